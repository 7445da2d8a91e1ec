"""Virtual transducers of this station: each in a process, on a bus that does not leave this machine.

They are nodes like others: own key and UUID, same commands, same checks. Their folder in the home holds their flash and
their source; the daemon starts them, restarts them after they ended, and provisions them when they are made, as it
knows their key from the file that it made itself.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import secrets
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Container, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from teds_provision.errors import KnownUuidError, NodeBusyError, NotFoundError, StoreError, UsageError
from teds_provision.files import write_whole
from teds_provision.handover.life import DECOMMISSIONED
from teds_provision.links.opening import with_source
from teds_provision.links.ports import free_port
from teds_provision.ncap.live import Live
from teds_provision.ncap.nodes.simulation import SIMULATION, SOCKET, Feed
from teds_provision.ncap.settings import own_source
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.node_template import create
from teds_provision.node.sources.base import seconds_of
from teds_provision.one_core import every_core
from teds_provision.protocol.announce import default_can_address
from teds_provision.protocol.keys import fingerprint
from teds_provision.provisioning.build import check_name
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry
from teds_provision.teds.formats import UUID_OCTETS, placed, stated_uuid
from teds_provision.teds.image import BlockId
from teds_provision.teds.profile import default_folders
from teds_provision.teds.sheet import Sheet

FOLDER: Final = "virtual"
_FACTS: Final = "virtual.json"
_LOG: Final = "log"
_CALIBRATION: Final = "calibration.toml"
_SOURCES: Final = re.compile(r"(noise|simulation)\Z|(sine|ramp):[0-9.]+\Z|unix:/[^\0]+\Z|file:/[^\0]+\Z")
_LONGEST_PERIOD: Final = 86_400.0
_AGAIN, _LONGEST = 1.0, 30.0
_ENDING: Final = 5.0
MOST: Final = 100
_LIBC: Final = ctypes.CDLL(None)


@dataclass
class Virtual:
    """One virtual transducer; ``state`` is running, starting, ended."""

    uuid: str
    name: str
    source: str
    folder: Path
    channels: int = 0
    state: str = "starting"
    why: str = ""
    process: subprocess.Popen[bytes] | None = field(default=None, repr=False)
    kept: bool = False
    feed: Feed | None = field(default=None, repr=False)

    def as_json(self) -> dict[str, Any]:
        """Return the object of api.md, `/virtual`."""
        facts = {name: getattr(self, name) for name in ("uuid", "name", "source", "state", "why", "channels")}
        return {**facts, "simulation": self.feed.as_json() if self.feed is not None else None}


class Virtuals:
    """The virtual transducers of one daemon. ``place`` is their bus, a CAN place on loopback."""

    def __init__(self, station: Station, live: Live) -> None:
        self._station, self._live = station, live
        self._home = station.home / FOLDER
        self._guard = threading.Lock()
        self._stop = threading.Event()
        self._all: dict[str, Virtual] = {}
        self._port = free_port()
        for folder in sorted(self._home.glob("*/")):
            with suppress(OSError, ValueError, KeyError, TypeError):
                facts = json.loads((folder / _FACTS).read_text())
                one = Virtual(facts["uuid"], facts["name"], facts["source"], folder, facts["channels"])
                self._all[one.uuid] = one

    @property
    def bus(self) -> str:
        """The bus without the daemon's source, for the nodes."""
        return f"udp_multicast:239.74.163.3?port={self._port}&hop_limit=0&fd=1"

    @property
    def place(self) -> str:
        """The bus as a link of the daemon."""
        return with_source(f"can:{self.bus}", own_source(self._station.id))

    def all(self) -> list[dict[str, Any]]:
        """Return every virtual transducer as JSON."""
        with self._guard:
            return [virtual.as_json() for virtual in self._all.values()]

    def __contains__(self, uuid: object) -> bool:
        return uuid in self._all

    def start(self) -> None:
        """Start those that were made and do not run yet."""
        for virtual in list(self._all.values()):
            if not virtual.kept:
                virtual.kept = True
                threading.Thread(
                    target=self._run, args=(virtual,), name=f"virtual {virtual.uuid[:8]}", daemon=True
                ).start()

    def stop(self) -> None:
        """End them all."""
        self._stop.set()
        for virtual in list(self._all.values()):
            _end(virtual.process)

    # -- making and removing -----------------------------------------------------------------------------------------

    def make(
        self,
        *,
        name: str | None,
        source: str,
        content: str | None,
        profile: str | None,
        new_uuid: bool = False,
        on_bus: Container[str] = (),
    ) -> Virtual:
        """Make one from a datasheet (XML, JSON, hex) or a profile, whitelist it under the key in its file.

        ``new_uuid``: the datasheet's own UUID is replaced. ``on_bus`` are the nodes that links have heard. Raises
        UsageError, BadDataError, NotFoundError, KnownUuidError.
        """
        _check_source(source)
        if (content is None) == (profile is None):
            raise UsageError("A virtual transducer needs a datasheet or a profile.", hint="Give exactly one of them.")
        if len(self._all) >= MOST:
            raise UsageError(f"This station already has {MOST} virtual transducers.", hint="Remove one first.")
        folder = self._home / secrets.token_hex(6)
        try:
            one = self._create(folder, name or "", source, content, profile, None if new_uuid else on_bus)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        with self._guard:
            self._all[one.uuid] = one
        self._live.event("virtual", state="made", uuid=one.uuid, name=one.name)
        return one

    def _create(
        self,
        folder: Path,
        name: str,
        source: str,
        content: str | None,
        profile: str | None,
        on_bus: Container[str] | None,
    ) -> Virtual:
        """Make its folder; ``on_bus`` None: it gets a UUID that the station chooses, whatever the datasheet has."""
        folder.mkdir(parents=True, mode=0o700)
        teds: Path | None = None
        if content is not None:
            teds = folder / "datasheet"
            placed(content.encode())  # raises an error about the content, not about the temporary file
            teds.write_text(content, encoding="utf-8")
        stated = stated_uuid(placed(content.encode())) if content is not None and on_bus is not None else None
        uuid_ = None if stated else self._new_uuid()
        folders = default_folders(self._station.home)
        flash = create(folder, uuid=uuid_, name=name, teds=teds, profile=profile, folders=folders)
        state = flash.load()
        sheet = Sheet.from_blocks(flash.hardware)
        one = Virtual(state.uuid.hex(), name or sheet.meta.name, source, folder, len(sheet.channels))
        check_name(one.name or None)
        self._require_free(state.uuid, state.can_address, one.name, on_bus or ())
        if profile is not None and (lines := ideal_calibration(sheet)):
            write_whole(folder / _CALIBRATION, lines.encode())
        write_whole(folder / _FACTS, json.dumps({**one.as_json(), "profile": profile}).encode())
        key = fingerprint(state.node_key)
        with self._station.durable("virtual"):
            self._station.pins.put(WhitelistEntry(state.uuid, key, assurance="import", name=one.name or None))
            self._station.audit("virtual", state.uuid, "made", fingerprint=key)
        return one

    def _require_free(self, uuid: bytes, address: int, name: str, on_bus: Container[str]) -> None:
        """Refuse a UUID, an address or a name that another node has: that one would be tried again for ever."""
        if uuid.hex() in self._all or self._station.overview.is_known(uuid) or uuid.hex() in on_bus:
            raise KnownUuidError(
                f"The datasheet has the UUID of node {uuid.hex()}, which this station already knows.",
                hint='Two nodes cannot share a UUID. Give the new one another UUID ("new_uuid": true).',
            )
        if address in self._addresses():
            raise UsageError(
                f"Another virtual transducer already uses CAN address 0x{address:02X}.",
                hint="Clear the UUID in the datasheet's Meta-TEDS; a suitable one is generated.",
            )
        if name and (others := self._station.nodes.all_named(name)):
            raise UsageError(f"Node {others[0].hex()} already has the name {name!r}.", hint="Choose another name.")

    def _addresses(self) -> set[int]:
        return {default_can_address(bytes.fromhex(uuid)) for uuid in self._all}

    def _new_uuid(self) -> bytes:
        """Return a UUID whose address on the bus is free."""
        taken = self._addresses()
        while True:
            uuid = secrets.token_bytes(UUID_OCTETS)
            if default_can_address(uuid) not in taken:
                return uuid

    def profile_of(self, uuid: str) -> str | None:
        """Return the profile that one was made from; None: from a datasheet."""
        found = json.loads((self._virtual_of(uuid).folder / _FACTS).read_text()).get("profile")
        return found if isinstance(found, str) else None

    def calibration_of(self, uuid: str) -> Path | None:
        """Return the linear calibration of one that was made from a profile, None if it has none."""
        path = self._virtual_of(uuid).folder / _CALIBRATION
        return path if path.exists() else None

    def name_of(self, uuid: str) -> str:
        """Return the name that it was given, "" for none."""
        return self._virtual_of(uuid).name

    def blocks_of(self, uuid: str) -> dict[BlockId, bytes]:
        """Return the TEDS that one was made with, under its own UUID and name."""
        return FlashFile(self._virtual_of(uuid).folder).hardware

    # -- simulations -------------------------------------------------------------------------------------------------

    def find(self, text: str) -> Virtual:
        """Return the one that a UUID or a name means; raises NotFoundError."""
        with self._guard:
            found = self._all.get(text.lower())
            named = [virtual for virtual in self._all.values() if virtual.name == text]
        if found is None and len(named) != 1:
            raise NotFoundError(
                f"No virtual transducer of this station is called {text[:40]!r}.", hint="GET /virtual lists them."
            )
        return found if found is not None else named[0]

    def begin_feed(self, virtual: Virtual, feed: Feed) -> None:
        """Let a simulation feed one; raises UsageError (another source), NodeBusyError (another simulation does)."""
        if virtual.source != SIMULATION:
            raise UsageError(
                f"{virtual.name or virtual.uuid} has the source {virtual.source}, so it takes no values.",
                hint=f'Create one with "source": "{SIMULATION}".',
            )
        with self._guard:
            if virtual.feed is not None:
                raise NodeBusyError(
                    f"{virtual.name or virtual.uuid} is already fed by {virtual.feed.by}.", hint="End that one first."
                )
            virtual.feed = feed
        self._live.event("virtual", uuid=virtual.uuid, state="fed", by=feed.by)
        with suppress(StoreError):
            self._station.audit("virtual", bytes.fromhex(virtual.uuid), "simulation connected", by=feed.by)

    def end_feed(self, virtual: Virtual, feed: Feed) -> None:
        """Let another simulation feed it; the place is free before anything else is done."""
        with self._guard:
            if virtual.feed is feed:
                virtual.feed = None
        self._live.event("virtual", uuid=virtual.uuid, state="not fed", by=feed.by)
        facts = {name: value for name, value in feed.as_json().items() if name != "since"}
        with suppress(StoreError):
            self._station.audit("virtual", bytes.fromhex(virtual.uuid), "simulation disconnected", **facts)

    def forget(self, uuid: str) -> Virtual:
        """Remove one from the station; it still runs until :meth:`end`; raises NotFoundError."""
        one, octets, station = self._virtual_of(uuid), bytes.fromhex(uuid), self._station
        with station.durable("virtual"):
            station.pins.remove(octets)
            station.keys.remove(octets)  # the node's own copy is deleted with its folder, so this key would be useless
            station.datasheets.drop_draft(octets)
            if station.nodes.get(octets) is not None:  # frees its name
                station.nodes.remember(octets, name=None, retired=DECOMMISSIONED)
            station.measurements.hand_on(octets, None)
            station.audit("virtual", octets, "removed")
        with self._guard:
            self._all.pop(uuid, None)
        return one

    def end(self, virtual: Virtual) -> None:
        """End the process of one that was forgotten, and its key with it."""
        feed = virtual.feed
        if feed is not None:
            feed.end()
        _end(virtual.process)
        shutil.rmtree(virtual.folder, ignore_errors=True)
        self._live.event("virtual", state="removed", uuid=virtual.uuid)

    def _virtual_of(self, uuid: str) -> Virtual:
        with self._guard:
            found = self._all.get(uuid)
        if found is None:
            raise NotFoundError(f"{uuid} is not a virtual transducer of this station.")
        return found

    # -- the processes -----------------------------------------------------------------------------------------------

    def _run(self, virtual: Virtual) -> None:
        """Run it, and again when it ended, until it is removed or the daemon ends."""
        pause = _AGAIN
        log = virtual.folder / _LOG
        while not self._stop.is_set() and virtual.uuid in self._all:
            words = [sys.executable, "-m", "teds_provision", "--json", "node", "run", str(virtual.folder)]
            words += ["--can", self.bus]
            try:
                process = virtual.process = self._begun(virtual, words, log)
            except OSError as error:  # no memory or descriptor for a process, or its folder is gone
                self._publish_state(virtual, "ended", f"It cannot be started: {error.strerror}.")
                self._stop.wait(pause)
                pause = min(2 * pause, _LONGEST)
                continue
            if self._stop.is_set() or virtual.uuid not in self._all:
                _end(process)
            if self._until_its_end(virtual, process):
                pause = _AGAIN
            if self._stop.is_set() or virtual.uuid not in self._all:
                return
            last: list[str] = []
            with suppress(OSError):
                last = log.read_text(errors="replace").strip().splitlines()
            self._publish_state(virtual, "ended", last[-1] if last else "")
            self._stop.wait(pause)
            pause = min(2 * pause, _LONGEST)

    @staticmethod
    def _begun(virtual: Virtual, words: list[str], log: Path) -> subprocess.Popen[bytes]:
        daemon = os.getpid()
        with every_core(), log.open("wb") as errors, opened_folder(virtual.folder) as folder:
            fed = virtual.source == SIMULATION
            source = f"{SIMULATION}:{short_path(folder)}" if fed else virtual.source
            return subprocess.Popen(
                [*words, "--source", source],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors,
                pass_fds=(folder,) if fed else (),
                process_group=0,  # Ctrl-C is for the daemon, which ends its nodes in order
                preexec_fn=lambda: _die_with(daemon),  # noqa: PLW1509 - two calls of the system, nothing else
            )

    def _until_its_end(self, virtual: Virtual, process: subprocess.Popen[bytes]) -> bool:
        """Read its lines until it ends; whether it ever was ready."""
        assert process.stdout is not None
        ready = False
        for line in process.stdout:
            if b'"ready"' in line:
                ready = True
                self._publish_state(virtual, "running")
        process.wait()
        return ready

    def _publish_state(self, virtual: Virtual, state: str, why: str = "") -> None:
        virtual.state, virtual.why = state, why
        self._live.event("virtual", uuid=virtual.uuid, state=state, why=why)


@contextmanager
def opened_folder(folder: Path) -> Iterator[int]:
    """Give the descriptor of a folder for the block."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def short_path(folder: int) -> str:
    """Return the socket in an opened folder: a socket's path has 107 octets at most, that of a home may have more."""
    return f"/proc/self/fd/{folder}/{SOCKET}"


def ideal_calibration(sheet: Sheet) -> str:
    """Return straight lines over the whole raw range, for channels without values otherwise: these were not measured.

    A profile does not know the curve of a single board; a transducer in software has none but this.
    """
    today = datetime.now(UTC).date().isoformat()
    lines = []
    for channel in sheet.channels:
        ends = channel.sample.raw_range if channel.sample is not None else None
        if not channel.value_problem or ends is None or not channel.has_range or channel.calibration_problem:
            continue
        low, high = channel.unit.from_si(channel.low), channel.unit.from_si(channel.high)
        points = f"[[{ends[0]}, {low!r}], [{ends[1]}, {high!r}]]"
        lines.append(
            f'[[calibration]]\nchannel = {channel.number}\ndate = {today}\nunit = "{channel.unit.text}"\n'
            f"points = {points}\n"
        )
    return "\n".join(lines)


def _check_source(text: str) -> None:
    """Refuse what its process would refuse: that one would be started again and again."""
    kind, _, rest = text.partition(":")
    if not _SOURCES.match(text):
        raise UsageError(
            f"{text!r} is not a valid source.",
            hint="Use noise, sine:SECONDS, ramp:SECONDS, simulation, file:/PATH or unix:/PATH.",
        )
    if kind in ("sine", "ramp") and seconds_of(rest, kind) > _LONGEST_PERIOD:
        raise UsageError(f"{text!r} is longer than a day.", hint=f"Give seconds, such as {kind}:2.")


def _end(process: subprocess.Popen[bytes] | None) -> None:
    if process is None or process.poll() is not None:
        return
    process.terminate()
    try:
        process.wait(_ENDING)
    except subprocess.TimeoutExpired:
        process.kill()


def _die_with(daemon: int) -> None:
    """End when the daemon does, however it ends (prctl PR_SET_PDEATHSIG).

    By SIGKILL, which a node survives as it survives a power cut: Python drops what a handler raises at a bad moment of
    its start. A daemon that was gone before this call sends nothing any more.
    """
    _LIBC.prctl(1, signal.SIGKILL)
    if os.getppid() != daemon:
        os._exit(1)
