"""KeyAgreement 2 between the product and a stranger, either way round; nodes with one fault each."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

from teds_provision.errors import BadDataError, GarbledError, NotAuthenticError, PolicyError, TedsProvisionError
from teds_provision.links import LINKS, Capabilities, Contact
from teds_provision.protocol.messages.identity import Identity
from teds_provision.provisioning.agree import AgreeResult, agree
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.identify import identify
from teds_provision.station.station import Station as Ours
from teds_provision.station.store.records import WhitelistEntry
from tests.bench import Board
from tests.strangers.agreement import FAULTS, Node, Station
from tests.strangers.crypto import CURVE, point

UUID = bytes.fromhex("00112233445566778899")


@dataclass
class Desk:
    """A stranger's node on the product's reader."""

    node: Node
    via: str = "nfc"
    frames: list[bytes] = field(default_factory=list)

    @property
    def capabilities(self) -> Capabilities:
        return LINKS[self.via].capabilities

    def exchange(self, frame: bytes) -> bytes:
        self.frames.append(frame)
        return self.node.handle(frame)

    def close(self) -> None:
        pass


def run(station: Ours, node: Node) -> AgreeResult:
    station.pins.put(WhitelistEntry(node.uuid))
    contact = Contact(Identity.decode(node.hello(b"")), Desk(node), tag_uid=b"\x04" + bytes(6))
    with Conversation(contact, notice=lambda notice: None) as talk:
        return agree(station, talk, identify(station, talk))


def test_a_strangers_node_gets_a_key_of_ours(station: Ours) -> None:
    node = Node(UUID)
    agreed = run(station, node)
    assert (agreed.epoch, node.epoch, node.requests) == (1, 1, 1)
    (held,) = station.keys.unwrapped(UUID)
    assert held.key == node.key


TAG, PROOF, POINT = "tagN", "does not hold the key that it shows", "one-time key"
WHAT: dict[str, tuple[type[TedsProvisionError], str, int]] = {
    "sigN without the 00 of its label": (NotAuthenticError, PROOF, 1),
    "sigN as a proof of Prove": (NotAuthenticError, PROOF, 1),
    "sigN by another key": (NotAuthenticError, PROOF, 1),
    "sigN with a high s": (NotAuthenticError, PROOF, 1),
    "sigN as DER": (GarbledError, "octets, not 165", 1),
    "halves of Z swapped": (NotAuthenticError, TAG, 2),
    "Z of the identity key": (NotAuthenticError, TAG, 2),
    "salt and ikm swapped": (NotAuthenticError, TAG, 2),
    "tagN of the station's label": (NotAuthenticError, TAG, 2),
    "tagN with 00 behind its label": (NotAuthenticError, TAG, 2),
    "En not in T": (NotAuthenticError, TAG, 2),
    "digest over the data block only": (NotAuthenticError, TAG, 2),
    "En is P(node)": (NotAuthenticError, POINT, 1),
    "En is P(station)": (NotAuthenticError, POINT, 1),
    "En is E": (NotAuthenticError, POINT, 1),
    "En off the curve": (NotAuthenticError, POINT, 1),
    "the same epoch again": (PolicyError, "offers key epoch 0", 1),
    "the epoch little-endian": (NotAuthenticError, "offered key epoch 16777216 but reports 1", 1),
    "a reply without its last octet": (GarbledError, "164 octets, not 165", 1),
    "the reply to the Request before": (NotAuthenticError, TAG, 2),
    "the TEDS changes with every Read": (NotAuthenticError, TAG, 2),
    "field 102 is signed anew for every Read": (NotAuthenticError, TAG, 2),
    "KeyAgreement 1": (BadDataError, "KeyAgreement 1", 0),
    "KeyAgreement 1 in the reply alone": (GarbledError, "octets, not 165", 1),
}


@pytest.mark.parametrize("fault", sorted(FAULTS))
def test_a_node_with_a_fault_in_its_agreement_is_refused_and_named(station: Ours, fault: str) -> None:
    error, words, requests = WHAT[fault]
    node = Node(UUID, fault)
    with pytest.raises(error, match=words.replace("(", r"\(").replace(")", r"\)")):
        run(station, node)
    assert node.requests == requests
    if fault != "the epoch little-endian":  # which shows after its Confirm
        assert (node.key, station.keys.keys_of(UUID)) == (b"", [])


# -- a stranger's station, our node ------------------------------------------------------------------------------------


def command(function: int, payload: bytes = b"") -> bytes:
    return b"\0\0\x80" + bytes([function]) + len(payload).to_bytes(2, "big") + payload


def ask(board: Board, function: int, payload: bytes = b"", link: str = "nfc") -> bytes:
    return board.tim.handle(command(function, payload), link=link, tapped=True)


def reason(reply: bytes) -> int:
    assert reply[:3] == b"\0\0\1", reply.hex()
    return reply[3]


def test_a_strangers_station_agrees_with_our_node_and_opens_a_session() -> None:
    board, station = Board(), Station()
    for epoch in (1, 2):
        one_time = ec.generate_private_key(CURVE)
        payload = station.request(point(one_time))
        reply = ask(board, 1, payload)[3:]
        agreed = station.take(payload, one_time, reply, board.uuid, board.state.security_teds())
        assert ask(board, 2, agreed.confirm) == b"\1\0\0"
        assert (board.state.key, board.state.epoch, agreed.epoch) == (agreed.key, epoch, epoch)
    c = ask(board, 3)[3:]
    opening, own = station.open(agreed.key, board.uuid, c)
    answer = ask(board, 3, opening)[3:]
    assert len(answer) == 81
    again = ask(board, 3)[3:]
    assert (int.from_bytes(again, "big") - int.from_bytes(c, "big")) % 2**64 == 1, "c counts good macs"
    assert reason(ask(board, 3, opening)) == 12
    station.opened(agreed.key, board.uuid, opening, own, answer)


def test_what_a_strangers_station_may_not_do() -> None:
    board, station = Board(), Station()
    one_time = ec.generate_private_key(CURVE)
    good = station.request(point(one_time))
    assert reason(ask(board, 1, good[:-1])) == 4
    assert reason(ask(board, 1, good[:194] + point(station.key))) == 15
    assert reason(ask(board, 1, good[:194] + board.key.point)) == 15
    first, second = ask(board, 1, good)[3:], ask(board, 1, good)[3:]
    assert first[20:85] != second[20:85], "En is for one Request"
    teds = board.state.security_teds()
    old = station.take(good, one_time, first, board.uuid, teds)
    new = station.take(good, one_time, second, board.uuid, teds)
    assert reason(ask(board, 2, new.confirm, link="can:f1")) == 2
    assert reason(ask(board, 2, old.confirm)) == 12
    assert reason(ask(board, 2, new.confirm)) == 2
    third = station.take(good, one_time, ask(board, 1, good)[3:], board.uuid, teds)
    assert ask(board, 9, bytes(32))[:1] == b"\1", "a proof, in factory state"
    assert reason(ask(board, 2, third.confirm)) == 2, "the Reset ended it"
    assert board.state.key is None
