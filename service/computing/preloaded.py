"""What `service.computing.tasks` imports: loaded once, so that no computation begins with it."""

from __future__ import annotations

import gc

import service.controllers.design
import service.controllers.page
import service.design.design
import service.identification.run  # noqa: F401

gc.freeze()  # so that the copies' collectors leave alone what they share
