"""The real server, to be asked thousands of things: `python fuzzed_server.py DATA_DIR`.

Jobs are pretended, and one real design, which takes seconds of computing, is the answer to every
question for one.
"""

import sys
from pathlib import Path
from unittest import mock

if __name__ == "__main__":
    from stillpath.service.environment import prepare_environment

    prepare_environment()

    from stillpath.applications.design.design import design_report
    from stillpath.models.store import load_machine
    from stillpath.service.api import designs
    from stillpath.service.server import serve_forever
    from stillpath.service.settings import Settings
    from tests.service.runners import light

    design = design_report(load_machine("ender3"), "x").model_dump(mode="json")
    with (
        mock.patch.object(designs, "run_and_wait", mock.AsyncMock(return_value=None)),
        mock.patch.object(designs, "read_result", mock.AsyncMock(return_value=design)),
    ):
        serve_forever(Settings(data_dir=Path(sys.argv[1])), "127.0.0.1", 0, runner=light)
