"""Checks the addresses of servers of values: loopback; others only with TLS and a permitted name."""

from __future__ import annotations

import ipaddress
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from teds_provision.errors import BadDataError, UsageError
from teds_provision.files import read_limited

_LOCAL_NAMES: Final = ("localhost",)
_EVERY_ADDRESS: Final = ("0.0.0.0", "::")
_MOST_PEM: Final = 1 << 20


@dataclass(frozen=True)
class Exposure:
    """``allow``: host names under which clients may reach a server; ``certificate`` and ``key``: its TLS, PEM files."""

    allow: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None

    @property
    def tls(self) -> bool:
        """True if servers speak TLS."""
        return self.certificate is not None

    def require_pair(self) -> None:
        """Raise UsageError for half of a pair, BadDataError for files with which no server can start."""
        if (self.certificate is None) != (self.key is None):
            raise UsageError("--tls-cert and --tls-key must be used together.", hint="Give both, or neither.")
        if self.certificate is not None and self.key is not None:
            _require_pair(self.certificate, self.key)

    def require_safe(self, option: str, host: str, *, sends: str, clients: str) -> None:
        """Raise UsageError if other machines could reach ``host`` without TLS, or under no name that was allowed.

        ``option`` names the address for people, ``sends`` what would be readable, ``clients`` who connects.
        """
        if is_loopback(host):
            return
        if not self.tls:
            raise UsageError(
                f"{option} {host} would send {sends} over the network unencrypted.",
                hint="Add --tls-cert and --tls-key, or serve 127.0.0.1 and use an SSH tunnel.",
            )
        if not self.allow:
            raise UsageError(
                f"{option} {host} needs the names under which {clients} may reach it.",
                hint="Add --http-allow HOST for each of them.",
            )

    def url(self, scheme: str, host: str, port: int) -> str:
        """Return the address for people; on every address, it is the first name that was allowed."""
        name = self.allow[0] if self.allow and host in _EVERY_ADDRESS else host
        return f"{scheme}{'s' if self.tls else ''}://{f'[{name}]' if ':' in name else name}:{port}"


def is_loopback(host: str) -> bool:
    """Return True if only this machine reaches a server on this address.

    False for names that would have to be looked up.
    """
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() in _LOCAL_NAMES


def _require_pair(certificate: Path, key: Path) -> None:
    """Raise BadDataError if OpenSSL cannot serve with these two files; there is no prompt for an encrypted key."""

    def no_passphrase() -> str:
        raise BadDataError(
            f"{key} is encrypted.", hint="A service starts unattended: store the key decrypted, with mode 0600."
        )

    for path in (certificate, key):
        if len(read_limited(path, _MOST_PEM, "PEM file")) == 0:
            raise BadDataError(f"{path} is empty.")
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, no_passphrase)
    except OSError as error:  # ssl.SSLError is one
        raise BadDataError(
            f"{certificate} and {key} are not a certificate and its key: {getattr(error, 'reason', None) or error}.",
            hint="Both must be PEM files, and the certificate must come first in its file.",
        ) from error
