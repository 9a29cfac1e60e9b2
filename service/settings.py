"""Settings of the HTTP service, from the environment (`STILLPATH_*`) or from the caller."""

from __future__ import annotations

import ipaddress
import json
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BeforeValidator, Field, SecretStr, model_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from stillpath.applications.machines.settings import (
    ENV_PREFIX,
    MachineSettings,
    user_data_dir,
)

__all__ = ["Settings", "is_loopback"]

_SHORTEST_SECRET = 16


def _network(text: str) -> str:
    try:
        return str(ipaddress.ip_network(text, strict=False))
    except ValueError:
        raise ValueError(
            f"{text!r:.80} is not an address or network; write for instance 127.0.0.1 or 10.0.0.0/8"
        ) from None


def _listed(value: Any) -> Any:
    """Read a list as a variable holds it."""
    if not isinstance(value, str):
        return value
    if not value.lstrip().startswith("["):
        return [part.strip() for part in value.split(",") if part.strip()]
    try:
        return json.loads(value)
    except ValueError:
        raise ValueError('is no list; write for instance a,b or ["a", "b"]') from None


def _is_long(secret: SecretStr | None) -> SecretStr | None:
    if secret is not None and len(secret) < _SHORTEST_SECRET:
        raise ValueError(
            f"has {len(secret)} characters, which can be guessed; give {_SHORTEST_SECRET} or more"
        )
    return secret


Network = Annotated[str, AfterValidator(_network)]
# Without NoDecode, what is not JSON would be an error that names neither value nor remedy.
Hosts = Annotated[list[str], NoDecode, BeforeValidator(_listed)]
Networks = Annotated[list[Network], NoDecode, BeforeValidator(_listed)]


def _data_dir() -> Path:
    """Return the folder that the command line uses too, so that both see the same machines."""
    try:
        return user_data_dir()
    except RuntimeError:  # a user without a home, as services may be
        return Path("stillpath-data")


class Settings(MachineSettings, BaseSettings):
    """Settings of one process of the service. In a variable a list is JSON, or ``a,b``.

    An empty variable, as Compose and files of settings pass it on, counts as none.

    One computer needs none of the first three: SQLite, a folder, and worker processes of its own.
    With several, all three are elsewhere.

    Attributes
    ----------
    data_dir : Path
        Uploads on their way, and, unless they are elsewhere, database, results and machines. By
        default the user's folder for data, or `stillpath-data` here for a user without a home.
    database_url : str, optional
        For instance ``postgresql+psycopg://user@host/stillpath``; by default SQLite in `data_dir`.
    storage_url : str, optional
        For instance ``s3://bucket/prefix``; by default a folder in `data_dir`.
    scheduler : str, optional
        Address of a Dask scheduler, for instance ``tcp://host:8786``; by default the service runs
        workers of its own.
    workers : int
        Processes of its own that do jobs; each handles one at a time.
    max_attempts : int
        Number of times a job may lose its worker before it fails; stops of the service do not
        count.
    heartbeat_timeout_s : float
        A worker that has been silent for this long is lost.
    cancel_grace_s : float
        How long a worker may take to obey a cancel before its process is ended.
    max_job_s, max_job_bytes : float, int
        A job that takes longer, or whose process grows larger, fails.
    computing_processes : int
        Further processes, for short jobs (minutes, not hours): designs, identifications,
        controllers. With a scheduler: how many of its places are kept for these.
    max_computing_s, max_computing_bytes : float, int
        Such a job that takes longer, or whose process grows larger, fails.
    max_upload_bytes : int
        A larger upload is refused with status 413.
    disk_reserve_bytes : int
        Stays free on the disk of `data_dir`: uploads that would leave less are refused with status
        507, jobs wait for half of it. 0: no check.
    max_jobs_per_owner, max_bytes_per_owner : int
        Unfinished jobs, and bytes of all jobs kept, that one owner may have.
    requests_per_minute : int
        Of one key, or of one address without a key; reading progress does not count.
    keep_days : float
        Finished jobs are deleted after this many days.
    keys : bool, optional
        Whether callers must show a key. By default they must unless the service is bound to
        loopback.
    first_key : str, optional
        Made a key with all scopes at the first start, instead of a random one in the file
        ``first-key`` of `data_dir`.
    allowed_hosts : list of str
        Names in the Host header that are answered besides those of this computer; ``*`` for all.
    trusted_proxies : list of str
        Addresses or networks of proxies whose ``X-Forwarded-For``, ``-Host`` and ``-Proto`` count.
    printers : Path, optional
        TOML file of printers that results can be forwarded to.
    webhook_targets : list of str
        ``host`` or ``host:port`` that webhooks may be sent to, by https; ``http://host:port`` for
        plain http.
    webhook_secret : str, optional
        Signs webhooks (HMAC-SHA256), with at least 16 characters; without it there are none.
    """

    model_config = SettingsConfigDict(
        env_prefix=ENV_PREFIX, env_ignore_empty=True, extra="forbid", frozen=True
    )

    data_dir: Annotated[Path, Field(default_factory=_data_dir)]
    database_url: str | None = None
    storage_url: str | None = None
    scheduler: str | None = None
    workers: Annotated[int, Field(ge=1, le=64)] = 1
    max_attempts: Annotated[int, Field(ge=1, le=10)] = 2
    heartbeat_timeout_s: Annotated[float, Field(ge=2)] = 15.0
    cancel_grace_s: Annotated[float, Field(gt=0)] = 10.0
    max_job_s: Annotated[float, Field(gt=0)] = 4 * 3600.0
    max_job_bytes: Annotated[int, Field(gt=0)] = 4 << 30
    computing_processes: Annotated[int, Field(ge=1, le=64)] = 1
    max_computing_s: Annotated[float, Field(gt=0)] = 300.0
    max_computing_bytes: Annotated[int, Field(ge=64 << 20)] = 1 << 30
    max_upload_bytes: Annotated[int, Field(gt=0)] = 1 << 30
    disk_reserve_bytes: Annotated[int, Field(ge=0)] = 512 << 20
    max_jobs_per_owner: Annotated[int, Field(ge=1)] = 1000
    max_bytes_per_owner: Annotated[int, Field(gt=0)] = 100 << 30
    requests_per_minute: Annotated[int, Field(ge=1)] = 1200
    keep_days: Annotated[float, Field(gt=0)] = 30.0
    keys: bool | None = None
    first_key: SecretStr | None = None
    allowed_hosts: Hosts = []
    trusted_proxies: Networks = []
    printers: Path | None = None
    webhook_targets: Hosts = []
    webhook_secret: Annotated[SecretStr | None, AfterValidator(_is_long)] = None

    @model_validator(mode="after")
    def _together(self) -> Self:
        """Refuse workers elsewhere that could not reach what lies here."""
        if self.scheduler is not None:
            here = [
                f"{ENV_PREFIX}{name} is {url or 'not set'} ({instead})"
                for name, url, instead in (
                    ("DATABASE_URL", self.database_url, "postgresql://..."),
                    ("STORAGE_URL", self.storage_url, "s3://bucket/prefix"),
                )
                if url is None or url.startswith(("sqlite", "file"))
            ]
            if here:
                raise ValueError(
                    f"workers of the scheduler {self.scheduler} cannot reach this computer's "
                    f"files, so set what lies elsewhere: {', '.join(here)}"
                )
        return self


def is_loopback(host: str) -> bool:
    """Return whether a server bound to `host` can be reached from this computer only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
