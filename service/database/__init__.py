"""The database: what the service remembers, and how its schema grows."""
