"""What is typed wrongly: cause, cure and exit code; and a consumer that is not there, which everybody hears of."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.measure.rig import Rig, events, of
from tests.places import free_tcp_port

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    made = Rig(tmp_path_factory.mktemp("words"), {"g": "gripper"})
    try:
        made.nodes["g"].start()
        yield made
    finally:
        made.close()


def test_what_is_wrong_is_reported_with_what_to_do(rig: Rig, tmp_path: Path) -> None:
    g, nothing = rig.nodes["g"].uuid, tmp_path / "nothing.toml"
    nothing.write_text("")
    cases = [
        (("measure", g, "--mqtt", "http://x"), 2, "is not a broker URL"),
        (("measure", g, "--mqtt", "mqtt://me:secret@x"), 2, "password-file"),
        (("measure", g, "--channel", "y"), 8, "has no channel 'y'"),
        (("measure", g, "--channel", "1", "--duration", "1"), 8, "is not a sensor"),
        (("measure", g, "--to", "run.xyz"), 2, ".csv"),
        (("measure", g, "--to", tmp_path / "no" / "run.csv", "--duration", "1"), 3, "its folder is not there"),
        (("measure", g, "--require", nothing), 8, "asks for nothing"),
        (("set", g, "x", "1"), 8, "3 (grip force)"),
        (("set", g, "opening", "0.05", "--hold", "0.1"), 0, '"safe": true'),  # for channel 1, the opening set point
        (("set", g, "grip force", "1", "--hold", "0.1"), 8, "is a sensor, not an actuator"),
        (("set", g, "1", "-0.5"), 6, "exceeds the limits"),  # a value, and no option
        (("set", g, "1", "0.05", "--hodl", "3"), 2, "--hodl"),
        (("set", g, "2", "1", "--hold", "0.1"), 8, "is a sensor, not an actuator"),
        (("set", g, "1", "1", "--unit", "kelvin"), 8, "not a unit for channel 1"),
        (("sample", g, "x"), 8, "has no channel 'x'"),
        (("sample", g, "256"), 2, "not in the range 1<=x<=255"),
    ]
    wrong = []
    for words, code, text in cases:
        outcome = rig.station.start("--json", *words, "--can", rig.can).end()
        last_event = json.dumps(events(outcome.out)[-1:], ensure_ascii=False)
        if outcome.code != code or text not in last_event or "Traceback" in outcome.err:
            wrong.append((words, outcome.code, last_event))
    assert wrong == []


def test_a_command_without_a_link_takes_no_address_of_the_service_that_met_the_node(rig: Rig) -> None:
    """The last place had the source address of the service: 7, "in use", beside it."""
    g = rig.nodes["g"].uuid
    service = rig.station.start("--json", "ncap", "run", "--measure", "all", "--can", rig.can)
    try:
        service.wait_for('"running"')
        driven = rig.station.start("--json", "set", g, "1", "0.05", "--hold", "0.1").end()
        assert (driven.code, events(driven.out)[-1]) == (0, {"event": "end", "safe": True}), driven.out
    finally:
        service.close()


@pytest.mark.parametrize(
    "words", [("measure", "recover"), ("measure", "recover", "."), ("measure", "recover", "none.mcap")]
)
def test_recover_names_what_it_is(rig: Rig, words: tuple[str, ...]) -> None:
    code, message = {2: (2, "Name exactly one recording"), 3: (3, "none.mcap")}[2 if len(words) == 2 else 3]
    message = "is a folder" if words[-1] == "." else message
    outcome = rig.station.start("--json", *words).end()
    assert outcome.code == code
    assert message in outcome.out


def test_a_broker_that_is_not_there_is_reported_and_what_it_cost(rig: Rig) -> None:
    place = f"mqtt://127.0.0.1:{free_tcp_port()}"
    lines = rig.measure(rig.nodes["g"].uuid, "--rate", 10, "--duration", 5, "--mqtt", place, code=5)
    event = next(line for line in lines if line["event"] == "sink")
    assert (event["state"], event["sink"]) == ("waiting", place)
    assert "nothing is listening at 127.0.0.1" in event["why"]
    assert lines[-1]["error"]["code"] == "link"
    assert "accepted nothing: nothing is listening at 127.0.0.1" in lines[-1]["error"]["message"]
    [sink] = lines[-1]["sinks"]
    assert (sink["written"], sink["dropped"] > 0) == (0, True)
    assert of(lines, channel=2), "the measurement goes on"
