"""Moved to `models.reference_motion`."""

from models.reference_motion import reference_motion as reference_motion
