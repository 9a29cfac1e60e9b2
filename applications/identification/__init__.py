"""Identify machines from measurement files, with a page that shows the quality of the fit."""
