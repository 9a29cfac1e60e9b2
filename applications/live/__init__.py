"""Compensation at print time, inside Klipper."""
