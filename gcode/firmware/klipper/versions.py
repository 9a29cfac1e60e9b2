"""Known faults of Klipper by its version."""

from __future__ import annotations

import re

__all__ = ["ignores_shaper_frequencies"]

_VERSION = re.compile(r"v0\.13\.0-(\d+)-g[0-9a-f]+")
_IGNORING = range(631, 642)


def ignores_shaper_frequencies(version: str) -> bool:
    """Return whether SET_INPUT_SHAPER leaves printer.cfg's frequencies in force.

    Between commits db10e92e9 (2026-04-27, v0.13.0-631) and 77d5d942e (2026-05-04, v0.13.0-642) of
    klippy/extras/input_shaper.py, SHAPER_FREQ_X and SHAPER_FREQ_Y are checked and then forgotten.
    So SHAPER_FREQ_X=0 does not switch the shaper off.

    Parameters
    ----------
    version : str
        What ``git describe`` says of the host, as klippy.log, Moonraker and web pages show it.
        A fork with another numbering counts as not affected.
    """
    found = _VERSION.match(version)
    return found is not None and int(found[1]) in _IGNORING
