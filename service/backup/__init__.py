"""Backup and restore of the data directory of a service on one computer."""
