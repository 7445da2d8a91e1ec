"""The topic of every channel: station, node, channel (sinks publish under them); unique, and renameable."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from teds_provision.errors import FrozenError, NotFoundError, UsageError
from teds_provision.measure.blocks import ChannelFacts, StationFacts
from teds_provision.measure.running.measurement_job import station_facts
from teds_provision.measure.sinks.names import Topics, is_topic
from teds_provision.ncap.live import Live
from teds_provision.ncap.nodes.directory import NodeDirectory
from teds_provision.station.station import Station


class Names:
    """The names of one station, as sinks make them; ``is_measured`` freezes those of a node.

    ``in_use`` returns the station facts of its running measurement: a node of the same name that came since changes the
    names for the next one, not what is published.
    """

    def __init__(
        self,
        station: Station,
        roster: NodeDirectory,
        live: Live,
        is_measured: Callable[[str], bool],
        in_use: Callable[[str], StationFacts | None],
    ) -> None:
        self._station, self._directory, self._live, self._is_measured = station, roster, live, is_measured
        self._in_use = in_use
        self._of_running: tuple[StationFacts, int, Topics] | None = None
        self._guard = threading.Lock()
        self._topics: Topics | None = None
        self._made_of = -1  # the directory's count of changes at that time

    def forget(self) -> None:
        """Drop cached names after a chosen name changed. Changes of nodes and datasheets are noticed anyway."""
        with self._guard:
            self._topics = None
        self._directory.touch()

    def topic(self, uuid: str, channel: int) -> str:
        """Return the whole topic of a channel."""
        return self._topics_of(uuid, self._now()).channel(uuid, channel)

    def all(self) -> list[dict[str, Any]]:
        """Return every channel with its topic, and the name chosen for it; channel 0 is the node's part."""
        now, chosen = self._now(), self._station.measurements.names
        found = []
        for uuid in self._directory.uuids():
            topics = self._topics_of(uuid, now)
            raw = bytes.fromhex(uuid)
            found.append({"uuid": uuid, "channel": 0, "name": chosen.get((raw, 0)), "topic": topics.node(uuid)})
            for number, _ in self._directory.channel_names(uuid):
                name = chosen.get((raw, number))
                found.append({"uuid": uuid, "channel": number, "name": name, "topic": topics.channel(uuid, number)})
        return found

    def rename(self, uuid: str, channel: int, name: str | None) -> None:
        """Publish it under this name; None: under the one that is made for it.

        Raises UsageError, NotFoundError for a channel that the node has not, FrozenError.
        """
        if name is not None and not is_topic(name):
            raise UsageError(
                f"{name!r} is not a valid topic name.",
                hint="Use letters, digits and single _, beginning with a letter; / between parts.",
            )
        known = [number for number, _ in self._directory.channel_names(uuid)]
        if name is not None and channel and known and channel not in known:
            raise NotFoundError(
                f"{uuid} has no channel {channel}.", hint=f"Channels in its datasheet: {', '.join(map(str, known))}."
            )
        if name is not None:
            self._now().require_free(uuid, channel, name)
            meant = name.strip("/") if not channel else f"/{name.strip('/')}"
            if any(row["topic"] == meant for row in self.all() if (row["uuid"], row["channel"]) != (uuid, channel)):
                raise UsageError(f"{name!r} is published already.", hint="Choose another name.")
        raw = bytes.fromhex(uuid)
        if self._is_measured(uuid) or self._station.measurements.is_running(raw):
            raise FrozenError(
                f"Node {uuid} is being measured, so its names cannot be changed now.", hint="End the measurement first."
            )
        with self._station.durable("rename"):
            self._station.measurements.rename(raw, channel, name.strip("/") if name is not None else None)
            self._station.audit("rename", raw, "done", channel=channel, name=name)
        self.forget()
        self._live.event("names", state="changed", uuid=uuid, channel=channel)

    def _now(self) -> Topics:
        changes = self._directory.changes
        with self._guard:
            topics = self._topics if self._made_of == changes else None
        if topics is not None:
            return topics
        topics = self._learn_topics(station_facts(self._station))
        with self._guard:
            self._topics, self._made_of = topics, changes
        return topics

    def _learn_topics(self, station: StationFacts) -> Topics:
        topics = Topics(station)
        for uuid in self._directory.uuids():
            called, unverified = self._directory.published_name(uuid)
            topics.learn(
                ChannelFacts(uuid, called, number, name, unverified=unverified)
                for number, name in self._directory.channel_names(uuid)
            )
        return topics

    def _topics_of(self, uuid: str, now: Topics) -> Topics:
        """Return the topics of a node: those that its running measurement publishes, else those of the next one."""
        facts = self._in_use(uuid)
        if facts is None:
            return now
        changes, made = self._directory.changes, self._of_running
        if made is None or made[0] is not facts or made[1] != changes:
            made = self._of_running = (facts, changes, self._learn_topics(facts))
        return made[2]
