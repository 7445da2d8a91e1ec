"""Topics that somebody chose: by command, unique, frozen while they are measured, and found in the recording."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader

from tests.e2e.desk import ANGLE
from tests.measure.rig import Rig

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    made = Rig(tmp_path_factory.mktemp("rig"), {"a": ANGLE, "g": "gripper"})
    try:
        made.nodes["a"].start()
        yield made
    finally:
        made.close()


def topics(rig: Rig) -> dict[tuple[str, int], str]:
    reply = rig.station.ask("names", "list")
    return {(name["uuid"], name["channel"]): name["topic"] for name in reply["names"]}


def test_topics_are_listed_chosen_and_made_again(rig: Rig) -> None:
    a, g = rig.nodes["a"].uuid, rig.nodes["g"].uuid
    made = {(a, 1): "/bench/a/angle", (g, 1): "/bench/g/opening_set_point", (g, 2): "/bench/g/opening"}
    assert made.items() <= topics(rig).items()
    for words in ((a, 1, "crane/slew"), (g, 0, "hand"), ("station", 0, "crane_7")):
        rig.station.ask("names", "set", *words)
    chosen = topics(rig)
    assert (chosen[a, 1], chosen[g, 2]) == ("/crane/slew", "/crane_7/hand/opening")
    assert rig.station.ask("names", "set", a, 1, "other", "--dry-run")
    assert topics(rig) == chosen
    for words in ((a, 1), (g, 0), ("station", 0)):
        rig.station.ask("names", "reset", *words)
    rig.station.ask("names", "set", g, "grip force", "hand/force")
    assert topics(rig)[g, 3] == "/hand/force"
    rig.station.ask("names", "reset", g, "Grip Force")
    error = rig.station.refuses("names", "set", g, "torque", "x", code=3)
    assert error["hint"].startswith("Channels in its datasheet: 1 (opening set point), 2 (opening)")
    assert made.items() <= topics(rig).items()


def frame_of(rig: Rig, uuid: str) -> str | None:
    [found] = [name["frame"] for name in rig.station.ask("names", "list")["names"] if name["uuid"] == uuid]
    return None if found is None else str(found)


def test_frames_are_listed_chosen_and_taken_back(rig: Rig) -> None:
    a = rig.nodes["a"].uuid
    rig.station.ask("names", "frame", a, 0, "left_arm")
    rig.station.ask("names", "frame", a, 1, "left_arm/tip")
    assert frame_of(rig, a) == "left_arm/tip"
    rig.station.ask("names", "frame", a, 1, "")
    assert frame_of(rig, a) == "left_arm", "that of the whole node"
    rig.station.ask("names", "frame", a, 0, "")
    assert frame_of(rig, a) is None
    rig.station.refuses("names", "frame", a, 1, "no frame", code=2)
    rig.station.refuses("names", "frame", a, 9, "tip", code=3)


def test_a_channel_is_chosen_by_name_wherever_it_is_by_number(rig: Rig, tmp_path: Path) -> None:
    """By the name in the signed datasheet; a name that is none lists those that are."""
    g, bus, file = rig.nodes["g"], ["--can", rig.can], tmp_path / "run.csv"
    g.start()
    (opening,) = rig.station.ask("sample", "g", "opening", *bus)["samples"]
    assert (opening["channel"], opening["name"]) == (2, "opening")
    driven = rig.station.run("set", "g", "Opening set point", 0, "--hold", 0, *bus)
    assert driven.code == 0, driven
    assert driven.out.startswith("Channel 1 (opening set point): 0 m\n")
    driven = rig.station.run("set", "g", "opening", 0.05, "--hold", 0, *bus)  # by what it sets
    assert driven.out.startswith("Channel 1 (opening set point): "), driven
    error = rig.station.refuses("set", "g", "grip force", 5, "--hold", 0, *bus, code=8)
    assert "Channel 3 (grip force)" in error["message"]
    assert error["hint"] == "Its actuators: 1 (opening set point)."
    error = rig.station.refuses("sample", "g", "openning", *bus, code=8)
    assert "2 (opening), 3 (grip force)" in error["message"]
    error = rig.station.refuses("set", "g", "1", 99, "--hold", 0, *bus, code=6)
    assert "channel 1 (opening set point)" in error["message"]
    rig.station.refuses("measure", "g", "--channel", "torque", "--duration", 1, *bus, code=8)
    ended = rig.station.run("measure", "g", "--channel", "grip force", "--duration", "0.3", "--to", file, *bus)
    assert ended.code == 0, ended
    shown = rig.station.run("record", "show", file, "--channel", "grip force", "--limit", 3)
    assert shown.out.count("grip force") == 3
    error = rig.station.run("record", "show", file, "--channel", "opening")
    assert (error.code, error.out) == (3, "")
    assert "It has 3 (grip force)." in error.err
    g.kill()


def test_what_cannot_be_a_topic_is_refused(rig: Rig) -> None:
    a, g = rig.nodes["a"].uuid, rig.nodes["g"].uuid
    for wrong in ("1st", "a__b", "a b", "end_", "", "a//b"):
        rig.station.refuses("names", "set", a, 1, wrong, code=2)
    rig.station.refuses("names", "set", a, 0, "two/parts", code=2)
    rig.station.refuses("names", "set", a, 9, "nothing", code=3)
    rig.station.ask("names", "set", a, 1, "one")
    assert "already" in rig.station.refuses("names", "set", g, 1, "one", code=2)["message"]
    rig.station.ask("names", "reset", a, 1)


def test_a_chosen_name_is_in_the_recording_and_stays_while_it_is_measured(rig: Rig, tmp_path: Path) -> None:
    a, file = rig.nodes["a"].uuid, tmp_path / "run.mcap"
    rig.station.ask("names", "set", a, 0, "slew")
    running = rig.begin(a, "--rate", 20, "--to", file)
    running.wait_for('"event":"data"')
    assert rig.station.refuses("names", "set", a, 0, "other", code=6)["code"] == "frozen"
    running.signal(signal.SIGTERM)
    assert running.end().code == 0
    with file.open("rb") as octets:
        found = {channel.topic for _, channel, _ in make_reader(octets).iter_messages()}
    assert any(topic.startswith("/bench/slew/") for topic in found), found
    rig.station.ask("names", "reset", a, 0)
