"""Feedback designs for closed-loop machines: what a controller adds to a baseline loop."""
