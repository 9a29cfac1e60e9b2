"""What slicers write beside the commands: marks, their own estimates, settings."""
