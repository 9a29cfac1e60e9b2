"""The real server, to be asked thousands of things: `python fuzzed_server.py DATA_DIR`.

Jobs are pretended. One real design and one real filter for live printing, which take seconds of
computing, are the answers to every question for one.
"""

import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

if __name__ == "__main__":
    from stillpath.service.environment import prepare_environment

    prepare_environment()

    from stillpath.applications.design.design import design_report
    from stillpath.applications.live.export import write_export
    from stillpath.models.store import load_machine
    from stillpath.service.api import designs, live
    from stillpath.service.server import serve_forever
    from stillpath.service.settings import Settings
    from tests.service.runners import light, load_little

    load_little()
    machine = load_machine("ender3")
    with tempfile.TemporaryDirectory() as folder:
        export = write_export(machine, Path(folder) / "stillpath.json")
    # Less of it than a user is shown: its form is the same.
    less = {"errors_percent": (0.0,), "shapers": ("zv",)}
    design = design_report(machine, "x", **less).model_dump(mode="json")
    with ExitStack() as stack:
        for route, answer in ((designs, design), (live, export)):
            for name, returned in (("run_and_wait", None), ("read_result", answer)):
                pretended = mock.AsyncMock(return_value=returned)
                stack.enter_context(mock.patch.object(route, name, pretended))
        serve_forever(Settings(data_dir=Path(sys.argv[1])), "127.0.0.1", 0, runner=light)
