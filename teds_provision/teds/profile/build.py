"""From a profile, a UUID and calibrations to the TEDS of one node."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from teds_provision.errors import BadData
from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.model import Edition
from teds_provision.teds.profile.model import BuiltDatasheet, ChannelProfile, Profile

if TYPE_CHECKING:
    from teds_provision.teds.calibration import Calibration
    from teds_provision.teds.image import BlockId

USER_DEFINED_NAME: Final = 0
_CAL_NONE, _CAL_SUPPLIED = 0, 1
_UUID_OCTETS: Final = {2007: 10, 2024: 16}


def build(
    profile: Profile,
    uuid: bytes,
    *,
    calibration: Mapping[int, Calibration],
    name: str | None,
    edition: Edition,
    now: datetime | None,
) -> BuiltDatasheet:
    """See :meth:`Profile.build`."""
    from teds_provision.teds import compose

    if profile.abstract:
        raise BadData(
            f"The profile {profile.name} is only a base for others.",
            hint="Use a profile that extends it; see profile list.",
        )
    for number in calibration:
        if profile.channel(number) is None:
            raise BadData(
                f"The calibration is for channel {number}; {profile.name} has channels 1 to {len(profile.channels)}.",
                hint="Give the calibration of this type, or --no-calibration to drop the one that the node has.",
            )
    warnings: list[str] = []
    uuid = _uuid(uuid, edition, warnings)
    meta = (("UUID", uuid), *profile.meta, ("MaxChan", len(profile.channels)))
    blocks: dict[BlockId, bytes] = {(0, AccessCode.META): compose(AccessCode.META, meta, edition=edition)}
    for channel in profile.channels:
        given = calibration.get(channel.number)
        fields = {**channel.fields, "CalKey": _calibration_key(channel, given)}
        blocks[channel.number, AccessCode.CHANNEL] = compose(AccessCode.CHANNEL, fields, edition=edition)
        if given is not None:
            blocks[channel.number, AccessCode.CALIBRATION] = compose(
                AccessCode.CALIBRATION, given.fields(edition), edition=edition
            )
        if channel.name:
            blocks[channel.number, AccessCode.NAME] = _name(channel.name, edition)
        warnings += _calibration_warnings(channel, given, now or datetime.now(UTC))
    blocks[0, AccessCode.NAME] = _name(name or profile.tim_name, edition)
    if profile.phy:
        blocks[0, AccessCode.PHY] = compose(AccessCode.PHY, profile.phy, edition=edition)
    for text in profile.texts:
        block = (("Text", {"LangCode": text.language, "Text": text.text}),)
        blocks[text.channel, text.access_code] = compose(text.access_code, block, edition=edition)
    return BuiltDatasheet(dict(sorted(blocks.items())), tuple(warnings))


def _uuid(uuid: bytes, edition: Edition, warnings: list[str]) -> bytes:
    asked = _UUID_OCTETS[edition]
    if edition == 2024 and len(uuid) == 10:
        warnings.append("The node's UUID has 10 octets, the 2024 form 16: it was put behind six zero octets.")
        return bytes(6) + uuid
    if len(uuid) != asked:
        raise BadData(f"A UUID of the {edition} edition has {asked} octets, this one {len(uuid)}.")
    return uuid


def _calibration_key(channel: ChannelProfile, given: Calibration | None) -> int:
    if channel.calibration_key is not None:
        return channel.calibration_key
    return _CAL_NONE if given is None else _CAL_SUPPLIED


def _name(name: str, edition: Edition) -> bytes:
    from teds_provision.teds import compose

    return compose(AccessCode.NAME, (("Format", USER_DEFINED_NAME), ("TCName", name)), edition=edition)


def _calibration_warnings(channel: ChannelProfile, given: Calibration | None, now: datetime) -> list[str]:
    demand = channel.calibration
    where = f"Channel {channel.number}" + (f" ({channel.name})" if channel.name else "")
    if given is None:
        if not demand.required:
            return []
        return [f"{where} has no calibration, and its type asks for one: give it with --calibration FILE."]
    warnings = [f"{where}: {text}" for text in given.date_warnings(now, demand.interval)]
    if channel.calibration_key == _CAL_NONE:
        warnings.append(f"{where} has a calibration, but its calibration key says that there is none.")
    if demand.method and demand.method != given.method:
        warnings.append(f"{where}: its type asks for the method {demand.method}; the calibration is {given.method}.")
    return warnings
