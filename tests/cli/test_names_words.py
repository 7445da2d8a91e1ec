"""``names``: all that it prints, refuses and writes into the log, without links."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision import provisioning
from teds_provision.cli.measure import names
from teds_provision.errors import NotFoundError
from teds_provision.measure.blocks import ChannelFacts
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile

from .shell import call

HAND, CELL = bytes.fromhex("8d4d9da65281f7000000"), bytes.fromhex("91aa9da65281f7000000")
H, C = HAND.hex(), CELL.hex()
KNOWN = [
    (HAND, 1, ChannelFacts(H, "hand", 1, "opening", frame="tip")),
    (HAND, 2, ChannelFacts(H, "hand", 2, "grip force")),
    (CELL, 1, ChannelFacts(C, "", 1, "")),
]
LIST = f"""\
{H} 1: /bench/hand/opening
{H} 2: /bench/hand/grip_force
{C} 1: /bench/{C[:8]}/channel_1
"""


@pytest.fixture
def desk(home: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for uuid, name in ((H, "hand"), (C, "cell")):
        assert call(home, "whitelist", "add", uuid, "--fingerprint", "ab" * 32, "--name", name).code == 0
    monkeypatch.setattr(names, "_channels", lambda _station: KNOWN)
    return home


def shown(desk: Path, *words: object) -> str:
    done = call(desk, "names", *words)
    assert done.code == 0, done
    return done.out


def test_names_are_listed_chosen_planned_and_reset(desk: Path) -> None:
    plain = shown(desk, "list").splitlines()
    assert [line.partition(", frame ")[0] for line in plain][:2] == LIST.splitlines()[:2]
    assert plain[2].startswith(f"{C} 1: /bench/")
    assert shown(desk, "set", "hand", 1, "/crane/slew/").splitlines()[0].startswith(f"{H} 1: /crane/slew (chosen)")
    plan = call(desk, "names", "set", "hand", "GRIP FORCE", "other", "--dry-run")
    assert plan.err == "Plan, nothing is changed:\n"
    assert f"{H} 2: /other (chosen)" in plan.out
    assert f"{H} 2: /bench/hand/grip_force" in shown(desk, "list")
    own = shown(desk, "set", C, 0, "scale")
    assert "/bench/scale/" in own
    assert own.splitlines()[2].endswith(" (chosen)")
    assert not own.splitlines()[1].endswith(" (chosen)")
    assert "/crane_7/scale/" in shown(desk, "set", "station", 0, "crane_7")
    for words in (("hand", "opening"), (C, 0), ("station", 0)):
        shown(desk, "reset", *words)
    assert shown(desk, "list").splitlines() == plain
    rows = call(desk, "--json", "names", "list").json
    assert rows["station"] == "bench"
    assert rows["names"][1] == {
        "uuid": H,
        "channel": 2,
        "topic": "/bench/hand/grip_force",
        "chosen": False,
        "frame": None,
    }
    log = [entry for entry in call(desk, "--json", "log").json["entries"] if entry["act"] == "rename"]
    assert [(entry["uuid"], entry["detail"]) for entry in log] == [
        (H, {"channel": 1, "name": "crane/slew"}),
        (C, {"channel": 0, "name": "scale"}),
        (None, {"channel": 0, "name": "crane_7"}),
        (H, {"channel": 1, "name": None}),
        (C, {"channel": 0, "name": None}),
        (None, {"channel": 0, "name": None}),
    ]


def test_frames_are_chosen_and_taken_back(desk: Path) -> None:
    assert f"{H} 2: /bench/hand/grip_force, frame left/gripper_1" in shown(desk, "frame", "hand", 2, "left/gripper_1")
    plan = call(desk, "--json", "names", "frame", "hand", 0, "palm", "--dry-run")
    assert [row["frame"] for row in plan.json["names"]][:2] == ["palm", "left/gripper_1"]
    assert [row["frame"] for row in call(desk, "--json", "names", "list").json["names"]][1] == "left/gripper_1"
    assert ", frame left" not in shown(desk, "frame", "hand", 2, "")
    log = [entry for entry in call(desk, "--json", "log").json["entries"] if entry["act"] == "frame"]
    assert [(entry["uuid"], entry["detail"]) for entry in log] == [
        (H, {"channel": 2, "frame": "left/gripper_1"}),
        (H, {"channel": 2, "frame": ""}),
    ]


TOPIC = "Use letters, digits and single _, starting with a letter; / separates the parts of a channel's name."
HAS = "Channels in its datasheet: 1 (opening), 2 (grip force)."


@pytest.mark.parametrize(
    ("words", "code", "message", "hint"),
    [
        (("set", "hand", "1", "a//b"), 2, "'a//b' is not a valid topic name.", TOPIC),
        (("set", "hand", "0", "a/b"), 2, "'a/b' is not a valid topic name.", TOPIC),
        (("set", "station", "0", "a/b"), 2, "'a/b' is not a valid topic name.", TOPIC),
        (("set", "hand", "1", "7th"), 2, "'7th' is not a valid topic name.", TOPIC),
        (("set", "hand", "3", "x"), 3, f"{H} has no channel 3.", HAS),
        (("set", "hand", "torque", "x"), 3, f"{H} has no channel 'torque'.", HAS),
        (("set", C, "torque", "x"), 3, f"{C} has no channel 'torque'.", "Channels in its datasheet: 1."),
        (("set", "station", "1", "x"), 3, None, "Channels in its datasheet: none."),
        (("reset", "hand", "torque"), 3, f"{H} has no channel 'torque'.", HAS),
        (("frame", "hand", "1", "a b"), 2, "'a b' is not a valid frame.",
         "Use letters, digits, _ and /, starting with a letter."),
        (("frame", "hand", "9", "a"), 3, f"{H} has no channel 9.", HAS),
    ],
)  # fmt: skip
def test_what_names_nothing_is_refused(
    words: tuple[str, ...], code: int, message: str | None, hint: str, desk: Path
) -> None:
    error = call(desk, "--json", "names", *words)
    assert (error.code, error.json["error"]["hint"]) == (code, hint)
    assert message is None or error.json["error"]["message"] == message


def test_a_channel_that_the_datasheet_lost_is_reset_by_its_number(desk: Path) -> None:
    assert call(desk, "names", "reset", "hand", 9).code == 0


def test_a_topic_belongs_to_one_channel(desk: Path) -> None:
    shown(desk, "set", "hand", 1, "slew")
    refused = call(desk, "--json", "names", "set", C, 1, "slew")
    assert refused.code != 0
    assert "slew" in refused.json["error"]["message"]
    shown(desk, "set", "hand", 1, "slew")


@pytest.mark.parametrize(
    ("verdict", "name", "unverified"),
    [
        ("authentic", "cell of the arm", False),
        ("unsigned", "thumb", True),
        ("not authentic", "cell of the arm", False),
        (None, "cell of the arm", False),
    ],
)
def test_a_node_without_a_signature_has_the_name_of_its_own_teds(
    verdict: str | None, name: str, unverified: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = Image(HAND, load_profile("load-cell").build(HAND, name="thumb").blocks)
    kept = {HAND: image}
    records = [SimpleNamespace(uuid=HAND, name="cell of the arm"), SimpleNamespace(uuid=CELL, name=None)]
    station: Any = SimpleNamespace(
        nodes=SimpleNamespace(all=lambda: records), datasheets=SimpleNamespace(datasheet=kept.get)
    )
    judged = SimpleNamespace(verified=SimpleNamespace(verdict=verdict)) if verdict is not None else None
    monkeypatch.setattr(provisioning.readings, "verdict_of", lambda _station, _uuid: judged)
    [(uuid, number, facts)] = names._channels(station)
    assert (uuid, number, facts.key) == (HAND, 1, (H, 1))
    assert (facts.node, facts.unverified, facts.name) == (name, unverified, load_profile("load-cell").channels[0].name)
    kept[CELL] = Image(CELL, load_profile("load-cell").build(CELL, name="").blocks)
    _, (_, _, other) = names._channels(station)
    assert other.node == ("load cell" if verdict == "unsigned" else "")


def test_slashes_around_a_name_are_no_part_of_it(desk: Path) -> None:
    assert "/bench/slew/" in shown(desk, "set", "hand", 0, "/slew/")
    assert f"{H} 1: /crane/slew (chosen)" in shown(desk, "set", "hand", 1, "//crane/slew/")
    assert "/crane_7/slew/" in shown(desk, "set", "station", 0, "/crane_7")


@pytest.mark.parametrize(
    ("uuid", "channel", "number"),
    [
        (HAND, 1, 1), (HAND, 0, 0), (HAND, "OPENING", 1), (HAND, "opening", 1), (HAND, 9, None), (HAND, "twice", None),
        (HAND, "knee", None), (b"u" * 10, 7, 7), (b"u" * 10, 0, 0), (b"u" * 10, "opening", None),
        (names.STATION, 0, 0), (names.STATION, 1, None),
    ],
)  # fmt: skip
def test_a_channel_is_one_of_the_datasheet_or_any_number_if_that_is_not_known(
    monkeypatch: pytest.MonkeyPatch, uuid: bytes, channel: int | str, number: int | None
) -> None:
    twice = [(HAND, number, ChannelFacts(H, "hand", number, "Twice")) for number in (3, 4)]
    monkeypatch.setattr(names, "_channels", lambda _station: [*KNOWN, *twice])
    station: Any = None
    if number is not None:
        assert names._require_channel(station, uuid, channel) == number
        return
    with pytest.raises(NotFoundError) as refused:
        names._require_channel(station, uuid, channel)
    has = "1 (opening), 2 (grip force), 3 (Twice), 4 (Twice)" if uuid == HAND else "none"
    assert refused.value.message == f"{uuid.hex()} has no channel {channel!r}."
    assert refused.value.hint == f"Channels in its datasheet: {has}."


def test_the_topic_that_another_channel_has_by_default_is_taken(desk: Path) -> None:
    refused = call(desk, "--json", "names", "set", "hand", 1, "bench/hand/grip_force")
    assert (refused.code, f"channel 2 of node {H}" in refused.json["error"]["message"]) == (2, True)
    assert "(chosen)" not in shown(desk, "list")
    shown(desk, "set", "hand", 2, "bench/hand/grip_force")
