"""Settings of the HTTP service, from the environment (`STILLPATH_*`) or from the caller."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Annotated

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

from service.machines.settings import ENV_PREFIX, MachineSettings

__all__ = ["Settings", "is_loopback"]


class Settings(MachineSettings, BaseSettings):
    """Settings of one service.

    Attributes
    ----------
    data_dir : Path
        Database, uploads, results and machines; made on first use.
    max_upload_bytes : int
        A larger upload is refused with status 413.
    workers : int
        Worker processes; each handles one job at a time.
    max_attempts : int
        How often a job may be started before a dying worker fails it.
    cancel_grace_s : float
        How long a worker may take to obey a cancel before its process is ended.
    allow_remote : bool
        Serve other computers than this one. There are no keys yet: only behind something that
        checks who is calling.
    """

    model_config = SettingsConfigDict(env_prefix=ENV_PREFIX, extra="forbid", frozen=True)

    data_dir: Path = Path("stillpath-data")
    max_upload_bytes: Annotated[int, Field(gt=0)] = 1 << 30
    workers: Annotated[int, Field(ge=1, le=64)] = 1
    max_attempts: Annotated[int, Field(ge=1, le=10)] = 2
    cancel_grace_s: Annotated[float, Field(gt=0)] = 10.0
    allow_remote: bool = False


def is_loopback(host: str) -> bool:
    """Return whether a server bound to `host` can be reached from this computer only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
