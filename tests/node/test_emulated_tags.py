"""The emulated tags, Type 4 and Type 2, octet by octet, and the time that frames take on air."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import NoReaderError, UsageError
from teds_provision.links.nfc.nfcpy import nfc
from teds_provision.node.nfc import server as server_module
from teds_provision.node.nfc.server import ETU, AirTime, NfcServer, answer_seconds, command_seconds
from teds_provision.node.nfc.tags import IsoDepTag, NdefApplication, Type2Memory, Type4Memory
from teds_provision.node.nfc.tnep import ExtraRecords
from tests.node.tag_talk import Handler
from tests.pace import best_of

SELECT_APPLICATION = bytes.fromhex("00A4040007D276000085010100")
SELECT_CC, SELECT_NDEF = bytes.fromhex("00A4000C02E103"), bytes.fromhex("00A4000C02E104")
UID = bytes.fromhex("02112233445566")


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


@pytest.mark.parametrize(
    ("rats", "octets"),
    [("e0", 13), ("e000", 13), ("e01f", 21), ("e020", 29), ("e030", 37), ("e040", 45), ("e050", 61), ("e060", 93),
     ("e070", 125), ("e080", 253), ("e090", 253), ("e0f0", 253)],
)  # fmt: skip
def test_a_block_is_as_long_as_the_reader_takes_it(rats: str, octets: int) -> None:
    """ISO/IEC 14443-4, FSDI: 16 to 256 octets, of which one is the PCB and two are the CRC."""
    memory = Type4Memory(400)
    memory.put(bytes(300))
    tag = IsoDepTag(bytes.fromhex(rats), NdefApplication(memory, lambda seconds: True))
    for number, apdu in enumerate((SELECT_APPLICATION, SELECT_NDEF)):
        assert tag.answer(bytes((0x02 | number,)) + apdu) == bytes((0x02 | number,)) + b"\x90\x00"
    block = tag.answer(bytes.fromhex("0200B00000FF"))
    assert block is not None
    assert (block[0] & 0x10, len(block) - 1) == (0x10, octets)


def test_a_type_2_tag_has_the_layout_of_the_nhs31xx() -> None:
    memory = Type2Memory(UID)
    memory.put(b"hello")
    assert memory.answer(b"\x30\x00") == bytes.fromhex("021122B9 33445566 44000000 E1106F00")
    assert memory.answer(b"\x30\x04") == bytes.fromhex("0103E80E46FD0100") + b"\x03\x05hello\xfe"
    memory.put(bytes(range(250)) + bytes(249))
    assert (memory.answer(b"\x30\x06") or b"")[:6] == bytes.fromhex("03FF01F30001")
    assert memory.answer(bytes((0x30, 131)))[3:4] == b"\xfe"  # type: ignore[index]
    assert memory.answer(bytes((0x30, 132))) == b"\x00"


def test_a_type_2_tag_has_room_for_499_octets_at_most() -> None:
    assert [Type2Memory(UID, most).max_ndef for most in (100, 499, 500)] == [100, 499, 499]


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
    air = AirTime()

    def ten() -> float:
        began = time.perf_counter()
        for _ in range(10):
            air(b"\x30\x04", False)
            air(bytes(16), True)
        seconds = time.perf_counter() - began
        assert seconds > 0.0205  # 10 x 2.09 ms
        return seconds

    best_of(10, 0.05, ten, because="21 ms each, and twenty sleeps that a busy machine may prolong")


def test_a_tag_that_cannot_be_is_refused() -> None:
    with pytest.raises(UsageError):
        NfcServer("udp:localhost:5000", Handler(), tag="2", uid=bytes(4))
    with pytest.raises(UsageError):
        NfcServer("udp:0.0.0.0:5000", Handler())


# --- from one activation to the next ----------------------------------------------------------------------------------


class Reader:
    """A reader's field over the tag: what ``listen`` and ``exchange`` of nfcpy's front end give, in their order."""

    def __init__(self, server: NfcServer, *said: Any) -> None:
        self.server, self.said = server, list(said)
        self.offers: list[Any] = []
        self.answers: list[bytes | None] = []

    def listen(self, offer: Any, timeout: float) -> Any:
        self.offers.append(offer)
        return self._next()

    def exchange(self, answer: bytes | None, timeout: float) -> bytes:
        self.answers.append(answer)
        said = self._next()
        if isinstance(said, Exception):
            raise said
        return bytes(said)

    def close(self) -> None:
        assert not self.said

    def _next(self) -> Any:
        if len(self.said) == 1:
            self.server._stop.set()
        return self.said.pop(0)


places: list[Any] = []


class Place:
    """A place on the reader that is free at the second look."""

    def __init__(self) -> None:
        self.asked, self.air = 0, None
        places.append(self)

    def bind(self) -> bool:
        self.asked += 1
        return self.asked != 2

    def wake(self) -> None:
        """Nothing waits on it."""


def served(patch: pytest.MonkeyPatch, *said: Any, **how: Any) -> tuple[Reader, list[object]]:
    """Return what a reader saw of a tag that it talked to so, and what the node learned of its field, in order."""
    log: list[object] = []

    class Logged(Handler):
        def lost(self, link: str) -> None:
            log.append("lost")

    server = NfcServer("udp:localhost:5000", Logged(), extras=ExtraRecords(field=log.append), queue=True, **how)
    reader = Reader(server, *said)
    patch.setattr(server_module, "NodeDevice", lambda *_: Place())
    patch.setattr(server_module, "frontend", lambda *_: reader)
    server.start()
    server._thread.join()
    server.stop()
    return reader, log


@pytest.mark.parametrize(
    ("tag", "uid", "sens", "sak"),
    [
        ("4", "08112233", "0400", "20"),
        ("4", "04112233445566", "4400", "20"),
        ("4", "04112233445566778899", "8400", "20"),
        ("2", "04112233445566", "4400", "00"),
    ],
)
def test_a_tag_is_activated_by_its_uid(
    monkeypatch: pytest.MonkeyPatch, tag: Any, uid: str, sens: str, sak: str
) -> None:
    """ISO/IEC 14443-3: ATQA has the size of the UID, SAK whether ISO-DEP follows."""
    reader, log = served(monkeypatch, None, tag=tag, uid=bytes.fromhex(uid))
    (offer,) = reader.offers
    assert offer.brty == "106A"
    assert (offer.sens_res.hex(), offer.sdd_res.hex(), offer.sel_res.hex()) == (sens, uid, sak)
    assert log == []


@pytest.mark.parametrize(("tag", "first", "octets"), [("4", 0x08, 4), ("2", 0x02, 7)])
def test_a_tag_that_is_given_no_uid_draws_one(
    monkeypatch: pytest.MonkeyPatch, tag: Any, first: int, octets: int
) -> None:
    """ISO/IEC 14443-3: 08 begins a random UID of four octets; 02 is a maker's number, as one of seven begins."""
    uids = [served(monkeypatch, None, tag=tag)[0].offers[0].sdd_res for _ in range(2)]
    assert [(uid[0], len(uid)) for uid in uids] == [(first, octets)] * 2
    assert uids[0] != uids[1], "once in 16 million runs they are equal"


def test_the_node_learns_when_the_field_comes_and_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A battery is charged in the field; sessions end with it. A frame lost on air ends nothing."""
    first, second = (SimpleNamespace(tt2_cmd=None, tt4_cmd=rats) for rats in (b"\xe0\x80", b"\xe0\x80"))
    gone, lost = nfc.clf.BrokenLinkError(), nfc.clf.TransmissionError()
    on_air = (b"\xc2", lost, nfc.clf.TimeoutError(), b"\xb2", gone)
    reader, log = served(monkeypatch, first, *on_air, None, second, gone, uid=bytes(4))
    assert [event for event in log if event != "lost"] == [True, False, True, False]
    assert log.count("lost") == 2, "the worker forgets, whenever it comes to it"
    assert [answer.hex() if answer else answer for answer in reader.answers] == [
        "057880b000", "c2", None, None, "a3", "057880b000",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("bind", "message", "hint"),
    [
        (False, "Another node or program is using udp:localhost:5000.", "Stop it, or use another port."),
        (OSError(98, "Address already in use"), "The node cannot use udp:localhost:5000: Address already in use.",
         "Try another port."),
    ],
)  # fmt: skip
def test_a_reader_that_another_node_is_on_is_refused(
    monkeypatch: pytest.MonkeyPatch, bind: bool | Exception, message: str, hint: str
) -> None:
    def taken() -> bool:
        if isinstance(bind, Exception):
            raise bind
        return bind

    waits: list[float] = []
    monkeypatch.setattr(server_module, "NodeDevice", lambda *_: SimpleNamespace(bind=taken, air=None))
    now = [100.0]

    def wait(seconds: float) -> bool:
        waits.append(seconds)
        now[0] += seconds
        return False

    monkeypatch.setattr(server_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(server_module, "_QUEUE", 0.25)
    server = NfcServer("udp:localhost:5000", Handler())
    server._stop = cast("Any", SimpleNamespace(wait=wait))
    with pytest.raises(NoReaderError) as no:
        server.start()
    assert (no.value.message, no.value.hint) == (message, hint)
    assert waits == ([] if isinstance(bind, Exception) else [0.25] * 5), "a node that leaves has a second"
    assert not server._thread.is_alive()


@pytest.mark.parametrize("pace", [True, False])
def test_frames_last_as_on_air_if_that_is_asked(monkeypatch: pytest.MonkeyPatch, pace: bool) -> None:
    served(monkeypatch, None, uid=UID, pace=pace)
    assert isinstance(places[-1].air, AirTime) is pace


def test_a_restart_of_the_node_ends_its_sessions_and_forgets_its_replies() -> None:
    handler = Handler()
    server = NfcServer("udp:localhost:5000", handler)
    server.restarted()
    job = server._tnep._jobs.get()
    assert job is not None
    job()
    assert handler.lost_lines == ["nfc"]


def test_a_type_2_tag_answers_its_first_command(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, log = served(
        monkeypatch, SimpleNamespace(tt2_cmd=b"\x30\x00", tt4_cmd=None), nfc.clf.BrokenLinkError(), tag="2", uid=UID
    )
    assert reader.answers == [Type2Memory(UID, 499).answer(b"\x30\x00")]
    assert log == [True, False, "lost"]
