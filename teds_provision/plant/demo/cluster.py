"""A PostgreSQL of one's own in a folder: for the demo, and for tests against a real server.

Debian's programs, none of the system's clusters: own data, socket, port and TLS key. ``initdb`` refuses root, so as
root everything of it runs as user ``postgres``. Logins come over TLS with SCRAM, the superuser (``postgres``) over the
socket alone. Nothing in it survives a loss of power: fsync is off.
"""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from teds_provision.errors import TedsProvisionError

SUPERUSER: Final = "postgres"
_ROOMS: Final = Path("/usr/lib/postgresql")
_OLDEST: Final = 15
_START: Final = 60.0
_HBA: Final = "local all postgres trust\nhostssl all all 127.0.0.1/32 scram-sha-256\n"
_SETTINGS: Final = {
    "listen_addresses": "127.0.0.1",
    "fsync": "off",
    "ssl": "on",
    "ssl_cert_file": "server.crt",
    "ssl_key_file": "server.key",
    "ssl_min_protocol_version": "TLSv1.3",
    "password_encryption": "scram-sha-256",
    "shared_buffers": "32MB",
    "autovacuum": "off",
    "log_min_messages": "warning",
}


def programs() -> Path | None:
    """Return the folder of the newest server's programs (15 or newer).

    None if Debian's `postgresql` is not installed.
    """
    found = [
        room for room in _ROOMS.glob("*/bin/postgres") if room.parts[-3].isdigit() and int(room.parts[-3]) >= _OLDEST
    ]
    newest = max(found, key=lambda path: int(path.parts[-3]), default=None)
    return newest.parent if newest is not None and runs_as() is not None else None


def runs_as() -> str | None:
    """Return the user that the server runs as: this one, or as root ``postgres``; None if root has no such user."""
    me = pwd.getpwuid(os.geteuid()).pw_name if os.geteuid() else SUPERUSER
    with suppress(KeyError):
        return pwd.getpwnam(me).pw_name
    return None


@dataclass
class Cluster:
    """A server that was made by :func:`running`; ``folder`` is its own."""

    folder: Path
    port: int
    bin: Path
    _server: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    @property
    def socket(self) -> Path:
        """The folder of its Unix socket."""
        return self.folder / "s"

    @property
    def root_certificate(self) -> Path:
        """Certificate with which a client verifies it."""
        return self.folder / "root.crt"

    @property
    def pid(self) -> int:
        """The postmaster's process id."""
        assert self._server is not None
        return self._server.pid

    def url(self, database: str) -> str:
        """Return the URL for `registry connect`."""
        return f"postgresql://localhost:{self.port}/{database}?sslrootcert={self.root_certificate}"

    def psql(self, text: str, database: str = "postgres") -> str:
        """Run SQL as the superuser; returns unaligned rows. Raises TedsProvisionError with the server's words."""
        where = ["-h", str(self.socket), "-p", str(self.port), "-U", SUPERUSER, "-d", database]
        done = self._run("psql", "-X", "-q", "-At", "-v", "ON_ERROR_STOP=1", *where, "-f", "-", stdin=text)
        return done.stdout

    def make(self) -> None:
        """Make data folder, TLS key and settings."""
        owner = runs_as()
        for place in (self.folder, self.socket):
            place.mkdir(mode=0o755, parents=True, exist_ok=True)
            if owner is not None and os.geteuid() == 0:
                shutil.chown(place, owner)
        data = self.folder / "data"
        usual = ["--no-sync", "--no-instructions", "--auth=trust", "--encoding=UTF8", "--locale=C"]
        self._run("initdb", "-D", str(data), "-U", SUPERUSER, *usual)
        key, certificate = _tls()
        settings = _SETTINGS | {"port": str(self.port), "unix_socket_directories": str(self.socket)}
        for name, octets, mode in (
            ("server.key", key, 0o600),
            ("server.crt", certificate, 0o644),
            ("pg_hba.conf", _HBA.encode(), 0o600),
            ("postgresql.conf", "".join(f"{name} = '{value}'\n" for name, value in settings.items()).encode(), 0o600),
        ):
            path = data / name
            path.write_bytes(octets)
            path.chmod(mode)
            if owner is not None and os.geteuid() == 0:
                shutil.chown(path, owner)
        self.root_certificate.write_bytes(certificate)

    def start(self) -> None:
        """Start the server and wait until it answers; it ends with this process, however that ends."""
        dies_with_us = ["setpriv", "--pdeathsig", "INT", "--"] if shutil.which("setpriv") else []
        log = (self.folder / "log").open("ab")
        with log:
            self._server = subprocess.Popen(
                [*dies_with_us, str(self.bin / "postgres"), "-D", str(self.folder / "data")],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd="/",
                start_new_session=True,  # Ctrl-C is for the process that started the demo
                user=runs_as() if os.geteuid() == 0 else None,
            )
        end = time.monotonic() + _START
        asks = [str(self.bin / "pg_isready"), "-q", "-h", str(self.socket), "-p", str(self.port)]
        while subprocess.run(asks, check=False).returncode:
            if self._server.poll() is not None or time.monotonic() > end:
                raise TedsProvisionError(f"PostgreSQL did not start: {(self.folder / 'log').read_text()[-500:]}")
            time.sleep(0.02)

    def stop(self, how: signal.Signals = signal.SIGINT) -> None:
        """End the server: at once, connections cut (SIGINT), or as a power cut would (SIGQUIT)."""
        if self._server is not None:
            self._server.send_signal(how)
            self._server.wait(_START)
            self._server = None

    def _run(self, program: str, *words: str, stdin: str = "") -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            [str(self.bin / program), *words],
            input=stdin,
            capture_output=True,
            text=True,
            cwd="/",
            check=False,
            user=runs_as() if os.geteuid() == 0 else None,
        )
        if done.returncode:
            raise TedsProvisionError(f"{program}: {done.stderr.strip()[-500:]}")
        return done


@contextmanager
def running(folder: Path, port: int, bin: Path) -> Iterator[Cluster]:
    """Run a separate server with its data in ``folder``, which user ``postgres`` must be able to reach."""
    made = Cluster(folder, port, bin)
    made.make()
    made.start()
    try:
        yield made
    finally:
        made.stop()


def _tls() -> tuple[bytes, bytes]:
    """Return key and self-signed certificate of ``localhost``, as PEM."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
    from cryptography.x509.oid import NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=30))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    return private, made.public_bytes(Encoding.PEM)
