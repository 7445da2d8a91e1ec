"""Calibration certificates for tests: the repository's examples, changed a little, and a laboratory that signs them."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

EXAMPLES = Path(__file__).parents[2] / "examples" / "dcc"
ANGLE = (EXAMPLES / "angle.xml").read_bytes()
TEMPERATURE = (EXAMPLES / "temperature.xml").read_bytes()
POINTS = [(400.0, 2.1), (16700.0, 91.6), (33120.0, 181.9), (49400.0, 271.4)]
"""Raw value and angle in degrees of the example."""


def changed(octets: bytes, *pairs: tuple[str, str]) -> bytes:
    """Return a certificate with texts exchanged; each must be there."""
    text = octets.decode()
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    return text.encode()


@dataclass(frozen=True)
class Signer:
    """A laboratory's key, its certificate and those above it, as PEM."""

    key: bytes
    certificate: bytes
    chain: tuple[bytes, ...] = ()

    def sign(self, octets: bytes, *, xades: bool = True) -> bytes:
        """Return a certificate with an enveloped signature."""
        import signxml
        from lxml import etree
        from signxml.xades import XAdESSigner

        root = etree.fromstring(octets)
        method = signxml.SignatureMethod.ECDSA_SHA256
        inclusive = signxml.CanonicalizationMethod.CANONICAL_XML_1_1
        maker = XAdESSigner if xades else signxml.XMLSigner
        signer = maker(signature_algorithm=method, digest_algorithm="sha256", c14n_algorithm=inclusive)
        signed = signer.sign(root, key=self.key, cert=[p.decode() for p in (self.certificate, *self.chain)])
        whole: bytes = etree.tostring(signed, xml_declaration=True, encoding="UTF-8")
        return whole


def _made(
    name: str,
    issuer: tuple[x509.Certificate, ec.EllipticCurvePrivateKey] | None,
    days: tuple[int, int],
    *,
    ca: bool,
    use: str = "sign",
) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.now(UTC)
    above, by = issuer if issuer is not None else (None, key)
    usage = x509.KeyUsage(
        not ca and use == "sign", use == "commit", False, use == "encipher", False, ca, ca, False, False
    )
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(above.subject if above is not None else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now + timedelta(days=days[0]))
        .not_valid_after(now + timedelta(days=days[1]))
        .add_extension(x509.BasicConstraints(ca, None), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(by.public_key()), critical=False)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("lab.example")]), critical=False)
    )
    builder = builder.add_extension(usage, critical=True) if use else builder
    return builder.sign(by, hashes.SHA256()), key


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


@cache
def signer(name: str = "Thermolab Example", days: tuple[int, int] = (-1, 300)) -> Signer:
    """Return a laboratory with a certificate that it signed itself."""
    certificate, key = _made(name, None, days, ca=False)
    return Signer(_key(key), _pem(certificate))


@cache
def signer_under_ca(use: str = "sign") -> tuple[Signer, bytes]:
    """Return a laboratory whose key is for one use ("" if it states none), and the PEM of the CA above it."""
    ca = _made("Accreditation Example", None, (-30, 3000), ca=True)
    certificate, key = _made("Lab under a CA", ca, (-1, 300), ca=False, use=use)
    return Signer(_key(key), _pem(certificate)), _pem(ca[0])


def _key(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
