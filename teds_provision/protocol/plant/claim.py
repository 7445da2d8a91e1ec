"""What one station claims of one node, gathered from its pages in their order (contract/plant.md section 2).

Within a chain newest is by place (n, then the place in ``events``), never by ``at``. A claim holds what the rules ask
for and nothing of the order in which chains arrived: the greatest key, the last pin and name, sets of the rest.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Final

from teds_provision.protocol.plant.event import Event, reset_proven

Key = tuple[int, str]
"""Epoch and key id of a link key."""
_NOTHING: Final[tuple[object, ...]] = (None, [], {}, -1)


@dataclass
class Claim:
    """One station's claims of one node.

    ``pin``: fingerprint and assurance of its last ``pinned``, None after an ``unpinned``. ``agreed``: epoch, key id and
    fingerprint of the greatest key that it agreed; ``took``: epoch and key id of the greatest that it was given.
    ``written``: sequence, digest, epoch, profile, its digest and due of the greatest. ``gave``: bundle, peer, epoch,
    key id, mode of each. ``undone``: bundles. ``refused``: bundle, peer, why. ``resets``: fingerprint and epoch of each
    reset that the node's key proved. ``name``, ``groups``: with the time of the event.
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

    def take(self, event: Event) -> None:
        """Add the next event of the station's chain about this node."""
        gather = _GATHER.get(event.act)
        if gather is not None:
            gather(self, event)

    def key(self) -> Key | None:
        """The greatest key that it agreed or took."""
        return max((key for key in (self.agreed and self.agreed[:2], self.took) if key), default=None)

    def left(self) -> set[tuple[str, str, int, str, str]]:
        """What it gave and did not undo."""
        return {gave for gave in self.gave if gave[0] not in self.undone}

    def to_json(self) -> str:
        """As the store keeps it."""
        kept = {name: sorted(value) if isinstance(value, set) else value for name, value in asdict(self).items()}
        return json.dumps({name: value for name, value in kept.items() if value not in _NOTHING}, separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> Claim:
        """What :meth:`to_json` gave."""
        kept = json.loads(text)
        claim = cls(forgot=kept.get("forgot", -1))
        for name in ("pin", "agreed", "took", "written", "name"):
            if name in kept:
                setattr(claim, name, tuple(kept[name]))
        for name in ("gave", "refused", "resets"):
            setattr(claim, name, {tuple(one) for one in kept.get(name, ())})
        claim.undone = set(kept.get("undone", ()))
        claim.groups = {group: (member, at) for group, (member, at) in kept.get("groups", {}).items()}
        return claim


def _pinned(claim: Claim, event: Event) -> None:
    claim.pin = event.members["fingerprint"], event.members["assurance"]


def _unpinned(claim: Claim, event: Event) -> None:
    claim.pin = None


def _agreed(claim: Claim, event: Event) -> None:
    new = event.members["epoch"], event.members["key_id"], event.members["fingerprint"]
    if claim.agreed is None or new[:2] >= claim.agreed[:2]:
        claim.agreed = new


def _took(claim: Claim, event: Event) -> None:
    new = event.members["epoch"], event.members["key_id"]
    claim.took = new if claim.took is None else max(claim.took, new)


def _written(claim: Claim, event: Event) -> None:
    told = event.members
    new = told["sequence"], told["teds_sha256"], told["epoch"], told["profile"], told["profile_sha256"], told["due"]
    if claim.written is None or new[:2] >= claim.written[:2]:
        claim.written = new


def _gave(claim: Claim, event: Event) -> None:
    told = event.members
    claim.gave.add((told["bundle"], told["peer"], told["epoch"], told["key_id"], told["mode"]))


def _undone(claim: Claim, event: Event) -> None:
    claim.undone.add(event.members["bundle"])


def _refused(claim: Claim, event: Event) -> None:
    claim.refused.add((event.members["bundle"], event.members["peer"], event.members["why"]))


def _forgot(claim: Claim, event: Event) -> None:
    claim.forgot = max(claim.forgot, event.members["epoch"])


def _reset(claim: Claim, event: Event) -> None:
    proven = reset_proven(event)
    if proven is not None:
        claim.resets.add((proven, event.members["epoch"]))


def _named(claim: Claim, event: Event) -> None:
    claim.name = event.members["name"], event.at


def _grouped(claim: Claim, event: Event) -> None:
    claim.groups[event.members["group"]] = event.members["member"], event.at


_GATHER: Final[dict[str, Callable[[Claim, Event], None]]] = {
    "pinned": _pinned, "unpinned": _unpinned, "agreed": _agreed, "took": _took, "written": _written, "gave": _gave,
    "undone": _undone, "refused": _refused, "forgot": _forgot, "reset": _reset, "named": _named, "grouped": _grouped,
}  # fmt: skip
"""Signed and vouched digests, statements and liftings are sets of the whole plant, kept beside the claims."""
