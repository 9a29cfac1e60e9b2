"""What computes for a request: in processes of its own, with limits, owners taking turns."""
