"""The reading that each node has in the store, and the verdict that is derived from it.

Every command that reads a node's TEDS keeps the reading here: the digest of each, when, by which command, in which
session. Every verdict is derived from that row, by today's pins, bans and trust (:func:`verdict_of`), so that all
screens agree. Only a reading in a session replaces one made in a session; one without a session, if a key is held, is
shown beside it and changes nothing: a stranger on the bus could have sent it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from functools import lru_cache

from teds_provision.errors import StoreChangedError
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.verify import (
    ABOUT_THE_REST,
    FreshnessFloor,
    Signers,
    TrustSource,
    judge,
    session_check,
    snapshot_trust_of,
    static_checks,
)
from teds_provision.shapes.verdict import MERELY_UNSIGNED, Check, NodeVerdict, Origin, Verification
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeReading, utc_now
from teds_provision.teds.image import SECURITY, Image

_DIGEST = 35  # octets: channel u16, access code u8, SHA-256
_IN_SESSION = "opened with the key held here"


def keep(
    station: Station,
    node: Conversation,
    image: Image,
    *,
    by: str,
    floor: FreshnessFloor | None,
    c: bytes | None = None,
    more: Sequence[Check] = (),
    profile: str | None = None,
) -> NodeVerdict:
    """Keep a whole reading of a node; the datasheet too, if it was read in a session and is worth it.

    ``c`` is that of the session in which the reading began, if the one that is open now may be a later one. ``more``
    are checks that were made at the node. Returns the verdict on this very reading, whether it was kept or not.
    """
    c = (c or node.open_counter) if node.sealed else None
    return keep_read(station, image, c, by=by, floor=floor, more=more, profile=profile)


def keep_read(
    station: Station,
    image: Image,
    c: bytes | None,
    *,
    by: str,
    floor: FreshnessFloor | None,
    more: Sequence[Check] = (),
    profile: str | None = None,
) -> NodeVerdict:
    """Keep as :func:`keep` does; ``c`` is the counter of the session in which it was read, None for none."""
    row, judged = judge_reading(station, image, c, by=by, floor=floor, more=more)
    keep_judged(station, row, judged, image, profile)
    return judged


def judge_reading(
    station: Station,
    image: Image,
    c: bytes | None,
    *,
    by: str,
    floor: FreshnessFloor | None,
    more: Sequence[Check] = (),
) -> tuple[NodeReading, NodeVerdict]:
    """Return the row of a reading and the verdict on it; nothing is kept yet. See :func:`keep_read`."""
    checks, signers = static_checks(image, floor)
    own = [*checks, *more]
    row = NodeReading(image.uuid, utc_now(), by, c, True, _packed(image), *signers, _written(own))
    return row, _judged(station, row, keyed=is_keyed(station, image.uuid))


def keep_judged(
    station: Station, row: NodeReading, judged: NodeVerdict, image: Image, profile: str | None = None
) -> None:
    """Keep what :func:`judge_reading` gave of ``image``."""
    # otherwise the datasheet known so far is kept
    worth = row.in_session and judged.verified.verdict != "not authentic"
    station.datasheets.keep_reading(row, image if worth else None, profile)


def keep_shown(station: Station, uuid: bytes, security_teds: bytes, *, by: str) -> None:
    """Store a Security TEDS that was read outside a session: its key is needed for building; it is not a datasheet."""
    image = Image(uuid, {SECURITY: security_teds})
    signers = static_checks(image, None)[1]
    station.datasheets.keep_reading(NodeReading(uuid, utc_now(), by, None, False, _packed(image), *signers))


def is_known(station: Station, node: Conversation, image: Image) -> bool:
    """Return True if the row has this already: the same TEDS, all of them read since the node last started."""
    row = station.datasheets.reading(image.uuid)
    return (
        row is not None
        and row.whole
        and node.open_counter is not None
        and row.is_of_this_start(node.open_counter)
        and row.digests == _packed(image)
    )


def cached_image_if_current(
    station: Station, node: Conversation, security_teds: bytes, floor: FreshnessFloor
) -> Image | None:
    """Return the datasheet that was read before, if its Security TEDS is the same and it had no fault.

    Every TEDS of field 108 is in it, with the digest that was read last. If the session's c shows a restart since, that
    is recorded: the verdict is ``kept`` then. None: all of it has to be read.
    """
    row, image = station.datasheets.reading(node.uuid), station.datasheets.datasheet(node.uuid)
    if row is None or image is None or not row.in_session or node.open_counter is None:
        return None
    if image.security != security_teds or _packed(image) != row.digests or row.failed - MERELY_UNSIGNED:
        return None
    checks, _ = static_checks(image, floor)
    if {check.name for check in checks if check.result == "failed"} - MERELY_UNSIGNED:
        return None
    if not row.is_of_this_start(node.open_counter):
        station.datasheets.started_anew(node.uuid, node.open_counter)
    return image


def verdict_of(station: Station, uuid: bytes) -> NodeVerdict | None:
    """Return today's verdict on a node from its reading; None if no datasheet of it was read."""
    row = station.datasheets.reading(uuid)
    if row is None or not row.is_datasheet:
        return None
    return _judged(station, row, keyed=is_keyed(station, uuid))


def is_keyed(station: Station, uuid: bytes) -> bool:
    """Return True if a session proves a node here: a key of it is held, and was not given away."""
    return bool(station.keys.held(uuid)) and station.policy.tombstone(uuid) is None


def verdicts_of(station: Station, uuids: Sequence[bytes], keyed: Iterable[bytes]) -> dict[bytes, NodeVerdict]:
    """Return the verdicts of a chunk of nodes as :func:`verdict_of` does; ``keyed`` are those whose key is held."""
    rows = [row for row in station.datasheets.readings_of(uuids).values() if row.is_datasheet]
    if not rows:
        return {}
    held = set(keyed)
    try:
        judging = snapshot_trust_of(station, [row.uuid for row in rows])
    except StoreChangedError:  # another program changed a pin: only that node loses its verdict
        found = {row.uuid: _judged_or_not(station, row, keyed=row.uuid in held) for row in rows}
    else:
        found = {row.uuid: _judged(judging, row, keyed=row.uuid in held) for row in rows}
    return found


def _judged_or_not(station: Station, row: NodeReading, *, keyed: bool) -> NodeVerdict:
    try:
        return _judged(station, row, keyed=keyed)
    except StoreChangedError as error:
        return NodeVerdict(
            Verification(row.uuid, (Check("node key", "failed", error.message),)), "plain", row.at, row.by
        )


def _judged(station: TrustSource, row: NodeReading, *, keyed: bool) -> NodeVerdict:
    signers = Signers(row.node_key, row.node_key_signature, row.station_key, row.station_key_signature)
    checks = judge(station, row.uuid, _read(row.checks), signers, digests_of(row).get(SECURITY))
    # a row that this program did not write
    if row.station_key is None and all(check.result != "failed" for check in checks):
        checks.append(Check("signed", "failed", "it does not say who signed it"))
    if not any(check.name == "session" for check in checks):
        why = "its datasheet was last read outside a session" if keyed else ""
        checks.append(session_check(_IN_SESSION if row.in_session else "", why))
    if not row.whole:
        checks = [check._replace(kept=True) if check.name in ABOUT_THE_REST else check for check in checks]
    origin: Origin = "plain" if not row.in_session else "session" if row.whole else "kept"
    return NodeVerdict(Verification(row.uuid, tuple(checks)), origin, row.at, row.by)


def digests_of(row: NodeReading) -> dict[tuple[int, int], bytes]:
    """Return the digest of each TEDS that was read, by channel and access code."""
    places = range(0, len(row.digests), _DIGEST)
    parts = [row.digests[place : place + _DIGEST] for place in places]
    return {(int.from_bytes(part[:2], "big"), part[2]): part[3:] for part in parts}


def _packed(image: Image) -> bytes:
    return b"".join(
        channel.to_bytes(2, "big") + bytes([code]) + hashlib.sha256(image.blocks[channel, code]).digest()
        for channel, code in image
    )


def _written(checks: Iterable[Check]) -> str:
    return json.dumps([[check.name, check.result, check.why] for check in checks], separators=(",", ":"))


@lru_cache(maxsize=1024)
def _read(text: str) -> tuple[Check, ...]:
    """Parse the checks of a row; cached, as most nodes of a plant have the same."""
    return tuple(Check(name, result, why) for name, result, why in json.loads(text))
