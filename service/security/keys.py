"""API keys: random, stored as digests, with scopes, expiry and revocation."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from pydantic import SecretStr
from sqlalchemy import Engine, RowMapping, delete, insert, select, update
from sqlalchemy.exc import IntegrityError

from stillpath.service.database.tables import keys
from stillpath.service.database.transactions import reading, writing
from stillpath.service.permissions import private_file
from stillpath.service.security.callers import Caller, Scope
from stillpath.service.settings import Settings, is_loopback

__all__ = [
    "KEY_PREFIX",
    "OWNER_PATTERN",
    "Key",
    "KeyRefused",
    "KeyStore",
    "UnsafeBinding",
    "announce_first_key",
    "keys_needed",
]

KEY_PREFIX = "sp_"
OWNER_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._@-]{0,63}$"
_FORM = re.compile(rf"{KEY_PREFIX}[A-Za-z0-9_-]{{32,128}}")
_FIRST = "first"
_FILE = "first-key"
# Resolution of a key's last use, so that not every read causes a write.
_USE_SECONDS = 60.0


class UnsafeBinding(ValueError):
    """The service would serve other computers without requiring a key."""


class KeyRefused(ValueError):
    """A key or what is asked of it has the wrong form."""


@dataclass(frozen=True, slots=True)
class Key:
    """The stored data of a key, without the key itself.

    Attributes
    ----------
    id : str
        Names the key in lists and in the audit log; it opens nothing.
    owner : str
        Whose jobs its jobs are; several keys may have one owner.
    name : str
        What it is for, for a person.
    created_at, expires_at, revoked_at, used_at : float or None
        Seconds since the epoch; `used_at` may be a minute behind.
    """

    id: str
    owner: str
    name: str
    scopes: frozenset[Scope]
    created_at: float
    expires_at: float | None = None
    revoked_at: float | None = None
    used_at: float | None = None

    def refusal(self, now: float) -> str | None:
        """Return why the key is no longer valid, or None."""
        if self.revoked_at is not None:
            return f"The key {self.id} was revoked."
        if self.expires_at is not None and self.expires_at <= now:
            return f"The key {self.id} has expired."
        return None

    def caller(self, remote: str | None) -> Caller:
        """Return who shows this key."""
        return Caller(self.owner, self.scopes, key_id=self.id, remote=remote)


class KeyStore:
    """The keys in the database.

    A key has 192 random bits, so its SHA-256 needs neither salt nor stretching, and looking up the
    digest leaks no partial matches.

    Parameters
    ----------
    clock : callable
        Seconds since the epoch.
    """

    def __init__(self, engine: Engine, *, clock: Callable[[], float] = time.time) -> None:
        self._engine = engine
        self._clock = clock

    def create(
        self,
        *,
        name: str,
        owner: str,
        scopes: Iterable[Scope],
        expires_at: float | None = None,
    ) -> tuple[Key, str]:
        """Make a key.

        Returns
        -------
        Key, str
            The second is the key itself; it is not kept and cannot be shown again.

        Raises
        ------
        KeyRefused
        """
        secret = KEY_PREFIX + secrets.token_urlsafe(24)
        return self._add(secrets.token_hex(6), secret, name, owner, scopes, expires_at), secret

    def create_first(self, secret: str | None = None) -> str | None:
        """Make the first key, with all scopes, unless there is or was one already.

        Parameters
        ----------
        secret : str, optional
            The key to take; by default a random one.

        Returns
        -------
        str or None
            The key, or None if there are keys. Of several processes that try, one gets it.

        Raises
        ------
        KeyRefused
            If `secret` does not look like a key.
        """
        if secret is not None:
            _check_form(secret)
        with reading(self._engine) as connection:
            if connection.execute(select(keys.c.id).limit(1)).first() is not None:
                return None
        secret = secret or KEY_PREFIX + secrets.token_urlsafe(24)
        try:
            self._add(_FIRST, secret, "first key", "admin", Scope, None)
        except IntegrityError:
            return None
        return secret

    def find(self, secret: str) -> Key | None:
        """Return the key of a secret, whether still valid or not."""
        if _FORM.fullmatch(secret) is None:
            return None
        query = select(keys).where(keys.c.sha256 == _digest(secret))
        with reading(self._engine) as connection:
            row = connection.execute(query).mappings().first()
        return None if row is None else _key(row)

    def sign(self, key_id: str, text: str) -> tuple[Key, str] | None:
        """Return a key, and its signature of a text; None: there is no such key.

        The signature (HMAC-SHA256) is made with what the database holds of the key, so that every
        process of the service knows it, and it ends with the key.
        """
        if not key_id.isalnum():
            return None
        with reading(self._engine) as connection:
            row = connection.execute(select(keys).where(keys.c.id == key_id)).mappings().first()
        if row is None:
            return None
        return _key(row), hmac.new(row["sha256"].encode(), text.encode(), "sha256").hexdigest()

    def used(self, key: Key) -> None:
        """Note that a key was used, at most once a minute."""
        now = self._clock()
        # Less than nothing where the clock was set back.
        if key.used_at is not None and 0 <= now - key.used_at < _USE_SECONDS:
            return
        with writing(self._engine) as connection:
            connection.execute(update(keys).where(keys.c.id == key.id).values(used_at=now))

    def list(self) -> list[Key]:
        """Return all keys, the oldest first."""
        query = select(keys).order_by(keys.c.created_at, keys.c.id)
        with reading(self._engine) as connection:
            return [_key(row) for row in connection.execute(query).mappings()]

    def revoke(self, key_id: str) -> Key | None:
        """Revoke a key immediately and permanently; return it, or None if the id is unknown."""
        if not key_id.isalnum():
            return None
        with writing(self._engine) as connection:
            connection.execute(
                update(keys)
                .where(keys.c.id == key_id, keys.c.revoked_at.is_(None))
                .values(revoked_at=self._clock())
            )
            row = connection.execute(select(keys).where(keys.c.id == key_id)).mappings().first()
        return None if row is None else _key(row)

    def withdraw(self, key: Key) -> None:
        """Delete a key that nobody has seen, as if it had not been made."""
        with writing(self._engine) as connection:
            connection.execute(delete(keys).where(keys.c.id == key.id))

    def _add(
        self,
        key_id: str,
        secret: str,
        name: str,
        owner: str,
        scopes: Iterable[Scope],
        expires_at: float | None,
    ) -> Key:
        key = Key(key_id, owner, name, frozenset(scopes), self._clock(), expires_at)
        _check(key)
        row = {
            "id": key.id,
            "owner": key.owner,
            "name": key.name,
            "sha256": _digest(secret),
            "scopes": " ".join(sorted(key.scopes)),
            "created_at": key.created_at,
            "expires_at": key.expires_at,
        }
        with writing(self._engine) as connection:
            connection.execute(insert(keys).values(row))
        return key


def keys_needed(settings: Settings, host: str) -> bool:
    """Return whether callers of a service bound to `host` must show a key.

    Raises
    ------
    UnsafeBinding
        If keys are switched off for an address that other computers can reach.
    KeyRefused
        If the first key of the settings does not look like one.
    """
    if settings.first_key is not None:
        _check_form(settings.first_key.get_secret_value())
    local = is_loopback(host)
    if settings.keys is None:
        return not local
    if not settings.keys and not local:
        raise UnsafeBinding(
            f"{host} can be reached from other computers, and keys are switched off "
            "(STILLPATH_KEYS). Bind 127.0.0.1, or leave keys on"
        )
    return settings.keys


def announce_first_key(store: KeyStore, given: SecretStr | None, folder: Path) -> None:
    """Make the first key if there is none; unless it was given, put it into a file and say where.

    Parameters
    ----------
    folder : Path
        For the file ``first-key``, which only its owner reads.

    Raises
    ------
    KeyRefused
        If the given one does not look like a key.
    """
    if given is not None:
        store.create_first(given.get_secret_value())
        return
    if store.list():
        return
    # The file first, so that no key is lost: whoever starts a service beside us has one of his own.
    fresh, file = folder / f".{_FILE}-{secrets.token_hex(4)}", folder / _FILE
    private_file(fresh)
    try:
        secret = KEY_PREFIX + secrets.token_urlsafe(24)
        fresh.write_text(f"{secret}\n")
        if store.create_first(secret) is not None:
            fresh.replace(file)
            # Not the key itself: standard output is what logs keep.
            sys.stdout.write(f"stillpath: first key, with all scopes: {file.resolve()}\n")
            sys.stdout.flush()
    finally:
        fresh.unlink(missing_ok=True)


def _check_form(secret: str) -> None:
    if _FORM.fullmatch(secret) is None:
        raise KeyRefused(
            f"the first key must be {KEY_PREFIX!r} and 32 to 128 characters of A-Z a-z 0-9 _ -; "
            "python -c \"import secrets; print('sp_' + secrets.token_urlsafe(24))\" makes one "
            "(STILLPATH_FIRST_KEY)"
        )


def _check(key: Key) -> None:
    if re.fullmatch(OWNER_PATTERN, key.owner) is None:
        raise KeyRefused(
            f"owner {key.owner[:80]!r}: give 1 to 64 letters, digits or . _ @ - that begin with a "
            "letter or digit"
        )
    if not 1 <= len(key.name) <= 120 or not key.name.isprintable():
        raise KeyRefused(f"name {key.name[:80]!r}: give 1 to 120 printable characters")
    if not key.scopes:
        raise KeyRefused(f"a key without scopes opens nothing; there are {', '.join(Scope)}")
    if key.expires_at is not None and key.expires_at <= key.created_at:
        raise KeyRefused("the key would have expired already; give a later moment")


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


def _key(row: RowMapping) -> Key:
    values = dict(row)
    del values["sha256"]
    return Key(**values | {"scopes": frozenset(Scope(name) for name in row["scopes"].split())})
