"""RepRapFirmware 3 (Duet)."""
