"""Filtered basis functions on plain arrays, step by step.

A notebook in a script: run it as a whole, or cell by cell (`# %%`) in an editor that knows them.
Numbers in brackets are equations of K. S. Ramani's dissertation (see docs/fbf.md).
"""

# %% [markdown]
# One axis of a printer, as measured on a Lulzbot Taz 6 at 1 kHz. It has a pair of zeros outside
# the unit circle: its exact inverse grows without bound.

# %%
import numpy as np

from stillpath.compensation.basis import BASES, bspline_basis, ce_opt_basis, dct_basis
from stillpath.compensation.full_preview import FullPreview, independence
from stillpath.compensation.lifted import LiftedSet, lift, lifted_set
from stillpath.compensation.metrics import (
    effort_metric,
    error_metric,
    error_of_functions,
    robust_error_metric,
)
from stillpath.compensation.nominal import two_step
from stillpath.compensation.operators import DenseOperator
from stillpath.models.plants import Mode, ModesSpec, discretise
from stillpath.models.store import load_machine

DT_S, M = 1e-3, 600

plant = discretise(load_machine("taz6-x").axes["x"].nominal, DT_S)
print("zeros outside the unit circle:", np.round([z for z in plant.zeros() if abs(z) > 1], 4))

# %% [markdown]
# The lifted plant G is an operator: products with G and G' by FFT, a matrix only on request.

# %%
g = lift(plant, M)
u = np.sin(np.arange(M) / 20)
print("G u with and without the matrix:", float(np.abs(g.dense() @ u - g.apply(u)).max()))

# %% [markdown]
# A path: a zigzag at 100 mm/s, known from end to end, in steps of 10 um.

# %%
t = np.arange(M) * DT_S
corners = np.array([0.0, 0.1, 0.16, 0.26, 0.36, 0.46, 0.6])
y_d = np.round(np.interp(t, corners, [0, 0, 6, -4, 6, -4, 5]), 2)


def rms(x: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(x**2)))


print(f"uncompensated: rms error {rms(y_d - g.apply(y_d)):.3f} mm")

# %% [markdown]
# Three sets of 150 functions. All track white noise equally well (2.26); what differs is the
# effort. The optimal ones (3.22) stay out of what the plant hardly answers and go where it answers
# most, which is not where this smooth path is: a little more error, and no command that swings far
# beyond the path in its last samples.

# %%
bases = {
    "DCT": dct_basis(M, 150),
    "B-splines": bspline_basis(M, 150),
    "CE-Opt": ce_opt_basis(lifted_set(g.markov[None], [1.0]).gram, 150),
}
print(f"expected for white noise: J_e = {error_of_functions(150, M):.4f}")
for name, phi in bases.items():
    design = FullPreview(g, phi)
    command = design.command(y_d)
    error = y_d - g.apply(command)
    c = design.controller()
    print(
        f"{name:10} J_e {error_metric(g, c):.4f}  J_c {effort_metric(c):8.2f}  "
        f"rms error {rms(error):.4f} mm  largest command "
        f"{np.abs(command).max():6.2f} mm  condition {design.report.condition:.1e}"
    )

# %% [markdown]
# How many functions? Every command of fewer functions is a partial sum of the largest design.

# %%
counts = [25, 50, 75, 100, 125, 150]
commands = FullPreview(g, bases["CE-Opt"]).commands(y_d, counts)
for n, command in zip(counts, commands.T, strict=True):
    print(f"n = {n:3}: rms error {1e3 * rms(y_d - g.apply(command)):6.1f} um")

# %% [markdown]
# Existence and uniqueness (2.17): with as many functions as samples, filtered functions depend on
# each other: beside the silent inputs (as many as the plant has states) the rank does not rise by
# their number, and the least squares report says so too.

# %%
test = independence(plant, np.eye(M))
report = FullPreview(g, np.eye(M)).report
print(
    f"all {M} samples: rank {test.rank}, {test.augmented} with {test.silent} silent inputs -> "
    f"independent: {test.independent}"
)
print(f"least squares: rank {report.rank} of {report.functions}, unique: {report.unique}")

# %% [markdown]
# An uncertain plant: one mode, 180 to 220 Hz, damping .001 to .1. The set is two matrices,
# A = sum l G'G and B = sum l G, whatever the number of plants.


# %%
def mode(f_hz: float, zeta: float) -> np.ndarray:
    """Markov parameters of one mode."""
    spec = ModesSpec(modes=(Mode(f_hz=f_hz, zeta=zeta),))
    return discretise(spec, DT_S).impulse_response(M)


markov = np.array(
    [mode(f, z) for f in np.linspace(180, 220, 21) for z in np.geomspace(1e-3, 0.1, 5)]
)
members: LiftedSet = lifted_set(markov, np.full(len(markov), 1 / len(markov)))
standard = lift(mode(200.0, 0.01), M)
for name in BASES:
    psi = BASES[name](members, 300)
    one = FullPreview(standard, psi).controller()
    every = FullPreview(members, psi).controller()
    print(
        f"{name:8} J_e,r of one nominal model {robust_error_metric(members, one):6.3f}, "
        f"of the whole set {robust_error_metric(members, every):.3f}"
    )

# %% [markdown]
# Two steps (remark 4.7): nominal model (4.28), most robust functions for it, best number of them;
# the direction that all plants answer least is left out (r = 1).

# %%
robust = two_step(members, r=1)
c = FullPreview(DenseOperator(robust.nominal), robust.basis).controller()
print(
    f"two steps: best n = {robust.best} of {M} (r = {robust.r}), largest singular value "
    f"{robust.singular_values[-1]:.4f}, J_e,r {robust_error_metric(members, c):.3f}"
)
