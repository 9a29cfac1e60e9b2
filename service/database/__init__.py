"""The database: the service's memory, and the migrations of its schema."""
