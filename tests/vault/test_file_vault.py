"""The passphrase file: made once, never overwritten, changed atomically, opened with the right passphrase alone."""

from __future__ import annotations

import base64
import json
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import (
    KeyringUnavailableError,
    StoreError,
    UsageError,
    VaultChangedError,
    VaultError,
    WrongPassphraseError,
)
from teds_provision.protocol.keys import SoftwareKey, verify
from teds_provision.vault import file_vault
from teds_provision.vault.file_vault import FileVault
from teds_provision.vault.keyring_vault import KeyringVault
from teds_provision.vault.master import Material
from teds_provision.vault.passphrase import PRODUCT, THROWAWAY, seal, unseal
from teds_provision.vault.selection import create_vault, open_vault
from teds_provision.vault.software import merge_keys
from tests.pace import costs_at_most
from tests.passphrase_costs import product_costs
from tests.vault.passphrase import GOOD, STORE, Person


def test_the_keys_come_back_with_the_passphrase(tmp_path: Path, vault: FileVault) -> None:
    again = FileVault.open(tmp_path, STORE, Person())
    assert again.identity().point == vault.identity().point
    ours, theirs = vault.ca(), again.ca()
    assert ours is not None
    assert theirs is not None
    assert theirs.point == ours.point != vault.identity().point
    assert verify(vault.identity().point, b"m", again.identity().sign(b"m"))


def test_the_product_pays_64_mib_and_says_so_in_the_file(tmp_path: Path) -> None:
    with product_costs():
        vault, why = create_vault(tmp_path, STORE, "file", Person())
    content = json.loads((tmp_path / "vault.json").read_text())
    assert (vault.kind, why) == ("file", "as requested")
    assert (content["kdf"], content["memory_kib"], content["iterations"], content["lanes"]) == ("argon2id", 65536, 3, 4)
    assert (PRODUCT.memory_kib, PRODUCT.iterations, PRODUCT.lanes) == (65536, 3, 4)


def test_the_file_is_for_its_owner_alone_and_nothing_else_is_left(tmp_path: Path, vault: FileVault) -> None:
    vault.drop_ca()
    assert [path.name for path in tmp_path.iterdir()] == ["vault.json"]
    assert stat.S_IMODE((tmp_path / "vault.json").stat().st_mode) == 0o600


def test_no_secret_is_in_the_file_or_in_a_repr(tmp_path: Path, vault: FileVault) -> None:
    material = vault._material
    text = (tmp_path / "vault.json").read_text() + repr(vault) + repr(material) + repr(vault._key) + str(vars(vault))
    for secret in (material.identity, material.ca or b"", *material.masters.keys.values(), vault._key.key):
        assert secret.hex() not in text
        assert repr(secret) not in text
    assert GOOD not in text
    assert material.encode() not in text


@pytest.mark.parametrize("wrong", ["", "four random words her", GOOD + " ", GOOD.upper(), "x" * 5000])
def test_a_wrong_passphrase_is_distinguished_from_damage(tmp_path: Path, vault: FileVault, wrong: str) -> None:
    with pytest.raises(VaultError) as caught:
        FileVault.open(tmp_path, STORE, Person(wrong))
    assert isinstance(caught.value, WrongPassphraseError) or len(wrong) > 1024
    assert caught.value.exit_code == 7
    assert wrong == "" or wrong not in str(caught.value) + caught.value.hint


def test_a_passphrase_typed_in_another_unicode_form_is_the_same(tmp_path: Path) -> None:
    FileVault.create(tmp_path, STORE, Person("größe und länge"), costs=THROWAWAY)
    decomposed = "gro\u0308ße und la\u0308nge"
    FileVault.open(tmp_path, STORE, Person(decomposed))


@pytest.mark.parametrize(
    "weak",
    ["", "short", "1234567", "aaaaaaaaaaaa", "line\nbreak here", "nul\0 in the middle", "\udce9" * 4 + "abcdefg"],
)
def test_a_weak_or_impossible_passphrase_makes_no_vault(tmp_path: Path, weak: str) -> None:
    with pytest.raises(VaultError):
        FileVault.create(tmp_path, STORE, Person(weak), costs=THROWAWAY)
    assert list(tmp_path.iterdir()) == []


def test_a_second_init_opens_the_vault_and_changes_nothing(tmp_path: Path, vault: FileVault) -> None:
    before = (tmp_path / "vault.json").read_bytes()
    person = Person()
    again = FileVault.create(tmp_path, STORE, person, costs=THROWAWAY)
    assert again.identity().point == vault.identity().point
    assert [confirm for _, confirm in person.asked] == [False]
    assert (tmp_path / "vault.json").read_bytes() == before
    with pytest.raises(WrongPassphraseError):
        FileVault.create(tmp_path, STORE, Person("quite another one"))
    assert (tmp_path / "vault.json").read_bytes() == before


def test_the_vault_of_another_store_is_refused_before_anyone_is_asked(tmp_path: Path, vault: FileVault) -> None:
    person = Person()
    with pytest.raises(VaultError, match="another store"):
        FileVault.open(tmp_path, "77" * 16, person)
    assert person.asked == []
    content = json.loads((tmp_path / "vault.json").read_text())
    (tmp_path / "vault.json").write_text(json.dumps({**content, "store": "77" * 16}))
    with pytest.raises(WrongPassphraseError):
        FileVault.open(tmp_path, "77" * 16, person)


def test_a_missing_vault_names_the_cure(tmp_path: Path) -> None:
    with pytest.raises(VaultError, match="missing") as caught:
        FileVault.open(tmp_path, STORE, Person())
    assert "restore" in caught.value.hint


def test_a_process_unlocks_once(tmp_path: Path) -> None:
    person = Person()
    vault, _ = create_vault(tmp_path, STORE, "file", person, costs=THROWAWAY)
    assert open_vault(tmp_path, STORE, "file", person) is vault
    assert isinstance(vault, FileVault)
    vault.drop_ca()
    assert open_vault(tmp_path, STORE, "file", person) is vault
    assert len(person.asked) == 1


def test_a_vault_that_another_process_replaced_is_read_again(tmp_path: Path) -> None:
    person = Person()
    vault, _ = create_vault(tmp_path, STORE, "file", person, costs=THROWAWAY)
    FileVault.open(tmp_path, STORE, person).drop_ca()
    assert vault.ca() is not None
    fresh = open_vault(tmp_path, STORE, "file", person)
    assert fresh.ca() is None
    assert len(person.asked) == 2  # by its maker and by the other: the key of the file is known still


def test_the_keys_of_another_station_in_the_same_file_are_not_taken_in(tmp_path: Path, vault: FileVault) -> None:
    before = vault.secret_material()
    FileVault.open(tmp_path, STORE, Person())._save(Material.generate())
    with pytest.raises(VaultError, match="another station"):
        vault.refresh()
    assert vault.secret_material() == before


def test_a_new_passphrase_replaces_the_old(tmp_path: Path, vault: FileVault) -> None:
    vault.new_passphrase(Person("another good passphrase"), costs=THROWAWAY)()
    with pytest.raises(WrongPassphraseError):
        FileVault.open(tmp_path, STORE, Person())
    again = FileVault.open(tmp_path, STORE, Person("another good passphrase"))
    assert again.identity().point == vault.identity().point


CHANGES: dict[str, Callable[[FileVault, Path, str], object]] = {
    "another passphrase": lambda vault, pem, old: vault.new_passphrase(Person(), costs=THROWAWAY)(),
    "the CA key dropped": lambda vault, pem, old: vault.drop_ca(),
    "the CA key taken in": lambda vault, pem, old: vault.import_ca(pem, GOOD),
    "one more master key": lambda vault, pem, old: vault.add_master(),
    "the old master keys deleted": lambda vault, pem, old: vault.retire_masters(),
    "a backup joined": lambda vault, pem, old: vault.join(old),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_change_keeps_what_another_process_changed_before(
    tmp_path: Path, vault: FileVault, change: Callable[[FileVault, Path, str], object]
) -> None:
    """A vault is read once and kept: what it wrote from that alone would lose a master key, and each key under it."""
    vault.export_ca(tmp_path / "ca.pem", GOOD)
    vault.add_master()
    old = vault.secret_material()
    other = FileVault.open(tmp_path, STORE, Person())
    if change is CHANGES["the CA key taken in"]:
        vault.drop_ca()
        other.refresh()
    other.add_master()
    wrapped = other.wrap(b"a key of node 1.", context=b"1")
    change(vault, tmp_path / "ca.pem", old)
    again = FileVault.open(tmp_path, STORE, Person())
    assert again.unwrap(wrapped, context=b"1") == b"a key of node 1."
    with pytest.raises(VaultError):
        again.unwrap(wrapped, context=b"2")
    again.new_passphrase(Person("another good passphrase"), costs=THROWAWAY)()
    with pytest.raises(VaultChangedError):
        change(vault, tmp_path / "ca.pem", old)


def test_a_passphrase_that_cannot_be_written_is_not_the_new_one(
    tmp_path: Path, vault: FileVault, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object, **options: object) -> None:
        raise VaultError("The disk is full.")

    seal_anew = vault.new_passphrase(Person("another good passphrase"), costs=THROWAWAY)
    with monkeypatch.context() as patched:
        patched.setattr(file_vault, "write_whole", full)
        with pytest.raises(VaultError, match="full"):
            seal_anew()
    vault.add_master()
    assert FileVault.open(tmp_path, STORE, Person()).masters() == (1, 2)


def test_every_flipped_octet_of_the_file_is_noticed(tmp_path: Path, vault: FileVault) -> None:
    path = tmp_path / "vault.json"
    good = path.read_bytes()
    point = vault.identity().point
    silent = []
    for place in range(len(good)):
        path.write_bytes(good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :])
        try:
            again = FileVault.open(tmp_path, STORE, Person())
        except VaultError:
            continue
        silent.append((place, again.identity().point == point))
    assert silent == []


def test_forged_costs_cannot_exhaust_the_machine(tmp_path: Path, vault: FileVault) -> None:
    content = json.loads((tmp_path / "vault.json").read_text())
    for forged in (
        {"memory_kib": 1 << 31},
        {"iterations": 1 << 30},
        {"lanes": 1 << 20},
        {"lanes": 0},
        {"memory_kib": -1},
    ):
        (tmp_path / "vault.json").write_text(json.dumps({**content, **forged}))
        with costs_at_most(1.0), pytest.raises(VaultError):
            FileVault.open(tmp_path, STORE, Person())


@pytest.mark.parametrize("name", ["salt", "ciphertext"])
def test_base64_has_one_form(name: str) -> None:
    """Spare bits of the last letter are zero: a changed octet never means the same."""
    letters = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
    sealed = seal(GOOD, b"sixteen octets !", context=b"c", costs=THROWAWAY)
    assert unseal(GOOD, sealed, context=b"c")[0] == b"sixteen octets !"
    text = sealed[name].rstrip("=")
    bent = text[:-1] + letters[letters.index(text[-1]) + 1] + "=" * (len(sealed[name]) - len(text))
    assert base64.b64decode(bent) == base64.b64decode(sealed[name])
    with pytest.raises(VaultError, match="damaged"):
        unseal(GOOD, {**sealed, name: bent}, context=b"c")


@given(octets=st.binary(max_size=300) | st.text(max_size=100).map(lambda text: json.dumps({"format": text}).encode()))
def test_no_file_raises_anything_foreign(tmp_path_factory: pytest.TempPathFactory, octets: bytes) -> None:
    home = tmp_path_factory.mktemp("vault")
    (home / "vault.json").write_bytes(octets)
    with pytest.raises(VaultError):
        FileVault.open(home, STORE, Person())


def test_a_file_of_more_than_64_kib_is_damage_and_read_no_further(tmp_path: Path, vault: FileVault) -> None:
    """JSON may end in any number of blanks: only its size is wrong."""
    path = tmp_path / "vault.json"
    text = path.read_text()
    path.write_text(text + " " * (64 * 1024 - len(text)))
    assert FileVault.open(tmp_path, STORE, Person()).identity().point == vault.identity().point
    path.write_text(text + " " * (64 * 1024 - len(text) + 1))
    with pytest.raises(VaultError) as refused:
        FileVault.open(tmp_path, STORE, Person())
    assert refused.value.message == f"{path} is damaged or not a vault of this version."
    assert refused.value.hint == "Restore a backup (teds-provision restore)."


def test_a_deep_json_is_damage(tmp_path: Path) -> None:
    (tmp_path / "vault.json").write_text("[" * 60_000)
    with pytest.raises(VaultError):
        FileVault.open(tmp_path, STORE, Person())


def test_init_killed_at_any_instant_can_be_run_again(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path\n"
        "from teds_provision.vault.file_vault import FileVault; from teds_provision.vault.passphrase import THROWAWAY\n"
        "import teds_provision.protocol.keys, cryptography.hazmat.primitives.kdf.argon2\n"
        "print('ready', flush=True)\n"
        f"v = FileVault.create(Path(sys.argv[1]), {STORE!r}, lambda prompt, confirm: {GOOD!r}, costs=THROWAWAY)\n"
        "print(v.identity().point.hex(), flush=True)"
    )
    for attempt in range(8):
        home = tmp_path / str(attempt)
        home.mkdir()
        process = subprocess.Popen([sys.executable, "-c", code, str(home)], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        time.sleep(attempt * 0.0007)
        process.send_signal(signal.SIGKILL)
        output, _ = process.communicate()
        vault = FileVault.create(home, STORE, Person(), costs=THROWAWAY)
        assert output in ("", vault.identity().point.hex() + "\n")


def test_a_change_killed_at_any_instant_leaves_the_old_or_the_new(tmp_path: Path, vault: FileVault) -> None:
    vault.export_ca(tmp_path / "ca.pem", GOOD)
    code = (
        "import sys; from pathlib import Path; from teds_provision.vault.file_vault import FileVault\n"
        f"vault = FileVault.open(Path(sys.argv[1]), {STORE!r}, lambda prompt, confirm: {GOOD!r})\n"
        "print('ready', flush=True)\n"
        "while True: vault.add_master(); vault.retire_masters()"
    )
    numbers = []
    left = 1
    for attempt in range(8):
        process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        time.sleep(attempt * 0.004)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        again = FileVault.open(tmp_path, STORE, Person())
        assert again.identity().point == vault.identity().point
        # killed between the two, one more is left, and the next one begins with that many
        assert 1 <= len(again._material.masters.keys) <= left + 1
        left = len(again._material.masters.keys)
        numbers.append(again._material.masters.current)
    assert numbers == sorted(numbers)
    assert numbers[-1] > 1


def test_a_full_disk_leaves_the_vault_as_it_was(tmp_path: Path, vault: FileVault) -> None:
    before = (tmp_path / "vault.json").read_bytes()
    code = (
        "import resource, sys; sys.dont_write_bytecode = True\n"
        "from pathlib import Path; from teds_provision.errors import VaultError\n"
        "from teds_provision.vault.file_vault import FileVault\n"
        f"vault = FileVault.open(Path(sys.argv[1]), {STORE!r}, lambda prompt, confirm: {GOOD!r})\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n"
        "try: vault.drop_ca()\n"
        "except VaultError as failure: print(vault.ca() is not None, failure.message)"
    )
    run = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, timeout=60, check=False
    )
    assert run.stdout.startswith("True "), run.stderr
    assert "cannot be written" in run.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["vault.json"]
    assert (tmp_path / "vault.json").read_bytes() == before


def test_a_backup_brings_the_station_to_another_home(tmp_path: Path, vault: FileVault) -> None:
    wrapped = vault.wrap(b"k" * 16, context=b"c")
    home = tmp_path / "elsewhere"
    home.mkdir()
    restored, _ = create_vault(home, STORE, "file", Person(), costs=THROWAWAY, restored=vault.secret_material())
    assert restored.identity().point == vault.identity().point
    assert restored.unwrap(wrapped, context=b"c") == b"k" * 16


def test_a_backup_of_another_station_replaces_nothing(tmp_path: Path, vault: FileVault) -> None:
    with pytest.raises(VaultError, match="another station"):
        create_vault(tmp_path, STORE, "file", Person(), restored=Material.generate().encode())
    assert FileVault.open(tmp_path, STORE, Person()).identity().point == vault.identity().point


def test_two_lives_of_one_station_are_not_called_two_stations(tmp_path: Path, vault: FileVault) -> None:
    """An old backup restored, its master key made anew, then a newer backup, whose second master key is another one."""
    old = vault.secret_material()
    vault.add_master()
    newer = vault.secret_material()
    (tmp_path / "elsewhere").mkdir()
    restored, _ = create_vault(tmp_path / "elsewhere", STORE, "file", Person(), costs=THROWAWAY, restored=old)
    assert isinstance(restored, FileVault)
    restored.add_master()
    before = restored.secret_material()
    with pytest.raises(VaultError, match="are of one station, but each has another master key") as error:
        restored.join(newer)
    assert "another --home" in error.value.hint
    assert restored.secret_material() == before


def test_of_two_ca_keys_the_one_that_is_here_stays() -> None:
    here = Material.generate()
    other = here.with_ca(SoftwareKey.generate().secret())
    assert merge_keys(here, other.encode()) == here
    assert merge_keys(here.with_ca(None), other.encode()) == other
    assert merge_keys(here, other.with_ca(None).encode()) == here


def test_an_older_backup_brings_back_old_master_keys_without_losing_the_new(tmp_path: Path, vault: FileVault) -> None:
    backup = vault.secret_material()
    old = vault.wrap(b"o" * 16, context=b"c")
    vault.add_master()
    vault.retire_masters()
    new = vault.wrap(b"n" * 16, context=b"c")
    for keystore, why in (("file", "as requested"), (None, "the passphrase file already exists")):
        (tmp_path / "copy").mkdir(exist_ok=True)
        (tmp_path / "copy" / "vault.json").write_bytes((tmp_path / "vault.json").read_bytes())
        made = create_vault(tmp_path / "copy", STORE, keystore, Person(), restored=backup)
        assert (made[0].unwrap(old, context=b"c"), made[1]) == (b"o" * 16, why)
    restored, _ = create_vault(tmp_path, STORE, "file", Person(), restored=backup)
    assert (restored.unwrap(old, context=b"c"), restored.unwrap(new, context=b"c")) == (b"o" * 16, b"n" * 16)


def no_keyring(*_: object, **__: object) -> KeyringVault:
    raise KeyringUnavailableError("There is no keyring.")


def test_reason_place_and_duration_are_given_before_a_new_passphrase_and_only_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes: list[str] = []
    monkeypatch.setattr(KeyringVault, "create", no_keyring)
    for keystore, begin in (("file", ""), (None, "No OS keyring was found. ")):
        home = tmp_path / str(keystore)
        home.mkdir()
        for _ in range(2):
            create_vault(home, STORE, keystore, Person(), costs=THROWAWAY, notify=notes.append)
        (note,) = notes
        notes.clear()
        assert note.startswith(f"{begin}The station's keys will be stored in {home / 'vault.json'}, encrypted with a")
        assert note.endswith(" At least 8 characters; four random words are good. This takes about a second.")


def test_a_vault_behind_a_symbolic_link_is_not_opened(tmp_path: Path, vault: FileVault) -> None:
    (tmp_path / "vault.json").rename(tmp_path / "elsewhere.json")
    (tmp_path / "vault.json").symlink_to(tmp_path / "elsewhere.json")
    with pytest.raises(VaultError):
        FileVault.open(tmp_path, STORE, Person())


def test_a_vault_is_opened_again_and_written_only_if_there_is_something_new(
    tmp_path: Path, vault: FileVault, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[bytes] = []
    whole = file_vault.unseal_with

    def unseal_with(held: bytes, content: dict[str, Any], *, context: bytes) -> Any:
        opened.append(held)
        return whole(held, content, context=context)

    monkeypatch.setattr(file_vault, "unseal_with", unseal_with)
    other = FileVault.open(tmp_path, STORE, Person())
    assert (vault.refresh(), len(opened)) == (False, 0)
    other.add_master()
    assert [vault.refresh(), vault.refresh()] == [True, False]
    assert len(opened) == 1, "what was read is known"
    other.retire_masters()
    before = (tmp_path / "vault.json").read_bytes()
    other.retire_masters()
    assert (tmp_path / "vault.json").read_bytes() == before, "one master key is the newest"


def test_an_unknown_keystore_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        create_vault(tmp_path, STORE, "floppy", Person())
    with pytest.raises(UsageError):
        open_vault(tmp_path, STORE, "floppy", Person())


def test_without_a_person_to_ask_nothing_is_made(tmp_path: Path) -> None:
    def nobody(prompt: str, confirm: bool) -> str:
        raise VaultError("No passphrase, and nobody may be asked.")

    with pytest.raises(StoreError):
        create_vault(tmp_path, STORE, "file", nobody)
    assert list(tmp_path.iterdir()) == []


def test_keys_made_here_are_different_every_time() -> None:
    made = [Material.generate() for _ in range(5)]
    points = {
        SoftwareKey.from_secret(secret).point for material in made for secret in (material.identity, material.ca or b"")
    }
    assert len(points) == 10
