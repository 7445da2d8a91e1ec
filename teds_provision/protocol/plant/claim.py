"""One station's claims about one node, gathered from its pages in their order (contract/plant.md section 2).

Within a chain newest is by place (n, then the place in ``events``), never by ``at``. A claim holds what the rules need
and nothing of the order in which chains arrived: the greatest key, the last pin and name, sets of the rest.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from teds_provision.protocol.plant.event import Event, reset_proven

Key = tuple[int, str]
"""Epoch and key id of a link key."""
Runs = tuple[str, str, str | None]
"""Text, version and image digest of a node's firmware."""
_NOTHING: Final[tuple[object, ...]] = (None, [], {}, -1)


@dataclass
class Claim:
    """One station's claims of one node.

    ``pin``: fingerprint and assurance of its last ``pinned``, None after an ``unpinned``. ``agreed``: epoch, key id and
    fingerprint of the greatest key that it agreed; ``took``: epoch and key id of the greatest that it was given.
    ``written``: sequence, digest, epoch, profile, its digest and due of the greatest. ``gave``: bundle, peer, epoch,
    key id, mode of each. ``undone``: bundles. ``refused``: bundle, peer, why. ``resets``: fingerprint and epoch of each
    reset that the node's key proved. ``name``, ``groups``: with the time of the event. ``firmware``: what
    the node last reported to it in a session (None: the node reports none), with the time of the event.
    """

    pin: tuple[str, str] | None = None
    agreed: tuple[int, str, str] | None = None
    took: Key | None = None
    written: tuple[int, str, int, str | None, str | None, str | None] | None = None
    forgot: int = -1
    gave: set[tuple[str, str, int, str, str]] = field(default_factory=set)
    undone: set[str] = field(default_factory=set)
    refused: set[tuple[str, str, str]] = field(default_factory=set)
    resets: set[tuple[str, int]] = field(default_factory=set)
    name: tuple[str, str] | None = None
    groups: dict[str, tuple[bool, str]] = field(default_factory=dict)
    firmware: tuple[Runs | None, str] | None = None

    def apply_event(self, event: Event) -> None:
        """Add the next event of the station's chain about this node.

        Signed and vouched digests, statements and liftings are sets of the whole plant, kept beside the claims.
        """
        members = event.members
        match event.act:
            case "pinned":
                self.pin = members["fingerprint"], members["assurance"]
            case "unpinned":
                self.pin = None
            case "agreed":
                agreed = members["epoch"], members["key_id"], members["fingerprint"]
                if self.agreed is None or agreed[:2] >= self.agreed[:2]:
                    self.agreed = agreed
            case "took":
                took = members["epoch"], members["key_id"]
                self.took = took if self.took is None else max(self.took, took)
            case "written":
                written = (
                    members["sequence"], members["teds_sha256"], members["epoch"],
                    members["profile"], members["profile_sha256"], members["due"],
                )  # fmt: skip
                if self.written is None or written[:2] >= self.written[:2]:
                    self.written = written
            case "gave":
                self.gave.add(
                    (members["bundle"], members["peer"], members["epoch"], members["key_id"], members["mode"])
                )
            case "undone":
                self.undone.add(members["bundle"])
            case "refused":
                self.refused.add((members["bundle"], members["peer"], members["why"]))
            case "forgot":
                self.forgot = max(self.forgot, members["epoch"])
            case "reset":
                proven = reset_proven(event)
                if proven is not None:
                    self.resets.add((proven, members["epoch"]))
            case "named":
                self.name = members["name"], event.at
            case "grouped":
                self.groups[members["group"]] = members["member"], event.at
            case "firmware":
                self.firmware = _runs(members["runs"]), event.at

    def key(self) -> Key | None:
        """Return the greatest key that it agreed or took."""
        return max((key for key in (self.agreed and self.agreed[:2], self.took) if key), default=None)

    def given_keys(self) -> set[tuple[str, str, int, str, str]]:
        """Return the keys that it gave and did not undo."""
        return {gave for gave in self.gave if gave[0] not in self.undone}

    def to_json(self) -> str:
        """Return the JSON that the store keeps."""
        kept = {name: sorted(value) if isinstance(value, set) else value for name, value in asdict(self).items()}
        return json.dumps({name: value for name, value in kept.items() if value not in _NOTHING}, separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> Claim:
        """Parse the JSON of :meth:`to_json`."""
        kept = json.loads(text)
        claim = cls(forgot=kept.get("forgot", -1))
        for name in ("pin", "agreed", "took", "written", "name"):
            if name in kept:
                setattr(claim, name, tuple(kept[name]))
        for name in ("gave", "refused", "resets"):
            setattr(claim, name, {tuple(item) for item in kept.get(name, ())})
        claim.undone = set(kept.get("undone", ()))
        claim.groups = {group: (member, at) for group, (member, at) in kept.get("groups", {}).items()}
        if "firmware" in kept:
            runs, at = kept["firmware"]
            claim.firmware = _runs(runs), at
        return claim


def _runs(stated: Sequence[Any] | None) -> Runs | None:
    if stated is None:
        return None
    text, version, image = stated
    return text, version, image


def had_key(station: str, key: Key, claims: Mapping[str, Claim]) -> bool:
    """Return True if by any station's claims of a node this one has held a link key of it."""
    own = claims.get(station)
    if own is not None and key in ((own.agreed or ())[:2], own.took, *((e, k) for _, _, e, k, _ in own.gave)):
        return True
    return any((peer, e, k) == (station, *key) for claim in claims.values() for _, peer, e, k, _ in claim.gave)
