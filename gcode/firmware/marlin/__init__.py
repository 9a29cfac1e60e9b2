"""Marlin and its relatives: limits, planner, encoder."""
