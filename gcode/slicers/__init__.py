"""What slicers write besides commands: marks, estimates, settings."""
