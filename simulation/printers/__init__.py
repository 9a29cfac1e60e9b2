"""Virtual printers: masses, belts and friction, deliberately unlike the model structures."""
