"""Bodies on springs, dampers and dry friction, moved by motors: the physics of a printer.

Coordinates p are displacements in mm. Every element has an elongation e p - g c, c the commanded X
and Y: a spring force k times that and a damping force d times its rate act along e. A motor holds
its rotor to the command by a spring (the magnetic field); a belt has e = carriage - frame - rotor.
Friction follows Dahl's model: a stiff spring for micrometres and a constant force beyond.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from stillpath.models.arrays import Array
from stillpath.simulation.printers._kernels import followed

__all__ = ["Bodies", "Element", "Friction", "Motion"]

STEP_S = 1e-4
"""Commands are linear over a step, and friction is held: a tenth of the period of 1 kHz."""


@dataclass(frozen=True, slots=True)
class Element:
    """A spring with a damper.

    Attributes
    ----------
    along : dict of str to float
        Elongation of the element per unit of a coordinate.
    command : (float, float)
        Shortening per unit of the commanded X and Y.
    k_n_m, d_n_s_m : float
        Stiffness, and damping against the rate of the elongation.
    """

    along: dict[str, float]
    k_n_m: float
    d_n_s_m: float = 0.0
    command: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Friction:
    """Dry friction between bodies.

    Attributes
    ----------
    along : dict of str to float
        Slip per unit of a coordinate.
    force_n : float
        Sliding friction.
    bend_mm : float
        Slip over which friction builds up.
    """

    along: dict[str, float]
    force_n: float
    bend_mm: float = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Motion of the bodies, one sample per command.

    Attributes
    ----------
    position_mm, velocity_mm_s, accel_mm_s2 : ndarray, shape (coordinates, n)
    """

    position_mm: Array
    velocity_mm_s: Array
    accel_mm_s2: Array


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """Masses, the elements between them, and friction.

    Attributes
    ----------
    masses_kg : dict of str to float
        By coordinate; their order is that of all rows.
    """

    masses_kg: dict[str, float]
    elements: tuple[Element, ...]
    frictions: tuple[Friction, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Coordinates."""
        return tuple(self.masses_kg)

    def matrices(self) -> tuple[Array, Array, Array, Array, Array]:
        """Return M, D, K (n, n) and the inputs of command and its rate, shapes (n, 2)."""
        n = len(self.masses_kg)
        d, k = np.zeros((n, n)), np.zeros((n, n))
        by_command, by_rate = np.zeros((n, 2)), np.zeros((n, 2))
        for one in self.elements:
            e, g = self._row(one.along), np.array(one.command)
            k += one.k_n_m * np.outer(e, e)
            d += one.d_n_s_m * np.outer(e, e)
            by_command += one.k_n_m * np.outer(e, g)
            by_rate += one.d_n_s_m * np.outer(e, g)
        return np.diag(list(self.masses_kg.values())), d, k, by_command, by_rate

    def frequency_response(self, f_hz: Array) -> NDArray[np.complex128]:
        """Return coordinates over commanded X and Y, without friction, shape (f, n, 2)."""
        m, d, k, by_command, by_rate = self.matrices()
        s = 2j * np.pi * np.atleast_1d(np.asarray(f_hz, float))[:, None, None]
        return np.asarray(np.linalg.solve(s * s * m + s * d + k, by_command + s * by_rate))

    def natural_modes(self) -> Array:
        """Return rows (f_hz, zeta) of the motion without friction, rising in frequency."""
        m, d, k, _, _ = self.matrices()
        poles = np.linalg.eigvals(_state_matrix(m, d, k))
        upper = poles[poles.imag > 1e-6]
        rows = np.stack([np.abs(upper) / (2 * np.pi), -upper.real / np.abs(upper)], axis=1)
        return np.asarray(rows[np.argsort(rows[:, 0])])

    def follow(self, command_mm: Array, dt_s: float = STEP_S) -> Motion:
        """Let the bodies follow a command, shape (2, n), from rest where it begins.

        Raises
        ------
        ValueError
            For a sampling time longer than `STEP_S`: friction would be held too long.
        """
        if dt_s > STEP_S * (1 + 1e-9):
            raise ValueError(f"sampling time {dt_s:g} s is longer than {STEP_S:g} s")
        m, d, k, by_command, by_rate = self.matrices()
        n = len(m)
        inverse = np.linalg.inv(m)
        a = _state_matrix(m, d, k)
        slips = np.array([self._row(f.along) for f in self.frictions]).reshape(-1, n)
        # Inputs: the command (2), its rate (2), forces of friction.
        b = np.zeros((2 * n, 4 + len(slips)))
        b[n:] = inverse @ np.concatenate([by_command, by_rate, -slips.T], axis=1)
        step, now, slope = _held(a, b, dt_s)
        start = command_mm[:, :1]
        u = np.ascontiguousarray(command_mm - start)
        states = np.zeros((u.shape[1], 2 * n))
        followed(
            step,
            np.ascontiguousarray(now),
            np.ascontiguousarray(slope),
            u,
            dt_s,
            np.ascontiguousarray(slips),
            # Masses in kg and lengths in mm give forces in mN.
            1e3 * np.array([f.force_n for f in self.frictions]),
            np.array([f.bend_mm for f in self.frictions]),
            states,
        )
        velocity = states[:, n:].T
        accel = np.gradient(velocity, dt_s, axis=1)
        # At the start everything rests where the first command puts it.
        standing = np.linalg.solve(k, by_command) @ start
        return Motion(states[:, :n].T + standing, velocity, accel)

    def _row(self, along: dict[str, float]) -> Array:
        row = np.zeros(len(self.masses_kg))
        for name, share in along.items():
            row[self.names.index(name)] = share
        return row


def _state_matrix(m: Array, d: Array, k: Array) -> Array:
    n = len(m)
    inverse = np.linalg.inv(m)
    lower = np.concatenate([-inverse @ k, -inverse @ d], axis=1)
    return np.concatenate([np.eye(n, 2 * n, n), lower])


def _held(a: Array, b: Array, dt_s: float) -> tuple[Array, Array, Array]:
    """Return the matrices of a step: state, held inputs, and inputs that rise by 1 per step."""
    n, inputs = len(a), b.shape[1]
    block = np.zeros((n + 2 * inputs,) * 2)
    block[:n, :n] = a * dt_s
    block[:n, n : n + inputs] = b * dt_s
    block[n : n + inputs, n + inputs :] = np.eye(inputs)
    grown = expm(block)
    return grown[:n, :n].copy(), grown[:n, n : n + inputs].copy(), grown[:n, n + inputs :].copy()
