"""Settings and location of the user's machines, for the command line and the service."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["ENV_PREFIX", "MachineSettings", "user_data_dir"]

ENV_PREFIX = "STILLPATH_"


class MachineSettings(BaseModel):
    """Settings of the user's machines.

    Attributes
    ----------
    data_dir : Path, optional
        Machines lie in its folder `machines`; by default in the user's folder for data.
    database_url : str, optional
        Of a PostgreSQL database, in which machines lie instead.
    require_approval : bool
        Jobs use approved revisions of machines only.
    measurement_max_age_days : float
        An older measurement of a machine is warned of.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    data_dir: Path | None = None
    database_url: str | None = None
    require_approval: bool = False
    measurement_max_age_days: Annotated[float, Field(gt=0)] = 180.0

    @classmethod
    def from_environment(cls) -> Self:
        """Read ``STILLPATH_DATA_DIR`` and its like, in upper or lower case; empty ones are none.

        Plain, because the library for it costs every command a tenth of a second.
        """
        known = {ENV_PREFIX + field.upper(): field for field in cls.model_fields}
        given = {name.upper(): value for name, value in os.environ.items() if value}
        return cls.model_validate({known[n]: v for n, v in given.items() if n in known})


def user_data_dir(environment: Mapping[str, str] = os.environ) -> Path:
    """Return the folder where programs keep what a user owns, by the platform's convention."""
    if sys.platform == "win32":
        base = environment.get("LOCALAPPDATA")
        fallback = Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base, fallback = None, Path.home() / "Library" / "Application Support"
    else:
        base, fallback = environment.get("XDG_DATA_HOME"), Path.home() / ".local" / "share"
    return (Path(base) if base else fallback) / "stillpath"
