"""A printer's state from Moonraker: configuration, limits in force, commands.

Moonraker's docs/external_api/printer.md (`GET /printer/info`, `GET /printer/objects/query`) and
server.md (`GET /server/info`), OctoPrint's docs/api/version.rst (`GET /api/version`) and
Klipper's docs/Status_Reference.md (`configfile`, `toolhead`, `gcode`, `extruder`, `print_stats`),
2026-07.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from stillpath.applications.machines.klipper_config import Option, PrinterConfig
from stillpath.service.deliveries.http_requests import Reply, Unanswered, Unreached, get
from stillpath.service.deliveries.printers import Printer
from stillpath.service.deliveries.targets import TargetRefused, read_url

__all__ = ["NotReady", "PrinterState", "ask", "kind_there"]

_LONGEST_BYTES = 8 << 20
_TIMEOUT_S = 5.0
_TELLTALES: tuple[tuple[Literal["moonraker", "octoprint"], str, str], ...] = (
    ("moonraker", "/server/info", '"klippy_connected"'),
    ("octoprint", "/api/version", '"OctoPrint'),
)
"""Kind, where it answers, and what is in its answer. Moonraker may answer as OctoPrint, too."""
_OBJECTS = (
    "configfile=settings,config&toolhead=max_velocity,max_accel,square_corner_velocity,"
    "minimum_cruise_ratio&gcode=commands&extruder=pressure_advance&print_stats=state"
)


class NotReady(Exception):
    """Moonraker answers, but Klipper cannot be asked: it starts, has stopped, or is away."""


@dataclass(frozen=True, slots=True)
class PrinterState:
    """A printer as it is now.

    Attributes
    ----------
    software : str
        Klipper's version.
    settings : dict
        Sections of printer.cfg with everything it includes, Klipper's defaults filled in; section
        names in lower case.
    sections : tuple of str
        Names of all sections as they are written.
    limits : dict
        `max_velocity`, `max_accel`, `square_corner_velocity` and, since 2024-03,
        `minimum_cruise_ratio`, in force now.
    commands : dict, optional
        Known commands and their help; None: this Klipper does not tell (before 2023-12).
    pressure_advance_s : float, optional
        In force now.
    prints : bool
        Whether a print is under way, paused ones included.
    """

    software: str
    settings: Mapping[str, Mapping[str, Any]]
    sections: tuple[str, ...]
    limits: Mapping[str, float]
    commands: Mapping[str, str] | None
    pressure_advance_s: float | None
    prints: bool

    def config(self) -> PrinterConfig:
        """Return the settings as if they had been read from one file."""
        sections = {
            name: {
                option: Option(str(value), 0)
                for option, value in options.items()
                if isinstance(value, str | int | float)
            }
            for name, options in self.settings.items()
        }
        return PrinterConfig("printer.cfg", sections)


def ask(printer: Printer) -> PrinterState:
    """Ask a printer's Moonraker.

    Raises
    ------
    NotReady
    service.deliveries.http_requests.Unreached, service.deliveries.http_requests.Unanswered
    service.deliveries.targets.TargetRefused
    """
    info = _result(printer, "/printer/info")
    state = info.get("state")
    if state != "ready":
        told = " ".join(str(info.get("state_message", "")).split())[:300]
        raise NotReady(f"Klipper is not ready ({state or 'no state'}): {told}")
    status = _part(_result(printer, f"/printer/objects/query?{_OBJECTS}"), "status")
    config, gcode = _part(status, "configfile"), _part(status, "gcode")
    settings = {
        str(name): options
        for name, options in _part(config, "settings").items()
        if isinstance(options, dict)
    }
    if "printer" not in settings:
        raise Unanswered("Moonraker does not tell printer.cfg: its answer has no [printer]")
    commands = gcode.get("commands")
    return PrinterState(
        software=str(info.get("software_version", "")),
        settings=settings,
        sections=tuple(map(str, _part(config, "config"))),
        limits=_numbers(_part(status, "toolhead")),
        commands=_helps(commands) if isinstance(commands, dict) else None,
        pressure_advance_s=_numbers(_part(status, "extruder")).get("pressure_advance"),
        prints=_part(status, "print_stats").get("state") in ("printing", "paused"),
    )


def kind_there(printer: Printer) -> Literal["moonraker", "octoprint"] | None:
    """Return of which kind the software at a printer's address says it is; None: it does not."""
    for kind, path, word in _TELLTALES:
        with contextlib.suppress(Unreached, Unanswered, TargetRefused):
            reply = _get(printer, path)
            if reply.status == 200 and reply.text.startswith("{") and word in reply.text:
                return kind
    return None


def _get(printer: Printer, path: str) -> Reply:
    headers = {}
    if printer.api_key is not None:
        headers["X-Api-Key"] = printer.api_key.get_secret_value()
    return get(
        read_url(printer.url + path),
        headers=headers,
        longest_bytes=_LONGEST_BYTES,
        loopback=True,  # as for uploads
        timeout_s=_TIMEOUT_S,
    )


def _result(printer: Printer, path: str) -> dict[str, Any]:
    reply = _get(printer, path)
    try:
        told = json.loads(reply.text)
    except (ValueError, RecursionError):
        told = None
    if reply.status == 503:
        raise NotReady(f"Klipper is away: {_reason(told) or 'Moonraker answers 503'}")
    if reply.status == 404:  # Klipper brings these places along when it connects
        raise NotReady("Klipper is not connected, or there is no Moonraker (404 Not Found)")
    result = told.get("result") if isinstance(told, dict) else None
    if reply.status != 200 or not isinstance(result, dict):
        raise Unanswered(
            f"{path.partition('?')[0]} is answered with status {reply.status}, not as Moonraker "
            f"does{_reason(told, ': ')}"
        )
    return result


def _reason(told: Any, before: str = "") -> str:
    error = told.get("error") if isinstance(told, dict) else None
    message = error.get("message") if isinstance(error, dict) else None
    return before + " ".join(str(message).split())[:300] if message else ""


def _part(document: Mapping[str, Any], name: str) -> dict[str, Any]:
    found = document.get(name)
    return found if isinstance(found, dict) else {}


def _numbers(part: Mapping[str, Any]) -> dict[str, float]:
    return {
        name: float(value)
        for name, value in part.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }


def _helps(commands: Mapping[str, Any]) -> dict[str, str]:
    return {
        str(name): str(told.get("help", "")) if isinstance(told, dict) else ""
        for name, told in commands.items()
    }
