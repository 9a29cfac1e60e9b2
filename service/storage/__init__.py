"""Where the files of jobs lie: a folder, or S3."""

from stillpath.service.storage.base import Stat, Storage, StorageError, sha256_of

__all__ = ["Stat", "Storage", "StorageError", "sha256_of"]
