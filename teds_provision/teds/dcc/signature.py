"""The signature of a certificate, as far as signxml checks it; what is read afterwards is the signed part alone.

A signature is XMLDSig or XAdES, one, a child of the root, over the whole document. Its digests and its value are always
checked, with the signer's certificate that it brings: a file that was changed after signing is refused. The signer is
judged only by a certificate, or the CA of one, that the caller trusts.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from teds_provision.errors import BadDataError, NotAuthenticError
from teds_provision.teds.dcc.read import DigitalCertificate, certificate_of
from teds_provision.teds.dcc.xml_tree import ROOT, Node, XmlElement, parse_xml, require_bench

if TYPE_CHECKING:
    from cryptography import x509

GOOD: Final = "good"
NOT_CHECKED: Final = "not checked"
MOST_REFERENCES: Final = 8
MOST_CERTIFICATES: Final = 8
_FIRST_YEAR, _LAST_YEAR = 1970, 9000
_XADES: Final = "http://uri.etsi.org/01903/v1.3.2#"
_ALWAYS: Final = (
    "Not checked: revocation of the signer's certificate, time stamps, signature policies (XAdES-T and above).",
)
_EXPIRED: Final = "The signer's certificate has expired; it was valid at the time of signing that the signer states."


def read_checked(octets: bytes, file: str, trusted: Sequence[bytes], now: datetime) -> DigitalCertificate:
    """Read a certificate and check its signature; ``trusted`` are certificates (PEM) of signers or of their CAs.

    With ``trusted`` a good signature by one of them is required. Without, the signature is ``not checked``, but one
    that does not match its own document is refused. Raises NotAuthenticError, BadDataError (as reading does; a PEM
    that holds no certificate).
    """
    anchors = [certificate for pem in trusted for certificate in _anchors(pem)]
    root = parse_xml(octets, file)
    signatures = Node(root, file).children_named("ds:Signature") if root.tag == ROOT else []
    if not signatures:
        if anchors:
            raise NotAuthenticError(
                f"{file} has no signature.",
                hint="Ask the laboratory for a signed certificate, or omit --trust-dcc.",
            )
        plain = certificate_of(root, octets, file)
        return replace(plain, unchecked=("The certificate has no signature.",))
    if len(signatures) > 1:
        if anchors:
            raise NotAuthenticError(f"{file} has {len(signatures)} signatures; only one can be checked.")
        text = f"The certificate has {len(signatures)} signatures; only one could be checked."
        return replace(certificate_of(root, octets, file), unchecked=(text,))
    try:
        signed, notes = _verified(octets, file, signatures[0], anchors, now)
    except _UnsupportedError as error:
        if anchors:
            raise NotAuthenticError(f"The signature of {file} cannot be checked: {error}.") from error
        return replace(certificate_of(root, octets, file), unchecked=(f"The signature cannot be checked: {error}.",))
    found = certificate_of(signed, octets, file)
    if anchors:
        return replace(found, signature=GOOD, unchecked=notes)
    return replace(found, unchecked=("The signer is not known: name the certificate with --trust-dcc.", *notes))


class _UnsupportedError(Exception):
    """The signature is of a kind that is not checked here."""


def _anchors(pem: bytes) -> list[x509.Certificate]:
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificates(pem)
    except ValueError as error:
        raise BadDataError(
            "The file of --trust-dcc holds no certificate in PEM.", hint="It begins with -----BEGIN CERTIFICATE-----."
        ) from error


def _verified(
    octets: bytes, file: str, signature: Node, anchors: Sequence[x509.Certificate], now: datetime
) -> tuple[XmlElement, tuple[str, ...]]:
    """Return the signed root, and what was not checked. Raises NotAuthenticError, _UnsupportedError."""
    require_bench("signxml")
    references = signature.all_of("ds:SignedInfo/ds:Reference")
    if not 1 <= len(references) <= MOST_REFERENCES:
        raise NotAuthenticError(f"The signature of {file} has {len(references)} references.")
    if [reference.element.get("URI") for reference in references].count("") != 1:
        raise NotAuthenticError(f"The signature of {file} does not cover the whole certificate.")
    chain = _chain(signature)
    signer, notes = _signer(file, chain, anchors, now, _stated_time(signature))
    moment = now
    if not signer.not_valid_before_utc <= now <= signer.not_valid_after_utc:
        stated = _stated_time(signature)
        if anchors and (
            stated is None or not signer.not_valid_before_utc <= min(stated, now) <= signer.not_valid_after_utc
        ):
            raise NotAuthenticError(f"The certificate that signed {file} is not valid any more, or not yet.")
        moment = signer.not_valid_before_utc if stated is None or not anchors else min(stated, now)
        notes = (_EXPIRED,) if anchors else notes
    results = _results(octets, file, signature, signer, moment)
    roots = [found for found in results if found.tag == ROOT]
    if len(roots) != 1:
        raise NotAuthenticError(f"The signature of {file} does not cover the whole certificate.")
    return roots[0], (*notes, *_ALWAYS)


def _results(octets: bytes, file: str, signature: Node, signer: x509.Certificate, moment: datetime) -> list[XmlElement]:
    """Return the elements that the signature covers, as they were signed."""
    import signxml
    from signxml import xades

    is_xades = any(node.element.tag == f"{{{_XADES}}}QualifyingProperties" for node in _objects(signature))
    try:
        if is_xades:
            config = xades.XAdESSignatureConfiguration(
                location="./", expect_references=False, verification_time=moment, require_x509=True
            )
            verified = xades.XAdESVerifier().verify(octets, x509_cert=signer, expect_config=config)
        else:
            plain = signxml.SignatureConfiguration(
                location="./", expect_references=False, verification_time=moment, require_x509=True
            )
            found = signxml.XMLVerifier().verify(octets, x509_cert=signer, expect_config=plain)
            verified = found if isinstance(found, list) else [found]
    except signxml.InvalidSignature as error:
        raise NotAuthenticError(
            f"The signature of {file} is bad: {str(error)[:160]}.",
            hint="The file was changed after it was signed, or another key signed it. Ask the laboratory for it again.",
        ) from error
    # lxml, cryptography and signxml raise their own classes for forms that they do not support
    except Exception as error:
        raise _UnsupportedError(" ".join(str(error).split())[:160].rstrip(".") or type(error).__name__) from error
    return [result.signed_xml for result in verified if result.signed_xml is not None]


def _objects(signature: Node) -> Iterable[Node]:
    for holder in signature.children_named("ds:Object"):
        yield from (Node(child, signature.file) for child in holder.element)


def _chain(signature: Node) -> list[x509.Certificate]:
    """Return the certificates that a signature brings; raises _UnsupportedError without one, or for a damaged one."""
    from cryptography import x509
    from cryptography.exceptions import UnsupportedAlgorithm

    nodes = signature.all_of("ds:KeyInfo/ds:X509Data/ds:X509Certificate")[:MOST_CERTIFICATES]
    found = []
    for node in nodes:
        try:
            one = x509.load_der_x509_certificate(base64.b64decode(node.text.replace(" ", ""), validate=True))
            _ = (
                one.subject,
                one.issuer,
                one.not_valid_before_utc,
                one.not_valid_after_utc,
                one.public_key(),
            )  # parsed only when read: raises here if damaged
        except (ValueError, binascii.Error, UnsupportedAlgorithm) as error:
            raise _UnsupportedError("a certificate in it cannot be read") from error
        found.append(one)
    if not found:
        raise _UnsupportedError("it brings no X.509 certificate")
    return found


def _signer(
    file: str,
    chain: Sequence[x509.Certificate],
    anchors: Sequence[x509.Certificate],
    now: datetime,
    stated: datetime | None,
) -> tuple[x509.Certificate, tuple[str, ...]]:
    """Return the signer's certificate: one that is trusted, or that leads to a trusted CA; any one without anchors."""
    issuers = {certificate.issuer for certificate in chain if certificate.issuer != certificate.subject}
    leaf = next((certificate for certificate in chain if certificate.subject not in issuers), chain[0])
    if not anchors or leaf in anchors:
        return leaf, ()
    for moment in (now, stated):
        if moment is None or moment > now:
            continue
        if _leads_to(leaf, [other for other in chain if other != leaf], anchors, moment):
            return leaf, (_EXPIRED,) if moment is not now else ()
    subject = leaf.subject.rfc4514_string()[:120]
    raise NotAuthenticError(
        f"{file} was signed by {subject}, which is not trusted.",
        hint="Name the laboratory's certificate or its CA: --trust-dcc CERT.pem",
    )


def _leads_to(
    leaf: x509.Certificate, others: Sequence[x509.Certificate], anchors: Sequence[x509.Certificate], moment: datetime
) -> bool:
    """Return True if a chain of certificates, valid at a moment, leads from a signer to a trusted CA."""
    from cryptography import x509
    from cryptography.x509 import verification

    leaves = verification.ExtensionPolicy.permit_all()
    authorities = verification.ExtensionPolicy.webpki_defaults_ca()
    try:
        builder = verification.PolicyBuilder().store(verification.Store(list(anchors))).time(moment)
        builder = builder.extension_policies(ee_policy=leaves, ca_policy=authorities)
        builder.build_client_verifier().verify(leaf, list(others))
    except (verification.VerificationError, ValueError, x509.UnsupportedGeneralNameType):
        return False
    return _may_sign(leaf)


def _may_sign(certificate: x509.Certificate) -> bool:
    """Return True if a certificate's key usage, if it states one, allows signatures."""
    from cryptography import x509

    try:
        usage = certificate.extensions.get_extension_for_class(x509.KeyUsage).value
    except x509.ExtensionNotFound:
        return True
    except (ValueError, x509.DuplicateExtension, x509.UnsupportedGeneralNameType):
        return False
    return usage.digital_signature or usage.content_commitment


def _stated_time(signature: Node) -> datetime | None:
    """Return the time of signing that XAdES states, None without one; the signature covers it."""
    for holder in _objects(signature):
        for element in _descendants(holder.element):
            if element.tag == f"{{{_XADES}}}SigningTime":
                try:
                    moment = datetime.fromisoformat((element.text or "").strip())
                except ValueError:
                    return None
                if not _FIRST_YEAR <= moment.year < _LAST_YEAR:
                    return None
                return moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return None


def _descendants(element: XmlElement) -> Iterable[XmlElement]:
    level = [element]
    while level:
        yield from level
        level = [child for parent in level for child in parent]
