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


def _free(kind: socket.SocketKind) -> int:
    while True:
        port = _dice.choice(_OF_OURS)
        with socket.socket(socket.AF_INET, kind) as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


def free_udp_port() -> int:
    """Return a UDP port of 127.0.0.1 that is free."""
    return _free(socket.SOCK_DGRAM)


def free_tcp_port() -> int:
    """Return a TCP port of 127.0.0.1 that is free."""
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
