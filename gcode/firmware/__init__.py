"""One folder per firmware."""
