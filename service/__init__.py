"""The server: HTTP, jobs, database, authentication, deliveries."""
