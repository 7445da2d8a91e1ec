"""About, Locate and the permission of Manage: published octets, any octets, each state, a board with and without."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import GarbledError
from teds_provision.protocol.announce import Announce, ButtonPresses, uuid_crc
from teds_provision.protocol.messages.firmware import ABOUT, FirmwareFlag, FirmwareReport, parse_version
from teds_provision.protocol.messages.frames import Command, Function, Reason, refusal, security_command
from teds_provision.protocol.repetition import Repetition
from teds_provision.protocol.tim import Tim

from .desk import NODE, Desk

VECTORS: dict[str, Any] = json.loads(
    (Path(__file__).parent.parent / "vectors" / "profile" / "firmware_kat.json").read_text(encoding="utf-8")
)
REPORT = FirmwareReport("board/loadcell", (1, 2, 3), 4, bytes(range(32)), FirmwareFlag.LOCATE)
MANAGE = security_command(Function.MANAGE, bytes.fromhex("0800000100000006a0"))


def locate(*octets: int) -> Command:
    return security_command(Function.LOCATE, bytes(octets))


@dataclass
class Board:
    """Firmware that reports, and the seconds for which it was made to blink."""

    report: FirmwareReport | None = REPORT
    blinks: list[int] = field(default_factory=list)

    def about(self) -> FirmwareReport | None:
        return self.report

    def locate(self, seconds: int) -> None:
        self.blinks.append(seconds)


class FirmwareDesk(Desk):
    """A desk whose node has firmware to report."""

    def __init__(self, board: Board | None) -> None:
        self.board = board
        super().__init__()

    def restart(self) -> None:
        self.tim = Tim(NODE, self.memory, lambda: self.now, max_message=self.max_message, firmware=self.board)


def meaning(report: FirmwareReport) -> dict[str, Any]:
    return {
        "flags": [str(flag.name).lower() for flag in FirmwareFlag if flag in report.flags],
        "version": report.version_text,
        "build": report.build,
        "image": None if report.image is None else report.image.hex(),
        "text": report.text,
        "board": report.board,
        "application": report.application,
    }


@pytest.mark.parametrize("vector", VECTORS["about"], ids=lambda vector: vector["name"])
def test_the_published_reports_mean_what_the_file_states(vector: dict[str, Any]) -> None:
    payload = bytes.fromhex(vector["payload"])
    if vector["means"] is None:
        with pytest.raises(GarbledError):
            FirmwareReport.decode(payload)
        return
    report = FirmwareReport.decode(payload)
    assert meaning(report) == vector["means"]
    assert FirmwareReport.decode(payload[:1] + bytes([payload[1] | 0xC0]) + payload[2:]) == report, "bits 6 and 7"
    assert report.encode() == payload[:1] + bytes([payload[1] & 0x3F]) + payload[2:]


@pytest.mark.parametrize("vector", VECTORS["announce"], ids=lambda vector: vector["name"])
def test_the_published_announces_show_whether_the_button_was_pressed(vector: dict[str, Any]) -> None:
    identifier, _, data = vector["can"].partition("#")
    announce = Announce.decode(int(identifier, 16), bytes.fromhex(data))
    assert announce is not None
    assert (announce.pressed, announce.crc) == (vector["pressed"], uuid_crc(bytes.fromhex(vector["uuid"])))
    if bytes.fromhex(data)[6] < 2:
        assert announce.encode().hex() == data


texts = st.text("AZaz09._+-/", max_size=48)
digests = st.none() | st.binary(min_size=32, max_size=32).filter(any)
versions = st.tuples(st.integers(0, 255), st.integers(0, 255), st.integers(0, 65535))
flags = st.integers(0, 0x3F).map(FirmwareFlag)


@given(st.builds(FirmwareReport, texts, versions, st.integers(0, 2**32 - 1), digests, flags))
def test_what_is_encoded_is_decoded(report: FirmwareReport) -> None:
    octets = report.encode()
    assert 42 <= len(octets) <= 90
    assert FirmwareReport.decode(octets) == report
    assert parse_version(report.version_text) == report.version


@given(st.binary(max_size=100) | st.binary(min_size=41, max_size=95).map(lambda octets: b"\1" + octets))
def test_any_octets_are_a_report_or_refused(octets: bytes) -> None:
    try:
        report = FirmwareReport.decode(octets)
    except GarbledError:
        return
    assert report.encode()[2:] == octets[2:]


@pytest.mark.parametrize(
    "wrong",
    [
        {"text": "a b"},
        {"text": "x" * 49},
        {"text": "ü"},
        {"version": (256, 0, 0)},
        {"version": (0, 0, 65536)},
        {"build": -1},
        {"image": bytes(32)},
        {"image": bytes(31)},
    ],
)
def test_what_the_payload_cannot_carry_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"firmware|version|build|image"):
        FirmwareReport(**wrong)


@pytest.mark.parametrize("text", ["", "1", "1.2", "1.2.3.4", "256.0.0", "0.256.0", "0.0.65536", "1.2.x", "-1.0.0"])
def test_what_is_no_version_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not a version"):
        parse_version(text)


OK = None
# board: about, locate (10 s), manage; factory on nfc, keyed on nfc, keyed on ble, keyed on can, in session
TABLE: dict[str, tuple[Board | None, dict[str, tuple[int | None, ...]]]] = {
    "a board that reports and blinks": (
        Board(),
        {"about": (OK, 3, 3, OK, OK), "locate": (OK, 3, 3, 3, OK), "manage": (3, 3, 3, 3, 1)},
    ),
    "a board that has nothing to blink": (
        Board(FirmwareReport("b/a")),
        {"about": (OK, 3, 3, OK, OK), "locate": (1, 3, 3, 3, 1), "manage": (3, 3, 3, 3, 1)},
    ),
    "a board that reports nothing": (
        Board(None),
        {"about": (1, 3, 3, 1, 1), "locate": (1, 3, 3, 3, 1), "manage": (3, 3, 3, 3, 1)},
    ),
    "a node from before 128.21": (
        None,
        {"about": (1, 1, 1, 1, 1), "locate": (1, 1, 1, 1, 1), "manage": (1, 1, 1, 1, 1)},
    ),
}


@pytest.mark.parametrize("board", TABLE)
def test_each_command_in_each_state(board: str) -> None:
    firmware, due = TABLE[board]
    factory, keyed = FirmwareDesk(firmware), FirmwareDesk(firmware)
    keyed.agree().open()
    for name, command in {"about": ABOUT, "locate": locate(10), "manage": MANAGE}.items():
        found = (
            factory.plain(command),
            keyed.plain(command),
            keyed.plain(command, link="ble:2", tapped=False),
            keyed.plain(command, link="can:f1", tapped=False),
            keyed.sealed(command),
        )
        assert tuple(OK if reply.ok else reply.reason for reply in found) == due[name], name


def test_about_answers_what_runs_and_locate_blinks() -> None:
    desk = FirmwareDesk(board := Board(blinks=[]))
    assert FirmwareReport.decode(desk.plain(ABOUT).payload) == REPORT
    for seconds in (60, 10, 0):
        assert desk.plain(locate(seconds)).payload == b""
    assert board.blinks == [60, 10, 0]
    for wrong in (locate(61), locate(255), locate(), locate(1, 1), security_command(Function.ABOUT, b"\0")):
        assert desk.plain(wrong) == refusal(Reason.BAD_FORM)
    assert board.blinks == [60, 10, 0]
    desk.agree()
    assert desk.plain(locate(61), link="can:f1") == refusal(Reason.NOT_PERMITTED), "permission goes before form"


def test_a_repeated_about_is_run_again_and_a_repeated_locate_is_not() -> None:
    desk = FirmwareDesk(board := Board(blinks=[]))
    link = Repetition()

    def exchange(command: Command) -> bytes:
        return link.answer(7, command.encode(), lambda frame: desk.tim.handle(frame, link="nfc", tapped=True), now=0.0)

    first = exchange(ABOUT)
    board.report = FirmwareReport("board/loadcell", (1, 2, 4))
    assert exchange(ABOUT) != first
    board.report = REPORT
    assert exchange(locate(5)) == exchange(locate(5))
    assert board.blinks == [5]
    exchange(ABOUT)
    exchange(locate(5))
    assert board.blinks == [5, 5], "what came between takes the place of the stored reply"


def test_presses_are_announced_once_a_second_and_twenty_a_minute() -> None:
    presses = ButtonPresses()
    assert [presses.may_announce(at) for at in (10.0, 10.5, 10.99, 11.0)] == [True, False, False, True]
    presses = ButtonPresses()
    announced = [second for second in range(120) if presses.may_announce(float(second))]
    assert announced == [*range(20), *range(60, 80)]
