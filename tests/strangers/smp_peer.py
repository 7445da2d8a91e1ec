"""SMP of others, over UDP into a session of ours: what mcumgr-toolkit (Rust) makes of a board behind the filter."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pytest

from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.messages.smp import decode_packet, encode_map

PYTHON: Final = Path(os.environ.get("SMP_PYTHON", Path(__file__).parents[2] / ".venv-smp" / "bin" / "python"))
CLIENT: Final = Path(__file__).with_name("mcumgr_client.py")
PEER: Final = [
    pytest.mark.soak,
    pytest.mark.skipif(not PYTHON.exists(), reason="make test-smp makes .venv-smp"),
]
NOT_SUPPORTED, BUSY, INVALID = 8, 10, 3
"""Errors of SMP in which the session's refusals reach the client."""
_ERRORS: Final = {Reason.NOT_PERMITTED: NOT_SUPPORTED, Reason.BUSY: BUSY}
PASSED: Final = {
    "erase the slot": "MGMT_ERR_ENOTSUP",
    "erase storage": "MGMT_ERR_ENOTSUP",
    "shell": "MGMT_ERR_ENOTSUP",
    "settings": "MGMT_ERR_ENOTSUP",
    "file": "MGMT_ERR_ENOTSUP",
    "time": "MGMT_ERR_ENOTSUP",
    "keep what runs": "MGMT_ERR_EINVAL",  # 2: it is not on trial
    "upload": None,
    "keep what never ran": "MGMT_ERR_EINVAL",  # 4: no such body passes
    "slots": [0, 1],
    "restart": None,
}
"""What the client is told before the restart, beside its packet size and the images."""

Ask = Callable[[bytes], tuple[bool, int, bytes]]
"""A packet in the session: whether it passed, else the reason, and the reply packet."""


def run_client(ask: Ask, image: Path, part: str) -> dict[str, Any]:
    """Run the client's part of an update; return what its calls gave."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind(("127.0.0.1", 0))
        words = [str(PYTHON), str(CLIENT), str(own.getsockname()[1]), str(image), part]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as client:
            ended = threading.Event()
            carrier = threading.Thread(target=_carry, args=(own, ask, ended), daemon=True)
            carrier.start()
            try:
                output, _ = client.communicate(timeout=300)
            finally:
                client.kill()
                ended.set()
                carrier.join()
    assert client.returncode == 0
    gave: dict[str, Any] = json.loads(output)
    return gave


def _carry(own: socket.socket, ask: Ask, ended: threading.Event) -> None:
    own.settimeout(0.1)
    while not ended.is_set():
        try:
            packet, sender = own.recvfrom(4096)
        except TimeoutError:
            continue
        passed, reason, reply = ask(packet)
        if not passed:
            reply = decode_packet(packet).reply(encode_map({"rc": _ERRORS.get(Reason(reason), INVALID)})).encode()
        own.sendto(reply, sender)
