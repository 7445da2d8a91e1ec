"""A node process for the tests: an emulated tag whose handler gives each frame back reversed, after one octet 01.

Options as one JSON argument: path, uuid (hex), tag, uid, delay (s, of each frame), wt_int, n_wait, max_ndef, pace,
initial (hex: an NDEF message instead of the node's own), torn (how many answers have one octet flipped).
Prints "ready", then one line for each request ("request N") and each loss of the field ("lost").
"""

from __future__ import annotations

import json
import signal
import sys
import time
from typing import Any

from teds_provision.node.nfc.server import NfcServer
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.provisioning.meeting import IdleStop


class Echo:
    def __init__(self, uuid: bytes, delay: float) -> None:
        self.uuid, self.delay, self.served = uuid, delay, 0

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        assert link == "nfc"
        assert tapped
        self.served += 1
        print("request", self.served, flush=True)
        time.sleep(self.delay)
        return b"\x01" + frame[::-1]

    def lost(self, link: str) -> None:
        print("lost", flush=True)

    def identify(self) -> bytes:
        return Identity(self.uuid, NodeState.KEYED, self.served, 0, 4094, 9).encode()

    def can_address(self) -> int:
        return 9


def spoil(server: NfcServer, options: dict[str, Any]) -> None:
    tnep, torn = server._tnep, options.get("torn", 0)
    if "initial" in options:
        tnep._initial_message = lambda: bytes.fromhex(options["initial"])  # type: ignore[method-assign]
    answer = tnep._answer

    def flipped(serial: int, octets: bytes) -> bytes | None:
        nonlocal torn
        good = answer(serial, octets)
        if good is None or len(good) < 40 or torn == 0:
            return good
        torn -= 1
        return good[:-1] + bytes((good[-1] ^ 1,))

    tnep._answer = flipped  # type: ignore[method-assign]


def main() -> None:
    options = json.loads(sys.argv[1])
    server = NfcServer(
        options["path"],
        Echo(bytes.fromhex(options["uuid"]), options.get("delay", 0.0)),
        tag=options.get("tag", "4"),
        uid=bytes.fromhex(options["uid"]) if "uid" in options else None,
        wt_int=options.get("wt_int", 12),
        n_wait=options.get("n_wait", 15),
        max_ndef=options.get("max_ndef"),
        pace=options.get("pace", False),
        queue=True,
    )
    spoil(server, options)
    done = IdleStop(None)
    signal.signal(signal.SIGTERM, lambda *_: done.request_stop())
    server.start()
    print("ready", flush=True)
    done.wait()
    server.stop()


if __name__ == "__main__":
    main()
