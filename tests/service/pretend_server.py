"""The real server with a pretended road: `python pretend_server.py DATA_DIR`."""

import sys
from pathlib import Path

if __name__ == "__main__":
    from unittest import mock

    from service import server
    from service.api import create_app
    from service.settings import Settings
    from tests.service.runners import pretend

    def application(settings: Settings):
        return create_app(settings, runner=pretend)

    with mock.patch.object(server, "create_app", application):
        server.serve_forever(Settings(data_dir=Path(sys.argv[1])), "127.0.0.1", 0)
