"""Virtual printers: masses, belts and friction, a form that no model of ours has."""
