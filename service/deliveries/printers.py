"""Printers that results are uploaded to: their file, and how Moonraker and OctoPrint want it."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, SecretStr, ValidationError, field_validator

from stillpath.models.complaints import complaint
from stillpath.models.document import Document
from stillpath.pipeline.options import BudgetUm, MethodName
from stillpath.service.deliveries.http_requests import Reply, Unanswered, post
from stillpath.service.deliveries.targets import TargetRefused, read_url

__all__ = ["Printer", "PrinterFileError", "load_printers", "printer_for", "upload", "what_started"]

# A small computer reads a large file through before it answers.
_TIMEOUT_S = 300.0


class PrinterFileError(ValueError):
    """The file of printers cannot be used."""


class Printer(Document):
    """A section ``[printer.NAME]`` of the file.

    Attributes
    ----------
    name : str
    kind : str
        Which words it understands.
    url : str
        Where its Moonraker or OctoPrint is.
    api_key : str, optional
        That it asks for.
    machine : str
        Of the model that files for this printer are made with.
    method, tolerance_um, budget_um : optional
        Likewise, where the upload does not say.
    start : bool
        Whether an upload may start a print. By default somebody must look at the printer first.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
    kind: Literal["moonraker", "octoprint"]
    url: str
    api_key: SecretStr | None = None
    machine: Annotated[str, Field(min_length=1, max_length=255)]
    method: MethodName | None = None
    tolerance_um: Annotated[float, Field(ge=0.5, le=50, allow_inf_nan=False)] | None = None
    budget_um: BudgetUm | None = None
    start: bool = False

    @field_validator("url")
    @classmethod
    def _plain(cls, url: str) -> str:
        target = read_url(url)
        if "?" in target.path:
            raise ValueError("the address has a query (?...); give it without")
        return url.rstrip("/")


def load_printers(path: Path | None) -> dict[str, Printer]:
    """Return the printers of a file by name; none without a file.

    Raises
    ------
    PrinterFileError
    """
    if path is None:
        return {}
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise PrinterFileError(f"{path} (STILLPATH_PRINTERS) cannot be read: {error}") from error
    sections = content.pop("printer", {})
    if content or not isinstance(sections, dict):
        raise PrinterFileError(f"{path}: there may be sections [printer.NAME] only")
    return {name: _printer(path, name, section) for name, section in sections.items()}


def printer_for(printers: Mapping[str, Printer], name: str, *, start: bool = False) -> Printer:
    """Return a printer that a job asks for.

    Raises
    ------
    TargetRefused
        If there is none of that name, or it must not be started and `start` asks for that.
    """
    printer = printers.get(name)
    if printer is None:
        known = ", ".join(sorted(printers)) or "none"
        raise TargetRefused(f"no printer is called {name[:64]!r}; known: {known}")
    if start and not printer.start:
        raise TargetRefused(
            f"prints on {name} are not started from here; start it at the printer, or set "
            f"start = true in [printer.{name}]"
        )
    return printer


def upload(
    printer: Printer, file: Path, name: str, *, sha256: str | None, start: bool = False
) -> Reply:
    """Upload a file to a printer, streaming.

    Parameters
    ----------
    name : str
        What the printer shall call it; one there of the same name is replaced.
    sha256 : str, optional
        Of the file; Moonraker checks it.
    start : bool
        Whether the printer shall print it now.

    Raises
    ------
    TargetRefused, Unreached, Unanswered
        See `service.deliveries.http_requests.post`.
    """
    fields = {"print": "true" if start else "false"}
    if printer.kind == "moonraker":
        path = "/server/files/upload"
        fields["root"] = "gcodes"
        if sha256 is not None:
            fields["checksum"] = sha256
    else:
        path = "/api/files/local"
        fields["select"] = fields["print"]
    headers = {}
    if printer.api_key is not None:
        headers["X-Api-Key"] = printer.api_key.get_secret_value()
    target = read_url(printer.url + path)
    with file.open("rb") as stream:
        reply = post(
            target,
            headers=headers,
            fields=fields,
            file=(name, stream),
            loopback=True,  # whoever wrote the file of printers meant it
            timeout_s=_TIMEOUT_S,
        )
    if 200 <= reply.status < 300 and not reply.text.lstrip().startswith("{"):
        # A page: of a proxy, or of whatever else listens there. Nothing was uploaded, perhaps.
        raise Unanswered(
            f"{target} answers with status {reply.status}, but not as {printer.kind} does; check "
            f"url in [printer.{printer.name}]"
        )
    return reply


def what_started(printer: Printer, reply: Reply) -> str | None:
    """Return why a printer that was asked to print did not begin, as far as it says so."""
    try:
        told: Any = json.loads(reply.text)
    except ValueError:
        return None
    if not isinstance(told, dict):
        return None
    # Of a file that is no .gcode Moonraker starts none and says nothing; old OctoPrints never do.
    # Moonraker answers in its own words also where it is sent to as an OctoPrint
    # (components/octoprint_compat.py, application.py; 0.11).
    silent_means = printer.kind != "moonraker"
    if told.get("print_started", told.get("effectivePrint", silent_means)) is True:
        return None
    if told.get("print_queued"):
        return "uploaded; the printer put it into its queue"
    return "uploaded, but the printer did not begin to print; it may be busy or not ready"


def _printer(path: Path, name: str, section: Any) -> Printer:
    if not isinstance(section, dict):
        raise PrinterFileError(f"{path}: printer.{name} is not a section")
    try:
        return Printer(**{**section, "name": name})
    except ValidationError as error:
        # Without what was given: it may be the key.
        first = error.errors(include_input=False, include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        said = complaint(first, repeat=False)
        raise PrinterFileError(f"{path}: [printer.{name}] {place}: {said}") from None
    except TypeError as error:
        raise PrinterFileError(f"{path}: [printer.{name}]: {error}") from None
