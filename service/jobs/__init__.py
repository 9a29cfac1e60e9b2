"""Jobs: a state machine without I/O, a store that remembers, workers that do the work."""
