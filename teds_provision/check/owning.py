"""Rules of factory state, of a node that has a key, and of the key agreement that gives it one."""

from __future__ import annotations

import os
from dataclasses import dataclass

from teds_provision.check.outcome import NotApplicable
from teds_provision.check.probe import Probe, demand, holds
from teds_provision.check.rule import Stage, rule
from teds_provision.check.teds_rules import security_state
from teds_provision.protocol.agreement import AgreedKey, Credentials, RequestPayload, StationAgreement
from teds_provision.protocol.keys import (
    CHALLENGE_OCTETS,
    GROUP_ORDER,
    SIGNATURE_OCTETS,
    SoftwareKey,
    fingerprint,
    normalise_signature,
    reset_message,
    station_key_message,
    verify,
)
from teds_provision.protocol.messages.frames import Command, Function, Reason, security_command
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.session import OPEN_OCTETS
from teds_provision.teds.image import SECURITY

_OFF_CURVE = b"\x04" + bytes(64)


@dataclass(frozen=True)
class Strangers:
    """A station and its CA, made for one question."""

    station: SoftwareKey
    ca: SoftwareKey

    @classmethod
    def make(cls) -> Strangers:
        """New keys."""
        return cls(SoftwareKey.generate(), SoftwareKey.generate())

    def request(self, *, certified: bool = True, one_time: bytes = b"") -> bytes:
        """Payload of a Request of theirs."""
        signer = self.ca if certified else self.station
        signature = signer.sign(station_key_message(self.station.point))
        one_time = one_time or SoftwareKey.generate().point
        return RequestPayload(self.station.point, signature, self.ca.point, one_time).encode()


def request(payload: bytes) -> Command:
    """Request (128.1) with any payload."""
    return security_command(Function.REQUEST, payload)


def tapped_or_bus(probe: Probe) -> None:
    """Whether Request is looked at on this link at all: tapped, or the bus of a node without NFC in factory state."""
    if probe.tapped:
        return
    if probe.plain(request(b"")).reason == Reason.NOT_PERMITTED:
        raise NotApplicable("Request is not permitted on this link: the node is to be tapped.")


# -- factory state -----------------------------------------------------------------------------------------------------


@rule("factory-open", "Which command when", Stage.FACTORY)
def factory_open(probe: Probe) -> str:
    """Open in either form, and Sealed, get 2 in factory state."""
    probe.refused(security_command(Function.OPEN), Reason.WRONG_STATE)
    probe.refused(security_command(Function.OPEN, bytes(OPEN_OCTETS)), Reason.WRONG_STATE)
    return probe.refused(security_command(Function.SEALED, bytes(36)), Reason.WRONG_STATE)


def require_reset_proof(probe: Probe, epoch: int, challenge: bytes, proof: bytes) -> None:
    """Raise RuleBroken unless the reply to Reset is signed by the node's key, over this challenge."""
    message = reset_message(probe.uuid, epoch, challenge)
    right = len(proof) == SIGNATURE_OCTETS and verify(probe.security().node_key, message, normalise_signature(proof))
    holds(right, "Reset (128.9): the proof does not verify under field 101 at this epoch.")


@rule("factory-reset", "Reset", Stage.FACTORY)
def factory_reset(probe: Probe) -> str:
    """Reset in factory state changes nothing and gives the proof."""
    before, challenge = probe.identity(), os.urandom(CHALLENGE_OCTETS)
    require_reset_proof(probe, before.epoch, challenge, probe.good(security_command(Function.RESET, challenge)))
    after = probe.identity()
    holds(after == before, f"Reset (128.9) in factory state changed Identify from {before} to {after}.")
    return f"a proof for epoch {before.epoch}, nothing changed"


@rule("request-checks", "Key agreement", Stage.FACTORY)
def request_checks(probe: Probe) -> str:
    """Length before points before SIG104: 4, 15, 5."""
    tapped_or_bus(probe)
    strange = Strangers.make()
    wrong = strange.request(certified=False)
    probe.refused(request(_OFF_CURVE + wrong[65:-1]), Reason.BAD_FORM, "one octet short, P(station) off the curve")
    probe.refused(request(_OFF_CURVE + wrong[65:]), Reason.BAD_POINT, "P(station) off the curve, SIG104 wrong")
    probe.refused(request(wrong[:-65] + _OFF_CURVE), Reason.BAD_POINT, "E off the curve, SIG104 wrong")
    own = probe.security().node_key
    probe.refused(request(strange.request(one_time=own)), Reason.BAD_POINT, "E the node's own point")
    return probe.refused(request(wrong), Reason.BAD_SIGNATURE, "SIG104 of another key")


@rule("request-high-s", "Notation", Stage.FACTORY)
def request_high_s(probe: Probe) -> str:
    """Whoever verifies refuses an s in the upper half: a Request whose SIG104 has one gets 5."""
    tapped_or_bus(probe)
    good = Strangers.make().request()
    high = GROUP_ORDER - int.from_bytes(good[97:129], "big")
    twisted = good[:97] + high.to_bytes(32, "big") + good[129:]
    return probe.refused(request(twisted), Reason.BAD_SIGNATURE, "SIG104 with a high s")


@rule("confirm-without-request", "Key agreement", Stage.FACTORY)
def confirm_without_request(probe: Probe) -> str:
    """A Confirm with nothing pending gets 2."""
    tapped_or_bus(probe)
    return probe.refused(security_command(Function.CONFIRM, bytes(16)), Reason.WRONG_STATE)


# -- the agreement -----------------------------------------------------------------------------------------------------


def agree(probe: Probe, credentials: Credentials, *, epoch: int) -> AgreedKey:
    """Send a good Request and check its reply; nothing is kept on either side yet. Raises as ``accept`` does."""
    agreement = StationAgreement(credentials, probe.uuid)
    reply = probe.good(agreement.request())
    teds = probe.teds(SECURITY)
    return agreement.accept(reply, teds, pinned=fingerprint(probe.security().node_key), epoch=epoch)


@rule("confirm-checks", "Key agreement", Stage.AGREEMENT)
def confirm_checks(probe: Probe) -> str:
    """A Confirm of wrong length gets 4 and leaves what pends; a wrong tagS gets 12, and what pends goes."""
    tapped_or_bus(probe)
    before = probe.identity()
    agreed = agree(probe, probe.station, epoch=0)
    wrong = bytes([agreed.confirm.payload[0] ^ 1]) + agreed.confirm.payload[1:]
    probe.refused(security_command(Function.CONFIRM, wrong[:-1]), Reason.BAD_FORM)
    probe.refused(security_command(Function.CONFIRM, wrong), Reason.BAD_TAG, "tagS wrong")
    demand(probe.plain(agreed.confirm), Reason.WRONG_STATE, "Confirm (128.2) after a wrong tagS")
    after = probe.identity()
    holds(after == before, f"Identify went from {before} to {after} although no Confirm was good.")
    return "4, 12, then 2; nothing changed"


@rule("confirm-newest", "Key agreement", Stage.AGREEMENT)
def confirm_newest(probe: Probe) -> str:
    """What pends goes at a new good Request: the tagS of the one before gets 12."""
    tapped_or_bus(probe)
    first = agree(probe, probe.station, epoch=0)
    agree(probe, probe.station, epoch=0)
    return demand(probe.plain(first.confirm), Reason.BAD_TAG, "Confirm (128.2) of the Request before the last")


@rule("agreement-epoch", "Key agreement", Stage.AGREEMENT)
def agreement_epoch(probe: Probe) -> str:
    """The epoch that Request offers is the stored one + 1, and Request alone changes nothing."""
    tapped_or_bus(probe)
    before = probe.identity()
    agreed = agree(probe, probe.station, epoch=0)
    holds(agreed.epoch == before.epoch + 1, f"Request offers epoch {agreed.epoch}; {before.epoch + 1} is due.")
    holds(probe.identity() == before, "Request changed what Identify says before its Confirm.")
    return f"epoch {agreed.epoch} offered"


@rule("agreement-fresh", "Key agreement", Stage.AGREEMENT)
def agreement_fresh(probe: Probe) -> str:
    """Each Request gets a nonce of its own."""
    tapped_or_bus(probe)
    nonces = {probe.good(StationAgreement(probe.station, probe.uuid).request())[:16] for _ in range(2)}
    holds(len(nonces) == 2, "Two Requests (128.1) were answered with the same nonceN.")
    return "two Requests, two nonces"


# -- a node that has a key ---------------------------------------------------------------------------------------------


@rule("keyed-untapped", "Which command when", Stage.KEYED)
def keyed_untapped(probe: Probe) -> str:
    """Untapped Request, Confirm and Set CAN address get 3 once the node has a key."""
    if probe.tapped:
        raise NotApplicable("This link counts as tapped; try it over CAN.")
    # what is refused here would change nothing even where it is let through: its SIG104, length and state are wrong
    probe.refused(request(Strangers.make().request(certified=False)), Reason.NOT_PERMITTED)
    probe.refused(security_command(Function.CONFIRM, bytes(16)), Reason.NOT_PERMITTED)
    return probe.refused(security_command(Function.SET_CAN_ADDRESS, b"\0"), Reason.NOT_PERMITTED)


@rule("keyed-security", "The Security TEDS", Stage.KEYED)
def keyed_security(probe: Probe) -> str:
    """With a key too the Security TEDS agrees with Identify: a new epoch is in the initial one at once."""
    return security_state(probe)


@rule("confirm-elsewhere", "Key agreement", Stage.KEYED)
def confirm_elsewhere(probe: Probe) -> str:
    """A Confirm that is not by the same session as its Request gets 2, looked at before its tag."""
    if not probe.tapped:
        raise NotApplicable("Needs a tap: try it over NFC.")
    probe.sealed_good(StationAgreement(probe.station, probe.uuid).request())
    wrong = security_command(Function.CONFIRM, bytes(16))  # a wrong tagS: no node takes a key by it
    seen = probe.refused(wrong, Reason.WRONG_STATE, "plain, of a Request in a session")
    probe.close()
    probe.good(StationAgreement(probe.station, probe.uuid).request())
    probe.sealed_refused(wrong, Reason.WRONG_STATE, "of a plain Request")
    probe.refused(wrong, Reason.BAD_TAG, "tagS wrong")
    probe.close()
    return seen


@rule("keyed-reset", "Which command when", Stage.KEYED)
def keyed_reset(probe: Probe) -> str:
    """A plain Reset of a node with a key gets 3. It is sent too short, so that no node obeys it."""
    return probe.refused(security_command(Function.RESET), Reason.NOT_PERMITTED)


@rule("first-owner-wins", "Key agreement", Stage.KEYED)
def first_owner_wins(probe: Probe) -> str:
    """A Request that shows another CA, tapped or in a session, gets 14, looked at before SIG104."""
    probe.require(NodeState.KEYED, NodeState.PROVISIONED)
    refused = probe.refused if probe.tapped else probe.sealed_refused
    refused(request(Strangers.make().request(certified=False)), Reason.UNTRUSTED_STATION, "SIG104 wrong too")
    seen = refused(request(Strangers.make().request()), Reason.UNTRUSTED_STATION, "another owner's CA")
    probe.close()
    return seen
