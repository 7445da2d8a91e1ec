"""A handover between stations whose keys lie in tokens: SoftHSM on both sides, and another JOSE on either."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from teds_provision.errors import PolicyError, VaultError
from teds_provision.protocol.handover.bundle import open_bundle, payload_of, seal_bundle
from teds_provision.protocol.handover.receipt import open_receipt, seal_receipt
from teds_provision.protocol.handover.revocation import open_revocation, seal_revocation
from teds_provision.protocol.keys import fingerprint, station_key_message
from teds_provision.vault.pkcs11 import Pkcs11Vault
from tests.protocol.handover_parts import NOW, RECEIVER, SENDER, bundle, trusts
from tests.protocol.test_bundle_receipt import receipt
from tests.protocol.test_jose_tools import HEADER, PROTECTED, CTool
from tests.vault.softhsm import MODULE, PIN, loaded, unload

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def stations(tmp_path_factory):
    """Yield two stations, each with a token of its own."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("hsm")
        made = []
        for label, uri in loaded(folder, patch, ("north", "south")).items():
            (folder / label).mkdir()
            made.append(Pkcs11Vault.create(folder / label, label, uri, pin))
        yield made
        unload()


def pin(prompt, confirm):
    return PIN


@pytest.fixture
def reopened(stations, tmp_path):
    """Opens the south's vault again for the tests after one that closed it."""
    yield
    uri = f"pkcs11:token=south?module-path={MODULE}"
    stations[1] = Pkcs11Vault.create(tmp_path, "south", uri, pin)


def between(sender, receiver, ca, count):
    made = bundle(count, to=(receiver,))
    signature = ca.sign(station_key_message(receiver.point))
    return replace(
        made,
        sender=fingerprint(sender.point),
        ca=ca.point,
        station_signatures={fingerprint(receiver.point): signature},
    )


@pytest.mark.parametrize("count", [1, 1_000, 10_000])
def test_from_token_to_token(stations, count):
    north, south = stations[0].identity(), stations[1].identity()
    made = between(north, south, stations[0].ca(), count)
    octets = seal_bundle(made, north, [south.point])
    found = open_bundle(octets, south, trusts(north), NOW)
    assert found.bundle == made
    assert found.station_signature is not None
    with pytest.raises(PolicyError, match="not sealed for this station"):
        open_bundle(octets, north, trusts(north), NOW)


def test_the_receipt_and_the_deny_list_are_signed_in_the_token(stations):
    north, south = stations[0].identity(), stations[1].identity()
    made = receipt(sender=fingerprint(south.point), to=fingerprint(north.point))
    assert open_receipt(seal_receipt(made, south), trusts(south)) == made
    denied = seal_revocation(north, uuid=bytes(10), node=None, why="lost", created=NOW)
    assert open_revocation(denied.statement, trusts(north)) == denied


@pytest.mark.parametrize("count", [1, 1_000])
def test_signed_in_the_token_and_opened_by_the_jose_tool(stations, tmp_path, count):
    north, tool = stations[0].identity(), CTool(tmp_path)
    made = between(north, RECEIVER, stations[0].ca(), count)
    octets = seal_bundle(made, north, [RECEIVER.point])
    assert json.loads(tool.verified(tool.decrypt(octets, RECEIVER), north)) == json.loads(payload_of(made))


@pytest.mark.parametrize("count", [1, 1_000])
def test_sealed_by_the_jose_tool_and_opened_in_the_token(stations, tmp_path, count):
    south, tool = stations[1].identity(), CTool(tmp_path)
    made = between(SENDER, south, stations[0].ca(), count)
    octets = tool.encrypt(tool.sign(payload_of(made), SENDER, HEADER), [south], PROTECTED)
    assert open_bundle(octets, south, trusts(SENDER), NOW).bundle == made


def test_a_token_that_fails_is_no_fault_of_the_bundle(stations, reopened):
    south = stations[1].identity()
    octets = seal_bundle(between(SENDER, south, stations[0].ca(), 1), SENDER, [south.point])
    stations[1].close()
    with pytest.raises(VaultError, match="The token failed"):
        open_bundle(octets, south, trusts(SENDER), NOW)
