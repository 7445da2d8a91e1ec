"""A fixture for docs/extending.md, "A link that streams": a virtual node at the end of a TCP line.

``python -m tests.line_node FOLDER`` serves the node of this folder on a free port of this machine, which it prints. The
node is the product's; this file is only the wire that the page invents.
"""

from __future__ import annotations

import socket
import sys
import threading
from pathlib import Path

from teds_provision.node.flash_file import FlashFile
from teds_provision.node.hardware.board import Board
from teds_provision.node.realtime_loop import RealtimeLoop
from teds_provision.node.virtual import VirtualNode
from teds_provision.protocol.operation.streams import DataFrame
from teds_provision.teds.image import Image
from teds_provision.teds.sheet import Sheet

COMMAND, DATA = 0, 1
LINK, MTU = "ble:2", 247  # data go whole, as over the air: the profile knows a node's links by these names


def board_of(file: FlashFile) -> Board:
    assert file.hardware is not None
    return Board(Sheet.from_image(Image(file.load().uuid, file.hardware)), source="ramp:2")


def main() -> None:
    loop = RealtimeLoop()
    node = VirtualNode(Path(sys.argv[1]), board=board_of, pulse=loop)
    assert node.board is not None
    loop.start()
    node.board.start()
    with socket.create_server(("127.0.0.1", 0)) as listening:
        print(listening.getsockname()[1], flush=True)
        while True:
            line, _ = listening.accept()
            with line:
                serve(node, line)


def serve(node: VirtualNode, line: socket.socket) -> None:
    """Answer until the station closes the line."""
    turn = threading.Lock()

    def send(kind: int, octets: bytes) -> None:
        with turn:
            line.sendall(len(octets).to_bytes(2, "big") + bytes([kind]) + octets)

    def send_data(frame: DataFrame) -> None:
        send(DATA, frame.data)

    node.streams_over(send_data, LINK.partition(":")[0])
    with line.makefile("rb") as stream:
        while len(head := stream.read(3)) == 3:
            octets = stream.read(int.from_bytes(head[:2], "big"))
            if head[2] == COMMAND:
                reply = node.request_received(LINK, octets, tapped=False, received=node.tick(), mtu=MTU)
                send(COMMAND, reply)
                node.reply_sent(LINK)
            else:
                node.drive(LINK, octets[1:])
                print("driven", flush=True)
    node.lost(LINK)


if __name__ == "__main__":
    main()
