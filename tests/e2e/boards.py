"""Factory nodes in one process, each on a simulated reader of its own: ``python -m tests.e2e.boards FOLDER PATH …``.

Prints one line of JSON, the UUIDs in order, when all lie there; ends when stdin closes.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from teds_provision.node.flash_file import FlashFile
from teds_provision.node.nfc.server import NfcServer
from teds_provision.node.virtual import VirtualNode


def main() -> None:
    folder, *paths = sys.argv[1:]
    servers, uuids = [], []
    for number, path in enumerate(paths):
        home = Path(folder) / f"board{number}"
        FlashFile.create(home)
        node = VirtualNode(home)
        uuids.append(node.tim.flash.uuid.hex())
        servers.append(NfcServer(path, node))
        servers[-1].start()
    print(json.dumps(uuids), flush=True)
    sys.stdin.read()
    for server in servers:
        server.stop()


if __name__ == "__main__":
    main()
