"""The node's half of TNEP on an emulated tag, against the station's half in memory."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc.pieces import Piece
from teds_provision.links.nfc.poller import Poller
from teds_provision.node.nfc import tnep as charging
from teds_provision.node.nfc.tags import Type4Memory
from teds_provision.node.nfc.tnep import TnepTag
from teds_provision.protocol.operation.commands import PowerFlag, PowerReply
from tests.node.tag_talk import Handler, request, select


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

    def exchange(self, octets: bytes) -> tuple[message.NdefRecord, ...]:
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


def test_the_initial_message_offers_the_service_and_says_who_it_is(desk: Desk) -> None:
    records = message.decode(desk.mailbox.read())
    assert tnep.our_service(records) == tnep.ServiceParameters(tnep.SERVICE, 4, 15, 500)
    assert tnep.external(records, tnep.ID_TYPE) == desk.handler.identify()


def test_a_frame_before_the_selection_is_a_protocol_error(desk: Desk) -> None:
    assert tnep.status_of(desk.exchange(request(Piece(1, 4, 0, b"abcd")))) == tnep.PROTOCOL_ERROR
    assert desk.handler.frames == []


def test_a_message_that_is_nonsense_is_refused(desk: Desk) -> None:
    assert tnep.status_of(desk.exchange(select())) == tnep.SUCCESS
    torn = bytearray(request(Piece(1, 4, 0, b"abcd")))
    torn[-1] ^= 1
    for nonsense in (bytes(torn), b"\xff\xff\xff", request(Piece(1, 4, 0, b"abcd", answer=True))):
        assert tnep.status_of(desk.exchange(nonsense)) == tnep.GARBLED_REQUEST
    assert desk.handler.frames == []


def test_selecting_another_service_gives_the_initial_message(desk: Desk) -> None:
    for uri in (b"urn:nfc:sn:handover", b""):
        desk.exchange(select())
        assert tnep.our_service(desk.exchange(message.encode([tnep.select(uri)]))) is not None


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


def test_a_reply_is_kept_for_20_seconds_from_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """A commit may take seconds: counted from the request, a repetition would run it again."""
    now, ran = [1000.0], list[bytes]()

    def slow(_line: str, frame: bytes, *, tapped: bool) -> bytes:
        assert tapped
        ran.append(frame)
        now[0] += 12
        return bytes([len(ran)])

    tag = TnepTag(Type4Memory(500), cast("Any", SimpleNamespace(request=slow)), wt_int=4, n_wait=15)
    monkeypatch.setattr(charging, "time", SimpleNamespace(monotonic=lambda: now[0]))
    commit = bytes.fromhex("000001030000")
    assert tag._run(7, commit) == b"\1"
    now[0] += 19
    assert tag._run(7, commit) == b"\1"
    now[0] += 20
    assert (tag._run(7, commit), ran) == (b"\2", [commit] * 2)


@pytest.mark.parametrize("changes", [True, False], ids=["Identify changes", "Identify stays"])
def test_an_answer_that_is_ready_after_the_field_was_gone_is_not_put(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, changes: bool
) -> None:
    if not changes:  # so that the initial message, shown already, is not put once more
        same = desk.handler.identify()
        monkeypatch.setattr(desk.handler, "identify", lambda: same)
    desk.exchange(select())
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


def test_a_command_that_has_not_begun_is_not_run_once_the_field_is_gone() -> None:
    handler = Handler()
    tag = TnepTag(Type4Memory(500), handler, wt_int=4, n_wait=15)  # without its thread: the test runs its jobs
    tag.activated()
    tag._selected = True
    tag._written(request(Piece(1, 4, 0, b"abcd")))
    tag.lost()
    while not tag._jobs.empty():
        job = tag._jobs.get()
        assert job is not None
        job()
    assert (handler.frames, handler.lost_lines) == ([], ["nfc"])


def shown_id(desk: Desk) -> bytes | None:
    """Return the id record of the message in the mailbox, None if it has none."""
    return tnep.external(message.decode(desk.mailbox.read()), tnep.ID_TYPE)


def test_the_id_record_is_renewed_whenever_identify_changes_and_no_answer_gives_way_to_it(desk: Desk) -> None:
    before = desk.handler.identify()
    assert shown_id(desk) == before
    desk.handler.frames.append(b"by another link")
    desk.tag.idle()
    settle(desk)
    assert shown_id(desk) == desk.handler.identify() != before
    desk.exchange(select())
    (success,) = desk.exchange(select())
    desk.handler.frames.append(b"by another link")
    desk.tag.idle()
    settle(desk)
    assert message.decode(desk.mailbox.read()) == (success,), "the reader has not read its answer yet"


def settle(desk: Desk) -> None:
    """Wait until the worker has done what it was given."""
    done = threading.Event()
    desk.tag._jobs.put(done.set)
    assert done.wait(60)


@pytest.mark.parametrize("gone", [True, False], ids=["field lost", "activated anew"])
def test_a_reader_selects_the_service_anew_after_each_activation(desk: Desk, gone: bool) -> None:
    assert tnep.status_of(desk.exchange(select())) == tnep.SUCCESS
    if gone:
        desk.tag.lost()
    desk.tag.activated()
    assert desk.tag.ready(60)
    assert tnep.status_of(desk.exchange(request(Piece(1, 4, 0, b"abcd")))) == tnep.PROTOCOL_ERROR
    assert desk.handler.frames == []


def test_half_a_request_goes_with_the_field(desk: Desk) -> None:
    def held(piece: Piece) -> Piece:
        payload = tnep.external(desk.exchange(request(piece)), tnep.TIM_TYPE)
        assert payload is not None
        return Piece.decode(payload)

    desk.exchange(select())
    assert held(Piece(5, 8, 0, b"abcd", more=True)) == Piece(5, 8, 4, b"", answer=True)
    desk.tag.lost()
    desk.tag.activated()
    assert desk.tag.ready(60)
    desk.exchange(select())
    assert held(Piece(5, 8, 4, b"efgh")) == Piece(5, 8, 0, b"", answer=True)
    assert desk.handler.frames == []


def test_the_initial_message_octet_for_octet() -> None:
    """Charge, Tp, id and the address in the air, in this order (wire.md, "NFC" and "BLE")."""
    power = PowerReply(PowerFlag.BATTERY, 73)
    air = bytes.fromhex("c0a1a2a3a4a5")
    extras = charging.ExtraRecords(
        before=lambda: charging.charge_records(power), after=lambda: (charging.out_of_band_record(air, random=True),)
    )
    memory = Type4Memory(500)
    tag = TnepTag(memory, Handler(), wt_int=4, n_wait=15, extras=extras)
    tag.start()
    tag.stop()
    service = b"urn:nfc:xsn:teds-provision:tim"
    assert Mailbox(memory).read() == (
        bytes.fromhex("910606") + b"WLCCAP" + bytes.fromhex("2001091e030a")
        + bytes.fromhex("110702") + b"WLCSTAI" + bytes.fromhex("0149")
        + bytes.fromhex("110225") + b"Tp" + b"\x10\x1e" + service + bytes.fromhex("00040f01f4")
        + bytes.fromhex("141117") + b"teds-provision:id" + bytes(23)
        + bytes.fromhex("52200c") + b"application/vnd.bluetooth.le.oob"
        + bytes.fromhex("081ba5a4a3a2a1c00102" + "1c00")
    )  # fmt: skip


@given(st.lists(st.binary(min_size=1, max_size=80), max_size=8))
def test_no_message_upsets_the_node(messages: list[bytes]) -> None:
    desk = Desk(120)
    try:
        for octets in messages:
            desk.exchange(octets)
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


@pytest.mark.parametrize("max_ndef", [300, 499])
def test_a_battery_is_first_in_the_initial_message_and_the_service_is_found(max_ndef: int) -> None:
    power = [PowerReply(PowerFlag.BATTERY, 80)]
    tag = Type4Memory(max_ndef)
    node = TnepTag(
        tag,
        Handler(),
        wt_int=4,
        n_wait=15,
        extras=charging.ExtraRecords(
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
        power[0] = PowerReply(PowerFlag.BATTERY | PowerFlag.FULL, 100)
        node.activated()
        assert node.ready(5)
        renewed = message.decode(Mailbox(tag).read())
        assert renewed[0].payload[1] >> 6 == 2
        assert renewed[1].payload == b"\x01\x64"
    finally:
        node.stop()


def test_a_charging_reader_that_writes_its_power_disturbs_nothing(desk: Desk) -> None:
    before = desk.mailbox.read()
    assert desk.exchange(
        message.encode([message.NdefRecord(message.WELL_KNOWN, b"WLCINF", bytes(6))])
    ) == message.decode(before)
    assert tnep.status_of(desk.exchange(select())) == tnep.SUCCESS
    power = message.encode([message.NdefRecord(message.WELL_KNOWN, b"WLCINF", bytes(6))])
    assert tnep.status_of(desk.exchange(power)) == tnep.PROTOCOL_ERROR, "a reader that has selected asks"


@pytest.mark.parametrize(("random", "kind"), [(False, "00"), (True, "01")])
def test_an_out_of_band_record_has_the_address_backwards_and_its_kind(random: bool, kind: str) -> None:
    record = charging.out_of_band_record(bytes.fromhex("C1D857000102"), random=random)
    assert record.payload.hex() == f"081b02010057d8c1{kind}021c00"
