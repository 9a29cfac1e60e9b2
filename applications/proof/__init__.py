"""Proof on metal: prints that show compensated beside planned motion, and logs read back."""
