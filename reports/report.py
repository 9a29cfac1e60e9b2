"""Turns a `Result` into report.html and report.json.

The page holds everything it needs: style, script, and the data as inert JSON. Its content
security policy names the hashes of its own style and script and forbids all else, so a layer
name or a file name can never become code.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stillpath.pipeline.result import Channel, GroupFigures, Result
from stillpath.reports.figures import spectrum_figures
from stillpath.reports.pages import asset, content_hash, rendered, thousands, um_text, write_texts

__all__ = ["headline_figures", "render_report", "write_report"]

_PACKAGE = "stillpath.reports"
_PUT_BACK_SHOWN = 100
_FEATURES_SHOWN = 40
_LEGEND_QUANTILE = 0.99


def write_report(result: Result, directory: Path) -> None:
    """Write report.html and report.json into a folder.

    Each file is written beside its place and moved there whole.

    Parameters
    ----------
    directory : Path
        Made if it does not exist.

    Raises
    ------
    OSError
        If the folder or a file cannot be written.
    """
    page = render_report(result)
    write_texts(directory, {"report.json": result.model_dump_json(), "report.html": page})


def render_report(result: Result) -> str:
    """Return the report as one HTML page."""
    script = asset(_PACKAGE, "report.js")
    features = sorted(result.features, key=lambda group: -group.seconds)
    channels = {channel.name: channel for channel in result.channels}
    return rendered(
        _PACKAGE,
        "report.html.j2",
        asset(_PACKAGE, "report.css"),
        {
            "um": um_text,
            "short": _short,
            "plain": _plain,
            "duration": _duration,
            "share": _share,
            "megabytes": _megabytes,
            "number": thousands,
        },
        result=result,
        channels=channels,
        writes="after" in channels and result.settings.get("method") != "live",
        headline=headline_figures(result.channels, result.settings.get("where")),
        rows=_rows(result.channels),
        features=features[:_FEATURES_SHOWN],
        widest=_widest(features),
        spectra=spectrum_figures(result),
        put_back=result.put_back[:_PUT_BACK_SHOWN],
        script=script,
        script_hash=content_hash(script),
        data=_data(result),
    )


def headline_figures(
    channels: Sequence[Channel], where: str | float | None = None
) -> dict[str, Any]:
    """Return what the report says first: contour errors (rms, um) while extruding.

    Of a file that extrudes nothing, such as a coupon drawn with a pen, that of all motion; of one
    that is compensated in part, that of the features that were chosen (the setting `where`).

    Returns
    -------
    dict
        ``before``, ``after``, ``shaper`` : of the channels; None without such a channel.
        ``ratio`` : how many times smaller the error became; None if it hardly did.
        ``of`` : words for what these are errors of.
        ``range``, ``shaper_range`` : of `after` and `shaper` over the plants, if they are known.
        ``rubbing`` : upper ends of ranges with guides that rub much, by channel, if it is known.
    """
    extrudes = any(channel.extruding.contour_max_um > 0 for channel in channels)
    scope = "extruding" if extrudes else "all_motion"
    rms = {channel.name: getattr(channel, scope).contour_rms_um for channel in channels}
    selected = {c.name: c.selected_rms_um for c in channels if c.selected_rms_um is not None}
    rms.update(selected)
    chosen = "of outer walls" if where == "walls" else "of visible surfaces"
    of = chosen if selected else "while extruding"
    before, after = rms.get("before"), rms.get("after")
    ratio = before / after if before and after else None
    ranges = {channel.name: channel.contour_range_um for channel in channels}
    rubbing = {channel.name: channel.contour_rubbing_um for channel in channels}
    return {
        "range": ranges.get("after") if extrudes else None,
        "rubbing": rubbing if extrudes and rubbing.get("after") else None,
        "shaper_range": ranges.get("shaper") if extrudes else None,
        "of": of if extrudes else "of all motion (nothing is extruded)",
        "before": before,
        "after": after,
        "shaper": rms.get("shaper"),
        # Measuring an unchanged file is no improvement, whatever the last digit says.
        "ratio": ratio if ratio and ratio >= 1.05 else None,
    }


def _rows(channels: Sequence[Channel]) -> list[dict[str, Any]]:
    scopes = {"extruding": "While extruding", "all_motion": "All motion"}
    measures = {
        "contour_rms_um": "contour, rms",
        "contour_max_um": "contour, max",
        "tracking_rms_um": "tracking, rms",
        "tracking_max_um": "tracking, max",
    }
    rows = [
        {
            "scope": title if number == 0 else "",
            "label": label,
            "values": [getattr(getattr(channel, scope), name) for channel in channels],
        }
        for scope, title in scopes.items()
        for number, (name, label) in enumerate(measures.items())
    ]
    rows.append(
        {
            "scope": "At rest",
            "label": "vibration in the first 0.1 s, rms",
            "values": [channel.residual_rms_um for channel in channels],
        }
    )
    return rows


def _widest(groups: Sequence[GroupFigures]) -> float:
    values = [value for group in groups for value in group.contour_rms_um.values()]
    return max((value for value in values if math.isfinite(value)), default=0.0) or 1.0


def _data(result: Result) -> str:
    """Return the data for the script, as JSON that is safe inside a script element."""
    data = {
        "channels": [{"name": c.name, "label": _short(c.label)} for c in result.channels],
        "scale_um": _legend_top(result),
        "track": {
            "bin_s": result.track.bin_s,
            "values": {k: _rounded(v, 2) for k, v in result.track.contour_rms_um.items()},
        },
        "layers": [
            {"name": g.name, "seconds": round(g.seconds, 1), "values": _mapped(g.contour_rms_um)}
            for g in result.layers
        ],
        "views": [
            {
                "layer": view.layer,
                "z": round(view.z_mm, 3),
                "x": _rounded(view.x_mm, 2),
                "y": _rounded(view.y_mm, 2),
                "on": "".join("1" if flag else "0" for flag in view.extruding),
                "line": view.line,
                "error": {k: _rounded(v, 1) for k, v in view.contour_um.items()},
            }
            for view in result.layer_views
        ],
    }
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("&", "\\u0026")


def _legend_top(result: Result) -> float:
    """Return the top of the shared colour scale: a round number that few vertices exceed."""
    values = sorted(
        value
        for view in result.layer_views
        for value, on in zip(view.contour_um.get("before", ()), view.extruding, strict=False)
        if on and math.isfinite(value)
    )
    if not values:
        return 1.0
    top = max(values[int(_LEGEND_QUANTILE * (len(values) - 1))], 1e-3)
    step = 10.0 ** math.floor(math.log10(top))
    return next(step * f for f in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * f >= top * (1 - 1e-9))


def _rounded(values: Sequence[float], digits: int) -> list[float | None]:
    rounded = np.round(values, digits)
    found: list[float | None] = rounded.tolist()
    for k in np.flatnonzero(~np.isfinite(rounded)):
        found[k] = None
    return found


def _mapped(values: dict[str, float]) -> dict[str, float | None]:
    return {k: round(v, 2) if math.isfinite(v) else None for k, v in values.items()}


def _short(label: str) -> str:
    """Drop the brackets of a label, whose content the headline has already."""
    return label.split(" (")[0]


def _plain(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s" if seconds >= 10 else f"{seconds:.2f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min {rest:02d} s" if hours else f"{minutes} min {rest:02d} s"


def _share(part: float, whole: float) -> str:
    return f"{100 * part / whole:.1f} %" if whole else "–"


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.2f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"
