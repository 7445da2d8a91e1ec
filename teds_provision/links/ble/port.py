"""The station's Bluetooth port: finds nodes by their service, identifies each, and keeps few connections.

Nodes are connected one after the other; a connection ends when its link is closed. Only measuring keeps several.
"""

from __future__ import annotations

import json
import queue
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from teds_provision.errors import LinkError, NodeRefusedError, NoNodeError, NoReaderError, TedsProvisionError
from teds_provision.files import read_limited, whole_file
from teds_provision.links.ble.adapter import Adapter
from teds_provision.links.ble.airtime import BleAirtime
from teds_provision.links.ble.connection import BleConnection
from teds_provision.links.ble.link import BleLink, Loop
from teds_provision.links.ble.spec import parse_spec
from teds_provision.links.ports import BLE, LISTEN_SECONDS, Capabilities, Contact, Notice, NoticeSink, Trace
from teds_provision.links.streaming import DataListener, DataMessage, MeasuringLink, StreamPieces
from teds_provision.protocol.messages.frames import IDENTIFY, decode_reply
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.protocol.operation.can_frames import read_ble_frame

# A cache, from command to command, of the Bluetooth addresses at which nodes were met (operation.md section 7).
#
# A node keeps its address until it is reset, so a search for one node begins there and does not connect to twenty
# others. The file is in the user's cache folder; errors of reading or writing it are ignored. Its contents are hints.

FILE: Final = "ble-addresses.json"
MOST: Final = 10_000
_MOST_OCTETS: Final = 4 << 20


def cache_file() -> Path:
    """Return its path: ``~/.cache/teds-provision/ble-addresses.json`` unless XDG_CACHE_HOME is set."""
    from platformdirs import user_cache_path

    return user_cache_path("teds-provision") / FILE


class RememberedNodes:
    """Identify of nodes by address, the newest last; :meth:`save` keeps what was learnt."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known: dict[str, Identity] = {}
        self._changed = False
        with suppress(OSError, ValueError, TypeError, AttributeError, TedsProvisionError):
            document = json.loads(read_limited(path, _MOST_OCTETS, "cache"))
            self._known = {address: Identity.decode(bytes.fromhex(octets)) for address, octets in document.items()}

    def items(self) -> list[tuple[str, Identity]]:
        """Return every address and the identity seen there, the newest first."""
        return list(reversed(self._known.items()))

    def remember_node(self, address: str, identity: Identity) -> None:
        """Record the address of a node; an earlier address of it is forgotten."""
        others = {
            at: known_identity
            for at, known_identity in self._known.items()
            if at != address and known_identity.uuid != identity.uuid
        }
        self._changed = self._changed or self._known.get(address) is None or len(others) + 1 != len(self._known)
        self._known = {**others, address: identity}

    def save(self) -> None:
        """Write the cache, if it changed; never raises."""
        if not self._changed:
            return
        kept = list(self._known.items())[-MOST:]
        with suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with whole_file(self._path, replace=True) as file:
                file.write(json.dumps({address: identity.encode().hex() for address, identity in kept}).encode())
            self._changed = False


_ROUND_SECONDS: Final = 2.0
_SILENCE_SECONDS: Final = 1.5
"""Seconds without a new node after which all were seen. Nodes advertise every 0.1 to 1 s."""
_LONGEST_SECONDS: Final = 8.0
_GONE_SECONDS: Final = 10.0
_LONGEST_WAIT: Final = 60.0
"""Longest time in seconds before a node that advertises and does not answer is asked again."""
_GUESS_SECONDS: Final = 2.0
_MOST_GUESSES: Final = 3
_NOBODY: Final = Identity(bytes(10), NodeState.FACTORY, 0, 0, 1024, 0)
_REOPEN_SECONDS: Final = 1.0
_MOST_HELD: Final = 20_000


def open_port(where: str, trace: Trace | None = None) -> BlePort:
    """Open the adapter that ``where`` names, as ``--ble`` does; raises UsageError. Frames go to ``trace``."""
    return BlePort(where, trace)


@dataclass
class _WholeMessages:
    """A message is one notification, so none is put together from pieces."""

    wrong: int = 0


class BlePort(MeasuringLink):
    """Finds nodes through one Bluetooth adapter, and measures; see ``links.ports.Port``. Thread-safe.

    A node's number is that of its connection. One that streams is not given up for another node.
    """

    via = "ble"

    def __init__(self, spec_text: str, trace: Trace | None = None) -> None:
        self.trace = trace
        self.spec = parse_spec(spec_text)
        self.place = f"ble:{spec_text}"
        self._loop = Loop()
        self._adapter = Adapter(self.spec)
        self._connections: dict[str, BleConnection] = {}
        self._known = RememberedNodes(cache_file())
        self._data: queue.Queue[DataMessage] = queue.Queue(_MOST_HELD)
        self._streams: set[tuple[int, int]] = set()  # (connection number, stream number)
        self._heard = self._closed = False
        self.lost = 0  # data messages dropped because the queue was full
        self._transaction = secrets.randbelow(1 << 16)
        self._lock = threading.Lock()

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of Bluetooth LE."""
        return BLE

    def next_transaction(self) -> int:
        """Return a transaction number, 0 to 65535; the first of a process is random."""
        with self._lock:
            self._transaction = (self._transaction + 1) & 0xFFFF
            return self._transaction

    def close(self) -> None:
        """End every connection; never raises."""
        with self._lock:
            closed, self._closed = self._closed, True
        if closed:
            return
        self._known.save()
        with suppress(Exception):
            self._loop.run(self._all_down())
        self._loop.stop()

    # -- measuring and acting --------------------------------------------------------------------------------------

    def open_stream(self, node: int, stream: int, length: int) -> StreamPieces:
        """Take data messages of a stream from now on; its connection is kept."""
        del length
        with self._lock:
            self._streams.add((node, stream))
            self._keep(node)
        return _WholeMessages()

    def close_stream(self, node: int, stream: int) -> None:
        """Take them no more."""
        with self._lock:
            self._streams.discard((node, stream))
            self._keep(node)

    @contextmanager
    def listen(self) -> Iterator[DataListener]:
        """Hear the data messages of every connection."""
        self._heard = True
        try:
            yield self
        finally:
            self._heard = False

    def get_all(self, seconds: float) -> list[DataMessage]:
        """Return the data messages that wait; if there are none, wait ``seconds`` for the next one."""
        messages: list[DataMessage] = []
        with suppress(queue.Empty):
            messages.append(self._data.get(timeout=seconds))
            while True:
                messages.append(self._data.get_nowait())
        return messages

    def airtime(self, node: int | None = None) -> BleAirtime:
        """Return the airtime by the MTU of a connection; None: by the least."""
        return BleAirtime() if node is None else BleAirtime(self.link(node).mtu)

    def drive(self, node: int, message: bytes) -> None:
        """Write a Drive message; raises LinkError."""
        self.link(node).drive(message)

    def link(self, node: int, notice: NoticeSink | None = None) -> BleLink:
        """Return the link over the connection of this number; raises NoNodeError if there is none."""
        connection = next(
            (ble_connection for ble_connection in self._connections.values() if ble_connection.number == node), None
        )
        if connection is None:
            raise NoNodeError("That node is no longer known here.")
        return BleLink(self._loop, connection, self.next_transaction, self._make_room, notice or _silently)

    def _keep(self, number: int) -> None:
        """Mark a connection as used by a measurement or not, so that it is not given up for another node; locked."""
        streaming = any(node == number for node, _ in self._streams)
        for connection in self._connections.values():
            if connection.number == number:
                connection.streaming = streaming

    # -- finding ---------------------------------------------------------------------------------------------------

    def find(
        self, wanted: Callable[[Identity], bool], *, seconds: float, notice: NoticeSink, address: int | None = None
    ) -> Contact:
        """Return the node for which ``wanted`` is true: at ``address=``, else the first that advertises.

        Raises NoNodeError after ``seconds``, NoReaderError if Bluetooth cannot be used.
        """
        where = f"at {self.spec.address} " if self.spec.address else ""
        notice(Notice("waiting", f"Looking for the node {where}over BLE ({self.spec.text}).", seconds))
        reported: set[bytes] = set()
        for candidate in self._candidates(wanted, time.monotonic() + seconds):
            contact = self._ask(candidate, wanted, notice, reported)
            if contact is not None:
                return contact
        others = f"; others did: {', '.join(sorted(uuid.hex() for uuid in reported))}" if reported else ""
        raise NoNodeError(
            f"The node did not answer over BLE {where}within {seconds:g} s{others}.",
            hint="A node advertises for 60 s after a tap, and as long as it has a key. Bring it closer, or tap it.",
        )

    def find_all(self, *, seconds: float, notice: NoticeSink, listen: float = 0.0) -> list[Contact]:
        """Return every advertising node, identified one after the other; raises NoNodeError after ``seconds``.

        Listens until no new one has appeared for 1.5 s, and for at least ``listen`` seconds. Nodes are identified as
        soon as they are seen: a new node advertises only for a minute after its tap.
        """
        notice(Notice("waiting", f"Looking for nodes over BLE ({self.spec.text}).", seconds))
        began = time.monotonic()
        until, enough = began + seconds, began + min(listen, seconds)
        reported: set[bytes] = set()
        found: dict[str, Contact] = {}
        asked: dict[str, float] = {}
        while (left := until - time.monotonic()) > 0:
            for address in [self.spec.address] if self.spec.address else self._all_new(left, asked, found, enough):
                in_use = self._is_up(address)
                contact = self._ask(address, _anyone, notice, reported)
                asked[address] = time.monotonic()
                if contact is not None:
                    if not in_use:  # there may be twenty: each is connected again for its turn
                        contact.link.close()
                    found[address] = contact
            if found and (self.spec.address or time.monotonic() >= enough):
                break
        if found:
            return [found[address] for address in sorted(found)]
        raise NoNodeError(
            f"No node advertises within {seconds:g} s.",
            hint="A node advertises for 60 s after a tap, and as long as it has a key.",
        )

    def watch(self, *, stop: threading.Event, notice: NoticeSink) -> Iterator[Contact]:
        """Yield each node when it first advertises, and when it comes back after it was silent for 10 s.

        A node that does not say who it is is asked again while it advertises: after 5 s, 10 s and so on to 60 s.
        """
        notice(Notice("waiting", f"Watching for nodes over BLE ({self.spec.text})."))
        last: dict[str, float] = {}
        silent: dict[str, tuple[float, float]] = {}  # who did not answer: when to ask again, and how long it waited
        lost = False
        while not stop.is_set():
            try:
                seen = self._loop.run(self._adapter.scan(_ROUND_SECONDS, lambda _now: stop.is_set()))
                if lost:
                    lost = False
                    notice(Notice("reader-ready", "Bluetooth is back."))
            except NoReaderError as error:
                if not lost:
                    lost = True
                    notice(Notice("reader-lost", f"{error.message} Waiting for it."))
                stop.wait(_REOPEN_SECONDS)
                continue
            for address, at in seen.items():
                if at - last.get(address, -_GONE_SECONDS) >= _GONE_SECONDS:
                    silent.pop(address, None)
                    due = True
                else:
                    due = address in silent and at >= silent[address][0]
                last[address] = time.monotonic()
                contact = self._ask(address, _anyone, notice, set()) if due else None
                if contact is not None:
                    silent.pop(address, None)
                    yield contact
                    last[address] = time.monotonic()
                elif due:
                    wait = min(2 * silent[address][1], _LONGEST_WAIT) if address in silent else _GONE_SECONDS / 2
                    silent[address] = (time.monotonic() + wait, wait)
                if stop.is_set():
                    return

    # -- internals -------------------------------------------------------------------------------------------------

    def _candidates(self, wanted: Callable[[Identity], bool], until: float) -> Iterator[str]:
        """Yield addresses to ask until ``until``: known ones first, then those that advertise, each at intervals."""
        asked: dict[str, float] = {}
        for known in self._guesses(wanted):
            if self._is_up(known) or self._advertises(known):
                yield known
                asked[known] = time.monotonic()
        while (left := until - time.monotonic()) > 0:
            for address in self._advertising(min(left, _ROUND_SECONDS), asked):
                asked[address] = time.monotonic()
                yield address

    def _guesses(self, wanted: Callable[[Identity], bool]) -> list[str]:
        """Return addresses of earlier contacts with a wanted node, to try before listening for others.

        Empty if any node will do: then the first that advertises is as good.
        """
        if self.spec.address or wanted(_NOBODY):
            return []
        return [address for address, identity in self._known.items() if wanted(identity)][:_MOST_GUESSES]

    def _advertises(self, address: str) -> bool:
        """Return True if this address is heard within a moment."""
        return address in self._loop.run(self._adapter.scan(_GUESS_SECONDS, lambda seen: address in seen))

    def _advertising(self, seconds: float, asked: dict[str, float]) -> list[str]:
        """Return addresses that advertise and were not asked lately, as soon as there is one."""
        now = time.monotonic()

        def fresh(seen: dict[str, float]) -> list[str]:
            return [
                address
                for address in seen
                if (self.spec.address is None or address == self.spec.address)
                and now - asked.get(address, -_GONE_SECONDS) >= _GONE_SECONDS / 2
            ]

        return fresh(self._loop.run(self._adapter.scan(seconds, lambda seen: bool(fresh(seen)))))

    def _all_new(
        self, seconds: float, asked: Mapping[str, float], found: Mapping[str, Contact], enough: float
    ) -> list[str]:
        """Return advertising addresses not found yet: until no new one came for a while, and ``enough`` has passed.

        A node that did not identify itself counts as new again after some seconds, while it advertises.
        """
        began = time.monotonic()
        first_at: dict[str, float] = {}
        least = min(enough, began + LISTEN_SECONDS)

        def over(seen: dict[str, float]) -> bool:
            now = time.monotonic()
            for address, at in seen.items():
                if address not in found and at - asked.get(address, -_GONE_SECONDS) >= _GONE_SECONDS / 2:
                    first_at.setdefault(address, now)
            if not first_at:
                return bool(found) and now >= enough
            return now >= least and now - max(first_at.values()) >= _SILENCE_SECONDS

        self._loop.run(self._adapter.scan(min(seconds, max(_LONGEST_SECONDS, enough - began)), over))
        return sorted(first_at)

    def _ask(
        self, address: str, wanted: Callable[[Identity], bool], notice: NoticeSink, reported: set[bytes]
    ) -> Contact | None:
        """Connect and read Identify; the connection stays only if it is the wanted node."""
        link = self._link(address, notice)
        in_use = link.connection.is_up
        try:
            identity = Identity.decode(decode_reply(link.exchange(IDENTIFY.encode())).payload)
        except NoReaderError:
            raise
        except (LinkError, NodeRefusedError) as error:
            notice(Notice("unfinished", f"The node at {address} did not say who it is: {error.message}"))
            self._leave(link, in_use=in_use)
            return None
        except Exception:
            self._leave(link, in_use=in_use)
            raise
        self._known.remember_node(address, identity)
        if not wanted(identity):
            self._leave(link, in_use=in_use)
            if identity.uuid not in reported:
                reported.add(identity.uuid)
                uuid = identity.uuid.hex()
                notice(
                    Notice("foreign-tag", f"Node {uuid} is at {address}, but it is not the node that was requested.")
                )
            return None
        connection = link.connection.number
        return Contact(identity, link, connection=connection, trace=self.trace, bus=self.place)

    def _leave(self, link: BleLink, *, in_use: bool) -> None:
        """End a connection that was made for a question alone."""
        if not in_use:
            link.close()

    def _link(self, address: str, notice: NoticeSink) -> BleLink:
        with self._lock:
            connection = self._connections.get(address)
            if connection is None:
                connection = self._connections[address] = BleConnection(
                    self._adapter, address, self._take_data, self.trace
                )
        return BleLink(self._loop, connection, self.next_transaction, self._make_room, notice)

    def _is_up(self, address: str) -> bool:
        connection = self._connections.get(address)
        return connection is not None and connection.is_up

    def _make_room(self) -> bool:
        """End an idle connection; False if there is none."""
        with self._lock:
            idle = [
                ble_connection
                for ble_connection in self._connections.values()
                if ble_connection.is_up and not (ble_connection.asking or ble_connection.streaming)
            ]
        if not idle:
            return False
        self._loop.run(idle[0].disconnect())
        return True

    def _take_data(self, connection: int, octets: bytes) -> None:
        read = read_ble_frame(octets) if self._heard else None
        if read is None or (connection, read[0]) not in self._streams:
            return
        try:
            self._data.put_nowait(DataMessage(connection, *read, time.monotonic_ns()))
        except queue.Full:
            self.lost += 1

    async def _all_down(self) -> None:
        for connection in self._connections.values():
            await connection.disconnect()


def _silently(_notice: Notice) -> None:
    """Ignore a notice."""


def _anyone(_identity: Identity) -> bool:
    return True
