"""Authorisation: keys, scopes, limits, and the audit log."""
