"""What listens, stores, schedules and authenticates: HTTP, jobs, database, deliveries."""
