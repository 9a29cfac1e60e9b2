"""The real server with a pretended pipeline: `python pretend_server.py DATA_DIR [RUNNER]`.

It is less patient than the real one, so that tests of what it waits for take less time.
"""

import sys
from pathlib import Path

if __name__ == "__main__":
    from stillpath.service.api.body_timeout import BodyTimeout
    from stillpath.service.environment import prepare_environment
    from stillpath.service.jobs import room
    from stillpath.service.server import serve_forever
    from stillpath.service.settings import Settings
    from tests.service import runners

    prepare_environment()
    runners.load_little()
    room._NO_ROOM_S = 3.0
    BodyTimeout.__init__.__kwdefaults__["quiet_s"] = 12.0
    runner = getattr(runners, sys.argv[2] if len(sys.argv) > 2 else "pretend")
    serve_forever(Settings(data_dir=Path(sys.argv[1])), "127.0.0.1", 0, runner=runner)
