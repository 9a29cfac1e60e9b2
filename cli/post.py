"""The work of `integrations/slicers/stillpath_post.py` on this computer; heavy imports wait."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

__all__ = ["Refused", "compensate_in_place"]


class Refused(Exception):
    """It cannot be done as it was put: bad file, machine or option."""


def compensate_in_place(
    path: Path,
    options: Mapping[str, Any],
    *,
    name: str,
    tell: Callable[[str, float | None], object],
) -> Callable[[], str]:
    """Compensate a sliced file in place and return what makes the page of its report.

    Parameters
    ----------
    path : Path
        Replaced when the new file is complete, else left as it was.
    options : mapping
        `machine`, a name or the path of a document, and fields of `pipeline.options.Options`.
    name : str
        What the report calls the file; slicers hand over temporary ones.
    tell : callable
        Is given the stage and the share that is done; may raise to stop the work.

    Raises
    ------
    Refused
    """
    from stillpath.service.environment import prepare_environment

    prepare_environment()

    from pydantic import ValidationError

    from stillpath.cli.own_machines import open_machines
    from stillpath.cli.wrong_options import wrong_option
    from stillpath.compensation.base import DesignError
    from stillpath.gcode.errors import GcodeError
    from stillpath.models.errors import ModelError
    from stillpath.pipeline.options import Options
    from stillpath.pipeline.progress import Progress
    from stillpath.reports import render_report

    def report(progress: Progress) -> None:
        tell(progress.stage, progress.fraction)

    try:
        found = open_machines().for_job(options["machine"], files=True)
        chosen = Options(**{key: options[key] for key in options if key != "machine"})

        from stillpath.pipeline.compensate import compensate_file
        from stillpath.service.compiling import compiling_reported

        tell("starting", None)
        with compiling_reported(report) as progress:
            result = compensate_file(path, path, found.machine, chosen, progress=progress)
    except ValidationError as error:
        raise Refused(wrong_option(error)) from None
    except (GcodeError, ModelError, DesignError) as error:
        raise Refused(str(error)) from error
    result.warnings.extend(found.warnings)
    named = result.model_copy(update={"source_name": name})
    return lambda: render_report(named)
