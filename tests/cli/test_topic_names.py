"""``names``: all that it prints, and a plan that shows the names as they would be."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.cli.measure import names as commands
from teds_provision.measure.blocks import ChannelFacts
from teds_provision.station.station import Station
from tests.bench import PASSPHRASE

from .shell import call

UUID = bytes(range(10))
NODE = UUID.hex()


@pytest.fixture
def topic(home: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Have one node with two channels; return the topic of the station."""
    with Station.open(home, ask=lambda prompt, confirm: PASSPHRASE) as station:
        with station.transaction():
            station.nodes.remember(UUID, name="left")
        name = station.name
    facts = [(UUID, number, ChannelFacts(NODE, "left", number, text)) for number, text in ((1, "angle"), (2, "torque"))]
    monkeypatch.setattr(commands, "_channels", lambda _: facts)
    return f"/{name}"


def listed(home: Path) -> Any:
    return call(home, "--json", "names", "list").json


def test_names_are_listed_for_people_and_as_json(home: Path, topic: str) -> None:
    assert call(home, "names", "list").out.splitlines() == [
        f"{NODE} 1: {topic}/left/angle",
        f"{NODE} 2: {topic}/left/torque",
    ]
    call(home, "names", "set", NODE, "1", "/crane/slew/")
    framed = call(home, "names", "frame", NODE, "0", "arm_x")
    assert framed.out.splitlines() == [
        f"{NODE} 1: /crane/slew (chosen), frame arm_x",
        f"{NODE} 2: {topic}/left/torque, frame arm_x",
    ]
    (one, two) = listed(home)["names"]
    assert (one["chosen"], two["chosen"], one["frame"], set(one)) == (
        True, False, "arm_x", {"uuid", "channel", "topic", "chosen", "frame"}
    )  # fmt: skip
    call(home, "names", "frame", NODE, "2", "tip")
    assert [each["frame"] for each in listed(home)["names"]] == ["arm_x", "tip"], "its own goes before its node's"
    call(home, "names", "set", NODE, "0", "right")
    assert [each["chosen"] for each in listed(home)["names"]] == [True, True]


def test_without_a_chosen_frame_that_of_the_profile_is_listed_with_the_nodes_name_in_it(
    home: Path, topic: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_type = {2: SimpleNamespace(frame="{node}_{node}_tip"), 1: SimpleNamespace(frame="")}
    monkeypatch.setattr(commands, "channel_profiles", lambda _station, _uuid: of_type)
    assert [each["frame"] for each in listed(home)["names"]] == [None, "left_left_tip"]
    call(home, "names", "set", NODE, "0", "right")
    call(home, "names", "frame", NODE, "1", "base")
    assert [each["frame"] for each in listed(home)["names"]] == ["base", "right_right_tip"]


@pytest.mark.parametrize(
    ("words", "planned"),
    [
        (("set", NODE, "2", "crane/slew"), "crane/slew (chosen)"),
        (("set", NODE, "0", "right"), "right/torque (chosen)"),
        (("frame", NODE, "2", "tip"), ", frame tip"),
        (("frame", NODE, "torque", "tip"), ", frame tip"),
    ],
)
def test_a_plan_shows_the_names_as_they_would_be(home: Path, topic: str, words: tuple[str, ...], planned: str) -> None:
    """It showed them as they were."""
    before = listed(home)
    entries = len(call(home, "--json", "log").json["entries"])
    plan = call(home, "names", *words, "--dry-run")
    assert (plan.code, plan.err) == (0, "Plan, nothing is changed:\n")
    assert plan.out.splitlines()[1].endswith(planned)
    assert listed(home) == before
    assert len(call(home, "--json", "log").json["entries"]) == entries
    assert call(home, "names", *words).out == plan.out
    reset = call(home, "names", *(("reset", *words[1:3]) if words[0] == "set" else ("frame", *words[1:3], "")))
    assert (reset.code, listed(home)) == (0, before)


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("set", NODE, "1", "no topic"), 2, "'no topic' is not a valid topic name."),
        (("set", NODE, "0", "a/b"), 2, "'a/b' is not a valid topic name."),
        (("set", NODE, "3", "x"), 3, f"{NODE} has no channel 3."),
        (("set", NODE, "force", "x"), 3, f"{NODE} has no channel 'force'."),
        (("set", "station", "1", "x"), 3, ""),
        (("frame", NODE, "1", "no frame"), 2, "'no frame' is not a valid frame."),
        (("reset", NODE, "force"), 3, f"{NODE} has no channel 'force'."),
    ],
)
def test_what_is_no_name_is_refused(home: Path, topic: str, words: tuple[str, ...], code: int, message: str) -> None:
    refused = call(home, "--json", "names", *words)
    assert refused.code == code
    assert message in refused.json["error"]["message"]
    if code == 3 and message:
        assert refused.json["error"]["hint"] == "Channels in its datasheet: 1 (angle), 2 (torque)."
