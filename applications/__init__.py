"""Workflows around a machine: identify, design, verify, add controllers, scan, print live."""
