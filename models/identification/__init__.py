"""Machine models from measurements: read, estimate, fit, and make a set of plants of it."""
