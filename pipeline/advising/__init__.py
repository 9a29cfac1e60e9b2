"""Advice: a print file with better shaper and acceleration commands, its moves untouched."""
