"""The one exception of this package."""

__all__ = ["ModelError"]


class ModelError(ValueError):
    """A machine or plant that cannot be used; the message says what, where and the remedy."""
