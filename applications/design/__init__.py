"""Report on the design for one axis: plant, metrics, ladder, and the cost of model errors."""
