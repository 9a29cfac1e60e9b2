"""The real server with a pretended pipeline: `python pretend_server.py DATA_DIR [RUNNER]`."""

import sys
from pathlib import Path

if __name__ == "__main__":
    from stillpath.service.environment import prepare_environment
    from stillpath.service.server import serve_forever
    from stillpath.service.settings import Settings
    from tests.service import runners

    prepare_environment()
    runner = getattr(runners, sys.argv[2] if len(sys.argv) > 2 else "pretend")
    serve_forever(Settings(data_dir=Path(sys.argv[1])), "127.0.0.1", 0, runner=runner)
