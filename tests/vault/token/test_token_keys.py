"""Keys that lie in a token: the real SoftHSM 2 signs, agrees, and gives nothing out."""

from __future__ import annotations

import pytest

from teds_provision.errors import BadDataError, VaultError
from teds_provision.protocol.keys import Credentials, SoftwareKey, fingerprint, station_key_message, verify
from teds_provision.protocol.wire_agreement import NodeAgreement, StationAgreement

pytestmark = pytest.mark.system


def test_the_station_key_and_the_ca_key_sign_low_s_and_verify(vault):
    station, ca = vault.identity(), vault.ca()
    assert station.point != ca.point
    for number in range(20):  # a token's own k gives a high s every other time
        message = b"TEDS1 datasheet\0%d" % number
        assert verify(station.point, message, station.sign(message))
    assert verify(ca.point, station_key_message(station.point), ca.sign(station_key_message(station.point)))


def test_ecdh_gives_the_whole_x_coordinate_as_software_does(vault):
    station = vault.identity()
    zero_first = 0
    for number in range(1, 20_000):  # one in 256 begins with a zero octet; the loop ends at the first
        peer = SoftwareKey(number)
        x = peer.ecdh(station.point)
        if number < 20 or x[0] == 0:
            assert station.ecdh(peer.point) == x
        zero_first += x[0] == 0
        if zero_first and number >= 20:
            break
    assert zero_first, "no x-coordinate began with a zero octet, so the trap was not tried"


@pytest.mark.parametrize("point", [b"", b"\x04" + bytes(64), b"\x04" + b"\1" * 64, b"\x02" + bytes(32)])
def test_a_point_off_the_curve_never_reaches_the_token(vault, point):
    with pytest.raises(BadDataError):
        vault.identity().ecdh(point)


def test_the_keys_cannot_leave_the_token(vault, tmp_path):
    from pkcs11 import Attribute
    from pkcs11.exceptions import AttributeSensitive

    for key in (vault.identity(), vault.ca()):
        inside = key._key
        assert inside[Attribute.SENSITIVE]
        assert inside[Attribute.ALWAYS_SENSITIVE]
        assert inside[Attribute.NEVER_EXTRACTABLE]
        assert not inside[Attribute.EXTRACTABLE]
        assert inside[Attribute.PRIVATE]
        assert inside[Attribute.LOCAL]
        with pytest.raises(AttributeSensitive):
            inside[Attribute.VALUE]
    with pytest.raises(VaultError, match="cannot leave"):
        vault.export_ca(tmp_path / "ca.pem", "a passphrase")
    assert not (tmp_path / "ca.pem").exists()


def test_an_agreement_leaves_no_secret_object_behind(vault):
    from pkcs11 import Attribute, ObjectClass

    vault.identity().ecdh(SoftwareKey(5).point)
    session = vault._session._session
    assert not list(session.get_objects({Attribute.CLASS: ObjectClass.SECRET_KEY}))


def test_a_key_agreement_of_the_profile_with_the_key_in_the_token(vault):
    from teds_provision.protocol.keys import node_key_message
    from teds_provision.teds.codec.security import SecurityTeds

    node, uuid = SoftwareKey(31), bytes(range(10))
    shown = SecurityTeds(node_key=node.point, node_key_signature=node.sign(node_key_message(uuid, node.point))).encode()
    station = vault.identity()
    signature = vault.ca().sign(station_key_message(station.point))
    agreement = StationAgreement(Credentials(station, signature, vault.ca().point), uuid)
    half = NodeAgreement.answer(node, uuid, agreement.request().payload, epoch=1, teds=shown)
    agreed = agreement.accept(half.reply, shown, pinned=fingerprint(node.point), epoch=0)
    assert agreed.key == half.key
    assert agreed.confirm.payload == half.station_tag
