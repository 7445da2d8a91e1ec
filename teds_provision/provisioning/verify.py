"""Step 7: everything that the profile demands of a datasheet, check by check (profile.md, "The Security TEDS")."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from teds_provision.errors import BadDataError, BadDatasheetError, NotAuthenticError, TedsProvisionError, UnprovenError
from teds_provision.protocol import datasheet
from teds_provision.protocol.fingerprints import same_key
from teds_provision.protocol.keys import fingerprint, node_key_good, node_key_good_once, other_key
from teds_provision.protocol.messages.identity import Identity
from teds_provision.shapes.verdict import FRESHNESS, PAGES, SESSION, Check, Verification
from teds_provision.station.plant.plant import SignerRules
from teds_provision.station.station import Station
from teds_provision.station.store.records import RevocationRecord, WhitelistEntry
from teds_provision.teds.codec import security
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.security import NotCanonicalError, SecurityTeds
from teds_provision.teds.image import SECURITY, BlockId, Image

if TYPE_CHECKING:
    from teds_provision.protocol.plant.signer import SignerVerdict

# -- the grounds of a verdict: a station's keys, pins and deny list, looked up singly or as a snapshot for many --------


class PinLookup(Protocol):
    """Looks up the key to which a UUID is pinned."""

    def check(self, uuid: bytes, point: bytes) -> None:
        """Raise KeyMismatchError if this UUID is known with another key."""

    def entry(self, uuid: bytes) -> WhitelistEntry | None:
        """Return the whitelist entry of a node."""


class TrustLookup(Protocol):
    """The trusted signers, and the denied nodes."""

    def revocation(self, uuid: bytes) -> RevocationRecord | None:
        """Return why a node is denied, None if it is not."""

    def trusted_cas(self, uuid: bytes | None = None) -> list[bytes]:
        """Return the CA keys that count for a node."""

    def trusted_stations(self) -> list[bytes]:
        """Return the station keys that count."""

    def signing(self, certifier: bytes | None, station_key: bytes, security_teds: bytes) -> SignerVerdict | None:
        """Return the plant's verdict on the signer of this TEDS, or one of this SHA-256; None if it does not apply."""


class TrustSource(Protocol):
    """A station, or what was remembered of one."""

    @property
    def point(self) -> bytes:
        """The station's own key."""

    @property
    def pins(self) -> PinLookup:
        """Pinned keys."""

    @property
    def policy(self) -> TrustLookup:
        """Trust and denials."""


@dataclass(frozen=True)
class _PinSnapshot:
    by_uuid: Mapping[bytes, str]
    entries: Mapping[bytes, WhitelistEntry]

    def check(self, uuid: bytes, point: bytes) -> None:
        pinned = self.by_uuid.get(uuid)
        if pinned is not None and not same_key(pinned, fingerprint(point)):
            raise other_key(pinned, point)

    def entry(self, uuid: bytes) -> WhitelistEntry | None:
        return self.entries.get(uuid)


@dataclass(frozen=True)
class _TrustSnapshot:
    denied: Mapping[bytes, RevocationRecord]
    cas: tuple[bytes, ...]
    cas_of_nodes: Mapping[bytes, bytes]
    stations: tuple[bytes, ...]
    rules: SignerRules | None

    def revocation(self, uuid: bytes) -> RevocationRecord | None:
        return self.denied.get(uuid)

    def trusted_cas(self, uuid: bytes | None = None) -> list[bytes]:
        kept = self.cas_of_nodes.get(uuid) if uuid is not None else None
        return [*self.cas, *([kept] if kept is not None and kept not in self.cas else [])]

    def trusted_stations(self) -> list[bytes]:
        return list(self.stations)

    def signing(self, certifier: bytes | None, station_key: bytes, security_teds: bytes) -> SignerVerdict | None:
        return None if self.rules is None else self.rules.signing(certifier, station_key, security_teds)


@dataclass(frozen=True)
class StationSnapshot:
    """Snapshot of a station's trust: plain data, so that other processes can judge by it too."""

    point: bytes
    pins: _PinSnapshot
    policy: _TrustSnapshot


def snapshot_trust(station: Station) -> StationSnapshot:
    """Take down everything that judging images asks a station for; raises StoreChangedError as the station does."""
    return StationSnapshot(
        station.point,
        _PinSnapshot(station.pins.all(), {entry.uuid: entry for entry in station.pins.whitelist()}),
        _TrustSnapshot(
            {revocation.uuid: revocation for revocation in station.policy.revocations()},
            tuple(station.policy.trusted_cas()),
            _counting(station, station.keys.cas_of_nodes()),
            tuple(station.policy.trusted_stations()),
            station.policy.signer_rules(),
        ),
    )


def snapshot_trust_of(station: Station, uuids: Sequence[bytes]) -> StationSnapshot:
    """Return :func:`snapshot_trust` restricted to a chunk of nodes, to limit memory."""
    entries = station.pins.get_many(uuids)
    return StationSnapshot(
        station.point,
        _PinSnapshot(station.pins.pinned_among(station.nodes.get_many(uuids).values(), entries.values()), entries),
        _TrustSnapshot(
            station.policy.revocations_of(uuids),
            tuple(station.policy.trusted_cas()),
            _counting(station, station.keys.cas_among(uuids)),
            tuple(station.policy.trusted_stations()),
            station.policy.signer_rules(),
        ),
    )


def _counting(station: Station, cas: Mapping[bytes, bytes]) -> dict[bytes, bytes]:
    """Return those of the nodes' CAs in which trust has not ended; each CA is looked up once."""
    counts = {ca: station.policy.counts(ca) for ca in set(cas.values())}
    return {uuid: ca for uuid, ca in cas.items() if counts[ca]}


@dataclass(frozen=True)
class FreshnessFloor:
    """Lower bounds of a node's datasheet: the node's own values, and those of the last one checked here.

    ``identity`` was read in a session, None if there was none; ``sequence`` and ``key_epoch`` are fields 106 and 107 of
    the newest datasheet with a good signature that this station saw on the node, 0 for none.
    """

    identity: Identity | None = None
    sequence: int = 0
    key_epoch: int = 0


def freshness_floor_of(station: Station, uuid: bytes, identity: Identity | None) -> FreshnessFloor:
    """Return this station's bounds for a node's datasheet: those of the one that the store has of it.

    It is the stored datasheet whose signature is checked here, not the one that was just read. Only signed values
    count: any device could serve the others.
    """
    image = station.datasheets.datasheet(uuid)
    octets = image.security if image is not None else None
    try:
        shown = security.decode(octets) if octets is not None else None
    except BadDataError:
        shown = None
    if image is None or octets is None or shown is None or not shown.signed:
        return FreshnessFloor(identity)
    signers = Signers.from_security_teds(shown)
    counts = _signer(station, signers, _certifier(station, uuid, signers), octets)[0].result == "passed"
    trusted = counts and datasheet.signature_good(shown, octets, uuid)
    return FreshnessFloor(identity, shown.sequence, shown.key_epoch) if trusted else FreshnessFloor(identity)


def verify_image(station: TrustSource, image: Image, *, floor: FreshnessFloor | None = None) -> list[Check]:
    """Check an image as far as octets and this station's trust go; ``floor`` is None for a file judged alone.

    Never raises on any octets.
    """
    return _checks(station, image, _proofs(image), floor)


def verify_images(station: TrustSource, images: Iterable[Image]) -> list[list[Check]]:
    """Return the checks of many files, as :func:`verify_image` makes them of each.

    All signatures are checked in a row. Between the other checks of its image, each one took half as long again: the
    tables of OpenSSL and the Python around them evicted each other from the processor's cache.
    """
    files = list(images)
    return [_checks(station, image, proofs, None) for image, proofs in zip(files, _all_proofs(files), strict=True)]


class _SecurityFields(NamedTuple):
    """Fields of an image's Security TEDS, or why it cannot be parsed (None: there is none), and its signatures."""

    shown: SecurityTeds | NotCanonicalError | None
    node_key: bool = False
    datasheet: bool = False


def _proofs(image: Image) -> _SecurityFields:
    """Read the Security TEDS of an image, and check what needs no trust: fields 102 and 100."""
    return _all_proofs([image])[0]


def _all_proofs(images: Sequence[Image]) -> list[_SecurityFields]:
    """Return the fields of many images: read all, then check the signatures of all nodes, then of all stations."""
    read = [_shown(image) for image in images]
    signed = [
        security.tbs(image.uuid, image.blocks[SECURITY]) if isinstance(shown, SecurityTeds) and shown.signed else None
        for image, shown in zip(images, read, strict=True)
    ]
    # a provisioning checks one image several times, so use the caches; many files are checked once each
    alone = len(images) == 1
    node_good = node_key_good if alone else node_key_good_once
    datasheet_good = datasheet.message_signature_good if alone else datasheet.message_signature_good_once
    node_keys = [
        isinstance(shown, SecurityTeds) and node_good(image.uuid, shown.node_key, shown.node_key_signature)
        for image, shown in zip(images, read, strict=True)
    ]
    datasheets = [
        message is not None and isinstance(shown, SecurityTeds) and datasheet_good(shown, message)
        for shown, message in zip(read, signed, strict=True)
    ]
    return list(map(_SecurityFields, read, node_keys, datasheets))


def _shown(image: Image) -> _Shown:
    """Read the Security TEDS of an image, or return why it cannot be read (None: there is none)."""
    octets = image.security
    try:
        return None if octets is None else security.decode(octets)
    except NotCanonicalError as error:
        return error


def _checks(station: TrustSource, image: Image, proofs: _SecurityFields, floor: FreshnessFloor | None) -> list[Check]:
    return judge(
        station,
        image.uuid,
        _own_checks_and_freshness(image, proofs, floor),
        Signers.from_security_teds(proofs.shown),
        image.security,
    )


class Signers(NamedTuple):
    """Fields 101 to 104 of a Security TEDS, to be checked by today's pins and trust; None if absent."""

    node_key: bytes | None = None
    node_key_signature: bytes | None = None
    station_key: bytes | None = None
    station_key_signature: bytes | None = None

    @classmethod
    def from_security_teds(cls, shown: SecurityTeds | NotCanonicalError | None) -> Signers:
        """Return the signers of a Security TEDS; none if it is absent or not of this profile."""
        if not isinstance(shown, SecurityTeds):
            return cls()
        signed = (shown.station_key, shown.station_key_signature) if shown.signed else (None, None)
        return cls(shown.node_key, shown.node_key_signature, *signed)


def static_checks(image: Image, floor: FreshnessFloor | None) -> tuple[list[Check], Signers]:
    """Return the checks that no later change of trust alters, and the input of :func:`judge` for the others.

    The image's own checks are cached for a moment: both the record of a write and the verdict need them.
    """
    cached = next((cached for asked, cached in tuple(_CHECKED) if asked is image), None)
    if cached is None:
        proofs = _proofs(image)
        cached = proofs.shown, _own_checks(image, proofs)
        _CHECKED.append((image, cached))
    shown, checks = cached
    return [*checks, *_not_older(shown, floor)], Signers.from_security_teds(shown)


_Shown = SecurityTeds | NotCanonicalError | None
_CHECKED: Final[deque[tuple[Image, tuple[_Shown, tuple[Check, ...]]]]] = deque(maxlen=4)


def judge(
    station: TrustSource, uuid: bytes, own_checks: Iterable[Check], signers: Signers, security_teds: bytes | None
) -> list[Check]:
    """Return all checks: the datasheet's ``own_checks``, which trust does not alter, and today's pins, bans and trust.

    ``security_teds``: the TEDS itself or its SHA-256, by which the plant's stations name what they signed.
    """
    checks = {check[0]: check for check in own_checks}
    if signers.node_key is not None:
        if "node key" not in checks:
            checks["node key"] = _pinned(station, uuid, signers.node_key)
        checks["not revoked"] = _not_revoked(station, uuid)
    if signers.station_key is not None:
        certifier = _certifier(station, uuid, signers)
        checks |= {check.name: check for check in _signer(station, signers, certifier, security_teds)}
        checks["station certificate"] = _certificate(station, signers, certifier)
    return [checks[name] for name in _ORDER if name in checks]


_ORDER: Final = (
    "form", "canonical form", "algorithms", "node key", "key epoch", "sequence", "not revoked", "signed",
    "signing station", PAGES, "station certificate", "signature", "signed TEDS", "every TEDS is signed", "UUID",
    "possession", SESSION,
)  # fmt: skip
ABOUT_THE_REST: Final = frozenset({"form", "signed TEDS", "every TEDS is signed", "UUID"})
"""Checks of other TEDS than the Security TEDS."""


def _own_checks_and_freshness(image: Image, proofs: _SecurityFields, floor: FreshnessFloor | None) -> list[Check]:
    return [*_own_checks(image, proofs), *_not_older(proofs.shown, floor)]


def _not_older(shown: _Shown, floor: FreshnessFloor | None) -> list[Check]:
    """Check that a datasheet is not older than what is known of its node."""
    return [_epoch(shown, floor), _sequence(shown, floor)] if isinstance(shown, SecurityTeds) else []


def _own_checks(image: Image, proofs: _SecurityFields) -> tuple[Check, ...]:
    """Return the checks of an image that need no other knowledge."""
    shown = proofs.shown
    checks = [_form(image, known_good=SECURITY if isinstance(shown, SecurityTeds) else None)]
    if shown is None:
        return (*checks, Check("signed", "failed", "the image has no Security TEDS"))
    if isinstance(shown, NotCanonicalError):
        ours = security.has_profile_version(image.blocks[SECURITY])
        why = shown.message if ours else "the Security TEDS does not follow this profile: shown, never trusted"
        return (*checks, Check("canonical form", "failed", why))
    checks += [_CANONICAL, _algorithms(shown)]
    if not proofs.node_key:
        checks.append(Check("node key", "failed", "field 102 does not sign this key for this UUID"))
    if not shown.signed:
        return (*checks, Check("signed", "failed", "this is the initial Security TEDS, which is not signed yet"))
    checks += [_SIGNED, _GOOD_SIGNATURE if proofs.datasheet else _BAD_SIGNATURE, *_listed(image, shown), _meta(image)]
    return tuple(checks)


def possession_check(prove: Callable[[], None]) -> Check:
    """Run the challenge and return it as a check; a link that fails is raised, not judged."""
    try:
        prove()
    except NotAuthenticError as error:
        return Check("possession", "failed", error.message)
    return Check("possession", "passed", "the node signed a fresh challenge")


def session_check(opened: str, why: str) -> Check:
    """Return the check that the TEDS came from the node: ``opened`` is the evidence, ``why`` the reason of a failure.

    Both empty: no key of the node is held here, and signatures alone count.
    """
    if opened:
        return Check(SESSION, "passed", opened)
    if why:
        return Check(SESSION, "failed", why)
    return Check(SESSION, "skipped", "this station holds no key of this node")


def unproven(uuid: bytes, why: str) -> UnprovenError:
    """Return the error (exit 5) if a key of the node is held and the origin is unproven.

    Neither a session nor the node's signature proves it.
    """
    return UnprovenError(
        f"Nothing could be proven about node {uuid.hex()}: {why}.",
        hint="Data received outside a session may be a replay. Try it on the reader; to take a node over: agree"
        " --rotate",
    )


def require_authentic(verified: Verification) -> None:
    """Raise NotAuthenticError (exit 4), or UnprovenError (5), unless the verdict is ``authentic``.

    Names the first failure.
    """
    if verified.verdict == "authentic":
        return
    failed = {check.name: check for check in reversed(verified.checks) if check.result == "failed"}
    if verified.verdict == "unproven" and PAGES in failed:
        raise UnprovenError(
            f"Nothing could be proven about the datasheet of node {verified.uuid.hex()}: {failed[PAGES].why}.",
            hint="To get the missing pages: registry sync, or registry sync --files DIR from a station that has them",
        )
    if verified.verdict == "unproven":
        raise unproven(verified.uuid, failed[SESSION].why)
    in_order = list(reversed(failed.values()))
    reason = next((check for check in in_order if check.name in FRESHNESS), in_order[0])
    raise BadDatasheetError(f"The datasheet is {verified.verdict}: {reason.why or reason.name}.")


def _check(name: str, holds: bool, why: str, good: str = "") -> Check:
    return Check(name, "passed", good) if holds else Check(name, "failed", why)


_CANONICAL: Final = Check("canonical form", "passed")
_SIGNED: Final = Check("signed", "passed")
_OUR_ALGORITHMS: Final = Check("algorithms", "passed", "ECDSA P-256, SHA-256, AES-128")


def _form(image: Image, known_good: BlockId | None) -> Check:
    """Check length, checksum and class of every TEDS but ``known_good``, which was decoded."""
    blocks = image.blocks
    bad = [id for id in blocks if id != known_good and not datasheet.passes_own_check(id, blocks[id])]
    if not bad:
        return Check("form", "passed", f"{len(blocks)} TEDS")
    why = ", ".join(f"TEDS {code} of channel {channel}" for channel, code in sorted(bad))
    return Check("form", "failed", f"length, checksum or class is wrong: {why}")


def _algorithms(shown: SecurityTeds) -> Check:
    if shown.values == security.OUR_VALUES:
        return _OUR_ALGORITHMS
    wrong = [number for number, value in security.OUR_VALUES.items() if shown.values[number] != value]
    why = "weak or unknown algorithm in field " + ", ".join(map(str, wrong))
    if other := security.other_wire(shown):
        why = f"it names {other}"
    return Check("algorithms", "failed", why)


def _pinned(station: TrustSource, uuid: bytes, node_key: bytes) -> Check:
    name = "node key"
    try:
        station.pins.check(uuid, node_key)
        entry = station.pins.entry(uuid)
    except TedsProvisionError as error:
        return Check(name, "failed", error.message)
    pinned = "pinned" if entry is not None and entry.fingerprint else "not pinned here"
    return Check(name, "passed", f"{fingerprint(node_key)[:16]}, {pinned}")


_FILE_ALONE = "a file does not show the node's current state"
_NO_EPOCH: Final = Check("key epoch", "skipped", _FILE_ALONE)
_NO_SEQUENCE: Final = Check("sequence", "skipped", _FILE_ALONE)


def _epoch(shown: SecurityTeds, floor: FreshnessFloor | None) -> Check:
    name = "key epoch"
    if floor is None:
        return _NO_EPOCH
    if floor.identity is not None and shown.key_epoch > floor.identity.epoch:
        why = f"signed for epoch {shown.key_epoch}, but the node is at {floor.identity.epoch}"
        return Check(name, "failed", why)
    why = f"signed for epoch {shown.key_epoch}, older than the {floor.key_epoch} that this station saw"
    return _check(name, shown.key_epoch >= floor.key_epoch, why, str(shown.key_epoch))


def _sequence(shown: SecurityTeds, floor: FreshnessFloor | None) -> Check:
    name = "sequence"
    if floor is None:
        return _NO_SEQUENCE
    if floor.identity is not None and shown.sequence < floor.identity.sequence:
        own = floor.identity.sequence
        why = f"sequence {shown.sequence} is older than the node's own {own}: an old datasheet was restored"
        return Check(name, "failed", why)
    why = f"sequence {shown.sequence} is older than the {floor.sequence} that this station saw on the node"
    return _check(name, shown.sequence >= floor.sequence, why, str(shown.sequence))


def _not_revoked(station: TrustSource, uuid: bytes) -> Check:
    revoked = station.policy.revocation(uuid)
    return _check("not revoked", revoked is None, f"revoked: {revoked.why}" if revoked else "")


def _certifier(station: TrustSource, uuid: bytes, signers: Signers) -> bytes | None:
    """Return the trusted CA that signed field 104, None if none did."""
    for ca in station.policy.trusted_cas(uuid):
        if datasheet.is_certified(ca, signers.station_key, signers.station_key_signature):
            return ca
    return None


def _station(station: TrustSource, signers: Signers, certifier: bytes | None) -> Check:
    key = signers.station_key or b""
    digits = fingerprint(key)[:16]
    return _check(
        "signing station",
        certifier is not None or key in station.policy.trusted_stations(),
        f"station {digits} is neither trusted here nor certified by a trusted CA",
        digits,
    )


def _signer(
    station: TrustSource, signers: Signers, certifier: bytes | None, security_teds: bytes | None
) -> tuple[Check, ...]:
    """Check that the station that signed counts; in a plant by its roster and pages, which may not be here yet."""
    key = signers.station_key or b""
    signer = station.policy.signing(certifier, key, security_teds or b"")
    if signer is None:
        return (_station(station, signers, certifier),)
    name, digits = "signing station", fingerprint(key)[:16]
    if signer.result == "unproven":
        return (Check(name, "skipped", digits), Check(PAGES, "failed", signer.why))
    why = f"{digits}, {signer.why}" if signer.why and signer.result == "passed" else signer.why or digits
    return (Check(name, signer.result, why),)


def _certificate(station: TrustSource, signers: Signers, certifier: bytes | None) -> Check:
    name = "station certificate"
    if certifier is not None:
        return Check(name, "passed", f"CA {fingerprint(certifier)[:16]}")
    if signers.station_key == station.point or signers.station_key not in station.policy.trusted_stations():
        return Check(name, "failed", "field 104 matches no trusted CA")
    return Check(name, "skipped", "the station itself is trusted; its CA is not known here")


_GOOD_SIGNATURE: Final = Check("signature", "passed")
_BAD_SIGNATURE: Final = Check(
    "signature", "failed", "field 100 does not verify: the datasheet was changed or belongs to another node"
)
_ALL_LISTED: Final = Check("every TEDS is signed", "passed")
_RIGHT_META: Final = Check("UUID", "passed")
_WRONG_META: Final = Check("UUID", "failed", "the Meta-TEDS names another")


def _listed(image: Image, shown: SecurityTeds) -> tuple[Check, Check]:
    """Check that field 108 names the TEDS that are here, all of them and no others."""
    found = datasheet.digests(image.blocks)
    if found == shown.signed_blocks:
        return Check("signed TEDS", "passed", f"{len(found)} digests"), _ALL_LISTED
    return _blocks(found, shown), _unlisted(image, shown)


def _blocks(found: Mapping[BlockId, bytes], shown: SecurityTeds) -> Check:
    wrong = [block for block, digest in shown.signed_blocks.items() if found.get(block) != digest]
    why = ", ".join(f"TEDS {code} of channel {channel} is missing or changed" for channel, code in wrong)
    return _check("signed TEDS", not wrong, why, f"{len(shown.signed_blocks)} digests")


def _unlisted(image: Image, shown: SecurityTeds) -> Check:
    extra = sorted(image.blocks.keys() - shown.signed_blocks.keys() - {SECURITY})
    why = ", ".join(f"TEDS {code} of channel {channel} is unsigned" for channel, code in extra)
    return _check("every TEDS is signed", not extra, why)


def _meta(image: Image) -> Check:
    metas = [teds for (_, code), teds in image.blocks.items() if code == AccessCode.META]
    return _RIGHT_META if all(datasheet.meta_names(teds, image.uuid) for teds in metas) else _WRONG_META
