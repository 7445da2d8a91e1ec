"""``node create`` and ``node run``: what they print, whole, what they ask and what they refuse; in this process."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.cli.node import virtual_nodes
from teds_provision.cli.node.virtual_nodes import ActuatorLines
from teds_provision.errors import KnownUuidError, UsageError
from teds_provision.node import node_template
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.hardware.board import ActuatorReading
from teds_provision.node.wrapped.running import SensorPlace
from teds_provision.protocol.keys import fingerprint
from teds_provision.teds.image import Image
from teds_provision.teds.origin import Origin
from teds_provision.teds.profile import load_profile

from .shell import call

UUID = bytes.fromhex("8d4d9da65281f7000000")
NODE = UUID.hex()


# -- node create -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("profile", "end"),
    [
        (None, ", CAN address 0xc0."),
        ("magnetic-angular-position-sensor", ", CAN address 0xc0, 1 channel."),
        ("gripper", ", CAN address 0xc0, 3 channels."),
    ],
)
def test_what_create_prints_and_that_the_same_again_changes_nothing(
    tmp_path: Path, profile: str | None, end: str
) -> None:
    words = ["node", "create", tmp_path / "n", "--uuid", NODE, *(["--profile", profile] if profile else [])]
    made = call(tmp_path / "home", *words)
    key = fingerprint(FlashFile(tmp_path / "n").load().node_key)
    assert (made.code, made.out) == (0, f"Node {NODE} in {tmp_path / 'n'}, key {key[:16]}{end}\n")
    stored = (tmp_path / "n" / "flash.json").read_bytes()
    assert call(tmp_path / "home", *words) == made
    assert (tmp_path / "n" / "flash.json").read_bytes() == stored


def test_the_object_that_create_prints_is_held_whole(tmp_path: Path) -> None:
    words = ["--json", "node", "create", tmp_path / "n", "--uuid", f"0x{NODE.upper()}", "--profile", "gripper"]
    made = call(tmp_path / "home", *words, "--name", "left hand").json
    assert made == {
        "uuid": NODE,
        "fingerprint": fingerprint(FlashFile(tmp_path / "n").load().node_key),
        "name": "left hand",
        "can_address": 0xC0,
        "channels": [
            {"channel": 1, "name": "opening set point", "kind": "actuator", "unit": "m"},
            {"channel": 2, "name": "opening", "kind": "sensor", "unit": "m"},
            {"channel": 3, "name": "grip force", "kind": "sensor", "unit": "N"},
        ],
        "origin": None,
        "firmware": None,
    }


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--teds", "FILE", "--profile", "gripper"], "--teds and --profile cannot be combined."),
        (["--profile", "gripper", "--from", "iio:x"], "--profile and --from cannot be combined."),
        (["--teds", "FILE", "--from", "iio:x"], "--teds and --from cannot be combined."),
        (["--message", "Torque"], "--message needs --from dbc:FILE."),
        (["--message", "Torque", "--profile", "gripper"], "--message needs --from dbc:FILE."),
        (["--new-uuid"], "--new-uuid replaces the UUID in a file."),
        (["--new-uuid", "--profile", "gripper"], "--new-uuid replaces the UUID in a file."),
        (["--new-uuid", "--teds", "FILE", "--uuid", NODE], "--new-uuid replaces the UUID in a file."),
        (["--firmware", "FILE"], "--firmware and --firmware-key belong together."),
        (["--firmware-key", "FILE"], "--firmware and --firmware-key belong together."),
        (["--uuid", NODE[:-2]], "Invalid value for '--uuid': a UUID has 20 hex digits."),
        (["--uuid", "x" * 20], "Invalid value for '--uuid': a UUID has 20 hex digits."),
        (["--name", "a\nb"], "printable text; this one has 3."),
        (["--max-message", "511"], "511"),
        (["--max-message", "4095"], "4095"),
    ],
)
def test_what_create_refuses_makes_no_node(tmp_path: Path, words: list[str], message: str) -> None:
    (tmp_path / "FILE").write_text("x")
    given = [tmp_path / word if word == "FILE" else word for word in words]
    refused = call(tmp_path / "home", "--json", "node", "create", tmp_path / "n", *given)
    assert refused.code == 2
    assert message in refused.json["error"]["message"]
    assert not (tmp_path / "n").exists()


def image_file(folder: Path, uuid: bytes = UUID) -> Path:
    file = folder / f"{uuid.hex()}.json"
    file.write_text(Image(uuid, load_profile("gripper").build(uuid).blocks).to_json())
    return file


class Terminal:
    """Stands for the app of a command: a person who answers, and what is shown."""

    def __init__(self, home: Path, *, answer: bool | None) -> None:
        self.home, self.interactive, self._answer = home, answer is not None, answer
        self.questions, self.notes, self.warnings = list[str](), list[str](), list[str]()

    def ask_yes_no(self, question: str) -> bool:
        self.questions.append(question)
        return bool(self._answer)

    def note(self, text: str) -> None:
        self.notes.append(text)

    def warn(self, text: str) -> None:
        self.warnings.append(text)


def free_uuid(tmp_path: Path, answer: bool | None, *, uuid: bytes | None = None, new: bool = False) -> Any:
    """Return the terminal, and the UUID with which a node is made of a file."""
    terminal: Any = Terminal(tmp_path, answer=answer)
    return terminal, virtual_nodes._free_uuid(terminal, tmp_path / "n", uuid, image_file(tmp_path), new)


def test_a_uuid_that_is_known_is_asked_for_and_never_taken_over_without_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(virtual_nodes, "_known_as", lambda _app, uuid: "Node 'hand'" if uuid == UUID else None)
    terminal, uuid = free_uuid(tmp_path, answer=True)
    assert uuid not in (None, UUID)
    assert len(uuid) == 10
    assert terminal.questions == ["Create the node with a new UUID?"]
    assert terminal.notes == [
        f"Node 'hand' has the UUID {NODE} of {tmp_path / NODE}.json; two nodes with one UUID cannot be distinguished."
    ]
    with pytest.raises(KnownUuidError, match=r"Cancelled\. Nothing was created\.") as refused:
        free_uuid(tmp_path, answer=False)
    assert refused.value.hint == f"To make the copy anyway: --uuid {NODE}"
    with pytest.raises(KnownUuidError, match="has the UUID") as refused:
        free_uuid(tmp_path, answer=None)
    assert (refused.value.exit_code, refused.value.code) == (6, "uuid-known")
    for answer in (None, False):
        terminal, uuid = free_uuid(tmp_path, answer=answer, uuid=UUID)
        assert (uuid, terminal.questions) == (UUID, []), "who names it means it"
        assert terminal.warnings == [
            "Node 'hand' has this UUID: two nodes with one UUID cannot be distinguished. Run only one of them."
        ]
        terminal, uuid = free_uuid(tmp_path, answer=answer, new=True)
        assert (uuid != UUID, len(uuid), terminal.questions) == (True, 10, [])
    other = bytes(range(10))
    terminal, uuid = free_uuid(tmp_path, answer=None, uuid=other)
    assert (uuid, terminal.warnings) == (other, [])


def test_a_uuid_that_nobody_knows_is_the_files_and_one_that_was_made_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(virtual_nodes, "_known_as", lambda _app, _uuid: None)
    assert free_uuid(tmp_path, answer=None)[1] is None
    node_template.create(tmp_path / "n", teds=image_file(tmp_path))
    monkeypatch.setattr(virtual_nodes, "_known_as", lambda _app, _uuid: "Node 'hand'")
    assert free_uuid(tmp_path, answer=None)[1] is None, "the same command again"
    assert free_uuid(tmp_path, answer=None, new=True)[1] == UUID, "also one that asked for a new UUID before"


def test_a_node_is_known_to_the_station_or_on_a_link_of_its_running_ncap(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = SimpleNamespace(name="hand")
    station: Any = SimpleNamespace(
        overview=SimpleNamespace(is_known=lambda uuid: uuid != UUID),
        nodes=SimpleNamespace(get=lambda uuid: known if uuid == b"a" else None),
    )
    app: Any = SimpleNamespace(home=home, station=lambda: station)
    assert virtual_nodes._known_as(app, b"a") == "Node 'hand'"
    known.name = ""
    assert virtual_nodes._known_as(app, b"a") == "A node of this station"
    assert virtual_nodes._known_as(app, b"b") == "A node of this station"
    assert virtual_nodes._known_as(app, UUID) is None
    asked: list[str] = []
    connected = SimpleNamespace(connect=lambda home: SimpleNamespace(node=asked.append))
    monkeypatch.setattr(virtual_nodes, "client", connected)
    assert virtual_nodes._known_as(app, UUID) is None
    (home / "ncap.sock").touch()
    assert virtual_nodes._known_as(app, UUID) == "A node on a link of the running ncap"
    assert asked == [NODE]
    assert virtual_nodes._known_as(SimpleNamespace(home=home / "none", station=None), UUID) is None  # type: ignore[arg-type]


# -- node run ----------------------------------------------------------------------------------------------------------

CAN = "udp_multicast:239.74.163.2"
UDP = "udp:localhost:54321"


@pytest.mark.parametrize(
    ("count", "links", "source", "message"),
    [
        (1, {}, "noise", "A node needs a link."),
        (1, {"nfc": UDP}, "noise", None),
        (1, {"can": CAN}, "-", None),
        (1, {"ble": "usb:0"}, "exec:x", None),
        (2, {"can": CAN}, "noise", None),
        (2, {"can": CAN}, "file:run.csv", None),
        (2, {"can": CAN}, "sine:2", None),
        (2, {"can": CAN, "nfc": UDP}, "noise", "--nfc supports one node only."),
        (2, {"can": CAN, "ble": "usb:0"}, "noise", "--ble supports one node only."),
        (2, {"can": CAN}, "-", "--source - supports one node only."),
        (2, {"can": CAN}, "unix:a", "--source unix:a supports one node only."),
        (1, {"can": CAN, "bus": CAN}, "noise", "--bus names wrapped sensors."),
        (1, {"can": CAN, "node_ids": (5,)}, "noise", "--node-id names wrapped sensors."),
        (1, {"can": CAN, "bus": CAN, "node_ids": (5,)}, "noise", "--bus names wrapped sensors."),
        (2, {"can": CAN, "bus": CAN}, "dbc:x.dbc", None),
        (2, {"bus": CAN}, "dbc:x.dbc", "A node needs a link."),
        (2, {"nfc": UDP, "bus": CAN}, "dbc:x.dbc", "--nfc supports one node only."),
    ],
)
def test_which_options_of_a_run_go_together(
    count: int, links: dict[str, Any], source: str, message: str | None
) -> None:
    place = SensorPlace(source, links.pop("bus", None), links.pop("node_ids", ()), links.get("can"))
    given = {"nfc": None, "can": None, "ble": None, **links}
    if message is None:
        virtual_nodes._check_options(count, place, **given)
        return
    with pytest.raises(UsageError) as refused:
        virtual_nodes._check_options(count, place, **given)
    assert refused.value.message == message


@pytest.mark.parametrize(("kind", "source"), [("dbc", "dbc:FILE"), ("eds", "canopen:FILE"), ("iio", "iio:DEVICE")])
def test_a_wrapped_node_among_others_gives_no_made_up_values(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: Any, source: str
) -> None:
    origins = iter([None, Origin(kind, "Torque", "ab" * 32 if kind != "iio" else "")])
    monkeypatch.setattr(virtual_nodes.teds_room.origin, "origin_of", lambda _blocks: next(origins))
    none: Any = None
    for name in ("plain", "torque"):
        FlashFile.create(tmp_path / name)
    with pytest.raises(UsageError, match="so --source noise cannot give its values") as refused:
        virtual_nodes._wrapped(none, none, [tmp_path / "plain", tmp_path / "torque"], SensorPlace("noise"))
    assert refused.value.hint == f"Use --source {source}."
    assert str(tmp_path / "torque") in refused.value.message


class Shown:
    """Keeps what a command prints: objects and lines for people."""

    def __init__(self) -> None:
        self.objects, self.lines = list[dict[str, Any]](), list[str]()

    def emit(self, found: dict[str, Any], text: str) -> None:
        self.objects.append(found)
        self.lines.append(text)


def reading(**changes: Any) -> ActuatorReading:
    state = {"channel": 1, "name": "opening", "value": 0.05, "unit": "m", "raw": 1861.0, "safe": False, "time": 1.5e9}
    return ActuatorReading(**{**state, **changes})


def lines_of() -> tuple[Shown, ActuatorLines]:
    shown: Any = Shown()
    return shown, ActuatorLines(shown)


def test_the_newest_state_of_each_actuator_is_printed_and_an_equal_one_is_not_printed_again() -> None:
    shown, lines = lines_of()
    first, second = lines.observer_of("aa"), lines.observer_of("bb")
    for value in (0.01, 0.02, 0.05):
        first(reading(value=value))
    first(reading(channel=2, name="", value=None, raw=7.0))
    second(reading(value=0.0, safe=True))
    lines._print_news()
    assert shown.lines == ["aa opening: 0.05 m", "aa channel 2: raw 7", "bb opening: safe state, 0 m"]
    assert shown.objects[0] == {
        "event": "actuator", "uuid": "aa", "channel": 1, "name": "opening", "value": 0.05, "unit": "m",
        "raw": 1861.0, "safe": False, "time": "2017-07-14T02:40:00.000Z",
    }  # fmt: skip
    lines._print_news()
    first(reading(time=1.6e9))
    lines._print_news()
    assert len(shown.lines) == 3, "nothing is new"
    first(reading(safe=True))
    first(reading(channel=2, name="", value=None, raw=math.nan))
    lines._print_news()
    assert shown.lines[3] == "aa opening: safe state, 0.05 m"
    assert (shown.objects[4]["raw"], shown.objects[4]["value"]) == (None, None)
    assert virtual_nodes._EVERY_SECONDS == 0.05, "twenty a second"


def test_what_happens_to_a_node_has_a_line_each_and_the_newest_thousand_are_kept() -> None:
    shown, lines = lines_of()
    lines.locate_of("aa")(10)
    lines.locate_of("aa")(0)
    lines.note_reset("aa")
    lines.validity_of("aa")(3, "torque", "3 periods late")
    lines.validity_of("aa")(3, "torque", "")
    lines._print_news()
    assert shown.lines == [
        "aa: blinks for 10 s",
        "aa: stops",
        "aa: reset by hand, back in factory state",
        "aa torque: invalid: 3 periods late",
        "aa torque: valid again",
    ]
    assert [{name: value for name, value in found.items() if name != "time"} for found in shown.objects] == [
        {"event": "locate", "uuid": "aa", "seconds": 10},
        {"event": "locate", "uuid": "aa", "seconds": 0},
        {"event": "reset", "uuid": "aa", "state": "factory"},
        {"event": "invalid", "uuid": "aa", "channel": 3, "name": "torque", "reason": "3 periods late"},
        {"event": "valid", "uuid": "aa", "channel": 3, "name": "torque"},
    ]
    shown.lines.clear()
    for seconds in range(1, 1002):
        lines.locate_of("bb")(seconds)
    lines._print_news()
    assert (len(shown.lines), shown.lines[0], shown.lines[-1]) == (
        1000, "bb: blinks for 2 s", "bb: blinks for 1001 s",
    )  # fmt: skip


def test_a_reader_that_is_gone_ends_the_lines_and_not_the_node() -> None:
    def gone(_found: dict[str, Any], _text: str) -> None:
        raise BrokenPipeError

    for note in (lambda lines: lines.note_reset("aa"), lambda lines: lines.observer_of("aa")(reading())):
        shown, lines = lines_of()
        shown.emit = gone  # type: ignore[method-assign]
        note(lines)
        lines._print_news()
        assert lines._stop.is_set()
