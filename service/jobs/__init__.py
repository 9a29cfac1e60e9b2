"""Jobs: a state machine without I/O, a store that persists them, workers that run them."""
