"""Settings of the HTTP service, from the environment (`STILLPATH_*`) or from the caller."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Annotated

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

__all__ = ["MachineSettings", "Settings", "is_loopback"]


class MachineSettings(BaseSettings):
    """Settings of the user's machines, for the command line and the service.

    Attributes
    ----------
    data_dir : Path, optional
        Machines lie in its folder `machines`; by default in the user's folder for data.
    require_approval : bool
        Jobs use approved revisions of machines only.
    measurement_max_age_days : float
        An older measurement of a machine is warned of.
    """

    model_config = SettingsConfigDict(env_prefix="STILLPATH_", extra="forbid", frozen=True)

    data_dir: Path | None = None
    require_approval: bool = False
    measurement_max_age_days: Annotated[float, Field(gt=0)] = 180.0


class Settings(MachineSettings):
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
