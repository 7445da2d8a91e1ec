"""Reads CANopen devices: PDOs whose mapping is read from the device, and single objects by SDO (python-canopen).

Nothing is written to a device. It is not started either, as that is the work of the network's master.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from teds_provision.links.can.bus import open_bus
from teds_provision.links.can.spec import CanSpec
from teds_provision.node.wrapped import canopen_device
from teds_provision.node.wrapped.latest_values import LatestValues

if TYPE_CHECKING:
    import canopen

_RETRY: Final = 2.0
"""Seconds between two attempts to read the mapping of a device that does not answer."""
_LEAST_POLL: Final = 0.05
_LATEST_SECONDS: Final = 1.0

Notify = Callable[[str], None]


class DeviceReader:
    """One device: its description, and the values of its channels."""

    def __init__(self, path: Path, node_id: int, notify: Notify) -> None:
        octets, self.objects = canopen_device.load(path, node_id)
        self.sensor = canopen_device.described(path, octets, self.objects)
        self.node_id, self._notify = node_id, notify
        self._variables = list(canopen_device.measured_objects(self.objects))
        self.values = [LatestValues(channel, "PDO") for channel in self.sensor.channels]
        self._by_object = {
            (variable.index, variable.subindex): part
            for variable, part in zip(self._variables, self.values, strict=True)
        }
        self._node: canopen.RemoteNode | None = None
        self._mapped: set[tuple[int, int]] = set()
        self._ready = False
        self._told = ""

    def connect(self, network: canopen.Network) -> None:
        """Join the network; nothing is sent yet."""
        import canopen

        self._node = canopen.RemoteNode(self.node_id, self.objects)
        network.add_node(self._node)

    def note_trouble(self, why: str) -> None:
        """Note why nothing comes, for the reasons; print each new cause once."""
        for part in self.values:
            part.note_trouble(why)
        if why and why != self._told:
            self._notify(f"CANopen device {self.node_id}: {why}.")
        self._told = why

    def prepare(self) -> bool:
        """Read the mapping of the transmit PDOs from the device and listen to them; False if it does not answer."""
        from canopen.sdo.exceptions import SdoError

        assert self._node is not None
        if self._ready:
            return True
        try:
            self._node.tpdo.read()  # type: ignore[no-untyped-call]
        except (SdoError, OSError, KeyError, ValueError) as error:
            self.note_trouble(f"its PDO mapping cannot be read ({str(error).strip() or type(error).__name__})")
            return False
        for pdo in self._node.tpdo.values():
            if not pdo.enabled:
                continue
            wanted = [variable for variable in pdo.map if (variable.index, variable.subindex) in self._by_object]
            if wanted:
                self._mapped.update((variable.index, variable.subindex) for variable in wanted)
                pdo.add_callback(self._received)
        for place, part in self._by_object.items():
            if place not in self._mapped:
                part.set_carrier("SDO reply")
        self.note_trouble("")
        self._ready = True
        return True

    def poll(self) -> None:
        """Read every channel that no PDO carries, by SDO."""
        from canopen.sdo.exceptions import SdoError

        assert self._node is not None
        for variable in self._variables:
            part = self._by_object[variable.index, variable.subindex]
            if (variable.index, variable.subindex) in self._mapped:
                continue
            try:
                raw = self._sdo(variable).raw
            except (SdoError, OSError, KeyError, ValueError) as error:
                part.note_trouble(f"the device refuses it ({str(error).strip() or type(error).__name__})")
                continue
            part.note_trouble("")
            if isinstance(raw, int | float):
                part.put(time.monotonic(), raw)

    @property
    def polled(self) -> float:
        """Seconds between two polls; infinite if PDOs carry every channel."""
        periods = [part.channel.period for place, part in self._by_object.items() if place not in self._mapped]
        return max(_LEAST_POLL, min(periods)) if periods else float("inf")

    def _sdo(self, variable: Any) -> Any:
        assert self._node is not None
        entry = self._node.sdo[variable.index]
        return entry if variable.parent is self.objects else entry[variable.subindex]

    def _received(self, pdo: Any) -> None:
        """Take a PDO, in the thread of python-canopen, which only logs what a callback raises."""
        try:
            age = time.time() - pdo.timestamp
            at = time.monotonic() - (age if 0.0 < age < _LATEST_SECONDS else 0.0)
            for variable in pdo.map:
                part = self._by_object.get((variable.index, variable.subindex))
                raw = variable.raw if part is not None else None
                if part is not None and isinstance(raw, int | float):
                    part.put(at, raw)
        except Exception as error:
            self.note_trouble(f"a PDO cannot be decoded ({error})")
            logging.getLogger(__name__).debug("A PDO could not be decoded.", exc_info=True)


class CanopenReader:
    """All devices of one bus: one thread of python-canopen for PDOs, one of ours that asks by SDO."""

    def __init__(self, spec: CanSpec, devices: Sequence[DeviceReader], notify: Notify) -> None:
        self._spec, self._devices, self._notify = spec, devices, notify
        self._network: canopen.Network | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Open the bus and read; raises NoReaderError or UsageError."""
        import canopen

        self._network = canopen.Network(open_bus(self._spec))
        self._network.connect()
        for device in self._devices:
            device.connect(self._network)
        self._thread = threading.Thread(target=self._run, name="wrapped", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End; never raises."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=3)
        if self._network is not None:
            try:
                self._network.disconnect()
            except Exception:  # the notifier raises again what stopped it
                logging.getLogger(__name__).debug("The CANopen network did not close cleanly.", exc_info=True)
            self._network = None

    def _run(self) -> None:
        due = dict.fromkeys(self._devices, 0.0)
        while not self._stop.is_set():
            now = time.monotonic()
            for device in self._devices:
                if now < due[device]:
                    continue
                if device.prepare():
                    device.poll()
                    due[device] = now + device.polled
                else:
                    due[device] = time.monotonic() + _RETRY
            self._check()
            self._stop.wait(min(1.0, max(0.005, min(due.values()) - time.monotonic())))

    def _check(self) -> None:
        """Note that the bus was lost: the thread of python-canopen ends without a word."""
        failure = getattr(getattr(self._network, "notifier", None), "exception", None)
        if failure is not None:
            for device in self._devices:
                device.note_trouble(f"the CAN bus {self._spec.text} cannot be read ({failure})")
