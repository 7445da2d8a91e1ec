"""One PKCS #11 token: finding it, logging in, making and finding P-256 keys, signing and agreeing in it.

PKCS #11 v2.40 through ``python-pkcs11`` (extra ``[pkcs11]``), which is loaded here and only when a token is used.
Facts about modules come from trials with SoftHSM 2.6.1 and from the sources of others; a real SE050 was not tried.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

from teds_provision.errors import BadDataError, VaultError, WrongPassphraseError
from teds_provision.lazy import how_to_install
from teds_provision.protocol.keys import fingerprint, normalise_signature, public_key
from teds_provision.vault.base import LAST_ATTEMPT, Ask
from teds_provision.vault.pkcs11_uri import Pkcs11Uri

if TYPE_CHECKING:
    from pkcs11 import PrivateKey as TokenObject
    from pkcs11 import Session, Token

Result = TypeVar("Result")

_RETRY_SECONDS = 0.2
_POINT_DER = b"\x04\x41"  # OCTET STRING of 65 octets
_X_OCTETS = 32


class TokenKey:
    """A P-256 key that never leaves the token; a :class:`teds_provision.protocol.keys.PrivateKey`."""

    def __init__(self, key: Any, point: bytes, label: str, identifier: bytes) -> None:
        self._key = key
        self.point = point
        self.label = label
        self.identifier = identifier

    def sign(self, message: bytes) -> bytes:
        """Return SIG(key, message): CKM_ECDSA over the SHA-256 made here, s in the lower half."""
        return self.sign_digest(hashlib.sha256(message).digest())

    def sign_digest(self, digest: bytes) -> bytes:
        """Sign the SHA-256 digest of a message."""
        from pkcs11 import Mechanism

        return normalise_signature(guarded(lambda: bytes(self._key.sign(digest, mechanism=Mechanism.ECDSA))))

    def ecdh(self, peer: bytes) -> bytes:
        """Return the x-coordinate of the ECDH: CKM_ECDH1_DERIVE with CKD_NULL into a 32-octet secret, then destroyed.

        A shorter secret would be the *last* octets of x on some modules and the first on others; key derivation is
        ours, outside, because tokens lack HKDF. Raises BadDataError for a bad point, VaultError.
        """
        public_key(peer)  # tokens are not required to check that a point is on the curve
        return guarded(lambda: self._derive(peer))

    def _derive(self, peer: bytes) -> bytes:
        from pkcs11 import KDF, Attribute, KeyType, Mechanism
        from pkcs11.exceptions import DomainParamsInvalid, MechanismParamInvalid

        def derive(point: bytes) -> bytes:
            secret = self._key.derive_key(
                KeyType.GENERIC_SECRET,
                8 * _X_OCTETS,
                mechanism=Mechanism.ECDH1_DERIVE,
                mechanism_param=(KDF.NULL, None, point),
                template={Attribute.TOKEN: False, Attribute.SENSITIVE: False, Attribute.EXTRACTABLE: True},
            )
            try:
                return bytes(secret[Attribute.VALUE]).rjust(_X_OCTETS, b"\0")
            finally:
                secret.destroy()

        try:
            return derive(peer)
        except (MechanismParamInvalid, DomainParamsInvalid):  # some modules need the point in DER
            return derive(_POINT_DER + peer)

    def __repr__(self) -> str:
        return f"TokenKey({self.label!r}, {fingerprint(self.point)[:16]})"


class TokenSession:
    """A session on one token, logged in."""

    def __init__(self, session: Session, token: Token) -> None:
        self._session = session
        self._token = token
        self.label: str = token.label

    def find(self, *, label: str | None, identifier: bytes | None) -> TokenKey | None:
        """Return the P-256 key with this label and CKA_ID; None if there is none.

        Raises VaultError: several fit, no public key beside it, another curve, or it may leave the token.
        """
        return guarded(lambda: self._find(label, identifier))

    def generate(self, *, label: str, identifier: bytes) -> TokenKey:
        """Make a P-256 key pair in the token: private, sensitive, not extractable. Raises VaultError."""
        guarded(lambda: self._generate(label, identifier), retry=False)
        key = self.find(label=label, identifier=identifier)
        if key is None:
            raise VaultError("The token created a key but does not show it.", hint="Inspect it with pkcs11-tool -O.")
        return key

    def destroy(self, key: TokenKey) -> None:
        """Destroy a key pair (CKA_ID and label both fit); a writing session shares the login of this one."""
        from pkcs11 import Attribute

        def run() -> None:
            wanted = {Attribute.LABEL: key.label, Attribute.ID: key.identifier}
            with self._token.open(rw=True) as session:
                for found in list(session.get_objects(wanted)):
                    found.destroy()

        guarded(run)

    def set_pin(self, old: str, new: str) -> None:
        """Have the token take a new user PIN; one try. Raises WrongPassphraseError, VaultError."""
        from pkcs11 import exceptions

        def run() -> None:
            with self._token.open(rw=True) as session:
                session.set_pin(old, new)

        try:
            run()
        except (exceptions.PinIncorrect, exceptions.ArgumentsBad):
            raise WrongPassphraseError(
                f"The PIN of the token {self.label!r} is wrong.", hint="Run it again with the right PIN."
            ) from None
        except (exceptions.PinInvalid, exceptions.PinLenRange):
            raise VaultError(
                f"The token {self.label!r} does not accept this as a new PIN.", hint="Check its length and characters."
            ) from None
        except exceptions.PKCS11Error as error:
            raise _failure(error) from error

    def close(self) -> None:
        """End the session; the last one to end logs out."""
        guarded(self._session.close, retry=False)

    def _generate(self, label: str, identifier: bytes) -> None:
        from pkcs11 import Attribute, KeyType, ObjectClass
        from pkcs11.util.ec import encode_named_curve_parameters

        half = {Attribute.CLASS: ObjectClass.PUBLIC_KEY, Attribute.LABEL: label, Attribute.ID: identifier}
        # left by a run that was cut while the token made the pair
        for left_over in list(self._session.get_objects(half)):
            left_over.destroy()
        curve = self._session.create_domain_parameters(
            KeyType.EC, {Attribute.EC_PARAMS: encode_named_curve_parameters("secp256r1")}, local=True
        )
        curve.generate_keypair(
            store=True,
            label=label,
            id=identifier,
            public_template={Attribute.VERIFY: True},
            private_template={
                Attribute.PRIVATE: True,
                Attribute.SENSITIVE: True,
                Attribute.EXTRACTABLE: False,
                Attribute.SIGN: True,
                Attribute.DERIVE: True,
            },
        )

    def _find(self, label: str | None, identifier: bytes | None) -> TokenKey | None:
        from pkcs11 import Attribute, KeyType, ObjectClass
        from pkcs11 import PrivateKey as TokenObject

        wanted: dict[Attribute, object] = {Attribute.CLASS: ObjectClass.PRIVATE_KEY, Attribute.KEY_TYPE: KeyType.EC}
        if label is not None:
            wanted[Attribute.LABEL] = label
        if identifier is not None:
            wanted[Attribute.ID] = identifier
        found = list(self._session.get_objects(wanted))
        if not found:
            return None
        if len(found) > 1:
            raise VaultError(
                f"{len(found)} keys of the token {self.label!r} match.",
                hint="Select one by object= and id= in the URI.",
            )
        key = found[0]
        assert isinstance(key, TokenObject)
        if not key[Attribute.SENSITIVE] or key[Attribute.EXTRACTABLE]:
            raise VaultError(
                f"The key {key.label!r} can leave the token {self.label!r}, so it is not used.",
                hint="Let teds-provision create one: give no object or id, or new ones.",
            )
        return TokenKey(key, self._point(key), key.label, key.id)

    def _point(self, key: TokenObject) -> bytes:
        """Read the public point: from the public key object, else from the private one."""
        from pkcs11 import Attribute, ObjectClass
        from pkcs11.exceptions import PKCS11Error

        wanted = {Attribute.CLASS: ObjectClass.PUBLIC_KEY, Attribute.LABEL: key.label, Attribute.ID: key.id}
        for holder in (*self._session.get_objects(wanted), key):
            try:
                point = bytes(holder[Attribute.EC_POINT])
            except PKCS11Error:  # an object without that attribute
                continue
            point = point.removeprefix(_POINT_DER) if len(point) != 65 else point
            try:
                public_key(point)
            except BadDataError as error:
                raise VaultError(f"The key {key.label!r} of the token is not a P-256 key.") from error
            return point
        raise VaultError(
            f"The token {self.label!r} shows no public key beside {key.label!r}.",
            hint="Load the public key with the same label and id, using the vendor's tool.",
        )


def find_token(uri: Pkcs11Uri) -> Token:
    """Load the module and return the one token that the URI names.

    Raises VaultError: python-pkcs11 or the module missing, no such token, several, PIN locked.
    """
    try:
        import pkcs11
    except ImportError as error:
        raise VaultError("Keys in a token need the package python-pkcs11.", hint=how_to_install("pkcs11")) from error
    try:
        library = guarded(lambda: pkcs11.lib(uri.module_path))
        tokens = guarded(lambda: [token for token in library.get_tokens() if _fits(uri, token)])
    except VaultError as failure:
        if type(failure.__cause__) is not pkcs11.PKCS11Error:  # with a return code, the module itself was loaded
            raise
        raise VaultError(
            f"The PKCS #11 module {uri.module_path} cannot be loaded.",
            hint="Install the token's driver, or correct module-path in the URI.",
        ) from failure
    if not tokens:
        raise VaultError(
            f"There is no {uri} here.", hint="Plug it in; pkcs11-tool --module MODULE -L (opensc) lists the tokens."
        )
    if len(tokens) > 1:
        raise VaultError(f"{len(tokens)} tokens match the URI.", hint="Add serial= or slot-id= to it.")
    if tokens[0].flags & pkcs11.TokenFlag.USER_PIN_LOCKED:
        raise _locked(uri)
    return tokens[0]


def log_in(token: Token, uri: Pkcs11Uri, pin: str | None, *, write: bool) -> TokenSession:
    """Open a session with ``pin`` (None: the token has its own PIN pad). One try, never a second one.

    A login belongs to the process, not to the session: if this process holds one already, the module does not look at
    the PIN. Therefore ``open_vault`` asks once per process. Raises WrongPassphraseError with the token's hint about
    remaining tries, or VaultError.
    """
    from pkcs11 import PROTECTED_AUTH, TokenFlag, exceptions

    try:
        session = token.open(rw=write, user_pin=PROTECTED_AUTH if pin is None else pin)
    except exceptions.UserAlreadyLoggedIn:
        session = guarded(lambda: token.open(rw=write))
    except (exceptions.PinIncorrect, exceptions.PinInvalid, exceptions.PinLenRange, exceptions.ArgumentsBad):
        flags = guarded(lambda: token.slot.get_token().flags)
        if flags & TokenFlag.USER_PIN_LOCKED:
            raise _locked(uri) from None
        raise WrongPassphraseError(
            f"The PIN of the {uri} is wrong. {_tries(flags)}",
            hint="Run it again with the right PIN; it is not retried automatically.",
        ) from None
    except exceptions.PinLocked:
        raise _locked(uri) from None
    except (exceptions.PinExpired, exceptions.UserPinNotInitialized):
        raise VaultError(f"The {uri} has no valid user PIN.", hint="Set one with the token's own tool.") from None
    except exceptions.PKCS11Error as error:
        raise _failure(error) from error
    return TokenSession(session, token)


def ask_pin(token: Token, uri: Pkcs11Uri, ask: Ask) -> str | None:
    """Ask for the PIN and warn before the last try; return None if the token has its own PIN pad."""
    from pkcs11 import TokenFlag

    if token.flags & TokenFlag.PROTECTED_AUTHENTICATION_PATH:
        return None
    last = f" ({LAST_ATTEMPT})" if token.flags & TokenFlag.USER_PIN_FINAL_TRY else ""
    return ask(f"PIN of the {uri}{last}", False)


def guarded(run: Callable[[], Result], *, retry: bool = True) -> Result:
    """Run something on the token; every error of the module becomes a VaultError.

    CKR_GENERAL_ERROR gets one more try: SoftHSM gives it when two processes touch their objects at once.
    """
    from pkcs11.exceptions import GeneralError, PKCS11Error

    try:
        return run()
    except GeneralError as error:
        if not retry:
            raise _failure(error) from error
    except PKCS11Error as error:
        raise _failure(error) from error
    time.sleep(_RETRY_SECONDS)
    return guarded(run, retry=False)


def _fits(uri: Pkcs11Uri, token: Token) -> bool:
    wanted = (
        (uri.token, token.label),
        (uri.serial, token.serial.decode("utf-8", "replace")),
        (uri.manufacturer, token.manufacturer_id),
        (uri.model, token.model),
        (uri.slot_id, token.slot.slot_id),
    )
    return all(asked is None or asked == has for asked, has in wanted)


def _tries(flags: int) -> str:
    from pkcs11 import TokenFlag

    if flags & TokenFlag.USER_PIN_FINAL_TRY:
        return "One attempt is left before the token locks."
    if flags & TokenFlag.USER_PIN_COUNT_LOW:
        return "The token has counted a wrong attempt and does not say how many are left."
    return "The token does not say how many attempts are left."


def _locked(uri: Pkcs11Uri) -> VaultError:
    return VaultError(
        f"The PIN of the {uri} is locked after too many wrong attempts.",
        hint="Set a new PIN with the security officer's PIN, with the token's own tool.",
    )


def _failure(error: Exception) -> VaultError:
    """Name a module's error by its PKCS #11 return code, which is what its maker's pages are sorted by."""
    name = type(error).__name__
    gone = name in {"DeviceRemoved", "DeviceError", "TokenNotPresent", "SessionHandleInvalid", "SessionClosed"}
    return VaultError(
        f"The token failed ({name}).", hint="Plug it in and run this again." if gone else "Check it with its own tool."
    )
