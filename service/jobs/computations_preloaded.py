"""Imports of `service.jobs.computations`, loaded once for all forked workers."""

from __future__ import annotations

import gc

import stillpath.applications.controllers.design
import stillpath.applications.controllers.page
import stillpath.applications.design.design
import stillpath.applications.identification.run  # noqa: F401

gc.freeze()  # keeps the garbage collectors of forks from touching shared memory
