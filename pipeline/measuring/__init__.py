"""Measurements of planned motion: errors, spectra, layers, reference shapers."""
