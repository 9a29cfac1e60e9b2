"""Imports of `service.jobs.computations`, loaded once so that no computation begins with them."""

from __future__ import annotations

import gc

import stillpath.applications.controllers.design
import stillpath.applications.controllers.page
import stillpath.applications.design.design
import stillpath.applications.identification.run  # noqa: F401

gc.freeze()  # so that the copies' collectors leave alone what they share
