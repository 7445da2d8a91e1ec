"""Topic names of channels: ``/<station>/<node>/<channel>``, unique and the same after every start.

A part of a name follows the rules of ROS 2 (which are stricter than those of ROS 1 and MQTT): letters, digits and
``_``, first a letter, no ``__``, no ``_`` at the end. A node without a name is ``n`` and the first eight digits of its
UUID; a channel without one is ``ch`` and its number. Two of one name get their UUID's digits, or number, behind it.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Set
from functools import lru_cache
from itertools import chain
from typing import Final, TypeVar

from teds_provision.errors import UsageError
from teds_provision.measure.blocks import ChannelFacts, StationFacts

LONGEST = 60
TOKEN = re.compile(r"[A-Za-z](?:[A-Za-z0-9]|_(?=[A-Za-z0-9]))*\Z")


@lru_cache(maxsize=4096)  # called for each value that goes to a broker
def slug(text: str) -> str:
    """Return an operator's or a datasheet's name as one part of a topic; empty if nothing is left of it."""
    letters = unicodedata.normalize("NFKD", text.casefold()).encode("ascii", "ignore").decode().lower()
    joined = re.sub(r"[^a-z0-9]+", "_", letters).strip("_")[:LONGEST].strip("_")
    return f"n_{joined}" if joined and not joined[0].isalpha() else joined


def is_topic(text: str) -> bool:
    """Return True if a chosen name follows the rules; parts are divided by ``/``."""
    return all(TOKEN.match(part) and "__" not in part for part in text.strip("/").split("/"))


FRAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*\Z")


def is_frame(text: str) -> bool:
    """Return True if a text can be a coordinate frame (``frame_id``), of an operator or a file."""
    return len(text) <= LONGEST and FRAME.match(text) is not None


class Topics:
    """Names of all nodes and channels of one station: no two topics are equal, whatever names there are.

    Chosen names go before derived ones; a derived one that is taken, or reserved (``teds``, ``imu``), gets its number
    or the digits of its UUID behind it. Derived names follow from ``station`` and from each node's own datasheet alone
    (:attr:`ChannelFacts.siblings`), so that every measurement and ``/names`` make the same.
    """

    def __init__(self, station: StationFacts) -> None:
        self.station = slug(station.name) or "station"
        self._chosen = {key: name.strip("/") for key, name in station.names.items()}
        for key, name in self._chosen.items():
            if not is_topic(name):
                raise UsageError(
                    f"{name!r} for {key[0]} cannot be the name of a topic.",
                    hint="Use letters, digits and single _, beginning with a letter; / between parts.",
                )
        self._whole = {f"/{name}": key for key, name in self._chosen.items() if key[1]}
        self._numbers: dict[str, set[int]] = {}  # per node: channels with a chosen name; 0: the node itself has one
        for uuid, number in self._chosen:
            self._numbers.setdefault(uuid, set()).add(number)
        self._channels: dict[str, dict[int, str]] = {}  # per node: names of its channels, from the datasheet
        self._known = {uuid: slug(name) for uuid, name in station.nodes.items()}  # the station's name of each node
        self._strangers: dict[str, str] = {}
        self._unverified: dict[str, str] = {}  # unsigned names: a separate namespace
        self._nodes: dict[str, str] = {}
        self._made: dict[str, dict[int, str]] = {}
        self._name_nodes()

    def learn(self, facts: Iterable[ChannelFacts]) -> Set[str]:
        """Learn facts of channels; return the nodes that may have another name now.

        A node that the station does not know gives its name up to one that it does.
        """
        strangers, touched = len(self._strangers), set[str]()
        for channel_facts in facts:
            touched.add(channel_facts.uuid)
            if channel_facts.unverified:
                self._name_unverified(channel_facts.uuid, slug(channel_facts.node))
            else:
                self._unverified.pop(channel_facts.uuid, None)
                if channel_facts.uuid not in self._known:
                    self._strangers[channel_facts.uuid] = slug(channel_facts.node)
            if channel_facts.chosen is not None and self._has_others(channel_facts.uuid, dict(channel_facts.chosen)):
                # Names chosen while the node was not measured; those of other nodes do not change.
                self._chosen = {key: name for key, name in self._chosen.items() if key[0] != channel_facts.uuid}
                self._chosen |= {(channel_facts.uuid, number): name.strip("/") for number, name in channel_facts.chosen}
                self._whole = {f"/{name}": key for key, name in self._chosen.items() if key[1]}
                self._numbers[channel_facts.uuid] = {number for number, _ in channel_facts.chosen}
                self._made.pop(channel_facts.uuid, None)
            channels = self._channels.setdefault(channel_facts.uuid, {})
            channels.update({channel_facts.number: channel_facts.name, **dict(channel_facts.siblings)})
            self._made.pop(channel_facts.uuid, None)
        if len(self._strangers) != strangers:
            before = self._nodes
            self._name_nodes()
            renamed = {uuid for uuid, name in self._nodes.items() if before.get(uuid) != name}
            for uuid in renamed:
                self._made.pop(uuid, None)
            touched |= renamed
        return touched

    def _has_others(self, uuid: str, chosen: Mapping[int, str]) -> bool:
        """Return True if the names that were chosen for a node are not those that are known here."""
        return self._numbers.get(uuid, set()) != chosen.keys() or any(
            self._chosen[uuid, number] != name.strip("/") for number, name in chosen.items()
        )

    def _name_unverified(self, uuid: str, name: str) -> None:
        """Name an unverified node; an unproven name never renames another node."""
        own = name or f"n{uuid[:8]}"
        if self._unverified.get(uuid, "").startswith(own):
            return
        taken = {other for key, other in self._unverified.items() if key != uuid}
        self._unverified[uuid] = next(
            candidate for candidate in (own, f"{own}_{uuid[:8]}", f"{own}_{uuid}") if candidate not in taken
        )

    def _name_nodes(self) -> None:
        taken = {name for (_, channel), name in self._chosen.items() if not channel} | _NOT_NODES
        self._nodes = {}
        for own in (self._known, self._strangers):
            alike = Counter(uuid[:8] for uuid in own)
            wishes = {uuid: (self._own_name(uuid, name) or f"n{uuid[:8]}",) for uuid, name in own.items()}
            more = {
                uuid: (f"{name or 'n'}_{uuid[:8]}" if name and alike[uuid[:8]] == 1 else "", f"{name or 'n'}_{uuid}")
                for uuid, name in own.items()
            }
            self._nodes |= _apart(wishes, more, taken)
            taken |= set(self._nodes.values())

    def _own_name(self, uuid: str, name: str) -> str:
        """Return the name, with its own digits behind it if it ends in those of another node.

        Two namesakes have their digits behind their names. When one of them goes, the running measurement goes on under
        that name, and a third node of that name must not get it in the next one.
        """
        digits = name.rpartition("_")[2]
        if len(digits) not in (8, 20) or not all(digit in "0123456789abcdef" for digit in digits):
            return name
        another = any(other.startswith(digits) for other in chain(self._known, self._strangers) if other != uuid)
        return f"{name}_{uuid[:8]}" if another else name

    def node(self, uuid: str) -> str:
        """Return the node's part: ``arm``, ``n8d4d9da6``.

        ``unverified/arm``, whatever was chosen for the signed one.
        """
        if uuid in self._unverified:
            return f"{UNVERIFIED}/{self._unverified[uuid]}"
        return self._chosen.get((uuid, 0)) or self._nodes.get(uuid) or f"n{uuid[:8]}"

    def channel(self, uuid: str, number: int) -> str:
        """Return the whole topic of a channel: ``/bench/arm/angle``."""
        if (uuid, number) in self._chosen and uuid not in self._unverified:
            return f"/{self._chosen[uuid, number]}"
        if uuid not in self._made:
            self._made[uuid] = self._make(uuid)
        return f"/{self.station}/{self.node(uuid)}/{self._made[uuid].get(number, f'ch{number}')}"

    def _make(self, uuid: str) -> dict[int, str]:
        """Return the derived names of a node's channels."""
        prefix = f"/{self.station}/{self.node(uuid)}/"
        channels = self._channels.get(uuid, {})
        apart = uuid in self._unverified
        own = {number: name for number, name in channels.items() if apart or (uuid, number) not in self._chosen}
        mine = [topic.removeprefix(prefix) for topic in self._whole if topic.startswith(prefix)]
        taken = {*mine, *(topic.removesuffix("/cmd") for topic in mine)}
        wishes = {number: (slug(name) or f"ch{number}",) for number, name in own.items()}
        more = {number: (f"{wish}_{number}", f"{wish}_ch{number}") for number, (wish,) in wishes.items()}
        return _apart(wishes, more, taken, _NOT_CHANNELS)

    def of_node(self, uuid: str, what: str) -> str:
        """Return a topic beside the channels of a node: ``/bench/arm/teds``."""
        return f"/{self.station}/{self.node(uuid)}/{what}"

    def of_group(self, group: str) -> str:
        """Return the array topic of a group: ``/bench/hand``; of a measurement without one ``/bench/all``."""
        name = slug(group) or "all"
        return f"/{self.station}/{name}{'_group' if name in _JOINTS else ''}"

    def of_station(self, what: str) -> str:
        """Return a topic of the whole station: ``/bench/joint_states``."""
        return f"/{self.station}/{what}"

    def require_free(self, uuid: str, channel: int, name: str) -> None:
        """Raise UsageError if a name that is to be chosen is, or would be mistaken for, another one's."""
        name = name.strip("/")
        if not channel:
            other = next(
                (other for other in {**self._known, **self._strangers} if other != uuid and self.node(other) == name),
                "",
            )
            if other or name in _NOT_NODES or name.partition("/")[0] == UNVERIFIED:
                raise _taken(name, f"node {other}" if other else "something else")
            return
        topic = f"/{name}"
        if name.partition("/")[0] in _NOT_TOPICS or self._stands_for_else(topic):
            raise _taken(name, "something else")
        for other, channels in self._channels.items():
            for number in channels:
                theirs = self.channel(other, number)
                if (other, number) != (uuid, channel) and topic in (theirs, f"{theirs}/cmd"):
                    raise _taken(name, f"channel {number} of node {other}")

    def _stands_for_else(self, topic: str) -> bool:
        """Return True if a topic is that of a node as a whole, of a group, or of their companions."""
        _, _, rest = topic.partition(f"/{self.station}/")
        if not topic.startswith(f"/{self.station}/") or not rest:
            return False
        parts = rest.split("/")
        return len(parts) == 1 or bool(_NOT_CHANNELS.fullmatch(parts[-1])) or parts[-1] == "cmd"


UNVERIFIED: Final = "unverified"
_JOINTS: Final = frozenset({"joint_states", "joint_commands"})
_NOT_NODES: Final = frozenset({"all", "reports", "status", UNVERIFIED}) | _JOINTS
"""Parts of topics of the station itself: no node is called so."""
_NOT_CHANNELS: Final = re.compile(r"(array|teds|state|status|age|cmd|(stream|imu|magnetic_field|wrench)(_[0-9]+)?)")
"""Parts of topics beside the channels of a node (live.py, vectors.py, mcap/recording.py, mqtt.py)."""
_NOT_TOPICS: Final = frozenset(
    {"diagnostics", "diagnostics_agg", "rosout", "rosout_agg", "parameter_events", "tf", "tf_static", "clock"}
)
"""Topics of ROS itself."""
_Key = TypeVar("_Key", str, int)


def _taken(name: str, by: str) -> UsageError:
    return UsageError(f"{name!r} is the topic of {by} already.", hint="Choose another name.")


def _apart(
    wishes: Mapping[_Key, tuple[str, ...]],
    more: Mapping[_Key, tuple[str, ...]],
    taken: Set[str],
    forbidden: re.Pattern[str] | None = None,
) -> dict[_Key, str]:
    """Return each wish if it is unique, else the first of ``more`` that is free, else that with a number."""

    def may(name: str) -> bool:
        return bool(name) and name not in taken and not (forbidden and forbidden.fullmatch(name))

    count = Counter(name for (name,) in wishes.values())
    found = {key: name for key, (name,) in wishes.items() if count[name] == 1 and may(name)}
    used = set(found.values())
    for key in sorted(wishes.keys() - found.keys()):
        last = more[key][-1]
        tries = chain(more[key], (f"{last}_{number}" for number in range(2, 1 << 30)))
        found[key] = next(name for name in tries if may(name) and name not in used and name not in count)
        used.add(found[key])
    return found
