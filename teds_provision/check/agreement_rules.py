"""Rules of factory state, of a node that has a key, and of the key agreement that gives it one."""

from __future__ import annotations

import hmac
import os
from dataclasses import dataclass, field
from typing import Final

from teds_provision.check import slips
from teds_provision.check.plain_rules import low_s, security_state
from teds_provision.check.probe import OVER_CAN, OVER_NFC, NotApplicableError, Probe, RuleBrokenError, demand, holds
from teds_provision.check.rule import Stage, rule
from teds_provision.errors import BadDataError, GarbledError, NotAuthenticError, PolicyError
from teds_provision.links.ports import MultiStationLink
from teds_provision.protocol.keys import (
    CHALLENGE_OCTETS,
    GROUP_ORDER,
    SIGNATURE_OCTETS,
    Credentials,
    SoftwareKey,
    agreement_message,
    fingerprint,
    is_point,
    normalise_signature,
    reset_message,
    station_key_message,
    verify,
)
from teds_provision.protocol.messages.frames import (
    IDENTIFY,
    Command,
    Function,
    Reason,
    Reply,
    decode_reply,
    security_command,
)
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.messages.tables import describe_command, describe_reply
from teds_provision.protocol.session import OPEN_OCTETS, StationSession
from teds_provision.protocol.wire_agreement import REPLY_OCTETS, AgreedKey, RequestPayload, StationAgreement
from teds_provision.teds.image import SECURITY, BlockId

_OFF_CURVE: Final = b"\x04" + bytes(64)
_CONFIRMATIONS: Final = 6
"""The slips of tagS that are tried, each with its own Request."""
_SIGNATURES: Final = 8
"""Replies to Request whose sigN is looked at for a high s: each costs a slow node some seconds."""
_HIGH_S: Final = "s of sigN is in the upper half of the group order; n - s is due then."
_WRONG_CONFIRM: Final = security_command(Function.CONFIRM, bytes(16))
"""A tagS that is wrong but for a chance of 2^-128: no node takes a key by it."""


@dataclass(frozen=True)
class StrangerStation:
    """A station and its CA, made for one question."""

    station: SoftwareKey
    ca: SoftwareKey

    @classmethod
    def make(cls) -> StrangerStation:
        """Return a station with new keys."""
        return cls(SoftwareKey.generate(), SoftwareKey.generate())

    @property
    def credentials(self) -> Credentials:
        """The credentials of this station."""
        return Credentials(self.station, self.ca.sign(station_key_message(self.station.point)), self.ca.point)

    def request(self, *, certified: bool = True, one_time: bytes = b"", message: bytes = b"") -> bytes:
        """Return the payload of a Request of the stranger; SIG104 signs ``message`` in place of the right one."""
        signer = self.ca if certified else self.station
        signature = signer.sign(message or station_key_message(self.station.point))
        one_time = one_time or SoftwareKey.generate().point
        return RequestPayload(self.station.point, signature, self.ca.point, one_time).encode()


def request(payload: bytes) -> Command:
    """Request (128.1) with any payload."""
    return security_command(Function.REQUEST, payload)


def tapped_or_bus(probe: Probe) -> None:
    """Raise NotApplicableError unless the link is tapped, or the bus of a factory node without NFC."""
    if probe.tapped:
        return
    if probe.plain(request(b"")).reason == Reason.NOT_PERMITTED:
        raise NotApplicableError(f"Request is not permitted on this link, as the board has NFC. {OVER_NFC}")


@dataclass(frozen=True)
class TriedRequest:
    """One Request, its reply, and what this station derives from both: Z is left out, K only while it is a test's."""

    agreement: slips.Agreement
    agreed: AgreedKey | None
    broken: RuleBrokenError | None
    script: bytes
    okm: bytes = field(repr=False)


def try_agreement(probe: Probe, credentials: Credentials, *, sealed: bool = False) -> TriedRequest:
    """Send a good Request and check its reply; nothing is kept on either side yet.

    Raises RuleBrokenError if no reply of the right length with a valid point came. A fault of its tag, signature or
    epoch is returned in ``broken``.
    """
    one_time = SoftwareKey.generate()
    agreement = StationAgreement(credentials, probe.uuid, one_time=one_time)
    command, teds = agreement.request(), probe.teds(SECURITY)
    reply = probe.sealed(command) if sealed else probe.plain(command)
    if not reply.ok:
        slip = _slip_of_request(probe) if reply.reason == Reason.BAD_SIGNATURE else None
        raise RuleBrokenError(f"{describe_command(command)}: success is due, {describe_reply(reply)} came.", slip)
    holds(
        len(reply.payload) == REPLY_OCTETS,
        f"Request (128.1): {REPLY_OCTETS} octets are due, {len(reply.payload)} came.",
    )
    shown = probe.security()
    made = slips.Agreement(command.payload, reply.payload, probe.uuid, shown.node_key, teds, one_time, credentials.key)
    agreed, broken = None, None
    try:
        agreed = agreement.accept(reply.payload, teds, pinned=fingerprint(shown.node_key), epoch=0)
    except GarbledError as torn:
        raise RuleBrokenError(f"Request (128.1): {torn.message}") from None
    except (NotAuthenticError, PolicyError, BadDataError) as wrong:
        if not is_point(made.en):
            raise RuleBrokenError(f"Request (128.1): {wrong.message}") from None
        broken = _explained(made, wrong.message)
    script = made.transcripts()[0][1]
    okm = made.material(made.shared, script)[0][1][:48]
    return TriedRequest(made, agreed, broken, script, okm)


def _explained(made: slips.Agreement, otherwise: str) -> RuleBrokenError:
    """Return the error for a reply whose octets this station did not accept, with the slip that explains it."""
    script = made.transcripts()[0][1]
    okm = made.material(made.shared, script)[0][1]
    if made.tag != next(made.tags(okm, script))[1]:
        return RuleBrokenError("Request (128.1): tagN is wrong.", made.slip_of_tag())
    if not verify(made.node, agreement_message(script), normalise_signature(made.signature)):
        slip = made.slip_of_signature()
        return RuleBrokenError("Request (128.1): tagN is right, sigN does not verify under field 101.", slip)
    if slips.high_s(made.signature):
        return RuleBrokenError(f"Request (128.1): {_HIGH_S}")
    return RuleBrokenError(f"Request (128.1): {otherwise}")


def _slip_of_request(probe: Probe) -> slips.Slip | None:
    """Return the slip by which a node that refuses a good SIG104 verifies it.

    For Requests of strangers, in factory state.
    """
    if probe.identity().state != NodeState.FACTORY:
        return None
    strange = StrangerStation.make()

    def takes(message: bytes) -> bool:
        return probe.plain(request(strange.request(message=message))).ok

    if takes(b"") or takes(b"no station key"):
        return None  # it refuses a good SIG104 now, or accepts any: no slip explains either
    return next((slip for slip, message in slips.station_keys(strange.station.point) if takes(message)), None)


def stranger_asks(probe: Probe) -> bytes:
    """Return the payload of a reply to a good Request of a stranger that is never confirmed.

    May raise NotApplicableError.
    """
    return _stranger_asks(probe, request(StrangerStation.make().request())).payload


def _stranger_asks(probe: Probe, command: Command) -> Reply:
    tapped_or_bus(probe)
    if probe.no_agreement:
        raise NotApplicableError(f"Needs a good reply to Request, and none came: {probe.no_agreement}")
    return Reply(True, probe.good(command))


def agree(
    probe: Probe, credentials: Credentials | None = None, *, sealed: bool = False
) -> tuple[AgreedKey, TriedRequest]:
    """Call :func:`try_agreement`, by default for this station; raises RuleBrokenError for any fault.

    A second call after a fault raises NotApplicableError.
    """
    if probe.no_agreement:
        raise NotApplicableError(f"Needs a good reply to Request, and none came: {probe.no_agreement}")
    try:
        tried = try_agreement(probe, credentials or probe.station, sealed=sealed)
        if tried.broken is not None:
            raise tried.broken
    except RuleBrokenError as broken:
        probe.no_agreement = str(broken)
        raise
    assert tried.agreed is not None
    return tried.agreed, tried


# -- factory state -----------------------------------------------------------------------------------------------------


@rule("factory-open", "Which command when", Stage.FACTORY)
def factory_open(probe: Probe) -> str:
    """Open in either form, and Sealed, get 2 in factory state."""
    probe.refused(security_command(Function.OPEN), Reason.WRONG_STATE)
    probe.refused(security_command(Function.OPEN, bytes(OPEN_OCTETS)), Reason.WRONG_STATE)
    return probe.refused(security_command(Function.SEALED, bytes(36)), Reason.WRONG_STATE)


def require_reset_proof(probe: Probe, epoch: int, challenge: bytes, proof: bytes) -> None:
    """Raise RuleBrokenError unless the reply to Reset is signed by the node's key, over this challenge."""
    message, node = reset_message(probe.uuid, epoch, challenge), probe.node_key
    if len(proof) != SIGNATURE_OCTETS or not verify(node, message, normalise_signature(proof)):
        slip = slips.of_reset(probe.uuid, node, epoch, challenge, proof)
        raise RuleBrokenError("Reset (128.9): the proof does not verify under field 101 at this epoch.", slip)


@rule("factory-reset", "Reset", Stage.FACTORY)
def factory_reset(probe: Probe) -> str:
    """Reset in factory state changes nothing and gives the proof."""
    before, challenge = probe.identity(), os.urandom(CHALLENGE_OCTETS)
    require_reset_proof(probe, before.epoch, challenge, probe.good(security_command(Function.RESET, challenge)))
    after = probe.identity()
    holds(after == before, f"Reset (128.9) in factory state changed Identify from {before} to {after}.")
    return f"a proof for epoch {before.epoch}, nothing changed"


@rule("reset-low-s", "Notation", Stage.FACTORY)
def reset_low_s(probe: Probe) -> str:
    """Check that the node signs with s in the lower half, in proofs of Reset too."""
    return low_s(probe, Function.RESET, "Reset (128.9)")


@rule("confirm-without-request", "Key agreement", Stage.FACTORY)
def confirm_without_request(probe: Probe) -> str:
    """Check that a Confirm without a pending Request gets 2, for any length."""
    tapped_or_bus(probe)
    for octets in (0, 15, 17):
        probe.refused(security_command(Function.CONFIRM, bytes(octets)), Reason.WRONG_STATE, "nothing pending")
    return probe.refused(_WRONG_CONFIRM, Reason.WRONG_STATE, "nothing pending")


@rule("request-checks", "Key agreement", Stage.FACTORY)
def request_checks(probe: Probe) -> str:
    """Check the order of refusals: length (4) before points (15) before SIG104 (5)."""
    tapped_or_bus(probe)
    strange = StrangerStation.make()
    wrong = strange.request(certified=False)
    probe.refused(request(_OFF_CURVE + wrong[65:-1]), Reason.BAD_FORM, "one octet short, P(station) off the curve")
    probe.refused(request(_OFF_CURVE + wrong[65:]), Reason.BAD_POINT, "P(station) off the curve, SIG104 wrong")
    off_ca = wrong[:129] + _OFF_CURVE + wrong[194:]
    probe.refused(request(off_ca), Reason.BAD_POINT, "P(CA) off the curve, SIG104 wrong")
    probe.refused(request(wrong[:-65] + _OFF_CURVE), Reason.BAD_POINT, "E off the curve, SIG104 wrong")
    return probe.refused(request(wrong), Reason.BAD_SIGNATURE, "SIG104 of another key")


@rule("request-one-time", "Key agreement", Stage.FACTORY)
def request_one_time(probe: Probe) -> str:
    """Check that E is a one-time key: the node's own point and the station's static one get 15, before SIG104."""
    tapped_or_bus(probe)
    strange, own = StrangerStation.make(), probe.node_key
    probe.refused(request(strange.request(one_time=own, certified=False)), Reason.BAD_POINT, "E the node's own point")
    static = strange.request(one_time=strange.station.point)
    return probe.refused(request(static), Reason.BAD_POINT, "E equal to P(station)")


@rule("request-high-s", "Notation", Stage.FACTORY)
def request_high_s(probe: Probe) -> str:
    """Check that the node refuses an s in the upper half: a Request with such a SIG104 gets 5."""
    tapped_or_bus(probe)
    good = StrangerStation.make().request()
    high = GROUP_ORDER - int.from_bytes(good[97:129], "big")
    twisted = good[:97] + high.to_bytes(32, "big") + good[129:]
    return probe.refused(request(twisted), Reason.BAD_SIGNATURE, "SIG104 with a high s")


@rule("request", "Key agreement", Stage.FACTORY)
def request_answered(probe: Probe) -> str:
    """Check that a good Request of any station is answered in factory state, by 165 octets."""
    tapped_or_bus(probe)
    command = request(StrangerStation.make().request())
    reply = probe.plain(command)
    if reply.ok and len(reply.payload) == REPLY_OCTETS:
        return f"{REPLY_OCTETS} octets"
    slip = _slip_of_request(probe) if reply.reason == Reason.BAD_SIGNATURE else None
    what = f"{describe_command(command)}: success with {REPLY_OCTETS} octets is due, {describe_reply(reply)} came."
    probe.no_agreement = what
    raise RuleBrokenError(what, slip)


@rule("agreement-epoch", "Key agreement", Stage.FACTORY)
def agreement_epoch(probe: Probe) -> str:
    """Check that Request offers the stored epoch + 1, and alone changes nothing."""
    before = probe.identity()
    offered = int.from_bytes(stranger_asks(probe)[16:20], "big")
    little = int.from_bytes((before.epoch + 1).to_bytes(4, "little"), "big")
    slip = {
        before.epoch: slips.Slip("epoch-not-plus-1", "the stored epoch is offered, not the stored one + 1"),
        little: slips.Slip("epoch-little-endian", "the epoch in the reply is little-endian"),
    }.get(offered)
    if offered != before.epoch + 1:
        raise RuleBrokenError(f"Request offers epoch {offered}; {before.epoch + 1} is due.", slip)
    holds(probe.identity() == before, "Request changed the reply to Identify before its Confirm.")
    return f"epoch {offered} offered"


@rule("agreement-low-s", "Notation", Stage.FACTORY)
def agreement_low_s(probe: Probe) -> str:
    """Check that the node signs with s in the lower half, in sigN too."""
    for _ in range(_SIGNATURES):
        reply = stranger_asks(probe)
        holds(not slips.high_s(reply[-SIGNATURE_OCTETS:]),
              f"Request (128.1): {_HIGH_S}")  # fmt: skip
    return f"{_SIGNATURES} sigN with low s"


@rule("agreement-fresh", "Key agreement", Stage.FACTORY)
def agreement_fresh(probe: Probe) -> str:
    """Check that each Request gets a fresh nonce and a fresh one-time key."""
    first, second = stranger_asks(probe), stranger_asks(probe)
    holds(first[:16] != second[:16], "Two Requests (128.1) were answered with the same nonceN.")
    holds(first[20:85] != second[20:85], "Two Requests (128.1) were answered with the same one-time key En.")
    own = probe.node_key
    holds(
        own not in (first[20:85], second[20:85]),
        "Request (128.1): En is the node's identity key; a one-time key is due.",
    )
    return "two Requests, two nonces, two one-time keys"


@rule("agreement-tags", "Key agreement", Stage.FACTORY)
def agreement_tags(probe: Probe) -> str:
    """Check the reply of 165 octets: tagN over T, and sigN over T under the key that the node shows."""
    tapped_or_bus(probe)
    agree(probe, StrangerStation.make().credentials)
    return f"{REPLY_OCTETS} octets, tagN and sigN right"


@rule("confirm-checks", "Key agreement", Stage.FACTORY)
def confirm_checks(probe: Probe) -> str:
    """Check that a Confirm of wrong length gets 4 and keeps the pending agreement; a wrong tagS gets 12 and ends it."""
    before = probe.identity()
    stranger_asks(probe)
    probe.refused(security_command(Function.CONFIRM, bytes(15)), Reason.BAD_FORM)
    probe.refused(_WRONG_CONFIRM, Reason.BAD_TAG, "tagS wrong")
    probe.refused(_WRONG_CONFIRM, Reason.WRONG_STATE, "after a wrong tagS")
    after = probe.identity()
    holds(after == before, f"Identify went from {before} to {after} although no Confirm was good.")
    return "4, 12, then 2; nothing changed"


@rule("repetition-request", "Repetition", Stage.FACTORY)
def repetition_request(probe: Probe) -> str:
    """Check that a repeated Request gets the stored reply and does not run again: nonceN, En and the agreement stay."""
    line, command = probe.resending, request(StrangerStation.make().request())
    first = _stranger_asks(probe, command)
    again = decode_reply(line.resend(command.encode()))
    text = "the stored reply is due, another one came. It was run again." if again.ok else describe_reply(again)
    holds(again == first, f"Request (128.1) repeated: {text}")
    return f"the stored {len(first.payload)} octets"


@rule("reset-ends-request", "Reset", Stage.FACTORY)
def reset_ends_request(probe: Probe) -> str:
    """Check that a Reset ends the pending agreement: the next Confirm gets 2, not 12."""
    stranger_asks(probe)
    probe.good(security_command(Function.RESET, os.urandom(CHALLENGE_OCTETS)))
    return probe.refused(_WRONG_CONFIRM, Reason.WRONG_STATE, "a Reset between Request and Confirm")


@rule("confirm-other-link", "Key agreement", Stage.FACTORY)
def confirm_other_link(probe: Probe) -> str:
    """Check that a Confirm from another link than its Request gets 2 and keeps the pending agreement."""
    other = probe.from_station(1)
    stranger_asks(probe)
    seen = other.refused(_WRONG_CONFIRM, Reason.WRONG_STATE, "from another station's address")
    probe.refused(_WRONG_CONFIRM, Reason.BAD_TAG, "then from the one of the Request, tagS wrong")
    return seen


# -- the agreement -----------------------------------------------------------------------------------------------------


@rule("confirm-newest", "Key agreement", Stage.AGREEMENT)
def confirm_newest(probe: Probe) -> str:
    """Check that a new good Request replaces the pending agreement: the tagS of the former gets 12."""
    tapped_or_bus(probe)
    first, _ = agree(probe)
    if probe.keep is not None:  # keep the key, in case the node adopts it: otherwise the node would be lost
        probe.keep(first)
    stranger_asks(probe)
    return demand(probe.plain(first.confirm), Reason.BAD_TAG, "Confirm (128.2) of the Request before the last")


@rule("confirm-whole-tag", "Key agreement", Stage.AGREEMENT)
def confirm_whole_tag(probe: Probe) -> str:
    """Check that all 16 octets of tagS are compared: one wrong in only its first or last octet gets 12."""
    tapped_or_bus(probe)
    for at in (0, 15):
        agreed, tried = agree(probe)
        if probe.keep is not None:  # keep the key, in case the node adopts it: otherwise the node would be lost
            probe.keep(agreed)
        right = agreed.confirm.payload
        wrong = right[:at] + bytes([right[at] ^ 1]) + right[at + 1 :]
        reply = probe.plain(security_command(Function.CONFIRM, wrong))
        if reply.ok:
            probe.key, probe.okm = agreed.key, tried.okm
        seen = demand(reply, Reason.BAD_TAG, f"Confirm (128.2), octet {at} of tagS alone wrong")
    return seen


@rule("agreement", "Key agreement", Stage.AGREEMENT)
def agreement(probe: Probe) -> str:
    """Check that a good Confirm is accepted: Identify then shows state keyed and the offered epoch."""
    tapped_or_bus(probe)
    before = probe.identity()
    confirm(probe, sealed=False)
    after = probe.identity()
    holds(after.state != NodeState.FACTORY, "After a good Confirm (128.2) Identify still reports factory state.")
    holds(after.epoch == before.epoch + 1, f"After Confirm the epoch is {after.epoch}; {before.epoch + 1} was offered.")
    holds(after.sequence == before.sequence, f"Confirm took the sequence from {before.sequence} to {after.sequence}.")
    return f"keyed, epoch {after.epoch}"


def confirm(probe: Probe, *, sealed: bool) -> None:
    """Agree on a key, which is durable here before the Confirm leaves, and go on with it; raises RuleBrokenError."""
    agreed, tried = agree(probe, sealed=sealed)
    assert probe.keep is not None
    probe.keep(agreed)
    reply = probe.sealed(agreed.confirm) if sealed else probe.plain(agreed.confirm)
    if not reply.ok:
        slip = _slip_of_confirm(probe) if reply.reason == Reason.BAD_TAG and not sealed else None
        raise RuleBrokenError(
            f"{describe_command(agreed.confirm)}: success is due, {describe_reply(reply)} came.", slip
        )
    probe.key, probe.okm = agreed.key, tried.okm


def _slip_of_confirm(probe: Probe) -> slips.Slip | None:
    """Return the slip by which a node that refuses a good tagS computes it; each is tried with its own Request.

    The right tag, and one of zeros, are tried first: no slip explains a node that accepts either.
    """
    for number in range(-2, _CONFIRMATIONS):
        agreed, tried = agree(probe)
        assert probe.keep is not None
        probe.keep(agreed)
        slip: slips.Slip | None = None
        command = agreed.confirm if number == -2 else _WRONG_CONFIRM
        if number >= 0:
            slip, tag = slips.confirmations(tried.okm[16:], tried.script)[number]
            command = security_command(Function.CONFIRM, tag)
        if probe.plain(command).ok:
            probe.key, probe.okm = agreed.key, tried.okm
            return slip
    return None


# -- a node that has a key ---------------------------------------------------------------------------------------------


@rule("open", "Sessions", Stage.KEYED)
def open_a_session(probe: Probe) -> str:
    """Check that En is a point, the tag shows that the node holds the key, and a sealed command gets a sealed reply."""
    probe.open()
    inside, outside = probe.sealed_good(IDENTIFY), probe.good(IDENTIFY)
    holds(inside == outside, "Identify replies differently in the session and outside it.")
    return "a good tag; Identify the same inside and outside"


@rule("keyed-untapped", "Which command when", Stage.KEYED)
def keyed_untapped(probe: Probe) -> str:
    """Check that untapped Request, Confirm and Set CAN address get 3 once the node has a key."""
    if probe.tapped:
        raise NotApplicableError(f"Every command counts as tapped on this link. {OVER_CAN}")
    # These change nothing even if a faulty node runs them: their SIG104, length and state are wrong.
    probe.refused(request(StrangerStation.make().request(certified=False)), Reason.NOT_PERMITTED)
    probe.refused(security_command(Function.CONFIRM, bytes(16)), Reason.NOT_PERMITTED)
    return probe.refused(security_command(Function.SET_CAN_ADDRESS, b"\0"), Reason.NOT_PERMITTED)


@rule("keyed-security", "The Security TEDS", Stage.KEYED)
def keyed_security(probe: Probe) -> str:
    """Check that the Security TEDS of a keyed node agrees with Identify: a new epoch is in the initial one at once."""
    return security_state(probe)


@rule("confirm-elsewhere", "Key agreement", Stage.KEYED)
def confirm_elsewhere(probe: Probe) -> str:
    """Check that a Confirm outside the session of its Request gets 2, before its tag is checked."""
    if not probe.tapped:
        raise NotApplicableError(f"Needs a tap. {OVER_NFC}")
    probe.sealed_good(StationAgreement(probe.station, probe.uuid).request())
    seen = probe.refused(_WRONG_CONFIRM, Reason.WRONG_STATE, "plain, of a Request in a session")
    probe.close()
    probe.good(StationAgreement(probe.station, probe.uuid).request())
    probe.sealed_refused(_WRONG_CONFIRM, Reason.WRONG_STATE, "of a plain Request")
    probe.refused(_WRONG_CONFIRM, Reason.BAD_TAG, "tagS wrong")
    probe.close()
    return seen


@rule("confirm-other-session", "Key agreement", Stage.KEYED)
def confirm_other_session(probe: Probe) -> str:
    """Check that the pending agreement ends with its session: a Confirm in the next one of the same link gets 2."""
    probe.sealed_good(StationAgreement(probe.station, probe.uuid).request())
    probe.close()
    seen = probe.sealed_refused(_WRONG_CONFIRM, Reason.WRONG_STATE, "of a Request in an earlier session")
    probe.close()
    return seen


@rule("confirm-beside", "Key agreement", Stage.KEYED)
def confirm_beside(probe: Probe) -> str:
    """Check that a Confirm in another station's session gets 2 and keeps the pending agreement."""
    other = probe.from_station(1)
    probe.sealed_good(StationAgreement(probe.station, probe.uuid).request())
    seen = other.sealed_refused(_WRONG_CONFIRM, Reason.WRONG_STATE, "of a Request in another session")
    probe.sealed_refused(_WRONG_CONFIRM, Reason.BAD_TAG, "then in the session of the Request, tagS wrong")
    other.close()
    probe.close()
    return seen


@rule("keyed-reset", "Which command when", Stage.KEYED)
def keyed_reset(probe: Probe) -> str:
    """Check that a plain Reset of a keyed node gets 3. It is sent too short, so that no node obeys it."""
    return probe.refused(security_command(Function.RESET), Reason.NOT_PERMITTED)


@rule("first-owner-wins", "Key agreement", Stage.KEYED)
def first_owner_wins(probe: Probe) -> str:
    """Check that a Request with another CA gets 14, tapped or in a session, after the points and before SIG104."""
    probe.require(NodeState.KEYED, NodeState.PROVISIONED)
    refused = probe.refused if probe.tapped else probe.sealed_refused
    strange = StrangerStation.make()
    off = strange.request(certified=False)[:-65] + _OFF_CURVE
    refused(request(off), Reason.BAD_POINT, "E off the curve, another owner's CA, SIG104 wrong")
    refused(request(strange.request(certified=False)), Reason.UNTRUSTED_STATION, "another owner's CA, SIG104 wrong")
    seen = refused(request(strange.request()), Reason.UNTRUSTED_STATION, "another owner's CA")
    probe.close()
    return seen


# -- another key -------------------------------------------------------------------------------------------------------


@rule("confirm-ends-sessions", "Key agreement", Stage.ROTATION)
def confirm_ends_sessions(probe: Probe) -> str:
    """Check that a good Confirm ends every session and half-open Open on every link, and the old key."""
    old_key = probe.link_key
    own, others = probe.open(), []
    probe.sealed_good(IDENTIFY)
    if isinstance(probe.contact.link, MultiStationLink):
        others = [probe.from_station(1), probe.from_station(2)]
        others[0].open()
        others[0].sealed_good(IDENTIFY)
        others[1].open()  # half-open: no Sealed frame is sent
    before, stored = probe.identity(), _teds_of(probe)
    confirm(probe, sealed=True)
    probe.session, probe.before_rotation = None, (before, stored)
    holds(probe.identity().epoch == before.epoch + 1, f"After Confirm the epoch is not {before.epoch + 1}.")
    seen = demand(probe.plain(own.seal(IDENTIFY)), Reason.WRONG_STATE, "Sealed (128.4) in the session of the Confirm")
    for other, what in zip(others, ("another station's session", "another station's half-open Open"), strict=False):
        assert other.session is not None
        late = other.session.seal(IDENTIFY)
        seen = demand(other.plain(late), Reason.WRONG_STATE, f"Sealed (128.4) in {what} after Confirm")
    former = StationSession(old_key, probe.uuid)
    probe.refused(former.open(probe.opening_counter()), Reason.UNKNOWN_KEY, "under the key before Confirm")
    probe.open()
    probe.sealed_good(IDENTIFY)
    probe.close()
    return seen


@rule("rotation-keeps", "Key agreement", Stage.ROTATION)
def rotation_keeps(probe: Probe) -> str:
    """Check that another key changes only the epoch: state, sequence and every TEDS stay.

    Looks at what the Confirm of confirm-ends-sessions left.
    """
    if probe.before_rotation is None:
        raise NotApplicableError("Needs a good Confirm of a node with a key (rule confirm-ends-sessions).")
    before, stored = probe.before_rotation
    after = probe.identity()
    states = f"{before.state.name.lower()} became {after.state.name.lower()}"
    holds(after.state == before.state, f"After a Confirm of a node with a key, {states}; rotation keeps the state.")
    holds(after.sequence == before.sequence, f"Confirm took the sequence from {before.sequence} to {after.sequence}.")
    kept = _teds_of(probe)
    holds(kept == stored, "After a Confirm of a node with a key its TEDS are not what they were.")
    return f"{after.state.name.lower()}, sequence {after.sequence}, {len(kept)} TEDS kept"


def _teds_of(probe: Probe) -> dict[BlockId, bytes]:
    """Return every TEDS, the Security TEDS only if it is signed: an initial one has the epoch, which changes."""
    signed = probe.security().signed
    return {block: probe.teds(block) for block in probe.listed() if signed or block != SECURITY}


# -- a test agreement in the open --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ExplainedRequest:
    """One Request of a test, its reply, and the intermediate values of the profile; keys as bytes.

    The agreement is never confirmed, and the node ends it: none of these values is, or becomes, a key in use.
    """

    request: bytes
    reply: bytes
    security_teds: bytes
    transcript: bytes
    okm: bytes
    tag_due: bytes
    station_tag: bytes
    problem: str
    slip: str | None

    @property
    def confirmation_key(self) -> bytes:
        """The confirmation key M."""
        return self.okm[16:]


def explain(probe: Probe) -> ExplainedRequest:
    """Make a Request that is never confirmed, end it on the node, and return its values.

    A node in factory state is asked by a station and CA made for this request; a node of ours, which answers its
    owner alone, by this station, with a one-time key on both sides. Raises RuleBrokenError, NotApplicableError.
    """
    factory = probe.identity().state == NodeState.FACTORY
    sealed = not factory and not probe.tapped
    if factory:
        tapped_or_bus(probe)
    tried = try_agreement(probe, StrangerStation.make().credentials if factory else probe.station, sealed=sealed)
    ended = (probe.sealed if sealed else probe.plain)(_WRONG_CONFIRM)
    if ended.ok or ended.reason != Reason.BAD_TAG:
        raise RuleBrokenError(
            f"Confirm (128.2) with a wrong tagS, to end the test: refusal 12 is due, {describe_reply(ended)} came."
        )
    probe.close()
    confirmation = tried.okm[16:]
    due = next(tried.agreement.tags(tried.okm + bytes(16), tried.script))[1]
    station = hmac.digest(confirmation, b"station" + tried.script, "sha256")[:16]
    problem, slip = (str(tried.broken), tried.broken.slip) if tried.broken is not None else ("", None)
    made = tried.agreement
    return ExplainedRequest(
        made.request, made.reply, made.teds, tried.script, tried.okm, due, station, problem, slip.name if slip else None
    )
