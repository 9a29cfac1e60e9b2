"""Opens the machines of this user, names and tells who changes them. Heavy imports wait."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from stillpath.models.errors import ModelError

if TYPE_CHECKING:
    from collections.abc import Callable

    from stillpath.applications.machines.documents import Documents
    from stillpath.applications.machines.resolve import Resolver
    from stillpath.applications.machines.revision import Revision
    from stillpath.applications.machines.settings import MachineSettings
    from stillpath.service.settings import Settings

__all__ = [
    "By",
    "Message",
    "Name",
    "RevisionNote",
    "data_dir",
    "open_documents",
    "open_machines",
    "print_revision",
    "service_settings",
    "who",
]

_Made = TypeVar("_Made")

Name = Annotated[str, typer.Argument(metavar="NAME")]
By = Annotated[
    str | None, typer.Option("--by", help="Author, recorded with the revision. [default: you]")
]
Message = Annotated[str, typer.Option("--message", "-M", help="Why; recorded with the revision.")]


@dataclass(frozen=True, slots=True)
class RevisionNote:
    """Who makes a revision, and why."""

    by: By = None
    message: Message = ""


def open_machines() -> Resolver:
    """Return the machines of this user, by the environment's settings."""
    from stillpath.applications.machines.resolve import Resolver
    from stillpath.applications.machines.store import MachineStore

    settings = _settings()
    return Resolver(
        MachineStore(open_documents("machines")),
        require_approval=settings.require_approval,
        max_age_days=settings.measurement_max_age_days,
    )


def print_revision(revision: Revision) -> None:
    """Print one line about a revision that was made."""
    typer.echo(f"{revision.machine.name}: revision {revision.number} ({revision.machine.revision})")


def open_documents(name: str) -> Documents:
    """Return where this user's ``machines``, ``identifications`` or ``printers`` lie.

    A folder, unless STILLPATH_DATABASE_URL names a PostgreSQL database.
    """
    from stillpath.applications.machines.documents import DocumentFolder

    if _settings().database_url is not None:
        from stillpath.service.database import documents, engine

        settings = service_settings()
        if engine.database_url(settings).get_backend_name() != "sqlite":
            # Without a pool nothing is left open after a command.
            return documents.DocumentTable(engine.open_database(settings, pooled=False), name)
    return DocumentFolder(data_dir() / name)


def data_dir() -> Path:
    """Return the folder of this user's machines and identifications."""
    from stillpath.applications.machines.settings import user_data_dir

    return _settings().data_dir or user_data_dir()


def service_settings(**given: Any) -> Settings:
    """Return the settings of the service: those given that are not None, else the environment's."""
    from stillpath.service.settings import Settings

    return _checked(Settings, **{name: value for name, value in given.items() if value is not None})


def who(by: str | None) -> str:
    """Return the author that was named, else the user of this computer."""
    if by is not None:
        return by
    import getpass

    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):  # a container's user may have no name
        return "unknown"


def _settings() -> MachineSettings:
    from stillpath.applications.machines.settings import MachineSettings

    return _checked(MachineSettings.from_environment)


def _checked(make: Callable[..., _Made], **given: Any) -> _Made:
    from pydantic import ValidationError

    from stillpath.cli.wrong_options import wrong_setting

    try:
        return make(**given)
    except ValidationError as error:
        raise ModelError(wrong_setting(error)) from None
