"""A token is opened: PINs, tries, modules and tokens that are not there."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from teds_provision.errors import UsageError, VaultError, WrongPassphraseError
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.vault.pkcs11 import Pkcs11Vault
from teds_provision.vault.pkcs11_token import TokenKey, TokenSession, _tries, ask_pin, find_token, log_in
from teds_provision.vault.pkcs11_uri import Pkcs11Uri
from tests.vault.softhsm import MODULE, PIN, unload
from tests.vault.token.person import Person, in_new_process

pytestmark = pytest.mark.system


@pytest.fixture
def closed(uri, home, store_id):
    """Return a vault that nobody has open in this process: the module looks at a PIN only then."""
    unload()
    vault = Pkcs11Vault.create(home, store_id, uri, Person())
    vault.close()
    return vault


def test_a_wrong_pin_is_reported_once_with_what_is_known_of_the_tries(closed, home, store_id, uri):
    person = Person("000000")
    with pytest.raises(WrongPassphraseError, match=r"PIN of the token 'bench' is wrong\. .*attempt") as refused:
        Pkcs11Vault.open(home, store_id, uri, person)
    assert len(person.prompts) == 1
    assert refused.value.exit_code == 7
    assert "000000" not in str(refused.value) + refused.value.hint
    assert Pkcs11Vault.open(home, store_id, uri, Person()).identity().point == closed.identity().point


@pytest.mark.parametrize("pin", ["", "1", "9" * 300, "é" * 5])
def test_odd_pins_are_wrong_pins(closed, home, store_id, uri, pin):
    with pytest.raises(WrongPassphraseError):
        Pkcs11Vault.open(home, store_id, uri, Person(pin))


def test_what_a_token_reports_of_the_tries_left():
    """SoftHSM never locks, so the flags are given here."""
    from pkcs11 import TokenFlag

    assert _tries(0) == "The token does not say how many attempts are left."
    assert "counted a wrong attempt" in _tries(TokenFlag.USER_PIN_COUNT_LOW)
    assert "One attempt is left" in _tries(TokenFlag.USER_PIN_COUNT_LOW | TokenFlag.USER_PIN_FINAL_TRY)


def test_a_pin_pad_and_the_last_try():
    from pkcs11 import TokenFlag

    class ShownToken:
        flags = TokenFlag.PROTECTED_AUTHENTICATION_PATH

    person, uri = Person(), Pkcs11Uri("/m.so", token="t")
    assert ask_pin(ShownToken, uri, person) is None
    ShownToken.flags = TokenFlag.USER_PIN_FINAL_TRY
    assert ask_pin(ShownToken, uri, person) == PIN
    assert person.prompts == ["PIN of the token 't' (last attempt before it locks)"]


@pytest.mark.parametrize("module", ["/nowhere/module.so", __file__, "/usr/lib/x86_64-linux-gnu/libc.so.6", "/tmp"])
def test_a_module_that_cannot_be_loaded(home, store_id, uris, module):
    with pytest.raises(VaultError, match="cannot be loaded") as refused:
        Pkcs11Vault.create(home, store_id, f"pkcs11:token=bench?module-path={module}", Person())
    assert "driver" in refused.value.hint


def test_a_module_that_was_loaded_and_then_fails_is_not_called_one_that_cannot_be_loaded(monkeypatch):
    import pkcs11
    from pkcs11.exceptions import GeneralError

    def fails(error):
        monkeypatch.setattr(pkcs11, "lib", lambda _path: (_ for _ in ()).throw(error))
        with pytest.raises(VaultError) as refused:
            find_token(Pkcs11Uri("/m.so", token="t"))
        return refused.value.message

    unloaded = "The PKCS #11 module /m.so cannot be loaded."
    assert fails(pkcs11.PKCS11Error("no such file")) == unloaded
    assert fails(GeneralError()) != unloaded


def test_a_token_that_is_not_there_or_not_clear(home, store_id, uris):
    with pytest.raises(VaultError, match="no token 'nobody'") as refused:
        Pkcs11Vault.create(home, store_id, f"pkcs11:token=nobody?module-path={MODULE}", Person())
    assert "Plug it in" in refused.value.hint
    with pytest.raises(VaultError, match="tokens match"):
        Pkcs11Vault.create(home, store_id, f"pkcs11:model=SoftHSM%20v2?module-path={MODULE}", Person())


def test_a_key_that_is_not_in_the_token_any_more(vault, home, store_id, uri, uris):
    with pytest.raises(VaultError, match="does not hold the station key") as refused:
        Pkcs11Vault.open(home, store_id, uris["spare"], Person())
    assert "init" in refused.value.hint
    vault._session.destroy(vault.ca())
    with pytest.raises(VaultError, match="does not hold the CA key"):
        Pkcs11Vault.open(home, store_id, uri, Person())


def test_without_the_package_the_cure_is_named(home, store_id, uri, uris):
    code = (
        "import sys; sys.modules['pkcs11'] = None\nfrom pathlib import Path\n"
        "from teds_provision.vault.pkcs11 import Pkcs11Vault\nfrom teds_provision.errors import VaultError\n"
        "try: Pkcs11Vault.create(Path(sys.argv[1]), 'x', sys.argv[2], None)\n"
        "except VaultError as failure: print(failure.exit_code, failure.hint)"
    )
    done = in_new_process(uris, code, str(home), uri)
    assert done.stdout.strip().startswith("7 Install it: "), done.stderr
    assert " -m pip install " in done.stdout
    assert "[pkcs11]" in done.stdout


def test_importing_the_vault_loads_no_token_library():
    code = "import sys, teds_provision.vault.pkcs11; print('pkcs11' in sys.modules)"
    assert in_new_process(None, code).stdout.strip() == "False"


def test_a_uri_with_a_pin_is_refused_before_anything(home, store_id, uri):
    person = Person()
    with pytest.raises(UsageError, match="PIN"):
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
    with pytest.raises(VaultError, match="GeneralError"):
        guarded(lambda: fail(GeneralError(), GeneralError()))
    assert len(calls) == 2
    calls.clear()
    with pytest.raises(VaultError, match="DeviceRemoved") as refused:
        guarded(lambda: fail(DeviceRemoved()))
    assert len(calls) == 1
    assert "Plug it in" in refused.value.hint


class Refusing:
    """A token that refuses every session, as SoftHSM never does."""

    label = "t"

    def __init__(self, error, flags=0):
        self.error, self.flags = error, flags
        self.slot = SimpleNamespace(get_token=lambda: self)
        self.tries = []

    def open(self, *, rw, user_pin=None):
        self.tries.append((rw, user_pin))
        raise self.error


WRONG = "The PIN of the token 't' is wrong. The token does not say how many attempts are left."
LOCKED = "The PIN of the token 't' is locked after too many wrong attempts."


@pytest.mark.parametrize(
    ("error", "flags", "kind", "message", "hint"),
    [
        ("PinIncorrect", 0, WrongPassphraseError, WRONG, "Run it again with the right PIN; it is not retried"),
        ("PinInvalid", 0, WrongPassphraseError, WRONG, "Run it again with the right PIN"),
        ("PinLenRange", 0, WrongPassphraseError, WRONG, "Run it again with the right PIN"),
        ("ArgumentsBad", 0, WrongPassphraseError, WRONG, "Run it again with the right PIN"),
        ("PinIncorrect", "USER_PIN_LOCKED", VaultError, LOCKED, "Set a new PIN with the security officer's PIN"),
        ("PinLocked", 0, VaultError, LOCKED, "Set a new PIN with the security officer's PIN"),
        ("PinExpired", 0, VaultError, "The token 't' has no valid user PIN.", "Set one with the token's own tool."),
        ("UserPinNotInitialized", 0, VaultError, "The token 't' has no valid user PIN.", "Set one with the token's"),
        ("DeviceRemoved", 0, VaultError, "The token failed (DeviceRemoved).", "Plug it in and run this again."),
        ("TokenNotPresent", 0, VaultError, "The token failed (TokenNotPresent).", "Plug it in and run this again."),
        ("HostMemory", 0, VaultError, "The token failed (HostMemory).", "Check it with its own tool."),
    ],
)
@pytest.mark.parametrize("write", [False, True])
def test_a_login_that_a_token_refuses_is_tried_once_and_named(error, flags, kind, message, hint, write):
    from pkcs11 import TokenFlag, exceptions

    token = Refusing(getattr(exceptions, error)(), TokenFlag[flags] if flags else 0)
    with pytest.raises(VaultError) as refused:
        log_in(token, Pkcs11Uri("/m.so", token="t"), "1234", write=write)
    assert type(refused.value) is kind
    assert refused.value.message == message
    assert refused.value.hint.startswith(hint)
    assert token.tries == [(write, "1234")], "a token locks after some tries"


def test_a_token_with_a_pin_pad_is_told_to_ask_itself():
    from pkcs11 import PROTECTED_AUTH, exceptions

    token = Refusing(exceptions.PinIncorrect())
    with pytest.raises(WrongPassphraseError):
        log_in(token, Pkcs11Uri("/m.so", token="t"), None, write=False)
    assert token.tries == [(False, PROTECTED_AUTH)]


@pytest.mark.parametrize(
    ("error", "kind", "message", "hint"),
    [
        (
            "PinIncorrect",
            WrongPassphraseError,
            "The PIN of the token 't' is wrong.",
            "Run it again with the right PIN.",
        ),
        (
            "ArgumentsBad",
            WrongPassphraseError,
            "The PIN of the token 't' is wrong.",
            "Run it again with the right PIN.",
        ),
        (
            "PinInvalid",
            VaultError,
            "The token 't' does not accept this as a new PIN.",
            "Check its length and characters.",
        ),
        ("PinLenRange", VaultError, "The token 't' does not accept this as a new PIN.", "Check its length and"),
        ("DeviceError", VaultError, "The token failed (DeviceError).", "Plug it in and run this again."),
        ("GeneralError", VaultError, "The token failed (GeneralError).", "Check it with its own tool."),
    ],
)
def test_a_new_pin_that_a_token_refuses_is_tried_once_and_named(error, kind, message, hint):
    from pkcs11 import exceptions

    token = Refusing(getattr(exceptions, error)())
    with pytest.raises(VaultError) as refused:
        TokenSession(None, token).set_pin("1234", "5678")
    assert type(refused.value) is kind
    assert refused.value.message == message
    assert refused.value.hint.startswith(hint)
    assert token.tries == [(True, None)]


def test_a_token_whose_pin_is_locked_is_named_before_anyone_is_asked(monkeypatch):
    import pkcs11

    token = SimpleNamespace(
        label="t", flags=pkcs11.TokenFlag.USER_PIN_LOCKED, serial=b"1", manufacturer_id="m", model="x"
    )
    token.slot = SimpleNamespace(slot_id=0)
    monkeypatch.setattr(pkcs11, "lib", lambda _path: SimpleNamespace(get_tokens=lambda: [token]))
    with pytest.raises(VaultError) as refused:
        find_token(Pkcs11Uri("/m.so", token="t"))
    assert refused.value.message == LOCKED
    token.flags = 0
    assert find_token(Pkcs11Uri("/m.so", token="t")) is token


POINT = SoftwareKey(7).point


class Objects:
    """Mock session on a token with the objects of the test."""

    def __init__(self, private, public=()):
        self.private, self.public = private, public

    def get_objects(self, wanted):
        from pkcs11 import Attribute, ObjectClass

        return iter(self.private if wanted[Attribute.CLASS] == ObjectClass.PRIVATE_KEY else self.public)


class Held(dict):
    """An object of a token; an attribute that it lacks is an error of the module."""

    label, id = "station", b"\1"

    def __missing__(self, _attribute):
        from pkcs11.exceptions import AttributeTypeInvalid

        raise AttributeTypeInvalid


def test_the_public_point_is_read_wherever_a_token_shows_it(monkeypatch):
    import pkcs11
    from pkcs11 import Attribute

    monkeypatch.setattr(pkcs11, "PrivateKey", Held)
    safe = {Attribute.SENSITIVE: True, Attribute.EXTRACTABLE: False}
    der = b"\x04\x41" + POINT

    def found(private, *public):
        return TokenSession(Objects([private], public), SimpleNamespace(label="t")).find(label=None, identifier=None)

    for private, public in (
        (Held(safe), (Held({Attribute.EC_POINT: der}),)),
        (Held(safe), (Held({Attribute.EC_POINT: POINT}),)),  # some modules leave the OCTET STRING out
        (Held(safe), (Held(), Held({Attribute.EC_POINT: der}))),
        (Held({**safe, Attribute.EC_POINT: der}), ()),  # and some show it at the private key alone
        (Held({**safe, Attribute.EC_POINT: der}), (Held(),)),
    ):
        assert found(private, *public).point == POINT
    like_der = SoftwareKey(37).point
    assert like_der[:2] == b"\x04\x41", "a bare point whose first octets are those of the OCTET STRING"
    assert found(Held(safe), Held({Attribute.EC_POINT: like_der})).point == like_der
    with pytest.raises(VaultError) as refused:
        found(Held(safe), Held())
    assert refused.value.message == "The token 't' shows no public key beside 'station'."
    assert refused.value.hint.startswith("Load the public key with the same label and id")
    with pytest.raises(VaultError, match=r"^The key 'station' of the token is not a P-256 key\.$"):
        found(Held(safe), Held({Attribute.EC_POINT: der[:-1]}))
    for unsafe in ({**safe, Attribute.SENSITIVE: False}, {**safe, Attribute.EXTRACTABLE: True}):
        with pytest.raises(VaultError) as refused:
            found(Held(unsafe), Held({Attribute.EC_POINT: der}))
        assert refused.value.message == "The key 'station' can leave the token 't', so it is not used."
        assert refused.value.hint.startswith("Let teds-provision create one")
    two = TokenSession(Objects([Held(safe)] * 2), SimpleNamespace(label="t"))
    with pytest.raises(VaultError) as refused:
        two.find(label=None, identifier=None)
    assert refused.value.message == "2 keys of the token 't' match."
    assert refused.value.hint == "Select one by object= and id= in the URI."


def test_a_key_that_a_token_made_and_does_not_show_is_named(monkeypatch):
    session = TokenSession(Objects([]), SimpleNamespace(label="t"))
    monkeypatch.setattr(session, "_generate", lambda _label, _identifier: None)
    with pytest.raises(VaultError) as refused:
        session.generate(label="station", identifier=b"\1")
    assert refused.value.message == "The token created a key but does not show it."
    assert refused.value.hint == "Inspect it with pkcs11-tool -O."


@pytest.mark.parametrize("error", ["MechanismParamInvalid", "DomainParamsInvalid"])
@pytest.mark.parametrize("secret", [bytes(range(32)), bytes(range(1, 31))], ids=["32 octets", "30 octets"])
def test_a_point_is_given_in_der_to_a_module_that_asks_for_it(error, secret):
    """The secret is x in 32 octets, whatever a module leaves out in front; its object is destroyed."""
    from pkcs11 import Attribute, exceptions

    given, destroyed = [], []

    class Secret(dict):
        def destroy(self):
            destroyed.append(1)

    class Key:
        def derive_key(self, _kind, bits, *, mechanism, mechanism_param, template):
            given.append((bits, mechanism_param[2]))
            if mechanism_param[2] == POINT:
                raise getattr(exceptions, error)
            return Secret({Attribute.VALUE: secret})

    assert TokenKey(Key(), POINT, "station", b"\1").ecdh(POINT) == secret.rjust(32, b"\0")
    assert given == [(256, POINT), (256, b"\x04\x41" + POINT)]
    assert destroyed == [1]


def test_the_end_of_a_session_is_not_tried_twice(monkeypatch):
    from pkcs11.exceptions import GeneralError

    tries = []

    def close():
        tries.append("close")
        raise GeneralError

    session = TokenSession(SimpleNamespace(close=close), SimpleNamespace(label="bench"))
    with pytest.raises(VaultError):
        session.close()
    assert tries == ["close"]
