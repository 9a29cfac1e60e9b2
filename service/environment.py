"""Environment variables that must be set before numpy and numba are imported, in every process."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
import tempfile
from pathlib import Path

__all__ = ["prepare_environment"]

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
"""Parameters of glibc's mallopt (malloc.h)."""
_KEPT_BYTES, _STEP_BYTES = 256 << 20, 16 << 20
_NEW_OBJECTS = 50_000
"""Number of new objects that triggers a garbage collection."""
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def prepare_environment(*, computing: bool = True) -> None:
    """Set defaults for the numerical libraries; what the user has set stays.

    BLAS gets one thread: the matrices are small, and more threads only burn CPU. Numba gets a
    writable folder for compiled kernels where the installed package cannot hold them. Child
    processes inherit both.

    Parameters
    ----------
    computing : bool
        Whether this process computes: then memory that is freed stays with it, and cycles of
        objects are looked for seldom. One that lasts and leaves computing to others gives it back.
    """
    if computing:
        _keep_freed_memory()
        # Modules and kernels are many permanent objects: a collection for every 700 new ones,
        # Python's default, would only slow the start.
        gc.set_threshold(_NEW_OBJECTS)
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")
    if "NUMBA_CACHE_DIR" not in os.environ and not _package_is_writable():
        os.environ["NUMBA_CACHE_DIR"] = str(_kernel_cache())


def _keep_freed_memory() -> None:
    """Make glibc's allocator keep freed memory; a no-op elsewhere.

    Returning large sample arrays to the kernel, which zeroes them again, costs a tenth of a job's
    time.
    """
    if not sys.platform.startswith("linux"):
        return
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_MMAP_THRESHOLD, _KEPT_BYTES)
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
        mallopt(_TOP_PAD, _STEP_BYTES)


def _package_is_writable() -> bool:
    return os.access(Path(__file__).resolve().parent.parent / "models", os.W_OK)


def _kernel_cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    try:
        folder = (Path(base) if base else Path.home() / ".cache") / "stillpath" / "numba"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # not allowed, or a user without a home
        return Path(tempfile.mkdtemp(prefix="stillpath-numba-"))
    return folder
