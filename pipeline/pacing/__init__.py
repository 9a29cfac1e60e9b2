"""Faster prints within a budget of contour error: samples of a file, trials, and a search."""
