"""Klipper: its dialect and its planner."""
