"""The service's database and the migrations of its schema."""
