"""Rules of the link, on frames as they were recorded: which octets of a frame are looked at, and what is found."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.check import link_rules
from teds_provision.check.probe import HeardFrame, NotApplicableError, RuleBrokenError
from teds_provision.protocol.messages.frames import Command
from teds_provision.protocol.messages.identity import Identity, NodeState

NODE, OWN, OTHER = 0x11, 0xF1, 0xF7
IDENTITY = Identity(bytes(range(10)), NodeState.KEYED, 4, 2, 1024, 17)
OVER_CAN = "Connect the board's CAN, and add: --via can --can INTERFACE:CHANNEL"
OVER_NFC = "Put the board on an NFC reader, and add: --via nfc"


def _heard(
    octets: str, *, source: int = NODE, to: int = OWN, direction: str = "in", fd: bool = False, identifier: int = 0
) -> HeardFrame:
    number = identifier or 0x18DA0000 | to << 8 | source
    return HeardFrame("can", direction, bytes.fromhex(octets), number, fd)  # type: ignore[arg-type]


ASKED = _heard("1067010000010300", source=OWN, to=NODE, direction="out")


class _Bus:
    """A link of a bus, as far as a rule asks for it; ``begin`` has these answers."""

    def __init__(self, *answers: str) -> None:
        self.answers, self.begun = list(answers), list[int]()

    def begin(self, octets: int) -> bytes:
        self.begun.append(octets)
        return bytes.fromhex(self.answers.pop(0))

    def exchange(self, frame: bytes) -> bytes:
        raise AssertionError

    identify_at = identify_functional = from_station = exchange
    capabilities = address = None


def _probe(frames: list[HeardFrame], **more: Any) -> Any:
    """Return a board whose long request and long answer make these frames; some were heard before."""
    heard = SimpleNamespace(frames=[_heard("300900"), _heard("3f0909")])
    asked = list[Any]()

    def plain(command: Command) -> None:
        asked.append(command.encode())
        heard.frames.extend(frames[:1])

    def teds(block: tuple[int, int]) -> None:
        asked.append(block)
        heard.frames.extend(frames[1:])

    members: dict[str, Any] = {
        "heard": heard,
        "contact": SimpleNamespace(address=NODE, link=None, identity=IDENTITY),
        "plain": plain,
        "teds": teds,
        "asked": asked,
        "identity": lambda: IDENTITY,
    }
    return SimpleNamespace(**members | more)


FLOWS = [
    (["300000"], "block size 0, STmin 0 ms; padding none"),
    (["300814cccccccccc"], "block size 8, STmin 20 ms; padding CC"),
    (["3000f1cccccccccc", "3000fa0000000000"], "block size 0, STmin 0.1 ms, block size 0, STmin 127 ms; padding 00 CC"),
    (["310000cccccccccc", "300a00cccccccccc", "320000cccccccccc"], "block size 10, STmin 0 ms; padding CC"),
    (["300000", "0501000001aabbcc"], "block size 0, STmin 0 ms; padding BB CC"),
    (["300000", "000801020304050607aabb"], "block size 0, STmin 0 ms; padding BB"),
    (["300000", "100c010203040506", "2107080910110c55"], "block size 0, STmin 0 ms; padding 55"),
    (["300000", "100d010203040506", "2107080910111213"], "block size 0, STmin 0 ms; padding none"),
    (["300000", "1014010203040506", "21aaaaaaaaaaaaaa", "22aaaaaaaaaaaaaa"], "block size 0, STmin 0 ms; padding none"),
    (["300000", "1013010203040506", "21aaaaaaaaaaaaaa", "22aaaaaaaaaaaa77"], "block size 0, STmin 0 ms; padding 77"),
    (["300000", "1013010203040506", "22aaaaaaaaaaaa77", "21aaaaaaaaaaaa78"], "block size 0, STmin 0 ms; padding none"),
    (
        ["300000", "1013010203040506", "21aaaaaaaaaaaaaa", "21aaaaaaaaaaaaaa", "22aaaaaaaaaaaa77"],
        "block size 0, STmin 0 ms; padding none",
    ),
    (["3008147ecccccccc"], "block size 8, STmin 20 ms; padding 7E CC"),
    (["300000", "2255555555555555"], "block size 0, STmin 0 ms; padding none"),
    (["300000", "2155555555555555"], "block size 0, STmin 0 ms; padding none"),
]  # fmt: skip


@pytest.mark.parametrize(("frames", "seen"), FLOWS)
def test_block_size_gap_and_padding_are_read_from_the_frames_of_the_node(frames: list[str], seen: str) -> None:
    probe = _probe([ASKED, *(_heard(octets) for octets in frames)])
    assert link_rules.can_flow_control(probe) == seen
    assert probe.asked == [bytes.fromhex("0000010300650c00000000") + bytes(96), (0, 128)]


def test_the_numbers_of_a_long_answer_begin_again_after_fifteen() -> None:
    rest = [_heard(f"2{number % 16:x}{'aa' * 7}") for number in range(1, 53)] + [_heard("25" + "aa" * 5 + "6666")]
    probe = _probe([ASKED, _heard("300000"), _heard("1177010203040506"), *rest])
    assert link_rules.can_flow_control(probe) == "block size 0, STmin 0 ms; padding 66"


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (["3000"], "Flow control 3000: 30 to 32, block size and STmin are due."),
        (["330000", "300000"], "Flow control 330000: 30 to 32, block size and STmin are due."),
        (
            ["3f0000", "3000", "320000", "350000", "330000", "31"],
            "Flow control 3000 31 330000 350000 3f0000: 30 to 32, block size and STmin are due.",
        ),
    ],
)
def test_a_flow_control_that_is_none_is_named(frames: list[str], words: str) -> None:
    with pytest.raises(RuleBrokenError) as broken:
        link_rules.can_flow_control(_probe([ASKED, *(_heard(octets) for octets in frames)]))
    assert str(broken.value) == words


def test_frames_of_others_are_not_the_node_s() -> None:
    """Other nodes, what this station sends, functional frames, an Announce, frames without octets."""
    others = [
        _heard("3f0000", source=0x12), _heard("3f0000", source=OWN, to=NODE, direction="out"),
        _heard("3f0000", identifier=0x18DBFF11), _heard("3f0000", identifier=0x1CFF0011),
        HeardFrame("nfc", "in", b"\x3f\0\0", None, False), _heard(""),
    ]  # fmt: skip
    probe = _probe([ASKED, *others, _heard("300000", to=OTHER)])
    assert link_rules.can_flow_control(probe) == "block size 0, STmin 0 ms; padding none"


@pytest.mark.parametrize(
    ("asked", "answers", "seen"),
    [
        (False, [False, False], "asked and answered in classic CAN"),
        (True, [True, True], "asked and answered in CAN FD"),
        (True, [], "asked and answered in CAN FD"),
        (True, [True, False], "Asked in CAN FD it answered in classic CAN."),
        (False, [True, False], "Asked in classic CAN it answered in CAN FD."),
    ],
)
def test_a_node_answers_in_the_form_of_the_request(asked: bool, answers: list[bool], seen: str) -> None:
    first = _heard("10", source=OWN, to=NODE, direction="out", fd=asked)
    late = _heard("21", source=OWN, to=NODE, direction="out", fd=not asked)
    probe = _probe([_heard("10", source=0x12, fd=not asked), first, *(_heard("30", fd=fd) for fd in answers), late])
    if seen.startswith("Asked"):
        with pytest.raises(RuleBrokenError) as broken:
            link_rules.can_form(probe)
        assert str(broken.value) == seen
    else:
        assert link_rules.can_form(probe) == seen


BUSY = [
    (["300000", "300000"], "", "refused; both taken up"),
    (["30", "310000"], "", "refused; both taken up"),
    (["300000", "0501000001" "11"], "", "refused; 17 for the second"),
    (["320000"], "The first frame of 200 octets: 320000 came, not a flow control.", ""),
    ([""], "The first frame of 200 octets: nothing came, not a flow control.", ""),
    (["300000", ""], "nothing came; ", ""),
    (["300000", "320000"], "320000 came; ", ""),
    (["300000", "050100000102"], "050100000102 came; ", ""),
    (["300000", "10c8010000000000"], "10c8010000000000 came; ", ""),
]  # fmt: skip


@pytest.mark.parametrize(("answers", "words", "seen"), BUSY)
def test_a_second_station_s_first_frame_is_taken_up_or_refused_with_17(
    answers: list[str], words: str, seen: str
) -> None:
    first, second = _Bus(answers[0]), _Bus(*answers[1:])
    paused, numbers = list[float](), list[int]()

    def from_station(number: int) -> Any:
        numbers.append(number)
        return SimpleNamespace(line=second)

    def refused(command: Command, reason: int, why: str) -> str:
        assert (len(command.encode()), reason, why, paused) == (107, 3, "a long request after it", [1.2])
        return "refused"

    probe = SimpleNamespace(from_station=from_station, bus=first, pause=paused.append, refused=refused)
    if words:
        with pytest.raises(RuleBrokenError) as broken:
            link_rules.can_busy(probe)  # type: ignore[arg-type]
        due = f"A second station's first frame beside another's long request: {words}"
        due += "a flow control, or a single frame with refusal 17, is due."
        assert str(broken.value) == (words if len(answers) == 1 else due)
        assert paused == []
    else:
        assert link_rules.can_busy(probe) == seen  # type: ignore[arg-type]
        assert second.begun == [200]
    assert (first.begun, numbers) == ([200], [1])


WTX = [
    (["f201"], "multiplier 1"),
    (["f23b"], "multiplier 59"),
    (["f20a", "f202", "f20a"], "multiplier 2, 10"),
    (["f228", "f201"], "multiplier 1, 40"),
    (["f2c5"], "multiplier 5"),
    (["f201", "f200f2", "f2", "0a00", "e23f"], "multiplier 1"),
    (["f200"], "S(WTX) with multiplier 0: 1 to 59 are allowed."),
    (["f23c", "f201", "f23f"], "S(WTX) with multiplier 60, 63: 1 to 59 are allowed."),
    ([], "The board never asked for more time, so there is no S(WTX) to look at."),
]


@pytest.mark.parametrize(("blocks", "seen"), WTX)
def test_a_board_asks_for_1_to_59_times_its_waiting_time(blocks: list[str], seen: str) -> None:
    frames = [HeardFrame("nfc", "in", bytes.fromhex(octets), None, False) for octets in blocks]
    frames.append(HeardFrame("nfc", "out", b"\xf2\0", None, False))
    probe: Any = SimpleNamespace(heard=SimpleNamespace(frames=frames), contact=SimpleNamespace(address=None))
    if "allowed" in seen or "never" in seen:
        with pytest.raises(RuleBrokenError if "allowed" in seen else NotApplicableError) as no:
            link_rules.nfc_wtx(probe)
        assert str(no.value) == seen
    else:
        assert link_rules.nfc_wtx(probe) == seen


def test_a_service_record_announces_a_wait_of_whole_steps() -> None:
    def tried(wt_int: int) -> str:
        link = SimpleNamespace(announced={"WT_INT": wt_int, "N": 3})
        return link_rules.nfc_wait_time(SimpleNamespace(contact=SimpleNamespace(link=link)))  # type: ignore[arg-type]

    assert (tried(0), tried(8)) == ("WT_INT 0, N 3", "WT_INT 8, N 3")
    for wrong in (1, 2, 7, 62):
        with pytest.raises(RuleBrokenError) as broken:
            tried(wrong)
        assert str(broken.value) == f"WT_INT is {wrong}: implementations round what is no multiple of 4 differently."


def test_a_rule_of_another_link_says_how_to_connect_the_board() -> None:
    elsewhere: Any = _probe([], contact=SimpleNamespace(address=None, link=None))
    on_a_bus: Any = _probe([])
    unheard: Any = _probe([], heard=None)
    for rule, probe, words in (
        (link_rules.can_flow_control, elsewhere, f"A rule of CAN. {OVER_CAN}"),
        (link_rules.can_flow_control, unheard, f"A rule of CAN. {OVER_CAN}"),
        (link_rules.can_form, elsewhere, f"A rule of CAN. {OVER_CAN}"),
        (link_rules.nfc_wait_time, on_a_bus, f"A rule of NFC. {OVER_NFC}"),
        (link_rules.nfc_wtx, on_a_bus, f"A rule of NFC. {OVER_NFC}"),
        (link_rules.nfc_wtx, unheard, f"A rule of NFC. {OVER_NFC}"),
    ):
        with pytest.raises(NotApplicableError) as no:
            rule(probe)
        assert str(no.value) == words
    nothing_heard: Any = SimpleNamespace(heard=None, contact=SimpleNamespace(address=None))
    with pytest.raises(NotApplicableError, match=r"never asked for more time"):
        link_rules.nfc_wtx(nothing_heard)


def test_a_node_is_what_it_was_when_it_was_found() -> None:
    assert link_rules.identify_found(_probe([])) == "the same when it was found and when it is asked"
    later = replace(IDENTITY, epoch=5)
    with pytest.raises(RuleBrokenError, match=r"found as Identity\(.*epoch=4.*; Identify says Identity\(.*epoch=5"):
        link_rules.identify_found(_probe([], identity=lambda: later))
