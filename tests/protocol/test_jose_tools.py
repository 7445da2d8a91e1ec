"""Two other JOSE implementations: the C tool ``jose`` (Debian package) and jwcrypto open ours, and we open theirs."""

from __future__ import annotations

import json
import shutil
import subprocess

import pytest

from teds_provision.errors import NotAuthenticError
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.bundle import TYPE, open_bundle, payload_of, seal_bundle
from teds_provision.protocol.handover.jose import public_jwk
from teds_provision.protocol.handover.receipt import open_receipt, seal_receipt
from teds_provision.protocol.handover.strict_json import encode_base64url
from teds_provision.protocol.keys import fingerprint
from tests.protocol.handover_parts import NOW, RECEIVER, SENDER, THIRD, bundle, trusts
from tests.protocol.test_bundle_receipt import receipt

RECEIVERS = (RECEIVER, THIRD)
HEADER = {"alg": "ES256", "kid": fingerprint(SENDER.point), "typ": TYPE}
PROTECTED = {"alg": "ECDH-ES+A256KW", "enc": "A256GCM", "cty": "JWS"}


def private_jwk(key):
    return public_jwk(key.point) | {"d": encode_base64url(key.secret())}


class CTool:
    """The command ``jose`` with keys and documents in files."""

    def __init__(self, folder):
        self._folder = folder
        if shutil.which("jose") is None:
            pytest.skip("the Debian package jose is not installed (scripts/install-test-packages)")

    def file(self, name, content):
        path = self._folder / name
        path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
        return str(path)

    def run(self, *words):
        return subprocess.run(["jose", *words], capture_output=True, timeout=60, check=True).stdout

    def decrypt(self, octets, key):
        return self.run("jwe", "dec", "-i", self.file("jwe", octets), "-k", self.file("key", private_jwk(key)))

    def verified(self, jws, key):
        signer = self.file("signer", public_jwk(key.point))
        return self.run("jws", "ver", "-i", self.file("jws", jws), "-k", signer, "-O", "-")

    def sign(self, payload, key, header):
        template = self.file("template", {"protected": header})
        words = ("-I", self.file("payload", payload), "-k", self.file("key", private_jwk(key)), "-s", template)
        return self.run("jws", "sig", *words, "-c")

    def encrypt(self, plain, keys, protected):
        words = [
            word for number, key in enumerate(keys) for word in ("-k", self.file(f"k{number}", public_jwk(key.point)))
        ]
        words += [word for number, key in enumerate(keys) for word in ("-r", self.recipient(number, key))]
        template = self.file("jwe-template", {"protected": protected})
        return self.run("jwe", "enc", "-i", template, "-I", self.file("plain", plain), *words)

    def recipient(self, number, key):
        return self.file(f"r{number}", {"header": {"kid": fingerprint(key.point)}})


class JwCrypto:
    """The library jwcrypto."""

    def decrypt(self, octets, key):
        from jwcrypto import jwe

        token = jwe.JWE()
        token.deserialize(octets.decode(), self.key(private_jwk(key)))
        return token.payload

    def verified(self, jws, key):
        from jwcrypto import jws as library

        token = library.JWS()
        token.deserialize(jws.decode(), self.key(public_jwk(key.point)))
        return token.payload

    def sign(self, payload, key, header):
        from jwcrypto import jws

        token = jws.JWS(payload)
        token.add_signature(self.key(private_jwk(key)), None, json.dumps(header), None)
        return token.serialize(compact=True).encode()

    def encrypt(self, plain, keys, protected):
        from jwcrypto import jwe

        token = jwe.JWE(plain, json.dumps(protected))
        for key in keys:
            token.add_recipient(self.key(public_jwk(key.point)), json.dumps({"kid": fingerprint(key.point)}))
        return token.serialize().encode()

    @staticmethod
    def key(members):
        from jwcrypto import jwk

        return jwk.JWK(**members)


@pytest.fixture(params=[pytest.param(CTool, marks=pytest.mark.system), JwCrypto], ids=["jose", "jwcrypto"])
def other(request, tmp_path):
    return CTool(tmp_path) if request.param is CTool else JwCrypto()


OF_A_THOUSAND = pytest.mark.nightly(
    "tests/protocol/test_jose_tools.py::test_we_open_the_others_bundle, "
    "tests/protocol/test_jose_tools.py::test_the_other_opens_our_bundle, with 1 node and with 10,000"
)


OF_BOTH = pytest.mark.nightly(
    "tests/protocol/test_jose_tools.py::test_we_open_the_others_bundle, for two receivers with 1 node, for "
    "one with 10,000"
)


@pytest.mark.parametrize(
    "count", [1, pytest.param(1_000, marks=OF_A_THOUSAND), pytest.param(10_000, marks=pytest.mark.slow)]
)
def test_the_other_opens_our_bundle(other, count):
    made = bundle(count, to=RECEIVERS)
    octets = seal_bundle(made, SENDER, [key.point for key in RECEIVERS])
    for key in RECEIVERS if count == 1 else RECEIVERS[1:]:
        payload = other.verified(other.decrypt(octets, key), SENDER)
        assert json.loads(payload) == json.loads(payload_of(made))


@pytest.mark.parametrize(
    ("receivers", "count"),
    [
        pytest.param(RECEIVERS[:1], 1, id="one receiver-1"),
        pytest.param(RECEIVERS, 1, id="two receivers-1"),
        pytest.param(RECEIVERS[:1], 1_000, id="one receiver-1000", marks=OF_A_THOUSAND),
        pytest.param(RECEIVERS, 1_000, id="two receivers-1000", marks=OF_A_THOUSAND),
        pytest.param(RECEIVERS[:1], 10_000, id="one receiver-10000", marks=pytest.mark.slow),
        pytest.param(RECEIVERS, 10_000, id="two receivers-10000", marks=[pytest.mark.slow, OF_BOTH]),
    ],
)
def test_we_open_the_others_bundle(other, count, receivers):
    made = bundle(count, to=receivers)
    octets = other.encrypt(other.sign(payload_of(made), SENDER, HEADER), receivers, PROTECTED)
    for key in receivers:
        assert open_bundle(octets, key, trusts(SENDER), NOW).bundle == made


def test_the_others_signatures_verify_with_either_s(other):
    for number in range(6 if isinstance(other, CTool) else 40):  # half of the others' signatures have a high s
        token = other.sign(b"%d" % number, SENDER, HEADER)
        found = jose.verify_compact(token, trusts(SENDER), typ=TYPE, max_octets=9999)
        assert found.payload == b"%d" % number


def test_the_other_verifies_our_receipt_and_we_theirs(other):
    octets = seal_receipt(receipt(), RECEIVER)
    payload = other.verified(octets, RECEIVER)
    header = {"alg": "ES256", "kid": fingerprint(RECEIVER.point), "typ": "teds-receipt+jws"}
    assert open_receipt(other.sign(payload, RECEIVER, header), trusts(RECEIVER)) == receipt()


def test_a_name_of_a_sender_on_the_others_signature_does_not_help(other):
    octets = other.encrypt(other.sign(payload_of(bundle()), THIRD, HEADER), RECEIVERS[:1], PROTECTED)
    with pytest.raises(NotAuthenticError):
        open_bundle(octets, RECEIVER, trusts(SENDER), NOW)
