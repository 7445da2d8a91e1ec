"""The CA key as a file to keep away: PKCS #8 in PEM, encrypted (RFC 5958, RFC 8018 PBES2).

PBKDF2-HMAC-SHA-256 with 600,000 rounds and AES-256-CBC: any OpenSSL opens it. The number of rounds is why it is put
together here: the library's own writer takes 2,048.
"""

from __future__ import annotations

import base64
import os
from pathlib import Path
from textwrap import wrap
from typing import Final

from teds_provision.errors import UsageError, VaultError, WrongPassphraseError
from teds_provision.files import read_limited, write_new
from teds_provision.vault.passphrase import check_new

ROUNDS: Final = 600_000
MAX_ROUNDS: Final = 10_000_000
"""Some seconds of work: the number comes from a file that is not verified yet."""
_MAX_OCTETS: Final = 16 * 1024
_LABEL: Final = "ENCRYPTED PRIVATE KEY"
# DER of the object identifiers, tag and length included (RFC 8018 appendix C, RFC 3565).
_PBES2: Final = bytes.fromhex("06092a864886f70d01050d")
_PBKDF2: Final = bytes.fromhex("06092a864886f70d01050c")
_HMAC_SHA256: Final = bytes.fromhex("06082a864886f70d0209") + b"\x05\x00"
_AES256_CBC: Final = bytes.fromhex("060960864801650304012a")
_SEQUENCE, _INTEGER, _OCTETS = 0x30, 0x02, 0x04


def write_ca(path: Path, secret: bytes, passphrase: str) -> None:
    """Write the key of a 32-octet scalar, encrypted, into a new file of mode 0600.

    Raises VaultError: the file exists, the passphrase is weak, or it cannot be written (then none is left).
    """
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    check_new(passphrase)
    key = ec.derive_private_key(int.from_bytes(secret, "big"), ec.SECP256R1())
    pem = _encrypted_pem(key.private_bytes(Encoding.DER, PrivateFormat.PKCS8, NoEncryption()), passphrase)
    try:
        write_new(path, pem, failure=VaultError)
    except UsageError as taken:  # since version 0.1 this command fails with the exit code of the vault
        raise VaultError(taken.message, hint=taken.hint) from None


def read_ca(path: Path, passphrase: str) -> bytes:
    """Return the 32-octet scalar of an encrypted P-256 key in PEM.

    Raises NotFoundError, WrongPassphraseError, BadDataError (too large), VaultError (not such a file).
    """
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    pem = read_limited(path, _MAX_OCTETS, "CA key", failure=VaultError)
    if _LABEL.encode() not in pem:
        raise VaultError(
            f"{path} contains no encrypted private key in PEM format.", hint="Give the file that trust ca export wrote."
        )
    _check_costs(path, pem)
    try:
        key = load_pem_private_key(pem, passphrase.encode("utf-8", "surrogateescape"))
    except (ValueError, TypeError):  # a wrong passphrase and a damaged file look alike
        raise WrongPassphraseError(
            f"Wrong passphrase for {path}.", hint="Try again. If it is right, the file is damaged."
        ) from None
    except Exception as error:  # for unsupported ciphers and curves the library raises many exception classes
        raise VaultError(
            f"{path} contains an unsupported kind of key.", hint="Give the file that trust ca export wrote."
        ) from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or not isinstance(key.curve, ec.SECP256R1):
        raise VaultError(f"{path} contains no P-256 key.", hint="Give the file that trust ca export wrote.")
    return key.private_numbers().private_value.to_bytes(32, "big")


def _check_costs(path: Path, pem: bytes) -> None:
    """Refuse what would take minutes before the passphrase is tried: only PBES2 with PBKDF2 and bounded rounds."""
    text = b"".join(line for line in pem.split(b"\n") if not line.startswith(b"-----")).strip()
    try:
        der = base64.b64decode(text, validate=False)
    except ValueError:
        der = b""
    place = der.find(_PBKDF2)
    rounds = _rounds(der[place + len(_PBKDF2) :]) if _PBES2 in der and place >= 0 else 0
    if not 0 < rounds <= MAX_ROUNDS:
        raise VaultError(
            f"{path} is encrypted in an unsupported way.",
            hint=f"Encrypt it with PBES2 and PBKDF2 of at most {MAX_ROUNDS:,} rounds: openssl pkcs8 -topk8 -v2 aes256",
        )


def _rounds(parameters: bytes) -> int:
    """Return the iteration count of PBKDF2-params (RFC 8018 appendix A.2); 0 if it is malformed."""
    try:
        salt = 2 if parameters[1] < 0x80 else 2 + (parameters[1] & 0x7F)
        if parameters[0] != _SEQUENCE or parameters[salt] != _OCTETS or parameters[salt + 1] >= 0x80:
            return 0
        number = salt + 2 + parameters[salt + 1]
        if parameters[number] != _INTEGER or parameters[number + 1] > 8:
            return 0
        return int.from_bytes(parameters[number + 2 : number + 2 + parameters[number + 1]], "big")
    except IndexError:
        return 0


def _encrypted_pem(der: bytes, passphrase: str) -> bytes:
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
    from cryptography.hazmat.primitives.kdf.pbkdf2 import PBKDF2HMAC
    from cryptography.hazmat.primitives.padding import PKCS7

    salt, iv = os.urandom(16), os.urandom(16)
    key = PBKDF2HMAC(hashes.SHA256(), length=32, salt=salt, iterations=ROUNDS).derive(passphrase.encode())
    padder, cipher = PKCS7(128).padder(), Cipher(algorithms.AES256(key), modes.CBC(iv)).encryptor()
    ciphertext = cipher.update(padder.update(der) + padder.finalize()) + cipher.finalize()
    derivation = _der(
        _SEQUENCE,
        _der(_OCTETS, salt) + _der(_INTEGER, ROUNDS.to_bytes(3, "big")) + _der(_SEQUENCE, _HMAC_SHA256),
    )
    scheme = _der(_SEQUENCE, _PBKDF2 + derivation) + _der(_SEQUENCE, _AES256_CBC + _der(_OCTETS, iv))
    algorithm = _der(_SEQUENCE, _PBES2 + _der(_SEQUENCE, scheme))
    text = base64.b64encode(_der(_SEQUENCE, algorithm + _der(_OCTETS, ciphertext))).decode()
    return "\n".join([f"-----BEGIN {_LABEL}-----", *wrap(text, 64), f"-----END {_LABEL}-----", ""]).encode()


def _der(tag: int, content: bytes) -> bytes:
    """Encode one element; lengths up to 65,535."""
    length = len(content)
    if length < 0x80:
        return bytes([tag, length]) + content
    octets = length.to_bytes((length.bit_length() + 7) // 8, "big")
    return bytes([tag, 0x80 | len(octets)]) + octets + content
