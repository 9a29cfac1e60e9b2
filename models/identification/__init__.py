"""Machine models from measurements: read, estimate, fit, and derive a set of plants."""
