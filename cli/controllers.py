"""Commands of closed-loop machines. Heavy imports wait until a command needs them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stillpath.cli.arguments import CommandRefused, check_folder, check_output

if TYPE_CHECKING:
    from stillpath.applications.controllers.design import Designed
    from stillpath.applications.controllers.options import ControllerOptions

__all__ = ["controller", "loops"]

MachineOption = Annotated[
    str | None,
    typer.Option("--machine", "-m", help="A name of `stillpath loops`, or a JSON file's path."),
]
SettingsFile = Annotated[
    Path | None,
    typer.Option(
        "--options",
        metavar="FILE",
        exists=True,
        dir_okay=False,
        help="Settings as a JSON document (docs/controllers.md); other options override it.",
    ),
]
_MANY = "Hz, separated by commas."
_NO_BAND_PASS = "none"


@dataclass(frozen=True, slots=True)
class SettingOptions:
    """Settings of a controller: fields of `ControllerOptions`."""

    method: Annotated[
        str | None,
        typer.Option(
            help="fmsdob, fmsdob-adaptive, inverse-dob, dob, mmp, rc-wide, rc-quasi or "
            "rc-multirate."
        ),
    ] = None
    targets_hz: Annotated[str | None, typer.Option(help=f"Tones: {_MANY}")] = None
    bandwidth_hz: Annotated[
        str | None,
        typer.Option(help="Width of the notches. fmsdob, mmp: or one each. fmsdob: or none."),
    ] = None
    shape: Annotated[str | None, typer.Option(help="pointwise or hermite.")] = None
    detuning: Annotated[float | None, typer.Option(help="Notches end at 1 - detuning.")] = None
    tones: Annotated[int | None, typer.Option(help="fmsdob-adaptive: how many.")] = None
    cutoff_hz: Annotated[float | None, typer.Option(help="dob: cutoff of its filter.")] = None
    nominal: Annotated[str | None, typer.Option(help="dob: machine whose plant it takes.")] = None
    fundamental_hz: Annotated[
        float | None,
        typer.Option("--fundamental-hz", "--period-hz", help="rc: fundamental of the error."),
    ] = None
    nyquist_pairs: Annotated[int | None, typer.Option(help="rc: zero pairs of the filter.")] = None
    notches_hz: Annotated[str | None, typer.Option(help=f"rc: left alone. {_MANY}")] = None
    fast: Annotated[
        str | None, typer.Option(help="rc-multirate: the machine, identified at the fast rate.")
    ] = None
    alpha: Annotated[float | None, typer.Option(help="mmp, rc: pole radius.")] = None
    uncertainty: Annotated[
        float | None, typer.Option(help="Relative plant error to survive at every frequency.")
    ] = None
    duration_s: Annotated[float | None, typer.Option(help="Length of the time response.")] = None

    def given(self) -> dict[str, Any]:
        """Return the settings that were given, numbers and machines read."""
        given = asdict(self) | {
            "targets_hz": _numbers("--targets-hz", self.targets_hz),
            "bandwidth_hz": _widths(self.bandwidth_hz),
            "nominal": _reference(self.nominal),
            "notches_hz": _numbers("--notches-hz", self.notches_hz),
            "fast": _reference(self.fast),
        }
        chosen = {name: value for name, value in given.items() if value is not None}
        return chosen | ({"bandwidth_hz": None} if self.bandwidth_hz == _NO_BAND_PASS else {})


@dataclass(frozen=True, slots=True)
class OutputOptions:
    """What is written of a controller."""

    report: Annotated[
        Path | None,
        typer.Option("--report", metavar="DIR", help="For controller.html, .json and .h."),
    ] = None
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Coefficients, to be loaded.")
    ] = None
    c_header: Annotated[
        Path | None, typer.Option("--c-header", metavar="FILE", help="The same as C.")
    ] = None

    def check(self, *inputs: Path | str | None) -> None:
        """Refuse what cannot be written, before anything is computed."""
        files = [file for file in (self.json_file, self.c_header) if file is not None]
        if len({check_output(file, *inputs) for file in files}) < len(files):
            raise CommandRefused(f"--json and --c-header are both {files[0]}; name two files")
        check_folder(self.report)

    def write(self, made: Designed) -> None:
        """Write what was asked for."""
        from stillpath.applications.controllers.page import write_controller
        from stillpath.reports.pages import write_texts

        if self.report is not None:
            write_controller(made, self.report)
        if self.json_file is not None:
            text = json.dumps(made.report.controller, indent=2) + "\n"
            write_texts(self.json_file.parent, {self.json_file.name: text})
        if self.c_header is not None:
            write_texts(self.c_header.parent, {self.c_header.name: made.controller.to_c_header()})


def controller(
    machine: MachineOption = None,
    *,
    options: SettingsFile = None,
    settings: SettingOptions,
    output: OutputOptions,
    show_list: Annotated[bool, typer.Option("--list", help="As `stillpath loops`.")] = False,
) -> None:
    """Design an add-on controller for a closed-loop machine."""
    if show_list:
        loops()
        return
    if machine is None:
        raise typer.BadParameter("--machine is missing; `stillpath loops` lists what there is")
    output.check(options, machine, settings.nominal, settings.fast)
    chosen = _options(options, settings.given())

    from stillpath.applications.controllers.design import design_controller
    from stillpath.cli.controller_tables import print_controller
    from stillpath.models.loops import load_loop

    made = design_controller(chosen.loop or load_loop(machine), chosen)
    output.write(made)
    print_controller(made.report)


def loops() -> None:
    """List the closed-loop machines and the methods that fit each."""
    from stillpath.applications.controllers.design import loop_figures
    from stillpath.cli.controller_tables import print_loops

    print_loops(loop_figures())


def _options(file: Path | None, given: dict[str, Any]) -> ControllerOptions:
    from stillpath.applications.controllers.options import METHODS, read_options

    document: Any = {}
    if file is not None:
        try:
            document = json.loads(file.read_bytes())
        except ValueError as error:
            raise typer.BadParameter(f"{file}: not JSON ({error})") from None
        if not isinstance(document, dict):
            raise typer.BadParameter(f"{file}: a JSON object of settings is needed")
    document |= given
    if "method" not in document:
        raise typer.BadParameter(f"--method is missing; there are {', '.join(METHODS)}")
    return read_options(document)


def _numbers(option: str, text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise typer.BadParameter(f"{option} {text}: numbers are needed, as in 500,1200") from None


def _widths(text: str | None) -> list[float] | float | None:
    if text == _NO_BAND_PASS:
        return None
    widths = _numbers("--bandwidth-hz", text)
    return widths[0] if widths is not None and len(widths) == 1 else widths


def _reference(name: str | None) -> object:
    """Return a machine that an option names: a file is read here, options hold no paths."""
    if name is None:
        return None
    from stillpath.models.loops import load_loop

    return load_loop(name)
