"""A file in, a compensated and checked file and its figures out; no web framework, no database."""
