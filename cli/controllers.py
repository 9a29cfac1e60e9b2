"""Commands of closed-loop machines. Heavy imports wait until a command needs them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stillpath.cli.arguments import check_folder, check_output

if TYPE_CHECKING:
    from stillpath.applications.controllers.options import ControllerOptions

__all__ = ["register"]

Method = Annotated[
    str | None,
    typer.Option(
        help="fmsdob, fmsdob-adaptive, inverse-dob, dob, mmp, rc-wide, rc-quasi or rc-multirate."
    ),
]
MachineOption = Annotated[
    str | None,
    typer.Option("--machine", "-m", help="A name of `stillpath loops`, or a JSON file's path."),
]
Settings = Annotated[
    Path | None,
    typer.Option(
        "--options",
        metavar="FILE",
        exists=True,
        dir_okay=False,
        help="Settings as a JSON document (docs/controllers.md); options given here go before.",
    ),
]
Many = "Hz, separated by commas."


def register(app: typer.Typer) -> None:
    """Add controller and loops to a command line."""
    for command in (controller, loops):
        app.command()(command)


def controller(
    machine: MachineOption = None,
    method: Method = None,
    options: Settings = None,
    targets_hz: Annotated[str | None, typer.Option(help=f"Tones: {Many}")] = None,
    bandwidth_hz: Annotated[float | None, typer.Option(help="Width of each notch.")] = None,
    shape: Annotated[str | None, typer.Option(help="pointwise or hermite.")] = None,
    detuning: Annotated[float | None, typer.Option(help="Notches end at 1 - detuning.")] = None,
    tones: Annotated[int | None, typer.Option(help="fmsdob-adaptive: how many.")] = None,
    cutoff_hz: Annotated[float | None, typer.Option(help="dob: of its filter.")] = None,
    nominal: Annotated[str | None, typer.Option(help="dob: machine whose plant it takes.")] = None,
    fundamental_hz: Annotated[
        float | None, typer.Option("--fundamental-hz", "--period-hz", help="rc: of the error.")
    ] = None,
    nyquist_pairs: Annotated[int | None, typer.Option(help="rc: zero pairs of the filter.")] = None,
    notches_hz: Annotated[str | None, typer.Option(help=f"rc: left alone. {Many}")] = None,
    fast: Annotated[
        str | None, typer.Option(help="rc-multirate: the machine, identified at the fast rate.")
    ] = None,
    alpha: Annotated[float | None, typer.Option(help="mmp, rc: pole radius.")] = None,
    uncertainty: Annotated[
        float | None, typer.Option(help="Relative plant error to survive at every frequency.")
    ] = None,
    duration_s: Annotated[float | None, typer.Option(help="Of the time response.")] = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", metavar="DIR", help="For controller.html, .json and .h."),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Coefficients, to be loaded.")
    ] = None,
    c_header: Annotated[
        Path | None, typer.Option("--c-header", metavar="FILE", help="The same as C.")
    ] = None,
    show_list: Annotated[bool, typer.Option("--list", help="As `stillpath loops`.")] = False,
) -> None:
    """Design an add-on controller for a closed-loop machine."""
    if show_list:
        loops()
        return
    if machine is None:
        raise typer.BadParameter("--machine is missing; `stillpath loops` lists what there is")
    given: dict[str, Any] = {
        "method": method,
        "targets_hz": _numbers("--targets-hz", targets_hz),
        "bandwidth_hz": bandwidth_hz,
        "shape": shape,
        "detuning": detuning,
        "tones": tones,
        "cutoff_hz": cutoff_hz,
        "nominal": _reference(nominal),
        "fundamental_hz": fundamental_hz,
        "nyquist_pairs": nyquist_pairs,
        "notches_hz": _numbers("--notches-hz", notches_hz),
        "fast": _reference(fast),
        "alpha": alpha,
        "uncertainty": uncertainty,
        "duration_s": duration_s,
    }
    chosen = _options(options, {key: value for key, value in given.items() if value is not None})
    for file in (json_file, c_header):
        if file is not None:
            check_output(file)
    check_folder(report)

    from stillpath.applications.controllers.design import design_controller
    from stillpath.applications.controllers.page import write_controller
    from stillpath.cli.controller_tables import print_controller
    from stillpath.models.loops import load_loop
    from stillpath.reports.pages import write_texts

    made = design_controller(chosen.loop or load_loop(machine), chosen)
    if report is not None:
        write_controller(made, report)
    if json_file is not None:
        text = json.dumps(made.report.controller, indent=2) + "\n"
        write_texts(json_file.parent, {json_file.name: text})
    if c_header is not None:
        write_texts(c_header.parent, {c_header.name: made.controller.to_c_header()})
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
        raise typer.BadParameter(f"--method is missing; there is {', '.join(METHODS)}")
    return read_options(document)


def _numbers(option: str, text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise typer.BadParameter(f"{option} {text}: numbers are needed, as in 500,1200") from None


def _reference(name: str | None) -> object:
    """Return a machine that an option names: a file is read here, options hold no paths."""
    if name is None:
        return None
    from stillpath.models.loops import load_loop

    return load_loop(name)
