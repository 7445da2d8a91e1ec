"""The node's half of the key agreement: the order of its checks, and what lies in RAM between Request and Confirm."""

from __future__ import annotations

from dataclasses import replace

import pytest

from teds_provision.errors import GarbledError, KeyMismatchError, NotAuthenticError, PolicyError
from teds_provision.protocol.keys import (
    GROUP_ORDER,
    Credentials,
    SoftwareKey,
    agreement_message,
    fingerprint,
    node_key_message,
    station_key_message,
)
from teds_provision.protocol.messages.frames import Function, Reason, Reply, refusal, security_command
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.tim import Tim
from teds_provision.protocol.wire_agreement import (
    AgreedKey,
    NodeAgreement,
    RequestPayload,
    StationAgreement,
    TranscriptMismatchError,
    transcript,
)
from teds_provision.teds.codec import security

from .desk import CA, CREDENTIALS, NODE, STATION, UUID, Desk
from .memory import PowerCutError

OTHER_CA = SoftwareKey(11)
OFF_CURVE = b"\x04" + bytes(63) + b"\x01"
GOOD = RequestPayload(STATION.point, CREDENTIALS.station_signature, CA.point, SoftwareKey(13).point)


def request(**changes: bytes) -> RequestPayload:
    return RequestPayload(**{**vars(GOOD), **changes})


def reason_of(desk: Desk, payload: RequestPayload) -> int | None:
    return desk.plain(security_command(Function.REQUEST, payload.encode())).reason


@pytest.mark.parametrize("which", ["station", "ca", "one_time"])
@pytest.mark.parametrize("point", [OFF_CURVE, bytes(65), b"\x02" + STATION.point[1:33] + bytes(32), NODE.point])
def test_every_point_is_decoded_strictly(which: str, point: bytes) -> None:
    assert reason_of(Desk(), request(**{which: point})) == Reason.BAD_POINT


def test_a_foreign_ca_is_refused_before_its_signature_is_looked_at() -> None:
    other = request(ca=OTHER_CA.point, station_signature=bytes(64))
    assert reason_of(Desk().agree(), other) == Reason.UNTRUSTED_STATION
    assert reason_of(Desk(), other) == Reason.BAD_SIGNATURE


@pytest.mark.parametrize("signature", ["zero", "of another key", "high s"])
def test_sig104_must_verify(signature: str) -> None:
    good = CREDENTIALS.station_signature
    wrong = {
        "zero": bytes(64),
        "of another key": CA.sign(station_key_message(SoftwareKey(17).point)),
        "high s": good[:32] + (GROUP_ORDER - int.from_bytes(good[32:], "big")).to_bytes(32, "big"),
    }[signature]
    assert reason_of(Desk(), request(station_signature=wrong)) == Reason.BAD_SIGNATURE


def test_points_come_before_the_ca_and_the_ca_before_the_signature() -> None:
    desk = Desk().agree()
    assert reason_of(desk, request(ca=OTHER_CA.point, one_time=OFF_CURVE)) == Reason.BAD_POINT
    assert reason_of(desk, request(ca=OTHER_CA.point, station_signature=bytes(64))) == Reason.UNTRUSTED_STATION


def test_another_station_of_the_same_owner_may_rekey() -> None:
    second = SoftwareKey(19)
    desk = Desk().agree()
    desk.agree(Credentials(second, CA.sign(station_key_message(second.point)), CA.point))
    assert (desk.flash.epoch, desk.flash.station, desk.flash.ca) == (2, second.point, CA.point)


# -- between Request and Confirm ---------------------------------------------------------------------------------------


def half_way(desk: Desk, *, link: str = "nfc") -> AgreedKey:
    agreement = StationAgreement(CREDENTIALS, UUID)
    reply = desk.plain(agreement.request(), link=link)
    return agreement.accept(reply.payload, desk.flash.security_teds(), pinned=None, epoch=desk.flash.epoch)


def test_nothing_is_durable_before_confirm() -> None:
    desk = Desk()
    confirm = half_way(desk).confirm
    assert desk.flash.state == NodeState.FACTORY
    desk.restart()
    assert desk.plain(confirm) == refusal(Reason.WRONG_STATE)


def test_a_wrong_tag_gets_12_and_drops_the_agreement() -> None:
    desk = Desk()
    confirm = half_way(desk).confirm
    assert desk.plain(security_command(Function.CONFIRM, bytes(16))) == refusal(Reason.BAD_TAG)
    assert desk.plain(confirm) == refusal(Reason.WRONG_STATE)


def test_a_confirm_of_the_wrong_length_or_from_elsewhere_leaves_it() -> None:
    desk = Desk()
    confirm = half_way(desk).confirm
    assert desk.plain(security_command(Function.CONFIRM, bytes(15))) == refusal(Reason.BAD_FORM)
    assert desk.plain(confirm, link="can:f1") == refusal(Reason.WRONG_STATE)
    assert desk.plain(confirm) == Reply(True)


def test_a_bad_request_leaves_it_and_a_good_one_replaces_it() -> None:
    desk = Desk()
    first = half_way(desk)
    assert reason_of(desk, request(one_time=OFF_CURVE)) == Reason.BAD_POINT
    second = half_way(desk)
    assert desk.plain(first.confirm) == refusal(Reason.BAD_TAG)
    assert desk.plain(second.confirm) == refusal(Reason.WRONG_STATE), "the wrong tag dropped the second one"


@pytest.mark.parametrize(("seconds", "reply"), [(59.9, Reply(True)), (60.0, refusal(Reason.WRONG_STATE))])
def test_it_goes_after_60_seconds(seconds: float, reply: Reply) -> None:
    desk = Desk()
    confirm = half_way(desk).confirm
    desk.now += seconds
    assert desk.plain(confirm) == reply


def test_it_goes_with_its_link_but_not_with_another() -> None:
    desk = Desk()
    confirm = half_way(desk).confirm
    desk.tim.link_lost("can:f1")
    assert desk.plain(confirm) == Reply(True)
    desk = Desk()
    confirm = half_way(desk).confirm
    desk.tim.link_lost("nfc")
    assert desk.plain(confirm) == refusal(Reason.WRONG_STATE)


def test_a_confirm_must_come_in_the_session_of_its_request() -> None:
    desk = Desk().agree().open()
    agreement = StationAgreement(CREDENTIALS, UUID)
    teds = desk.flash.security_teds()
    agreed = agreement.accept(desk.sealed(agreement.request()).payload, teds, pinned=None, epoch=1)
    assert desk.plain(agreed.confirm) == refusal(Reason.WRONG_STATE)
    assert desk.sealed(agreed.confirm) == Reply(True)
    assert desk.flash.epoch == 2


def test_rotation_keeps_the_state_and_the_datasheet() -> None:
    desk = Desk().provision()
    before = desk.flash.security_teds()
    desk.agree()
    assert desk.flash.state == NodeState.PROVISIONED
    assert desk.flash.security_teds() == before


@pytest.mark.parametrize("when", ["die_before", "die_after"])
def test_power_cut_in_confirm_leaves_all_old_or_all_new(when: str) -> None:
    desk = Desk()
    agreed = half_way(desk)
    setattr(desk.memory, when, True)
    with pytest.raises(PowerCutError):
        desk.plain(agreed.confirm)
    expected = (None, 0) if when == "die_before" else (agreed.key, 1)
    assert (desk.flash.key, desk.flash.epoch) == expected


def test_a_flash_that_fails_gets_11_and_keeps_the_old_state() -> None:
    desk = Desk()
    agreed = half_way(desk)
    desk.memory.fail = True
    assert desk.plain(agreed.confirm) == refusal(Reason.FLASH_FAILURE)
    assert desk.flash.state == NodeState.FACTORY


@pytest.mark.parametrize(("held", "taken"), [(0, True), (1, False), (2, False)])
def test_the_station_refuses_an_epoch_that_is_not_greater_than_that_of_its_key(held: int, taken: bool) -> None:
    desk = Desk()
    agreement = StationAgreement(CREDENTIALS, UUID)
    reply = desk.plain(agreement.request()).payload  # offers epoch 1
    if taken:
        assert agreement.accept(reply, desk.flash.security_teds(), pinned=None, epoch=held).epoch == 1
    else:
        with pytest.raises(PolicyError, match=f"offers key epoch 1; this station already holds epoch {held}"):
            agreement.accept(reply, desk.flash.security_teds(), pinned=None, epoch=held)


def test_the_station_refuses_another_key_than_the_pinned_one_in_the_agreement_itself() -> None:
    """What was identified a moment ago need not be what answers the Request."""
    desk = Desk()
    agreement = StationAgreement(CREDENTIALS, UUID)
    reply = desk.plain(agreement.request()).payload
    with pytest.raises(KeyMismatchError):
        agreement.accept(reply, desk.flash.security_teds(), pinned=fingerprint(SoftwareKey(17).point), epoch=0)


def test_the_station_refuses_a_key_that_is_not_signed_for_this_uuid_in_the_agreement_itself() -> None:
    desk = Desk()
    elsewhere = NODE.sign(node_key_message(bytes(10), NODE.point))
    desk.memory.state = replace(desk.flash, node_key_signature=elsewhere)
    desk.restart()
    agreement = StationAgreement(CREDENTIALS, UUID)
    reply = desk.plain(agreement.request()).payload
    for pinned in (None, fingerprint(NODE.point)):
        with pytest.raises(NotAuthenticError, match="field 102"):
            agreement.accept(reply, desk.flash.security_teds(), pinned=pinned, epoch=0)


# -- the station's half: the order of its checks -----------------------------------------------------------------------


class AgreementReply:
    """A good reply to a Request, and what the node that made it would say with another En, T or key."""

    def __init__(self) -> None:
        self.one_time = SoftwareKey(13)
        self.agreement = StationAgreement(CREDENTIALS, UUID, one_time=self.one_time)
        self.teds = Desk().flash.security_teds()

    def reply(self, *, epoch: int = 1, one_time: SoftwareKey | None = None, signer: SoftwareKey = NODE) -> bytes:
        """Return what a node with this key answers; ``signer`` makes sigN alone."""
        payload = self.agreement.request().payload
        pair = one_time or SoftwareKey(23)
        made = NodeAgreement.answer(NODE, UUID, payload, epoch=epoch, teds=self.teds, nonce=bytes(16), one_time=pair)
        if signer is NODE:
            return made.reply
        script = transcript(payload, bytes(16), epoch, pair.point, UUID, NODE.point, self.teds)
        return made.reply[:-64] + signer.sign(agreement_message(script))

    def accept(self, reply: bytes, *, epoch: int = 0) -> AgreedKey:
        return self.agreement.accept(reply, self.teds, pinned=None, epoch=epoch)


def with_en(reply: bytes, point: bytes) -> bytes:
    return reply[:20] + point + reply[85:]


def bent(reply: bytes, at: int) -> bytes:
    return reply[:at] + bytes([reply[at] ^ 1]) + reply[at + 1 :]


TAG_AT = 85


def test_the_station_checks_length_point_tag_proof_and_epoch_in_this_order() -> None:
    answered = AgreementReply()
    everything = with_en(bent(bent(answered.reply(signer=CA), TAG_AT), 19), OFF_CURVE)
    with pytest.raises(GarbledError, match="164 octets, not 165"):
        answered.accept(everything[:-1], epoch=1)
    with pytest.raises(GarbledError, match="166 octets, not 165"):
        answered.accept(everything + b"\0", epoch=1)
    with pytest.raises(NotAuthenticError, match="one-time key"):
        answered.accept(everything, epoch=1)
    with pytest.raises(TranscriptMismatchError) as tag:
        answered.accept(bent(answered.reply(signer=CA), TAG_AT), epoch=1)
    with pytest.raises(NotAuthenticError, match="sigN") as proof:
        answered.accept(answered.reply(signer=CA), epoch=1)
    with pytest.raises(PolicyError, match="offers key epoch 1") as stale:
        answered.accept(answered.reply(), epoch=1)
    assert "try again at the reader" in tag.value.hint
    assert "Do not use it" in proof.value.hint
    assert "take it to the bench and reset it by hand" in stale.value.hint
    assert answered.accept(answered.reply()).epoch == 1


@pytest.mark.parametrize("whose", ["E", "P(station)", "P(node)", "off the curve", "zeros"])
def test_en_is_a_one_time_key_of_the_node_and_nothing_else(whose: str) -> None:
    """With En = P(node) a thief of the identity key could read what was agreed on before."""
    answered = AgreementReply()
    holders = {"E": answered.one_time, "P(station)": STATION, "P(node)": NODE}
    if whose in holders:
        reply = answered.reply(one_time=holders[whose])  # right in everything else
    else:
        reply = with_en(answered.reply(), OFF_CURVE if whose == "off the curve" else bytes(65))
    with pytest.raises(NotAuthenticError, match="one-time key"):
        answered.accept(reply)


def test_a_high_s_in_the_proof_of_an_agreement_is_refused() -> None:
    answered = AgreementReply()
    reply = answered.reply()
    high = GROUP_ORDER - int.from_bytes(reply[-32:], "big")
    with pytest.raises(NotAuthenticError, match="sigN"):
        answered.accept(reply[:-32] + high.to_bytes(32, "big"))


def test_a_thief_of_the_station_key_cannot_pose_as_a_node() -> None:
    """Under KeyAgreement 1 he could: ECDH(station, node) was known to him as well."""
    answered = AgreementReply()
    with pytest.raises(NotAuthenticError, match="sigN"):
        answered.accept(answered.reply(signer=STATION))


def test_the_datasheet_that_the_station_read_is_part_of_what_is_agreed_on() -> None:
    answered = AgreementReply()
    reply = answered.reply()
    answered.teds = security.initial(NODE.point, Desk().flash.node_key_signature, sequence=1, key_epoch=0)
    with pytest.raises(TranscriptMismatchError):
        answered.accept(reply)


def test_the_identity_key_of_a_node_only_signs() -> None:
    class Slot:
        """A PSA key slot whose policy allows ECDSA alone."""

        point = NODE.point

        def sign(self, message: bytes) -> bytes:
            return NODE.sign(message)

        sign_digest = NODE.sign_digest

        def ecdh(self, peer: bytes) -> bytes:
            raise AssertionError("the policy of this key does not permit agreement")

    desk = Desk()
    desk.tim = Tim(Slot(), desk.memory, lambda: desk.now)
    desk.provision().agree()
    assert desk.flash.epoch == 2


def test_a_one_time_key_is_for_one_request_and_e_is_no_static_key() -> None:
    desk = Desk()
    replies = [desk.plain(security_command(Function.REQUEST, GOOD.encode())).payload for _ in range(2)]
    assert replies[0][20:85] != replies[1][20:85]
    assert reason_of(desk, request(one_time=STATION.point)) == Reason.BAD_POINT


@pytest.mark.parametrize(("asked", "reset"), [("nfc", "can:f1"), ("can:f1", "nfc")])
def test_a_reset_on_another_link_ends_a_pending_agreement_too(asked: str, reset: str) -> None:
    desk = Desk()
    confirm = half_way(desk, link=asked).confirm
    assert desk.plain(security_command(Function.RESET, bytes(32)), link=reset).ok
    assert desk.plain(confirm, link=asked) == refusal(Reason.WRONG_STATE)
    assert desk.flash.key is None


@pytest.mark.parametrize("by", ["command", "hand"])
def test_a_reset_ends_a_pending_agreement_in_factory_state_too(by: str) -> None:
    desk = Desk()
    confirm = half_way(desk).confirm
    if by == "command":
        assert desk.plain(security_command(Function.RESET, bytes(32))).ok
    else:
        desk.tim.reset_by_hand()
    assert desk.plain(confirm) == refusal(Reason.WRONG_STATE)
