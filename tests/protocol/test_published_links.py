"""The published vectors of the links: NFC messages and CAN frames, both ends of ours and a stranger."""

from __future__ import annotations

from teds_provision.links.can.bus import Frame
from teds_provision.links.can.bus_multiplexer import BroadcastReplies
from teds_provision.links.can.isotp import Pair
from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc.pieces import Piece, Requester, room
from tests.vectors.recipes_links import Mailbox, TagHandler, node

from . import vector_node as vn
from .vector_node import Entry

# -- NFC ---------------------------------------------------------------------------------------------------------------


@vn.cases("nfc_pieces")
def test_nfc_messages_as_published(document: Entry, entry: Entry) -> None:
    mailbox = Mailbox(entry["max_ndef"])
    from teds_provision.node.nfc.tnep import TnepTag

    tag = TnepTag(mailbox, TagHandler(node(entry["name"], entry["state"])), wt_int=20, n_wait=15)
    tag.start()
    shown = [mailbox.shown.get(timeout=60)]
    for step in entry["steps"]:
        assert len(step["message"]) // 2 <= entry["max_ndef"]
        if step["by"] == "station":
            shown.append(mailbox.write(bytes.fromhex(step["message"])))
        else:
            assert shown[-1].hex() == step["message"], step["note"]
    tag.stop()


@vn.cases("nfc_pieces")
def test_a_station_cuts_its_requests_as_published(document: Entry, entry: Entry) -> None:
    requester, done = None, 0
    for step, answer in zip(entry["steps"], entry["steps"][1:], strict=False):
        if "command" in step:
            first = piece_in(step)
            assert first is not None
            command = bytes.fromhex(step["command"])
            requester, wanted = Requester(first.transaction, command, room(entry["max_ndef"])), step["reply"]
        if requester is None or step["by"] != "station":
            continue
        assert piece_in(step) == requester.next(), step["note"]
        taken = piece_in(answer)
        assert taken is not None
        assert requester.handle_piece(taken)
        if requester.reply is not None:
            assert requester.reply.hex() == wanted
            requester, done = None, done + 1
    assert requester is None
    assert done == sum("command" in step for step in entry["steps"])


def piece_in(step: Entry) -> Piece | None:
    payload = tnep.external(message.decode(bytes.fromhex(step["message"])), tnep.TIM_TYPE)
    return None if payload is None else Piece.decode(payload)


def test_a_stranger_reads_the_initial_message() -> None:
    import ndef

    document = vn.load("nfc_pieces")
    for entry in document["entries"]:
        octets = bytes.fromhex(entry["steps"][0]["message"])
        service, ident = ndef.message_decoder(octets, known_types={})
        assert (service.type, ident.type) == ("urn:nfc:wkt:Tp", "urn:nfc:ext:teds-provision:id")
        uri = b"urn:nfc:xsn:teds-provision:tim"
        assert service.data == bytes([0x10, len(uri)]) + uri + bytes([0, 20, 15]) + entry["max_ndef"].to_bytes(2, "big")
        assert ident.data[1:11].hex() == document["uuid"]


# -- CAN ---------------------------------------------------------------------------------------------------------------


def reassembled(steps: list[Entry], by: str, identifier: str) -> bytes:
    """The one ISO-TP message of a sender, put together from ISO 15765-2 alone; checks number and padding."""
    octets, length, number = b"", 0, 0
    for step in steps:
        data = bytes.fromhex(step["data"])
        if step["by"] != by or step["id"] != identifier or data[0] >> 4 == 3:
            continue
        if data[0] >> 4 == 0:
            start, length = (1, data[0]) if data[0] else (2, data[1])
            octets = data[start:]
        elif data[0] >> 4 == 1:
            length, octets = (data[0] & 15) << 8 | data[1], data[2:]
        else:
            number = number + 1 & 15
            assert data[0] == 0x20 | number
            octets += data[1:]
    assert set(octets[length:]) <= {0xCC}, "padding"
    return octets[:length]


@vn.cases("can_frames")
def test_can_frames_hold_the_published_command_and_reply(document: Entry, entry: Entry) -> None:
    target, source = entry["node_address"], entry["station_address"]
    to_node = f"18dbff{source:02x}" if entry.get("functional") else f"18da{target:02x}{source:02x}"
    transaction = f"{entry['transaction']:02x}"
    assert reassembled(entry["steps"], "station", to_node).hex() == transaction + entry["command"]
    found = reassembled(entry["steps"], "node", f"18da{source:02x}{target:02x}")
    assert found.hex() == transaction + entry["reply"]
    for step in entry["steps"]:
        assert len(step["data"]) == 16 or entry["fd"]


@vn.cases("can_frames")
def test_our_ends_of_the_bus_send_the_published_frames(document: Entry, entry: Entry) -> None:
    if entry.get("functional"):
        return check_gathering(entry)
    station, address, fd = entry["station_address"], entry["node_address"], entry["fd"]
    sent: dict[str, list[Frame]] = {"station": [], "node": []}
    ends = {
        "station": Pair(station, address, sent["station"].append, fd=fd),
        "node": Pair(address, station, sent["node"].append, fd=fd),
    }
    ends["station"].send(bytes([entry["transaction"]]) + bytes.fromhex(entry["command"]))
    for step in entry["steps"]:
        by, other = step["by"], "node" if step["by"] == "station" else "station"
        for _ in range(40):
            ends[by].run()
            if sent[by]:
                break
        frame = sent[by].pop(0)
        assert (f"{frame.identifier:08x}", frame.data.hex(), frame.fd) == (step["id"], step["data"], step["fd"])
        ends[other].handle_frame(frame)
        if ends["node"].received() is not None:
            ends["node"].send(bytes([entry["transaction"]]) + bytes.fromhex(entry["reply"]))
    answer = ends["station"].received()
    assert answer is not None
    assert answer[1:].hex() == entry["reply"]
    return None


def check_gathering(entry: Entry) -> None:
    gathering = BroadcastReplies(entry["station_address"], entry["transaction"])
    flows = []
    for step in entry["steps"]:
        frame = Frame(int(step["id"], 16), bytes.fromhex(step["data"]), step["fd"])
        if step["by"] != "station":
            flow = gathering.add_frame(frame)
            flows += [flow.data.hex()] if flow else []
    published = [step["data"] for step in entry["steps"][1:] if step["by"] == "station"]
    assert flows == published
    assert bool(gathering.conflicts) == entry["conflict"]
    if not entry["conflict"]:
        assert gathering.answers == {entry["node_address"]: bytes.fromhex(entry["reply"])}


def test_a_node_on_a_bus_answers_the_published_functional_identify() -> None:
    import can

    from teds_provision.node.can.server import CanServer

    entry = vn.load("can_frames")["entries"][0]
    server = CanServer("virtual:published-vectors", TagHandler(node(entry["name"])))
    server.start()
    try:
        with can.Bus(interface="virtual", channel="published-vectors") as bus:
            for step in entry["steps"]:
                if step["by"] == "station":
                    data = bytes.fromhex(step["data"])
                    bus.send(can.Message(arbitration_id=int(step["id"], 16), data=data, is_extended_id=True))
                else:
                    got = bus.recv(timeout=60)
                    while got is not None and got.arbitration_id >> 8 == 0x1CFF00:  # its Announce, whenever it comes
                        got = bus.recv(timeout=60)
                    assert got is not None
                    assert (f"{got.arbitration_id:08x}", bytes(got.data).hex()) == (step["id"], step["data"])
    finally:
        server.stop()
