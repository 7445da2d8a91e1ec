"""Permitted callers: tokens of scripts and of browsers, kept as SHA-256 in ``ncap-tokens.json`` (mode 0600).

A token is 32 random octets, so its digest needs no salt and no slow hash. The file is changed under its own lock, and
read again when it has changed: `ncap token` works with and without a running daemon.
"""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import json
import os
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

from teds_provision.errors import NotFoundError, StoreError, UsageError
from teds_provision.files import open_lock, read_limited, write_whole

FILE: Final = "ncap-tokens.json"
BROWSER_SECONDS: Final = 30 * 86_400.0
LOGIN_SECONDS: Final = 300.0
_MOST_BROWSERS: Final = 100
_LONGEST_NAME: Final = 64
_MOST_OCTETS: Final = 4 << 20


@dataclass(frozen=True)
class Token:
    """One token: its digest (hex), and until when it is good (unix seconds; 0: for ever)."""

    name: str
    kind: Literal["script", "browser"]
    digest: str
    read_only: bool = False
    created: float = 0.0
    until: float = 0.0


def digest_of(token: str) -> str:
    """Return the SHA-256 of a token, hex."""
    return hashlib.sha256(token.encode()).hexdigest()


class Tokens:
    """The tokens of one home. Thread-safe."""

    def __init__(self, home: Path) -> None:
        self._home = home
        self._guard = threading.Lock()
        self._stamp: tuple[int, int] | None = None
        self._known: list[Token] = []
        self._logins: dict[str, tuple[float, bool]] = {}

    # -- for the command line ----------------------------------------------------------------------------------------

    def add(self, name: str, *, read_only: bool = False) -> str:
        """Make a token for a script; it is given back once and nowhere else. Raises UsageError for a taken name."""
        if not name.strip() or not name.isprintable() or len(name) > _LONGEST_NAME:
            raise UsageError(f"{name!r} is not a valid token name.", hint="Use up to 64 printable characters.")
        with self._changing() as tokens:
            if any(token.name == name and token.kind == "script" for token in tokens):
                raise UsageError(f"Token {name!r} already exists.", hint=f"Remove it: ncap token remove {name}")
            token = secrets.token_urlsafe(32)
            tokens.append(Token(name, "script", digest_of(token), read_only, time.time()))
        return token

    def remove(self, name: str) -> int:
        """Remove the tokens of this name, effective at once; raises NotFoundError."""
        with self._changing() as tokens:
            kept = [token for token in tokens if token.name != name]
            gone = len(tokens) - len(kept)
            if not gone:
                known = ", ".join(dict.fromkeys(token.name for token in tokens)) or "none"
                raise NotFoundError(f"No token is named {name!r}.", hint=f"Known tokens: {known}.")
            tokens[:] = kept
        return gone

    def all(self) -> list[Token]:
        """Return every token that is valid now."""
        now = time.time()
        return [token for token in self._read() if not token.until or token.until > now]

    # -- for the daemon ----------------------------------------------------------------------------------------------

    def login_link(self, *, read_only: bool = False) -> str:
        """Return a token for the URL of `ncap open`: it works once, within five minutes, and is never written down."""
        token = secrets.token_urlsafe(32)
        now = time.monotonic()
        with self._guard:
            self._logins = {key: value for key, value in self._logins.items() if value[0] > now}
            self._logins[digest_of(token)] = now + LOGIN_SECONDS, read_only
        return token

    def login(self, token: str) -> str | None:
        """Turn a token of `ncap open` into the token of a browser's cookie; None if it is invalid or expired."""
        with self._guard:
            until, read_only = self._logins.pop(digest_of(token), (0.0, False))
        if until < time.monotonic():
            return None
        cookie = secrets.token_urlsafe(32)
        now = time.time()
        with self._changing() as tokens:
            browsers = [token for token in tokens if token.kind == "browser"]
            for old in browsers[: max(0, len(browsers) - _MOST_BROWSERS + 1)]:
                tokens.remove(old)
            tokens.append(Token("browser", "browser", digest_of(cookie), read_only, now, now + BROWSER_SECONDS))
        return cookie

    def find(self, token: str) -> Token | None:
        """Return the matching token, None for none; compares in constant time."""
        digest, now = digest_of(token), time.time()
        found = None
        for known_token in self._read():
            if hmac.compare_digest(known_token.digest, digest) and (not known_token.until or known_token.until > now):
                found = known_token
        return found

    def is_good(self, digest: str) -> bool:
        """Return True if the token of this digest is still valid: neither removed nor expired."""
        now = time.time()
        return any(token.digest == digest and (not token.until or token.until > now) for token in self._read())

    # -- the file ----------------------------------------------------------------------------------------------------

    def _read(self) -> list[Token]:
        path = self._home / FILE
        with self._guard:
            try:
                status = path.stat()
            except FileNotFoundError:
                self._stamp, self._known = None, []
                return []
            stamp = status.st_mtime_ns, status.st_ino
            if stamp != self._stamp:
                self._known, self._stamp = (
                    _parsed(read_limited(path, _MOST_OCTETS, "tokens", failure=StoreError)),
                    stamp,
                )
            return self._known

    @contextmanager
    def _changing(self) -> Iterator[list[Token]]:
        descriptor = open_lock(self._home / f"{FILE}.lock")
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            now = time.time()
            tokens = [token for token in self._read() if not token.until or token.until > now]
            yield tokens
            text = json.dumps({"format": "ncap-tokens/1", "tokens": [asdict(token) for token in tokens]}, indent=1)
            write_whole(self._home / FILE, text.encode())
        finally:
            os.close(descriptor)


def _parsed(octets: bytes) -> list[Token]:
    try:
        rows: list[dict[str, Any]] = json.loads(octets)["tokens"]
        return [Token(**row) for row in rows]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise StoreError(
            f"{FILE} cannot be read, so no token is accepted.",
            hint="Remove the file and create new tokens: ncap token add NAME",
        ) from error
