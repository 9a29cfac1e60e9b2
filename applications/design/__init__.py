"""A look at the design for one axis: the plant, the metrics, the ladder, what errors of it cost."""
