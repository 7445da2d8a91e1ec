"""The other side of the provisioning benchmarks: virtual nodes, one after the other on one reader or bus, or many.

Started as a separate process: ``python -m benchmarks.nodes nfc|can LINK [--pace] [--tag 2] [--crypto-delay MS]``. For
every line on stdin it takes the present node away and puts a new one down, and answers with six words: the node's
UUID, how many point operations (signatures, ECDH, checks of signatures; one-time keys are made in idle time) the node
before it did, how many seconds its flash took to be safe (this machine's disk), and how many it waited, at random,
before its last answer to everyone; and of a node in C, which counts no operations but times them, how many seconds
they took, and how many all the rest of it, from the arrival of what it answers to the first bit of its answer.
With ``--many N`` there are N nodes on a bus at once, until stdin closes; with ``--c`` each node is
``firmware/build/host/teds-node``, paced.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Literal

from teds_provision.node.can.server import CanServer
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.nfc.server import NfcServer
from teds_provision.node.virtual import Delays, VirtualNode
from teds_provision.protocol.flash import Flash

PROGRAM = Path(__file__).parents[1] / "firmware/build/host/teds-node"
TAGS: dict[str, Literal["2", "4"]] = {"2": "2", "4": "4"}


class CountingNode(VirtualNode):
    """A virtual node that counts its point operations, and the seconds of its flash."""

    operations = 0
    flash = 0.0

    def __init__(self, folder: Path, *, delays: Delays) -> None:
        super().__init__(folder, delays=delays)
        plain = self.flash_file.commit

        def commit(state: Flash) -> None:
            began = time.perf_counter()
            try:
                plain(state)
            finally:
                self.flash += time.perf_counter() - began

        self.flash_file.commit = commit  # type: ignore[method-assign]

    def _work(self) -> None:
        self.operations += 1
        super()._work()


class CountingServer(CanServer):
    """A bus that remembers how long its node waited before its last answer to everyone."""

    waited = 0.0

    def _spread(self) -> float:
        self.waited = super()._spread()
        return self.waited


def made(folder: Path, delay: float) -> CountingNode:
    """Return a new node in factory state; ``delay`` seconds a point operation."""
    FlashFile.create(folder)
    return CountingNode(folder, delays=Delays(crypto=delay))


def one_after_the_other(options: argparse.Namespace, place: Path) -> None:
    """Serve another node for each line of input."""
    server: NfcServer | CanServer | None = None
    node: CountingNode | None = None
    for number, _ in enumerate(sys.stdin):
        if server is not None:
            server.stop()
        operations, flash = (node.operations, node.flash) if node is not None else (0, 0.0)
        waited = server.waited if isinstance(server, CountingServer) else 0.0
        node = made(place / str(number), options.crypto_delay / 1000)
        if options.via == "nfc":
            tag = TAGS[options.tag]
            server = NfcServer(options.link, node, tag=tag, wt_int=options.wait_time, pace=options.pace)
        else:
            server = CountingServer(options.link, node, counts_as_tapped=node.in_factory_state)
        server.start()
        print(node.tim.flash.uuid.hex(), operations, flash, waited, 0.0, 0.0, flush=True)
    if server is not None:
        server.stop()


def one_after_the_other_in_c(options: argparse.Namespace, place: Path) -> None:
    """Serve another node in C for each line of input."""
    process: subprocess.Popen[str] | None = None
    for number, _ in enumerate(sys.stdin):
        usage = ended(process) if process is not None else dict.fromkeys(("chip", "flash", "turned"), 0.0)
        words = [str(PROGRAM), "--flash", str(place / f"{number}.bin"), f"--{options.via}", options.link, "--pace"]
        process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        uuid = json.loads(process.stdout.readline())["uuid"]
        print(uuid, 0, usage["flash"], 0.0, usage["chip"], usage["turned"], flush=True)
    if process is not None:
        ended(process)


def ended(process: subprocess.Popen[str]) -> dict[str, float]:
    """End a node in C and return its report of the part that it took."""
    process.terminate()
    output: dict[str, float] = json.loads(process.communicate(timeout=20)[0])
    return output


def all_at_once(options: argparse.Namespace, place: Path) -> None:
    """Run the nodes on one bus; print their UUIDs in one line when they listen."""
    server = CanServer(options.link)
    nodes = [made(place / str(number), options.crypto_delay / 1000) for number in range(options.many)]
    for node in nodes:
        server.add(node, counts_as_tapped=node.in_factory_state)
    server.start()
    print(*(node.tim.flash.uuid.hex() for node in nodes), flush=True)
    sys.stdin.read()
    server.stop()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("via", choices=["nfc", "can"])
    parser.add_argument("link")
    parser.add_argument("--pace", action="store_true")
    parser.add_argument("--wait-time", type=int, default=4)
    parser.add_argument("--tag", choices=sorted(TAGS), default="4")
    parser.add_argument("--crypto-delay", type=float, default=0)
    parser.add_argument("--many", type=int, default=0)
    parser.add_argument("--c", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run = one_after_the_other_in_c if options.c else one_after_the_other
        (all_at_once if options.many else run)(options, Path(folder))


if __name__ == "__main__":
    main()
