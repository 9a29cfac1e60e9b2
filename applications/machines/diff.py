"""Differences between two states of a machine, in words and figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from stillpath.applications.machines.resonances import Resonance, matched, resonances
from stillpath.applications.machines.revision import Revision
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSetSpec, PlantSpec

__all__ = ["Change", "diff", "replaced_plants"]

_SHOWN = 60


class Change(BaseModel):
    """One difference."""

    model_config = ConfigDict(frozen=True)

    place: str = Field(description="Field of the machine document.")
    text: str = Field(description="What changed, in words and figures.")
    before: Any = None
    after: Any = None
    percent: float | None = Field(
        default=None, description="Change of a number, or of a mode's frequency."
    )


def diff(old: Machine, new: Machine) -> tuple[Change, ...]:
    """Return the differences of two machines; none if and only if they are equal."""
    before, after = old.model_dump(mode="json"), new.model_dump(mode="json")
    axes_before, axes_after = before.pop("axes"), after.pop("axes")
    changes = list(_values("", before, after))
    for axis in sorted(axes_before):
        place = f"axes.{axis}"
        changes += _plants(place, axis.upper(), old.axes[axis], new.axes[axis])
        for document in (axes_before[axis], axes_after[axis]):
            del document["nominal"]
        changes += _values(place, axes_before[axis], axes_after[axis])
    return tuple(changes)


def replaced_plants(history: Sequence[Revision]) -> Iterator[str]:
    """Yield a line if the newest revision brings plants of an earlier one back.

    As a file does that was exported before the machine was measured again.
    """
    if len(history) < 2:
        return
    *earlier, before, now = history
    for axis, plants in sorted(now.machine.axes.items()):
        if plants == before.machine.axes[axis]:
            continue
        again = [r.number for r in earlier if r.machine.axes[axis] == plants]
        if again:
            yield (
                f"axis {axis.upper()}: the plants are those of revision {again[-1]} again; "
                f"revision {before.number} had newer ones. If the file is an old export: "
                f"`stillpath machines rollback {now.machine.name} {before.number}`"
            )


def _plants(place: str, axis: str, old: PlantSetSpec, new: PlantSetSpec) -> Iterator[Change]:
    """Yield the differences of two nominal plants: by modes, then by zeros."""
    if old.nominal == new.nominal:
        return
    told = [
        *_pairs(f"{place}.nominal", f"{axis} mode", old.nominal, new.nominal, zeros=False),
        *_pairs(f"{place}.nominal", f"{axis} zero", old.nominal, new.nominal, zeros=True),
    ]
    if not told:
        text = f"{axis} plant: {old.nominal.kind} -> {new.nominal.kind}, same f and zeta"
        told = [Change(place=f"{place}.nominal", text=text)]
    yield from told


def _pairs(
    place: str, what: str, old: PlantSpec, new: PlantSpec, *, zeros: bool
) -> Iterator[Change]:
    for a, b in matched(resonances(old, zeros=zeros), resonances(new, zeros=zeros)):
        text = f"{what} {_pair_text(a, b)}"
        if a is None or b is None:
            yield Change(place=place, text=text, before=a, after=b)
        elif _shown(a) != _shown(b):
            yield Change(place=place, text=text, before=a, after=b, percent=_percent(a[0], b[0]))


def _pair_text(a: Resonance | None, b: Resonance | None) -> str:
    if a is None or b is None:
        (f, zeta), word = (b, "new") if a is None else (a, "gone")  # type: ignore[misc]
        return f"at {f:.1f} Hz (zeta {zeta:.3f}) is {word}"
    moved = f"{a[0]:.1f} -> {b[0]:.1f} Hz ({_percent(a[0], b[0]):+.1f} %)"
    return f"{moved}, zeta {a[1]:.3f} -> {b[1]:.3f}"


def _values(place: str, old: Any, new: Any) -> Iterator[Change]:
    """Yield the differing leaves of two documents."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted(old.keys() | new.keys()):
            inner = f"{place}.{key}" if place else key
            yield from _values(inner, old.get(key), new.get(key))
    elif isinstance(old, list) and isinstance(new, list) and _long(old, new):
        yield from _lists(place, old, new)
    elif old != new:
        percent = _percent(old, new) if _numbers(old, new) and old else None
        change = "" if percent is None else f" ({percent:+.1f} %)"
        text = f"{place}: {_short(old)} -> {_short(new)}{change}"
        yield Change(place=place, text=text, before=old, after=new, percent=percent)


def _lists(place: str, old: list[Any], new: list[Any]) -> Iterator[Change]:
    """Compare lists of documents (members, modes, files) by length, not entry by entry."""
    if old == new:
        return
    changed = sum(a != b for a, b in zip(old, new, strict=False))
    parts = [f"{len(old)} -> {len(new)} entries"] if len(old) != len(new) else []
    parts += [f"{changed} of {len(old)} changed"] if changed else []
    yield Change(place=place, text=f"{place}: {', '.join(parts)}", before=old, after=new)


def _long(old: list[Any], new: list[Any]) -> bool:
    return any(isinstance(entry, dict | list) for entry in [*old, *new])


def _numbers(*values: Any) -> bool:
    return all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)


def _percent(old: float, new: float) -> float:
    return 100.0 * (new / old - 1.0)


def _shown(mode: Resonance) -> tuple[float, float]:
    """Return a mode rounded to nine digits."""
    return float(f"{mode[0]:.8e}"), float(f"{mode[1]:.8e}")


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if value is None:
        return "none"
    if isinstance(value, dict):
        text = "; ".join(f"{key} {_short(inner)}" for key, inner in value.items())
    elif isinstance(value, list) and _long(value, []):
        text = f"{len(value)} entries"
    elif isinstance(value, list):
        text = ", ".join(map(_short, value)) or "none"
    else:
        text = str(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 1]}…"
