"""Ports, buses, domains and UUIDs of a test's own, however many workers and checkouts run on this machine at once."""

from __future__ import annotations

import fcntl
import os
import random
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from teds_provision.protocol.announce import default_can_address

OF_NODES = range(2, 60)  # CAN addresses of nodes that a test makes; what it puts beside them, it puts elsewhere
_OF_OURS = range(10_000, 32_000)  # below those that the system deals out to others a moment later
_dice = random.SystemRandom()


class _Claims:
    """Ports that this process has taken for its tests, each a locked octet of one file, so that no other takes them.

    That a port is free now says nothing of the moment at which a node binds it: two of eight workers that look at once
    would sometimes take the same one. The locks end with the process.
    """

    def __init__(self) -> None:
        self.process = os.getpid()
        self._taken: set[int] = set()  # a process can lock its own octet twice
        file = Path(tempfile.gettempdir(), f"teds-provision-tests-{os.getuid()}-ports")
        self._file = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)

    def claim(self, kind: socket.SocketKind, port: int) -> bool:
        """Take a port, or return False if this or another process has it."""
        place = int(kind) << 16 | port
        if place in self._taken:
            return False
        try:
            fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
        except OSError:
            return False
        self._taken.add(place)
        return True


_claims: list[_Claims] = []  # at most one; of a forked process its own


def _claim(kind: socket.SocketKind, port: int) -> bool:
    if not _claims or _claims[0].process != os.getpid():
        _claims[:] = [_Claims()]
    return _claims[0].claim(kind, port)


def _free(kind: socket.SocketKind) -> int:
    while True:
        port = _dice.choice(_OF_OURS)
        with socket.socket(socket.AF_INET, kind) as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            if _claim(kind, port):
                return port


def free_udp_port() -> int:
    """Return a UDP port of 127.0.0.1 that is free, and that no other test is given as long as this process lives."""
    return _free(socket.SOCK_DGRAM)


def free_tcp_port() -> int:
    """Return a TCP port of 127.0.0.1 that is free, and that no other test is given as long as this process lives."""
    return _free(socket.SOCK_STREAM)


def free_group() -> str:
    """A multicast group of one's own: a bus is bound to its group, so no look at a port shows whether it is taken.

    Two tests on one bus are two stations: the one that is late hears of the other one's nodes that a tap is needed.
    """
    return "239." + ".".join(str(_dice.randrange(1, 250)) for _ in range(3))


def free_bus() -> str:
    """Return a CAN bus over multicast that no other test uses."""
    return f"udp_multicast:{free_group()}?port={free_udp_port()}"


def new_uuid(taken: set[int]) -> bytes:
    """Return a random UUID whose default CAN address lies in ``OF_NODES`` and is not ``taken``; it is from now on.

    A node's default address follows from its UUID, so two random ones in 239 share it, or meet a stranger of the test.
    """
    while True:
        uuid = os.urandom(10)
        address = default_can_address(uuid)
        if address in OF_NODES and address not in taken:
            taken.add(address)
            return uuid


def free_reader() -> str:
    """Return a simulated NFC reader that no other test uses."""
    return f"udp:localhost:{free_udp_port()}"


@contextmanager
def ros_domain() -> Iterator[int]:
    """A ROS domain that nobody else is in while it is held: there are few, and in one everybody sees every topic."""
    numbers = list(range(100, 200))
    _dice.shuffle(numbers)
    for number in numbers:
        place = Path(tempfile.gettempdir()) / f"teds-provision-tests-{os.getuid()}-ros-domain-{number}"
        with place.open("w") as held:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield number
            return
    raise AssertionError("Every ROS domain from 100 to 199 is in use.")


def self_signed(folder: Path) -> tuple[str, Path, str, Path]:
    """Return the options for TLS: a new certificate for localhost and 127.0.0.1, and its key."""
    certificate, key = folder / "cert.pem", folder / "key.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2",
         "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1", "-keyout", str(key),
         "-out", str(certificate)],
        check=True, capture_output=True,
    )  # fmt: skip
    return "--tls-cert", certificate, "--tls-key", key
