"""Ripple from files of passes, for `stillpath identify --ripple`; nothing is stored here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import ValidationError

from stillpath.applications.identification.run import InputFile, read_inputs
from stillpath.models.complaints import explain
from stillpath.models.errors import ModelError
from stillpath.models.identification.readers import LARGEST_BYTES
from stillpath.models.identification.readers.compressed import unpacked
from stillpath.models.identification.readers.tables import check_size
from stillpath.models.identification.ripple import RippleLearning, WaveBasis
from stillpath.models.identification.ripple_passes import learn_machine_ripple, read_pass
from stillpath.models.machine import Machine
from stillpath.models.provenance import SourceFile
from stillpath.models.ripple import RippleAxis, RippleSide
from stillpath.models.user_files import as_utf8

__all__ = ["LearntRipple", "learn_from_files", "parse_basis"]

_LONGEST_NAME = 64
_FORM = "NAME:PITCH, NAME:PITCH:1,2,3 or either with @output appended"


@dataclass(frozen=True, slots=True)
class LearntRipple:
    """A machine with ripple, and the sources of the learning."""

    machine: Machine
    axis: RippleAxis
    sources: tuple[SourceFile, ...]
    summary: str

    def named(self, name: str | None, title: str | None) -> Machine:
        """Return the machine, with another name and title if given.

        Raises
        ------
        ModelError
            If no machine can have them.
        """
        machine = self.machine
        update = {"title": title or machine.title}
        if name is not None and name != machine.name:
            update = {
                "name": name,
                "title": title or f"{machine.title}, ripple learnt",
                "source": f"all but the ripple of axis {self.axis.upper()} is of {machine.title} "
                f"({machine.name}): {machine.source}",
            }
        try:
            return Machine.model_validate(machine.model_dump() | update)
        except ValidationError as error:
            raise ModelError(f"machine {name or machine.name!r:.80}: {explain(error)}") from None


def learn_from_files(
    files: Sequence[str],
    machine: Machine,
    axis: RippleAxis | None,
    parts: Sequence[str],
    *,
    gain: float = 0.5,
    remaining: bool = False,
    homing_repeatability_mm: float = 0.0,
) -> LearntRipple:
    """Learn the ripple of an axis from its passes, or update what the machine has.

    Parameters
    ----------
    files : sequence of str
        Paths of passes (`models.identification.ripple_passes`).
    parts : sequence of str
        What repeats; see `parse_basis`.

    Raises
    ------
    ModelError
        Where no axis is told, a file or part cannot be read, or `learn_ripple` refuses.
    """
    if axis is None:
        raise ModelError(
            "--ripple: say by --axis x or y (a or b: a motor of CoreXY) what the passes moved"
        )
    basis = [parse_basis(text) for text in parts]
    inputs = read_inputs(files)
    known: dict[bytes, InputFile] = {}
    for file in inputs:
        if (first := known.setdefault(file.content, file)) is not file:
            raise ModelError(
                f"{file.name} is a copy of {first.name}, and a copy is no repeat: give each pass "
                "once"
            )
    passes = [read_pass(_text(f.content, f.name), f.name) for f in inputs]
    made, learning = learn_machine_ripple(
        machine,
        axis,
        passes,
        basis,
        gain=gain,
        remaining=remaining,
        homing_repeatability_mm=homing_repeatability_mm,
    )
    return LearntRipple(made, axis, tuple(f.source for f in inputs), _summary(axis, made, learning))


def parse_basis(text: str) -> WaveBasis:
    """Read `NAME:PITCH[:1,2,3][@output]`, the pitch in mm; harmonics 1, 2, 3 by default.

    Raises
    ------
    ModelError
        If it has another form, or a number is out of range.
    """
    what, _, side = text.partition("@")
    fields = what.split(":")
    sides: dict[str, RippleSide] = {"": "input", "input": "input", "output": "output"}
    try:
        name, pitch_mm = fields[0].strip(), float(fields[1])
        listed = fields[2].split(",") if len(fields) > 2 else ["1", "2", "3"]
        numbers = tuple(int(number) for number in listed)
        enters = sides[side]
    except (IndexError, KeyError, ValueError):
        raise ModelError(f"--ripple {text!r}: {_FORM} is needed") from None
    good = len(fields) <= 3 and 1e-3 < pitch_mm <= 2000 and min(numbers) >= 1
    good = good and 1 <= len(name) <= _LONGEST_NAME
    if not good or max(numbers) > 400 or len(set(numbers)) < len(numbers):
        raise ModelError(
            f"--ripple {text!r}: {_FORM} is needed, the name up to {_LONGEST_NAME} characters, "
            "the pitch above 0.001 and up to 2000 mm, the harmonics from 1 to 400 and each once"
        )
    return WaveBasis(name, pitch_mm, numbers, enters)


def _text(content: bytes, name: str) -> str:
    content = as_utf8(unpacked(content, name, LARGEST_BYTES))
    check_size(content, name)
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise ModelError(f"{name}: not text (byte {error.start}); a pass is a table") from None


def _summary(axis: RippleAxis, machine: Machine, learning: RippleLearning) -> str:
    lines = [f"axis {axis}: the waves explain {learning.explained:.1%} of the deviation (rms)"]
    for source in machine.ripple[axis].sources:
        for h in source.harmonics:
            sd = "" if h.sd_um is None else f" +- {h.sd_um:.2f}"
            lines.append(
                f"  {source.name} {source.pitch_mm:g} mm, {source.enters}, harmonic {h.number}: "
                f"{h.amplitude_um:.2f}{sd} µm at {h.phase_deg:.1f} deg"
            )
    lines += [
        f"  {seen.source} {seen.number}: noise gain {seen.noise_gain:.2f}, "
        f"{seen.distance_hz:.3g} Hz from folding"
        for seen in learning.observability
        if seen.distance_hz is not None
    ]
    return "\n".join(lines)
