"""PKCS #11 URIs (RFC 7512): which module, which token, which key. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import unquote_to_bytes

from teds_provision.errors import UsageError

_PATH = frozenset({"token", "serial", "manufacturer", "model", "object", "id", "slot-id", "type"})
_SECRETS = frozenset({"pin-value", "pin-source"})
_EXAMPLE = "For example: pkcs11:token=station?module-path=/usr/lib/softhsm/libsofthsm2.so"


@dataclass(frozen=True)
class Pkcs11Uri:
    """The attributes of a URI that this tool reads; None for those that it lacks."""

    module_path: str
    token: str | None = None
    serial: str | None = None
    manufacturer: str | None = None
    model: str | None = None
    object: str | None = None
    id: bytes | None = None
    slot_id: int | None = None

    @classmethod
    def parse(cls, text: str) -> Pkcs11Uri:
        """Parse a URI strictly; raises UsageError.

        An unknown or repeated attribute is refused, as it might have distinguished two tokens. So are ``pin-value`` and
        ``pin-source``: no option may hold a secret, and no store may name the file that holds it.
        """
        scheme, colon, rest = text.partition(":")
        if scheme.lower() != "pkcs11" or not colon:
            raise UsageError("A token is given as a URI that starts with pkcs11:.", hint=_EXAMPLE)
        path, _, query = rest.partition("?")
        found = _attributes(path, ";") | {f"?{name}": value for name, value in _attributes(query, "&").items()}
        _refuse(found)
        module = found.pop("?module-path", None)
        if module is None:
            raise UsageError("The PKCS #11 URI has no module-path.", hint=_EXAMPLE)
        unknown = ", ".join(name.removeprefix("?") for name in found.keys() - _PATH)
        if unknown:
            raise UsageError(f"This tool does not know the PKCS #11 URI attribute {unknown}.", hint=_EXAMPLE)
        if found.get("type", b"private") != b"private":
            raise UsageError("The PKCS #11 URI names another type than a private key.")
        slot = _number("slot-id", found.get("slot-id"))
        texts = {name: _text(name, found.get(name)) for name in ("token", "serial", "manufacturer", "model", "object")}
        return cls(
            _text("module-path", module) or "",
            id=found.get("id"),
            slot_id=slot,
            **texts,
        )

    def __str__(self) -> str:
        """Return what people call the token: its label, serial or slot."""
        if self.token is not None:
            return f"token {self.token!r}"
        if self.serial is not None:
            return f"token with the serial number {self.serial}"
        return "token" if self.slot_id is None else f"token in slot {self.slot_id}"


def _attributes(part: str, separator: str) -> dict[str, bytes]:
    found: dict[str, bytes] = {}
    for pair in part.split(separator) if part else ():
        name, equals, value = pair.partition("=")
        if not equals or not name or name in found:
            raise UsageError(f"The PKCS #11 URI has no or two values for {name!r}.", hint=_EXAMPLE)
        found[name] = unquote_to_bytes(value)
    return found


def _refuse(found: dict[str, bytes]) -> None:
    if any(name.removeprefix("?") in _SECRETS for name in found):
        raise UsageError(
            "A PKCS #11 URI may not contain a PIN or its place.",
            hint="Remove pin-value and pin-source: you are asked for the PIN, or pass it with --passphrase-fd.",
        )
    if "?module-name" in found:
        raise UsageError("Use module-path, not module-name.", hint=_EXAMPLE)


def _number(name: str, octets: bytes | None) -> int | None:
    if octets is None:
        return None
    if not octets.isdigit():
        raise UsageError(f"The {name} of the PKCS #11 URI is not a number.")
    return int(octets)


def _text(name: str, octets: bytes | None) -> str | None:
    try:
        text = None if octets is None else octets.decode("utf-8")
    except UnicodeDecodeError as error:
        raise UsageError(f"The {name} of the PKCS #11 URI is not UTF-8.") from error
    if text is not None and not (text and text.isprintable()):
        raise UsageError(f"The {name} of the PKCS #11 URI is empty or not printable.")
    return text
