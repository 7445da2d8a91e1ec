"""The emulated tags octet by octet, and both halves of TNEP against each other in memory."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import Garbled, NodeSilent, UsageFailure
from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc.pieces import Piece
from teds_provision.links.nfc.poller import Poller
from teds_provision.node.nfc import charging
from teds_provision.node.nfc.air import ETU, Air, answer_seconds, command_seconds
from teds_provision.node.nfc.tnep import TnepTag
from teds_provision.node.nfc.type2 import Type2Memory
from teds_provision.node.nfc.type4 import IsoDepTag, NdefApplication, Type4Memory
from teds_provision.protocol.operation.commands import Power, PowerFlag
from tests.pace import best_of

SELECT_APPLICATION = bytes.fromhex("00A4040007D276000085010100")
SELECT_CC, SELECT_NDEF = bytes.fromhex("00A4000C02E103"), bytes.fromhex("00A4000C02E104")
UID = bytes.fromhex("02112233445566")


class Handler:
    """A node that counts what it runs and can be held up."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []
        self.lost_lines: list[str] = []
        self.go = threading.Event()
        self.go.set()
        self.entered = threading.Event()

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        self.entered.set()
        self.go.wait(60)
        self.frames.append(frame)
        return b"\x01\x00\x00" + bytes((len(self.frames),)) + frame

    def lost(self, link: str) -> None:
        self.lost_lines.append(link)

    def identify(self) -> bytes:
        return bytes(22) + bytes((len(self.frames),))

    def can_address(self) -> int:
        return 1

    def take_can_address(self, address: int) -> None:
        raise AssertionError

    def actuator_claimed(self) -> bool:
        return False


class Mailbox:
    """The reader's view of a Type 4 file, without frames."""

    def __init__(self, memory: Type4Memory) -> None:
        self.memory = memory

    def read(self) -> bytes:
        size = int.from_bytes(self.memory.read(b"\xe1\x04", 0, 2) or b"", "big")
        return self.memory.read(b"\xe1\x04", 2, size) or b""

    def write(self, octets: bytes) -> None:
        assert self.memory.write(0, len(octets).to_bytes(2, "big") + octets)


class Desk:
    """A node's tag on a reader, in memory."""

    def __init__(self, max_ndef: int = 500) -> None:
        self.handler = Handler()
        self.mailbox = Mailbox(Type4Memory(max_ndef))
        self.tag = TnepTag(self.mailbox.memory, self.handler, wt_int=4, n_wait=15)
        self.tag.start()
        self.tag.activated()
        assert self.tag.ready(5)

    def poller(self) -> Poller:
        service = tnep.our_service(message.decode(self.mailbox.read()))
        assert service is not None
        return Poller(self.mailbox, service)

    def say(self, octets: bytes) -> tuple[message.Record, ...]:
        """Write one message and return the answer to it."""
        self.mailbox.write(octets)
        until = time.monotonic() + 5
        while not (answer := self.mailbox.read()):
            assert time.monotonic() < until
            time.sleep(0.001)
        return message.decode(answer)


@pytest.fixture
def desk() -> Iterator[Desk]:
    desk = Desk()
    yield desk
    desk.tag.stop()


def select() -> bytes:
    return message.encode([tnep.select(tnep.SERVICE)])


def request(piece: Piece) -> bytes:
    return message.encode([tnep.payload_record(piece.encode())])


def test_the_initial_message_offers_the_service_and_says_who_it_is(desk: Desk) -> None:
    records = message.decode(desk.mailbox.read())
    assert tnep.our_service(records) == tnep.ServiceParameters(tnep.SERVICE, 4, 15, 500)
    assert tnep.external(records, tnep.ID_TYPE) == desk.handler.identify()


def test_a_frame_before_the_selection_is_a_protocol_error(desk: Desk) -> None:
    assert tnep.status_of(desk.say(request(Piece(1, 4, 0, b"abcd")))) == tnep.PROTOCOL_ERROR
    assert desk.handler.frames == []


def test_a_message_that_is_nonsense_is_refused(desk: Desk) -> None:
    assert tnep.status_of(desk.say(select())) == tnep.SUCCESS
    torn = bytearray(request(Piece(1, 4, 0, b"abcd")))
    torn[-1] ^= 1
    for nonsense in (bytes(torn), b"\xff\xff\xff", request(Piece(1, 4, 0, b"abcd", answer=True))):
        assert tnep.status_of(desk.say(nonsense)) == tnep.GARBLED_REQUEST
    assert desk.handler.frames == []


def test_selecting_another_service_gives_the_initial_message(desk: Desk) -> None:
    for uri in (b"urn:nfc:sn:handover", b""):
        desk.say(select())
        assert tnep.our_service(desk.say(message.encode([tnep.select(uri)]))) is not None


def test_a_repeated_frame_is_not_run_again_until_the_field_was_gone(desk: Desk) -> None:
    frame = bytes.fromhex("000080010000")
    first = desk.poller().transact(7, frame)
    again = Poller(desk.mailbox, tnep.ServiceParameters(tnep.SERVICE, 4, 15, 500)).transact(7, frame)
    assert first == again
    assert len(desk.handler.frames) == 1
    desk.tag.lost()
    desk.tag.activated()
    assert desk.tag.ready(5)
    assert desk.handler.lost_lines == ["nfc"]
    assert desk.poller().transact(7, frame) != first
    assert len(desk.handler.frames) == 2


def test_an_answer_that_is_ready_after_the_field_was_gone_is_not_put(desk: Desk) -> None:
    desk.say(select())
    desk.handler.go.clear()
    desk.mailbox.write(request(Piece(1, 4, 0, b"abcd")))
    assert desk.mailbox.read() == b""  # more time, please
    assert desk.handler.entered.wait(60)
    desk.tag.lost()
    desk.tag.activated()
    assert not desk.tag.ready(0.05)
    desk.handler.go.set()
    assert desk.tag.ready(5)
    records = message.decode(desk.mailbox.read())
    assert tnep.external(records, tnep.ID_TYPE) == desk.handler.identify()


@given(st.lists(st.binary(min_size=1, max_size=80), max_size=8))
def test_no_message_upsets_the_node(messages: list[bytes]) -> None:
    desk = Desk(120)
    try:
        for octets in messages:
            desk.say(octets)
        desk.tag.activated()
        assert desk.tag.ready(5)
        assert desk.poller().transact(1, b"abcd")[4:] == b"abcd"
    finally:
        desk.tag.stop()


@given(st.binary(min_size=1, max_size=1500), st.integers(56, 700))
def test_no_message_is_longer_than_announced(frame: bytes, max_ndef: int) -> None:
    desk = Desk(max_ndef)
    try:
        written = desk.mailbox.write

        def checked(octets: bytes) -> None:
            assert len(octets) <= max_ndef
            written(octets)

        desk.mailbox.write = checked  # type: ignore[method-assign]
        assert desk.poller().transact(1, frame)[4:] == frame
    finally:
        desk.tag.stop()


class Script:
    """Someone else's node: what stands in its mailbox at each read, the last of it for ever."""

    def __init__(self, *reads: bytes) -> None:
        self.reads = list(reads)
        self.written: list[bytes] = []
        self.now = 0.0

    def read(self) -> bytes:
        return self.reads.pop(0) if len(self.reads) > 1 else self.reads[0]

    def write(self, octets: bytes) -> None:
        self.written.append(octets)

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def transact(self, *, wt_int: int = 20, n_wait: int = 15, max_ndef: int = 300) -> bytes:
        service = tnep.ServiceParameters(tnep.SERVICE, wt_int, n_wait, max_ndef)
        return Poller(self, service, clock=lambda: self.now, sleep=self.sleep).transact(3, b"abcd")


OK = message.encode([tnep.status(0)])


def answer(piece: Piece) -> bytes:
    return message.encode([tnep.payload_record(piece.encode()), tnep.status(0)])


GOOD = answer(Piece(3, 2, 0, b"ok", answer=True))


@pytest.mark.parametrize(
    "reads",
    [
        [b"", b"", OK, b"", GOOD],
        [select(), OK, request(Piece(3, 4, 0, b"abcd")), GOOD],  # our own message still there
        [OK, b"\xd1torn", GOOD],
        [OK, GOOD[:-3], GOOD],
        [OK, answer(Piece(2, 2, 0, b"no", answer=True)), GOOD],  # another transaction
        [OK, answer(Piece(3, 2, 0, b"o", answer=True, more=True)), answer(Piece(3, 2, 1, b"k", answer=True))],
        [OK, *[b""] * 100, GOOD],  # far past N_wait, within 5 s at an interval of 32 ms
    ],
)
def test_a_station_bears_with_other_peoples_nodes(reads: list[bytes]) -> None:
    script = Script(*reads)
    assert script.transact(n_wait=0) == b"ok"


@pytest.mark.parametrize("wt_int", [0, 4, 20, 36, 44])
def test_a_station_gives_up_after_its_own_5_s(wt_int: int) -> None:
    script = Script(b"")
    with pytest.raises(NodeSilent):
        script.transact(wt_int=wt_int, n_wait=0)
    assert 5.0 <= script.now < 5.1


def test_a_node_that_announces_more_time_than_5_s_gets_it_up_to_15_s() -> None:
    for wt_int, n_wait, seconds in ((40, 15, 8.2), (60, 15, 15.0)):
        script = Script(b"")
        with pytest.raises(NodeSilent):
            script.transact(wt_int=wt_int, n_wait=n_wait)
        assert script.now == pytest.approx(seconds, abs=0.1)


@pytest.mark.parametrize(
    "reads",
    [
        [message.encode([tnep.status(1)])],
        [OK, message.encode([tnep.status(0x81)])],
        [OK, OK],
        [OK, message.encode([tnep.payload_record(Piece(3, 2, 0, b"ok", answer=True).encode())])],
        [OK, answer(Piece(3, 9, 0, b"", answer=True))],  # never holds anything
        [OK, b"\xd1torn"],
    ],
)
def test_what_breaks_the_wire_format_is_garbled(reads: list[bytes]) -> None:
    with pytest.raises(Garbled):
        Script(*reads).transact()


def test_a_node_that_takes_too_little_is_named() -> None:
    with pytest.raises(Garbled, match="at most 30 octets"):
        Script(OK).transact(max_ndef=30)


# --- the tags ---------------------------------------------------------------------------------------------------------


def card(memory: Type4Memory, ready: bool = True) -> IsoDepTag:
    return IsoDepTag(b"\xe0\x80", NdefApplication(memory, lambda seconds: ready), patience=0.0)


def blocks(tag: IsoDepTag, *apdus: bytes) -> list[bytes]:
    answers = []
    for number, apdu in enumerate(apdus):
        block = tag.answer(bytes((0x02 | number & 1,)) + apdu)
        assert block is not None
        assert block[0] == 0x02 | number & 1
        answers.append(block[1:])
    return answers


def test_a_type_4_tag_is_read_as_the_nfc_forum_says() -> None:
    memory = Type4Memory(1000)
    memory.put(b"hello")
    answers = blocks(
        card(memory),
        SELECT_APPLICATION,
        SELECT_CC,
        bytes.fromhex("00B000000F"),
        SELECT_NDEF,
        bytes.fromhex("00B0000007"),
    )
    assert answers[:2] == [b"\x90\x00"] * 2
    assert answers[2].hex() == "000f2000fb00f80406e10403ea0000" + "9000"
    assert answers[3:] == [b"\x90\x00", b"\x00\x05hello\x90\x00"]


def test_a_message_counts_as_written_when_its_length_is() -> None:
    memory, written = Type4Memory(1000), []
    memory.written = written.append
    tag = card(memory)
    body = bytes(range(200))
    parts = [b"\x00\x00" + body[:100], body[100:]]
    updates = [bytes.fromhex("00D60000") + bytes((102,)) + parts[0], bytes.fromhex("00D6006664") + parts[1]]
    blocks(tag, SELECT_APPLICATION, SELECT_NDEF, *updates)
    assert written == []
    assert tag.answer(bytes.fromhex("0200D600000200C8")) == b"\x02\x90\x00"
    assert written == [body]


@pytest.mark.parametrize(
    ("apdu", "status"),
    [
        ("00A4040007D2760000850199", "6A82"),
        ("00B0000002", "6986"),  # application not selected
        ("00", "6700"),
        ("00CA000000", "6986"),
    ],
)
def test_a_type_4_tag_refuses_what_it_does_not_have(apdu: str, status: str) -> None:
    assert blocks(card(Type4Memory(100)), bytes.fromhex(apdu))[0].hex().upper() == status


def test_a_type_4_tag_does_not_go_past_its_file() -> None:
    update = bytes.fromhex("00D6006020") + bytes(32)
    answers = blocks(card(Type4Memory(100)), SELECT_APPLICATION, SELECT_NDEF, update, bytes.fromhex("00B0FFFF02"))
    assert [answer.hex() for answer in answers[2:]] == ["6a84", "6b00"]


def test_a_slow_command_asks_for_more_time() -> None:
    ready = [False, False, True]
    tag = IsoDepTag(b"\xe0\x80", NdefApplication(Type4Memory(100), lambda seconds: ready.pop(0)))
    assert tag.answer(b"\x02" + SELECT_APPLICATION) == b"\xf2\x01"
    assert tag.answer(b"\xf2\x01") == b"\xf2\x01"
    assert tag.answer(b"\xf2\x01") == b"\x02\x90\x00"


def test_a_lost_block_is_sent_again_and_chains_work_both_ways() -> None:
    memory = Type4Memory(100)
    memory.put(bytes(60))
    tag = IsoDepTag(b"\xe0\x00", NdefApplication(memory, lambda seconds: True))  # FSD 16: 13 octets a block
    first, second = SELECT_APPLICATION[:7], SELECT_APPLICATION[7:]
    assert tag.answer(b"\x12" + first) == b"\xa2"
    assert tag.answer(b"\xb2") == b"\xa2"  # R(NAK): the acknowledge again
    assert tag.answer(b"\x03" + second) == b"\x03\x90\x00"
    assert tag.answer(b"\x02" + SELECT_NDEF) == b"\x02\x90\x00"
    got, block = b"", tag.answer(bytes.fromhex("0300B000003E"))
    number = 1
    while block is not None:
        assert tag.answer(bytes((0xB2 | number,))) == block
        got += block[1:]
        if not block[0] & 0x10:
            break
        number ^= 1
        block = tag.answer(bytes((0xA2 | number,)))
    assert got == b"\x00\x3c" + bytes(60) + b"\x90\x00"
    assert tag.answer(b"\xc2") == b"\xc2"
    assert tag.deselected


@given(st.lists(st.binary(min_size=1, max_size=300), max_size=20), st.binary(min_size=1, max_size=2))
def test_no_block_upsets_a_type_4_tag(blocks_sent: list[bytes], rats: bytes) -> None:
    tag = IsoDepTag(rats, NdefApplication(Type4Memory(200), lambda seconds: True))
    for block in blocks_sent:
        got = tag.answer(block)
        assert got is None or 0 < len(got) <= 254


def test_a_type_2_tag_has_the_layout_of_the_nhs31xx() -> None:
    memory = Type2Memory(UID)
    memory.put(b"hello")
    assert memory.answer(b"\x30\x00") == bytes.fromhex("021122B9 33445566 44000000 E1106F00")
    assert memory.answer(b"\x30\x04") == bytes.fromhex("0103E80E46FD0100") + b"\x03\x05hello\xfe"
    memory.put(bytes(range(250)) + bytes(249))
    assert (memory.answer(b"\x30\x06") or b"")[:6] == bytes.fromhex("03FF01F30001")
    assert memory.answer(bytes((0x30, 131)))[3:4] == b"\xfe"  # type: ignore[index]
    assert memory.answer(bytes((0x30, 132))) == b"\x00"


def test_page_6_with_a_length_completes_a_message() -> None:
    memory, written = Type2Memory(UID), []
    memory.written = written.append
    for page, octets in ((6, "03006162"), (7, "6364FE00"), (6, "03046162")):
        assert memory.answer(bytes((0xA2, page)) + bytes.fromhex(octets)) == b"\x0a"
    assert written == [b"abcd"]


def test_header_and_registers_of_a_type_2_tag_are_not_written() -> None:
    memory = Type2Memory(UID)
    for page in (0, 3, 132, 255):
        assert memory.answer(bytes((0xA2, page)) + bytes(4)) == b"\x00"


@given(st.lists(st.binary(max_size=8), max_size=30))
def test_no_command_upsets_a_type_2_tag(commands: list[bytes]) -> None:
    memory = Type2Memory(UID)
    for command in commands:
        assert len(memory.answer(command) or b"") in (1, 16)


# --- time on air ------------------------------------------------------------------------------------------------------


def test_frames_take_what_a_data_sheet_says() -> None:
    assert command_seconds(b"\x30\x04") == pytest.approx(368e-6, abs=1e-6)  # NTAG21x, READ and WRITE
    assert answer_seconds(b"\x30\x04", bytes(16)) == pytest.approx(1548e-6, abs=1.5e-6 + ETU)
    assert command_seconds(b"\xa2\x04abcd") == pytest.approx(708e-6, abs=1e-6)
    assert answer_seconds(b"\xa2\x04abcd", b"\x0a") == pytest.approx(6 * ETU)


def test_a_paced_exchange_lasts_as_long_as_on_air() -> None:
    air = Air()

    def ten() -> float:
        began = time.perf_counter()
        for _ in range(10):
            air(b"\x30\x04", False)
            air(bytes(16), True)
        took = time.perf_counter() - began
        assert took > 0.0205  # 10 x 2.09 ms
        return took

    best_of(10, 0.05, ten)


def test_a_tag_that_cannot_be_is_refused() -> None:
    from teds_provision.node.nfc.server import NfcServer

    with pytest.raises(UsageFailure):
        NfcServer("udp:localhost:5000", Handler(), tag="2", uid=bytes(4))
    with pytest.raises(UsageFailure):
        NfcServer("udp:0.0.0.0:5000", Handler())


@pytest.mark.parametrize("max_ndef", [300, 499])
def test_a_battery_stands_first_in_the_initial_message_and_the_service_is_found(max_ndef: int) -> None:
    power = [Power(PowerFlag.BATTERY, 80)]
    tag = Type4Memory(max_ndef)
    node = TnepTag(
        tag,
        Handler(),
        wt_int=4,
        n_wait=15,
        extras=charging.Extras(
            before=lambda: charging.charge_records(power[0]),
            after=lambda: (charging.out_of_band_record(bytes.fromhex("C1D857000101"), random=True),),
        ),
    )
    node.start()
    try:
        records = message.decode(Mailbox(tag).read())
        assert [record.type for record in records[:2]] == [b"WLCCAP", b"WLCSTAI"]
        assert records[1].payload == b"\x01\x50"
        assert records[-1].payload.hex() == "081b0101005" + "7d8c101021c00"  # the octets of a real record
        assert tnep.our_service(records) is not None
        power[0] = Power(PowerFlag.BATTERY | PowerFlag.FULL, 100)
        node.activated()
        assert node.ready(5)
        renewed = message.decode(Mailbox(tag).read())
        assert renewed[0].payload[1] >> 6 == 2
        assert renewed[1].payload == b"\x01\x64"
    finally:
        node.stop()


def test_a_charging_reader_that_writes_its_power_disturbs_nobody(desk: Desk) -> None:
    before = desk.mailbox.read()
    assert desk.say(message.encode([message.Record(message.WELL_KNOWN, b"WLCINF", bytes(6))])) == message.decode(before)
    assert tnep.status_of(desk.say(select())) == tnep.SUCCESS
