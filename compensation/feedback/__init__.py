"""Feedback designs for closed-loop machines: add-ons to a baseline loop."""
