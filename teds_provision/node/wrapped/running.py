"""``--source dbc:FILE``, ``canopen:FILE``, ``iio:DEVICE``: one reader for all wrapped nodes of a process."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from teds_provision.errors import PolicyError, UsageError
from teds_provision.links.can.spec import parse_spec
from teds_provision.node.wrapped import canopen_reader, dbc_message, iio_device, iio_reader
from teds_provision.node.wrapped.can_reader import CanReader, MessageReader
from teds_provision.node.wrapped.description import WrappedSensor
from teds_provision.node.wrapped.latest_values import LatestValues
from teds_provision.node.wrapped.wrapped_source import Report, WrappedSource
from teds_provision.teds.origin import Origin

KIND_OF: Final[Mapping[str, str]] = {"dbc": "dbc", "canopen": "eds", "iio": "iio"}
"""Kind of Origin that each word of ``--source`` serves."""
SOURCE_OF: Final = {origin: f"{word}:{'DEVICE' if word == 'iio' else 'FILE'}" for word, origin in KIND_OF.items()}

Notify = Callable[[str], None]


class Reader(Protocol):
    """Reader of the sensors, which has its own threads."""

    def start(self) -> None:
        """Begin; raises an error of ours with the cause."""

    def stop(self) -> None:
        """End; never raises."""


@dataclass(frozen=True)
class SensorPlace:
    """Source of the wrapped sensors: ``source`` as given, its ``kind`` of Origin, the ``bus`` and CANopen node ids."""

    source: str
    bus: str | None = None
    node_ids: tuple[int, ...] = ()
    beside: str | None = None

    @property
    def word(self) -> str:
        """``dbc``, ``canopen`` or ``iio``."""
        return self.source.partition(":")[0]

    @property
    def argument(self) -> str:
        """The file or device."""
        return self.source.partition(":")[2]


def is_wrapped(source: str) -> bool:
    """Return True if ``--source`` names sensors that are wrapped."""
    return source.partition(":")[0] in KIND_OF


def require_match(place: SensorPlace, origins: Sequence[Origin | None], names: Sequence[str]) -> None:
    """Raise UsageError unless every node wraps a sensor of this kind, and the options fit.

    ``beside`` of the place is the bus of the nodes, ``names`` what people call the nodes.
    """
    if not place.argument:
        raise UsageError(
            f"--source {place.word}: needs a file or device.", hint=f"Write {SOURCE_OF[KIND_OF[place.word]]}."
        )
    for origin, name in zip(origins, names, strict=True):
        if origin is None:
            raise UsageError(
                f"Node {name} wraps no sensor.",
                hint=f"Create it with --from {KIND_OF[place.word]}:…, or use another --source.",
            )
        if origin.kind != KIND_OF[place.word]:
            raise UsageError(
                f"Node {name} wraps a sensor of kind {origin.kind}, which --source {place.word} does not read.",
                hint=f"Use --source {SOURCE_OF[origin.kind]}.",
            )
    _require_options(place, len(origins))


def _require_options(place: SensorPlace, count: int) -> None:
    if place.word == "iio":
        if place.bus is not None:
            raise UsageError("An IIO device is on no bus.", hint="Omit --bus.")
        if count > 1:
            raise UsageError("--source iio supports one node only.", hint="Run the others in separate processes.")
    elif place.bus is None:
        raise UsageError(f"--source {place.word} needs the bus of the sensors.", hint="Add --bus socketcan:can1.")
    if place.word == "canopen" and len(place.node_ids) != count:
        raise UsageError(
            f"--source canopen needs a --node-id for each of the {count} nodes, in their order."
            if count > 1
            else "--source canopen needs --node-id.",
            hint="--node-id 5",
        )
    if place.word != "canopen" and place.node_ids:
        raise UsageError("--node-id is an address of a CANopen device.", hint="Omit it, or use --source canopen:FILE.")


class WrappedRun:
    """The reader of the wrapped nodes of one process, and the source of each of them.

    ``report`` makes the Report of a node from its number. Raises NotFoundError, BadDataError, UsageError, PolicyError
    (the file is not the one that the node was made from).
    """

    def __init__(
        self, place: SensorPlace, origins: Sequence[Origin], report: Callable[[int], Report], notify: Notify
    ) -> None:
        self._report = report
        self._reader, self._values = _READERS[place.word](place, origins, notify)

    def source(self, number: int) -> WrappedSource:
        """Return the source of the node with this number, counted from 0."""
        return WrappedSource(self._values[number], self._report(number))

    def start(self) -> None:
        """Begin to read."""
        self._reader.start()

    def stop(self) -> None:
        """End; never raises."""
        self._reader.stop()


Read = tuple[Reader, list[list[LatestValues]]]


def _require_same(origin: Origin, sensor: WrappedSensor, path: str) -> None:
    if sensor.origin != origin:
        raise PolicyError(
            f"{path} is not the file that the node was made from: channels, units or ranges may differ.",
            hint="Give the file that it was made from, or create a new node: node create DIR --from …",
        )


def _dbc(place: SensorPlace, origins: Sequence[Origin], notify: Notify) -> Read:
    spec = parse_spec(place.bus or "")
    readers = []
    for origin in origins:
        message = dbc_message.read(Path(place.argument), origin.name)
        _require_same(origin, message.sensor, place.argument)
        readers.append(MessageReader(message, notify))
    clashing = readers[0].message.clashing if readers else ()
    if clashing and place.beside is not None and parse_spec(place.beside).wire == spec.wire:
        raise UsageError(
            f"{place.argument} has messages with identifiers of the nodes' own frames: {', '.join(clashing[:5])}.",
            hint="Put the sensors on a bus of their own, or behind a gateway that filters these identifiers.",
        )
    return CanReader(spec, readers, notify), [reader.values for reader in readers]


def _canopen(place: SensorPlace, origins: Sequence[Origin], notify: Notify) -> Read:
    devices = []
    for origin, node_id in zip(origins, place.node_ids, strict=True):
        device = canopen_reader.DeviceReader(Path(place.argument), node_id, notify)
        _require_same(origin, device.sensor, place.argument)
        devices.append(device)
    reader = canopen_reader.CanopenReader(parse_spec(place.bus or ""), devices, notify)
    return reader, [device.values for device in devices]


def _iio(place: SensorPlace, origins: Sequence[Origin], notify: Notify) -> Read:
    device = iio_device.find(place.argument)
    _require_same(origins[0], device.describe(), place.argument)
    reader = iio_reader.IioReader(device, notify)
    return reader, [reader.values]


_READERS: Final[Mapping[str, Callable[[SensorPlace, Sequence[Origin], Notify], Read]]] = {
    "dbc": _dbc,
    "canopen": _canopen,
    "iio": _iio,
}
