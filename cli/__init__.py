"""Commands that belong to no room of their own, and what all commands take and check."""
