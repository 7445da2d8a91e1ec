"""Step 4: the TEDS of a node from its profile and calibration, and the Security TEDS still unsigned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from teds_provision.errors import BadData, NotFound, UsageFailure
from teds_provision.station.station import Station
from teds_provision.steps.sign import known_image, known_node_keys, unsigned_security
from teds_provision.store import Draft
from teds_provision.teds.image import SECURITY, BlockId, Image

if TYPE_CHECKING:
    from teds_provision.teds.calibration import Calibration
    from teds_provision.teds.profile import Profile


@dataclass(frozen=True)
class BuildOrder:
    """What the user asks for: profile (None: the one that the node had), calibration file, name, and overrides.

    ``accept_calibration`` is the reason given for a calibration that the guard would refuse.
    """

    profile: str | None = None
    calibration: Path | None = None
    name: str | None = None
    drop_calibration: bool = False
    accept_calibration: str | None = None


@dataclass(frozen=True)
class Built:
    """A built image (Security TEDS unsigned, or absent where the node's key is not known yet) and its warnings."""

    image: Image
    profile: str
    warnings: tuple[str, ...]
    calibrations: Mapping[int, Calibration] = field(default_factory=dict)


def build(
    station: Station,
    uuid: bytes,
    order: BuildOrder,
    *,
    has: Image | None = None,
    keep: Mapping[BlockId, bytes] | None = None,
    edition: int = 2007,
    keep_draft: bool = True,
) -> Built:
    """Build a node's datasheet.

    ``has`` is what the node has now (else what it was last read to have): where the order brings no calibration, that
    of an earlier run that never came to write is taken, else the node's is kept. ``keep`` are read-only TEDS of the
    node, to be signed as they are. ``keep_draft`` False changes nothing in the store (dry run).

    Raises NotFound (profile, file), BadData (profile or calibration with errors), PolicyRefused (a calibration that
    the guard refuses).
    """
    has = has or known_image(station, uuid)
    plan = _composed(station, uuid, order, _pending(station, uuid, has) or has, edition)
    profile, calibrations, warnings = plan.profile, plan.calibrations, plan.warnings
    image = Image(uuid, {**(keep or {}), **plan.blocks})
    warnings += guard(
        station,
        image,
        has,
        order.accept_calibration,
        calibrations=calibrations,
        profile=profile,
        record=keep_draft,
    )
    try:
        image = image.with_block(SECURITY, unsigned_security(station, known_node_keys(station, uuid, has), image))
    except NotFound:
        warnings += ("The node's key is not known yet: the Security TEDS is added when it was identified.",)
    if not keep_draft:
        return Built(image, profile.name, warnings, calibrations)
    with station.transaction():
        station.nodes.remember(uuid, profile=plan.wanted, name=plan.name)
        station.nodes.keep_draft(Draft(uuid, image, "built", plan.wanted))
        station.audit("build", uuid, "done", profile=profile.name, teds=image.digest())
    return Built(image, profile.name, warnings, calibrations)


@dataclass(frozen=True)
class _Composed:
    """The TEDS that profile, calibration and name give; ``wanted`` is the profile as it was asked for."""

    profile: Profile
    wanted: str
    name: str | None
    calibrations: dict[int, Calibration]
    blocks: Mapping[BlockId, bytes]
    warnings: tuple[str, ...]


def _composed(station: Station, uuid: bytes, order: BuildOrder, has: Image | None, edition: int) -> _Composed:
    from teds_provision.teds.profile import default_folders, load_profile, passed_over

    record = station.nodes.get(uuid)
    wanted = order.profile or (record.profile if record else None)
    if wanted is None:
        raise UsageFailure(f"No profile is known for node {uuid.hex()}.", hint="Add --profile; see: profile list")
    folders = default_folders(station.home)
    profile = load_profile(wanted, folders)
    calibrations, warnings = _calibrations(order, profile, has)
    warnings = passed_over(wanted, folders) + warnings
    name = order.name or (record.name if record else None)
    try:
        made = profile.build(uuid, calibration=calibrations, name=name, edition=edition)  # type: ignore[arg-type]
    except UnicodeEncodeError as error:  # an argument in another encoding than the terminal's
        raise BadData("The name of the node is not valid text.", hint="Give it in the terminal's encoding.") from error
    return _Composed(profile, wanted, name, calibrations, made.blocks, warnings + made.warnings)


def check_order(station: Station, uuid: bytes | None, order: BuildOrder) -> None:
    """Try what an order names, before a node is waited for or changed; a UUID of None is any node's.

    Raises UsageFailure (no profile known), NotFound, BadData, as :func:`build` would; changes nothing.
    """
    if uuid is not None or order.profile is not None:
        _composed(station, uuid or bytes(10), order, None, 2007)


def _pending(station: Station, uuid: bytes, has: Image | None) -> Image | None:
    """What an earlier run built or signed and never wrote: it says which calibration is meant, not the node."""
    draft = station.nodes.draft(uuid)
    if draft is None:
        return None
    image = draft.image
    if draft.stage == "signed" and _sequence(image) <= _sequence(has):
        return None
    return image


def _sequence(image: Image | None) -> int:
    from teds_provision.teds.codec import security

    octets = image.security if image is not None else None
    try:
        return security.decode(octets).sequence if octets is not None else -1
    except BadData:
        return -1


def _calibrations(
    order: BuildOrder, profile: Profile, has: Image | None
) -> tuple[dict[int, Calibration], tuple[str, ...]]:
    from teds_provision.teds.calibration import load_calibrations
    from teds_provision.teds.sheet import Sheet

    if order.calibration is not None:
        if not order.calibration.is_file():
            raise NotFound(f"There is no calibration file {order.calibration}.")
        return load_calibrations(order.calibration, profile), ()
    if order.drop_calibration or has is None:
        return {}, ()
    kept = dict(Sheet.of(has).calibrations)
    numbers = ", ".join(map(str, kept))
    return kept, (f"The calibration that was given before is kept (channel {numbers}).",) if kept else ()


def guard(
    station: Station,
    image: Image,
    has: Image | None,
    accepted: str | None,
    *,
    calibrations: Mapping[int, Calibration] | None = None,
    profile: Profile | None = None,
    record: bool = True,
) -> tuple[str, ...]:
    """Refuse a calibration that would hurt (exit 6), unless someone said why it is right; returns warnings.

    That reason goes into the audit log, unless ``record`` is False (dry run).
    """
    from teds_provision.errors import PolicyRefused
    from teds_provision.teds.guard.guard import check_calibration

    old = has.unsigned_blocks() if has is not None else None
    findings = check_calibration(image.unsigned_blocks(), old, profile, calibrations=calibrations)
    errors = [f"channel {finding.channel}: {finding.message}" for finding in findings if finding.severity == "error"]
    if errors and accepted is None:
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        raise PolicyRefused(
            f"The calibration is refused: {errors[0]}{more}.",
            hint='Mend it; or, if it is right, say why: --accept-calibration "why".',
        )
    if errors and record:
        station.audit("accept-calibration", image.uuid, "accepted", why=accepted, findings=errors)
    return tuple(f"channel {finding.channel}: {finding.message}" for finding in findings)
