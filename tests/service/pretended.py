"""What processes that only pretend to compute need, loaded when this module is imported."""

from __future__ import annotations

import gc
import signal

from stillpath.service.environment import prepare_environment

# As `service.preloaded` does, but without the pipeline: most tests take less time than to load it.
signal.signal(signal.SIGINT, signal.SIG_IGN)
prepare_environment()

import tests.service.synthetic  # noqa: E402, F401

gc.freeze()
