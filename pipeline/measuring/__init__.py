"""What is measured of planned motion: errors, spectra, layers, reference shapers."""
