"""A token is opened: PINs, tries, modules and tokens that are not there."""

from __future__ import annotations

import pytest

from teds_provision.errors import UsageError, VaultError, WrongPassphraseError
from teds_provision.vault.pkcs11 import Pkcs11Vault
from teds_provision.vault.pkcs11_token import _tries, ask_pin
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
