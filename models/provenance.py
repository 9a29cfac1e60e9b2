"""Origin of a model and how far it can be trusted; stored beside the plants."""

from __future__ import annotations

from datetime import date
from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from stillpath.models.document import Document, Finite, NonNegative, Positive

__all__ = ["ADDED", "Kind", "MeasuredMode", "Phase", "Provenance", "SourceFile"]

Kind: TypeAlias = Literal[
    "raw log",
    "ring test",
    "spectrum",
    "frequency response",
    "recorded drive",
    "model file",
    "typed in",
]
"""What a model was made of."""

Phase: TypeAlias = Literal["not measured", "aligned at low frequency"]
"""How the phase was obtained. No recording of a printer shares its clock with the command, so what
is measured is phase relative to slow motion, which is taken to be on time."""

ADDED = ("phase", "slow_delay_s", "coherent_share", "coherent_band_hz", "friction")
"""Fields that older documents lack; None says nothing new (`models.machine.Machine.revision`)."""


class SourceFile(Document):
    """A file that was read: its name (no folder) and the SHA-256 of its bytes."""

    name: str
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class MeasuredMode(Document):
    """A resonance with the standard deviations of its fit; None where the fit has none."""

    f_hz: Positive
    zeta: Finite
    f_sd_hz: NonNegative | None = None
    zeta_sd: NonNegative | None = None


class Provenance(Document):
    """How the plants of an axis were found.

    Attributes
    ----------
    kind : str
        What was read.
    residual : float, optional
        Of the fit: NRMSE (0.01 is 1 %), or rms in dB for a spectrum.
    delay_s, gain : float, optional
        What the fit set aside: a delay of the recording against the command, and the level of what
        was measured against what was commanded.
    trust_below_hz : float, optional
        Above, the model may be far off although it fits (phase unknown, or not measured).
    phase : str, optional
        How it was obtained.
    slow_delay_s : (float, float), optional
        Least and largest delay of slow motion of the plants that explain the measurement. Of a
        spectrum the members have it; those of a response are advanced by it, as nobody knows what
        of it is the recording's. Where the clocks of raw logs show that an axis follows later than
        the other, its members have a delay within this range (`identification.clocks`).
    coherent_share : float, optional
        Of the measured frequencies, those at which the motion follows the command.
    coherent_band_hz : (float, float), optional
        Lowest and highest of these.
    friction : str, optional
        That the axis's friction was assumed, not measured (`models.friction.with_least_friction`).
    """

    kind: Kind
    measured_on: date | None = None
    sources: tuple[SourceFile, ...] = ()
    residual: NonNegative | None = None
    delay_s: Finite | None = None
    gain: Positive | None = None
    modes: tuple[MeasuredMode, ...] = ()
    trust_below_hz: Positive | None = None
    phase: Phase | None = None
    slow_delay_s: tuple[Finite, Finite] | None = None
    coherent_share: Annotated[float, Field(ge=0, le=1)] | None = None
    coherent_band_hz: tuple[Positive, Positive] | None = None
    friction: Literal["assumed"] | None = None

    @property
    def magnitude_only(self) -> bool:
        """Whether the phase was not measured."""
        return self.kind == "spectrum"
