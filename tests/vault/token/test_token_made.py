"""A vault is made in a token: again, killed, by many processes at once, under chosen names; the CA key may go."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from teds_provision.errors import VaultError
from teds_provision.protocol.keys import verify
from teds_provision.vault.pkcs11 import FILE_NAME, Pkcs11Vault
from teds_provision.vault.selection import create_vault, forget_vaults, open_vault
from tests.vault.softhsm import PIN, SoftHsm
from tests.vault.token.person import Person

pytestmark = pytest.mark.system


def test_create_again_opens_what_is_there(vault, home, store_id, uri):
    person = Person()
    assert Pkcs11Vault.create(home, store_id, uri, person).identity().point == vault.identity().point
    assert person.prompts == ["PIN of the token 'bench'"]


def test_a_run_that_died_before_the_file_is_carried_on_with_the_same_keys(vault, home, store_id, uri):
    (home / FILE_NAME).unlink()
    again = Pkcs11Vault.create(home, store_id, uri, Person())
    assert (again.identity().point, again.ca().point) == (vault.identity().point, vault.ca().point)


def test_half_a_key_pair_of_a_run_that_died_is_cleared_away(vault, home, store_id, uri):
    from pkcs11 import Attribute, ObjectClass

    key = vault.identity()
    wanted = {Attribute.CLASS: ObjectClass.PRIVATE_KEY, Attribute.ID: key.identifier}
    with vault._session._token.open(rw=True) as session:
        next(iter(session.get_objects(wanted))).destroy()
    (home / FILE_NAME).unlink()
    again = Pkcs11Vault.create(home, store_id, uri, Person()).identity()
    assert again.point != key.point
    assert verify(again.point, b"m", again.sign(b"m"))


@pytest.mark.parametrize("last_step", ["log_in", "generate", "generate generate", "write_whole", "file written"])
def test_killed_at_any_step_of_making_it_it_is_carried_on(tmp_path, last_step):
    """Killed before the named step; inside the module's own writes SoftHSM itself may lose its token."""
    hsm = SoftHsm(tmp_path)
    uri = hsm.new_token("mortal")
    code = (
        "import os, signal, sys; from pathlib import Path; from teds_provision.vault import pkcs11 as ours\n"
        "step, times = sys.argv[3].split()[0], len(sys.argv[3].split())\n"
        "def die_before(real):\n"
        "    def call(*args, **named):\n"
        "        global times\n"
        "        times -= 1\n"
        "        return os.kill(os.getpid(), signal.SIGKILL) if not times else real(*args, **named)\n"
        "    return call\n"
        "place = ours.TokenSession if step == 'generate' else ours\n"
        "if step == 'file': step, times = '_load', 1\n"
        "if step != 'none': setattr(place, step, die_before(getattr(place, step)))\n"
        f"v = ours.Pkcs11Vault.create(Path(sys.argv[1]), 's', sys.argv[2], lambda p, c: {PIN!r})\n"
        "assert v.unwrap(v.wrap(b'k' * 16, context=b'c'), context=b'c') == b'k' * 16\n"
        "print(v.identity().point.hex(), v.ca().point.hex())"
    )

    def run(step):
        words = [sys.executable, "-c", code, str(tmp_path), uri, step]
        return subprocess.run(words, env=hsm.environment, capture_output=True, text=True, timeout=60, check=False)

    for _ in range(2):
        killed = run(last_step)
        if not (tmp_path / FILE_NAME).exists() or last_step == "log_in":
            assert killed.returncode == -signal.SIGKILL, killed.stderr
    first, second = run("none"), run("none")
    assert first.returncode == second.returncode == 0, first.stderr
    assert first.stdout == second.stdout


def test_two_stores_in_one_token_have_keys_of_their_own(vault, tmp_path, store_id, uri):
    (tmp_path / "second").mkdir()
    second = Pkcs11Vault.create(tmp_path / "second", store_id + "x", uri, Person())
    assert second.identity().point not in (vault.identity().point, vault.ca().point)


def test_object_and_id_name_the_station_key(home, store_id, uri):
    named = uri.replace("?", ";object=my%20station;id=%01%02?")
    vault = Pkcs11Vault.create(home, store_id, named, Person())
    assert (vault.identity().label, vault.identity().identifier) == ("my station", b"\1\2")
    (home / "again").mkdir()
    for text in (named, uri.replace("?", ";object=my%20station?"), uri.replace("?", ";id=%01%02?")):
        (home / "again" / FILE_NAME).unlink(missing_ok=True)
        other = Pkcs11Vault.create(home / "again", "another store", text, Person(), with_ca=False)
        assert other.identity().point == vault.identity().point
        assert other.ca() is None


def test_a_key_that_may_leave_the_token_is_not_used(home, store_id, uri, vault):
    from pkcs11 import Attribute, KeyType
    from pkcs11.util.ec import encode_named_curve_parameters

    writing = Pkcs11Vault.create(home, store_id, uri, Person())._session._session
    curve = writing.create_domain_parameters(
        KeyType.EC, {Attribute.EC_PARAMS: encode_named_curve_parameters("secp256r1")}, local=True
    )
    private = {Attribute.SENSITIVE: False, Attribute.EXTRACTABLE: True}
    curve.generate_keypair(label="loose", id=b"loose", private_template=private)
    (home / "b").mkdir()
    with pytest.raises(VaultError, match="can leave the token"):
        Pkcs11Vault.create(home / "b", store_id, uri.replace("?", ";object=loose?"), Person())


def test_a_key_of_another_curve_is_not_used(vault, home, store_id, uri):
    from pkcs11 import Attribute, KeyType
    from pkcs11.util.ec import encode_named_curve_parameters

    curve = vault._session._session.create_domain_parameters(
        KeyType.EC, {Attribute.EC_PARAMS: encode_named_curve_parameters("secp384r1")}, local=True
    )
    curve.generate_keypair(label="wide", id=b"wide")
    (home / "b").mkdir()
    with pytest.raises(VaultError, match=r"may leave|not a P-256"):
        Pkcs11Vault.create(home / "b", store_id, uri.replace("?", ";object=wide?"), Person())


def test_a_token_that_is_pulled_while_the_ca_key_is_destroyed_leaves_a_vault_that_opens(
    vault, home, store_id, uri, monkeypatch
):
    """The file names the key no more before it is gone: else the file would name one that the token lacks."""
    monkeypatch.setattr(vault._session, "destroy", lambda key: (destroy(key), pulled()))
    destroy = type(vault._session).destroy.__get__(vault._session)

    def pulled():
        raise VaultError("The token was removed.")

    with pytest.raises(VaultError, match="was removed"):
        vault.drop_ca()
    assert Pkcs11Vault.open(home, store_id, uri, Person()).ca() is None


def test_the_ca_key_can_be_destroyed_and_then_it_is_gone(vault, home, store_id, uri):
    assert vault.drop_ca()
    assert vault.ca() is None
    assert not vault.drop_ca()
    again = Pkcs11Vault.open(home, store_id, uri, Person())
    assert again.ca() is None
    assert again.identity().point == vault.identity().point


def test_many_processes_make_one_vault_and_all_hold_the_same_keys(tmp_path):
    hsm = SoftHsm(tmp_path)
    uri = hsm.new_token("busy")
    code = (
        "import sys; from pathlib import Path; from teds_provision.vault.pkcs11 import Pkcs11Vault\n"
        f"v = Pkcs11Vault.create(Path(sys.argv[1]), sys.argv[1], sys.argv[2], lambda p, c: {PIN!r})\n"
        "assert v.unwrap(v.wrap(b'k' * 16, context=b'c'), context=b'c') == b'k' * 16\n"
        "print(v.identity().point.hex(), v.ca().point.hex())"
    )
    homes = [tmp_path / "one", tmp_path / "two"]
    for home in homes:
        home.mkdir()
    started = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(homes[number % 2]), uri],
            env=hsm.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for number in range(6)
    ]
    results = [process.communicate(timeout=60) for process in started]
    assert all(process.returncode == 0 for process in started), results
    for which in (0, 1):
        assert len({out for out, _ in results[which::2]}) == 1


def test_the_tool_chooses_and_opens_it_by_its_uri(home, store_id, uri):
    vault, why = create_vault(home, store_id, uri, Person())
    assert (vault.kind, why) == ("pkcs11", "as requested")
    assert "bench" in vault.description
    person = Person()
    assert open_vault(home, store_id, uri, person) is vault
    assert not person.prompts
    forget_vaults()
    assert open_vault(home, store_id, uri, person).identity().point == vault.identity().point
    assert len(person.prompts) == 1
    forget_vaults()


def test_the_file_names_its_keys_for_people(vault, home):
    members = json.loads(Path(home / FILE_NAME).read_text())
    assert members["station"]["label"] == "teds-provision station"
    assert members["station"]["point"] == vault.identity().point.hex()
