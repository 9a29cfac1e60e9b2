"""A PostgreSQL server for the tests, of the programs that are installed.

`tests/conftest.py` offers the fixtures to all: `postgres_server` runs for the whole session,
`postgres_url` is a new, empty database for each test, `PostgresServer` is for tests that stop or
kill a server of their own. Tests that ask for them by `getfixturevalue` carry the marker
`postgresql`; all others are given it.
"""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

__all__ = [
    "MISSING",
    "PostgresServer",
    "is_installed",
    "postgres_server",
    "postgres_url",
    "running_server",
]

MISSING = "no PostgreSQL: install Debian's `postgresql`, or put its initdb and postgres on the PATH"


class PostgresServer:
    """A server with a folder of its own, on a port of the loopback interface.

    Parameters
    ----------
    folder : Path
        New; owned by whoever the server runs as. Short, because a socket lies in it.
    settings : str
        Further settings, ``name=value``.
    """

    def __init__(self, folder: Path, *settings: str) -> None:
        self._programs = _programs()
        assert self._programs is not None, MISSING
        self.folder = folder
        self.port = _free_port()
        self._settings = settings
        self._process: subprocess.Popen[bytes] | None = None
        folder.mkdir(parents=True, exist_ok=True)
        if _user() is not None:
            shutil.chown(folder, *_user_and_group())
        subprocess.run(
            [
                *(self._programs / "initdb", "-D", folder / "data", "-U", "stillpath"),
                *("-A", "trust", "-E", "UTF8", "--locale=C", "--no-sync"),
            ],
            check=True,
            stdout=subprocess.DEVNULL,
            cwd="/",
            **_as_user(),
        )

    def start(self) -> None:
        """Start it and wait until it answers."""
        import psycopg  # not before it is needed: every test run comes by here

        assert self._programs is not None
        assert self._process is None
        arguments = ["-D", str(self.folder / "data"), "-p", str(self.port), "-k", str(self.folder)]
        for setting in ("listen_addresses=127.0.0.1", "fsync=off", *self._settings):
            arguments += ["-c", setting]
        with (self.folder.parent / f"{self.folder.name}.log").open("ab") as log:
            self._process = subprocess.Popen(
                [self._programs / "postgres", *arguments],
                stdout=log,
                stderr=log,
                cwd="/",
                **_as_user(),
            )
        for _ in range(600):
            assert self._process.poll() is None, "PostgreSQL did not start, see its log"
            try:
                psycopg.connect(self._dsn("postgres")).close()
                return
            except psycopg.OperationalError:
                time.sleep(0.1)
        raise AssertionError("PostgreSQL does not answer")

    def stop(self, how: signal.Signals = signal.SIGINT) -> None:
        """End it: SIGINT closes it orderly, at once; SIGQUIT like a crash."""
        if self._process is None:
            return
        self._process.send_signal(how)
        self._process.wait(60)
        self._process = None

    def new_database(self) -> str:
        """Make an empty database and return its address for STILLPATH_DATABASE_URL."""
        import psycopg

        name = f"t{uuid.uuid4().hex[:12]}"
        with psycopg.connect(self._dsn("postgres"), autocommit=True) as connection:
            # As before PostgreSQL 15: several times as quick where nothing is forced to disk.
            strategy = "STRATEGY FILE_COPY" if connection.info.server_version >= 150_000 else ""
            connection.execute(f"CREATE DATABASE {name} {strategy}".encode())
        return f"postgresql+psycopg://stillpath@127.0.0.1:{self.port}/{name}"

    def drop_database(self, url: str) -> None:
        """Drop a database and whoever is connected to it."""
        import psycopg

        name = url.rpartition("/")[2]
        with psycopg.connect(self._dsn("postgres"), autocommit=True) as connection:
            connection.execute(f"DROP DATABASE {name} WITH (FORCE)".encode())

    def _dsn(self, database: str) -> str:
        return f"host=127.0.0.1 port={self.port} user=stillpath dbname={database} connect_timeout=5"


def is_installed() -> bool:
    """Return whether there is a PostgreSQL to run."""
    return _programs() is not None


@contextmanager
def running_server() -> Iterator[PostgresServer]:
    """Run a server in a folder of its own."""
    folder = Path(tempfile.mkdtemp(prefix="sp-pg-"))
    folder.chmod(0o755)
    server = PostgresServer(folder / "server")
    try:
        server.start()
        yield server
    finally:
        server.stop()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def postgres_server() -> Iterator[PostgresServer]:
    """Run a server for the session."""
    assert is_installed(), MISSING  # a test is stopped before, by its marker
    with running_server() as server:
        yield server


@pytest.fixture
def postgres_url(postgres_server: PostgresServer) -> Iterator[str]:
    """Give the address of a new, empty database."""
    url = postgres_server.new_database()
    yield url
    postgres_server.drop_database(url)


def _programs() -> Path | None:
    found = shutil.which("postgres")
    folders = [Path(found).parent] if found else []
    folders += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    return next((f for f in folders if (f / "initdb").exists() and (f / "postgres").exists()), None)


def _user() -> pwd.struct_passwd | None:
    """Return who the server runs as where we are root, which it refuses to be."""
    if os.getuid() != 0:
        return None
    for name in ("postgres", "nobody"):
        try:
            return pwd.getpwnam(name)
        except KeyError:
            continue
    raise AssertionError("neither a user postgres nor nobody")


def _user_and_group() -> tuple[int, int]:
    user = _user()
    assert user is not None
    return user.pw_uid, user.pw_gid


def _as_user() -> dict[str, object]:
    user = _user()
    if user is None:
        return {}
    return {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []}


def _free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])
