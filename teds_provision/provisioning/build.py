"""Step 4: the TEDS of a node from its profile and calibration, and the Security TEDS still unsigned.

A node that has a datasheet gets only what the user just asked for. Anything else (a trial build, a run that
was cut, a newer profile, another datasheet than this station remembers) is shown as the changes in physical units and
asked about; the store never silently wins over the node.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Final

from teds_provision import teds
from teds_provision.errors import (
    BadDataError,
    CalibrationMisfitError,
    NotFoundError,
    PolicyError,
    TedsProvisionError,
    UsageError,
)
from teds_provision.files import read_limited
from teds_provision.protocol import datasheet
from teds_provision.provisioning.adoption import read_factory_datasheet
from teds_provision.provisioning.board_type import (
    Retype,
    differences,
    is_remembered,
    require_board_type,
    topic_warnings,
)
from teds_provision.provisioning.calibration_guard import guard, is_calibrated, merged
from teds_provision.provisioning.sign import known_node_keys, unsigned_security
from teds_provision.provisioning.teds_read import NodeSnapshot
from teds_provision.provisioning.verify import FreshnessFloor, verify_image
from teds_provision.sanitize import printable
from teds_provision.shapes.verdict import Verification
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft, NodeRecord
from teds_provision.teds import calibration as calibrating
from teds_provision.teds import guard as guarding
from teds_provision.teds.calibration import Calibration
from teds_provision.teds.certificate import CertificateChoice, CertificateReference, ChooseItem
from teds_provision.teds.codec import security
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.diff import Change, diff_blocks
from teds_provision.teds.image import SECURITY, BlockId, Image
from teds_provision.teds.profile import BuiltDatasheet, Profile
from teds_provision.teds.profile.load import (
    default_folders,
    files_digest,
    find_profile,
    is_profile_name,
    load_profile,
    passed_over,
)
from teds_provision.teds.profile.reader import NAME_OCTETS
from teds_provision.teds.sheet import Sheet, described

# -- the order: profile, calibration, name; read, fitted and guarded before waiting for a node -------------------------

_UUID, _COUNT = "{uuid}", "{n}"
_MOST_PEM: Final = 1 << 20
_NOBODY: Final = bytes(10)


@dataclass(frozen=True)
class BuildOrder:
    """The user's order: profile (None: the one that the node had), calibration file, name, and overrides.

    ``name`` may hold ``{uuid}`` (20 hex digits) or ``{n}`` (the first free number from 1). ``accept_calibration`` is
    the reason given for a calibration that the guard would refuse. ``channel`` is the one that the calibration is for
    (None: as its file states), ``due`` when the next one is due. Of a certificate ``item`` is the result to use,
    ``choose`` is called if several fit, and ``trusted`` are the files with certificates (PEM) of its signers.
    """

    profile: str | None = None
    calibration: Path | None = None
    name: str | None = None
    drop_calibration: bool = False
    accept_calibration: str | None = None
    retype: bool = False  # the board may become another type than it reports
    adopt: bool = False  # sign the factory datasheet, confirmed by the operator
    channel: int | None = None
    item: str | None = None
    trusted: tuple[Path, ...] = ()
    due: datetime | None = None
    choose: ChooseItem | None = field(default=None, compare=False)

    @property
    def names_nothing(self) -> bool:
        """True if no value of the datasheet is named."""
        return self.profile is None and self.calibration is None and self.name is None and not self.drop_calibration

    @property
    def has_pattern(self) -> bool:
        """True if each node gets a different name."""
        return self.name is not None and (_UUID in self.name or _COUNT in self.name)


@dataclass(frozen=True)
class PreparedOrder:
    """A validated order: its profile, and the calibrations of its file, fitted; None if unnamed.

    ``warnings`` are those of the guard and about the order.
    """

    order: BuildOrder
    profile: Profile | None = None
    calibrations: Mapping[int, Calibration] | None = None
    warnings: tuple[str, ...] = ()
    passed: tuple[str, ...] = ()
    """A notice about the place of the profile."""


@dataclass(frozen=True)
class ComposedTeds:
    """The TEDS that profile, calibration and name give; ``wanted`` is the profile as it was asked for."""

    profile: Profile
    wanted: str
    name: str | None
    calibrations: Mapping[int, Calibration]
    blocks: Mapping[BlockId, bytes]
    warnings: tuple[str, ...]
    digest: str = ""
    changed: bool = False
    """True if the profile that the node had has changed since its datasheet was made."""


def for_several(order: BuildOrder) -> BuildOrder:
    """Return the order, if it can be meant for more than one node; raises UsageError if all would become equal."""
    if order.name is not None and not order.has_pattern:
        raise UsageError(
            f"Every node would get the name {order.name!r}.",
            hint="Use {uuid} or {n} in --name, or list the boards in a sheet: --batch FILE.",
        )
    if order.calibration is not None:
        raise UsageError(
            f"Every node would get the calibration {order.calibration}: it belongs to one sensor.",
            hint="List the boards in a sheet: --batch FILE.",
        )
    return order


def prepare(station: Station, order: BuildOrder, uuid: bytes | None = None) -> PreparedOrder:
    """Read, fit and guard what an order names; ``uuid`` is the node that is meant, None if any may come.

    Changes nothing. Raises UsageError (no profile known), NotFoundError, BadDataError, PolicyError (the guard).
    """
    check_name(order.name)
    if order.adopt:
        if order.profile is not None or order.calibration is not None or order.drop_calibration:
            raise UsageError(
                "--adopt signs the datasheet that the board brought, so it takes no profile or calibration.",
                hint="Omit --profile and --calibration.",
            )
        return PreparedOrder(order)
    wanted = _absolute_profile(order.profile) or (_known_profile(station, uuid) if uuid is not None else None)
    if order.calibration is not None and not order.calibration.is_file():
        raise NotFoundError(f"There is no calibration file {order.calibration}.")
    if wanted is None:
        if uuid is not None and not order.names_nothing:
            raise no_profile(uuid)
        return PreparedOrder(order)
    profile, passed = _load(station, wanted), _passed_over(station, wanted)
    calibrations = _from_file(order, profile)
    if calibrations is None:
        return PreparedOrder(order, profile, passed=passed)
    made = _built_of(profile, _NOBODY, calibrations, order.name, 2007)
    trial = Image(_NOBODY, dict(made.blocks))
    warnings = guard(station, trial, None, order.accept_calibration, calibrations, profile, record=False)
    return PreparedOrder(order, profile, calibrations, merged(warnings), passed)


def named_for(station: Station, uuid: bytes, prepared: PreparedOrder, *, keep: bool = False) -> PreparedOrder:
    """Return the order with the name that this node gets; raises PolicyError if another node has it.

    ``keep``: a numbered name is kept for this node at once, as others may need theirs at the same time.
    """
    if prepared.order.name is None or _COUNT not in prepared.order.name or not keep:
        return _named_for(station, uuid, prepared)
    with station.durable("name"):
        named = _named_for(station, uuid, prepared)
        station.nodes.remember(uuid, name=named.order.name)
    return named


def _named_for(station: Station, uuid: bytes, prepared: PreparedOrder) -> PreparedOrder:
    name = prepared.order.name
    if name is None:
        return prepared
    name = name.replace(_UUID, uuid.hex())
    if _COUNT in name:
        name = _numbered(station, uuid, name)
    require_free_name(station, uuid, name)
    check_name(name)
    return replace(prepared, order=replace(prepared.order, name=name))


def require_free_name(station: Station, uuid: bytes, name: str) -> None:
    """Raise PolicyError if another node has this name."""
    others = [other for other in station.nodes.all_named(name) if other != uuid]
    if others:
        raise PolicyError(
            f"Node {others[0].hex()} already has the name {name!r}.",
            hint="Choose another name; {uuid} or {n} in --name makes names unique.",
        )


def _numbered(station: Station, uuid: bytes, pattern: str) -> str:
    """Return the pattern with the first number that no other node has; a node that has one keeps it."""
    record = station.nodes.get(uuid)
    mine = record.name if record is not None else None
    number = 1
    while True:
        name = pattern.replace(_COUNT, str(number))
        owners = station.nodes.all_named(name)
        if not owners or owners == [uuid]:
            break
        number += 1
    if mine is not None and mine != name:
        before, _, after = pattern.partition(_COUNT)
        digits = mine.removeprefix(before).removesuffix(after)
        if digits.isdecimal() and mine == pattern.replace(_COUNT, digits):
            return mine
    return name


def compose(
    station: Station,
    uuid: bytes,
    prepared: PreparedOrder,
    has: Image | None,
    *,
    name: str | None = None,
    as_known: bool = True,
    edition: int = 2007,
) -> ComposedTeds:
    """Compose a node's TEDS; ``has`` provides calibrations that the order neither brings nor drops.

    ``name`` is the one to keep if the order names none; ``as_known``: else the one that this station knows. Raises
    UsageError (no profile known), BadDataError.
    """
    order = prepared.order
    wanted = _absolute_profile(order.profile) or _known_profile(station, uuid)
    if wanted is None:
        raise no_profile(uuid)
    profile = prepared.profile or _load(station, wanted)
    passed = prepared.passed if prepared.profile is not None else _passed_over(station, wanted)
    calibrations = prepared.calibrations if prepared.calibrations is not None else _from_file(order, profile)
    warnings: tuple[str, ...] = ()
    if calibrations is None:
        calibrations, warnings = _kept_calibrations(order, has, profile)
    elif order.channel is not None:  # only this channel changes; the others keep their calibration
        others, warnings = _kept_calibrations(order, has, profile, but=order.channel)
        calibrations = dict(sorted({**others, **calibrations}.items()))
    record = station.nodes.get(uuid)
    kept = order.name or name or (record.name if as_known and record is not None else None)
    made, digest = _built_of(profile, uuid, calibrations, kept, edition), digest_of(profile)
    before = record.profile_digest if record is not None else None
    changed = order.profile is None and before is not None and before != digest
    if changed:
        warnings += (f"Profile {wanted} has changed since this node's datasheet was built.",)
    warned = merged((*passed, *warnings, *made.warnings))
    return ComposedTeds(profile, wanted, kept, calibrations, made.blocks, warned, digest, changed)


def digest_of(profile: Profile) -> str:
    """Return the SHA-256 (hex) of a profile with all that it extends: the TEDS that it gives, and its demands."""
    place = ("digest",)
    if place not in profile.composed:  # computed for the first node of this type
        profile.composed[place] = _digest(profile)
    return profile.composed[place].hex()


def profile_files_digest(station: Station, record: NodeRecord | None) -> str | None:
    """Return the SHA-256 (hex) of the files of the profile that a node's datasheet was built of.

    None if no profile is known, its files are gone, or they have changed.
    """
    if record is None or record.profile is None or record.profile_digest is None:
        return None
    folders = default_folders(station.home)
    try:
        path = find_profile(record.profile, folders)
        digest = files_digest(path, folders)
        return digest if _content_of(digest, path, station.home) == record.profile_digest else None
    except TedsProvisionError:  # a file that was moved or is being edited is not an error of the node
        return None


@lru_cache(maxsize=64)
def _content_of(_files: str, path: Path, home: Path) -> str:
    return digest_of(load_profile(path, default_folders(home)))


def content_digests(prepared: PreparedOrder) -> tuple[str, str]:
    """Return SHA-256 (hex) of the profile with all that it extends, and of the fitted calibrations; "" for none."""
    profile, calibrations = prepared.profile, prepared.calibrations
    if profile is None:
        return "", ""
    if calibrations is None:
        return digest_of(profile), ""
    blocks = _built_of(profile, _NOBODY, calibrations, None, 2007).blocks
    wanted = (AccessCode.CALIBRATION, AccessCode.CERTIFICATE)
    fitted = [[*block, octets.hex()] for block, octets in sorted(blocks.items()) if block[1] in wanted]
    return digest_of(profile), hashlib.sha256(json.dumps(fitted).encode()).hexdigest()


def _digest(profile: Profile) -> bytes:
    blocks = _built_of(profile, _NOBODY, {}, None, 2007).blocks
    entries = [[*block, octets.hex()] for block, octets in sorted(blocks.items())]
    demands = [repr(channel.calibration) for channel in profile.channels]
    return hashlib.sha256(json.dumps([entries, demands]).encode()).digest()


def _absolute_profile(profile: str | None) -> str | None:
    """Return a name unchanged, a path as absolute, since the next command may run in another folder."""
    return profile if profile is None or is_profile_name(profile) else str(Path(profile).absolute())


def _kept_calibrations(
    order: BuildOrder, has: Image | None, profile: Profile, *, but: int | None = None
) -> tuple[dict[int, Calibration], tuple[str, ...]]:
    """Return the calibrations that the node has (``but`` of this channel) and the order keeps, and a warning if any.

    Raises CalibrationMisfitError if one was made for another channel than the profile's.
    """
    if order.drop_calibration or has is None:
        return {}, ()
    kept = {number: found for number, found in teds_calibrations(has).items() if number != but}
    if not kept:
        return {}, ()
    require_fit(kept, has, Image(_NOBODY, dict(_built_of(profile, _NOBODY, {}, None, 2007).blocks)), profile)
    numbers = ", ".join(map(str, kept))
    return kept, (
        f"Channel {numbers} keeps its calibration."
        if len(kept) == 1
        else f"Channels {numbers} keep their calibrations.",
    )


def require_fit(kept: Mapping[int, Calibration], has: Image, new: Image, profile: Profile | None = None) -> None:
    """Raise CalibrationMisfitError if a calibration of ``has`` was made for another channel than ``new`` describes."""
    for number, current in kept.items():
        had, now = described(number, has.blocks), described(number, new.blocks)
        own = profile.channel(number) if profile is not None else None
        why = guarding.misfit(current, had, now, own)
        if why:
            raise CalibrationMisfitError(
                f"The calibration of channel {number} that the node has does not fit: {why}.",
                hint="Give this channel a calibration (--calibration FILE), or drop the existing one"
                " (--no-calibration).",
            )


def certificate_brought(calibrations: Mapping[int, Calibration]) -> CertificateReference | None:
    """Return the certificate that was read for these calibrations, None if they come from elsewhere."""
    found = [known.certificate for known in calibrations.values() if known.certificate is not None]
    return next((certificate for certificate in found if certificate.signature), None)


def teds_calibrations(image: Image) -> dict[int, Calibration]:
    """Return the calibrations that an image holds, by channel."""
    if not is_calibrated(image):
        return {}
    return dict(Sheet.from_image(image).calibrations)


def own_name(station: Station, image: Image, before: str | None) -> str | None:
    """Return the node's individual name in its datasheet, None if its profile ``before`` gives it to all."""
    octets = image.blocks.get((0, AccessCode.NAME))
    found = teds.decode(octets).get("TCName") if octets is not None else None
    if not isinstance(found, str) or not found:
        return None
    try:
        common = _load(station, before).tim_name if before is not None else None
    except (BadDataError, NotFoundError):
        common = None
    return None if found == common else printable(found)


def check_name(name: str | None) -> None:
    """Raise UsageError for a name that fits into no TEDS or is not shown whole.

    BadDataError for one that is no text.
    """
    if name is None:
        return
    try:
        octets = len(name.encode())
    except UnicodeEncodeError as error:  # an argument in another encoding than the terminal's
        raise BadDataError(
            "The name of the node is not valid text.", hint="Give it in the terminal's encoding."
        ) from error
    if not 1 <= octets <= NAME_OCTETS:
        raise UsageError(f"A name has 1 to {NAME_OCTETS} octets of UTF-8, this one {octets}.")
    if not name.isprintable():
        raise UsageError(f"A name is one line of printable characters, not {name!r}.")


def _known_profile(station: Station, uuid: bytes) -> str | None:
    record = station.nodes.get(uuid)
    return record.profile if record is not None else None


def no_profile(uuid: bytes) -> UsageError:
    """Return the error for a node without a known profile."""
    return UsageError(f"No profile is known for node {uuid.hex()}.", hint="Add --profile; see: profile list")


def _load(station: Station, wanted: str) -> Profile:
    return load_profile(wanted, default_folders(station.home))


def _passed_over(station: Station, wanted: str) -> tuple[str, ...]:
    return passed_over(wanted, default_folders(station.home))


def _from_file(order: BuildOrder, profile: Profile) -> Mapping[int, Calibration] | None:
    if order.calibration is None:
        return None
    pems = tuple(read_limited(path, _MOST_PEM, "certificate") for path in order.trusted)
    choice = CertificateChoice(order.channel, order.item, pems, order.choose)
    return calibrating.load_calibrations(order.calibration, profile, choice, due=order.due)


def _built_of(
    profile: Profile, uuid: bytes, calibrations: Mapping[int, Calibration], name: str | None, edition: int
) -> BuiltDatasheet:
    return profile.build(uuid, calibration=calibrations, name=name, edition=edition)  # type: ignore[arg-type]


__all__ = ["BuildOrder", "BuildResult", "Proposal", "UnrequestedChangeError", "build", "propose"]


@dataclass(frozen=True)
class BuildResult:
    """A built image (Security TEDS unsigned, or absent if the node's key is not known yet) and its warnings."""

    image: Image
    profile: str
    warnings: tuple[str, ...]
    calibrations: Mapping[int, Calibration] = field(default_factory=dict)


class UnrequestedChangeError(PolicyError):
    """A node's datasheet would change in values that this command did not name, without a confirmation.

    ``changes`` lists them.
    """

    code = "not-named"

    def __init__(self, message: str, changes: tuple[Change, ...], *, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.changes = changes


Confirm = Callable[[bytes, tuple[Change, ...]], None]
"""Asks before a datasheet changes in what was not named: UUID and changes; raises if the answer is no."""


def no_confirmation(uuid: bytes, changes: tuple[Change, ...]) -> None:
    """Refuse, as without a terminal there is no confirmation. Raises UnrequestedChangeError with the changes."""
    shown = " ".join(change.text for change in changes[:3])
    more = f" And {len(changes) - 3} more." if len(changes) > 3 else ""
    raise UnrequestedChangeError(
        f"Node {uuid.hex()} has a different datasheet, and this command does not name what would change: {shown}{more}",
        changes,
        hint="Name it (--profile, --name, --calibration), or drop the draft: teds-provision draft drop UUID.",
    )


def build(
    station: Station,
    uuid: bytes,
    order: BuildOrder,
    *,
    has: Image | None = None,
    edition: int = 2007,
    keep_draft: bool = True,
    retype: Retype | None = None,
) -> BuildResult:
    """Build a node's datasheet as a draft, which only ``sign``, ``write`` or a confirmation bring onto the node.

    If the order brings no calibration, that of an earlier run that never came to write is taken, else the one of the
    node's last reading (``has``: another one's). ``keep_draft`` False changes nothing (dry run).

    ``retype`` is asked if the board, as it was last read, is of another type. Raises NotFoundError (profile, file),
    BadDataError (profile or calibration with errors), WrongBoardError, PolicyError (a calibration that the guard
    refuses).
    """
    prepared = named_for(station, uuid, prepare(station, order, uuid))
    has = has or station.datasheets.datasheet(uuid)
    if has is not None and prepared.profile is not None and not order.retype:
        changes = differences(has.blocks, prepared.profile, prepared.calibrations or ())
        if changes and not is_remembered(station, uuid, order.profile, factory=False):
            (retype or require_board_type)(uuid, changes)
    pending, draft = pending_image(station, uuid, has), station.datasheets.draft(uuid)
    name = own_name(station, pending, draft.profile) if pending is not None and draft is not None else None
    plan = compose(station, uuid, prepared, pending or has, name=name, edition=edition)
    image = Image(uuid, dict(plan.blocks))
    warnings = plan.warnings + guard(
        station, image, has, order.accept_calibration, plan.calibrations, plan.profile, record=keep_draft
    )
    try:
        image = image.with_block(SECURITY, unsigned_security(station, known_node_keys(station, uuid, has), image))
    except NotFoundError:
        warnings += ("The node's key is not known yet: the Security TEDS is added once it is identified.",)
    warnings += topic_warnings(station, has, image)
    built = BuildResult(image, plan.profile.name, merged(warnings), plan.calibrations)
    if not keep_draft:
        return built
    with station.durable("build"):
        # if the node has a datasheet, the store keeps the facts of that one
        if has is None or not has.unsigned_blocks():
            facts = {"profile": plan.wanted, "profile_digest": plan.digest, "name": plan.name}
            station.nodes.remember(uuid, **{fact: value for fact, value in facts.items() if value is not None})
        station.datasheets.keep_draft(Draft(uuid, image, "built", plan.wanted))
        station.audit("build", uuid, "done", profile=built.profile, teds=image.digest())
    return built


@dataclass(frozen=True)
class Proposal:
    """The wanted content of a node: TEDS without the Security TEDS, and whether all of it was ordered.

    ``changes`` are against what it has now; ``profile`` and ``name`` are recorded once it is written, None if
    unchanged.
    """

    image: Image
    changes: tuple[Change, ...]
    named: bool
    warnings: tuple[str, ...] = ()
    profile: str | None = None
    name: str | None = None
    calibrations: Mapping[int, Calibration] = field(default_factory=dict)
    profile_digest: str | None = None

    def require_a_yes(self, confirm: Confirm) -> None:
        """Ask for a confirmation if something changes that was not named."""
        if self.changes and not self.named:
            confirm(self.image.uuid, self.changes)


def propose(station: Station, prepared: PreparedOrder, present: NodeSnapshot, *, record: bool = True) -> Proposal:
    """Return the wanted content of a node that was just read. ``record`` False: for a dry run, without an audit entry.

    Raises UsageError (no profile known), NotFoundError, BadDataError, PolicyError (a calibration that the guard
    refuses).
    """
    has = present.image
    with station.reading():
        proposal = _proposal(station, prepared, present)
    warnings = guard(
        station,
        proposal.image,
        has,
        prepared.order.accept_calibration,
        proposal.calibrations or None,
        prepared.profile if proposal.calibrations else None,
        record=record,
    )
    changes = tuple(diff_blocks(has.unsigned_blocks(), proposal.image.unsigned_blocks()))
    return Proposal(
        proposal.image,
        changes,
        proposal.named,
        merged(proposal.warnings + warnings + topic_warnings(station, has, proposal.image)),
        proposal.profile,
        proposal.name,
        proposal.calibrations,
        proposal.profile_digest,
    )


def _proposal(station: Station, prepared: PreparedOrder, present: NodeSnapshot) -> Proposal:
    """Return the wanted content, by what the node has now and what was ordered; not guarded yet."""
    order = prepared.order
    intact = _intact(station, present)
    # The board has only fixed TEDS from its factory and never had a datasheet.
    if not intact and (order.adopt or order.profile is None) and present.is_fixed:
        return _composed(station, prepared, present, named=True)
    if order.adopt and order.name is None:
        return _as_it_is(station, present)
    if order.adopt:  # its factory datasheet under another name, whatever its type
        brought = read_factory_datasheet(station, present.image, name=order.name)
        return Proposal(brought.image, (), True, name=brought.name or None)
    if not intact:
        return _mended(station, prepared, present) or _composed(
            station, prepared, present, named=order.profile is not None
        )
    if order.names_nothing:
        return _as_it_is(station, present)
    if order.profile is not None:
        return _composed(station, prepared, present, named=True, resume=False)
    return _only_what_is_named(station, prepared, present)


def _intact(station: Station, present: NodeSnapshot) -> bool:
    """Return True if the node's datasheet is authentic for this station, so that its values may be kept."""
    checks = verify_image(station, present.image, floor=FreshnessFloor(present.identity))
    return Verification(present.image.uuid, tuple(checks)).verdict == "authentic"


def _mended(station: Station, prepared: PreparedOrder, present: NodeSnapshot) -> Proposal | None:
    """Return the datasheet that the node was signed for, if it holds something else and nothing else is ordered."""
    octets, uuid = present.image.security, present.image.uuid
    try:
        shown = security.decode(octets) if octets is not None else None
    except BadDataError:
        shown = None
    if octets is None or shown is None or not shown.signed or not prepared.order.names_nothing:
        return None
    for record in station.datasheets.history(uuid):
        blocks = record.image.unsigned_blocks()
        if datasheet.digests(blocks) != shown.signed_blocks:
            continue
        checks = verify_image(
            station, Image(uuid, {**blocks, SECURITY: octets}), floor=FreshnessFloor(present.identity)
        )
        if Verification(uuid, tuple(checks)).verdict == "authentic":
            return Proposal(Image(uuid, blocks), (), named=True)
    return None


def _composed(
    station: Station,
    prepared: PreparedOrder,
    present: NodeSnapshot,
    *,
    named: bool,
    resume: bool = True,
) -> Proposal:
    """Compose all TEDS by profile; ``resume``: with the calibration of a run that stopped before the write."""
    uuid, has = present.image.uuid, present.image
    pending = pending_image(station, uuid, has) if resume else None
    source = station.datasheets.draft(uuid) if pending is not None else station.nodes.get(uuid)
    name = own_name(station, pending or has, source.profile if source is not None else None)
    plan = compose(station, uuid, prepared, pending or has, name=name, as_known=resume)
    image = Image(uuid, {**present.fixed_beside(plan.blocks), **plan.blocks})
    named = named and not plan.changed
    return Proposal(image, (), named, plan.warnings, plan.wanted, plan.name, plan.calibrations, plan.digest)


def _as_it_is(station: Station, present: NodeSnapshot) -> Proposal:
    """Return the node's present content, unless something else was built or signed for it and never written."""
    uuid, has = present.image.uuid, present.image
    pending = pending_image(station, uuid, has)
    if pending is None or pending.unsigned_blocks() == has.unsigned_blocks():
        return Proposal(Image(uuid, has.unsigned_blocks()), (), named=True)
    draft = station.datasheets.draft(uuid)
    blocks = pending.unsigned_blocks()
    image = Image(uuid, {**present.fixed_beside(blocks), **blocks})
    profile = draft.profile if draft is not None else None
    return Proposal(image, (), named=False, profile=profile, name=own_name(station, image, profile))


def _only_what_is_named(station: Station, prepared: PreparedOrder, present: NodeSnapshot) -> Proposal:
    """Return the node's present content, with only those TEDS replaced that differ by the named values."""
    uuid, has = present.image.uuid, present.image
    record = station.nodes.get(uuid)
    name = own_name(station, has, record.profile if record is not None else None)
    asked = compose(station, uuid, prepared, has, name=name, as_known=False)
    unasked = compose(station, uuid, PreparedOrder(BuildOrder(), asked.profile), has, name=name, as_known=False)
    blocks = dict(has.unsigned_blocks())
    for block in {*asked.blocks, *unasked.blocks}:
        wanted = asked.blocks.get(block)
        if wanted == unasked.blocks.get(block) or present.is_read_only(block):
            continue
        if wanted is None:
            blocks.pop(block, None)
        else:
            blocks[block] = wanted
    if prepared.order.name is not None:  # write the name even if the profile gives the same name as before
        blocks[0, AccessCode.NAME] = asked.blocks[0, AccessCode.NAME]
    # Other changes of the profile remain unwritten, so its digest is not updated (no profile_digest here).
    return Proposal(Image(uuid, blocks), (), True, asked.warnings, asked.wanted, asked.name, asked.calibrations)


def pending_image(station: Station, uuid: bytes, has: Image | None) -> Image | None:
    """Return an unwritten image of an earlier run: it determines the intended calibration, not the node."""
    draft = station.datasheets.draft(uuid)
    if draft is None:
        return None
    image = draft.image
    if draft.stage == "signed" and _sequence(image) <= _sequence(has):
        return None
    return image


def unwritten_draft(station: Station, has: Image | None, wanted: Image) -> tuple[str, ...]:
    """Return a warning if the node has a draft that was never written and has other content than ``wanted``.

    ``has`` is the datasheet on the node now. The caller writes ``wanted`` and keeps that draft.
    """
    pending, draft = pending_image(station, wanted.uuid, has), station.datasheets.draft(wanted.uuid)
    if pending is None or draft is None or pending.unsigned_blocks() == wanted.unsigned_blocks():
        return ()
    node, profile = wanted.uuid.hex(), f" as {draft.profile}" if draft.profile else ""
    return (
        f"Node {node} has a draft ({draft.stage}{profile}) that was never written; it is kept, and is no part of this"
        f" datasheet. To drop it: teds-provision draft drop {node}",
    )


def _sequence(image: Image | None) -> int:
    octets = image.security if image is not None else None
    try:
        return security.decode(octets).sequence if octets is not None else -1
    except BadDataError:
        return -1
