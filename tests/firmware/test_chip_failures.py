"""Each call of the chip's random source and cryptography fails once: 11, nothing has happened, the next try works."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from teds_provision.protocol.messages.frames import Function, Reason, Reply, security_command
from teds_provision.protocol.operation.stream_commands import CLOCK, drive
from teds_provision.protocol.session import StationSession
from teds_provision.protocol.wire_agreement import StationAgreement
from tests.firmware.bench import CBench
from tests.firmware.desk import CDesk
from tests.protocol.desk import CREDENTIALS, UUID
from tests.protocol.operation.bench import MS
from tests.protocol.operation.consumer import Consumer
from tests.protocol.operation.test_refusals import subscribe

pytestmark = pytest.mark.system
CHALLENGE = bytes(range(32))
_RANDOM, _CRYPTO = -3, -5


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    CDesk.close_all()
    CBench.close_all()


def prove(desk: CDesk) -> Reply:
    return desk.plain(security_command(Function.PROVE, CHALLENGE))


def request(desk: CDesk) -> Reply:
    return desk.plain(StationAgreement(CREDENTIALS, UUID).request())


def long_open(desk: CDesk) -> Reply:
    session = StationSession(desk.key, UUID)
    calls = desk.node.chip_calls
    command = session.open(desk.plain(session.request_counter()).payload)
    assert desk.node.chip_calls == calls, "the short form costs nothing"
    return desk.plain(command)


def reset(desk: CDesk) -> Reply:
    return desk.sealed(security_command(Function.RESET, CHALLENGE))


@pytest.mark.parametrize(("ask", "calls"), [(prove, 1), (request, 10), (long_open, 8), (reset, 1)])
def test_a_call_that_fails_gets_11_and_nothing_has_happened(ask: Callable[[CDesk], Reply], calls: int) -> None:
    for call in range(1, calls + 1):
        desk = CDesk()
        desk.provision() if ask is reset else desk.agree()
        before = desk.shown()
        desk.node.chip_fails(call)
        assert ask(desk).reason == Reason.FLASH_FAILURE, f"call {call}"
        assert desk.shown() == before
        if ask is request:
            assert desk.plain(security_command(Function.CONFIRM, bytes(16))).reason == Reason.WRONG_STATE
        desk.node.chip_fails(0)
        assert ask(desk).ok
    desk = CDesk()
    desk.provision() if ask is reset else desk.agree()
    desk.node.chip_fails(0)
    assert ask(desk).ok
    made = desk.node.chip_calls - (1 if ask is reset else 0)  # the last seals the reply
    assert made == calls, "each of its calls was tried"


def test_a_reply_that_cannot_be_sealed_is_a_plain_11_and_the_session_goes_on() -> None:
    desk = CDesk()
    desk.agree().open()
    assert desk.session is not None
    desk.node.chip_fails(1)
    identify = security_command(Function.IDENTIFY)
    assert desk.plain(desk.session.seal(identify)).reason == Reason.FLASH_FAILURE
    assert desk.sealed(identify).ok


def test_a_first_start_without_chip_makes_no_identity_and_the_next_one_does() -> None:
    desk = CDesk()
    blank = bytes([0xFF]) * len(desk.node.image)
    for call, message in [(1, _RANDOM), (2, _CRYPTO), (3, _RANDOM)]:  # key, signature of field 102, c of Open
        desk.node.image = blank
        desk.node.chip_fails(call)
        assert desk.node.start() == message
        assert (desk.node.image == blank) == (call < 3)
        desk.node.chip_fails(0)
        assert desk.node.start() == 0


def test_a_run_without_a_key_is_none_and_the_one_before_goes_on() -> None:
    bench = CBench()
    bench.open().operate(1, 4)
    node = bench.tim
    consumer = Consumer(bench, start=100 * MS)
    assert bench.send(drive([4])).ok
    for command in (subscribe(), drive([4])):
        node.chip_fails(1)  # type: ignore[attr-defined]
        assert bench.reason(command) == Reason.FLASH_FAILURE
    node.chip_fails(0)  # type: ignore[attr-defined]
    bench.until(150 * MS)
    assert consumer.messages()
    assert bench.send(CLOCK).ok


def test_a_data_message_that_cannot_be_sealed_is_lost_and_the_counter_shows_it() -> None:
    bench = CBench()
    bench.open().operate(1)
    consumer = Consumer(bench, n=1, period=10 * MS, start=100 * MS)
    bench.until(105 * MS)
    bench.tim.chip_fails(1)  # type: ignore[attr-defined]
    bench.until(135 * MS)
    assert [message.counter for message in consumer.messages()] == [0, 2, 3]
    assert consumer.receiver.counts.lost == 1
