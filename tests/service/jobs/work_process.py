"""What an API process does besides answering: `python work_process.py RUNNER`."""

import signal
import sys
import threading

if __name__ == "__main__":
    from stillpath.service.database.engine import open_database
    from stillpath.service.environment import prepare_environment
    from stillpath.service.jobs.store import JobStore
    from stillpath.service.jobs.workforce import Workforce
    from stillpath.service.logs import configure_logging
    from stillpath.service.settings import Settings
    from stillpath.service.storage.factory import open_storage
    from tests.service import runners

    prepare_environment()
    runners.load_little()
    configure_logging()
    settings = Settings()
    engine = open_database(settings)
    work = Workforce(
        settings, JobStore(engine), open_storage(settings), getattr(runners, sys.argv[1])
    )
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    work.start()
    print("working", flush=True)
    # In turns: a signal that another thread receives does not wake one that waits without end.
    while not ended.wait(1.0):
        pass
    work.stop()
    engine.dispose()
