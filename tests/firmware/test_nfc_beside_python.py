"""The C node's tag beside the reference's: the same messages and frames of a reader, the same answers."""

from __future__ import annotations

import random
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest

from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc.message import EXTERNAL, WELL_KNOWN, NdefRecord
from teds_provision.links.nfc.pieces import Piece, room
from teds_provision.node.nfc.tags import ATS, IsoDepTag, NdefApplication, Type4Memory
from teds_provision.node.nfc.tnep import ExtraRecords, TnepTag, charge_records, out_of_band_record
from teds_provision.protocol.messages.frames import (
    Command,
    Function,
    Reason,
    decode_reply,
    refusal,
    security_command,
    update_teds,
    write_teds,
)
from teds_provision.protocol.operation.commands import PowerReply
from teds_provision.protocol.operation.stream_commands import CLOCK, ClockReply
from teds_provision.protocol.wire_agreement import StationAgreement
from tests.firmware.desk import CDesk
from tests.firmware.memory_node import MemoryNode
from tests.firmware.test_beside_python import Twins
from tests.protocol.desk import CREDENTIALS, NODE, UUID
from tests.vectors.recipes_links import Mailbox, TagHandler

pytestmark = pytest.mark.system

IDENTIFY = security_command(Function.IDENTIFY).encode()


class Taps:
    """Both nodes on one reader. The reference's worker has answered when its mailbox shows something."""

    def __init__(self, seed: int, max_ndef: int) -> None:
        self.dice = random.Random(seed)
        self.twins = Twins(seed)
        self.twins.c.close()
        self.c = self.twins.c = MemoryNode(
            lambda kind, size: NODE.secret() if kind == "i" else self.twins._draw("c", kind, size),
            self.twins.now,
            uuid=UUID,
        )
        self.c.has_nfc(max_ndef=max_ndef)
        self.twins.dice = {"py": random.Random(seed), "c": random.Random(seed)}
        self.twins.restart()
        self.max_ndef = max_ndef
        self.mailbox = Mailbox(max_ndef)
        self.tag = TnepTag(self.mailbox, TagHandler(self.twins.py), wt_int=4, n_wait=15)
        self.tag.start()
        self.transaction = 0
        self.writes = 0
        self.activate()

    def activate(self) -> None:
        """The field goes, and comes again."""
        for node in (self.tag.lost, lambda: self.c.nfc_field(False)):
            node()
        self.tag.activated()
        self.c.nfc_field(True)
        assert self.tag.ready(60)
        shown = b""
        while not self.mailbox.shown.empty():
            shown = self.mailbox.shown.get()
        assert self.c.nfc_message() == shown

    def write(self, octets: bytes) -> bytes:
        """A reader writes this; both show the same."""
        if not 0 < len(octets) <= self.max_ndef:
            return b""
        mine = self.mailbox.write(octets)
        assert self.c.nfc_write(octets).hex() == mine.hex(), octets.hex()
        self.writes += 1
        return mine

    def close(self) -> None:
        self.tag.stop()
        self.c.close()


@pytest.fixture
def taps() -> Iterator[Callable[[int, int], Taps]]:
    made: list[Taps] = []

    def make(seed: int, max_ndef: int) -> Taps:
        made.append(Taps(seed, max_ndef))
        return made[-1]

    yield make
    for taps in made:
        taps.close()


def command(dice: random.Random) -> bytes:
    """Return a command of a station, mostly sense."""
    return dice.choice(
        (
            lambda: IDENTIFY,
            lambda: security_command(Function.PROVE, dice.randbytes(32)).encode(),
            lambda: security_command(Function.LIST).encode(),
            lambda: Command(0, 1, 2, b"\x80" + dice.randrange(300).to_bytes(4, "big")).encode(),
            lambda: StationAgreement(CREDENTIALS, UUID).request().encode(),
            lambda: security_command(Function.RESET, bytes(32)).encode(),
            lambda: dice.randbytes(dice.randrange(1, 40)),
            lambda: dice.randbytes(dice.choice((1023, 1024, 1025, 3000))),
        )
    )()


def chunked(octets: bytes, dice: random.Random) -> bytes:
    """Return one record in chunks, as NDEF allows."""
    out, at, first = b"", 0, True
    while first or at < len(octets):
        part = octets[at : at + dice.randrange(1, 200)]
        at += len(part)
        last = at >= len(octets)
        head = (0x80 if first else 0) | (0x40 if last else 0x20) | 0x10 | (EXTERNAL if first else 6)
        name = tnep.TIM_TYPE if first else b"" if dice.random() < 0.95 else b"x"
        out += bytes((head, len(name), len(part))) + name + part
        first = False
    return out


def talk(taps: Taps) -> None:
    """One thing that a reader does."""
    dice = taps.dice
    what = dice.random()
    if what < 0.08:
        taps.activate()
        if dice.random() < 0.5:  # what was asked before the field went is forgotten
            taps.write(message.encode([tnep.select(tnep.SERVICE)]))
            taps.write(message.encode([tnep.payload_record(Piece(taps.transaction, 23, 0, b"").encode())]))
    if what < 0.25:
        taps.write(
            message.encode([tnep.select(dice.choice((tnep.SERVICE, tnep.SERVICE, b"", b"urn:nfc:sn:handover")))])
        )
        return
    if what < 0.3:
        taps.write(dice.randbytes(dice.randrange(1, 40)))
        return
    if dice.random() < 0.7:
        taps.transaction = (taps.transaction + 1) % 65536
    frame = command(dice)
    size = dice.choice((room(taps.max_ndef), room(taps.max_ndef), dice.randrange(1, room(taps.max_ndef))))
    size = max(size, len(frame) // 6)
    at = 0
    while at < len(frame):
        body = frame[at : at + size]
        more = at + len(body) < len(frame)
        own = Piece(taps.transaction, len(frame), at, body, answer=dice.random() < 0.03, more=more)
        payload = bytearray(own.encode())
        if dice.random() < 0.03:
            payload[dice.randrange(len(payload))] ^= 1
        name = tnep.TIM_TYPE.upper() if dice.random() < 0.1 else tnep.TIM_TYPE
        records = [NdefRecord(EXTERNAL, name, bytes(payload))]
        if dice.random() < 0.1:
            records.insert(
                dice.randrange(2), NdefRecord(WELL_KNOWN, b"T", dice.randbytes(dice.choice((0, 5, 300))), b"id")
            )
        octets = chunked(bytes(payload), dice) if dice.random() < 0.1 else message.encode(records)
        if dice.random() < 0.04:
            octets = octets[: dice.randrange(len(octets))]
        taps.write(octets)
        if dice.random() < 0.1:
            taps.write(octets)
        at += len(body) if dice.random() < 0.95 else 0
    for _ in range(dice.randrange(4)):
        ask = Piece(taps.transaction, dice.choice((len(frame), 23, 168)), dice.randrange(200), b"")
        taps.write(message.encode([tnep.payload_record(ask.encode())]))


@pytest.mark.parametrize("max_ndef", [4160, 499, 284, 200])
def test_both_tags_answer_a_random_reader_alike(taps: Callable[[int, int], Taps], max_ndef: int) -> None:
    for seed in range(6):
        reader = taps(seed, max_ndef)
        for _ in range(100):
            talk(reader)
        assert reader.writes > 60


@pytest.mark.parametrize("address", [None, bytes.fromhex("c0ffee123456")], ids=["wired", "in the air"])
@pytest.mark.parametrize("power", [(0, 50), (1, 0xFF), (1, 0), (1, 87), (5, 100), (3, 20), (None, 0)])
def test_both_show_their_charge_and_where_they_are_in_the_air(
    power: tuple[int | None, int], address: bytes | None
) -> None:
    flags, level = power
    node = MemoryNode(lambda kind, size: NODE.secret() if kind == "i" else bytes(size), lambda: 0.0, uuid=UUID)
    node.has_nfc(max_ndef=160)
    if flags is not None:
        node.has_battery(flags, level)
    if address is not None:
        node.is_in_the_air(address)
    assert node.start() == 0
    charge = charge_records(PowerReply(flags or 0, None if level == 0xFF else level))
    extras = ExtraRecords(
        before=lambda: charge,
        after=lambda: (out_of_band_record(address, random=True),) if address is not None else (),
    )
    twins = Twins(1)
    twins.memory.state = replace(twins.flash, can_address=node.can_address)
    twins.restart()
    mailbox = Mailbox(160)
    tag = TnepTag(mailbox, TagHandler(twins.py), wt_int=4, n_wait=15, extras=extras)
    tag.start()
    node.nfc_field(True)
    assert node.nfc_message().hex() == mailbox.shown.get().hex()
    tag.stop()
    node.close()
    twins.c.close()


def reader_frame(dice: random.Random, number: int, length: int) -> bytes:
    """Return one ISO-DEP block of a reader: mostly in order."""
    apdu = dice.choice(
        (
            bytes.fromhex("00A4040007D276000085010100"),
            bytes.fromhex("00A4000C02E103"),
            bytes.fromhex("00A4000C02E104"),
            bytes.fromhex("00A4000C02E105"),
            bytes.fromhex("00B000000F"),
            b"\x00\xb0" + dice.randrange(length + 3).to_bytes(2, "big") + bytes((dice.choice((0, 2, 15, 251)),)),
            b"\x00\xd6\x00\x00\x02" + bytes(2),
            b"\x00\xd6\x00\x00\x01\x01",
            b"\x00\xd6" + dice.choice((2, 2, 100, 6000)).to_bytes(2, "big") + bytes((20,)) + dice.randbytes(20),
            b"\x00\xd6\x00\x00\x02" + dice.choice((6, 20, 60000)).to_bytes(2, "big"),
            dice.randbytes(dice.randrange(1, 12)),
        )
    )
    what = dice.random()
    if what < 0.75:
        return bytes((0x02 | number,)) + apdu
    if what < 0.85:
        return bytes((0x12 | number,)) + apdu[: dice.randrange(len(apdu)) + 1]
    if what < 0.95:
        return bytes((dice.choice((0xA2, 0xB2)) | dice.randrange(2),))
    if what < 0.97:  # of another card: with CID, with NAD
        return bytes((dice.choice((0x0A, 0x06, 0x0E, 0x1A, 0xAA, 0xBA, 0xCA)) | number, 0)) + apdu
    return dice.choice((b"\xc2", b"\xf2\x01", bytes((dice.choice((0x00, 0x40, 0xD0, 0xFF)),)) + dice.randbytes(2)))


def test_the_initial_message_is_there_from_the_start() -> None:
    """Before any field: a chip may show it to a reader by itself."""
    node = MemoryNode(lambda kind, size: NODE.secret() if kind == "i" else bytes(size), lambda: 0.0, uuid=UUID)
    node.has_nfc(max_ndef=499)
    assert node.start() == 0
    service, identity = message.decode(node.nfc_message())
    assert service.is_well_known(b"Tp")
    uri = b"urn:nfc:xsn:teds-provision:tim"
    assert service.payload == b"\x10" + bytes((len(uri),)) + uri + b"\0\x04\x0f\x01\xf3"
    assert identity.type == b"teds-provision:id"
    assert identity.payload[:12] == b"\1" + UUID + b"\0"
    node.close()


def test_what_a_deselected_tag_and_one_that_was_asked_nothing_reply() -> None:
    node = MemoryNode(lambda kind, size: NODE.secret() if kind == "i" else bytes(size), lambda: 0.0, uuid=UUID)
    node.has_nfc()
    assert node.start() == 0
    rats = bytes.fromhex("e080")
    card = IsoDepTag(rats, NdefApplication(Type4Memory(1000), lambda seconds: True))
    assert node.nfc_frame(rats) == ATS
    for block in ("c2", "ca", "a2", "a3", "b2", "b3", "0200a4040007d276000085010100", "a3", "12a4", "a2", "a3", "c2"):
        assert node.nfc_frame(bytes.fromhex(block)) == card.answer(bytes.fromhex(block)), block
    node.close()


def test_a_reader_that_began_to_write_is_not_disturbed_by_a_new_initial_message() -> None:
    """NFC Forum T4T: a length of 0, the message, then its length; Identify changes in between (a new CAN address)."""
    node = MemoryNode(lambda kind, size: NODE.secret() if kind == "i" else bytes(size), lambda: 0.0, uuid=UUID)
    node.has_nfc()
    assert node.start() == 0
    number = 0

    def apdu(octets: bytes) -> bytes | None:
        nonlocal number
        answer = node.nfc_frame(bytes((0x02 | number,)) + octets)
        number ^= 1
        return answer[1:] if answer is not None else None

    node.nfc_frame(bytes.fromhex("e080"))
    apdu(bytes.fromhex("00a4040007d276000085010100"))
    assert apdu(bytes.fromhex("00a4000c02e104")) == b"\x90\x00"
    assert apdu(bytes.fromhex("00d60000020000")) == b"\x90\x00"
    node.take_can_address(99)
    node.poll()
    assert node.nfc_message() == b""
    octets = message.encode([tnep.select(tnep.SERVICE)])
    assert apdu(b"\0\xd6\0\2" + bytes((len(octets),)) + octets) == b"\x90\x00"
    node.poll()
    assert apdu(b"\0\xd6\0\0\2" + len(octets).to_bytes(2, "big")) == b"\x90\x00"
    node.poll()
    assert node.nfc_message() == message.encode([tnep.status(tnep.SUCCESS)])
    node.close()


@pytest.mark.parametrize("selection", [b"", b"\0", b"\x05abc", b"\x03abc", b"\x03abcd", b"\xff"], ids=bytes.hex)
def test_a_selection_that_does_not_add_up(taps: Callable[[int, int], Taps], selection: bytes) -> None:
    """Alone, twice, and behind a request."""
    reader = taps(1, 499)
    odd = NdefRecord(WELL_KNOWN, b"Ts", selection)
    reader.write(message.encode([odd]))
    reader.write(message.encode([odd, tnep.select(tnep.SERVICE)]))
    reader.write(message.encode([tnep.select(tnep.SERVICE), odd]))
    piece = tnep.payload_record(Piece(1, 6, 0, IDENTIFY).encode())
    reader.write(message.encode([piece, odd]))
    reader.write(message.encode([NdefRecord(WELL_KNOWN, b"WLCINF", b"")]))
    reader.write(message.encode([piece, piece]))
    reader.write(message.encode([piece]))


@pytest.mark.parametrize("behind", [b"\0", b"\x10\0\0", bytes(9)], ids=bytes.hex)
def test_octets_behind_the_last_record_make_a_message_garbled(taps: Callable[[int, int], Taps], behind: bytes) -> None:
    reader, select = taps(4, 499), message.encode([tnep.select(tnep.SERVICE)])
    wrong = reader.write(select + behind)
    assert wrong != bytes.fromhex("d10201546500")
    assert reader.write(select) == bytes.fromhex("d10201546500")


def payload(head: str, body: bytes) -> bytes:
    """Return a payload record with a right CRC: version, flags, transaction, total, offset, and the body."""
    octets = bytes.fromhex(head)
    return octets + zlib.crc32(octets + body).to_bytes(4, "big") + body


def test_what_a_payload_record_may_not_be(taps: Callable[[int, int], Taps]) -> None:
    """Its version is 1, its parts lie within the whole, it is no answer: else Te 80; nothing of it is kept."""
    reader = taps(3, 499)
    select = message.encode([tnep.select(tnep.SERVICE)])
    held_nothing = payload("01 01 0009 0006 0000", b"")

    def answer(octets: bytes) -> bytes:
        return reader.write(message.encode([tnep.payload_record(octets)]))

    assert reader.write(select) == bytes.fromhex("d10201546500")
    for wrong in (
        payload("00 00 0009 0006 0000", IDENTIFY),
        payload("02 00 0009 0006 0000", IDENTIFY),
        payload("01 01 0009 0006 0000", IDENTIFY),
        payload("01 00 0009 0005 0000", IDENTIFY),
        payload("01 00 0009 0006 0001", IDENTIFY),
        payload("01 00 0009 0006 0000", IDENTIFY)[:-1] + b"\1",
        payload("01 00 0009 0006 0000", b"")[:11],
    ):
        assert answer(wrong) == bytes.fromhex("d10201546580"), wrong.hex()
    assert answer(payload("01 00 0009 0006 0000", b"")).endswith(held_nothing)
    assert answer(payload("01 02 0009 0006 0000", IDENTIFY[:4])).endswith(payload("01 01 0009 0006 0004", b""))
    assert answer(payload("01 02 0009 0007 0004", IDENTIFY[4:])).endswith(payload("01 01 0009 0007 0000", b""))
    reply = answer(payload("01 00 0009 0006 0000", IDENTIFY))
    assert payload("01 01 0009 001a 0000", b"\1\0\x17" + reply[-23:]) == reply[-38:]


SELECTED, ERROR, GARBLED = (bytes.fromhex(f"d102015465{status}") for status in ("00", "01", "80"))


def test_a_reader_that_activates_the_tag_anew_selects_the_service_anew(taps: Callable[[int, int], Taps]) -> None:
    """Its field was never gone: it sends RATS once more, and sees the initial message."""
    reader = taps(4, 499)
    piece = message.encode([tnep.payload_record(payload("01 00 0009 0006 0000", IDENTIFY))])
    assert reader.write(message.encode([tnep.select(tnep.SERVICE)])) == SELECTED
    assert len(reader.write(piece)) > 60
    reader.tag.activated()
    reader.c.nfc_field(True)
    assert reader.tag.ready(60)
    while not reader.mailbox.shown.empty():
        assert reader.mailbox.shown.get() == reader.c.nfc_message()
    assert reader.write(piece) == ERROR


def test_a_message_that_is_not_answered_yet_goes_with_a_new_activation() -> None:
    node = MemoryNode(lambda kind, size: NODE.secret() if kind == "i" else bytes(size), lambda: 0.0, uuid=UUID)
    node.has_nfc()
    assert node.start() == 0
    rats, select = bytes.fromhex("e080"), message.encode([tnep.select(tnep.SERVICE)])
    assert node.nfc_frame(rats) == ATS
    for block in ("0200a4040007d276000085010100", "0300a4000c02e104"):
        assert node.nfc_frame(bytes.fromhex(block)) == bytes.fromhex(block[:2] + "9000")
    initial = node.nfc_message()
    update = b"\0\xd6\0\0" + bytes((2 + len(select),)) + len(select).to_bytes(2, "big") + select
    assert node.nfc_frame(b"\x02" + update) == b"\x02\x90\x00"
    assert node.nfc_frame(rats) == ATS
    node.poll()
    assert node.nfc_message() == initial
    assert node.nfc_frame(b"\x02\0\xb0\0\0\2") == b"\x02\x69\x86", "nor is the application selected any more"
    node.close()


_TS, _TIM = tnep.select(tnep.SERVICE), tnep.payload_record(b"")
_PIECE = payload("01 00 0009 0006 0000", IDENTIFY)


@pytest.mark.parametrize(
    ("records", "shown"),
    [
        ([NdefRecord(WELL_KNOWN, b"Xs", _TS.payload)], ERROR),
        ([NdefRecord(WELL_KNOWN, b"ts", _TS.payload)], ERROR),
        ([NdefRecord(WELL_KNOWN, b"Tx", _TS.payload)], ERROR),
        ([NdefRecord(WELL_KNOWN, b"Tss", _TS.payload)], ERROR),
        ([NdefRecord(WELL_KNOWN, b"T", _TS.payload)], ERROR),
        ([NdefRecord(EXTERNAL, b"Ts", _TS.payload)], ERROR),
        ([_TS, NdefRecord(WELL_KNOWN, b"Ts", tnep.select(b"urn:nfc:xsn:other:one").payload)], SELECTED),
        ([_TS, NdefRecord(EXTERNAL, b"x" + _TIM.type[1:], _PIECE)], SELECTED),
    ],
    ids=["first letter", "case", "last letter", "longer", "shorter", "external", "the first counts", "beside"],
)
def test_a_selection_is_a_ts_record_and_no_other(
    taps: Callable[[int, int], Taps], records: list[NdefRecord], shown: bytes
) -> None:
    assert taps(5, 499).write(message.encode(records)) == shown


@pytest.mark.parametrize(
    ("name", "kind", "ours"),
    [
        (_TIM.type, EXTERNAL, True),
        (_TIM.type.upper(), EXTERNAL, True),
        (b"T" + _TIM.type[1:], EXTERNAL, True),
        (_TIM.type[:-1] + b"M", EXTERNAL, True),
        (b"s" + _TIM.type[1:], EXTERNAL, False),
        (_TIM.type[:-1] + b"n", EXTERNAL, False),
        (_TIM.type[:-1], EXTERNAL, False),
        (_TIM.type + b"m", EXTERNAL, False),
        (_TIM.type, WELL_KNOWN, False),
    ],
)
def test_a_request_lies_in_a_record_of_this_external_type(
    taps: Callable[[int, int], Taps], name: bytes, kind: int, ours: bool
) -> None:
    """External types are compared without case (NFC Forum RTD)."""
    reader = taps(5, 499)
    assert reader.write(message.encode([_TS])) == SELECTED
    shown = reader.write(message.encode([NdefRecord(kind, name, _PIECE)]))
    assert len(shown) > 60 if ours else shown == ERROR


@pytest.mark.parametrize(
    "octets",
    [
        "d1",
        "d102",
        "91 02 00 54 73 11",  # a record that begins the message, then an octet of the next one
        "91 02 00 54 73 11 00 00 11",
        "91 02 00 54 73 11 00 00",  # whole records, none of which ends the message
        "d1 02 05 54 73 00",
        "d9 02 00 54 73",
        "d9 02 00 01 54 73",
        "c1 02 00 00 00 54 73",
        "51 02 01 54 73 00",  # does not begin a message
        "91 02 01 54 73 00 d1 00 00",  # begins it again
    ],
)
def test_a_message_that_is_cut_off_is_garbled(taps: Callable[[int, int], Taps], octets: str) -> None:
    reader = taps(6, 499)
    assert reader.write(message.encode([_TS])) == SELECTED
    assert reader.write(bytes.fromhex(octets)) == GARBLED


def test_half_a_request_and_a_reply_go_with_the_field(taps: Callable[[int, int], Taps]) -> None:
    reader = taps(4, 499)
    select = message.encode([tnep.select(tnep.SERVICE)])
    more = message.encode([tnep.payload_record(payload("01 00 0009 0006 0000", b""))])
    for piece, held in ((IDENTIFY[:4], "0004"), (IDENTIFY, "")):
        reader.write(select)
        reader.write(message.encode([tnep.payload_record(payload("01 00 0009 0006 0000", piece))]))
        answer = reader.write(more)
        assert answer.endswith(payload(f"01 01 0009 0006 {held}", b"")) if held else len(answer) > 60
        reader.activate()
        assert reader.write(more) == bytes.fromhex("d10201546501"), "nor is the service selected any more"
        reader.write(select)
        assert reader.write(more).endswith(payload("01 01 0009 0006 0000", b""))
        reader.activate()


@pytest.fixture
def keyed() -> Iterator[CDesk]:
    """A node with a tag, in a reader's field, which has agreed on a key there."""
    desk = CDesk()
    desk.node.has_nfc()
    desk.restart()
    desk.node.nfc_field(True)
    desk.agree()
    yield desk
    CDesk.close_all()


def test_the_session_of_a_reader_and_its_request_end_with_the_field(keyed: CDesk) -> None:
    agreement = StationAgreement(CREDENTIALS, UUID)
    assert keyed.open().sealed(security_command(Function.IDENTIFY)).ok
    session = keyed.session
    assert session is not None
    assert keyed.plain(agreement.request()).ok
    keyed.node.nfc_field(False)
    keyed.node.nfc_field(True)
    assert keyed.plain(session.seal(security_command(Function.IDENTIFY))) == refusal(Reason.WRONG_STATE)
    assert keyed.plain(security_command(Function.CONFIRM, bytes(16))) == refusal(Reason.WRONG_STATE)


@pytest.mark.parametrize("what", ["state and epoch", "address", "sequence"])
def test_the_id_record_is_renewed_whenever_identify_changes(keyed: CDesk, what: str) -> None:
    keyed.open(link="can:f1")
    keyed.node.nfc_field(False)
    keyed.node.nfc_field(True)
    before = keyed.node.nfc_message()
    if what == "address":
        keyed.node.take_can_address(99)
    elif what == "sequence":
        assert keyed.sealed(write_teds(0, 128, 0, keyed.signed({})), link="can:f1").ok
        assert keyed.sealed(update_teds(0, 128), link="can:f1").ok
    else:
        keyed.agree(link="can:f1", tapped=True)
    keyed.node.poll()
    shown = keyed.node.nfc_message()
    assert shown != before
    assert tnep.external(message.decode(shown), tnep.ID_TYPE) == keyed.node.identity().encode()


@pytest.mark.parametrize("fsdi", [0, 2, 8])
def test_both_tags_answer_a_readers_frames_alike(fsdi: int) -> None:
    """ISO-DEP and the APDUs alone: what the message says is the C node's in both."""
    dice = random.Random(fsdi)
    for _ in range(40):
        node = MemoryNode(lambda kind, size: NODE.secret() if kind == "i" else b"\x01" * size, lambda: 0.0, uuid=UUID)
        node.has_nfc(max_ndef=1000)
        assert node.start() == 0
        rats = bytes((0xE0, fsdi << 4))
        memory = Type4Memory(1000)
        card = IsoDepTag(rats, NdefApplication(memory, lambda seconds: True))
        assert node.nfc_frame(rats) == ATS
        memory.put(node.nfc_message())
        number = 0
        for _ in range(60):
            frame = reader_frame(dice, number, len(node.nfc_message()))
            came: list[bytes] = []
            memory.written = came.append
            mine, theirs = card.answer(frame), node.nfc_frame(frame)
            assert (mine or b"").hex() == (theirs or b"").hex(), frame.hex()
            if frame[0] & 0xEE == 0x02:
                number ^= 1
            if came:
                node.poll()
                memory.put(node.nfc_message())
        node.close()


def test_a_clock_over_nfc_was_received_when_its_message_was_whole_and_sent_when_it_was_answered(keyed: CDesk) -> None:
    """The reader writes it, and the node's loop takes it up a quarter of a second later."""
    keyed.node.add_channel(1, 0, 2)
    keyed.restart()
    keyed.open()
    session, node = keyed.session, keyed.node
    assert session is not None
    frame = session.seal(CLOCK).encode()
    piece = message.encode([tnep.payload_record(Piece(9, len(frame), 0, frame).encode())])
    node.nfc_write(message.encode([tnep.select(tnep.SERVICE)]))
    node.nfc_frame(bytes.fromhex("e080"))
    for number, apdu in enumerate(("00a4040007d276000085010100", "00a4000c02e104")):
        assert node.nfc_frame(bytes((0x02 | number,)) + bytes.fromhex(apdu)) == bytes((0x02 | number, 0x90, 0x00))
    node.nfc_write(message.encode([tnep.select(tnep.SERVICE)]))
    keyed.now = 7.0
    update = b"\0\xd6\0\0" + bytes((2 + len(piece),)) + len(piece).to_bytes(2, "big") + piece
    assert node.nfc_frame(b"\x02" + update) == b"\x02\x90\x00"
    keyed.now = 7.25
    node.poll()
    (_, answer) = message.decode(node.nfc_message())
    inner = session.unseal(decode_reply(Piece.decode(answer.payload).body).payload)
    told = ClockReply.decode(inner.payload)
    assert (told.received, told.sent) == (7_000_000_000, 7_250_000_000)
