"""Lifted systems: a linear plant acting on M + 1 samples, as one operator (paper 003, A.2).

An operator multiplies with G and G' without forming G: by FFT where it is Toeplitz, by running the
states forward and the costates backward where the plant changes with time, block by block where
there are several inputs and outputs. `compensation.lifted` makes them from plants.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import toeplitz

from stillpath.compensation._lifted_kernels import run_adjoint, run_forward
from stillpath.compensation.base import DesignError
from stillpath.models.arrays import Array

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator

__all__ = [
    "BlockOperator",
    "DenseOperator",
    "LiftedOperator",
    "ProductOperator",
    "TimeVaryingOperator",
    "ToeplitzOperator",
]

_Product = Callable[[Array], Array]

_COLUMNS = 64
"""Columns per FFT: more would only use more memory."""


class LiftedOperator(ABC):
    """A linear system over a finite time: (cols,) or (cols, k) inputs to (rows, ...) outputs."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """Rows and columns of G."""

    def apply(self, u: ArrayLike) -> Array:
        """Return G u.

        Parameters
        ----------
        u : array_like, shape (cols,) or (cols, k)

        Returns
        -------
        ndarray, shape (rows,) or (rows, k)
        """
        return self._checked(u, self.shape[1], "input", self._forward)

    def apply_adjoint(self, e: ArrayLike) -> Array:
        """Return G' e, shape (cols,) or (cols, k), for `e` of shape (rows,) or (rows, k)."""
        return self._checked(e, self.shape[0], "output", self._backward)

    def dense(self) -> Array:
        """Return G as a matrix, shape (rows, cols)."""
        return self.apply(np.eye(self.shape[1]))

    def as_linear_operator(self) -> LinearOperator:
        """Return the operator in the form that `scipy.sparse.linalg` expects."""
        from scipy.sparse.linalg import LinearOperator  # slow to import, seldom needed

        return LinearOperator(
            shape=self.shape,
            matvec=self.apply,
            rmatvec=self.apply_adjoint,
            matmat=self.apply,
            rmatmat=self.apply_adjoint,
            dtype=np.float64,
        )

    @abstractmethod
    def _forward(self, u: Array) -> Array:
        """Return G u for u of shape (cols, k)."""

    @abstractmethod
    def _backward(self, e: Array) -> Array:
        """Return G' e for e of shape (rows, k)."""

    def _checked(self, x: ArrayLike, length: int, what: str, product: _Product) -> Array:
        values = np.asarray(x, np.float64)
        if values.ndim not in (1, 2) or len(values) != length:
            raise DesignError(
                f"{what} of shape {values.shape}: this lifted system, shape {self.shape}, takes "
                f"({length},) or ({length}, k)"
            )
        return product(values) if values.ndim == 2 else product(values[:, None])[:, 0]


class DenseOperator(LiftedOperator):
    """A matrix with the interface of an operator."""

    def __init__(self, matrix: ArrayLike) -> None:
        self._matrix = np.asarray(matrix, np.float64)

    @property
    def shape(self) -> tuple[int, int]:
        """See `LiftedOperator.shape`."""
        rows, cols = self._matrix.shape
        return rows, cols

    def dense(self) -> Array:
        """See `LiftedOperator.dense`."""
        return self._matrix

    def _forward(self, u: Array) -> Array:
        return self._matrix @ u

    def _backward(self, e: Array) -> Array:
        return self._matrix.T @ e


class ToeplitzOperator(LiftedOperator):
    """A time-invariant system; products cost O(M log M).

    Parameters
    ----------
    markov : array_like, shape (m,)
        Markov parameters g_0 .. g_M (paper 003, A.2).
    ahead : array_like, shape (p,), p < m
        Parameters g_-1, g_-2, ... of a system that looks ahead (A.4); none for a plant.
    """

    def __init__(self, markov: ArrayLike, ahead: ArrayLike = ()) -> None:
        self.markov = np.array(markov, np.float64)
        self.ahead = np.array(ahead, np.float64)
        m = len(self.markov)
        if m == 0 or self.markov.ndim != 1 or self.ahead.ndim != 1 or len(self.ahead) >= m:
            raise DesignError(
                f"Markov parameters of shape {self.markov.shape}, {self.ahead.shape} ahead: give "
                "g_0 .. g_M and, for a system that looks ahead, at most M more"
            )
        if not (np.isfinite(self.markov).all() and np.isfinite(self.ahead).all()):
            raise DesignError("Markov parameters are not finite: is the plant unstable?")

    @property
    def shape(self) -> tuple[int, int]:
        """See `LiftedOperator.shape`."""
        return len(self.markov), len(self.markov)

    def dense(self) -> Array:
        """See `LiftedOperator.dense`."""
        row = np.zeros_like(self.markov)
        row[1 : len(self.ahead) + 1] = self.ahead
        return np.asarray(toeplitz(self.markov, row), np.float64)

    @cached_property
    def _size(self) -> int:
        from scipy.fft import next_fast_len  # slow to import, seldom needed

        return int(next_fast_len(2 * len(self.markov) - 1, real=True))

    @cached_property
    def _spectrum(self) -> NDArray[np.complex128]:
        # A circulant matrix of at least 2 M + 1 samples holds G in its corner.
        around = np.zeros(self._size)
        around[: len(self.markov)] = self.markov
        if len(self.ahead):
            around[-len(self.ahead) :] = self.ahead[::-1]
        return np.asarray(np.fft.rfft(around), np.complex128)

    def _forward(self, u: Array) -> Array:
        return self._multiply(u, self._spectrum)

    def _backward(self, e: Array) -> Array:
        return self._multiply(e, self._spectrum.conj())

    def _multiply(self, x: Array, spectrum: NDArray[np.complex128]) -> Array:
        m, k = x.shape
        out = np.empty((m, k))
        for first in range(0, k, _COLUMNS):
            part = slice(first, first + _COLUMNS)
            # Columns as rows: transforms run along contiguous memory.
            there = np.fft.rfft(x.T[part], self._size, axis=1)
            out[:, part] = np.fft.irfft(there * spectrum, self._size, axis=1)[:, :m].T
        return out


class TimeVaryingOperator(LiftedOperator):
    """A plant that changes from sample to sample (LTV, LPV); products cost O(M n^2).

    The state is passed on unchanged when the plant changes, so all plants must use the same (for
    instance physical) coordinates. `time_varying` builds it from plants.

    Parameters
    ----------
    a, b, c, d : ndarray, shapes (p, n, n), (p, n), (p, n), (p,)
        p state-space plants of order n.
    which : ndarray of int, shape (m,)
        Index of the plant at each sample.
    """

    def __init__(self, a: Array, b: Array, c: Array, d: Array, which: NDArray[np.int64]) -> None:
        plants, order = b.shape
        expected = ((plants, order, order), (plants, order), (plants, order), (plants,))
        given = (a.shape, b.shape, c.shape, d.shape)
        if given != expected or which.ndim != 1 or len(which) == 0:
            raise DesignError(
                f"time-varying plant with a, b, c, d of shapes {given}, {which.shape} samples: "
                f"{expected} and at least one sample needed"
            )
        if which.min() < 0 or which.max() >= plants:
            raise DesignError(f"`which` names plants {which.min()} to {which.max()} of {plants}")
        self._system = tuple(np.ascontiguousarray(x, np.float64) for x in (a, b, c, d))
        self._which = np.ascontiguousarray(which, np.int64)

    @property
    def shape(self) -> tuple[int, int]:
        """See `LiftedOperator.shape`."""
        return len(self._which), len(self._which)

    def free_response(self, state: ArrayLike) -> Array:
        """Return the outputs, shape (m,), that the initial state (n,) causes without input."""
        x = np.array(state, np.float64)[:, None]
        return self._run(np.zeros((len(self._which), 1)), x)[:, 0]

    def _forward(self, u: Array) -> Array:
        return self._run(u, np.zeros((self._system[1].shape[1], u.shape[1])))

    def _run(self, u: Array, x: Array) -> Array:
        y = np.empty_like(u, order="C")
        a, b, c, d = self._system
        run_forward(a, b, c, d, self._which, np.ascontiguousarray(u), x, y)
        return y

    def _backward(self, e: Array) -> Array:
        v = np.empty_like(e, order="C")
        a, b, c, d = self._system
        run_adjoint(a, b, c, d, self._which, np.ascontiguousarray(e), v)
        return v


class BlockOperator(LiftedOperator):
    """Several inputs and outputs: one operator per pair, square or not.

    Signals are stacked one after the other: all samples of the first input, then of the second.

    Parameters
    ----------
    blocks : sequence of rows of operators
        `blocks[i][j]` maps input j to output i; None: no connection.
    """

    def __init__(self, blocks: Sequence[Sequence[LiftedOperator | None]]) -> None:
        self._blocks = [list(row) for row in blocks]
        widths = {len(row) for row in self._blocks}
        if len(widths) != 1 or widths == {0}:
            raise DesignError("blocks must form a grid: every output with the same inputs")
        self._rows = [self._length(row, 0, f"output {i}") for i, row in enumerate(self._blocks)]
        columns = zip(*self._blocks, strict=True)
        self._cols = [self._length(col, 1, f"input {j}") for j, col in enumerate(columns)]

    @property
    def shape(self) -> tuple[int, int]:
        """See `LiftedOperator.shape`."""
        return sum(self._rows), sum(self._cols)

    def dense(self) -> Array:
        """See `LiftedOperator.dense`."""
        return np.block(
            [
                [np.zeros((m, k)) if block is None else block.dense()
                 for block, k in zip(row, self._cols, strict=True)]
                for row, m in zip(self._blocks, self._rows, strict=True)
            ]
        )  # fmt: skip

    def _forward(self, u: Array) -> Array:
        inputs = np.split(u, np.cumsum(self._cols)[:-1])
        out = [np.zeros((m, u.shape[1])) for m in self._rows]
        for y, row in zip(out, self._blocks, strict=True):
            for block, part in zip(row, inputs, strict=True):
                if block is not None:
                    y += block.apply(part)
        return np.concatenate(out)

    def _backward(self, e: Array) -> Array:
        outputs = np.split(e, np.cumsum(self._rows)[:-1])
        out = [np.zeros((m, e.shape[1])) for m in self._cols]
        for part, row in zip(outputs, self._blocks, strict=True):
            for v, block in zip(out, row, strict=True):
                if block is not None:
                    v += block.apply_adjoint(part)
        return np.concatenate(out)

    @staticmethod
    def _length(blocks: Iterable[LiftedOperator | None], side: int, what: str) -> int:
        lengths = {block.shape[side] for block in blocks if block is not None}
        if len(lengths) != 1:
            raise DesignError(
                f"blocks of {what} have lengths {sorted(lengths)}: they must agree, and one block "
                "at least must be there"
            )
        return lengths.pop()


class ProductOperator(LiftedOperator):
    """Two systems in series: `after` times `first` (a weighting filter, remark 3.3)."""

    def __init__(self, after: LiftedOperator, first: LiftedOperator) -> None:
        if after.shape[1] != first.shape[0]:
            raise DesignError(
                f"systems of shapes {after.shape} after {first.shape} do not follow each other"
            )
        self._after, self._first = after, first

    @property
    def shape(self) -> tuple[int, int]:
        """See `LiftedOperator.shape`."""
        return self._after.shape[0], self._first.shape[1]

    def _forward(self, u: Array) -> Array:
        return self._after.apply(self._first.apply(u))

    def _backward(self, e: Array) -> Array:
        return self._first.apply_adjoint(self._after.apply_adjoint(e))
