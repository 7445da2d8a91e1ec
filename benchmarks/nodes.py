"""The other side of the provisioning benchmark: virtual nodes, one after the other on one reader or bus.

Started as a process of its own: ``python -m benchmarks.nodes nfc|can LINK [--pace] [--wait-time N]``. For every line on
stdin it takes the present node away and puts a new one down; it answers each with the node's UUID.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from teds_provision.node.can.server import CanServer
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.nfc.server import NfcServer
from teds_provision.node.virtual import VirtualNode


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("via", choices=["nfc", "can"])
    parser.add_argument("link")
    parser.add_argument("--pace", action="store_true")
    parser.add_argument("--wait-time", type=int, default=4)
    options = parser.parse_args()
    server: NfcServer | CanServer | None = None
    with tempfile.TemporaryDirectory() as folder:
        for number, _ in enumerate(sys.stdin):
            if server is not None:
                server.stop()
            home = Path(folder) / str(number)
            FlashFile.create(home)
            node = VirtualNode(home)
            if options.via == "nfc":
                server = NfcServer(options.link, node, wt_int=options.wait_time, pace=options.pace)
            else:
                server = CanServer(options.link, node, counts_as_tapped=node.in_factory_state)
            server.start()
            print(node.tim.flash.uuid.hex(), flush=True)
        if server is not None:
            server.stop()


if __name__ == "__main__":
    main()
