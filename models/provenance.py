"""Where a model comes from and how far it can be trusted; stored beside the plants."""

from __future__ import annotations

from datetime import date
from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from models.document import Document, Finite, NonNegative, Positive

__all__ = ["Kind", "MeasuredMode", "Provenance", "SourceFile"]

Kind: TypeAlias = Literal[
    "raw log", "spectrum", "frequency response", "recorded drive", "model file", "typed in"
]
"""What a model was made of."""


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
        What was read. The phase is unknown for `spectrum`: the model is minimum phase by
        convention.
    residual : float, optional
        Of the fit: NRMSE (0.01 is 1 %), or rms in dB for a spectrum.
    delay_s, gain : float, optional
        What the fit set aside: a delay that cannot be told from the start of the recording, and
        the sensor's gain.
    trust_below_hz : float, optional
        Above, the model may be far off although it fits (phase unknown, or not measured).
    """

    kind: Kind
    measured_on: date | None = None
    sources: tuple[SourceFile, ...] = ()
    residual: NonNegative | None = None
    delay_s: Finite | None = None
    gain: Positive | None = None
    modes: tuple[MeasuredMode, ...] = ()
    trust_below_hz: Positive | None = None

    @property
    def magnitude_only(self) -> bool:
        """Whether the phase was not measured."""
        return self.kind == "spectrum"
