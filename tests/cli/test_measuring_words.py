"""``sample``, ``mode``, ``set``, ``measure``: what they print and pass on, and what ends them."""

from __future__ import annotations

import io
import json
import math
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from rich.console import Console

from teds_provision import measure, provisioning
from teds_provision.cli.context import App
from teds_provision.cli.measure import measure as measure_command
from teds_provision.cli.measure import sample as sample_command
from teds_provision.errors import (
    BadDataError,
    NodeRefusedError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    UsageError,
)
from teds_provision.links import LinkSettings
from teds_provision.measure.held_actuator import AppliedSetPoint
from teds_provision.measure.running.measurement import MeasurementEnd
from teds_provision.measure.sampling import Sample
from teds_provision.measure.sinks.mcap.recover import Damage, RecoveryResult
from teds_provision.protocol.operation.commands import ChannelState, OperationReply, PowerReply
from teds_provision.provisioning.meeting import IdleStop
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeptMeasurement
from teds_provision.teds.channel import Channel
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.sheet import Sheet
from teds_provision.teds.units import parse_unit

from .shell import call

UUID, OTHER = bytes(range(10)), bytes(range(10, 20))
NODE = UUID.hex()
BUS = ("--can", "virtual:measuring")


class Standing:
    """Stands for the decisions of the station: counts how often they were looked at, and ends after some."""

    def __init__(self, ends_after: int = 1000) -> None:
        self.looked, self.ends_after = 0, ends_after
        self.drives = self.unsigned = False

    def require(self) -> None:
        self.looked += 1
        if self.looked > self.ends_after:
            raise NotAuthenticError("Node was revoked.")


@pytest.fixture
def session(home: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what has a command meet this session, and these decisions of the station."""
    call(home, "whitelist", "add", NODE)

    def put(trusted: Any, standing: Standing | None = None) -> None:
        @contextmanager
        def met(_app: Any, _station: Any, _links: Any, uuid: bytes, *, by: str) -> Iterator[Any]:
            trusted.met = (uuid, by)
            yield trusted

        monkeypatch.setattr(sample_command, "trusted_node", met)
        monkeypatch.setattr(measure.standing, "NodeStanding", lambda _station, _uuid: standing or Standing())

    return put


# -- sample ------------------------------------------------------------------------------------------------------------

DEGREE = parse_unit("degree")
ANGLE = Sample(1, "angle", math.pi / 2, "rad", 4096, math.pi / 180, True, 1795341600.5, shown=DEGREE)
TORN = Sample(2, "force", None, "N", 9, None, False, 1795341600.5, why="beyond its limits")
WORD = Sample(3, "switch", 1.0, "1", 1, None, True, 1795341600.5, text="closed")


@pytest.mark.parametrize(("kept", "origin"), [(False, "session"), (True, "kept")])
def test_a_sample_is_printed_whole(
    home: Path, session: Any, monkeypatch: pytest.MonkeyPatch, kept: bool, origin: str
) -> None:
    asked: list[Any] = []

    def take(_trusted: Any, numbers: list[int]) -> list[Sample]:
        asked.append(numbers)
        return [ANGLE, TORN, WORD]

    monkeypatch.setattr(measure.sampling, "take_samples", take)
    standing = Standing()
    channels = {"angle": 1, 2: 2}
    trusted = SimpleNamespace(kept=kept, channel=lambda chosen: SimpleNamespace(number=channels[chosen]))
    session(trusted, standing)
    people = call(home, "sample", NODE, "angle", "2", *BUS)
    assert (people.code, people.out.splitlines()) == (
        0,
        [
            "channel  name    value                         ±  unit    raw",
            "1        angle   90                            1  degree  4096",
            "2        force   not valid: beyond its limits     N       9",
            "3        switch  1 (closed)                       1       1",
        ],
    )
    assert (asked, trusted.met, standing.looked) == ([[1, 2]], (UUID, "sample"), 1)
    found = call(home, "--json", "sample", NODE, *BUS).json
    assert asked[-1] == []
    first, second, third = found.pop("samples")
    assert found == {"uuid": NODE, "from": origin}
    assert first == {
        "channel": 1,
        "name": "angle",
        "value": math.pi / 2,
        "unit": "rad",
        "raw": 4096,
        "uncertainty": math.pi / 180,
        "valid": True,
        "shown": {"value": pytest.approx(90), "unit": "degree", "uncertainty": pytest.approx(1)},
        "time": 1795341600.5,
    }
    assert (second["value"], second["why"], "shown" in second) == (None, "beyond its limits", False)
    assert third["text"] == "closed"


def test_an_uncertainty_has_three_digits() -> None:
    for uncertainty, shown in ((0.0123456, "0.0123"), (1234.5, "1.23e+03"), (0.5, "0.5"), (None, "")):
        console = Console(file=io.StringIO(), width=120)
        sample_command._samples(console, [Sample(1, "force", 7.0, "N", 9, uncertainty, True, 1795341600.5)])
        row = console.file.getvalue().splitlines()[1].split()  # type: ignore[attr-defined]
        assert row == ["1", "force", row[2], *([shown] if shown else []), "N", "9"]


def test_values_of_a_node_that_was_revoked_meanwhile_are_not_printed(
    home: Path, session: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measure.sampling, "take_samples", lambda _trusted, _numbers: [ANGLE])
    session(SimpleNamespace(kept=False), Standing(ends_after=0))
    outcome = call(home, "--json", "sample", NODE, *BUS)
    assert (outcome.code, "samples" in outcome.json) == (4, False)


# -- mode --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("measuring", "mode"), [(True, "measurement"), (False, "configuration")])
def test_what_mode_prints(
    home: Path, session: Any, monkeypatch: pytest.MonkeyPatch, measuring: bool, mode: str
) -> None:
    states = {
        1: (ChannelState.ACTUATOR | ChannelState.CLAIMED_BY_OTHER, 0xF3),
        2: (ChannelState(0), 0),
        3: (ChannelState.SAFE | ChannelState.FAULT, 0),
    }
    monkeypatch.setattr(measure.verified_session, "operation", lambda _node: OperationReply(measuring, states))
    power = PowerReply(1, 82, 3.7, -0.2, 21)

    def answer(_command: Any, _doing: str) -> bytes:
        return power.encode()

    channels = [SimpleNamespace(number=1, name="grip"), SimpleNamespace(number=2, name="opening")]
    node = SimpleNamespace(request=answer, contact=SimpleNamespace(charging=None), uuid=UUID)
    session(SimpleNamespace(node=node, sheet=SimpleNamespace(channels=channels)))
    people = call(home, "mode", NODE, *BUS)
    assert people.out.splitlines() == [
        f"{mode} mode",
        "channel  name     state                       claimed by",
        "1        grip     actuator, claimed by other  0xF3",
        "2        opening  idle",
        "3                 safe, fault",
        "Battery 82 %",
    ]
    assert call(home, "--json", "mode", NODE, *BUS).json == {
        "uuid": NODE,
        "mode": mode,
        "channels": [
            {"channel": 1, "name": "grip", "state": ["actuator", "claimed by other"], "claimant": 0xF3},
            {"channel": 2, "name": "opening", "state": [], "claimant": 0},
            {"channel": 3, "name": "", "state": ["safe", "fault"], "claimant": 0},
        ],
        "power": {"flags": ["battery"], "level": 82, "voltage": 3.7, "current": -0.2, "temperature": 21},
        "charging": None,
    }

    def refuses(_command: Any, _doing: str) -> bytes:
        raise NodeRefusedError("It has no battery.", reason=1)

    node.request = refuses
    node.contact = SimpleNamespace(charging=SimpleNamespace(to_json=lambda: {"state": "full"}))
    found = call(home, "--json", "mode", NODE, *BUS).json
    assert (found["power"], found["charging"]) == (None, {"state": "full"})


# -- set ---------------------------------------------------------------------------------------------------------------


class Held:
    """Stands for an actuator in use: counts the set points."""

    made: list[Held]

    def __init__(self, _trusted: Any, chosen: Any, *, unit: str | None, dead_man: int) -> None:
        self.asked = (chosen, unit, dead_man)
        self.channel = Channel(
            1, name="opening set point", units=parse_unit("m").units, display="mm", low=0.0, high=0.11
        )
        self.unit = parse_unit(unit or "m")
        self.applied: list[float] = []
        self.checked: list[float] = []
        self.pause, self.safe = 0.25, True
        Held.made.append(self)

    def octets_of(self, value: float) -> bytes:
        self.checked.append(value)
        if self.unit.to_si(value) > 0.11:
            raise PolicyError("It exceeds the limits.")
        return b""

    def __enter__(self) -> Held:
        return self

    def __exit__(self, *_: object) -> None:
        self.applied.append(math.nan)

    def apply(self, value: float) -> AppliedSetPoint:
        self.applied.append(value)
        return AppliedSetPoint(1, value, self.unit.text, 7)

    def require_confirmation(self) -> bool:
        return self.safe


@pytest.fixture
def actuator(session: Any, monkeypatch: pytest.MonkeyPatch) -> Standing:
    """An actuator that nobody holds; time passes by its pauses alone."""
    Held.made = []
    now = [100.0]
    standing = Standing()
    session(SimpleNamespace(), standing)
    monkeypatch.setattr(measure.held_actuator, "HeldActuator", Held)
    monkeypatch.setattr(sample_command, "time", SimpleNamespace(monotonic=lambda: now[0]))

    def wait(_stop: IdleStop, seconds: float | None = None) -> bool:
        now[0] += seconds or 0.0
        return now[0] > 110.0

    monkeypatch.setattr(IdleStop, "wait", wait)
    return standing


def test_a_set_point_is_fed_until_its_time_is_over_and_ends_safe(home: Path, actuator: Standing) -> None:
    people = call(home, "set", NODE, "opening", "0.05", "--hold", "1", *BUS)
    assert (people.code, people.out) == (0, "Channel 1 (opening set point): 0.05 m\nsafe\n")
    [held] = Held.made
    assert (held.asked, held.checked) == (("opening", None, 1000), [0.05])
    assert [value for value in held.applied if value == value] == [0.05] * 5, "every quarter of a second for one"
    assert actuator.looked == 5, "the station's decisions are looked at before each"
    assert actuator.drives, "the whitelist counts for a node that moves"
    words = ("set", NODE, "1", "50", "--unit", "mm", "--hold", "0", "--dead-man", "200", *BUS)
    applied, end = call(home, "--json", *words).out.splitlines()
    assert applied == '{"applied": {"channel": 1, "value": 50.0, "unit": "mm", "raw": 7}}'
    assert end == '{"event": "end", "safe": true}'
    assert Held.made[-1].asked == (1, "mm", 200)
    assert [value for value in Held.made[-1].applied if value == value] == [50.0], "a hold of 0 sets it once"


def test_a_set_point_beyond_the_limits_claims_nothing(home: Path, actuator: Standing) -> None:
    assert call(home, "--json", "set", NODE, "1", "0.2", *BUS).code == 6
    assert Held.made[-1].applied == []
    assert call(home, "--json", "set", NODE, "1", "nan", *BUS).code == 2
    del actuator


def test_an_actuator_is_moved_only_on_the_whitelist_and_while_the_station_permits_it(
    home: Path, actuator: Standing
) -> None:
    actuator.ends_after = 3
    revoked = call(home, "--json", "set", NODE, "1", "0.05", *BUS)
    assert (revoked.code, len(Held.made[-1].applied)) == (4, 4), "three set points, and the end in order"
    call(home, "whitelist", "remove", NODE, "--yes")
    refused = call(home, "--json", "set", NODE, "1", "0.05", *BUS)
    assert (refused.code, len(Held.made)) == (6, 1), "no session is opened for it"


def test_a_bare_number_means_si_and_on_a_terminal_the_unit_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = App.current
    meter = Channel(1, name="opening", units=parse_unit("m").units, display="mm")
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True))
    with pytest.raises(UsageError) as refused:
        sample_command._require_unit(App(home=tmp_path), meter, 45, None)
    assert refused.value.message == ("Without --unit, 45 means 45 m, but channel 1 (opening) is shown in mm.")
    assert refused.value.hint == "Add --unit mm or --unit m."
    sample_command._require_unit(App(home=tmp_path), meter, 45, "m")
    sample_command._require_unit(App(home=tmp_path), replace(meter, display="m"), 45, None)
    for program in ({"as_json": True}, {"no_input": True}):
        sample_command._require_unit(App(home=tmp_path, **program), meter, 45, None)
    App.current = before


def test_the_first_signal_ends_in_order_and_the_second_at_once() -> None:
    stop = IdleStop(None)
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    for number in (signal.SIGINT, signal.SIGTERM):
        stop = IdleStop(None)
        with sample_command.ending(stop):
            signal.raise_signal(number)
            assert stop.is_set()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(number)
    stop = IdleStop(None)
    with sample_command.ending(stop):
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGHUP)
        assert stop.is_set(), "a terminal that is closed may send it twice"
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)] == before


# -- measure -----------------------------------------------------------------------------------------------------------

STREAM = {
    "channels": [1, 2], "period": 0.01, "messages": 40, "samples": 400, "lost": 2, "late": 1, "bad": 3, "invalid": 1,
    "invalid_why": [{"channel": 1, "why": "beyond its limits", "count": 1}], "clock_error": 0.001,
}  # fmt: skip


def test_who_is_measured(home: Path) -> None:
    call(home, "whitelist", "add", NODE, "--name", "thumb")
    call(home, "whitelist", "add", OTHER.hex(), "--name", "index")
    call(home, "group", "create", "hand", NODE, OTHER.hex())
    call(home, "group", "create", "empty")

    with Station.inspect(home) as station:
        who = measure_command._who
        assert who(station, ["hand"]) == ("hand", [UUID, OTHER])
        assert who(station, ["index", NODE, "index"]) == ("", [OTHER, UUID]), "each once, in their order"
        for words, error, hint in (
            (["empty"], UsageError, "group add empty UUID"),
            (["none"], NotFoundError, "Groups: empty, hand."),
            (["hand", NODE], NotFoundError, "Did you mean"),
        ):
            with pytest.raises(error) as refused:
                who(station, words)
            assert hint in refused.value.hint or len(words) > 1


def test_wide_files_are_those_of_text() -> None:
    assert measure_command._wide(["run.csv", "run.mcap", "RUN.TXT"]) == ["wide:run.csv", "run.mcap", "wide:RUN.TXT"]
    for files in ([], ["run.mcap", "run.jsonl"]):
        with pytest.raises(UsageError, match="--wide only works with text files"):
            measure_command._wide(files)


@pytest.mark.parametrize(
    ("via", "trigger", "why"),
    [
        ("can", True, ""), ("can", False, ""), ("ble", False, ""),
        ("ble", True, "--trigger needs a CAN bus."), ("nfc", False, "Streaming needs CAN or Bluetooth."),
    ],
)  # fmt: skip
def test_which_link_streams(via: str, trigger: bool, why: str) -> None:
    if not why:
        measure_command._require_streams(LinkSettings(via), trigger=trigger)
        return
    with pytest.raises(UsageError) as refused:
        measure_command._require_streams(LinkSettings(via), trigger=trigger)
    assert refused.value.message == why


def test_the_same_command_with_another_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    job: Any = SimpleNamespace(kept=KeptMeasurement("", group="left hand"))
    for typed, again in (
        (["measure", "a b", "--rate", "100", "--to", "x.csv"], "measure 'a b' --to x.csv --rate 50"),
        (["measure", "a", "--rate=100", "--json"], "measure a --json --rate 50"),
        (["measure", "a"], "measure a --rate 50"),
        (["-c"], "measure 'left hand' --rate 50"),
    ):
        monkeypatch.setattr(sys, "argv", ["teds-provision", *typed])
        assert measure_command._at_rate(job, [UUID], 50.0) == f"teds-provision {again}"
    nodes: Any = SimpleNamespace(kept=KeptMeasurement("", uuids=(UUID, OTHER)))
    assert measure_command._at_rate(nodes, [UUID, OTHER], 0.5) == (
        f"teds-provision measure {NODE} {OTHER.hex()} --rate 0.5"
    )


def test_what_the_end_of_a_measurement_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = App.current
    sinks = [{"sink": "mqtt://x", "written": 3, "dropped": 2}, {"sink": "ros2", "written": 9, "dropped": 0}]
    ended = MeasurementEnd([{"uuid": NODE, "streams": [STREAM]}], ["run.csv"], None, sinks=sinks)
    measure_command._print_end(App(home=tmp_path), ended, None, "si", "")
    assert capsys.readouterr().out.splitlines() == [
        f"{NODE}: 400 values in 40 messages, lost 2, late 1, bad 3, invalid 1 (1 of channel 1: beyond its limits)",
        "Written: run.csv",
        "mqtt://x: 2 values dropped",
    ]
    again = "teds-provision measure a --rate 50"
    lossy = replace(ended, lower_rate=50.0, apart=0.25)
    require: Any = SimpleNamespace(fits=[{"uuid": NODE, "result": "failed", "why": "rate is 1 Hz."}])
    measure_command._print_end(App(home=tmp_path, as_json=True), lossy, require, "shown", again)

    assert json.loads(capsys.readouterr().out) == {
        "event": "end",
        "nodes": [{"uuid": NODE, "streams": [STREAM]}],
        "files": ["run.csv"],
        "sinks": sinks,
        "lower_rate": {"rate": 50.0, "command": again},
        "unit": "shown",
        "fits": require.fits,
        "began_apart": 0.25,
    }
    nothing = MeasurementEnd([], [], PolicyError("It does not fit."))
    with pytest.raises(PolicyError):
        measure_command._print_end(App(home=tmp_path), nothing, require, "si", "")
    assert capsys.readouterr().out == "rate is 1 Hz.\n"
    measure_command._print_end(App(home=tmp_path), MeasurementEnd([], [], None), None, "si", again)
    assert capsys.readouterr().out == f"Nothing was measured.\nValues were lost. A lower rate may help: {again}\n"
    App.current = before


@pytest.mark.parametrize(
    ("result", "code", "text"),
    [
        (RecoveryResult(3, 1795341600.0, True, 0), 0, "run.mcap is intact: 3 messages until 2026-11-22T10:00:00.000Z"),
        (RecoveryResult(1, 1795341600.0, False, 40), 0,
         "run.mcap repaired (40 octets of a torn end cut off): 1 message until 2026-11-22T10:00:00.000Z"),
        (RecoveryResult(0, None, False, 8), 0, "run.mcap repaired (8 octets of a torn end cut off): 0 messages"),
        (RecoveryResult(2, None, False, 0, (Damage("chunk", 90, 70),), Path("run.mcap.recovered")), 8,
         "run.mcap is unchanged; its intact part is in run.mcap.recovered: 2 messages"),
    ],
)  # fmt: skip
def test_what_a_recovery_prints(
    home: Path, monkeypatch: pytest.MonkeyPatch, result: RecoveryResult, code: int, text: str
) -> None:
    asked: list[Any] = []

    def recover(path: Path, output: Path | None) -> RecoveryResult:
        asked.append((path, output))
        return result

    monkeypatch.setattr(measure.sinks.mcap.recover, "recover", recover)
    people = call(home, "measure", "recover", "run.mcap", "--output", "out.mcap")
    assert (people.code, people.out.rstrip("\n")) == (code, text)
    assert asked == [(Path("run.mcap"), Path("out.mcap"))]
    found = call(home, "--json", "measure", "recover", "run.mcap").json
    assert asked[-1] == (Path("run.mcap"), None)
    error = found.pop("error", None)
    output = {} if result.output is None else {"output": "run.mcap.recovered"}
    assert found == {
        "recovered": {
            "messages": result.messages,
            "until": None if result.until is None else "2026-11-22T10:00:00.000Z",
        },
        "file": "run.mcap",
        "cut": result.cut,
        "damaged": [vars(damage) for damage in result.damaged],
        **output,
    }
    assert (error is not None) == (code == 8)
    if error is not None:
        assert "run.mcap is damaged inside: chunk at octet 90 (70 octets)." in error["message"]


def test_output_is_for_a_recovery_alone(home: Path) -> None:
    for words in (["measure", NODE, "--output", "x"], ["measure", "recover"], ["measure", "recover", "a", "b"]):
        assert call(home, "--json", *words).code == 2


def test_the_damage_of_a_recording_names_three_pieces() -> None:
    damage = tuple(Damage("chunk", 100 * number, 70) for number in range(1, 6))
    error = measure_command._damage("run.mcap", RecoveryResult(0, None, False, 0, damage, Path("out")))
    assert isinstance(error, BadDataError)
    assert error.message == (
        "run.mcap is damaged inside: chunk at octet 100 (70 octets), chunk at octet 200 (70 octets), "
        "chunk at octet 300 (70 octets) and 2 more."
    )


def test_a_channel_that_is_named_has_its_number_by_the_datasheet_of_every_node(monkeypatch: pytest.MonkeyPatch) -> None:
    gripper = load_profile("gripper")
    images = {uuid: Image(uuid, gripper.build(uuid).blocks) for uuid in (UUID, OTHER)}
    station: Any = SimpleNamespace(datasheets=SimpleNamespace(datasheet=images.get))
    numbers = measure_command._numbers
    assert numbers(station, [UUID, OTHER], [2, "grip force", 7, "opening"]) == [2, 3, 7, 2]
    assert numbers(station, [], ["opening"]) == []
    with pytest.raises(BadDataError):
        numbers(station, [UUID], ["knee"])
    unknown = bytes(range(20, 30))
    with pytest.raises(
        UsageError, match=f"of node {unknown.hex()} are not known yet, so 'opening' cannot be"
    ) as refused:
        numbers(station, [UUID, unknown], ["opening"])
    assert refused.value.hint == f"Give its number, or read the node first: teds-provision verify {unknown.hex()}"
    of = {UUID: 2, OTHER: 5}
    monkeypatch.setattr(
        Sheet,
        "from_image",
        lambda image: SimpleNamespace(chosen=lambda _name, _uuid: SimpleNamespace(number=of[image.uuid])),
    )
    with pytest.raises(UsageError) as refused:
        numbers(station, [UUID, OTHER], ["opening"])
    assert refused.value.message == f"Channel 'opening' has different numbers: 2 on {NODE}, 5 on {OTHER.hex()}."
    assert refused.value.hint == "Measure them one by one."


@pytest.mark.parametrize(
    ("group", "wished", "changes"),
    [
        ("hand", {}, {"group": "hand", "uuids": (), "actuators": False}),
        ("", {"ros1": True, "channels": [2, 1, 2]}, {"channels": (2, 1)}),
        ("", {"ros2": True, "rate": 20.0, "require": "x"}, {"rate": 20.0, "require": "x"}),
        ("", {"ros2": True, "actuators": False}, {"actuators": False}),
        ("", {}, {"actuators": False}),
    ],
)
def test_a_measurement_is_kept_as_it_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group: str, wished: dict[str, Any], changes: dict[str, Any]
) -> None:
    monkeypatch.chdir(tmp_path)
    defaults: dict[str, Any] = dict.fromkeys(measure_command.OPTIONS)
    usual = {"channels": [], "actuators": True, "ros1": False, "ros2": False, "require": ""}
    kept = measure_command._asked(group, [UUID, OTHER], ["a.csv", "ros2"], defaults | usual | wished)
    assert (kept.id, kept.owner) == ("", "command")
    assert kept.sinks == (str(tmp_path / "a.csv"), "ros2")
    found = {"group": kept.group, "uuids": kept.uuids, "actuators": kept.actuators, "channels": kept.channels}
    found |= {"rate": kept.rate, "require": kept.require}
    plain = {"group": None, "uuids": (UUID, OTHER), "actuators": True, "channels": (), "rate": None, "require": ""}
    assert found == plain | changes


@pytest.mark.parametrize(
    ("places", "via", "can", "ble"),
    [
        ((), "nfc", None, None),
        (("can:socketcan:can0",), "can", ("socketcan:can0",), None),
        (("can:socketcan:can0", "can:socketcan:can1"), "can", ("socketcan:can0", "socketcan:can1"), None),
        (("ble:hci0",), "ble", None, "hci0"),
        (("can:socketcan:can0", "ble:hci0"), "nfc", None, None),
    ],
)
def test_nodes_are_met_where_they_were_last_unless_they_were_on_links_of_two_kinds(
    places: tuple[str, ...], via: str, can: Any, ble: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(provisioning.meeting, "likely_places", lambda _station, _links, uuids: places if uuids else ())
    links = sample_command.where_met(cast("Any", None), LinkSettings("nfc", timeout=7.0), [UUID])
    assert (links.via, links.can, links.ble, links.timeout) == (via, can, ble, 7.0)


def test_the_charge_is_that_of_the_tap_else_the_last_report() -> None:
    known: dict[bytes, Any] = {}
    station: Any = SimpleNamespace(nodes=SimpleNamespace(get=known.get))
    node: Any = SimpleNamespace(uuid=UUID, contact=SimpleNamespace(charging=None))
    assert sample_command._charging(station, node) is None
    known[UUID] = SimpleNamespace(charging=None)
    assert sample_command._charging(station, node) is None
    known[UUID] = SimpleNamespace(charging='{"text": "charging", "at": "2026-01-31T10:00:00Z"}')
    assert sample_command._charging(station, node) == {"text": "charging", "at": "2026-01-31T10:00:00Z"}
    node.contact.charging = SimpleNamespace(to_json=lambda: {"text": "full"})
    assert sample_command._charging(station, node) == {"text": "full"}


@pytest.mark.parametrize(
    ("low", "high", "value", "shown"),
    [
        (-1.0, 1.0, 1.1e-9, "1.1e-09 mm"), (-1.0, 1.0, 0.9e-9, "0 mm"), (-1.0, 1.0, -0.9e-9, "0 mm"),
        (-10.0, 1.0, 5e-9, "0 mm"), (0.0, 1.0, 5e-9, "5e-09 mm"), (0.0, math.inf, 1e-12, "1e-12 mm"),
        (-math.inf, 1.0, -1e-12, "-1e-12 mm"), (0.0, 0.0, 0.0, "0 mm"),
    ],
)  # fmt: skip
def test_a_set_point_that_is_zero_but_for_rounding_is_shown_as_zero(
    low: float, high: float, value: float, shown: str
) -> None:
    channel: Any = SimpleNamespace(low=low, high=high)
    applied: Any = SimpleNamespace(value=value, unit="mm")
    assert sample_command._near(channel, applied) == shown
    bare: Any = SimpleNamespace(value=value, unit="")
    assert sample_command._near(channel, bare) == shown.removesuffix(" mm")


@pytest.mark.parametrize(("level", "shown"), [(None, ""), (0, "Battery 0 %"), (77, "Battery 77 %")])
def test_a_battery_is_shown_if_the_node_has_one(level: int | None, shown: str) -> None:
    found: Any = SimpleNamespace(measuring=False, channels={})
    for power in (None, SimpleNamespace(level=level)):
        console = Console(file=io.StringIO())
        sample_command._mode(console, found, {}, cast("Any", power))
        last = console.file.getvalue().splitlines()[-1]  # type: ignore[attr-defined]
        assert (last == shown) is (bool(shown) and power is not None)


def test_a_terminal_that_is_closed_ends_in_order_unless_that_is_ignored() -> None:
    before = signal.getsignal(signal.SIGHUP)
    try:
        for handler, handled in ((signal.SIG_DFL, True), (signal.SIG_IGN, False)):
            signal.signal(signal.SIGHUP, handler)
            stop = IdleStop(None)
            with sample_command.ending(stop):
                assert (signal.getsignal(signal.SIGHUP) != handler) is handled
                signal.raise_signal(signal.SIGHUP)
                signal.raise_signal(signal.SIGHUP)
                assert stop.is_set() is handled
            assert signal.getsignal(signal.SIGHUP) == handler
    finally:
        signal.signal(signal.SIGHUP, before)


def test_of_several_nodes_with_one_number_the_first_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    third = bytes(range(20, 30))
    of = {UUID: 2, OTHER: 2, third: 5}
    monkeypatch.setattr(
        Sheet,
        "from_image",
        lambda image: SimpleNamespace(chosen=lambda _name, _uuid: SimpleNamespace(number=of[image])),
    )
    station: Any = SimpleNamespace(datasheets=SimpleNamespace(datasheet=lambda uuid: uuid))
    with pytest.raises(UsageError) as refused:
        measure_command._numbers(station, [UUID, OTHER, third], ["opening"])
    assert refused.value.message == f"Channel 'opening' has different numbers: 2 on {NODE}, 5 on {third.hex()}."
    assert measure_command._numbers(station, [UUID, OTHER], ["opening", "grip"]) == [2, 2]


@pytest.mark.parametrize(
    ("error", "lines"), [(None, []), (PolicyError("It does not fit."), ["rate is 1 Hz.", "range is not known."])]
)
def test_unmet_requirements_are_listed_if_they_ended_the_measurement(error: Any, lines: list[str]) -> None:
    fits = [
        {"uuid": NODE, "result": "passed", "why": "it fits"},
        {"uuid": NODE, "result": "failed", "why": "rate is 1 Hz."},
        {"uuid": NODE, "result": "skipped", "why": "range is not known."},
    ]
    require: Any = SimpleNamespace(fits=fits)
    ended = MeasurementEnd([], ["run.csv"], error)
    assert measure_command._end_lines(ended, require) == ["Written: run.csv", *lines]
    assert measure_command._end_lines(ended, None) == ["Written: run.csv"]


def test_the_unit_of_files_is_named_only_if_there_are_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = App.current
    app = App(home=tmp_path, as_json=True)
    measure_command._print_end(app, MeasurementEnd([], [], None), None, "shown", "")
    assert json.loads(capsys.readouterr().out) == {"event": "end", "nodes": [], "files": [], "sinks": []}
    App.current = before


@pytest.mark.parametrize(
    ("given", "typed", "bus"),
    [
        ({"can": "c", "ble": "b"}, set(), "can"),
        ({"can": "c", "ble": "b"}, {"ble"}, "ble"),
        ({"can": "c", "ble": "b"}, {"can", "ble"}, "can"),
        ({"can": "c"}, {"nfc"}, "can"),
        ({"ble": "b"}, set(), "ble"),
        ({}, {"via"}, None),
    ],
)
def test_of_two_buses_the_one_on_the_command_line_is_meant(
    given: dict[str, str], typed: set[str], bus: str | None
) -> None:
    assert sample_command._bus_meant(LinkSettings("nfc", **given), typed) == bus  # type: ignore[arg-type]


def test_a_session_that_is_lost_ends_a_command_with_what_lost_it(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    met: list[Any] = []

    @contextmanager
    def meet(_station: Any, links: LinkSettings, uuid: bytes, _reporter: Any, *, before: Any) -> Iterator[str]:
        met.append((links.via, uuid))
        before()
        yield "node"
        met.append("left")

    monkeypatch.setattr(provisioning.meeting, "meet", meet)
    monkeypatch.setattr(measure.verified_session, "open_trusted", lambda _station, node, *, by: (node, by))
    unlocked: list[bytes] = []
    station: Any = SimpleNamespace(unlock=unlocked.append)
    links = LinkSettings("can", can="virtual:x")
    before = App.current
    cause = NodeRefusedError("It has restarted.", reason=1)
    app = App(home=home, quiet=True)
    monkeypatch.setattr(sample_command, "over_the_bus", lambda links: links)
    with sample_command.trusted_node(app, station, links, UUID, by="mode") as trusted:
        assert trusted == ("node", "mode")  # type: ignore[comparison-overlap]
    assert (met, unlocked) == ([("can", UUID), "left"], [UUID])

    def lose() -> None:
        with sample_command.trusted_node(app, station, links, UUID, by="mode"):
            raise provisioning.conversation.SessionLostError(cause)

    with pytest.raises(NodeRefusedError, match="It has restarted"):
        lose()
    App.current = before


@pytest.mark.parametrize(
    ("changes", "cells"),
    [
        ({"uncertainty": 0.0}, ["1", "angle", "90", "0", "degree", "4096"]),
        ({"uncertainty": None}, ["1", "angle", "90", "degree", "4096"]),
        ({"turn": 0.0, "value": 2 * math.pi - 1e-9, "uncertainty": None}, ["1", "angle", "0", "degree", "4096"]),
        (
            {"turn": 0.0, "shown": None, "value": -0.5, "uncertainty": None, "unit": "rad"},
            ["1", "angle", "-0.5", "rad", "4096"],
        ),
    ],
)
def test_a_reading_within_its_turn_and_one_without_an_uncertainty(changes: dict[str, Any], cells: list[str]) -> None:
    console = Console(file=io.StringIO(), width=120)
    sample_command._samples(console, [replace(ANGLE, **changes)])
    assert console.file.getvalue().splitlines()[1].split() == cells  # type: ignore[attr-defined]


@pytest.mark.parametrize("value", ["inf", "-inf", "nan"])
def test_a_set_point_is_a_finite_number(home: Path, actuator: Standing, value: str) -> None:
    refused = call(home, "--json", "set", NODE, "1", value, *BUS)
    assert (refused.code, refused.json["error"]["message"]) == (2, "VALUE is not a finite number.")
    assert Held.made == []
    del actuator
