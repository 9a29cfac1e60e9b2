"""Validation on the real printer: test prints with a compensated half, and logs read back."""
