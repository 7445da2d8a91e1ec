"""``measure``: what the words and options of its command line ask for, and what is refused before that."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision import measure
from teds_provision.cli.measure import measure as measure_command
from teds_provision.errors import NodeSilentError, TedsProvisionError
from teds_provision.links import LinkSettings
from teds_provision.measure.running.measurement import MeasurementEnd
from teds_provision.station.station import Station
from teds_provision.station.store.records import COMMAND, KeptMeasurement
from tests.cli.shell import Outcome, call

UUID, OTHER = bytes(range(10)), bytes(range(10, 20))
NODE, NEXT = UUID.hex(), OTHER.hex()
BUS = ("--can", "virtual:measuring")


class Asked:
    """Mock measurement that ends at once and keeps the request of the last command."""

    def __init__(self) -> None:
        self.kept: KeptMeasurement | None = None
        self.request: Any = None
        self.opened: Any = None
        self.ran: dict[str, Any] = {}
        self.end = MeasurementEnd([], [], None)

    def job(self, station: Station, kept: KeptMeasurement, *, request: Any, opened: Any) -> Any:
        self.kept, self.request, self.opened = kept, request, opened
        return SimpleNamespace(station=station, kept=kept, request=request, sinks=())

    def run(self, _app: Any, _job: Any, links: Any, uuids: Any, duration: float | None) -> MeasurementEnd:
        self.ran = {"links": links, "uuids": uuids, "duration": duration}
        return self.end


@pytest.fixture
def asked(home: Path, monkeypatch: pytest.MonkeyPatch) -> Asked:
    call(home, "whitelist", "add", NODE, "--name", "thumb")
    call(home, "whitelist", "add", NEXT)
    call(home, "group", "create", "hand", NODE, NEXT)
    made = Asked()
    monkeypatch.setattr(measure.measurement_job, "MeasurementJob", made.job)
    monkeypatch.setattr(measure_command, "_run", made.run)
    monkeypatch.setattr(measure_command, "_propose_rate", lambda *_words: None)
    monkeypatch.setattr(Station, "unlock", lambda *_words: None)
    monkeypatch.chdir(home)
    return made


def asks(home: Path, *words: str) -> Outcome:
    return call(home, "measure", *words, *BUS)


PLAIN = KeptMeasurement("", uuids=(UUID,), owner=COMMAND)


@pytest.mark.parametrize(
    ("words", "changed"),
    [
        ((), {}),
        (("--rate", "50"), {"rate": 50.0}),
        (("--channel", "2", "--channel", "1", "--channel", "2"), {"channels": (2, 1)}),
        (("--kind", "event"), {"kind": "event"}),
        (("--trigger",), {"trigger": True}),
        (("--test-pattern",), {"test_pattern": True}),
        (("--unsigned",), {"unsigned": True}),
        (("--to", "a.csv", "--to", "sub/b.mcap"), {"sinks": ("HOME/a.csv", "HOME/sub/b.mcap")}),
        (("--to", "/a.txt", "--wide"), {"sinks": ("wide:/a.txt",)}),
        (("--to", "/a.txt", "--to", "/b.mcap", "--no-scalars"), {"sinks": ("/a.txt", "arrays:/b.mcap")}),
        (("--to", "/a.csv", "--unit", "shown"), {"sinks": ("shown:/a.csv",)}),
        (("--to", "/a.csv", "--unit", "shown", "--wide"), {"sinks": ("shown:wide:/a.csv",)}),
        (("--ros1",), {"sinks": ("ros1",), "actuators": True}),
        (("--ros2", "--ros1", "--to", "/a.csv"), {"sinks": ("/a.csv", "ros1", "ros2"), "actuators": True}),
        (("--ros2", "--no-actuators"), {"sinks": ("ros2",)}),
        (("--ros2", "--scalar-rate", "0"), {"sinks": ("ros2",), "actuators": True, "scalar_rate": 0.0}),
        (("--actuators",), {}),
        (("--mqtt", "mqtt://broker"), {"sinks": ("mqtt://broker",)}),
        (("--mqtt", "mqtts://me@broker"), {"sinks": ("mqtts://me@broker",)}),
        (("--foxglove",), {"sinks": ("foxglove:127.0.0.1:8765",)}),
        (("--foxglove-at", "127.0.0.1:9000"), {"sinks": ("foxglove:127.0.0.1:9000",)}),
        (("--foxglove", "--no-scalars"), {"sinks": ("arrays:foxglove:127.0.0.1:8765",)}),
        (("--dead-man", "700"), {"dead_man": 700}),
    ],
)
def test_each_option_asks_for_its_own_setting_and_for_no_other(
    words: tuple[str, ...], changed: dict[str, Any], asked: Asked, home: Path
) -> None:
    done = asks(home, NODE, *words)
    assert (done.code, done.out, done.err) == (0, "Nothing was measured.\n", "")
    assert asked.kept is not None
    wanted = {
        "uuids": (UUID,),
        **{name: getattr(PLAIN, name) for name in measure_command.OPTIONS},
        "sinks": (),
        **changed,
    }
    wanted["sinks"] = tuple(sink.replace("HOME", str(home)) for sink in wanted["sinks"])
    found = {name: getattr(asked.kept, name) for name in wanted}
    assert found == wanted
    assert (asked.kept.group, asked.kept.owner, asked.kept.id) == (None, "command", "")
    assert asked.ran["uuids"] == [UUID]
    assert asked.ran["duration"] is None
    assert asked.request.require_firmware is False


def test_a_group_and_named_channels_firmware_and_duration_are_passed_on(asked: Asked, home: Path) -> None:
    requirement = home / "task.toml"
    requirement.write_text('[angle]\nrange = ">= 300 deg"\n')
    done = asks(home, "hand", "--duration", "2.5", "--require-firmware", "--require", str(requirement))
    assert (done.code, done.err) == (0, "")
    assert asked.kept is not None
    assert (asked.kept.group, asked.kept.uuids) == ("hand", ())
    assert asked.kept.require == requirement.read_text()
    assert (asked.ran["uuids"], asked.ran["duration"]) == ([UUID, OTHER], 2.5)
    assert asked.ran["links"].can == "virtual:measuring"
    assert asked.request.require_firmware is True
    assert asked.request.timeout == asked.ran["links"].timeout
    done = asks(home, NEXT, "thumb", NEXT[:8], "--timeout", "3")
    assert asked.kept.uuids == (OTHER, UUID)
    assert (asked.request.timeout, asked.ran["links"].timeout) == (3.0, 3.0)


def test_sinks_are_opened_with_what_protects_them(asked: Asked, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []
    monkeypatch.setattr(measure.sinks, "open_sink", lambda *words: given.append(words) or "sink")
    assert asks(home, NODE, "--http-allow", "station.example").code == 0
    assert asked.opened("ros1", "taker") == "sink"
    ((spec, taker, exposure),) = given
    assert (spec, taker) == ("ros1", "taker")
    assert exposure.allow == ("station.example",)


@pytest.mark.parametrize(
    ("words", "message", "hint"),
    [
        (("--mqtt", "broker"), "--mqtt 'broker' is not a broker URL.", "Use mqtt://HOST or mqtts://USER@HOST."),
        (("--mqtt", "http://b"), "--mqtt 'http://b' is not a broker URL.", "Use mqtt://HOST or mqtts://USER@HOST."),
        (("--output", "x"), "--output only works with `measure recover`.", "To record, use --to FILE."),
        (("--wide",), "--wide only works with text files.", "Add --to FILE.csv"),
        (("--wide", "--to", "a.mcap"), "--wide only works with text files.", "Add --to FILE.csv"),
    ],
)
def test_what_cannot_be_asked_for_is_refused_before_anything_is_opened(
    words: tuple[str, ...], message: str, hint: str, asked: Asked, home: Path
) -> None:
    done = asks(home, NODE, "--json", *words)
    assert (done.code, done.json["error"]["message"], done.json["error"]["hint"]) == (2, message, hint)
    assert asked.kept is None


def test_who_and_what_is_refused_for_what_it_names(asked: Asked, home: Path) -> None:
    bad, pem = home / "bad.toml", home / "cert.pem"
    bad.write_text("[angle]\nrange = 7\n")
    pem.write_text("")
    for words, code, message in (
        ((NODE, "--require", str(bad)), 8, "bad.toml"),
        ((NODE, "--tls-cert", str(pem)), 2, "--tls-key"),
        (("foot",), 3, "No node or group is known as 'foot'."),
        (("foot", NODE), 3, "foot"),
        ((NODE, "--foxglove-at", "10.0.0.9:1"), 2, "10.0.0.9"),
    ):
        done = asks(home, "--json", *words)
        assert done.code == code, done
        assert message in done.json["error"]["message"] + done.json["error"]["hint"]
    assert done.json["error"]["hint"] != ""
    lone = asks(home, "--json", "foot")
    assert lone.json["error"]["hint"].startswith("Groups: hand. To make one: group create foot UUID")
    call(home, "group", "delete", "hand", "--yes")
    assert asks(home, "--json", "foot").json["error"]["hint"].startswith("Groups: none. ")
    several = asks(home, "--json", "foot", NODE)
    assert "Groups" not in several.json["error"]["hint"]
    over_nfc = call(home, "--json", "measure", NODE, "--via", "nfc", "--nfc", "udp:localhost:1")
    assert (over_nfc.code, over_nfc.json["error"]["message"]) == (2, "Streaming needs CAN or Bluetooth.")
    assert asked.kept is None


def test_a_measurement_that_lost_values_ends_with_the_command_for_a_lower_rate(
    asked: Asked, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["teds-provision", "measure", "thumb", "--rate=100"])
    asked.end = MeasurementEnd([], [], None, lower_rate=40.0)
    done = asks(home, NODE, "--rate", "100")
    assert done.out.endswith("A lower rate may help: teds-provision measure thumb --rate 40\n")


LAST = KeptMeasurement("", group="hand", owner=COMMAND, created="2026-01-31T10:00:00Z", rate=50.0, sinks=("/a.csv",))


@pytest.mark.parametrize(
    ("words", "last", "note"),
    [
        ((), None, ""),
        ((), LAST, "Continuing the measurement started at 2026-01-31T10:00:00Z: 50 Hz to /a.csv."),
        (("--rate", "50"), LAST, ""),
        (("--to", "/b.csv"), LAST, ""),
        (("--duration", "9"), LAST, ""),
        ((), replace(LAST, rate=None, sinks=()),
         "Continuing the measurement started at 2026-01-31T10:00:00Z: the datasheets' rates."),
        ((), replace(LAST, rate=0.5, sinks=("/a.csv", "ros1"), test_pattern=True, unsigned=True, require="[angle]"),
         "Continuing the measurement started at 2026-01-31T10:00:00Z: 0.5 Hz to /a.csv, ros1, test pattern,"
         " including unsigned nodes, with --require."),
    ],
)  # fmt: skip
def test_a_group_goes_on_as_it_was_if_nothing_else_is_asked_for(
    words: tuple[str, ...],
    last: KeptMeasurement | None,
    note: str,
    asked: Asked,
    home: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked: list[str] = []
    monkeypatch.setattr(
        "teds_provision.station.measurements.Measurements.settings_to_continue",
        lambda _self, group: looked.append(group) or last,
    )
    done = asks(home, "hand", *words)
    assert done.code == 0
    assert " ".join(done.err.split()) == note
    assert (asked.kept == last) is bool(note)
    assert looked == ([] if "--duration" in words else ["hand"])
    looked.clear()
    asks(home, NODE)
    assert looked == []


@pytest.mark.parametrize(
    ("rate", "kind", "found", "note"),
    [
        (None, None, SimpleNamespace(limit="machine", stated=1000.0, rate=250.0, why="this machine is busy"),
         "Values may be lost at the datasheet's 1000 Hz: this machine is busy. To measure at 250 Hz:"
         " teds-provision measure hand --rate 250"),
        (None, None, SimpleNamespace(limit="datasheet", stated=1000.0, rate=1000.0, why=""), ""),
        (None, None, None, ""),
        (9.0, None, "not asked", ""),
        (None, "event", "not asked", ""),
    ],
)  # fmt: skip
def test_a_rate_is_proposed_where_the_machine_may_lose_values(
    rate: float | None, kind: Any, found: Any, note: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []

    def propose(station: Any, uuids: Any, request: Any, around: Any) -> Any:
        assert found != "not asked"
        assert (station, uuids, request, around.values, around.busy) == ("station", [UUID], "request", 7e5, 0.5)
        return found

    monkeypatch.setattr(measure.rates, "this_machine", lambda: (7e5, 0.5))
    monkeypatch.setattr(measure.rates, "propose", propose)
    monkeypatch.setattr("sys.argv", ["teds-provision", "measure", "hand"])
    app: Any = SimpleNamespace(note=said.append)
    job: Any = SimpleNamespace(station="station", request="request", kept=KeptMeasurement("", rate=rate, kind=kind))
    measure_command._propose_rate(app, job, [UUID])
    assert said == ([note] if note else [])


@pytest.mark.parametrize("error", [None, NodeSilentError("It left.")])
@pytest.mark.parametrize("raises", [False, True])
def test_a_measurement_is_in_the_log_with_its_end_and_its_ports_are_closed(
    error: TedsProvisionError | None, raises: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    log: list[Any] = []
    port: Any = SimpleNamespace(close=lambda: log.append("closed"))
    other: Any = SimpleNamespace(close=lambda: log.append("closed"))
    station: Any = SimpleNamespace(audit=lambda *words, **facts: log.append((*words, facts)))
    ended = MeasurementEnd([], [], error)

    def run(_buses: Any, _stop: Any, *, watcher: Any, duration: float | None) -> MeasurementEnd:
        log.append((watcher, duration))
        if raises:
            raise NodeSilentError("It left at once.")
        return ended

    monkeypatch.setattr(measure_command, "open_ports", lambda _links: [port, other])
    monkeypatch.setattr(measure_command, "measuring_links", lambda ports: iter(ports[:1]))
    monkeypatch.setattr(
        measure.sources,
        "sole_user",
        lambda _station, links, what: nullcontext(log.append((list(links) == [port], what))),
    )
    monkeypatch.setattr(measure_command.measure_view, "watcher_for", lambda *_words: nullcontext("watcher"))
    monkeypatch.setattr(measure_command, "ending", lambda _stop: nullcontext())
    monkeypatch.setattr(measure.buses, "Buses", lambda _links, note: nullcontext(note))
    for group, what in (("hand", "measure hand"), (None, f"measure {NODE}, {NEXT}")):
        job: Any = SimpleNamespace(station=station, kept=KeptMeasurement("", group=group), sinks=(), run=run)
        app: Any = SimpleNamespace(warn="warn")
        log.clear()
        facts = {"nodes": [NODE, NEXT], "group": group or ""}
        begun = [(True, what), ("measure", None, "begun", facts), ("watcher", 2.5)]
        if raises:
            with pytest.raises(NodeSilentError):
                measure_command._run(app, job, LinkSettings("can"), [UUID, OTHER], 2.5)
            assert log == [*begun, "closed", "closed"]
            continue
        assert measure_command._run(app, job, LinkSettings("can"), [UUID, OTHER], 2.5) is ended
        outcome = "done" if error is None else "node-silent"
        assert log == [*begun, "closed", "closed", ("measure", None, outcome, facts)]


@pytest.mark.parametrize("url", ["broker", "mqtt:broker", "mqttx://broker", "http://broker", ""])
def test_a_broker_is_named_by_its_url(asked: Asked, home: Path, url: str) -> None:
    refused = call(home, "--json", "measure", NODE, "--mqtt", url, *BUS)
    assert (refused.code, refused.json["error"]) == (
        2,
        {
            "code": "usage",
            "message": f"--mqtt {url!r} is not a broker URL.",
            "hint": "Use mqtt://HOST or mqtts://USER@HOST.",
        },
    )
    assert asked.kept is None
