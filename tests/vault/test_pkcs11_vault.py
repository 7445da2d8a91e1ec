"""A station whose keys lie in a token: the real SoftHSM 2, the whole round."""

from __future__ import annotations

import json
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from teds_provision.errors import BadData, UsageFailure, VaultFailure, WrongPassphrase
from teds_provision.protocol.agreement import Credentials, NodeAgreement, StationAgreement
from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message, verify
from teds_provision.vault import create_vault, forget_vaults, open_vault
from teds_provision.vault.pkcs11 import FILE_NAME, Pkcs11Vault
from teds_provision.vault.pkcs11_token import _tries, ask_pin
from teds_provision.vault.pkcs11_uri import Pkcs11Uri
from tests.vault.softhsm import MODULE, PIN, SoftHsm, loaded, unload

pytestmark = pytest.mark.system
STORE = "5e" * 16
CONTEXT = b"a node"


class Person:
    """Someone who knows a PIN, and counts how often it was asked for."""

    def __init__(self, pin=PIN):
        self.pin, self.prompts = pin, []

    def __call__(self, prompt, confirm):
        assert not confirm
        self.prompts.append(prompt)
        return self.pin


@pytest.fixture(scope="module")
def uris(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        yield loaded(tmp_path_factory.mktemp("hsm"), patch, ("bench", "spare"))
        unload()


@pytest.fixture
def uri(uris):
    return uris["bench"]


@pytest.fixture
def home(tmp_path):
    return tmp_path


@pytest.fixture
def store_id(request):
    """One store per test, so that each test has keys of its own in the token."""
    return fingerprint(request.node.name.encode())[:32]


@pytest.fixture
def vault(home, store_id, uri):
    made = Pkcs11Vault.create(home, store_id, uri, Person())
    yield made
    made.close()


def in_new_process(uris, code, *words):
    """Run Python code in a process of its own that sees the same tokens."""
    return subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=60, check=False)


# The keys


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
    with pytest.raises(BadData):
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
    with pytest.raises(VaultFailure, match="cannot leave"):
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
    agreed = agreement.accept(half.reply, pinned=fingerprint(node.point), epoch=0)
    assert agreed.key == half.key
    assert agreed.confirm.payload == half.station_tag


# Wrapping, and the file


def test_a_wrapped_key_opens_under_its_context_alone_and_in_a_new_process(vault, home, store_id, uri, uris):
    wrapped = vault.wrap(b"sixteen octets!!", context=CONTEXT)
    assert vault.unwrap(wrapped, context=CONTEXT) == b"sixteen octets!!"
    with pytest.raises(VaultFailure, match="does not belong"):
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
        with pytest.raises(VaultFailure):
            Pkcs11Vault.open(home, store_id, uri, Person())
    path.write_text(text)
    assert Pkcs11Vault.open(home, store_id, uri, Person()).identity().point == vault.identity().point


def test_masters_that_someone_else_sealed_to_the_station_key_are_refused(vault, home, store_id, uri):
    """Whoever may write the file knows the public key; without the signature they could choose the master key."""
    from teds_provision.vault import pkcs11
    from teds_provision.vault.master import MasterKeys

    forger = pkcs11._Content(vault._content.station, vault._content.ca, MasterKeys({1: bytes(32)}))
    outsider = SoftwareKey(5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(forger.station), "sign", lambda _, message: outsider.sign(message))
        pkcs11._save(home, store_id, forger, replace=True)
    with pytest.raises(VaultFailure, match="was changed"):
        Pkcs11Vault.open(home, store_id, uri, Person())


@pytest.mark.parametrize("content", ["", "{", "[]", "null", "{}", '{"station": 1, "ca": 2}', "[" * 9999, "x" * 70_000])
def test_a_file_that_is_something_else_is_named_before_anyone_is_asked(home, store_id, uri, content):
    (home / FILE_NAME).write_text(content)
    person = Person()
    with pytest.raises(VaultFailure, match=FILE_NAME):
        Pkcs11Vault.open(home, store_id, uri, person)
    assert not person.prompts


def test_a_missing_file_and_one_of_another_store(vault, home, store_id, uri):
    with pytest.raises(VaultFailure, match="another store"):
        Pkcs11Vault.open(home, STORE, uri, Person())
    (home / FILE_NAME).unlink()
    with pytest.raises(VaultFailure, match="missing"):
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
    with pytest.raises(VaultFailure, match="lacks"):
        last.unwrap(before, context=CONTEXT)


def test_a_backup_opens_with_the_same_token_alone(vault, tmp_path, store_id, uri, uris):
    wrapped, backup = vault.wrap(b"k" * 16, context=CONTEXT), vault.secret_material()
    for name in ("again", "elsewhere"):
        (tmp_path / name).mkdir()
    again = Pkcs11Vault.create(tmp_path / "again", store_id, uri, Person(), restored=backup)
    assert again.unwrap(wrapped, context=CONTEXT) == b"k" * 16
    with pytest.raises(VaultFailure, match="does not hold the station key"):
        Pkcs11Vault.create(tmp_path / "elsewhere", store_id, uris["spare"], Person(), restored=backup)
    for damaged in ("", backup.replace('"nonce": "', '"nonce": "00'), backup.replace(store_id, STORE)):
        with pytest.raises(VaultFailure):
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
    with pytest.raises(VaultFailure, match="another station"):
        Pkcs11Vault.create(home, store_id, uri, Person(), restored=other.secret_material())


# Making it


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
    with pytest.raises(VaultFailure, match="may leave the token"):
        Pkcs11Vault.create(home / "b", store_id, uri.replace("?", ";object=loose?"), Person())


def test_a_key_of_another_curve_is_not_used(vault, home, store_id, uri):
    from pkcs11 import Attribute, KeyType
    from pkcs11.util.ec import encode_named_curve_parameters

    curve = vault._session._session.create_domain_parameters(
        KeyType.EC, {Attribute.EC_PARAMS: encode_named_curve_parameters("secp384r1")}, local=True
    )
    curve.generate_keypair(label="wide", id=b"wide")
    (home / "b").mkdir()
    with pytest.raises(VaultFailure, match=r"may leave|not a P-256"):
        Pkcs11Vault.create(home / "b", store_id, uri.replace("?", ";object=wide?"), Person())


def test_the_ca_key_can_be_destroyed_and_then_it_is_gone(vault, home, store_id, uri):
    assert vault.drop_ca()
    assert vault.ca() is None
    assert not vault.drop_ca()
    again = Pkcs11Vault.open(home, store_id, uri, Person())
    assert again.ca() is None
    assert again.identity().point == vault.identity().point


# What goes wrong


@pytest.fixture
def closed(uri, home, store_id):
    """A vault that nobody has open in this process: the module looks at a PIN only then."""
    unload()
    vault = Pkcs11Vault.create(home, store_id, uri, Person())
    vault.close()
    return vault


def test_a_wrong_pin_is_said_once_with_what_is_known_of_the_tries(closed, home, store_id, uri):
    person = Person("000000")
    with pytest.raises(WrongPassphrase, match=r"PIN of the token 'bench' is wrong\. .*tr") as refused:
        Pkcs11Vault.open(home, store_id, uri, person)
    assert len(person.prompts) == 1
    assert refused.value.exit_code == 7
    assert "000000" not in str(refused.value) + refused.value.hint
    assert Pkcs11Vault.open(home, store_id, uri, Person()).identity().point == closed.identity().point


@pytest.mark.parametrize("pin", ["", "1", "9" * 300, "é" * 5])
def test_odd_pins_are_wrong_pins(closed, home, store_id, uri, pin):
    with pytest.raises(WrongPassphrase):
        Pkcs11Vault.open(home, store_id, uri, Person(pin))


def test_what_a_token_tells_of_the_tries_left():
    """SoftHSM never locks, so the flags are given here."""
    from pkcs11 import TokenFlag

    assert _tries(0) == "The token does not say how many tries are left."
    assert "counted a wrong try" in _tries(TokenFlag.USER_PIN_COUNT_LOW)
    assert "One try is left" in _tries(TokenFlag.USER_PIN_COUNT_LOW | TokenFlag.USER_PIN_FINAL_TRY)


def test_a_pin_pad_and_the_last_try():
    from pkcs11 import TokenFlag

    class Shown:
        flags = TokenFlag.PROTECTED_AUTHENTICATION_PATH

    person, uri = Person(), Pkcs11Uri("/m.so", token="t")
    assert ask_pin(Shown, uri, person) is None
    Shown.flags = TokenFlag.USER_PIN_FINAL_TRY
    assert ask_pin(Shown, uri, person) == PIN
    assert person.prompts == ["PIN of the token 't' (the last try before it locks)"]


@pytest.mark.parametrize("module", ["/nowhere/module.so", __file__, "/usr/lib/x86_64-linux-gnu/libc.so.6", "/tmp"])
def test_a_module_that_cannot_be_loaded(home, store_id, uris, module):
    with pytest.raises(VaultFailure, match="cannot be loaded") as refused:
        Pkcs11Vault.create(home, store_id, f"pkcs11:token=bench?module-path={module}", Person())
    assert "driver" in refused.value.hint


def test_a_token_that_is_not_there_or_not_clear(home, store_id, uris):
    with pytest.raises(VaultFailure, match="no token 'nobody'") as refused:
        Pkcs11Vault.create(home, store_id, f"pkcs11:token=nobody?module-path={MODULE}", Person())
    assert "Plug it in" in refused.value.hint
    with pytest.raises(VaultFailure, match="tokens fit"):
        Pkcs11Vault.create(home, store_id, f"pkcs11:model=SoftHSM%20v2?module-path={MODULE}", Person())


def test_a_key_that_is_not_in_the_token_any_more(vault, home, store_id, uri, uris):
    with pytest.raises(VaultFailure, match="does not hold the station key") as refused:
        Pkcs11Vault.open(home, store_id, uris["spare"], Person())
    assert "init" in refused.value.hint
    vault._session.destroy(vault.ca())
    with pytest.raises(VaultFailure, match="does not hold the CA key"):
        Pkcs11Vault.open(home, store_id, uri, Person())


def test_without_the_package_the_cure_is_named(home, store_id, uri, uris):
    code = (
        "import sys; sys.modules['pkcs11'] = None\nfrom pathlib import Path\n"
        "from teds_provision.vault.pkcs11 import Pkcs11Vault\nfrom teds_provision.errors import VaultFailure\n"
        "try: Pkcs11Vault.create(Path(sys.argv[1]), 'x', sys.argv[2], None)\n"
        "except VaultFailure as failure: print(failure.exit_code, failure.hint)"
    )
    done = in_new_process(uris, code, str(home), uri)
    assert done.stdout.strip().startswith("7 Install it: "), done.stderr
    assert done.stdout.strip().endswith(" python-pkcs11")


def test_importing_the_vault_loads_no_token_library():
    code = "import sys, teds_provision.vault.pkcs11; print('pkcs11' in sys.modules)"
    assert in_new_process(None, code).stdout.strip() == "False"


def test_a_uri_with_a_pin_is_refused_before_anything(home, store_id, uri):
    person = Person()
    with pytest.raises(UsageFailure, match="PIN"):
        Pkcs11Vault.create(home, store_id, uri + "&pin-value=482915", person)
    assert not person.prompts
    assert not list(home.iterdir())


def test_a_general_error_of_the_module_gets_one_more_try_and_no_second():
    from pkcs11.exceptions import DeviceRemoved, GeneralError

    from teds_provision.vault.pkcs11_token import guarded

    calls = []

    def fail(*errors):
        calls.append(1)
        if len(calls) <= len(errors):
            raise errors[len(calls) - 1]
        return "done"

    assert guarded(lambda: fail(GeneralError())) == "done"
    assert len(calls) == 2
    calls.clear()
    with pytest.raises(VaultFailure, match="GeneralError"):
        guarded(lambda: fail(GeneralError(), GeneralError()))
    assert len(calls) == 2
    calls.clear()
    with pytest.raises(VaultFailure, match="DeviceRemoved") as refused:
        guarded(lambda: fail(DeviceRemoved()))
    assert len(calls) == 1
    assert "Plug it in" in refused.value.hint


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
    assert (vault.kind, why) == ("pkcs11", "the token was asked for")
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
