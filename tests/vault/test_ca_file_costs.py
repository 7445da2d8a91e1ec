"""A key file is a stranger's until its passphrase opens it: what it asks to be computed before is bounded."""

from __future__ import annotations

import base64
import shutil
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import TedsProvisionError, VaultError, WrongPassphraseError
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


@given(octets=st.binary(max_size=200))
def test_no_octets_raise_anything_foreign(tmp_path_factory: pytest.TempPathFactory, octets: bytes) -> None:
    path = tmp_path_factory.mktemp("ca") / "ca.pem"
    path.write_text(pem_of(octets))
    with pytest.raises((TedsProvisionError, WrongPassphraseError)):
        read_ca(path, WORDS)
