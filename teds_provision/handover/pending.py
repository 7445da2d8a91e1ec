"""Pending handovers: the stored record of a bundle, the receipt that closes it, and undoing a move.

A bundle that left is ``open`` until its receipt comes (``closed``), it is taken back (``undone``), or, for a copy, its
parcel is given up (``dropped``; a receipt that comes all the same closes it). One that came is ``imported``.
:class:`BundleNotes` holds what the columns of the table do not.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import datetime
from operator import attrgetter
from typing import Any

from teds_provision.errors import BadDataError, NotAuthenticError, NotFoundError, PolicyError
from teds_provision.protocol.handover.bundle import CLOCK_TOLERANCE, Bundle
from teds_provision.protocol.handover.receipt import Receipt, open_receipt
from teds_provision.protocol.handover.strict_json import decode_base64url, load_object
from teds_provision.sanitize import counted
from teds_provision.station.station import Station
from teds_provision.station.store.database import chunks
from teds_provision.station.store.records import Handover, Holder

OPEN, CLOSED, UNDONE, DROPPED, IMPORTED = "open", "closed", "undone", "dropped", "imported"


@dataclass(frozen=True)
class BundleNotes:
    """Notes kept with a bundle: its nodes (UUIDs in hex), one digest of its content, and its files.

    ``files`` are the SHA-256 of every file that was sealed with this content, and of what was signed in each: sealing
    again gives other octets. ``keys`` are the ids of the keys that left, one for each node (empty in rows of version
    1); ``run`` is the id of the first bundle made by the same command. ``created`` and ``expires`` are those of the
    newest file (``created`` is empty in rows of version 0.2); no receiver takes the files in ``stale`` any more.
    """

    uuids: tuple[str, ...]
    content: str
    ca: str
    expires: str
    files: tuple[str, ...] = ()
    refused: tuple[tuple[str, str], ...] = ()
    keys: tuple[str, ...] = ()
    run: str = ""
    created: str = ""
    stale: tuple[str, ...] = ()

    def to_json(self) -> str:
        """Return what the store keeps."""
        return json.dumps(vars(self))

    @classmethod
    def from_json(cls, text: str) -> BundleNotes:
        """Read what :meth:`to_json` gave."""
        members: dict[str, Any] = json.loads(text)
        refused = tuple((str(uuid), str(why)) for uuid, why in members["refused"])
        return cls(
            tuple(members["uuids"]),
            members["content"],
            members["ca"],
            members["expires"],
            tuple(members["files"]),
            refused,
            tuple(members.get("keys", ())),
            members.get("run", ""),
            members.get("created", ""),
            tuple(members.get("stale", ())),
        )

    def why_stale(self, now: datetime) -> str:
        """Return why no receiver would take the newest file at ``now``; "" if it would."""
        if datetime.fromisoformat(self.expires) <= now:
            return f"expired at {self.expires}"
        if self.created and datetime.fromisoformat(self.created) > now + CLOCK_TOLERANCE:
            return f"is dated {self.created}, in the future"
        return ""


def content_digest(
    sender: str, to: Iterable[str], mode: str, ca: bytes, nodes: Iterable[tuple[bytes, str, int]]
) -> str:
    """Return a digest that identifies a handover: sender, receivers, mode, CA, and keys (UUID, keyId, epoch).

    No time and no id: the same command gives the same digest again. Key ids are public, keys are not in it. ``nodes``
    ascend by UUID. The digest is over JSON, which is streamed and never built as a whole.
    """
    digest = hashlib.sha256(
        json.dumps([sender, sorted(to), mode, ca.hex()], separators=(",", ":")).encode()[:-1] + b",["
    )
    comma = ""
    for chunk in chunks(nodes):
        # JSON put together by hand for speed: there may be ten thousand nodes, and hex digits and numbers need no
        # quoting.
        listed = [f'["{uuid.hex()}","{identifier}",{epoch}]' for uuid, identifier, epoch in chunk]
        digest.update(f"{comma}{','.join(listed)}".encode())
        comma = ","
    digest.update(b"]]")
    return digest.hexdigest()


def digest_of(bundle: Bundle) -> str:
    """Return :func:`content_digest` of an opened bundle."""
    ascending = sorted(bundle.nodes, key=attrgetter("uuid"))
    nodes = ((node.uuid, node.kid, node.epoch) for node in ascending)
    return content_digest(bundle.sender, bundle.to, bundle.mode, bundle.ca, nodes)


def peer_name(station: Station, fingerprint: str) -> str:
    """Name under which a station is trusted, else the first digits of its fingerprint."""
    for record in station.policy.trusted("station"):
        if record.fingerprint == fingerprint:
            return record.name
    return fingerprint[:16]


def find_handover(station: Station, text: str) -> Handover:
    """Return the bundle that left under this id, or its first digits; raises NotFoundError."""
    fits = [row for row in station.handovers.all() if row.direction == "out" and row.id.startswith(text.lower())]
    if len(fits) != 1 or len(text) < 4:
        raise NotFoundError(f"No outgoing handover matches {text!r}.", hint="See: teds-provision handover list")
    return fits[0]


@dataclass(frozen=True)
class UndoResult:
    """A move taken back: its nodes, and whether there was anything to do."""

    row: Handover
    uuids: tuple[bytes, ...]
    fresh: bool


def undo(station: Station, row: Handover) -> UndoResult:
    """Take a move back before its receipt: the keys may be used again, and the next contact rotates them.

    The receiver may have the bundle all the same; until the rotation it can use the keys. Raises PolicyError for a
    copy and for a move whose receipt came.
    """
    uuids = tuple(bytes.fromhex(uuid) for uuid in BundleNotes.from_json(row.nodes).uuids)
    if row.mode == "copy":
        raise PolicyError(
            "A copy cannot be undone: the other station holds the keys.",
            hint="To replace them: teds-provision agree UUID --rotate",
        )
    if row.state == CLOSED:
        raise PolicyError(
            f"The receipt of this move has arrived: station {peer_name(station, row.peers[0])} holds the keys now.",
            hint="Have the nodes handed back: export-keys there, import-keys here.",
        )
    if row.state == UNDONE:
        return UndoResult(row, uuids, fresh=False)
    with station.transaction():
        for uuid in uuids:
            _lift(station, uuid, row)
            station.plant.record_event("undone", uuid, bundle=row.id, peer=row.peers[0], why="taken back")
        station.handovers.put(replace(row, state=UNDONE))
        station.audit("handover", None, "undone", handover=row.id, nodes=[uuid.hex() for uuid in uuids])
    return UndoResult(row, uuids, fresh=True)


@dataclass(frozen=True)
class CloseResult:
    """A bundle whose receipt came: what the receiver took in and what not; ``fresh`` False when it came before."""

    row: Handover
    receipt: Receipt
    fresh: bool


def close(station: Station, octets: bytes, *, dry_run: bool = False) -> CloseResult:
    """Take in the receipt of a bundle that left here; a move is then over: its keys are deleted.

    ``dry_run`` returns and raises the same, and changes nothing.

    Only the keys that were in the bundle are deleted, and only while this very move is open: a receipt that comes after
    the node's return deletes nothing. A copy for several stations is closed when each has sent its receipt.

    Nodes that the receiver refused come back to this station, to be rotated at the next contact. Raises
    NotAuthenticError (signature, sender, another file), PolicyError (not ours, undone), NotFoundError (unknown id),
    BadDataError.
    """
    receipt = open_receipt(octets, station.policy.station_points().get)
    row = station.handovers.get(receipt.id, "out")
    if row is None:
        raise NotFoundError(
            f"No bundle {receipt.id} left this station.", hint="Give the receipt to the bundle's sender."
        )
    _check_receipt(station, row, receipt)
    text = octets.strip().decode("ascii")
    texts = (row.receipt or "").split()
    if receipt.sender in map(signer_of, texts) or (row.state == CLOSED and row.mode == "move"):
        return CloseResult(row, receipt, fresh=False)
    if row.state == UNDONE:
        if not dry_run:
            station.audit("handover", None, "receipt of an undone move", handover=row.id)
        raise PolicyError(
            f"This move was undone here, but station {peer_name(station, receipt.sender)} took"
            f" {counted(len(receipt.imported), 'key')} in all the same.",
            hint="Rotate them at once: teds-provision agree UUID --rotate. Or export the move again.",
        )
    texts.append(text)
    state = CLOSED if len(texts) >= len(row.peers) else row.state
    closed = replace(row, state=state, receipt="\n".join(texts))
    if dry_run:
        return CloseResult(closed, receipt, fresh=True)
    with station.transaction():
        _settle(station, row, receipt)
        station.handovers.put(closed)
        detail = {"handover": row.id, "imported": len(receipt.imported), "refused": len(receipt.refused)}
        station.audit("handover", None, "receipt", state=state, **{"from": receipt.sender}, **detail)
    return CloseResult(closed, receipt, fresh=True)


def _settle(station: Station, row: Handover, receipt: Receipt) -> None:
    """Update the holders of each key from what the receiver accepted and refused."""
    if row.mode == "move":
        _delete_what_left(station, row, receipt.imported)
    for refused in receipt.refused:
        if row.mode == "move":
            _lift(station, refused.uuid, row)
        else:
            station.keys.remove_holder(refused.uuid, receipt.sender)
        station.plant.record_event("undone", refused.uuid, bundle=row.id, peer=receipt.sender, why="refused")


def _delete_what_left(station: Station, row: Handover, uuids: Iterable[bytes]) -> None:
    """Delete the keys that were in the bundle, of the nodes that rest because of this very move."""
    notes = BundleNotes.from_json(row.nodes)
    left = dict(zip(notes.uuids, notes.keys, strict=False))
    for uuid in uuids:
        tombstone = station.policy.tombstone(uuid)
        if tombstone is None or tombstone.handover_id != row.id:
            continue
        for key in station.keys.keys_of(uuid):
            # Rows of version 1 do not name the keys: then assume those that existed when the bundle was made.
            in_bundle = left.get(uuid.hex(), "") or (key.key_id if key.created <= row.created else "")
            if key.key_id == in_bundle:
                station.keys.remove_key(uuid, key.key_id)
        station.datasheets.drop_draft(uuid)


def signer_of(text: str) -> str:
    """Return the signer of a receipt or revocation that was verified on arrival, "" if it cannot be parsed."""
    try:
        return str(load_object(decode_base64url(text.split(".")[1], "The receipt"), "The receipt").get("from", ""))
    except (BadDataError, IndexError):
        return ""


def refused_in(text: str) -> frozenset[str]:
    """Return the nodes (UUIDs in hex) that a receipt, verified on arrival, names as not taken in."""
    try:
        refused = load_object(decode_base64url(text.split(".")[1], "The receipt"), "The receipt").get("refused", [])
    except (BadDataError, IndexError):
        return frozenset()
    return frozenset(str(node["uuid"]).lower() for node in refused)


def _check_receipt(station: Station, row: Handover, receipt: Receipt) -> None:
    notes = BundleNotes.from_json(row.nodes)
    if receipt.to != station.fingerprint or receipt.sender not in row.peers:
        raise PolicyError(
            f"The receipt is between {receipt.to[:16]} and {receipt.sender[:16]}, not between this station and one"
            " that the bundle was sealed to."
        )
    if receipt.bundle_sha256 not in notes.files:
        raise NotAuthenticError("The receipt is for another bundle than any that left here under this id.")
    named = [uuid.hex() for uuid in receipt.imported] + [refused.uuid.hex() for refused in receipt.refused]
    if sorted(named) != sorted(notes.uuids):
        raise NotAuthenticError("The receipt names other nodes than the bundle.")


def _lift(station: Station, uuid: bytes, row: Handover) -> None:
    """Let a resting key be used again; as another station may have it, a new one is due first."""
    tombstone = station.policy.tombstone(uuid)
    if tombstone is not None and tombstone.handover_id == row.id:
        station.policy.take_back([uuid])
        station.keys.demand_rotation(uuid, f"the move {row.id} did not happen")
        station.keys.put_holder(Holder(uuid, row.peers[0], mode="move"))


@dataclass(frozen=True)
class ListedHandover:
    """One line of ``handover list``."""

    row: Handover
    peers: tuple[str, ...]
    count: int
    expires: str
    expired: bool


def list_handovers(station: Station, now: datetime) -> list[ListedHandover]:
    """Return every bundle that left or came, oldest first.

    ``expired`` marks open ones that can no longer be imported.
    """
    names = {record.fingerprint: record.name for record in station.policy.trusted("station")}
    listed = []
    for row in station.handovers.all():
        notes = BundleNotes.from_json(row.nodes)
        expired = row.state == OPEN and datetime.fromisoformat(notes.expires) <= now
        peers = tuple(names.get(peer, peer[:16]) for peer in row.peers)
        listed.append(ListedHandover(row, peers, len(notes.uuids), notes.expires, expired))
    return listed
