"""PKCS #11 URIs (RFC 7512)."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.errors import UsageError
from teds_provision.vault.pkcs11_uri import Pkcs11Uri

M = "?module-path=/lib/m.so"


def test_every_attribute_is_read():
    text = "pkcs11:token=The%20Station;serial=DE%3B0;manufacturer=Snake%20Oil;model=1.0;object=key;id=%00%ff;slot-id=7"
    assert Pkcs11Uri.parse(text + ";type=private" + M) == Pkcs11Uri(
        "/lib/m.so", "The Station", "DE;0", "Snake Oil", "1.0", "key", b"\x00\xff", 7
    )
    assert Pkcs11Uri.parse("PKCS11:" + M) == Pkcs11Uri("/lib/m.so")


@pytest.mark.parametrize("text", ["", "pkcs11", "pkcs11?module-path=/lib/m.so", "file:token=t"])
def test_what_is_no_uri_of_a_token_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match="given as a URI that starts with pkcs11:") as refused:
        Pkcs11Uri.parse(text)
    assert "module-path=" in refused.value.hint


@pytest.mark.parametrize(
    ("path", "shown"),
    [
        ("token=hand;serial=7;slot-id=0", "token 'hand'"),
        ("serial=7;slot-id=0", "token with the serial number 7"),
        ("slot-id=0", "token in slot 0"),
        ("slot-id=3", "token in slot 3"),
        ("model=1", "token"),
    ],
)
def test_a_token_is_called_by_its_label_else_its_number_else_its_slot(path: str, shown: str) -> None:
    assert str(Pkcs11Uri.parse(f"pkcs11:{path}{M}")) == shown


@pytest.mark.parametrize("query", ["pin-value=1234", "pin-source=file:/etc/pin", "pin-source=%7Cprog", "pin-value="])
@pytest.mark.parametrize("between", ["&", "?"])
def test_no_uri_may_hold_a_pin_and_the_message_does_not_repeat_it(query, between):
    text = f"pkcs11:token=t{M}&{query}" if between == "&" else f"pkcs11:token=t?{query}&module-path=/lib/m.so"
    with pytest.raises(UsageError, match="may not contain a PIN") as refused:
        Pkcs11Uri.parse(text)
    assert "1234" not in str(refused.value)
    assert "--passphrase-fd" in refused.value.hint


def test_a_pin_among_the_path_attributes_is_refused_as_well():
    with pytest.raises(UsageError, match="may not contain a PIN"):
        Pkcs11Uri.parse("pkcs11:token=t;pin-value=1234" + M)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "pkcs11",
        "file:token=t" + M,
        "pkcs11:token=t",
        "pkcs11:token=t?module-name=softhsm",
        "pkcs11:token=t;token=u" + M,
        "pkcs11:token" + M,
        "pkcs11:=t" + M,
        "pkcs11:token=t;colour=red" + M,
        "pkcs11:token=t" + M + "&x-vendor=1",
        "pkcs11:token=%ff" + M,
        "pkcs11:token=" + M,
        "pkcs11:token=%1b[2J" + M,
        "pkcs11:type=cert" + M,
        "pkcs11:slot-id=one" + M,
        "pkcs11:slot-id=%c2%b2" + M,
        "pkcs11:?module-path=",
        "pkcs11:library-version=3" + M,
    ],
)
def test_what_might_name_something_else_is_refused(text):
    with pytest.raises(UsageError):
        Pkcs11Uri.parse(text)


@settings(deadline=None)
@given(st.text(max_size=60))
def test_any_text_is_read_or_refused(text):
    for whole in (text, "pkcs11:" + text, "pkcs11:" + text + M):
        with suppress(UsageError):
            assert isinstance(Pkcs11Uri.parse(whole), Pkcs11Uri)


@settings(deadline=None)
@given(st.text(alphabet=st.characters(min_codepoint=33, max_codepoint=0x2FF), min_size=1).filter(str.isprintable))
def test_any_printable_label_can_be_expressed(label):
    from urllib.parse import quote

    assert Pkcs11Uri.parse(f"pkcs11:token={quote(label, safe='')}{M}").token == label


def test_what_people_call_a_token_and_which_module_is_meant() -> None:
    called = [("token=t;serial=5", "token 't'"), ("serial=5;slot-id=7", "token with the serial number 5"),
              ("slot-id=7", "token in slot 7"), ("object=key", "token")]  # fmt: skip
    for attributes, name in called:
        assert str(Pkcs11Uri.parse(f"pkcs11:{attributes}?module-path=/m.so")) == name
    with pytest.raises(UsageError, match="Use module-path, not module-name"):
        Pkcs11Uri.parse("pkcs11:token=t?module-name=softhsm&module-path=/m.so")


@pytest.mark.parametrize(
    ("text", "name"), [(f"token=t;colour=red{M}", "colour"), (f"token=t{M}&x-vendor=1", "x-vendor")]
)
def test_an_attribute_that_is_not_known_is_named(text: str, name: str) -> None:
    with pytest.raises(UsageError, match=rf"^This tool does not know the PKCS #11 URI attribute {name}\.$"):
        Pkcs11Uri.parse(f"pkcs11:{text}")
