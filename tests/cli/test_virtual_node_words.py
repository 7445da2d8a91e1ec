"""``node create``, ``node run`` and ``node reset``: what they print and refuse (docs/virtual-nodes.md)."""

from __future__ import annotations

import errno
import json
import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import click
import pytest

from teds_provision.cli.node import virtual_nodes
from teds_provision.cli.node.virtual_nodes import ActuatorLines
from teds_provision.errors import LinkError
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.hardware.board import ActuatorReading
from teds_provision.protocol.keys import fingerprint
from teds_provision.teds.profile import load_profile
from tests.e2e.desk import ROOT

from .shell import call

UUID = "8d4d9da65281f7000000"
DBC = ROOT / "examples" / "bench" / "torque.dbc"


class Printed:
    """The command's output: JSON objects with the lines for people."""

    def __init__(self) -> None:
        self.lines: list[tuple[dict[str, Any], str]] = []
        self.fails = False

    def emit(self, record: dict[str, Any], text: str) -> None:
        if self.fails:
            raise BrokenPipeError
        self.lines.append((record, text))

    @property
    def words(self) -> list[str]:
        return [text for _, text in self.lines]


class Pause:
    """The pauses between two prints; ``meanwhile`` is called in each."""

    def __init__(self, *meanwhile: Callable[[], None]) -> None:
        self.seconds: list[float] = []
        self._meanwhile = list(meanwhile)
        self._set = False

    def is_set(self) -> bool:
        return self._set

    def set(self) -> None:
        self._set = True

    def wait(self, seconds: float) -> bool:
        self.seconds.append(seconds)
        self._meanwhile.pop(0)()
        self._set = self._set or not self._meanwhile
        return self._set


def lines_on(printed: Printed, *meanwhile: Callable[[ActuatorLines], None]) -> tuple[ActuatorLines, Pause]:
    made: Any = ActuatorLines(printed)  # type: ignore[arg-type]
    pause = made._stop = Pause(*[lambda step=step: step(made) for step in meanwhile])  # type: ignore[misc]
    return made, pause


def state(value: float | None, *, channel: int = 1, safe: bool = False, name: str = "grip", unit: str = "m") -> Any:
    return ActuatorReading(channel, name, value, unit, 7.0, safe, 1_700_000_000.25)


def test_an_actuator_prints_at_most_20_lines_a_second_and_always_its_last_state() -> None:
    printed = Printed()

    def many(lines: ActuatorLines) -> None:
        for number in range(100):
            lines.observer_of("aa")(state(float(number)))
            lines.observer_of("aa")(state(number / 2, channel=2))
            lines.observer_of("bb")(state(-1.0))

    def at_the_end(lines: ActuatorLines) -> None:
        many(lines)
        lines.observer_of("bb")(state(0.0, safe=True))

    lines, pause = lines_on(printed, many, lambda lines: lines.observer_of("aa")(state(99.0)), at_the_end)
    lines.observer_of("aa")(state(0.5))
    lines._run()
    assert printed.words == [
        "aa grip: 0.5 m",
        "aa grip: 99 m",
        "aa grip: 49.5 m",
        "bb grip: -1 m",
        "bb grip: safe state, 0 m",
    ]
    assert pause.seconds == [0.05] * 3, "a state that was printed is not printed again"


def test_the_line_of_an_actuator_in_words_and_json() -> None:
    printed = Printed()
    lines, _ = lines_on(printed, lambda _: None)
    for number, reading in enumerate(
        (
            state(0.25),
            state(0.0, safe=True),
            state(None),
            state(2.0, name="", unit=""),
            ActuatorReading(5, "valve", None, "m", math.nan, True, 0.0),
        )
    ):
        lines.observer_of(f"n{number}")(reading)
    lines._run()
    assert printed.words == [
        "n0 grip: 0.25 m",
        "n1 grip: safe state, 0 m",
        "n2 grip: raw 7",
        "n3 channel 1: 2",
        "n4 valve: safe state, raw nan",
    ]
    assert printed.lines[1][0] == {
        "event": "actuator",
        "uuid": "n1",
        "channel": 1,
        "name": "grip",
        "value": 0.0,
        "unit": "m",
        "raw": 7.0,
        "safe": True,
        "time": "2023-11-14T22:13:20.250Z",
    }
    assert (printed.lines[3][0]["name"], printed.lines[4][0]["raw"]) == ("", None)


def test_events_of_nodes_in_words_and_json_and_before_the_states() -> None:
    printed = Printed()
    lines, _ = lines_on(printed, lambda _: None)
    lines.observer_of("aa")(state(1.0))
    report = lines.validity_of("aa")
    report(2, "torque", "no frame for 30 ms")
    report(2, "torque", "")
    lines.locate_of("bb")(10)
    lines.locate_of("bb")(0)
    lines.note_reset("cc")
    lines._run()
    assert printed.words == [
        "aa torque: invalid: no frame for 30 ms",
        "aa torque: valid again",
        "bb: blinks for 10 s",
        "bb: stops",
        "cc: reset by hand, back in factory state",
        "aa grip: 1 m",
    ]
    events = [{key: value for key, value in record.items() if key != "time"} for record, _ in printed.lines[:5]]
    assert events == [
        {"event": "invalid", "uuid": "aa", "channel": 2, "name": "torque", "reason": "no frame for 30 ms"},
        {"event": "valid", "uuid": "aa", "channel": 2, "name": "torque"},
        {"event": "locate", "uuid": "bb", "seconds": 10},
        {"event": "locate", "uuid": "bb", "seconds": 0},
        {"event": "reset", "uuid": "cc", "state": "factory"},
    ]
    assert all(record["time"].endswith("Z") for record, _ in printed.lines)


def test_of_events_that_nobody_reads_the_last_thousand_are_kept() -> None:
    printed = Printed()
    lines, _ = lines_on(printed, lambda _: None)
    for number in range(1001):
        lines.locate_of("aa")(number + 1)
    lines._run()
    assert (len(printed.lines), printed.words[0], printed.words[-1]) == (
        1000,
        "aa: blinks for 2 s",
        "aa: blinks for 1001 s",
    )


@pytest.mark.parametrize("kind", ["event", "state"])
def test_a_node_whose_output_nobody_takes_prints_no_more_and_goes_on(kind: str) -> None:
    printed = Printed()
    printed.fails = True
    lines, pause = lines_on(printed, lambda _: None)
    (lines.note_reset if kind == "event" else lambda uuid: lines.observer_of(uuid)(state(1.0)))("aa")
    lines._run()
    assert (printed.lines, pause.is_set()) == ([], True)


def test_what_is_left_at_the_end_is_printed() -> None:
    printed = Printed()
    lines = ActuatorLines(printed)  # type: ignore[arg-type]
    lines.start()
    lines.observer_of("aa")(state(0.0, safe=True))
    lines.stop()
    assert printed.words == ["aa grip: safe state, 0 m"]
    ActuatorLines(printed).stop()  # type: ignore[arg-type]


# -- create ------------------------------------------------------------------------------------------------------------


def test_a_created_node_is_shown_whole(home: Path, tmp_path: Path) -> None:
    made = call(home, "node", "create", tmp_path / "a", "--uuid", f"0x{UUID}", "--name", "plain")
    key = fingerprint(FlashFile(tmp_path / "a").load().node_key)
    address = FlashFile(tmp_path / "a").load().can_address
    start = f"Node {UUID} in {tmp_path / 'a'}, key {key[:16]}, CAN address 0x{address:02x}"
    assert made.out == f"{start}.\n"
    again = call(home, "--json", "node", "create", tmp_path / "a", "--uuid", UUID, "--name", "plain")
    assert again.json == {
        "uuid": UUID,
        "fingerprint": key,
        "name": "plain",
        "can_address": address,
        "channels": [],
        "origin": None,
        "firmware": None,
    }
    made = call(home, "node", "create", tmp_path / "b", "--profile", "limit-switch")
    assert made.out.endswith(", 1 channel.\n")
    made = call(home, "--json", "node", "create", tmp_path / "c", "--profile", "gripper")
    assert [(each["channel"], each["kind"], each["unit"]) for each in made.json["channels"]] == [
        (1, "actuator", "m"),
        (2, "sensor", "m"),
        (3, "sensor", "N"),
    ]
    assert call(home, "node", "create", tmp_path / "d", "--profile", "gripper").out.endswith(", 3 channels.\n")


def test_a_wrapped_node_is_shown_with_its_sensor(home: Path, tmp_path: Path) -> None:
    words = ("node", "create", tmp_path / "a", "--from", f"dbc:{DBC}", "--message", "Torque")
    made = call(home, "--json", *words)
    assert made.json["origin"]["kind"] == "dbc"
    assert [each["name"] for each in made.json["channels"]] == ["torque", "speed", "temperature", "state"]
    assert made.json["channels"][3]["choices"]["2"] == "overload"
    assert call(home, *words).out.endswith(", 4 channels, wraps CAN message Torque (dbc).\n")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--profile", "gripper", "--from", "iio:x"), "--profile and --from cannot be combined."),
        (("--message", "Torque"), "--message needs --from dbc:FILE."),
        (("--new-uuid",), "--new-uuid replaces the UUID in a file."),
        (("--new-uuid", "--teds", "FILE", "--uuid", UUID), "--new-uuid replaces the UUID in a file."),
        (("--firmware", "FILE"), "--firmware and --firmware-key belong together."),
        (("--firmware-key", "FILE"), "--firmware and --firmware-key belong together."),
        (("--uuid", UUID[:-1]), "a UUID has 20 hex digits."),
        (("--uuid", UUID + "00"), "a UUID has 20 hex digits."),
        (("--name", "a\nb"), "a name has at most 120 octets of printable text; this one has 3."),
        (("--name", "ä" * 61), "a name has at most 120 octets of printable text; this one has 122."),
    ],
    ids=lambda value: None if isinstance(value, str) else " ".join(value)[:40],
)
def test_options_of_create_that_do_not_go_together(
    home: Path, tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    file = tmp_path / "file"
    file.write_text("{}")
    done = call(home, "--json", "node", "create", tmp_path / "a", *(file if word == "FILE" else word for word in words))
    assert (done.code, message in json.dumps(done.json, ensure_ascii=False)) == (2, True), done
    assert not (tmp_path / "a").exists()


# -- run ---------------------------------------------------------------------------------------------------------------

NFC, CAN = ("--nfc", "udp:localhost:1"), ("--can", "udp_multicast:239.1.2.3")


@pytest.mark.parametrize(
    ("count", "words", "message"),
    [
        (1, (), "A node needs a link."),
        (2, NFC, "--nfc supports one node only."),
        (2, (*NFC, *CAN), "--nfc supports one node only."),
        (2, ("--ble", "usb:0"), "--ble supports one node only."),
        (2, (*CAN, "--source", "-"), "--source - supports one node only."),
        (2, (*CAN, "--source", "unix:/x"), "--source unix:/x supports one node only."),
        (1, (*CAN, "--bus", "virtual:x"), "--bus names wrapped sensors."),
        (1, (*CAN, "--node-id", "5"), "--node-id names wrapped sensors."),
        (1, (*CAN, "--source", "sinus:2"), "--source 'sinus:2' is not known."),
        (1, (*CAN, "--source", f"dbc:{DBC}", "--bus", "virtual:x"), "wraps no sensor."),
        (1, (*CAN, "--source", "dbc:", "--bus", "virtual:x"), "--source dbc: needs a file or device."),
    ],
    ids=lambda value: " ".join(value)[:40] if isinstance(value, tuple) else None,
)
def test_options_of_run_that_do_not_go_together(
    home: Path, tmp_path: Path, count: int, words: tuple[str, ...], message: str
) -> None:
    folders = [tmp_path / f"node{number}" for number in range(count)]
    for folder in folders:
        FlashFile.create(folder)
    done = call(home, "--json", "node", "run", *folders, *words)
    assert (done.code, message in json.dumps(done.json, ensure_ascii=False)) == (2, True), done


def test_a_wrapped_node_runs_from_no_other_source_nor_file(home: Path, tmp_path: Path) -> None:
    folder = tmp_path / "a"
    call(home, "node", "create", folder, "--from", f"dbc:{DBC}", "--message", "Torque")
    run = ("--json", "node", "run", folder, *CAN)
    done = call(home, *run)
    assert done.code == 2
    assert done.json["error"]["message"] == (
        f"The node in {folder} wraps CAN message Torque (dbc), so --source noise cannot give its values."
    )
    assert done.json["error"]["hint"] == "Use --source dbc:FILE."
    done = call(home, *run, "--source", "canopen:x.eds", "--bus", "virtual:x", "--node-id", "5")
    assert done.json["error"]["message"] == (
        f"Node {folder} wraps a sensor of kind dbc, which --source canopen does not read."
    )
    other = tmp_path / "other.dbc"
    other.write_bytes(DBC.read_bytes() + b"\n")
    done = call(home, *run, "--source", f"dbc:{other}", "--bus", "virtual:x")
    assert (done.code, done.json["error"]["message"]) == (
        6,
        f"{other} is not the file that the node was made from: channels, units or ranges may differ.",
    )
    done = call(home, *run, "--source", f"dbc:{DBC}")
    assert (done.code, done.json["error"]["message"]) == (2, "--source dbc needs the bus of the sensors.")


def test_a_reset_by_hand_and_its_plan(home: Path, tmp_path: Path) -> None:
    for number, (words, out) in enumerate(
        (
            (("--dry-run",), f"Plan: reset node {UUID} to factory state.\n"),
            (("--dry-run", "--json"), {"uuid": UUID, "plan": "reset"}),
            ((), f"Node {UUID} is back in factory state.\n"),
            (("--json",), {"uuid": UUID, "state": "factory"}),
        )
    ):
        folder = tmp_path / str(number)
        FlashFile.create(folder, uuid=bytes.fromhex(UUID))
        before = (folder / "flash.json").read_bytes()
        done = call(
            home,
            *(("--json",) if "--json" in words else ()),
            "node",
            "reset",
            folder,
            *words[:1][: "--dry-run" in words],
        )
        assert (done.json if isinstance(out, dict) else done.out) == out
        assert "--dry-run" not in words or (folder / "flash.json").read_bytes() == before


@pytest.mark.parametrize("charged", [False, True])
@pytest.mark.parametrize(
    ("given", "kinds"),
    [
        ({"nfc": "udp:1"}, ["nfc"]),
        ({"can": "virtual:x"}, ["can"]),
        ({"ble": "usb:0"}, ["ble"]),
        ({"nfc": "udp:1", "can": "virtual:x", "ble": "usb:0"}, ["ble", "nfc", "can"]),
    ],
)
def test_a_node_is_served_on_each_link_that_is_named(
    monkeypatch: pytest.MonkeyPatch, given: dict[str, str], kinds: list[str], charged: bool
) -> None:
    made: list[Any] = []
    tapped: list[Any] = []

    class Server:
        def __init__(self, kind: str, *_: Any, **how: Any) -> None:
            self.kind, self.how, self.added = kind, how, list[Any]()
            self.restarted = lambda *of: course.append((kind, "restarted", *of))
            self.announce_press = lambda *of: course.append((kind, "pressed", *of))
            self.address = SimpleNamespace(octets=bytes(6))
            made.append(self)

        def tapped(self) -> None:
            tapped.append(self.kind)

        def send_data(self, *of: Any, **_: Any) -> None:
            course.append((self.kind, "sent", *of))

        def add(self, node: Any, *, counts_as_tapped: Any, measuring_handler: Any) -> None:
            self.added.append((node, counts_as_tapped(), measuring_handler is node))

    course, restarted, pressed, streams = list[Any](), list[Any](), list[Any](), list[Any]()
    battery = SimpleNamespace(field=lambda *, present: course.append(("field", present)), power=lambda: "power")
    node: Any = SimpleNamespace(
        in_factory_state=lambda: True,
        board=SimpleNamespace(battery=battery) if charged else None,
        flash_file=SimpleNamespace(path=Path("/x/flash.json")),
        when_restarted=restarted.append,
        announces_presses_over=pressed.append,
        streams_over=lambda *of: streams.append(of),
    )
    charging = virtual_nodes.node_room.tnep
    monkeypatch.setattr(charging, "charge_records", lambda power: (f"charge of {power}",))
    monkeypatch.setattr(charging, "out_of_band_record", lambda octets, *, random: (octets, random))
    room = virtual_nodes.node_room
    for name, kind in (("NfcServer", "nfc"), ("CanServer", "can"), ("BleServer", "ble")):
        monkeypatch.setattr(room, name, lambda *given, kind=kind, **how: Server(kind, *given, **how))
    monkeypatch.setattr(room, "StaticAddress", lambda folder, *, factory: (folder, factory))
    app: Any = SimpleNamespace(warn=lambda _text: None)
    links: dict[str, Any] = {"nfc": None, "can": None, "ble": None} | given
    servers = virtual_nodes._servers(app, [node], tag=None, pace=True, wait_time=23, **links)
    assert [cast(Any, server).kind for server in servers] == kinds
    by_kind = {server.kind: server for server in made}
    if "can" in by_kind:
        assert by_kind["can"].added == [(node, "nfc" not in by_kind, True)], "with a reader, only it is a tap"
    if "nfc" in by_kind:
        how = by_kind["nfc"].how
        assert (how["wt_int"], how["pace"]) == (20, True), "in steps of four"
        how["extras"].field(present=True)
        assert tapped == (["ble"] if "ble" in by_kind else [])
        assert how["extras"].after() == (((bytes(6), True),) if "ble" in by_kind else ())
        assert how["extras"].before() == (("charge of power",) if charged else ())
        assert course == ([("field", True)] if charged else [])
        how["extras"].field(present=False)
        assert course[1:] == ([("field", False)] if charged else [])
        battery.power = lambda: "later power"
        assert how["extras"].before() == (("charge of later power",) if charged else ()), "as it is at the tap"
    course.clear()
    for call_it in (*restarted, *pressed):
        call_it()
    frame = SimpleNamespace(identifier=5, data=b"x", fd=True)
    for send, *_ in streams:
        send(frame)
    of_bus = [("can", "restarted", node), ("can", "pressed", node), ("can", "sent", node, 5, b"x")]
    of_air = [("ble", "restarted"), ("ble", "sent", frame)]
    of_reader = [("nfc", "restarted")]
    wanted = {"can": of_bus, "ble": of_air, "nfc": of_reader}
    assert sorted(course, key=str) == sorted((one for kind in kinds for one in wanted[kind]), key=str)


@pytest.mark.parametrize(
    ("hardware", "source", "percent", "made", "warned"),
    [
        ({}, "noise", None, False, False),
        ({}, "sine:2", None, False, True),
        ({}, "noise", 50.0, True, False),
        ({}, "sine:2", 50.0, True, True),
    ],
)
def test_a_node_without_channels_needs_no_source(
    tmp_path: Path, hardware: dict[Any, bytes], source: str, percent: float | None, made: bool, warned: bool
) -> None:
    warnings: list[str] = []
    app: Any = SimpleNamespace(warn=warnings.append)
    lines: Any = SimpleNamespace(observer_of=lambda _uuid: None)
    file = FlashFile.create(tmp_path / "a", uuid=bytes.fromhex(UUID))
    board = virtual_nodes._boards(app, lines, source, percent, None)(file)
    assert (board is not None) is made
    text = f"Node {UUID} has no channels, so --source has no effect: create it with --teds or --profile."
    assert warnings == ([text] if warned else [])
    if board is not None:
        assert board.battery is not None


def test_each_wrapped_node_has_its_own_reader_and_its_delay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[dict[str, Any]] = []
    monkeypatch.setattr(virtual_nodes.node_room, "Board", lambda _sheet, **facts: made.append(facts))
    app: Any = SimpleNamespace(warn=lambda _text: None)
    lines: Any = SimpleNamespace(observer_of=lambda uuid: uuid)
    wrapped: Any = SimpleNamespace(source=lambda number: f"reader {number}")
    files = [FlashFile.create(tmp_path / name, uuid=bytes.fromhex(UUID)) for name in "ab"]
    make = virtual_nodes._boards(app, lines, "noise", 50.0, wrapped)
    for file in files:
        make(file)
    virtual_nodes._boards(app, lines, "noise", 50.0, None)(files[0])
    lag = virtual_nodes.node_room.wrapped.wrapped_source.LAG
    assert lag > 0
    assert [(facts["source"], facts["lag"], facts["shown"]) for facts in made] == [
        ("reader 0", lag, UUID),
        ("reader 1", lag, UUID),
        ("noise", 0, UUID),
    ]


def test_signals_reach_every_node_that_runs() -> None:
    course: list[str] = []

    def node(name: str) -> Any:
        return SimpleNamespace(
            reset_by_hand=lambda: course.append(f"reset {name}"),
            press_button=lambda: course.append(f"press {name}"),
            tim=SimpleNamespace(flash=SimpleNamespace(uuid=name.encode())),
        )

    lines: Any = SimpleNamespace(note_reset=lambda uuid: course.append(f"line {bytes.fromhex(uuid).decode()}"))
    virtual_nodes._reset_all([node("a"), node("b")], lines)
    virtual_nodes._press_all([node("a"), node("b")])
    assert course == ["reset a", "line a", "reset b", "line b", "press a", "press b"]


@pytest.mark.parametrize(("percent", "wrapped"), [(None, False), (50.0, False), (None, True)])
def test_nodes_with_channels_have_their_source_and_a_battery_if_one_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, percent: float | None, wrapped: bool
) -> None:
    made: list[Any] = []
    monkeypatch.setattr(virtual_nodes.node_room, "Board", lambda sheet, **how: made.append((sheet, how)))
    monkeypatch.setattr(virtual_nodes.node_room, "Battery", lambda percent: f"{percent} %")
    warnings: list[str] = []
    app: Any = SimpleNamespace(warn=warnings.append)
    lines: Any = SimpleNamespace(observer_of=lambda uuid: f"lines of {uuid}")
    sources: Any = SimpleNamespace(source=lambda number: f"sensor {number}") if wrapped else None
    make = virtual_nodes._boards(app, lines, "sine:2", percent, sources)
    uuids = [bytes([number]) * 10 for number in (1, 2)]
    for uuid in uuids:
        hardware = load_profile("gripper").build(uuid).blocks
        make(cast(Any, SimpleNamespace(load=lambda uuid=uuid: SimpleNamespace(uuid=uuid), hardware=hardware)))
    lag = virtual_nodes.node_room.wrapped.wrapped_source.LAG if wrapped else 0
    assert lag or not wrapped
    assert [how for _, how in made] == [
        {
            "source": f"sensor {number}" if wrapped else "sine:2",
            "lag": lag,
            "battery": None if percent is None else "50.0 %",
            "shown": f"lines of {uuid.hex()}",
            "notify": app.warn,
        }
        for number, uuid in enumerate(uuids)
    ]
    assert ([len(sheet.channels) for sheet, _ in made], warnings) == ([3, 3], [])


@pytest.mark.parametrize(
    ("text", "octets"),
    [(UUID, bytes.fromhex(UUID)), (f"0x{UUID}", bytes.fromhex(UUID)), (f"0X{UUID.upper()}", bytes.fromhex(UUID)),
     (None, None)],
)  # fmt: skip
def test_a_uuid_is_20_digits_with_or_without_0x(text: str | None, octets: bytes | None) -> None:
    none: Any = None
    assert virtual_nodes._uuid(none, none, text) == octets


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("thumb", None),
        ("", None),
        ("ä" * 60, None),
        ("ä" * 61, "a name has at most 120 octets of printable text; this one has 122."),
        ("a\tb", "a name has at most 120 octets of printable text; this one has 3."),
        ("sch\udcf6n", "the name is not valid text in this terminal's encoding."),
    ],
)
def test_a_name_is_short_printable_text(name: str, why: str | None) -> None:
    none: Any = None
    if why is None:
        assert virtual_nodes._name(none, none, name) == name
        return
    with pytest.raises(click.BadParameter) as refused:
        virtual_nodes._name(none, none, name)
    assert refused.value.message == why


def test_an_empty_message_names_one_too(home: Path, tmp_path: Path) -> None:
    done = call(home, "--json", "node", "create", tmp_path / "a", "--message", "")
    assert (done.code, done.json["error"]["message"]) == (2, "--message needs --from dbc:FILE.")


def test_what_a_sensor_says_of_itself_is_noted_and_its_image_is_started(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = virtual_nodes.node_room
    describe = room.wrapped.reading.describe

    def noted(*words: Any) -> Any:
        sensor = describe(*words)
        first, second, *rest = sensor.channels
        return replace(sensor, channels=(replace(first, note="no [unit]"), replace(second, note="0 to 1"), *rest))

    monkeypatch.setattr(room.wrapped.reading, "describe", noted)
    slots: list[Any] = []
    image = SimpleNamespace(version_text="1.4.0", digest=b"\xab" * 32)
    monkeypatch.setattr(
        room.firmware.boot_loader.ImageSlots,
        "create",
        lambda *words: slots.append(words) or SimpleNamespace(running=image),
    )
    for name in ("image.bin", "owner.pem"):
        (tmp_path / name).write_bytes(b"x")
    firmware = ("--firmware", tmp_path / "image.bin", "--firmware-key", tmp_path / "owner.pem")
    words = ("node", "create", tmp_path / "a", "--from", f"dbc:{DBC}", "--message", "Torque", *firmware)
    made = call(home, *words)
    assert made.err.splitlines() == ["torque: no [unit].", "speed: 0 to 1."]
    assert made.out.endswith(", 4 channels, wraps CAN message Torque (dbc), firmware 1.4.0.\n")
    assert slots == [(tmp_path / "a", tmp_path / "image.bin", tmp_path / "owner.pem")]
    assert call(home, "--json", *words).json["firmware"] == {"version": "1.4.0", "image": "ab" * 32}


def test_an_empty_battery_is_one(tmp_path: Path) -> None:
    app: Any = SimpleNamespace(warn=None)
    lines: Any = SimpleNamespace(observer_of=lambda _uuid: None)
    file = FlashFile.create(tmp_path / "a", uuid=bytes.fromhex(UUID))
    board = virtual_nodes._boards(app, lines, "noise", 0.0, None)(file)
    assert board is not None
    assert board.battery is not None
    assert board.battery.power().level == 0


@pytest.mark.parametrize(("count", "text"), [(1, f"Node {UUID} ready on a and b."), (2, "2 nodes ready on a and b.")])
def test_nodes_that_are_ready_are_named(count: int, text: str) -> None:
    printed = Printed()
    keys = [bytes([number]) * 65 for number in range(count)]
    nodes: Any = [
        SimpleNamespace(tim=SimpleNamespace(flash=SimpleNamespace(uuid=bytes.fromhex(UUID), node_key=key)))
        for key in keys
    ]
    virtual_nodes._say_ready(printed, nodes, ["a", "b"], "noise")  # type: ignore[arg-type]
    named = [{"uuid": UUID, "fingerprint": fingerprint(key)} for key in keys]
    several = {"nodes": named} if count > 1 else {}
    assert printed.lines == [({**named[0], **several, "links": ["a", "b"], "source": "noise", "ready": True}, text)]


@pytest.mark.parametrize("kind", ["event", "state"])
def test_a_node_whose_output_a_full_disk_refuses_goes_on_too(kind: str) -> None:
    class Full(Printed):
        def emit(self, record: dict[str, Any], text: str) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    lines, pause = lines_on(Full(), lambda _: None)
    (lines.note_reset if kind == "event" else lambda uuid: lines.observer_of(uuid)(state(1.0)))("aa")
    lines._run()
    assert pause.is_set()


@pytest.mark.parametrize(
    ("signal_of_end", "links", "has_can"),
    [("SIGTERM", {"can": "virtual:x"}, True), ("SIGINT", {"nfc": "udp:1", "ble": "usb:0"}, False)],
)
@pytest.mark.parametrize("fails", [False, True])
def test_nodes_run_until_a_signal_and_end_in_reverse_with_their_last_lines(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    signal_of_end: str,
    links: dict[str, str],
    has_can: bool,
    fails: bool,
) -> None:
    course: list[Any] = []
    handlers: dict[str, Any] = {}
    made: list[Any] = []

    class Part:
        def __init__(self, name: str) -> None:
            self.name = name

        def start(self) -> None:
            course.append(f"start {self.name}")
            if fails and self.name == "bus":
                raise LinkError("The bus is away.")

        def stop(self) -> None:
            course.append(f"stop {self.name}")

        def locate_of(self, uuid: str) -> str:
            return f"locate {uuid}"

    class Stop:
        ended = False

        def request_stop(self) -> None:
            self.ended = True

        def wait(self, _seconds: float) -> bool:
            handlers[signal_of_end]()
            return self.ended

    room = virtual_nodes.node_room
    board = Part("board")
    monkeypatch.setattr(
        room.virtual,
        "VirtualNode",
        lambda folder, **how: made.append((folder, how)) or SimpleNamespace(board=board if len(made) == 1 else None),
    )
    monkeypatch.setattr(room.realtime_loop, "RealtimeLoop", lambda: Part("pulse"))
    monkeypatch.setattr(virtual_nodes, "ActuatorLines", lambda _app: Part("lines"))
    monkeypatch.setattr(virtual_nodes, "_wrapped", lambda *_words: Part("reader"))
    monkeypatch.setattr(virtual_nodes, "_boards", lambda *_words: "make")
    monkeypatch.setattr(virtual_nodes, "_servers", lambda _app, _nodes, **_links: [Part("air"), Part("bus")])
    monkeypatch.setattr(virtual_nodes, "_check_options", lambda *_words, **_links: None)
    monkeypatch.setattr(
        virtual_nodes, "_say_ready", lambda _app, _nodes, up, source: course.append(("ready", up, source))
    )
    monkeypatch.setattr(virtual_nodes.provisioning.meeting, "IdleStop", lambda _none: Stop())
    names = ("SIGTERM", "SIGINT", "SIGUSR1", "SIGUSR2")
    monkeypatch.setattr(
        virtual_nodes,
        "signal",
        SimpleNamespace(
            **{name: name for name in names}, signal=lambda name, handler: handlers.update({name: handler})
        ),
    )
    folders = [tmp_path / "a", tmp_path / "b"]
    uuids = [FlashFile.create(folder).load().uuid.hex() for folder in folders]
    words: dict[str, Any] = dict.fromkeys(("nfc", "can", "ble"), None) | links
    app: Any = SimpleNamespace(warn=None)
    callback: Any = virtual_nodes.run.callback
    ending = pytest.raises(LinkError) if fails else nullcontext()
    with ending:
        callback.__wrapped__(
            app, folders=folders, crypto_delay=20.0, flash_delay=5.0, source="noise", battery=None, bus=None,
            node_ids=(), **words,
        )  # fmt: skip
    begun = ["start pulse", "start reader", "start board", "start air", "start bus"]
    ends = ["stop air", "stop board", "stop reader", "stop pulse"]
    if fails:
        assert course == [*begun, *ends], "what was started is stopped"
    else:
        up = [place for place in (words["nfc"], words["can"], words["ble"]) if place]
        assert course == [*begun, ("ready", up, "noise"), "start lines", "stop bus", *ends, "stop lines"]
    assert set(handlers) == set(names)
    assert [folder for folder, _ in made] == folders
    for (_, how), uuid in zip(made, uuids, strict=True):
        assert (how["delays"].crypto, how["delays"].flash) == (0.02, 0.005), "milliseconds"
        assert (how["has_can"], how["exclusive"], how["board"], how["located"]) == (
            has_can,
            True,
            "make",
            f"locate {uuid}",
        )
