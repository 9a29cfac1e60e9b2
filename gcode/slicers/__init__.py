"""Information of slicers beside the commands: marks, their own estimates, settings."""
