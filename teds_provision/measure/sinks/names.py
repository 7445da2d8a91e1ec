"""Topic names of channels: ``/<station>/<node>/<channel>``, unique and the same after every start.

A part of a name follows the rules of ROS 2 (which are stricter than those of ROS 1 and MQTT): letters, digits and
``_``, first a letter, no ``__``, no ``_`` at the end. A node without a name is ``n`` and the first eight digits of its
UUID; a channel without one is ``ch`` and its number. Two of one name get their UUID's digits, or number, behind it.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Iterable

from teds_provision.errors import UsageFailure
from teds_provision.measure.blocks import ChannelFacts, StationFacts

LONGEST = 60
TOKEN = re.compile(r"[A-Za-z](?:[A-Za-z0-9]|_(?=[A-Za-z0-9]))*\Z")


def slug(text: str) -> str:
    """A name from a person or a datasheet as one part of a topic; empty where nothing is left of it."""
    letters = unicodedata.normalize("NFKD", text.casefold()).encode("ascii", "ignore").decode().lower()
    joined = re.sub(r"[^a-z0-9]+", "_", letters).strip("_")[:LONGEST].strip("_")
    return f"n_{joined}" if joined and not joined[0].isalpha() else joined


def is_topic(text: str) -> bool:
    """Whether a name that a person chose follows the rules; parts are divided by ``/``."""
    return all(TOKEN.match(part) and "__" not in part for part in text.strip("/").split("/"))


class Topics:
    """Names of the nodes and channels of one measurement; chosen names go before made ones."""

    def __init__(self, station: StationFacts) -> None:
        self.station = slug(station.name) or "station"
        self._chosen = {key: name.strip("/") for key, name in station.names.items()}
        for key, name in self._chosen.items():
            if not is_topic(name):
                raise UsageFailure(
                    f"{name!r} for {key[0]} cannot be the name of a topic.",
                    hint="Use letters, digits and single _, beginning with a letter; / between parts.",
                )
        self._facts: dict[tuple[str, int], ChannelFacts] = {}
        self._own = {uuid: slug(name) for uuid, name in station.nodes.items()}  # what each node is called itself
        self._nodes = _names_of_nodes(self._own)
        self._channels: dict[tuple[str, int], str] = {}

    def learn(self, facts: Iterable[ChannelFacts]) -> None:
        """Facts of channels; names of those that were known stay unless a namesake came."""
        self._facts.update((one.key, one) for one in facts)
        self._own.update((one.uuid, slug(one.node)) for one in self._facts.values())
        self._nodes = _names_of_nodes(self._own)
        self._channels = _names_of_channels(
            {key: slug(one.name) or f"ch{one.number}" for key, one in self._facts.items()}
        )

    def node(self, uuid: str) -> str:
        """Part of the node: ``arm``, ``n8d4d9da6``."""
        return self._chosen.get((uuid, 0)) or self._nodes.get(uuid) or f"n{uuid[:8]}"

    def channel(self, uuid: str, number: int) -> str:
        """Whole topic of a channel: ``/bench/arm/angle``."""
        if (uuid, number) in self._chosen:
            return f"/{self._chosen[uuid, number]}"
        return f"/{self.station}/{self.node(uuid)}/{self._channels.get((uuid, number), f'ch{number}')}"

    def of_node(self, uuid: str, what: str) -> str:
        """A topic beside the channels of a node: ``/bench/arm/teds``."""
        return f"/{self.station}/{self.node(uuid)}/{what}"

    def of_group(self, group: str) -> str:
        """The array of a group: ``/bench/hand``; of a measurement without one ``/bench/all``."""
        return f"/{self.station}/{slug(group) or 'all'}"


def _names_of_nodes(own: dict[str, str]) -> dict[str, str]:
    """Names by UUID, of what each node is called itself: two of one name get the digits of their UUID behind it."""
    namesakes, alike = Counter(own.values()), Counter(uuid[:8] for uuid in own)
    names = {}
    for uuid, name in own.items():
        short = uuid[:8] if alike[uuid[:8]] == 1 else uuid
        names[uuid] = f"n{short}" if not name else name if namesakes[name] == 1 else f"{name}_{short}"
    return names


def _names_of_channels(own: dict[tuple[str, int], str]) -> dict[tuple[str, int], str]:
    """Names by node and number: two of one name in one node get their number behind it."""
    taken = Counter((uuid, name) for (uuid, _), name in own.items())
    return {key: f"{name}_{key[1]}" if taken[key[0], name] > 1 else name for key, name in own.items()}
