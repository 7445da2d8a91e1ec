"""What the last step asks of a board: each channel, one reading of each free sensor, and nothing stays claimed."""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Mapping
from typing import Any

import pytest

from teds_provision import teds
from teds_provision.errors import BadDataError, NodeRefusedError
from teds_provision.protocol.messages.frames import Command, Reason
from teds_provision.provisioning.board_type import (
    HardwareCheck,
    WrongBoardError,
    check_hardware,
    operate,
    require_working_hardware,
    shown_by,
)
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.teds.image import BlockId, Image
from teds_provision.teds.units import parse_unit

UUID = bytes.fromhex("8d4d9da65281f7000000")
SECURITY = b"a Security TEDS"
DIGEST = hashlib.sha256(SECURITY).digest()[:16]
SENSOR, ACTUATOR, EVENT = 0, 1, 2
CLAIMED_HERE, CLAIMED_BY_OTHER = 2, 4
OPERATE, SAMPLE, OPERATION = 18, 12, 19


def datasheet(*kinds: int, **more: object) -> Image:
    """Return a datasheet of channels with Float32 values in m, which need no calibration."""
    blocks: dict[BlockId, bytes] = {(0, 128): SECURITY}
    for number, kind in enumerate(kinds, 1):
        fields: dict[str, Any] = {
            "ChanType": kind,
            "PhyUnits": parse_unit("m").units,
            "Sample": {"DatModel": 1, "ModLenth": 4, "SigBits": 24},
            **more,
        }
        blocks[number, 3] = teds.compose(3, fields)
    return Image(UUID, blocks)


class Node:
    """A board whose channels answer Operate as told: with a reason, or (None) by taking the claim."""

    sealed, early = True, None

    def __init__(self, answers: Mapping[int, int | None] | None = None, *, octets: int = 0, **facts: Any) -> None:
        self.answers, self.octets = dict(answers or {}), octets
        self.states: dict[int, int] = facts.get("states", {})
        self.invalid: frozenset[int] = frozenset(facts.get("invalid", ()))
        self.operation: Reason | None = facts.get("operation")
        self.sampling: Reason | None = facts.get("sampling")
        self.asked: list[tuple[str, Any]] = []
        self.value: float | None = None
        self.claimed: set[int] = set()
        self.uuid = UUID

    def request(self, command: Command, _why: str = "") -> bytes:
        channel, payload = command.channel, command.payload
        if (command.command_class, command.function) == (128, OPERATION):
            if self.operation is not None:
                raise NodeRefusedError("refused", reason=self.operation)
            rows = (bytes([number, state, 0]) for number, state in sorted(self.states.items()))
            return b"\0" + b"".join(rows)
        if (command.command_class, command.function) == (128, SAMPLE):
            numbers = list(payload)
            self.asked.append(("sample", numbers))
            if self.sampling is not None:
                raise NodeRefusedError("busy", reason=self.sampling)
            bad = bool(self.invalid & set(numbers))
            values = [self.value or number for number in numbers]
            floats, raws = struct.pack(f">{len(values)}f", *values), bytes(self.octets * len(numbers))
            return struct.pack(">QB", 1, bad) + (raws or floats)
        if len(payload) < 16:
            self.asked.append(("idle", channel))
            self.claimed.clear()
            return b""
        assert payload[:16] == DIGEST
        lease = payload[16]
        self.asked.append(("operate", (channel, lease, payload[17:])))
        reason = self.answers.get(channel, None if lease else Reason.OUT_OF_RANGE)
        if reason is not None:
            raise NodeRefusedError("refused", reason=Reason(reason))
        if lease:
            self.claimed.add(channel)
        return b""

    def kinds(self) -> list[str]:
        return [what for what, _ in self.asked]


def check(node: Node, image: Image, shown: Mapping[int, str] | None = None) -> HardwareCheck:
    found = check_hardware(node, image, shown)  # type: ignore[arg-type]
    assert node.claimed == set(), "nothing stays claimed"
    return found


def test_each_sensor_is_claimed_read_and_let_go_and_an_actuator_is_asked_without_a_claim() -> None:
    node = Node()
    found = check(node, datasheet(SENSOR, ACTUATOR, EVENT))
    assert found.channels == {1: True, 2: True, 3: True}
    operated = [detail for what, detail in node.asked if what == "operate"]
    assert [(channel, lease) for channel, lease, _ in operated] == [(1, 5), (2, 0), (3, 5)]
    assert [bool(more) for *_, more in operated] == [False, True, False], "the dead-man of an actuator alone"
    assert node.kinds() == ["operate"] * 3 + ["sample", "idle"]
    assert [(sample["channel"], sample["value"], sample["valid"]) for sample in found.samples] == [
        (1, 1.0, True), (3, 3.0, True),
    ]  # fmt: skip
    assert (found.asked, found.warnings) == (True, ())


def test_a_reading_is_shown_in_the_units_of_the_type_and_given_in_si() -> None:
    found = check(Node(), datasheet(SENSOR), {1: "mm"})
    (sample,) = found.samples
    assert (sample["value"], sample["unit"]) == (1.0, "m")
    assert sample["shown"] == {"value": pytest.approx(1000.0), "unit": "mm"}


@pytest.mark.parametrize("reason", [Reason.DIGEST_MISMATCH, Reason.BAD_FORM])
@pytest.mark.parametrize("kind", [SENSOR, ACTUATOR])
def test_a_channel_that_does_not_bear_its_datasheet_is_named_and_the_others_let_go(reason: Reason, kind: int) -> None:
    node = Node({2: reason})
    with pytest.raises(WrongBoardError, match=r"^Channel 2 \(no name\) of the board does not match this datasheet"):
        check_hardware(node, datasheet(SENSOR, kind, SENSOR))  # type: ignore[arg-type]
    assert node.claimed == set()
    assert node.kinds()[-1] == "idle"


@pytest.mark.parametrize("reason", [Reason.BUSY, Reason.FAULT])
def test_a_sensor_that_is_busy_or_out_of_order_bears_its_datasheet_and_is_not_read(reason: Reason) -> None:
    node = Node({1: reason})
    found = check(node, datasheet(SENSOR, SENSOR))
    assert (found.channels, found.samples) == ({1: True, 2: True}, ())
    (warning,) = found.warnings
    assert warning.startswith("No reading was taken: ")
    assert "sample" not in node.kinds()


@pytest.mark.parametrize(
    ("reason", "accepts"),
    [
        (Reason.OUT_OF_RANGE, True),
        (None, None),  # a lease of 0 taken: it does not keep the profile
        (Reason.BUSY, None),
        (Reason.FAULT, None),
        (Reason.UNKNOWN_COMMAND, None),
    ],
)
def test_an_actuator_bears_its_datasheet_if_it_refuses_a_lease_of_0_alone(
    reason: Reason | None, accepts: bool | None
) -> None:
    found = check(Node({1: reason}), datasheet(ACTUATOR))
    assert (found.channels, found.asked, found.samples) == ({1: accepts}, bool(accepts), ())


def test_a_sensor_that_cannot_be_claimed_for_another_reason_is_skipped() -> None:
    node = Node({1: Reason.OUT_OF_RANGE})
    found = check(node, datasheet(SENSOR, SENSOR))
    assert found.channels == {1: None, 2: True}
    assert [sample["channel"] for sample in found.samples] == [2]


def test_a_sensor_of_another_session_is_asked_without_a_claim_and_not_read() -> None:
    node = Node(states={1: CLAIMED_BY_OTHER, 2: CLAIMED_HERE})
    found = check(node, datasheet(SENSOR, SENSOR))
    assert [(channel, lease) for what, (channel, lease, _) in node.asked[:2]] == [(1, 0), (2, 5)]
    assert found.channels == {1: True, 2: True}
    assert [sample["channel"] for sample in found.samples] == [2]
    alone = Node(states={1: CLAIMED_BY_OTHER})
    assert check(alone, datasheet(SENSOR)).samples == ()
    assert alone.kinds() == ["operate"], "nothing was claimed, so nothing is let go"


def test_a_board_that_does_not_measure_is_skipped_with_all_its_channels() -> None:
    node = Node(operation=Reason.UNKNOWN_COMMAND)
    found = check(node, datasheet(SENSOR, ACTUATOR))
    assert (found.channels, found.asked, found.warnings) == ({1: None, 2: None}, False, ())
    assert node.asked == []


def test_a_board_that_does_not_tell_its_mode_is_asked_for_each_channel_all_the_same() -> None:
    found = check(Node({1: Reason.OUT_OF_RANGE}, operation=Reason.BUSY), datasheet(SENSOR))
    assert (found.channels, found.samples) == ({1: True}, ())
    assert [text.startswith("No reading was taken: ") for text in found.warnings] == [True]
    assert check(Node(operation=Reason.BUSY), datasheet(ACTUATOR)).warnings == (), "there is no sensor to read"


def test_a_reading_that_fails_is_a_warning_and_lets_go() -> None:
    node = Node(sampling=Reason.BUSY)
    found = check(node, datasheet(SENSOR))
    assert (found.channels, found.warnings) == ({1: True}, ("No reading was taken: busy",))
    assert node.kinds()[-1] == "idle"


def test_invalid_readings_are_a_warning_and_no_value() -> None:
    found = check(Node(invalid=[1]), datasheet(SENSOR, SENSOR))
    assert [(sample["value"], sample["shown"]["value"], sample["valid"]) for sample in found.samples] == [
        (None, None, False)
    ] * 2
    assert found.warnings == ("The readings of channels 1, 2 are invalid.",)
    json = found.samples[0]
    assert math.isfinite(json["channel"])


def test_a_reading_outside_of_the_limits_or_that_is_no_number_is_invalid() -> None:
    found = check(Node(), datasheet(*[SENSOR] * 3, LowLimit=1.5, HiLimit=2.5))
    assert [(sample["value"], sample["valid"]) for sample in found.samples] == [
        (None, False), (2.0, True), (None, False),
    ]  # fmt: skip
    assert found.warnings == ("The readings of channels 1, 3 are invalid.",)
    node = Node()
    node.value = math.nan
    (sample,) = check(node, datasheet(SENSOR)).samples
    assert (sample["value"], sample["shown"]["value"], sample["valid"]) == (None, None, False)


@pytest.mark.parametrize(
    ("channels", "octets", "parts"),
    [(64, 1, [64]), (65, 1, [64, 1]), (45, 4, [45]), (46, 4, [45, 1]), (2, 91, [1, 1]), (3, 60, [3])],
)
def test_a_reply_has_at_most_180_octets_of_at_most_64_channels(channels: int, octets: int, parts: list[int]) -> None:
    model = 0 if octets <= 4 else 5
    blocks: dict[BlockId, bytes] = {(0, 128): SECURITY}
    for number in range(1, channels + 1):
        fields: dict[str, Any] = {"ChanType": 0, "Sample": {"DatModel": model, "ModLenth": octets, "SigBits": 8}}
        blocks[number, 3] = teds.compose(3, fields)
    node = Node(octets=octets)
    check(node, Image(UUID, blocks))
    assert [len(numbers) for what, numbers in node.asked if what == "sample"] == parts


class ForgetfulNode(Node):
    """A node that loses its session at the first request of each of so many sessions."""

    def __init__(self, losses: int, reason: Reason) -> None:
        super().__init__()
        self.losses, self.reason, self.opened = losses, reason, 0

    def request(self, command: Command, _why: str = "") -> bytes:
        if self.losses > self.opened:
            raise SessionLostError(NodeRefusedError("lost", reason=self.reason))
        return super().request(command)

    def reopen(self) -> None:
        self.opened += 1


def test_a_session_that_was_lost_is_opened_again_once() -> None:
    once = ForgetfulNode(1, Reason.WRONG_STATE)
    assert check(once, datasheet(SENSOR)).channels == {1: True}
    assert once.opened == 1
    for losses, reason, opened in ((2, Reason.WRONG_STATE, 1), (1, Reason.BUSY, 0)):
        node = ForgetfulNode(losses, reason)
        with pytest.raises(NodeRefusedError) as refused:
            check_hardware(node, datasheet(SENSOR))  # type: ignore[arg-type]
        assert (refused.value.reason, node.opened) == (reason, opened)


# -- new firmware ------------------------------------------------------------------------------------------------------


def works(node: Node, image: Image) -> list[tuple[str, Any]]:
    require_working_hardware(node, image)  # type: ignore[arg-type]
    assert node.claimed == set()
    return node.asked


def claims(asked: list[tuple[str, Any]]) -> list[int]:
    return [detail[0] for what, detail in asked if what == "operate" and detail[1]]


def test_new_firmware_serves_every_channel_and_one_free_sensor_gives_one_valid_value() -> None:
    asked = works(Node(), datasheet(ACTUATOR, SENSOR, SENSOR))
    assert [detail[:2] for what, detail in asked if what == "operate"] == [(1, 0), (2, 0), (3, 0), (2, 5)]
    assert claims(works(Node(invalid=[1, 2]), datasheet(SENSOR, SENSOR, SENSOR))) == [1, 2, 3], (
        "a probe may be unplugged"
    )
    assert claims(works(Node(states={1: CLAIMED_BY_OTHER}), datasheet(SENSOR, SENSOR))) == [2]
    assert claims(works(Node(states={1: CLAIMED_BY_OTHER}), datasheet(SENSOR, ACTUATOR))) == []
    with pytest.raises(WrongBoardError, match=r"^Channel 2 "):
        works(Node({2: Reason.DIGEST_MISMATCH}), datasheet(SENSOR, SENSOR))


def test_new_firmware_whose_first_eight_sensors_give_no_value_does_not_work() -> None:
    nine = datasheet(*[SENSOR] * 9)
    node = Node(invalid=range(1, 9))
    with pytest.raises(BadDataError, match=r"^No sensor of the board gives a valid value\.$"):
        require_working_hardware(node, nine)  # type: ignore[arg-type]
    assert (claims(node.asked), node.claimed) == (list(range(1, 9)), set())
    assert claims(works(Node(invalid=range(1, 8)), nine)) == list(range(1, 9))
    faulty = Node(sampling=Reason.FAULT)
    with pytest.raises(BadDataError):
        require_working_hardware(faulty, datasheet(SENSOR))  # type: ignore[arg-type]
    assert faulty.claimed == set()


def test_new_firmware_of_a_board_that_does_not_measure_is_asked_no_more() -> None:
    node = Node(dict.fromkeys((1, 2), Reason.UNKNOWN_COMMAND), operation=Reason.UNKNOWN_COMMAND)
    assert [what for what, _ in works(node, datasheet(SENSOR, ACTUATOR))] == ["operate"] * 2


# -- words -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("channel", "named"), [(3, "channel 3"), (0, "any sensor")])
def test_a_refused_claim_says_which_channel_and_what_to_do(channel: int, named: str) -> None:
    for reason, text, hint in (
        (Reason.DIGEST_MISMATCH,
         f"The board's hardware does not match its datasheet on {named}: the kind, format or length of a value differs"
         " (reason 6).", "Run verify UUID, then provision it again."),
        (Reason.FAULT, f"The node cannot measure with {named} now: its hardware reports a fault, or it has too little"
         " power (reason 23).", "Check its self-test and battery: mode UUID."),
        (Reason.BUSY, "refused", ""),
    ):  # fmt: skip
        with pytest.raises(NodeRefusedError) as refused:
            operate(Node({channel: reason}), channel, DIGEST + b"more", lease=5)  # type: ignore[arg-type]
        assert (refused.value.message, refused.value.reason) == (text, reason)
        assert refused.value.hint.endswith(hint)


def test_of_what_a_board_shows_the_descriptions_of_these_channels_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    from teds_provision.provisioning import board_type

    listed = [(0, 1), (0, 3), (1, 3), (1, 5), (2, 3), (3, 3)]
    monkeypatch.setattr(board_type, "list_blocks", lambda _node: listed)
    monkeypatch.setattr(board_type, "read_block", lambda _node, block: bytes(block))
    assert shown_by(Node(), {1, 3}) == {(1, 3): b"\1\3", (3, 3): b"\3\3"}  # type: ignore[arg-type]
