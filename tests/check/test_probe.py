"""The board as the rules see it, on a line of given answers: which of them break a rule, and which end the check."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.check.probe import (
    HeardFrame,
    NotApplicableError,
    Probe,
    RuleBrokenError,
    TraceRecorder,
    demand,
)
from teds_provision.errors import MessageTooLongError, NodeSilentError
from teds_provision.protocol.messages.frames import IDENTIFY, Function, Reason, Reply, refusal, security_command
from teds_provision.protocol.messages.identity import Identity, NodeState

UUID = bytes(range(10))
IDENTITY = Identity(UUID, NodeState.KEYED, 4, 2, 512, 17)
OVER_CAN = "Connect the board's CAN, and add: --via can --can INTERFACE:CHANNEL"
LIST = security_command(Function.LIST)
Answer = bytes | Exception


class Line:
    """A link that gives these answers in turn, and writes down what it was asked."""

    capabilities = SimpleNamespace(many=True, tapped=False)

    def __init__(self, *answers: Answer) -> None:
        self.answers, self.asked = list(answers), list[bytes]()

    def exchange(self, frame: bytes) -> bytes:
        self.asked.append(frame)
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


class Clock:
    def __init__(self) -> None:
        self.now, self.notes = 0.0, list[tuple[Any, ...]]()

    def pause(self, seconds: float) -> None:
        self.now += seconds


def probe_on(*answers: Answer, heard: TraceRecorder | None = None, clock: Clock | None = None) -> tuple[Probe, Line]:
    line, clock = Line(*answers), clock or Clock()

    def note(direction: str, octets: bytes, words: str, **more: Any) -> None:
        clock.notes.append((direction, octets, words, more))

    contact: Any = SimpleNamespace(link=line, identity=IDENTITY, note=note, address=17)
    made = Probe(contact, heard)
    made.pause, made.now = clock.pause, lambda: clock.now  # type: ignore[method-assign]
    return made, line


def ok(payload: bytes = b"") -> bytes:
    return Reply(True, payload).encode()


@pytest.mark.parametrize(
    ("answers", "words"),
    [
        ([NodeSilentError("silent"), ok()], "no reply, and every command gets one."),
        ([b"\1\0"], ""),
        ([b"\1\0\5abc"], ""),
        ([ok(bytes(510))], "513 octets came; maxMessage is 512."),
        (
            [MessageTooLongError("At most 100 fit.")],
            "6 octets are refused on the link; maxMessage is 512. At most 100 fit.",
        ),
    ],
)  # fmt: skip
def test_a_reply_that_is_none_breaks_whichever_rule_asked(answers: list[Answer], words: str) -> None:
    probe, line = probe_on(*answers)
    with pytest.raises(RuleBrokenError) as broken:
        probe.plain(LIST)
    assert str(broken.value).startswith(f"List (128.11), 0 octets: {words}")
    assert line.answers == []
    assert probe.asked == "List (128.11), 0 octets"


def test_a_node_that_answers_nothing_at_all_ends_the_check() -> None:
    probe, line = probe_on(NodeSilentError("first"), NodeSilentError("second"))
    with pytest.raises(NodeSilentError, match="second"):
        probe.plain(LIST)
    assert line.asked == [LIST.encode(), IDENTIFY.encode()]


def test_a_frame_that_is_too_long_for_the_node_as_well_is_no_fault_of_the_link() -> None:
    probe, _ = probe_on(MessageTooLongError("too long"), MessageTooLongError("too long"))
    with pytest.raises(MessageTooLongError):
        probe.octets(bytes(513), "513 octets")
    with pytest.raises(RuleBrokenError):
        probe.octets(bytes(512), "512 octets")


def test_a_reply_of_max_message_is_taken() -> None:
    probe, _ = probe_on(ok(bytes(509)))
    assert len(probe.good(LIST)) == 509


def test_a_busy_node_is_asked_again_for_a_while() -> None:
    """17 is no answer to a rule, unless it stays."""
    clock, busy = Clock(), refusal(Reason.BUSY).encode()
    probe, line = probe_on(busy, busy, ok(b"a"), clock=clock)
    assert probe.good(LIST) == b"a"
    assert len(line.asked) == 3
    pause, clock.now = clock.now / 2, 0.0
    probe, line = probe_on(*[busy] * 1000, clock=clock)
    with pytest.raises(RuleBrokenError) as broken:
        probe.plain(LIST)
    assert str(broken.value).startswith("List (128.11), 0 octets: busy (17) for ")
    assert str(broken.value).endswith(" s, and nothing here keeps the node busy.")
    assert len(line.asked) == pytest.approx(clock.now / pause + 1, abs=0.01)


def test_each_request_and_reply_is_noted_in_words() -> None:
    clock = Clock()
    probe, _ = probe_on(ok(b"abc"), refusal(Reason.BAD_FORM).encode(), clock=clock)
    probe.plain(LIST)
    probe.plain(LIST)
    words = "List (128.11), 0 octets"
    assert [(direction, octets, text) for direction, octets, text, _ in clock.notes] == [
        ("out", LIST.encode(), words),
        ("in", ok(b"abc"), f"reply to {words}: success, 3 octets"),
        ("out", LIST.encode(), words),
        ("in", refusal(Reason.BAD_FORM).encode(), f"reply to {words}: refusal 4"),
    ]
    assert [more for *_, more in clock.notes] == [{"sealed": False, "opened": None}, {}] * 2


@pytest.mark.parametrize(
    ("reply", "good"),
    [(refusal(Reason.BAD_FORM), True), (refusal(Reason.BUSY), False), (Reply(True, b"\4"), False),
     (Reply(False, b"\4\4"), False), (Reply(False, b""), False)],
)  # fmt: skip
def test_a_refusal_is_one_octet_with_its_reason(reply: Reply, good: bool) -> None:
    if good:
        assert demand(reply, 4, "what") == "what: refusal 4"
        return
    with pytest.raises(RuleBrokenError, match="what: refusal 4 is due, "):
        demand(reply, 4, "what")


def test_a_teds_is_read_to_its_end_piece_by_piece() -> None:
    probe, line = probe_on(ok(bytes(4) + b"abc"), ok(b"\0\0\0\3de"), ok(b"\0\0\0\5"))
    assert probe.teds((1, 3)) == b"abcde"
    assert [frame.hex() for frame in line.asked] == [f"0001010200050300000{at:03x}" for at in (0, 3, 5)]
    probe, _ = probe_on(ok(bytes(4) + b"abc"), ok(b"\0\0\0\2de"))
    with pytest.raises(RuleBrokenError) as broken:
        probe.teds((1, 3))
    assert str(broken.value) == "Read (1.2) of (1, 3): offset 3 was asked, 00000002 came."


def test_a_teds_without_end_is_given_up_after_a_mebibyte() -> None:
    class Endless(Line):
        capabilities = SimpleNamespace(many=True, tapped=False)

        def exchange(self, frame: bytes) -> bytes:
            return ok(frame[7:11] + bytes(0x4000))

    probe, _ = probe_on()
    probe.line, probe.max_message = cast("Any", Endless()), 1 << 20
    with pytest.raises(RuleBrokenError) as broken:
        probe.teds((1, 3))
    assert str(broken.value) == "Read (1.2) of (1, 3): no end after 1048576 octets."


def test_a_list_is_read_in_whatever_order_and_by_threes() -> None:
    probe, _ = probe_on(ok(bytes.fromhex("000001000080")), ok(bytes.fromhex("000080000001")), ok(bytes(4)))
    assert probe.listed() == [(0, 1), (0, 128)]
    assert probe.listed() == [(0, 128), (0, 1)]
    with pytest.raises(RuleBrokenError) as broken:
        probe.listed()
    assert str(broken.value) == "List (128.11): 4 octets are no multiple of 3."


def test_what_the_board_or_the_station_lacks_skips_a_rule_with_its_reason() -> None:
    probe, _ = probe_on(ok(IDENTITY.encode()))
    lacks: list[tuple[Callable[[], Any], str]] = [
        (lambda: probe.bus, f"Needs a second base station. {OVER_CAN}"),
        (lambda: probe.resending, f"This link sends no request twice. {OVER_CAN}"),
        (lambda: probe.framed, f"Needs single CAN frames. {OVER_CAN}"),
        (lambda: probe.link_key, "This station holds no key of the node."),
        (lambda: probe.station, "Needs this station's keys."),
        (lambda: probe.require(NodeState.FACTORY, NodeState.PROVISIONED), "The node is keyed."),
    ]
    for lack, words in lacks:
        with pytest.raises(NotApplicableError) as no:
            lack()
        assert str(no.value) == words
    probe, _ = probe_on(ok(IDENTITY.encode()))
    assert probe.require(NodeState.FACTORY, NodeState.KEYED) == IDENTITY
    probe.key, probe.credentials = bytes(16), cast("Any", "credentials")
    assert (probe.link_key, cast("Any", probe.station)) == (bytes(16), "credentials")
    probe.no_session = "Open (128.3): …"
    with pytest.raises(NotApplicableError) as no:
        probe.open()
    assert str(no.value) == "Needs a session, and none opens: Open (128.3): …"
    assert (probe.noisy, probe.tapped) == (True, False)


def _frames(*sources: tuple[str, int]) -> TraceRecorder:
    recorder = TraceRecorder()
    for direction, source in sources:
        recorder.frame("can", cast("Any", direction), b"", identifier=0x18DA0000 | source)
    recorder.frame("nfc", "in", b"")
    recorder.frame("nfc", "out", b"")
    return recorder


@pytest.mark.parametrize(
    ("heard", "free"),
    [
        ((), [0xF7, 0xF6, 0xF5]),
        ((("out", 0xF7),), [0xF6, 0xF5, 0xF4]),
        ((("out", 0xF1), ("out", 0xF7)), [0xF7, 0xF6, 0xF5]),
        ((("out", 0xF1), ("in", 0xF7), ("in", 0xF5)), [0xF6, 0xF4, 0xF3]),
        ((("out", 0xF1), *(("in", source) for source in range(0xF4, 0xF8))), [0xF3, 0xF2]),
    ],
)
def test_another_base_station_has_an_address_from_which_nothing_was_heard(
    heard: tuple[tuple[str, int], ...], free: list[int]
) -> None:
    probe, _ = probe_on(heard=_frames(*heard))
    assert [probe.free_source(number) for number in range(1, len(free) + 1)] == free
    if len(free) < 3:
        with pytest.raises(NotApplicableError) as no:
            probe.free_source(3)
        assert str(no.value) == (
            "The other base stations use all addresses, F1 to F7: disconnect one of them from this bus."
        )


def test_a_recorded_trace_goes_on_to_the_trace_of_the_user() -> None:
    further: list[Any] = []
    trace = TraceRecorder(
        cast(
            "Any",
            SimpleNamespace(
                frame=lambda *given, **more: further.append((given, more)),
                message=lambda *given, **more: further.append((given, more)),
            ),
        )
    )
    trace.frame("can", "in", b"a", identifier=5, fd=True, at=1.5)
    trace.message("can", "out", b"b", "words", uuid=UUID, sealed=True, opened=b"c")
    assert trace.frames == [HeardFrame("can", "in", b"a", 5, True)]
    assert further == [
        (("can", "in", b"a"), {"identifier": 5, "fd": True, "at": 1.5}),
        (("can", "out", b"b", "words"), {"uuid": UUID, "sealed": True, "opened": b"c"}),
    ]
    alone = TraceRecorder()
    alone.frame("can", "in", b"a")
    alone.message("can", "out", b"b", "words", uuid=UUID)
    assert alone.frames == [HeardFrame("can", "in", b"a", None, False)]


def test_a_node_that_was_moved_is_asked_there_on_a_bus_alone() -> None:
    clock = Clock()
    probe, line = probe_on(clock=clock)
    clock.now = 7.0
    probe.move(99)
    assert (probe.moved_at, probe.contact.address) == (7.0, 17)
    assert not hasattr(line, "address")
