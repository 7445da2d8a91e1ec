"""What a person can do about an error of a node's room: each hint that another test does not read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import TedsProvisionError
from teds_provision.links.can.spec import parse_spec
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.node_template import from_file
from teds_provision.node.sources import make_source
from teds_provision.node.sources.base import SourceChannel
from teds_provision.node.wrapped import canopen_device, dbc_message, iio_device, running
from teds_provision.node.wrapped.reading import describe
from teds_provision.node.wrapped.running import SensorPlace, require_match
from teds_provision.teds.origin import Origin

PLACES = [SourceChannel(1, "angle", 0.0, 360.0), SourceChannel(2, "force", 0.0, 1.0)]
DBC, EDS, IIO = Origin("dbc", "a", "ab" * 32), Origin("eds", "a", "ab" * 32), Origin("iio", "a")


def source(text: str) -> Callable[[Path], object]:
    return lambda folder: make_source(text.replace("FOLDER", str(folder)), PLACES, print)


def run(place: SensorPlace, *origins: Origin) -> Callable[[Path], object]:
    return lambda _: require_match(place, origins, ["a", "b"][: len(origins)])


def values(text: str) -> Callable[[Path], object]:
    def read(folder: Path) -> object:
        (folder / "values.csv").write_text(text)
        return make_source(f"file:{folder}/values.csv", PLACES, print)

    return read


def damaged_flash(folder: Path) -> object:
    (folder / "flash.json").write_text('{"format": "teds-virtual-node/3"}')
    return FlashFile(folder)


def damaged_teds(folder: Path) -> object:
    (folder / "node.hex").write_text("00 00 00 04 ff ff ff ff")
    return from_file(folder / "node.hex")


def one_message(_folder: Path) -> object:
    return dbc_message._chosen(Path("a.dbc"), [cast("Any", SimpleNamespace(name=name)) for name in "AB"], "C")


def several_messages(count: int) -> Callable[[Path], object]:
    messages: Any = [SimpleNamespace(name=f"m{number}") for number in range(count)]
    return lambda _: dbc_message._chosen(Path("a.dbc"), messages, None)


def no_channels(_folder: Path) -> object:
    objects: Any = SimpleNamespace(
        device_information=SimpleNamespace(product_name=None), get_variable=lambda *_: None, values=list
    )
    return canopen_device.described(
        Path("a.eds"), b"", type("Objects", (SimpleNamespace,), {"__contains__": lambda *_: False})(**vars(objects))
    )


@pytest.mark.parametrize(
    ("call", "message", "hint"),
    [
        (lambda folder: FlashFile(folder / "my node"), "There is no virtual node in ",
         "Make one: teds-provision node create '{}/my node'"),
        (damaged_flash, "a virtual node's flash, or it is damaged", "Make a new node."),
        (source("sinus"), "--source 'sinus' is not known.",
         "Use noise, sine:PERIOD, ramp:PERIOD, file:CSV, -, unix:PATH or exec:COMMAND; for a wrapped node"
         " dbc:FILE, canopen:FILE or iio:DEVICE."),
        (source("sine:0"), "sine:0 has no period.", "Write seconds: sine:2, or sine:20ms."),
        (source("ramp:fast"), "ramp:fast has no period.", "Write seconds: ramp:2, or ramp:20ms."),
        (source("exec:'a"), "exec: No closing quotation.", "Close the quotes."),
        (source("exec:"), "exec: needs a program.", "Write --source 'exec:./hand --rate 100'."),
        (source("unix:"), "unix: needs a path.", "Write --source unix:/tmp/hand.sock."),
        (source("simulation:"), "simulation: needs a path.", "Write --source simulation:/tmp/hand.sock."),
        (values("# nothing\n\nt,angle\n"), "values.csv has no rows of values.",
         "First line: t,NAME,NAME …; then a row for each instant."),
        (values("angle\n1\n"), "values.csv: there is no column t.", "First line: t,NAME,NAME …"),
        (values("t,angel\n0,1\n"), "values.csv: the node has no sensor named 'angel'.", "It has: angle, force."),
        (no_channels, "a.eds has no object that is sent in a PDO, or could be and is only read.",
         "A sensor has objects with PDOMapping=1 and AccessType=ro."),
        (one_message, "a.dbc has no message 'C'.", "It has: A, B."),
        (several_messages(2), "a.dbc has 2 messages: m0, m1.", "Choose one: --message NAME"),
        (several_messages(12), "a.dbc has 12 messages: " + ", ".join(f"m{n}" for n in range(12)) + ".",
         "Choose one: --message NAME"),
        (several_messages(14), ", m11 and 2 more.", "Choose one: --message NAME"),
        (lambda _: iio_device.find("bmp280?rooot=/x"), "iio:bmp280?rooot=/x has an unknown key.",
         "The only key is root=DIR."),
        (lambda folder: iio_device.find(str(folder / "none")), "There is no IIO device in ",
         "List them: ls /sys/bus/iio/devices"),
        (lambda _: describe("usb:1"), "--from 'usb:1' names no sensor.", "Use dbc:FILE, eds:FILE or iio:DEVICE."),
        (lambda _: describe("eds:a", "Engine"), "--message chooses a message of a DBC file.",
         "Omit it, or use --from dbc:FILE."),
        (run(SensorPlace("iio:bmp280", bus="socketcan:can1"), IIO), "An IIO device is on no bus.", "Omit --bus."),
        (run(SensorPlace("iio:bmp280"), IIO, IIO), "--source iio supports one node only.",
         "Run the others in separate processes."),
        (run(SensorPlace("dbc:a.dbc"), DBC), "--source dbc needs the bus of the sensors.",
         "Add --bus socketcan:can1."),
        (run(SensorPlace("canopen:a.eds", "socketcan:can1"), EDS), "--source canopen needs --node-id.", "--node-id 5"),
        (run(SensorPlace("canopen:a.eds", "socketcan:can1", (5,)), EDS, EDS),
         "--source canopen needs a --node-id for each of the 2 nodes, in their order.", "--node-id 5"),
        (run(SensorPlace("dbc:a.dbc", "socketcan:can1", (5,)), DBC), "--node-id is an address of a CANopen device.",
         "Omit it, or use --source canopen:FILE."),
        (run(SensorPlace("dbc:", "socketcan:can1"), DBC), "--source dbc: needs a file or device.", "Write dbc:FILE."),
        (run(SensorPlace("dbc:a.dbc", "socketcan:can1"), EDS),
         "Node a wraps a sensor of kind eds, which --source dbc does not read.", "Use --source canopen:FILE."),
        (lambda _: require_match(SensorPlace("iio:x"), [None], ["a"]), "Node a wraps no sensor.",
         "Create it with --from iio:…, or use another --source."),
    ],
)  # fmt: skip
def test_an_error_of_a_node_says_what_to_do(
    call: Callable[[Path], object], message: str, hint: str, tmp_path: Path
) -> None:
    with pytest.raises(TedsProvisionError) as no:
        call(tmp_path)
    assert message in no.value.message
    assert no.value.hint == hint.replace("{}", str(tmp_path))


def test_sensors_are_kept_off_a_bus_whose_identifiers_they_use(monkeypatch: pytest.MonkeyPatch) -> None:
    message: Any = SimpleNamespace(sensor=SimpleNamespace(origin=DBC), clashing=tuple("ABCDEF"))
    monkeypatch.setattr(dbc_message, "read", lambda path, name: message)
    monkeypatch.setattr(running, "MessageReader", lambda *_: SimpleNamespace(message=message, values=[]))
    reader = object()
    monkeypatch.setattr(running, "CanReader", lambda *_: reader)
    place = SensorPlace("dbc:a.dbc", "socketcan:can1", beside="socketcan:can1")
    with pytest.raises(TedsProvisionError) as no:
        running._dbc(place, [DBC], print)
    assert no.value.message == "a.dbc has messages with identifiers of the nodes' own frames: A, B, C, D, E."
    assert no.value.hint == (
        "Put the sensors on a bus of their own, or behind a gateway that filters these identifiers."
    )
    for beside in ("socketcan:can2", None):
        assert running._dbc(SensorPlace("dbc:a.dbc", "socketcan:can1", beside=beside), [DBC], print)[0] is reader
    assert parse_spec("socketcan:can1").wire != parse_spec("socketcan:can2").wire
