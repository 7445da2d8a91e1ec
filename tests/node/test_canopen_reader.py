"""The reader of CANopen devices step by step: which PDOs it listens to, what it asks for, and what it says of failures.

The device and its network are mocks; ``test_wrapped_devices`` has a real one.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import PolicyError
from teds_provision.links.can.spec import parse_spec
from teds_provision.node.wrapped import canopen_reader
from teds_provision.node.wrapped.canopen_reader import CanopenReader, DeviceReader
from teds_provision.node.wrapped.reading import describe
from teds_provision.node.wrapped.running import SensorPlace, WrappedRun
from tests.e2e.desk import ROOT

EDS = ROOT / "examples" / "bench" / "cell.eds"
TORQUE, TEMPERATURE = (0x6000, 1), (0x6000, 2)


class Pdos(dict[int, Any]):
    """Transmit PDOs: each reading of their mapping raises the next failure, if one is left."""

    def __init__(self, pdos: list[Any], *failures: Exception) -> None:
        super().__init__(enumerate(pdos, 1))
        self.failures = list(failures)

    def read(self) -> None:
        if self.failures:
            raise self.failures.pop(0)


def pdo(*places: tuple[int, int], enabled: bool = True) -> Any:
    """Return a transmit PDO that carries objects."""
    callbacks: list[Any] = []
    carried = [SimpleNamespace(index=index, subindex=subindex) for index, subindex in places]
    return SimpleNamespace(enabled=enabled, map=carried, callbacks=callbacks, add_callback=callbacks.append)


class Values:
    """Objects of a device by SDO: a failure is raised when its value is asked for."""

    def __init__(self, **values: object) -> None:
        self.values, self.asked = values, list[int]()

    def __getitem__(self, index: int) -> Any:
        assert index == 0x6000
        return {sub: _Value(self, sub) for sub in (1, 2)}


class _Value:
    def __init__(self, values: Values, sub: int) -> None:
        self._values, self._sub = values, sub

    @property
    def raw(self) -> object:
        self._values.asked.append(self._sub)
        value = self._values.values[f"sub{self._sub}"]
        if isinstance(value, Exception):
            raise value
        return value


def device(pdos: Pdos, values: Values | None = None) -> tuple[DeviceReader, list[str]]:
    messages: list[str] = []
    made = DeviceReader(EDS, 5, messages.append)
    made._node = cast("Any", SimpleNamespace(tpdo=pdos, sdo=values))
    return made, messages


def why(reader: DeviceReader) -> list[str]:
    """Return why each channel has no value: torque, temperature."""
    return [part.at(0.0)[1] for part in reader.values]


def sdo_error(text: str) -> Exception:
    from canopen.sdo.exceptions import SdoError

    return SdoError(text)


@pytest.mark.parametrize(
    ("failure", "said"),
    [
        (sdo_error("No SDO response received"), "No SDO response received"),
        (OSError("no buffer space"), "no buffer space"),
        (ValueError(" "), "ValueError"),
        (KeyError(), "KeyError"),
    ],
)
def test_a_mapping_that_cannot_be_read_is_reported_once_and_read_again(failure: Exception, said: str) -> None:
    reader, messages = device(Pdos([pdo(TORQUE, TEMPERATURE)], failure, failure, OSError("bus off")))
    assert not reader.prepare()
    assert not reader.prepare()
    reason = f"its PDO mapping cannot be read ({said})"
    assert why(reader) == [reason, reason]
    assert not reader.prepare()
    assert reader.prepare()
    assert messages == [f"CANopen device 5: {reason}.", "CANopen device 5: its PDO mapping cannot be read (bus off)."]
    assert why(reader) == ["no PDO has come yet"] * 2


def test_a_pdo_that_is_off_or_carries_nothing_measured_is_not_listened_to() -> None:
    off, other, on = pdo(TORQUE, enabled=False), pdo((0x2000, 0)), pdo((0x2000, 0), TEMPERATURE)
    reader, messages = device(Pdos([off, other, on]))
    assert reader.prepare()
    assert [len(each.callbacks) for each in (off, other, on)] == [0, 0, 1]
    assert reader.prepare(), "its mapping is read once"
    assert len(on.callbacks) == 1
    assert why(reader) == ["no SDO reply has come yet", "no PDO has come yet"]
    assert (reader.polled, messages) == (0.5, []), "the torque has 500 ms in the EDS file"


@pytest.mark.parametrize(
    ("mapped", "asked", "seconds"),
    [((), [1, 2], 0.1), ((TORQUE,), [2], 0.1), ((TEMPERATURE,), [1], 0.5), ((TORQUE, TEMPERATURE), [], math.inf)],
)
def test_what_no_pdo_carries_is_asked_for_at_the_shortest_period_of_it(
    mapped: tuple[tuple[int, int], ...], asked: list[int], seconds: float
) -> None:
    values = Values(sub1=7, sub2=36.5)
    reader, _ = device(Pdos([pdo(*mapped)]), values)
    reader.prepare()
    reader.poll()
    assert (values.asked, reader.polled) == (asked, seconds)
    numbers = [part.last.raw if part.last is not None else None for part in reader.values]
    assert numbers == [7 if 1 in asked else None, 36.5 if 2 in asked else None]


def test_an_object_without_subindexes_is_asked_for_itself() -> None:
    reader, _ = device(Pdos([]))
    sdo: Any = {0x6000: {2: "one of a record"}, 0x6100: "alone"}
    reader._node = cast("Any", SimpleNamespace(sdo=sdo))
    record, alone = reader._variables[1], SimpleNamespace(index=0x6100, subindex=0, parent=reader.objects)
    assert (reader._sdo(record), reader._sdo(alone)) == ("one of a record", "alone")


def test_no_device_is_asked_more_than_twenty_times_a_second() -> None:
    reader, _ = device(Pdos([pdo()]))
    reader.values[0].channel.__dict__["period"] = 0.01
    assert reader.polled == 0.05


@pytest.mark.parametrize(
    ("failure", "said"),
    [
        (sdo_error("Code 0x06090011, Subindex does not exist"), "Code 0x06090011, Subindex does not exist"),
        (OSError("no buffer space"), "no buffer space"),
        (KeyError(), "KeyError"),
        (ValueError(""), "ValueError"),
    ],
)
def test_an_object_that_is_refused_keeps_its_reason_and_the_others_are_read(failure: Exception, said: str) -> None:
    values = Values(sub1=failure, sub2=1.5)
    reader, messages = device(Pdos([]), values)
    reader.prepare()
    reader.poll()
    assert why(reader)[0] == f"the device refuses it ({said})"
    assert reader.values[1].last is not None
    values.values["sub1"] = b"text"
    reader.poll()
    assert why(reader)[0] == "no SDO reply has come yet", "octets are no number"
    assert (reader.values[0].last, messages) == (None, [])


@pytest.mark.parametrize(
    ("age", "at"),
    [(0.25, 499.75), (0.999, 499.001), (1.0, 500.0), (1.5, 500.0), (0.0, 500.0), (-0.25, 500.0)],
)
def test_a_pdo_is_dated_by_its_frame_if_that_is_not_older_than_a_second(
    monkeypatch: pytest.MonkeyPatch, age: float, at: float
) -> None:
    """Older or younger, its clock is not this host's."""
    monkeypatch.setattr(canopen_reader, "time", SimpleNamespace(time=lambda: 8000.0, monotonic=lambda: 500.0))
    reader, messages = device(Pdos([]))
    carried = [
        SimpleNamespace(index=0x2000, subindex=0, raw=3),
        SimpleNamespace(index=0x6000, subindex=1, raw=b"\0"),
        SimpleNamespace(index=0x6000, subindex=2, raw=21),
    ]
    reader._received(SimpleNamespace(timestamp=8000.0 - age, map=carried))
    torque, temperature = reader.values
    assert torque.last is None
    assert temperature.last is not None
    assert temperature.last[:2] == pytest.approx((at, 21.0), abs=1e-9)
    assert messages == []


def test_a_pdo_that_cannot_be_decoded_is_reported_and_does_not_end_the_reading() -> None:
    reader, messages = device(Pdos([]))
    reader._received(SimpleNamespace(timestamp=None, map=[]))
    assert len(messages) == 1
    assert messages[0].startswith("CANopen device 5: a PDO cannot be decoded (unsupported operand")
    assert why(reader)[0].startswith("a PDO cannot be decoded (")


class Turns:
    """An event that is set after some waits; it notes how long each one was."""

    def __init__(self, rounds: int, clock: list[float]) -> None:
        self._rounds, self._clock, self.waits = rounds, clock, list[float]()

    def is_set(self) -> bool:
        return len(self.waits) >= self._rounds

    def set(self) -> None:
        self._rounds = 0

    def wait(self, seconds: float) -> None:
        self.waits.append(seconds)
        self._clock[0] += seconds


class _Player(SimpleNamespace):
    __hash__ = object.__hash__  # type: ignore[assignment]


def player(name: str, answers: Iterator[bool], polled: float, log: list[str]) -> Any:
    """Return a device that answers or not."""

    def prepare() -> bool:
        log.append(f"{name} prepare")
        return next(answers)

    return _Player(
        prepare=prepare,
        poll=lambda: log.append(f"{name} poll"),
        polled=polled,
        note_trouble=lambda reason: log.append(f"{name} {reason}"),
    )


def test_each_device_is_polled_in_its_time_and_a_silent_one_is_tried_every_two_seconds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, log = [100.0], list[str]()
    monkeypatch.setattr(canopen_reader, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    answers = itertools.chain((False, True), itertools.repeat(True))
    devices = [player("a", itertools.repeat(True), 0.75, log), player("b", answers, math.inf, log)]
    made = CanopenReader(cast("Any", None), devices, log.append)
    turns = made._stop = cast("Any", Turns(5, clock))
    made._run()
    assert turns.waits == pytest.approx([0.75, 0.75, 0.5, 0.25, 0.75])
    assert log == [
        "a prepare", "a poll", "b prepare", "a prepare", "a poll", "a prepare", "a poll", "b prepare", "b poll",
        "a prepare", "a poll",
    ]  # fmt: skip


@pytest.mark.parametrize(("polled", "wait"), [(math.inf, 1.0), (0.0, 0.005), (0.3, 0.3)])
def test_the_reader_looks_at_the_bus_once_a_second_and_never_runs_without_a_pause(
    monkeypatch: pytest.MonkeyPatch, polled: float, wait: float
) -> None:
    clock = [100.0]
    monkeypatch.setattr(canopen_reader, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    made = CanopenReader(cast("Any", None), [player("a", itertools.repeat(True), polled, [])], print)
    turns = made._stop = cast("Any", Turns(1, clock))
    made._run()
    assert turns.waits == pytest.approx([wait])


def test_a_lost_bus_is_noted_by_every_device_and_the_end_raises_nothing() -> None:
    log: list[str] = []
    devices = [player(name, itertools.repeat(True), 1.0, log) for name in "ab"]
    made = CanopenReader(parse_spec("socketcan:can3"), devices, log.append)
    made.stop()  # before the start

    def disconnect() -> None:
        log.append("disconnect")
        raise RuntimeError("Network is down")

    notifier = SimpleNamespace(exception=None)
    made._network = cast("Any", SimpleNamespace(notifier=notifier, disconnect=disconnect))
    made._check()
    assert log == []
    notifier.exception = OSError("Network is down")
    made._check()
    lost = [f"{name} the CAN bus socketcan:can3 cannot be read (Network is down)" for name in "ab"]
    assert log == lost
    log.clear()
    turns, clock = made._stop, [0.0]
    made._stop = cast("Any", Turns(1, clock))
    made._run()
    assert log[-2:] == lost, "it looks after each round"
    log.clear()
    made._stop = turns
    made._thread = cast("Any", SimpleNamespace(join=lambda timeout: log.append(f"{timeout} {turns.is_set()}")))
    made.stop()
    assert log == ["3 True", "disconnect"]
    made.stop()
    assert log[2:] == ["3 True"]


def test_a_run_has_a_reader_for_each_device_and_refuses_a_file_that_has_changed() -> None:
    origin = describe(f"eds:{EDS}").origin
    place = SensorPlace(f"canopen:{EDS}", "socketcan:can3", (5, 6))
    events: list[tuple[Any, ...]] = []
    run = WrappedRun(place, [origin, origin], lambda number: lambda *event: events.append((number, *event)), print)
    reader: Any = run._reader
    assert [device.node_id for device in reader._devices] == [5, 6]
    assert reader._spec.text == "socketcan:can3"
    reader._devices[1].note_trouble("it is off")
    for number in (0, 1):
        source = run.source(number)
        source.start(cast("Any", SimpleNamespace(now=lambda: 0.0)))
        source.at(1, 0.0)
    assert events == [(0, 1, "torque", "no PDO has come yet"), (1, 1, "torque", "it is off")]
    with pytest.raises(PolicyError, match="not the file that the node was made from"):
        WrappedRun(place, [origin, replace(origin, sha256="0" * 64)], cast("Any", None), print)
