"""What the vault writes, octet for octet: a vault of today must open in every later version."""

from __future__ import annotations

import base64
import json
import sys
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.kdf.argon2 import Argon2id

from teds_provision.errors import UnknownMasterKeyError, VaultError, WrongPassphraseError
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.vault.base import node_key_context
from teds_provision.vault.file_vault import FileVault
from teds_provision.vault.master import MasterKeys, Material
from teds_provision.vault.passphrase import Costs, SealingKey, check_new, seal, unseal, unseal_with
from tests.vault.passphrase import GOOD, STORE, Person

UUID = bytes.fromhex("8d4d9da65281f7000001")
MASTER, OTHER = bytes(range(32)), bytes(range(32, 64))
IDENTITY, CA = (5).to_bytes(32, "big"), (7).to_bytes(32, "big")
SALT, NONCE = bytes(range(16)), bytes(range(12))
CHEAP = Costs(memory_kib=32, iterations=1, lanes=4)


def text(octets: bytes) -> str:
    return base64.b64encode(octets).decode()


def argon(passphrase: bytes, salt: bytes = SALT) -> bytes:
    return Argon2id(salt=salt, length=32, iterations=1, lanes=4, memory_cost=32).derive(passphrase)


# -- wrapped node keys -------------------------------------------------------------------------------------------------

CONTEXT = b"TEDS1 wrapped key\0" + b"\0\x20" + STORE.encode() + UUID + b"\0\0\0\x07" + b"\0\0\0\x02"


def wrapped(number: int, master: bytes, *, version: int = 1, context: bytes = CONTEXT) -> bytes:
    head = bytes([version]) + number.to_bytes(4, "big")
    return head + NONCE + AESGCM(master).encrypt(NONCE, b"k" * 16, head + context)


def test_a_wrapped_key_is_bound_to_its_store_node_epoch_and_slot() -> None:
    assert node_key_context(STORE, UUID, 7, 2) == CONTEXT
    masters = MasterKeys({1: OTHER, 0x01020304: MASTER})
    assert masters.unwrap(wrapped(0x01020304, MASTER), context=CONTEXT) == b"k" * 16
    assert masters.unwrap(wrapped(1, OTHER), context=CONTEXT) == b"k" * 16
    made = masters.wrap(b"k" * 16, context=CONTEXT)
    assert made[:5] == b"\x01\x01\x02\x03\x04", "under the highest number"
    assert AESGCM(MASTER).decrypt(made[5:17], made[17:], made[:5] + CONTEXT) == b"k" * 16
    assert len(made) == 49


@pytest.mark.parametrize(
    ("octets", "error"),
    [
        (b"", "is damaged"),
        (wrapped(1, OTHER)[:32], "is damaged"),
        (wrapped(1, OTHER)[:33], "does not belong"),
        (wrapped(1, OTHER, version=2), "is damaged"),
        (wrapped(1, MASTER), "does not belong"),
        (wrapped(1, OTHER, context=CONTEXT + b"\0"), "does not belong"),
        (wrapped(2, OTHER), "under a master key that the vault lacks"),
    ],
)
def test_what_no_master_key_opens(octets: bytes, error: str) -> None:
    with pytest.raises(VaultError, match=error) as caught:
        MasterKeys({1: OTHER}).unwrap(octets, context=CONTEXT)
    assert isinstance(caught.value, UnknownMasterKeyError) is ("lacks" in error)


def test_a_new_master_key_has_the_next_number_and_the_old_ones_go() -> None:
    two = MasterKeys({3: OTHER, 1: MASTER}).with_new()
    assert (sorted(two.keys), two.current, len(two.keys[4])) == ([1, 3, 4], 4, 32)
    assert (two.keys[1], two.keys[3]) == (MASTER, OTHER)
    assert two.newest_only().keys == {4: two.keys[4]}
    assert list(MasterKeys.generate().keys) == [1]


# -- the station's keys ------------------------------------------------------------------------------------------------


def line(**changes: Any) -> str:
    members = {"identity": text(IDENTITY), "ca": text(CA), "masters": {"1": text(MASTER), "2": text(OTHER)}} | changes
    return "teds1:" + text(json.dumps(members, separators=(",", ":")).encode())


def test_a_stations_keys_are_one_line() -> None:
    material = Material(IDENTITY, CA, MasterKeys({1: MASTER, 2: OTHER}))
    assert material.encode() == line()
    assert Material.decode(line()) == material
    assert material.with_ca(None).encode() == line(ca=None)
    assert Material.decode(line(ca=None)) == material.with_ca(None)


@pytest.mark.parametrize(
    "octets",
    [
        line(masters={}), line(masters={"1": text(MASTER[:31])}), line(masters={"one": text(MASTER)}),
        line(identity=text(IDENTITY[1:])), line(ca=text(CA + b"\0")), line(identity=None),
        line().removeprefix("teds1:"),
        "teds2:" + line().removeprefix("teds1:"), line() + "!",
    ],
)  # fmt: skip
def test_a_line_that_holds_other_keys_is_refused(octets: str) -> None:
    with pytest.raises(VaultError):
        Material.decode(octets)


# -- sealed under a passphrase -----------------------------------------------------------------------------------------


def sealed(plain: bytes, context: bytes, *, passphrase: bytes = GOOD.encode(), salt: bytes = SALT) -> dict[str, Any]:
    return {
        "kdf": "argon2id", "memory_kib": 32, "iterations": 1, "lanes": 4, "salt": text(salt), "cipher": "aes-256-gcm",
        "nonce": text(NONCE), "ciphertext": text(AESGCM(argon(passphrase, salt)).encrypt(NONCE, plain, context)),
    }  # fmt: skip


def test_what_is_sealed_under_a_passphrase_says_how_it_is_opened() -> None:
    opened, key = unseal(GOOD, sealed(b"plain", b"context"), context=b"context")
    assert (opened, key.costs, key.salt, key.key) == (b"plain", CHEAP, SALT, argon(GOOD.encode()))
    made = key.seal(b"again", context=b"other")
    assert list(made) == ["kdf", "memory_kib", "iterations", "lanes", "salt", "cipher", "nonce", "ciphertext"]
    assert {name: made[name] for name in list(made)[:6]} == {
        name: value for name, value in sealed(b"", b"").items() if name not in ("nonce", "ciphertext")
    }
    nonce, ciphertext = (base64.b64decode(made[name]) for name in ("nonce", "ciphertext"))
    assert AESGCM(key.key).decrypt(nonce, ciphertext, b"other") == b"again"
    assert (len(nonce), len(SealingKey.derive(GOOD, costs=CHEAP).salt)) == (12, 16)
    with pytest.raises(WrongPassphraseError):
        unseal(GOOD, sealed(b"plain", b"context"), context=b"another")


def test_an_agent_opens_with_salt_and_key_while_the_salt_is_the_same() -> None:
    held = SALT + argon(GOOD.encode())
    found = unseal_with(held, sealed(b"plain", b"c"), context=b"c")
    assert found is not None
    assert (found[0], found[1].salt, found[1].key) == (b"plain", SALT, held[16:])
    assert unseal_with(held, sealed(b"plain", b"c"), context=b"d") is None
    assert unseal_with(held, sealed(b"plain", b"c", salt=SALT[::-1]), context=b"c") is None
    other_salt = bytes(16) + argon(GOOD.encode())
    assert unseal_with(other_salt, sealed(b"plain", b"c"), context=b"c") is None


@pytest.mark.parametrize(
    ("change", "good"),
    [
        ({}, True),
        ({"salt": text(bytes(7))}, False),
        ({"salt": text(bytes(65))}, False),
        ({"nonce": text(bytes(11))}, False),
        ({"nonce": text(bytes(13))}, False),
        ({"ciphertext": text(bytes(16))}, False),
        ({"kdf": "argon2i"}, False),
        ({"cipher": "aes-128-gcm"}, False),
        ({"iterations": 0}, False),
        ({"lanes": "x"}, False),
        ({"salt": None}, False),
        ({"nonce": "AAECAwQFBgcICQoL="}, False),
    ],
)
def test_a_sealed_object_of_another_form_is_damaged(change: dict[str, Any], good: bool) -> None:
    whole = sealed(b"plain", b"c") | change
    if good:
        assert unseal(GOOD, whole, context=b"c")[0] == b"plain"
        return
    with pytest.raises(VaultError, match="is damaged"):
        unseal(GOOD, whole, context=b"c")


@pytest.mark.parametrize("octets", [8, 64])
def test_a_salt_has_8_to_64_octets(octets: int) -> None:
    assert unseal(GOOD, sealed(b"plain", b"c", salt=bytes(octets)), context=b"c")[0] == b"plain"


@pytest.mark.parametrize(
    ("passphrase", "why"),
    [
        ("1234567", "too short: at least 8 characters"),
        ("äöüäöüä", "too short: at least 8 characters"),  # of 14 octets
        ("12345678", None),
        ("aaaaaaaaaaaa", "repeats one character"),
        ("aaaaaaab", None),
        ("four random\twords", "control character"),
        ("ab" * 512, None),
        ("ab" * 512 + "c", "longer than 1024 octets"),
        ("äb" * 342, "longer than 1024 octets"),
        ("four random \udcff words", "not valid text"),
    ],
)
def test_a_new_passphrase(passphrase: str, why: str | None) -> None:
    if why is None:
        check_new(passphrase)
        return
    with pytest.raises(VaultError, match=why):
        check_new(passphrase)
    with pytest.raises(VaultError, match=why):
        seal(passphrase, b"", context=b"", costs=CHEAP)


def test_a_python_without_argon2id_names_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.kdf.argon2", None)
    with pytest.raises(VaultError, match="has no Argon2id") as refused:
        SealingKey.derive(GOOD, costs=CHEAP)
    assert refused.value.hint == "Install the wheel of cryptography from PyPI."


def test_a_passphrase_is_taken_in_unicodes_form_kc() -> None:
    assert SealingKey.derive("ﬁngers Å 8", costs=CHEAP, salt=SALT).key == argon("fingers Å 8".encode())


# -- the file ----------------------------------------------------------------------------------------------------------


def test_a_vault_in_a_file(tmp_path: Path) -> None:
    content = {"format": "teds-provision-vault/1", "store": STORE}
    whole = content | sealed(line().encode(), b"teds-provision-vault/1\0" + STORE.encode())
    path = tmp_path / "vault.json"
    path.write_text(json.dumps(whole))
    vault = FileVault.open(tmp_path, STORE, Person())
    assert vault.secret_material() == line()
    assert (vault.identity().point, vault.masters()) == (SoftwareKey(5).point, (1, 2))
    ca = vault.ca()
    assert ca is not None
    assert ca.point == SoftwareKey(7).point
    assert vault.opener() == SALT + argon(GOOD.encode())
    assert (vault.kind, vault.description) == ("file", f"passphrase file {path}")
    assert vault.unwrap(wrapped(2, OTHER), context=CONTEXT) == b"k" * 16
    vault.add_master()
    after = json.loads(path.read_text())
    assert list(after) == list(whole)
    assert {name: after[name] for name in after if name not in ("nonce", "ciphertext")} == {
        name: whole[name] for name in whole if name not in ("nonce", "ciphertext")
    }
    held = FileVault.open(tmp_path, STORE, Person("never asked for"), held=vault.opener())
    assert held.masters() == (1, 2, 3)
