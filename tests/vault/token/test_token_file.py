"""The file beside a token: what it holds, what is noticed, and how a backup of it comes back."""

from __future__ import annotations

import json
import stat
from dataclasses import replace

import pytest

from teds_provision.errors import TedsProvisionError, VaultChangedError, VaultError
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.vault import pkcs11
from teds_provision.vault.master import MasterKeys
from teds_provision.vault.pkcs11 import FILE_NAME, Pkcs11Vault
from tests.vault.softhsm import PIN
from tests.vault.token.person import Person, in_new_process

pytestmark = pytest.mark.system
STORE = "5e" * 16
CONTEXT = b"a node"


def test_a_wrapped_key_opens_under_its_context_alone_and_in_a_new_process(vault, home, store_id, uri, uris):
    wrapped = vault.wrap(b"sixteen octets!!", context=CONTEXT)
    assert vault.unwrap(wrapped, context=CONTEXT) == b"sixteen octets!!"
    with pytest.raises(VaultError, match="does not belong"):
        vault.unwrap(wrapped, context=b"another")
    code = (
        "import sys; from pathlib import Path; from teds_provision.vault.pkcs11 import Pkcs11Vault\n"
        f"v = Pkcs11Vault.open(Path(sys.argv[1]), sys.argv[2], sys.argv[3], lambda p, c: {PIN!r})\n"
        f"print(v.unwrap(bytes.fromhex(sys.argv[4]), context={CONTEXT!r}).decode(), v.identity().point.hex())"
    )
    done = in_new_process(uris, code, str(home), store_id, uri, wrapped.hex())
    assert done.stdout.split() == ["sixteen", "octets!!", vault.identity().point.hex()], done.stderr


def test_the_file_is_private_and_holds_neither_key_nor_pin(vault, home):
    path = home / FILE_NAME
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    text = path.read_text()
    assert PIN not in text
    for master in vault._content.masters.keys.values():
        assert master.hex() not in text
    assert PIN not in repr(vault)


def test_every_changed_digit_of_the_file_is_noticed(vault, home, store_id, uri):
    path = home / FILE_NAME
    text = path.read_text()
    for at in range(0, len(text), 7):
        if text[at] not in "0123456789abcdef":
            continue
        path.write_text(text[:at] + ("0" if text[at] != "0" else "1") + text[at + 1 :])
        with pytest.raises(VaultError):
            Pkcs11Vault.open(home, store_id, uri, Person())
    path.write_text(text)
    assert Pkcs11Vault.open(home, store_id, uri, Person()).identity().point == vault.identity().point


def test_masters_that_someone_else_sealed_to_the_station_key_are_refused(vault, home, store_id, uri):
    """Whoever may write the file knows the public key; without the signature they could choose the master key."""
    forger = pkcs11._Content(vault._content.station, vault._content.ca, MasterKeys({1: bytes(32)}))
    outsider = SoftwareKey(5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(forger.station), "sign", lambda _, message: outsider.sign(message))
        pkcs11._save(home, store_id, forger, replace=True)
    with pytest.raises(VaultError, match="was changed"):
        Pkcs11Vault.open(home, store_id, uri, Person())


@pytest.mark.parametrize("content", ["", "{", "[]", "null", "{}", '{"station": 1, "ca": 2}', "[" * 9999, "x" * 70_000])
def test_a_file_that_is_something_else_is_named_before_anyone_is_asked(home, store_id, uri, content):
    (home / FILE_NAME).write_text(content)
    person = Person()
    with pytest.raises(VaultError, match=FILE_NAME):
        Pkcs11Vault.open(home, store_id, uri, person)
    assert not person.prompts


def test_a_missing_file_and_one_of_another_store(vault, home, store_id, uri):
    with pytest.raises(VaultError, match="another store"):
        Pkcs11Vault.open(home, STORE, uri, Person())
    (home / FILE_NAME).unlink()
    with pytest.raises(VaultError, match="missing"):
        Pkcs11Vault.open(home, store_id, uri, Person())


def test_a_change_of_the_master_key(vault, home, store_id, uri):
    before = vault.wrap(b"k" * 16, context=CONTEXT)
    vault.add_master()
    after = vault.wrap(b"k" * 16, context=CONTEXT)
    again = Pkcs11Vault.open(home, store_id, uri, Person())
    assert again.unwrap(before, context=CONTEXT) == again.unwrap(after, context=CONTEXT) == b"k" * 16
    again.retire_masters()
    last = Pkcs11Vault.open(home, store_id, uri, Person())
    assert last.unwrap(after, context=CONTEXT) == b"k" * 16
    with pytest.raises(VaultError, match="lacks"):
        last.unwrap(before, context=CONTEXT)


def test_a_change_keeps_what_another_process_changed_before(vault, home, store_id, uri):
    other = Pkcs11Vault.open(home, store_id, uri, Person())
    set_pin = vault.new_passphrase(lambda prompt, confirm: PIN)  # to what it is: the other one's session stays open
    for change in (vault.add_master, vault.retire_masters, vault.drop_ca, set_pin):
        other.add_master()
        wrapped = other.wrap(b"k" * 16, context=CONTEXT)
        change()
        if change is not set_pin:
            other.refresh()
        assert Pkcs11Vault.open(home, store_id, uri, Person()).unwrap(wrapped, context=CONTEXT) == b"k" * 16
    for change in (
        other.add_master,
        other.retire_masters,
        other.drop_ca,
        other.new_passphrase(lambda prompt, confirm: PIN),
    ):
        with pytest.raises(VaultChangedError):
            change()


def test_a_backup_opens_with_the_same_token_alone(vault, tmp_path, store_id, uri, uris):
    wrapped, backup = vault.wrap(b"k" * 16, context=CONTEXT), vault.secret_material()
    for name in ("again", "elsewhere"):
        (tmp_path / name).mkdir()
    again = Pkcs11Vault.create(tmp_path / "again", store_id, uri, Person(), restored=backup)
    assert again.unwrap(wrapped, context=CONTEXT) == b"k" * 16
    with pytest.raises(VaultError, match="does not hold the station key"):
        Pkcs11Vault.create(tmp_path / "elsewhere", store_id, uris["spare"], Person(), restored=backup)
    for damaged in ("", backup.replace('"nonce": "', '"nonce": "00'), backup.replace(store_id, STORE)):
        with pytest.raises(VaultError):
            Pkcs11Vault.create(tmp_path / "elsewhere", store_id, uri, Person(), restored=damaged)
    assert not (tmp_path / "elsewhere" / FILE_NAME).exists()


def test_a_backup_joins_what_is_there_and_another_stations_does_not(vault, home, tmp_path, store_id, uri, uris):
    wrapped, backup = vault.wrap(b"k" * 16, context=CONTEXT), vault.secret_material()
    vault.add_master()
    vault.retire_masters()
    again = Pkcs11Vault.create(home, store_id, uri, Person(), restored=backup)
    assert again.unwrap(wrapped, context=CONTEXT) == b"k" * 16
    (tmp_path / "other").mkdir()
    other = Pkcs11Vault.create(tmp_path / "other", store_id, uri.replace("?", ";id=%09?"), Person())
    with pytest.raises(VaultError, match="another station"):
        Pkcs11Vault.create(home, store_id, uri, Person(), restored=other.secret_material())


def test_an_older_backup_brings_back_old_master_keys_without_losing_the_new(vault, home, store_id, uri):
    old, backup = vault.wrap(b"o" * 16, context=CONTEXT), vault.secret_material()
    vault.add_master()
    vault.retire_masters()
    vault.drop_ca()
    new = vault.wrap(b"n" * 16, context=CONTEXT)
    Pkcs11Vault.create(home, store_id, uri, Person(), restored=backup)
    again = Pkcs11Vault.open(home, store_id, uri, Person())
    assert (again.unwrap(old, context=CONTEXT), again.unwrap(new, context=CONTEXT)) == (b"o" * 16, b"n" * 16)
    assert again.ca() is None  # it was taken out since, and stays out


def test_a_backup_comes_back_without_the_ca_key_that_was_destroyed_since(vault, tmp_path, store_id, uri):
    wrapped, backup = vault.wrap(b"k" * 16, context=CONTEXT), vault.secret_material()
    vault.drop_ca()
    (tmp_path / "elsewhere").mkdir()
    again = Pkcs11Vault.create(tmp_path / "elsewhere", store_id, uri, Person(), restored=backup)
    assert again.unwrap(wrapped, context=CONTEXT) == b"k" * 16
    assert again.ca() is None
    assert Pkcs11Vault.open(tmp_path / "elsewhere", store_id, uri, Person()).ca() is None


def test_a_backup_that_brings_nothing_leaves_the_file_as_it_is(vault, home, store_id, uri):
    backup = vault.secret_material()
    vault.add_master()
    before = (home / FILE_NAME).read_bytes()
    Pkcs11Vault.create(home, store_id, uri, Person(), restored=backup)
    assert (home / FILE_NAME).read_bytes() == before


def test_two_lives_of_one_station_are_not_called_two_stations(vault, home, tmp_path, store_id, uri):
    """An old backup restored, its master key made anew, then a newer backup, whose second master key is another one."""
    old = vault.secret_material()
    vault.add_master()
    newer = vault.secret_material()
    (tmp_path / "elsewhere").mkdir()
    restored = Pkcs11Vault.create(tmp_path / "elsewhere", store_id, uri, Person(), restored=old)
    restored.add_master()
    before = restored.secret_material()
    with pytest.raises(VaultError, match="are of one station, but each has another master key") as error:
        Pkcs11Vault.create(tmp_path / "elsewhere", store_id, uri, Person(), restored=newer)
    assert "another --home" in error.value.hint
    assert restored.secret_material() == before


def test_a_backup_joins_what_another_process_has_added_by_then(vault, home, store_id, uri):
    backup = pkcs11._content_of(
        pkcs11._parsed(vault.secret_material().encode(), store_id, "The backup"), vault._session
    )
    other = Pkcs11Vault.open(home, store_id, uri, Person())
    vault.add_master()
    vault.retire_masters()
    other.refresh()
    vault.add_master()
    wrapped = vault.wrap(b"k" * 16, context=CONTEXT)
    other._join(backup)
    assert Pkcs11Vault.open(home, store_id, uri, Person()).unwrap(wrapped, context=CONTEXT) == b"k" * 16
    assert other.masters() == (1, 2, 3)


def signed_again(vault, home, **changes):
    """Write the file with other members, signed by the station key in the token."""
    members = {name: value for name, value in json.loads((home / FILE_NAME).read_text()).items() if name != "signature"}
    members |= changes
    members["signature"] = vault.identity().sign(pkcs11._signed(members)).hex()
    (home / FILE_NAME).write_text(json.dumps(members))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pins": "1"}, "vault-pkcs11.json is damaged (pins)."),
        ({"nonce": "0g"}, "vault-pkcs11.json is damaged (nonce)."),
        ({"sealed": 5}, "vault-pkcs11.json is damaged (sealed)."),
        ({"sealed": "00" * 48}, "The token does not open what was sealed to its key."),
        ({"nonce": ""}, "The token does not open what was sealed to its key."),
        ({"station": 1}, "vault-pkcs11.json does not say which key is the station key."),
        ({"station": {"label": "x", "id": "01"}}, "vault-pkcs11.json does not say which key is the station key."),
        ({"ca": {"label": "x", "id": "0g", "point": ""}}, "vault-pkcs11.json does not say which key is the CA key."),
    ],
)
def test_a_member_that_is_something_else_is_named(vault, home, store_id, uri, changes, message):
    """Even under a good signature: only the station itself could have written it, by a defect."""
    signed_again(vault, home, **changes)
    with pytest.raises(VaultError) as refused:
        Pkcs11Vault.open(home, store_id, uri, Person())
    assert refused.value.message == message
    cure = (
        "Check the token's driver." if "does not open" in message else "Restore this file from a backup of this station"
    )
    assert refused.value.hint.startswith(cure)


def test_a_key_in_the_token_that_is_not_the_one_from_init_is_refused(vault, home, store_id, uri):
    own = json.loads((home / FILE_NAME).read_text())["station"]
    signed_again(vault, home, station={**own, "point": SoftwareKey(5).point.hex()})
    with pytest.raises(VaultError) as refused:
        Pkcs11Vault.open(home, store_id, uri, Person())
    assert refused.value.message == f"The station key {own['label']!r} in the token 'bench' is not the one from init."
    assert refused.value.hint == "Plug in the token that was used at init."


def test_no_ca_key_comes_from_a_file_and_master_keys_of_another_process_are_taken_as_they_are(vault, tmp_path):
    with pytest.raises(VaultError) as refused:
        vault.import_ca(tmp_path / "ca.pem", "a passphrase for the safe")
    assert refused.value.message == "A CA key from a file cannot be imported into a token."
    assert refused.value.hint == "Use --keystore file in another home."
    before, other = vault.master_keys(), MasterKeys({7: bytes(range(32))})
    wrapped = other.wrap(bytes(16), context=b"x")
    vault.accept(other)
    assert (vault.masters(), vault.unwrap(wrapped, context=b"x")) == ((7,), bytes(16))
    vault.reread()
    assert vault.master_keys().keys == before.keys, "the file says otherwise"


def test_a_new_file_takes_the_place_of_none(vault, home, store_id):
    before = (home / FILE_NAME).read_bytes()
    with pytest.raises(TedsProvisionError):
        pkcs11._save(home, store_id, vault._content, replace=False)
    assert (home / FILE_NAME).read_bytes() == before


def test_what_is_read_again_are_the_master_keys_and_not_how_often_the_pin_was_changed(vault, monkeypatch):
    newer = replace(vault._content, pins=7, masters=vault._content.masters.with_new())
    pins = vault._content.pins
    monkeypatch.setattr(pkcs11, "_load", lambda *_: (newer, None))
    vault.reread()
    assert (vault._content.pins, vault.masters()) == (pins, (1, 2))
