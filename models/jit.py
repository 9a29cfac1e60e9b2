"""A typed face for numba's decorator, so that kernels stay visible to mypy.

Every kernel of the house is compiled ahead of its first use once per machine type (`cache=True`),
releases the GIL, and keeps IEEE arithmetic (fastmath stays off: outputs must be reproducible).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast, overload

import numba

__all__ = ["kernel"]

P = ParamSpec("P")
R = TypeVar("R")


@overload
def kernel(function: Callable[P, R], /) -> Callable[P, R]: ...


@overload
def kernel(
    *, inline: bool = False, parallel: bool = False
) -> Callable[[Callable[P, R]], Callable[P, R]]: ...


def kernel(
    function: Callable[..., Any] | None = None,
    /,
    *,
    inline: bool = False,
    parallel: bool = False,
) -> Any:
    """Compile a function of numbers and arrays with numba.

    Use as ``@kernel`` or ``@kernel(inline=True)``. The undecorated function stays reachable as
    ``.py_func``.

    Parameters
    ----------
    inline : bool
        Paste the body into its callers (for helpers of a few lines in a hot loop).
    parallel : bool
        Allow `numba.prange`.
    """

    def compiled(body: Callable[..., Any]) -> Callable[..., Any]:
        decorate = numba.njit(
            cache=True,
            nogil=True,
            fastmath=False,
            parallel=parallel,
            inline="always" if inline else "never",
        )
        return cast("Callable[..., Any]", decorate(body))

    return compiled if function is None else compiled(function)
