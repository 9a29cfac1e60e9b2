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
"""So many more objects than before make the search for cycles worth its time."""
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
        # Modules and kernels are very many objects, and all of them stay: to look through them
        # whenever 700 have come, as Python does, only makes the start longer.
        gc.set_threshold(_NEW_OBJECTS)
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")
    if "NUMBA_CACHE_DIR" not in os.environ and not _package_is_writable():
        os.environ["NUMBA_CACHE_DIR"] = str(_kernel_cache())


def _keep_freed_memory() -> None:
    """Tell the allocator of glibc to reuse what is freed; elsewhere nothing happens.

    Arrays of samples come and go by the megabyte. Given back to the kernel every time, and zeroed
    by it anew, they cost a tenth of a job's time.
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
    folder = (Path(base) if base else Path.home() / ".cache") / "stillpath" / "numba"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return Path(tempfile.mkdtemp(prefix="stillpath-numba-"))
    return folder
