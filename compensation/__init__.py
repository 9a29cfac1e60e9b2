"""Command design: from planned positions to commands. Knows plants, not files."""
