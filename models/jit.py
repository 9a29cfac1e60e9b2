"""A typed wrapper of numba's decorator, so that mypy sees kernels, and its cache on disk.

Every kernel is compiled at its first use once per machine type and cached on disk, releases the
GIL, and keeps IEEE arithmetic (fastmath stays off: outputs must be reproducible).

Cached code contains called kernels and constants of other modules, but numba checks only the
kernel's own file. The cache's stamp therefore covers every module of ours that the kernel's module
imports, directly or indirectly.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast, overload

import llvmlite.binding as llvm  # type: ignore[import-untyped]
import numba
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    UserProvidedCacheLocator,
)
from numba.core.compiler import CompileResult
from numba.core.runtime.nrt import rtsys

__all__ = ["kernel", "source_digest"]

P = ParamSpec("P")
R = TypeVar("R")

_IMPORT = re.compile(rb"^(?:from|import) +([A-Za-z_][\w.]*)", re.MULTILINE)


class _ReadOnlyLocator(UserProvidedCacheLocator):
    """A read-only folder of kernels, as in an image."""

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> Any:
        """Return a locator if there are kernels of `file`, and else leave it to numba's own."""
        if not os.environ.get("NUMBA_CACHE_DIR"):
            return None
        locator: Any = cls(function, file)
        return locator if Path(locator.get_cache_path()).is_dir() else None


class _CacheImpl(CompileResultCacheImpl):
    _locator_classes = [_ReadOnlyLocator, *CompileResultCacheImpl._locator_classes]  # noqa: RUF012

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """See `numba.core.caching.CacheImpl`, which would also read the kernel's LLVM code.

        Only callers still to be compiled need it, and reading it takes longer than the rest.
        """
        (name, kind, (machine_code, llvm_code)), fndesc, *others, environments = payload
        engine = target_context.codegen()._engine
        engine._defined_symbols |= {
            fndesc.llvm_cpython_wrapper_name,
            fndesc.env_name,
            *(environment.env_name for environment in environments),
        }
        unread = name, kind, (machine_code, _nothing())
        anew: Any = CompileResult._rebuild
        result = anew(target_context, unread, fndesc, *others, environments)
        result.library._get_module_for_linking = cache(partial(llvm.parse_bitcode, llvm_code))
        return result


@cache
def _nothing() -> bytes:
    """Return an LLVM module without functions."""
    return bytes(llvm.parse_assembly("").as_bitcode())


class _CacheFile(IndexDataCacheFile):
    """Index and code of a kernel on disk; the code has its own stamp.

    Numba writes the index first. What a full disk or a power cut then keeps from being written
    leaves the code of earlier sources under its name.
    """

    def _save_data(self, name: str, data: Any) -> None:
        super()._save_data(name, (self._stamp, data))  # type: ignore[no-untyped-call]

    def _load_data(self, name: str) -> Any:
        stamp, data = super()._load_data(name)  # type: ignore[no-untyped-call]
        if stamp != self._stamp:
            raise FileNotFoundError(f"{name} has code of other sources")  # numba compiles anew
        return data

    @property
    def _stamp(self) -> Any:
        return self._version, self._source_stamp


class _KernelCache(FunctionCache):
    """Numba's cache on disk, with a stamp of all sources that went into the machine code.

    Where it cannot be written, a kernel that is not in it is compiled anew each time.
    """

    _impl_class = _CacheImpl

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        file = Path(function.__code__.co_filename)
        self._cache_file = _CacheFile(  # type: ignore[no-untyped-call]
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=(
                self._impl.locator.get_source_stamp(),
                source_digest(file, file.parents[function.__module__.count(".")]),
            ),
        )

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """See `numba.core.caching.Cache`, which would import all that compiling needs first.

        To run compiled code, the array runtime (`rtsys`) is enough.
        """
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            try:
                return self._load_overload(signature, target_context)  # type: ignore[no-untyped-call]
            except Exception:
                # A truncated file can raise anything. It is written again.
                with contextlib.suppress(OSError):
                    self._cache_file.flush()  # type: ignore[no-untyped-call]
                return None

    def save_overload(self, signature: Any, data: Any) -> None:
        """See `numba.core.caching.Cache`."""
        with contextlib.suppress(OSError):
            super().save_overload(signature, data)  # type: ignore[no-untyped-call]


@cache
def source_digest(file: Path, root: Path) -> str:
    """Return a digest of a module's text and of all modules below `root` that it leads to.

    Parameters
    ----------
    file, root : Path
        The module, and the folder that its packages lie in.
    """
    found: dict[Path, bytes] = {}
    open_ends = [file]
    while open_ends:
        path = open_ends.pop()
        if path not in found:
            found[path], modules = _text_digest(path)
            candidates = (root / f"{module.replace('.', '/')}.py" for module in modules)
            open_ends += [candidate for candidate in candidates if candidate.is_file()]
    total = hashlib.sha256()
    for path in sorted(found):
        total.update(found[path])
    return total.hexdigest()


@cache
def _text_digest(path: Path) -> tuple[bytes, tuple[str, ...]]:
    """Return a digest of a module's text, and the names of the modules that it imports."""
    text = path.read_bytes()
    names = tuple(name.decode() for name in dict.fromkeys(_IMPORT.findall(text)))
    return hashlib.sha256(text).digest(), names


@overload
def kernel(function: Callable[P, R], /) -> Callable[P, R]: ...


@overload
def kernel(
    *,
    inline: bool = False,
    force_inline: bool = False,
    allocates: bool = True,
) -> Callable[[Callable[P, R]], Callable[P, R]]: ...


def kernel(
    function: Callable[..., Any] | None = None,
    /,
    *,
    inline: bool = False,
    force_inline: bool = False,
    allocates: bool = True,
) -> Any:
    """Compile a function of numbers and arrays with numba.

    Use as ``@kernel`` or ``@kernel(inline=True)``. The undecorated function stays reachable as
    ``.py_func``.

    Parameters
    ----------
    inline : bool
        Paste the body into its callers (for helpers of a few lines in a hot loop).
    force_inline : bool
        Inline the machine code into callers whatever its length: a call forces the caller to spill
        its registers.
    allocates : bool
        False: it neither creates nor returns arrays, so reference counting is left out, which costs
        more than the work of a small kernel with many array arguments.
    """

    def compiled(body: Callable[..., Any]) -> Callable[..., Any]:
        decorate: Any = numba.njit(  # type: ignore[call-overload]  # its stubs lack _nrt
            nogil=True,
            fastmath=False,
            _nrt=allocates,
            inline="always" if inline else "never",
            forceinline=force_inline,
        )
        dispatcher: Any = decorate(body)
        dispatcher._cache = _KernelCache(body)
        return cast("Callable[..., Any]", dispatcher)

    return compiled if function is None else compiled(function)
