"""Signatures of calibration certificates: who signed what, and that only the signed part is read."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import cast

import pytest
from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.x509 import verification
from lxml import etree

from teds_provision.errors import BadDataError, NotAuthenticError
from teds_provision.teds.dcc import signature
from teds_provision.teds.dcc.read import DigitalCertificate
from teds_provision.teds.dcc.signature import read_checked
from teds_provision.teds.dcc.xml_tree import Node

from .certificates import ANGLE, changed, signer, signer_under_ca

DS = "{http://www.w3.org/2000/09/xmldsig#}"


def read(octets: bytes, *trusted: bytes, later: float = 0) -> DigitalCertificate:
    return read_checked(octets, "c.xml", trusted, datetime.now(UTC) + timedelta(days=later))


@pytest.mark.parametrize("xades", [True, False], ids=["XAdES", "XMLDSig"])
def test_a_signature_is_good_by_the_trusted_laboratory_alone(xades: bool) -> None:
    lab, other = signer(), signer("Another laboratory")
    signed = lab.sign(ANGLE, xades=xades)
    good = read(signed, other.certificate, lab.certificate)
    assert good.signature == "good"
    assert "revocation" in " ".join(good.unchecked), "what was not checked is stated"
    assert good.number == "B2-2026-0042"
    unknown = read(signed)
    assert unknown.signature == "not checked"
    assert "--trust-dcc" in unknown.unchecked[0]
    with pytest.raises(NotAuthenticError, match="CN=Thermolab Example, which is not trusted") as refused:
        read(signed, other.certificate)
    assert refused.value.hint == "Name the laboratory's certificate or its CA: --trust-dcc CERT.pem"


def test_a_changed_certificate_is_refused_regardless_of_trust() -> None:
    lab = signer()
    forged = changed(lab.sign(ANGLE), ("91.6", "81.6"))
    for trusted in ((), (lab.certificate,)):
        with pytest.raises(NotAuthenticError, match=r"signature of c\.xml is bad") as refused:
            read(forged, *trusted)
        assert refused.value.hint == (
            "The file was changed after it was signed, or another key signed it. Ask the laboratory for it again."
        )


def test_a_signature_cannot_be_left_out_if_one_is_required() -> None:
    lab = signer()
    assert read(ANGLE).unchecked == ("The certificate has no signature.",)
    with pytest.raises(NotAuthenticError, match="has no signature") as refused:
        read(ANGLE, lab.certificate)
    assert refused.value.hint == "Ask the laboratory for a signed certificate, or omit --trust-dcc."
    signed = lab.sign(ANGLE)
    bare = changed(signed, ("http://www.w3.org/2001/04/xmldsig-more#ecdsa-sha256", "urn:unknown"))
    assert "cannot be checked" in read(bare).unchecked[0]
    with pytest.raises(NotAuthenticError, match="cannot be checked"):
        read(bare, lab.certificate)


def test_a_laboratory_below_a_trusted_ca_is_trusted() -> None:
    lab, ca = signer_under_ca()
    good = read(lab.sign(ANGLE), ca)
    assert good.signature == "good"
    assert good.unchecked == (
        "Not checked: revocation of the signer's certificate, time stamps, signature policies (XAdES-T and above).",
    ), "nothing has expired"
    with pytest.raises(NotAuthenticError, match="CN=Lab under a CA, which is not trusted"):
        read(lab.sign(ANGLE), signer().certificate)


def test_an_expired_signers_certificate_counts_at_the_time_of_signing_and_is_stated() -> None:
    lab = signer()
    late = read(lab.sign(ANGLE), lab.certificate, later=400)
    assert late.signature == "good"
    assert late.unchecked[0].startswith("The signer's certificate has expired")
    with pytest.raises(NotAuthenticError, match="not valid any more"):
        read(lab.sign(ANGLE, xades=False), lab.certificate, later=400)  # states no time
    below, ca = signer_under_ca()
    assert read(below.sign(ANGLE), ca, later=400).unchecked.count(late.unchecked[0]) == 1
    gone = signer("Expired long ago", (-900, -500))
    with pytest.raises(NotAuthenticError, match="not valid any more"):
        read(gone.sign(ANGLE), gone.certificate)
    for xades in (True, False):  # the validity of an untrusted signer's certificate does not matter
        unknown = read(gone.sign(ANGLE, xades=xades))
        assert (unknown.signature, len(unknown.unchecked)) == ("not checked", 2)
        assert unknown.unchecked[0].startswith("The signer is not known")


def test_a_signature_wrapped_into_another_certificate_covers_nothing() -> None:
    """The signed certificate goes into a comment of a forged one: the signature must not count for the forged one."""
    lab = signer()
    signed = etree.fromstring(lab.sign(ANGLE))
    signature = signed.find(f"{DS}Signature")
    signed.remove(signature)
    for target in ("", "#inner"):
        forged = etree.fromstring(changed(ANGLE, ("91.6", "11.6")))
        hidden = etree.SubElement(forged, "{https://ptb.de/dcc}comment")
        inner = etree.fromstring(etree.tostring(signed))
        inner.set("Id", "inner")
        hidden.append(inner)
        copy = etree.fromstring(etree.tostring(signature))
        for reference in copy.iter(f"{DS}Reference"):
            if reference.get("URI") == "":
                reference.set("URI", target)
        forged.append(copy)
        for trusted in ((), (lab.certificate,)):
            with pytest.raises(NotAuthenticError):
                read(etree.tostring(forged), *trusted)


def test_what_is_beside_the_signed_part_is_not_read() -> None:
    """Of a document that was signed as a whole nothing can be added; comments are no part of it, and not read."""
    lab = signer()
    commented = changed(lab.sign(ANGLE), ("B2-2026-0042", "B2-<!-- 9 -->2026-0042"))
    assert read(commented, lab.certificate).number == "B2-2026-0042"


def test_two_signatures_or_too_many_references_are_refused_if_one_is_required() -> None:
    lab = signer()
    signed = etree.fromstring(lab.sign(ANGLE))
    signature = signed.find(f"{DS}Signature")
    signed.append(etree.fromstring(etree.tostring(signature)))
    assert "2 signatures" in read(etree.tostring(signed)).unchecked[0]
    with pytest.raises(NotAuthenticError, match="2 signatures"):
        read(etree.tostring(signed), lab.certificate)
    many = etree.fromstring(lab.sign(ANGLE))
    info = many.find(f"{DS}Signature/{DS}SignedInfo")
    for _ in range(9):
        info.append(etree.fromstring(etree.tostring(info.find(f"{DS}Reference"))))
    with pytest.raises(NotAuthenticError, match="references"):
        read(etree.tostring(many), lab.certificate)


def test_a_file_that_holds_no_certificate_is_named_as_such() -> None:
    with pytest.raises(BadDataError, match="no certificate in PEM") as refused:
        read(ANGLE, b"-----BEGIN NOTHING-----")
    assert refused.value.hint == "It begins with -----BEGIN CERTIFICATE-----."


@pytest.mark.parametrize(("use", "good"), [("sign", True), ("commit", True), ("", True), ("encipher", False)])
def test_a_key_below_a_trusted_ca_is_one_for_signatures(use: str, good: bool) -> None:
    lab, ca = signer_under_ca(use)
    signed = lab.sign(ANGLE)
    if good:
        assert read(signed, ca).signature == "good"
    else:
        with pytest.raises(NotAuthenticError, match="which is not trusted"):
            read(signed, ca)


def _reordered(octets: bytes) -> bytes:
    """Return a signed certificate whose signature brings its certificates the other way round."""
    root = etree.fromstring(octets)
    (holder,) = root.iter(f"{DS}X509Data")
    certificates = holder.findall(f"{DS}X509Certificate")
    assert len(certificates) == 2
    for certificate in reversed(certificates):
        holder.remove(certificate)
        holder.append(certificate)
    return etree.tostring(root)


def test_a_trusted_certificate_that_is_only_brought_along_makes_no_signer_trusted() -> None:
    lab, thief = signer(), signer("Another laboratory")
    forged = replace(thief, chain=(lab.certificate,)).sign(ANGLE, xades=False)
    for octets in (forged, _reordered(forged)):
        with pytest.raises(NotAuthenticError):
            read(octets, lab.certificate)


def test_the_signers_certificate_is_found_wherever_it_stands_and_so_is_a_trusted_one() -> None:
    lab, ca = signer_under_ca()
    signed = replace(lab, chain=(ca,)).sign(ANGLE, xades=False)
    for octets in (signed, _reordered(signed)):
        assert read(octets, ca).signature == "good"
        assert read(octets, lab.certificate).signature == "good"
    other = signer("Another laboratory").certificate
    assert read(signed, other + lab.certificate).signature == "good", "the second of a file"


def test_a_signers_certificate_that_is_not_valid_yet_is_refused() -> None:
    """By our clock: a time of signing that is later than now proves nothing."""
    lab = signer()
    with pytest.raises(NotAuthenticError, match="not valid any more, or not yet"):
        read(lab.sign(ANGLE), lab.certificate, later=-400)
    below, ca = signer_under_ca()
    with pytest.raises(NotAuthenticError, match="which is not trusted"):
        read(below.sign(ANGLE), ca, later=-20)


def test_a_signature_without_the_signers_certificate_cannot_be_checked() -> None:
    lab = signer()
    signed = etree.fromstring(lab.sign(ANGLE, xades=False))
    (holder,) = signed.iter(f"{DS}KeyInfo")
    holder.getparent().remove(holder)
    bare = etree.tostring(signed)
    why = "it brings no X.509 certificate."
    assert read(bare).unchecked == (f"The signature cannot be checked: {why}",)
    with pytest.raises(NotAuthenticError) as refused:
        read(bare, lab.certificate)
    assert refused.value.message == f"The signature of c.xml cannot be checked: {why}"


@pytest.mark.parametrize("found", [[], ["other"], ["root", "root"], ["root", "other", "root"]], ids=str)
def test_a_signature_covers_the_whole_certificate_once(found: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """One of the parts that signxml reports as signed is the whole document; otherwise nothing is read."""
    lab = signer()
    octets = lab.sign(ANGLE)
    parts = {"root": etree.fromstring(octets), "other": etree.fromstring("<a/>")}
    monkeypatch.setattr(signature, "_results", lambda *_: [parts[name] for name in found])
    for trusted in ((), (lab.certificate,)):
        with pytest.raises(NotAuthenticError, match="does not cover the whole certificate"):
            read(octets, *trusted)


@pytest.mark.parametrize(
    ("stated", "usable"),
    [
        ("2000-01-01T00:00:00+00:00", False),  # before the signer's certificate
        ("soon", False),
        ("", False),
        ("1969-12-31T23:59:59+00:00", False),
        ("9000-01-01T00:00:00+00:00", False),
        ("{}T00:00:00+00:00", True),
        ("{}T00:00:00Z", True),
        ("{}T00:00:00", True),  # without a time zone: UTC
    ],
)
def test_a_time_of_signing_that_is_none_saves_no_expired_signer(stated: str, usable: bool) -> None:
    """A time within the certificate's days is taken, and then the signature, which covers it, is found bad."""
    gone = signer("Expired long ago", (-900, -500))
    octets = gone.sign(ANGLE)
    (given,) = re.findall(rb"(?<=SigningTime>)[^<]+(?=<)", octets)
    within = (datetime.now(UTC) - timedelta(days=700)).date()
    forged = octets.replace(given, stated.format(within).encode())
    with pytest.raises(NotAuthenticError, match="is bad" if usable else "not valid any more, or not yet"):
        read(forged, gone.certificate)


@pytest.mark.parametrize(
    ("stated", "moment"),
    [
        ("1970-01-01T00:00:00", datetime(1970, 1, 1, tzinfo=UTC)),
        ("8999-12-31T23:59:59Z", datetime(8999, 12, 31, 23, 59, 59, tzinfo=UTC)),
        ("2026-01-01T12:00:00+02:00", datetime(2026, 1, 1, 10, tzinfo=UTC)),
        (" 2026-01-01T12:00:00-01:30 ", datetime(2026, 1, 1, 13, 30, tzinfo=UTC)),
        ("1969-12-31T23:59:59Z", None),
        ("9000-01-01T00:00:00Z", None),
    ],
)
def test_a_stated_time_of_signing_is_one_of_the_years_1970_to_8999(stated: str, moment: datetime | None) -> None:
    octets = signer().sign(ANGLE)
    octets = re.sub(rb"(?<=SigningTime>)[^<]+(?=<)", stated.encode(), octets)
    (node,) = Node(etree.fromstring(octets), "c").children_named("ds:Signature")
    assert signature._stated_time(node) == moment


@pytest.mark.parametrize(
    "damage",
    [ValueError("x"), x509.DuplicateExtension("x", x509.KeyUsage.oid), x509.UnsupportedGeneralNameType("x")],
    ids=lambda damage: type(damage).__name__,
)
def test_a_key_whose_use_cannot_be_read_may_not_sign(damage: Exception) -> None:
    class Damaged:
        @property
        def extensions(self) -> x509.Extensions:
            raise damage

    assert not signature._may_sign(cast(x509.Certificate, Damaged()))


def test_a_signature_by_someone_unknown_states_what_was_not_checked_either() -> None:
    unknown = read(signer().sign(ANGLE)).unchecked
    assert unknown[0] == "The signer is not known: name the certificate with --trust-dcc."
    assert "revocation" in unknown[1]


@pytest.mark.parametrize("damage", [ValueError("no DER"), UnsupportedAlgorithm("a key of a new kind")])
def test_a_signers_certificate_that_cannot_be_read_makes_the_signature_one_that_cannot_be_checked(
    damage: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The library reads a certificate piece by piece, and meets an unknown key only when it is asked for it."""
    lab = signer()
    signed = lab.sign(ANGLE)

    class Damaged:
        subject = issuer = not_valid_before_utc = not_valid_after_utc = None

        def public_key(self) -> object:
            raise damage

    monkeypatch.setattr(x509, "load_der_x509_certificate", lambda _octets: Damaged())
    why = "The signature cannot be checked: a certificate in it cannot be read."
    assert read(signed).unchecked[0] == why
    with pytest.raises(NotAuthenticError, match="a certificate in it cannot be read"):
        read(signed, lab.certificate)


@pytest.mark.parametrize(
    "failure",
    [ValueError("x"), x509.UnsupportedGeneralNameType("x"), verification.VerificationError("x")],
    ids=lambda failure: type(failure).__name__,
)
def test_a_chain_that_cannot_be_judged_leads_to_no_trusted_ca(
    failure: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise failure

    monkeypatch.setattr(verification, "Store", fails)
    leaf = cast(x509.Certificate, None)
    assert not signature._leads_to(leaf, [], [], datetime.now(UTC))
