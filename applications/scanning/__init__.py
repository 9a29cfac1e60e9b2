"""Scanning (laser) machines: hatches in, commands and predicted residuals out."""
