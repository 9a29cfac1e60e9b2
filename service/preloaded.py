"""Importing this module loads all that a process needs to compensate (`service.processes`)."""

from __future__ import annotations

import gc
import signal

from stillpath.service.environment import prepare_environment

# Ctrl-C goes to the whole terminal group; the first process ends the others itself.
signal.signal(signal.SIGINT, signal.SIG_IGN)
prepare_environment()  # before numpy and numba

import stillpath.pipeline.compensate  # noqa: E402
import stillpath.reports  # noqa: E402, F401

gc.freeze()  # keeps the garbage collectors of forks from touching shared memory
