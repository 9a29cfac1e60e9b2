"""What is done around a machine: identify, design, prove, add controllers, scan, print live."""
