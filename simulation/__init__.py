"""What a machine does with a command: plant response and error measures."""
