"""The node's half of the key agreement: the order of its checks, and what lies in RAM between Request and Confirm."""

from __future__ import annotations

from dataclasses import replace

import pytest

from teds_provision.errors import NotAuthentic, OtherKey, PolicyRefused
from teds_provision.protocol.agreement import AgreedKey, Credentials, RequestPayload, StationAgreement
from teds_provision.protocol.keys import GROUP_ORDER, SoftwareKey, fingerprint, node_key_message, station_key_message
from teds_provision.protocol.messages.frames import Function, Reason, Reply, refusal, security_command
from teds_provision.protocol.messages.identity import NodeState

from .desk import CA, CREDENTIALS, NODE, STATION, UUID, Desk
from .memory import PowerCut

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
    return agreement.accept(reply.payload, pinned=None, epoch=desk.flash.epoch)


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
    agreed = agreement.accept(desk.sealed(agreement.request()).payload, pinned=None, epoch=1)
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
    with pytest.raises(PowerCut):
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
        assert agreement.accept(reply, pinned=None, epoch=held).epoch == 1
    else:
        with pytest.raises(PolicyRefused, match=f"offers key epoch 1; this station already holds epoch {held}"):
            agreement.accept(reply, pinned=None, epoch=held)


def test_the_station_refuses_another_key_than_the_pinned_one_in_the_agreement_itself() -> None:
    """What was identified a moment ago need not be what answers the Request."""
    desk = Desk()
    agreement = StationAgreement(CREDENTIALS, UUID)
    reply = desk.plain(agreement.request()).payload
    with pytest.raises(OtherKey):
        agreement.accept(reply, pinned=fingerprint(SoftwareKey(17).point), epoch=0)


def test_the_station_refuses_a_key_that_is_not_signed_for_this_uuid_in_the_agreement_itself() -> None:
    desk = Desk()
    elsewhere = NODE.sign(node_key_message(bytes(10), NODE.point))
    desk.memory.state = replace(desk.flash, node_key_signature=elsewhere)
    desk.restart()
    agreement = StationAgreement(CREDENTIALS, UUID)
    with pytest.raises(NotAuthentic, match="field 102"):
        agreement.accept(desk.plain(agreement.request()).payload, pinned=None, epoch=0)
