"""Who may do what: keys, scopes, limits, and the record of it."""
