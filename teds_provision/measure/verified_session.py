"""A session with a node whose datasheet is verified: the conditions for its values (operation.md section 1)."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

from teds_provision.errors import PolicyError
from teds_provision.links.ports import TimestampedLink
from teds_provision.measure.blocks import ChannelFacts, Kind
from teds_provision.measure.clock import ClockMap, Exchange
from teds_provision.measure.standing import require_measurable
from teds_provision.protocol.operation import commands
from teds_provision.protocol.operation.commands import OperationReply
from teds_provision.protocol.operation.stream_commands import CLOCK, ClockReply
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.board_type import operate
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.readings import keep
from teds_provision.provisioning.teds_read import read_image
from teds_provision.provisioning.verify import freshness_floor_of, require_authentic
from teds_provision.provisioning.verify_node import NodeVerification, verify_in_session
from teds_provision.station.shown_units import channel_profiles, shown_units
from teds_provision.station.station import Station
from teds_provision.teds.profile import ChannelProfile
from teds_provision.teds.sheet import Channel, ChannelKind, Sheet

# From a signed datasheet to the facts that accompany every value.

_WORDS: dict[ChannelKind, Kind] = {
    ChannelKind.SENSOR: "sensor",
    ChannelKind.ACTUATOR: "actuator",
    ChannelKind.EVENT_SENSOR: "event",
}


def facts_of(sheet: Sheet, channel: Channel, *, name: str, fingerprint: str, period: float | None) -> ChannelFacts:
    """Return the facts of one channel; ``name`` is the node's, ``fingerprint`` its Security TEDS's (64 hex digits).

    Values, limits and uncertainty are in the SI unit of the datasheet; ``period`` in seconds, which events do not have.
    """
    calibrated, due = channel.calibrated_at, channel.due
    return ChannelFacts(
        uuid=sheet.uuid.hex(),
        node=name or sheet.meta.name,
        number=channel.number,
        name=channel.name,
        kind=_WORDS.get(channel.kind or ChannelKind.SENSOR, "sensor"),
        unit=channel.si_unit,
        units=channel.units,
        shown_unit=channel.shown.text,
        low=_if_finite(channel.low),
        high=_if_finite(channel.high),
        uncertainty=_if_finite(channel.stated_uncertainty),
        calibrated=calibrated.date().isoformat() if calibrated else None,
        due=due.date().isoformat() if due else None,
        overdue=channel.overdue(datetime.now(UTC)),
        fingerprint=fingerprint,
        sample_form=channel.sample.name if channel.sample else "",
        own_period=_if_finite(channel.period),
        calibration=channel.calibration,
        period=None if channel.kind == ChannelKind.EVENT_SENSOR else period,
        wrapped=sheet.meta.origin.text if sheet.meta.origin is not None else "",
        vector=next((group for group in sheet.meta.vectors if channel.number in group), ()),
    )


def _deviation(of_type: ChannelProfile | None, channel: Channel) -> float | None:
    """Return the standard deviation in SI units; a profile with another unit than the datasheet gives none."""
    if of_type is None or of_type.units != channel.units or of_type.calibration.standard_deviation is None:
        return None
    return _if_finite(of_type.unit.difference_to_si(of_type.calibration.standard_deviation))


def _if_finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


LEASE, LONGEST_LEASE = 10, 60  # seconds for which a claim lasts without a message from this station
# seconds of lease for each node of the bus: clock requests to all nodes then use below a tenth of the time
LEASE_EACH = 0.2
DEAD_MAN = 1000  # milliseconds without a set point after which an actuator is safe


@dataclass
class SessionLease:
    """Seconds of the longest lease of this session's claims; 0 before the first.

    The node has one for all of them, the last Operate's (operation.md section 1).
    """

    seconds: int = 0


@dataclass(frozen=True)
class VerifiedSession:
    """A node in a session, with a datasheet that was verified just now.

    ``digest`` is Operate's (16 octets), ``fingerprint`` the SHA-256 of the Security TEDS in hex. ``unsigned``: the
    datasheet has no signature; there are raw values alone, and nothing is moved. ``profiles`` are the channels of its
    type, ``frames`` the chosen coordinate frames (0: for the whole node). ``unverified``: it has no signature either,
    and an operator allowed to calibrate values by it; nothing is moved. ``kept``: all but its Security TEDS was read
    before the node's last start; values come from the signed copy.
    """

    node: Conversation
    sheet: Sheet
    fingerprint: str
    name: str
    unsigned: bool = False
    kept: bool = False
    profiles: Mapping[int, ChannelProfile] = field(default_factory=dict)
    frames: Mapping[int, str] = field(default_factory=dict)
    unverified: bool = False
    lease: SessionLease = field(default_factory=SessionLease, compare=False)

    @property
    def uuid(self) -> str:
        """20 hex digits."""
        return self.sheet.uuid.hex()

    @property
    def digest(self) -> bytes:
        """First 16 octets of the fingerprint."""
        return bytes.fromhex(self.fingerprint)[: commands.DIGEST_OCTETS]

    def facts(self, channel: Channel, period: float | None) -> ChannelFacts:
        """Return the facts for every value of a channel that gives one every ``period`` seconds."""
        siblings = tuple((channel.number, channel.name) for channel in self.sheet.channels)
        if self.unsigned:  # the name only distinguishes channels; no other unsigned claim is used
            kind = facts_of(self.sheet, channel, name=self.name, fingerprint="", period=period).kind
            bare = ChannelFacts(self.uuid, self.name, channel.number, channel.name, kind, period=period, unsigned=True)
            return replace(bare, siblings=siblings)
        if self.unverified:  # the name from its TEDS: the store's name belongs to a signed datasheet
            known = facts_of(self.sheet, channel, name=self.sheet.meta.name, fingerprint="", period=period)
            return replace(known, siblings=siblings, unverified=True)
        known = facts_of(self.sheet, channel, name=self.name, fingerprint=self.fingerprint, period=period)
        of_type = self.profiles.get(channel.number)
        frame = self.frames.get(channel.number) or self.frames.get(0) or (of_type.frame if of_type else "")
        return replace(known, siblings=siblings, frame=frame, deviation=_deviation(of_type, channel))

    def channel(self, channel: int | str) -> Channel:
        """Return a channel of the datasheet by its number or name; raises BadDataError if there is none."""
        return self.sheet.chosen(channel, self.uuid)


def open_trusted(station: Station, node: Conversation, *, by: str, unsigned: bool = False) -> VerifiedSession:
    """Open a session and verify the datasheet for the command ``by``; ``unsigned`` also accepts an unsigned one.

    Raises PolicyError (no key, not listed), NotAuthenticError and UnprovenError (revoked, the datasheet), LinkError.
    """
    require_measurable(station, node.uuid)
    require_session(station, node)
    return trusted_from(station, node, verify_in_session(station, node, by=by), unsigned=unsigned)


def open_unverified(station: Station, node: Conversation, *, by: str) -> VerifiedSession:
    """Open a session with a node with an unsigned datasheet, all of it read in a session since its last start.

    The session proves that it is this node's, not that it is right. Raises PolicyError if it is signed, and what
    :func:`open_trusted` raises.
    """
    require_measurable(station, node.uuid)
    require_session(station, node)
    looked = verify_in_session(station, node, by=by)
    if looked.verified.verdict == "authentic":
        raise PolicyError("Its datasheet is signed now.")
    if looked.verified.verdict != "unsigned":
        require_authentic(looked.verified)
    image = looked.image
    if looked.kept:  # an unsigned Security TEDS has no digests of the other TEDS, so a cached copy proves nothing
        c, image = node.open_counter, read_image(node)
        verified = keep(
            station, node, image, by=by, floor=freshness_floor_of(station, node.uuid, node.proven), c=c
        ).verified
        if verified.verdict != "unsigned":
            require_authentic(verified)
    digest = hashlib.sha256(image.security or b"").hexdigest()
    return VerifiedSession(node, Sheet.from_image(image), digest, "", unverified=True)


def trusted_from(
    station: Station, node: Conversation, looked: NodeVerification, *, unsigned: bool = False
) -> VerifiedSession:
    """Return the node in its session, by what was seen there; raises as :func:`open_trusted` does."""
    image = looked.image
    bare = unsigned and looked.verified.verdict == "unsigned"
    if not bare:
        require_authentic(looked.verified)
    record = station.nodes.get(node.uuid)
    name = record.name if record is not None and record.name else ""
    digest = hashlib.sha256(image.security or b"").hexdigest()
    sheet = Sheet.from_image(image).shown_in(shown_units(station, node.uuid))
    frames = {number: frame for (uuid, number), frame in station.measurements.frames.items() if uuid == node.uuid}
    return VerifiedSession(node, sheet, digest, name, bare, looked.kept, channel_profiles(station, node.uuid), frames)


def exchange_clock(node: Conversation, clock: ClockMap) -> ClockReply:
    """Do one Clock exchange into the map; the map's ``lie`` is set if the node's clock cannot be believed."""
    reply, exchange = ask_clock(node)
    clock.exchange(exchange)
    return reply


def ask_clock(node: Conversation) -> tuple[ClockReply, Exchange]:
    """Run one Clock command, for a map that others read meanwhile; return reply and exchange.

    Time that this process spent on sealing, opening and waking up is not the link's delay: a link that knows when the
    first copy left and when the reply was whole is believed (operation.md section 5).
    """
    link = node.contact.link
    if isinstance(link, TimestampedLink):
        link.left = link.came = 0.0
    asked = time.monotonic_ns()
    reply = ClockReply.decode(node.request(CLOCK, "to report its time"))
    answered = time.monotonic_ns()
    if isinstance(link, TimestampedLink) and link.left < link.came:
        asked, answered = math.floor(link.left * 1e9), math.ceil(link.came * 1e9)
    return reply, Exchange(asked, answered, reply.received, reply.sent, reply.step, reply.drift)


def claim(trusted: VerifiedSession, channel: int, *, lease: int, dead_man: int | None = None) -> None:
    """Operate: claim a channel, 0 for every sensor; ``lease`` in s, ``dead_man`` in ms for an actuator.

    It shortens no lease that the session has: an actuator of a measurement whose Clocks are rare would end its streams.
    """
    longest = max(lease, trusted.lease.seconds)
    operate(trusted.node, channel, trusted.digest, lease=longest, dead_man=dead_man)
    trusted.lease.seconds = longest


def operation(node: Conversation) -> OperationReply:
    """Return what the node claims and does (128.19)."""
    return OperationReply.decode(node.request(commands.OPERATION, "to report its mode"))
