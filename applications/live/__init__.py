"""The compensation for print time: inside Klipper."""
