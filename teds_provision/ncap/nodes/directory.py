"""The facts of each node for the API. Written by the threads of links and measurements, read by all threads.

The rows of the store and the datasheets are read after a change, not for each request.
"""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any, Final

from teds_provision.api.answers import Node
from teds_provision.api.operations import MOST_NODES
from teds_provision.errors import NotFoundError, StoreError
from teds_provision.ncap.live import Live
from teds_provision.ncap.sinks import for_readers
from teds_provision.provisioning.inventory import with_verdicts
from teds_provision.sanitize import by_name
from teds_provision.shapes.node import KnownNode
from teds_provision.shapes.problem import Problem
from teds_provision.shapes.verdict import NodeVerdict
from teds_provision.station.overview import Search
from teds_provision.station.shown_units import shown_units, units_of_profile
from teds_provision.station.station import Station
from teds_provision.station.store.records import iso
from teds_provision.teds.sheet import Channel, Sheet

_log = logging.getLogger(__name__)
_order: Final = lru_cache(maxsize=32_768)(by_name)
"""Sort keys of ten thousand nodes, for each page of a list, cost half a second."""
_READ_NOW: Final = "read now"
_ADDED: Final = frozenset({"mode", "virtual", "wrapped", "unverified", "channels"})
_BLANK: Final[dict[str, Any]] = dict.fromkeys(name for name in Node.__annotations__ if name not in _ADDED)
"""Members of the API's node in their order; what takes other locks is added last."""
MOST_GONE: Final = 200
"""Number of nodes that left and are not in the store, kept to be shown: in transparent mode they can be invented."""


@dataclass
class NodePresence:
    """State of one node on the links now."""

    place: str = ""
    address: int | None = None
    present: bool = False
    seen: float = 0.0
    tapped: float = 0.0
    says: str | None = None  # state by a plain Identify, for an unknown node: a hint
    # verdict on what it sent outside a session; shown in addition to the stored one, not instead of it
    heard: dict[str, Any] | None = None
    looked: float = 0.0
    problem: Problem | None = None
    power: dict[str, Any] | None = None
    firmware: dict[str, Any] | None = None  # its firmware report outside a session; a stored report takes precedence
    measurement: str | None = None
    report: dict[str, Any] | None = None
    busy: str = ""
    version: int = 0  # incremented by each change of this object


class NodeDirectory:
    """The nodes by UUID (20 hex digits, lower case)."""

    def __init__(self, station: Station, live: Live) -> None:
        self._station, self._live = station, live
        self.topic: Callable[[str, int], str | None] = lambda _uuid, _number: None
        self.actuator: Callable[[str, int], dict[str, Any] | None] = lambda _uuid, _number: None
        self.virtual: Callable[[str], bool] = lambda _uuid: False
        self._lock, self._reading = threading.RLock(), threading.Lock()
        self._seen: dict[str, NodePresence] = {}
        self._rows: dict[str, KnownNode] = {}
        self._judged: dict[str, NodeVerdict | None] = {}  # by the store's rows and the present trust
        self._channels: dict[str, tuple[str, list[dict[str, Any]]]] = {}
        self._shown_in: dict[str, Mapping[int, str]] = {}  # display units with which the channels were decoded
        self._own_names: dict[str, str] = {}  # names from the datasheets
        self._origins: dict[str, dict[str, Any] | None] = {}  # the wrapped sensor of each node
        self.changes = 0  # incremented when a node's name or datasheet changes
        self._strangers: dict[str, set[str]] = {}
        # JSON of each node, by True for read-only callers
        self._texts: dict[str, dict[bool, tuple[tuple[int, int], str]]] = {}

    # -- the store ---------------------------------------------------------------------------------------------------

    def refresh(self, uuids: Iterable[str] | None = None) -> bool:
        """Read the rows of these nodes again, or of all in the store; datasheets when they are requested.

        False if the store cannot be read: the last known rows remain.
        """
        try:
            self._refresh(uuids)
        except StoreError as failure:
            _log.warning("The nodes cannot be read from the store: %s", failure.message)
            return False
        return True

    def _refresh(self, uuids: Iterable[str] | None) -> None:
        with self._reading:  # so that an older reading never overwrites a newer one
            every = self._station.overview.find(Search()) if uuids is None else map(bytes.fromhex, dict.fromkeys(uuids))
            wanted = list(every)
            found = list(with_verdicts(self._station, wanted))
            rows = {node.uuid: node for node, _ in found}
            judged = {node.uuid: verdict for node, verdict in found}
            with self._lock:
                self.changes += 1
                if uuids is None:
                    self._rows, self._judged = rows, judged
                else:
                    self._rows |= rows
                    self._judged |= judged

    def _sheet(self, uuid: str) -> list[dict[str, Any]]:
        """Return the channels of a node's last datasheet; decoded once for each datasheet."""
        with self._lock:
            digest = self._stored(uuid).teds_sha256 or ""
            known = self._channels.get(uuid)
        if known is not None and known[0] in (digest, _READ_NOW):
            return known[1]
        image = self._station.datasheets.datasheet(bytes.fromhex(uuid))
        shown = shown_units(self._station, bytes.fromhex(uuid))
        sheet = Sheet.from_image(image).shown_in(shown) if image is not None else None
        channels = [channel_facts(channel) for channel in sheet.channels] if sheet is not None else []
        with self._lock:
            self.changes += 1
            self._channels[uuid], self._shown_in[uuid] = (digest, channels), shown
            self._own_names[uuid] = sheet.meta.name if sheet is not None else ""
            self._origins[uuid] = _origin(sheet)
        return channels

    def follow_profiles(self) -> list[str]:
        """Show channels in the display units that their profiles name now; return the nodes with other ones."""
        with self._lock:
            known = {uuid: (self._stored(uuid).profile, units) for uuid, units in self._shown_in.items()}
        home = self._station.home
        now = {profile: units_of_profile(profile, home) for profile in {profile for profile, _ in known.values()}}
        changed = [uuid for uuid, (profile, units) in known.items() if now[profile] != units]
        with self._lock:
            for uuid in changed:
                self._channels.pop(uuid, None)
                self._shown_in.pop(uuid, None)
                self.changes += 1
        return changed

    def show_sheet(self, uuid: str, sheet: Sheet | None) -> None:
        """Show the channels of a datasheet that was read just now; None: those of the one that is kept."""
        with self._lock:
            self.changes += 1
            if sheet is None:
                self._channels.pop(uuid, None)
            else:
                self._shown_in[uuid] = shown_units(self._station, bytes.fromhex(uuid))
                known = sheet.shown_in(self._shown_in[uuid])
                self._channels[uuid] = _READ_NOW, [channel_facts(channel) for channel in known.channels]
                self._own_names[uuid] = sheet.meta.name
                self._origins[uuid] = _origin(sheet)

    # -- news from links and measurements ----------------------------------------------------------------------------

    def note(self, uuid: str, state: str | None = None, **facts: Any) -> None:
        """Change the facts of a node.

        With ``state`` every client gets an event (``came``, ``left``, ``verified`` …).
        """
        # only for the event: the stored reading determines the verdict that is shown
        verdict = facts.pop("verdict", None)
        with self._lock:
            seen = self._seen.setdefault(uuid, NodePresence())
            seen.version += 1
            for name, value in facts.items():
                setattr(seen, name, value)
            if state == "left":
                gone = [
                    other
                    for other, node_presence in self._seen.items()
                    if not node_presence.present and other not in self._rows
                ]
                of_each = (self._seen, self._channels, self._shown_in, self._own_names, self._origins, self._texts)
                for stranger in gone[:-MOST_GONE]:
                    for kept in of_each:
                        kept.pop(stranger, None)
        if state is not None:
            members = {key: value for key, value in facts.items() if key in ("problem", "place", "busy")}
            members |= {} if verdict is None else {"verdict": verdict}
            self._live.event("node", uuid=uuid, state=state, **members)

    def answering_on(self) -> frozenset[str]:
        """Return the nodes that answer on a link now, strangers of whitelist mode included."""
        with self._lock:
            here = {uuid for uuid, seen in self._seen.items() if seen.present}
            return frozenset(here.union(*self._strangers.values()))

    def seen(self, uuid: str) -> NodePresence:
        """Return a node's state on the links."""
        with self._lock:
            return self._seen.get(uuid) or NodePresence()

    def stranger(self, place: str, uuid: str, *, there: bool) -> bool:
        """Count a node that whitelist mode ignores; True if it is new."""
        with self._lock:
            known = self._strangers.setdefault(place, set())
            news = (uuid in known) != there
            (known.add if there else known.discard)(uuid)
        return news

    def strangers(self, place: str) -> int:
        """Return how many nodes of a link are ignored."""
        with self._lock:
            return len(self._strangers.get(place, ()))

    def forget_place(self, place: str) -> None:
        """Forget all sightings at a place: a link was lost, or its mode changed."""
        with self._lock:
            self._strangers.pop(place, None)
            gone = [uuid for uuid, seen in self._seen.items() if seen.place == place and seen.present]
        for uuid in gone:
            self.note(uuid, "left", present=False)

    def present(self, place: str) -> int:
        """Return how many nodes of a link are present."""
        with self._lock:
            return sum(seen.present and seen.place == place for seen in self._seen.values())

    # -- for the API -------------------------------------------------------------------------------------------------

    def uuids(self) -> list[str]:
        """Return every node of the store or on a link: those present first, each part by name."""
        with self._lock:
            known = set(self._rows) | {uuid for uuid, seen in self._seen.items() if seen.present or seen.looked}
            return sorted(known, key=lambda uuid: (not self.seen(uuid).present, _order(self.name(uuid), uuid)))

    def name(self, uuid: str) -> str:
        """Return the name of a node in the store, "" if it has none."""
        with self._lock:
            return self._stored(uuid).name or ""

    def published_name(self, uuid: str) -> tuple[str, bool]:
        """Return the name under which a node is published, and whether it is the node's own, unverified claim."""
        channels = self._sheet(uuid)
        with self._lock:
            judged = self._verdicts(uuid, self._seen.get(uuid) or NodePresence())["verdict"]
            if channels and judged is not None and judged["verdict"] == "unsigned":
                return self._own_names.get(uuid, ""), True
        return self.name(uuid), False

    def channel_names(self, uuid: str) -> list[tuple[int, str]]:
        """Return number and name of every channel."""
        return [(channel["number"], channel["name"]) for channel in self._sheet(uuid)]

    def raw_only(self, uuid: str) -> list[int]:
        """Return the sensors without a calibration: only their raw numbers are known."""
        return [channel["number"] for channel in self._sheet(uuid) if channel["problem"]]

    def known(self, uuid: str) -> bool:
        """Return True if there is anything to show of a node."""
        with self._lock:
            return uuid in self._rows or uuid in self._seen

    def channel(self, uuid: str, number: int) -> dict[str, Any]:
        """Return one channel of a node as in :meth:`node`; raises NotFoundError."""
        for channel in self.node(uuid)["channels"]:
            if channel["number"] == number:
                found: dict[str, Any] = channel
                return found
        raise NotFoundError(f"Node {uuid} has no channel {number}.")

    def nodes(self, most: int = MOST_NODES) -> list[dict[str, Any]]:
        """Return the first ``most`` of them; present ones come first."""
        return [self.node(uuid) for uuid in self.uuids()[:most]]

    def nodes_text(self, most: int = MOST_NODES, offset: int = 0, *, reader: bool = False) -> str:
        """Return the answer of GET /nodes as JSON; unchanged parts are cached.

        ``reader``: the client may only read.
        """
        uuids = self.uuids()
        shown = ",".join(self._text(uuid, reader) for uuid in uuids[offset : offset + most])
        return f'{{"nodes":[{shown}],"total":{len(uuids)}}}'

    def _text(self, uuid: str, reader: bool) -> str:
        with self._lock:
            seen = self._seen.get(uuid)
            key = (self.changes, seen.version if seen is not None else 0)
            known = self._texts.get(uuid, {}).get(reader)
        if known is not None and known[0] == key:
            return known[1]
        node = for_reader(self.node(uuid)) if reader else self.node(uuid)
        text = json.dumps(node, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
        # otherwise the text contains an age
        if all(channel["last"] is None and channel["actuator"] is None for channel in node["channels"]):
            with self._lock:
                self._texts.setdefault(uuid, {})[reader] = key, text
        return text

    def touch(self) -> None:
        """Record that something shown of every node has changed (names of topics)."""
        with self._lock:
            self.changes += 1

    def node(self, uuid: str) -> dict[str, Any]:
        """Return one node: api.md, `/nodes/UUID`."""
        channels = self._sheet(uuid)
        with self._lock:
            seen = self._seen.get(uuid) or NodePresence()
            known = self._stored(uuid)
            stored = known.published()
            wrapped = stored.pop("wrapped")
            out = (
                _BLANK
                | stored
                | {
                    "link": seen.place or None,
                    "via": seen.place.partition(":")[0] or None,
                    "address": seen.address,
                    "present": seen.present,
                    "last_seen": _moment(seen.seen) or known.last_seen,
                    "tapped": seen.tapped or None,
                    "state": known.state or seen.says,
                    **self._verdicts(uuid, seen),
                    "verified": _moment(seen.looked),
                    "problem": seen.problem,
                    "busy": seen.busy or None,
                    "measurement": seen.measurement,
                    "measuring": seen.report,
                    "power": seen.power,
                    "firmware": known.firmware or seen.firmware,
                }
            )
        called, unverified = self.published_name(uuid)
        out["unverified"] = unverified
        if unverified:  # an unsigned name, marked as such
            out["name"] = out["name"] or called or None
        out["virtual"] = self.virtual(uuid)
        out["wrapped"] = self._origins.get(uuid) or wrapped
        out["mode"] = "measuring" if seen.measurement else "idle" if seen.present else None
        out["channels"] = [{**channel, **self._now(uuid, channel["number"])} for channel in channels]
        return out

    def _stored(self, uuid: str) -> KnownNode:
        """Return a node as the store has it; with its UUID alone if it is only on a link."""
        return self._rows.get(uuid) or KnownNode(uuid=uuid)

    def _verdicts(self, uuid: str, seen: NodePresence) -> dict[str, Any]:
        """Return the verdict on a node, from its reading; and beside it what it sent outside a session.

        Of a node that was never read in a session, nor stored, the latter is all that is known.
        """
        judged = self._judged.get(uuid)
        if judged is None or (judged.origin == "plain" and seen.heard is not None):
            return {"verdict": seen.heard, "heard": None}
        return {"verdict": judged.to_json(), "heard": seen.heard}

    def _now(self, uuid: str, channel: int) -> dict[str, Any]:
        """Return the changing facts of a channel."""
        return {
            "topic": self.topic(uuid, channel),
            "last": self._value(uuid, channel),
            "actuator": self.actuator(uuid, channel),
        }

    def _value(self, uuid: str, channel: int) -> dict[str, Any] | None:
        last = self._live.last(uuid, channel)
        if last is None:
            return None
        age = max(0.0, time.time() - last.time)
        value = last.value if last.value is None or math.isfinite(last.value) else None
        return {"value": value, "raw": last.raw, "valid": value is not None, "time": last.time, "age": round(age, 3)}


def for_reader(node: dict[str, Any]) -> dict[str, Any]:
    """Return a node for a read-only token: its errors name no file of this machine."""
    return node | {name: for_readers(node[name]) for name in ("problem", "measuring")}


def _origin(sheet: Sheet | None) -> dict[str, Any] | None:
    origin = sheet.meta.origin if sheet is not None else None
    return dict(origin.to_json()) if origin is not None else None


def channel_facts(channel: Channel) -> dict[str, Any]:
    """Return the datasheet's facts of a channel: limits and uncertainty in its SI unit; ``rate`` in Hz.

    ``shown`` is the display unit: its number is the SI value × ``factor`` + ``offset``.
    """
    unit = channel.shown
    zero = unit.from_si(0.0)
    now = datetime.now(UTC)
    return {
        "number": channel.number,
        "name": channel.name,
        "kind": channel.kind.word if channel.kind is not None else None,
        "unit": channel.si_unit,
        "shown": {"unit": unit.text, "factor": _finite(unit.from_si(1.0) - zero), "offset": _finite(zero)},
        "low": _finite(channel.low),
        "high": _finite(channel.high),
        "uncertainty": _finite(channel.stated_uncertainty),
        "rate": _finite(1 / channel.period) if channel.period > 0 else None,
        "calibrated": channel.calibrated_at.date().isoformat() if channel.calibrated_at else None,
        "due": channel.due.date().isoformat() if channel.due else None,
        "overdue": channel.overdue(now),
        "problem": channel.value_problem or None,
    }


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


def _moment(unix: float) -> str | None:
    return iso(datetime.fromtimestamp(unix, UTC)) if unix else None
