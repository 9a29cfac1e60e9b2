"""The effect of a command on a machine: plant response and error measures."""
