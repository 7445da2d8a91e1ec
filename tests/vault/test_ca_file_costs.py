"""A key file is a stranger's until its passphrase opens it: what it asks to be computed before is bounded."""

from __future__ import annotations

import base64
import shutil
import subprocess
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.serialization import BestAvailableEncryption, Encoding, PrivateFormat
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import TedsProvisionError, VaultError, WrongPassphraseError
from teds_provision.vault import ca_file
from teds_provision.vault.ca_file import MAX_ROUNDS, ROUNDS, read_ca, write_ca
from tests.pace import costs_at_most

WORDS = "a passphrase for the safe"


def der_of(path: Path) -> bytes:
    return base64.b64decode("".join(path.read_text().split("-----")[2].split()))


def pem_of(der: bytes) -> str:
    label = "ENCRYPTED PRIVATE KEY"
    return f"-----BEGIN {label}-----\n{base64.b64encode(der).decode()}\n-----END {label}-----\n"


def test_more_rounds_than_the_bound_are_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "ca.pem"
    write_ca(path, bytes(31) + b"\x07", WORDS)
    assert read_ca(path, WORDS) == bytes(31) + b"\x07"
    der = der_of(path)
    own = b"\x02\x03" + ROUNDS.to_bytes(3, "big")
    assert der.count(own) == 1
    for many in (MAX_ROUNDS + 1, 0xFFFFFF, 0):
        path.write_text(pem_of(der.replace(own, b"\x02\x03" + many.to_bytes(3, "big"))))
        with costs_at_most(0.1), pytest.raises(VaultError, match="encrypted in an unsupported way"):
            read_ca(path, WORDS)


def test_a_key_sealed_by_scrypt_is_refused_and_the_usual_openssl_ones_open(tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    make = [
        "openssl",
        "genpkey",
        "-algorithm",
        "EC",
        "-pkeyopt",
        "ec_paramgen_curve:P-256",
        "-aes256",
        "-pass",
        "stdin",
    ]
    plain = subprocess.run(make[:6], check=True, capture_output=True).stdout
    (tmp_path / "usual.pem").write_bytes(
        subprocess.run(make, input=WORDS.encode(), check=True, capture_output=True).stdout
    )
    assert len(read_ca(tmp_path / "usual.pem", WORDS)) == 32
    (tmp_path / "plain.pem").write_bytes(plain)
    seal = ["openssl", "pkcs8", "-topk8", "-in", str(tmp_path / "plain.pem"), "-scrypt", "-passout", "stdin"]
    (tmp_path / "scrypt.pem").write_bytes(
        subprocess.run(seal, input=WORDS.encode(), check=True, capture_output=True).stdout
    )
    with pytest.raises(VaultError, match="encrypted in an unsupported way"):
        read_ca(tmp_path / "scrypt.pem", WORDS)


PBES2, PBKDF2 = "06092a864886f70d01050d", "06092a864886f70d01050c"


@pytest.mark.parametrize(
    ("parameters", "counted"),
    [
        ("30 0a 0402 abcd 0202 0800", True),  # a salt of two octets, 2,048 rounds
        ("30 81 0a 0402 abcd 0202 0800", True),  # a length in the long form
        ("30 82 000a 0402 abcd 0202 0800", True),
        ("30 0a 0402 abcd 0208 0000000000989680", True),  # 10,000,000, the most
        ("30 0a 0402 abcd 0208 0000000000989681", False),
        ("30 0a 0402 abcd 0209 000000000000000800", False),  # a number of nine octets
        ("30 0a 0402 abcd 0200", False),  # of none
        ("31 0a 0402 abcd 0202 0800", False),  # no SEQUENCE
        ("30 0a 0502 abcd 0202 0800", False),  # the salt is no OCTET STRING
        ("30 0a 0480 abcd 0202 0800", False),  # its length is not one octet
        ("30 81 86 0480" + "ab" * 128 + "0202 0800", False),  # nor is this one
        ("30 81 85 047f" + "ab" * 127 + "0202 0800", True),
        ("30 0a 0402 abcd 0302 0800", False),  # the number is no INTEGER
        ("30 0a 0402 abcd", False),  # cut off
        ("30", False),
        ("", False),
    ],
)
def test_rounds_are_counted_before_a_passphrase_is_tried(tmp_path: Path, parameters: str, counted: bool) -> None:
    """A cost within the limits is tried, and yields no key; any other cost is not tried."""
    path = tmp_path / "ca.pem"
    path.write_text(pem_of(bytes.fromhex(f"{PBES2} {PBKDF2} {parameters}")))
    with pytest.raises(VaultError) as refused:
        read_ca(path, WORDS)
    assert isinstance(refused.value, WrongPassphraseError) is counted
    if not counted:
        assert refused.value.message == f"{path} is encrypted in an unsupported way."
        assert "PBES2 and PBKDF2 of at most 10,000,000 rounds" in refused.value.hint


@pytest.mark.parametrize("missing", [PBES2, PBKDF2])
def test_only_pbes2_with_pbkdf2_is_tried(tmp_path: Path, missing: str) -> None:
    path = tmp_path / "ca.pem"
    path.write_text(pem_of(bytes.fromhex(f"{PBES2} {PBKDF2} 300a0402abcd02020800".replace(missing, ""))))
    with pytest.raises(VaultError, match="encrypted in an unsupported way"):
        read_ca(path, WORDS)


def test_what_is_no_base64_is_encrypted_in_no_way_that_is_known(tmp_path: Path) -> None:
    path = tmp_path / "ca.pem"
    path.write_text("-----BEGIN ENCRYPTED PRIVATE KEY-----\nMIIBA\n-----END ENCRYPTED PRIVATE KEY-----\n")
    with pytest.raises(VaultError, match="encrypted in an unsupported way"):
        read_ca(path, WORDS)


@pytest.mark.parametrize(
    "key", [ec.generate_private_key(ec.SECP384R1()), ed25519.Ed25519PrivateKey.generate()], ids=["P-384", "Ed25519"]
)
def test_a_key_of_another_kind_is_no_ca_key(
    tmp_path: Path, key: ec.EllipticCurvePrivateKey | ed25519.Ed25519PrivateKey
) -> None:
    path = tmp_path / "ca.pem"
    sealed = BestAvailableEncryption(WORDS.encode())
    path.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, sealed))
    with pytest.raises(VaultError) as refused:
        read_ca(path, WORDS)
    assert refused.value.message == f"{path} contains no P-256 key."
    assert refused.value.hint == "Give the file that trust ca export wrote."


@pytest.mark.parametrize("curve", ["06072a8648ce3d0201 06022a03", "06022a03"], ids=["curve", "algorithm"])
def test_a_key_of_a_kind_that_no_one_knows_is_named_as_such(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, curve: str
) -> None:
    path = tmp_path / "ca.pem"
    monkeypatch.setattr(ca_file, "ROUNDS", 65_536)  # the number is no rule here, and costs
    scalar = "0427 3025 020101 0420" + "07" * 32
    own = bytes.fromhex(f"020100 30{len(bytes.fromhex(curve)):02x} {curve} {scalar}")
    path.write_bytes(ca_file._encrypted_pem(bytes([0x30, len(own)]) + own, WORDS))
    with pytest.raises(VaultError) as refused:
        read_ca(path, WORDS)
    assert refused.value.message == f"{path} contains an unsupported kind of key."
    assert refused.value.hint == "Give the file that trust ca export wrote."


@given(octets=st.binary(max_size=200))
def test_no_octets_raise_anything_foreign(tmp_path_factory: pytest.TempPathFactory, octets: bytes) -> None:
    path = tmp_path_factory.mktemp("ca") / "ca.pem"
    path.write_text(pem_of(octets))
    with pytest.raises((TedsProvisionError, WrongPassphraseError)):
        read_ca(path, WORDS)


def test_salt_and_iv_are_two_random_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    left = [b"a random number!", b"and another one!"]
    with monkeypatch.context() as patch:
        patch.setattr("os.urandom", lambda octets: left.pop(0)[:octets])
        pem = ca_file._encrypted_pem(b"der", "four random words")
    der = base64.b64decode("".join(pem.decode().splitlines()[1:-1]))
    assert [octets in der for octets in (b"a random number!", b"and another one!")] == [True, True]


def test_an_empty_passphrase_is_a_wrong_one(tmp_path: Path) -> None:
    write_ca(tmp_path / "ca.pem", bytes(31) + b"\7", "four random words")
    with pytest.raises(WrongPassphraseError):
        read_ca(tmp_path / "ca.pem", "")
    assert read_ca(tmp_path / "ca.pem", "four random words") == bytes(31) + b"\7"
