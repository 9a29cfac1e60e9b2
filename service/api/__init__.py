"""The HTTP service: jobs in, files and reports out."""

from service.api.app import create_app

__all__ = ["create_app"]
