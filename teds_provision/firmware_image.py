"""An MCUboot image file: version, digest, the board that it names, and whose signature it has.

imgtool reads and checks it; nothing here parses an image. Its traps: it takes a file without signature for a good one
unless a key is given, reads files named ``.hex`` as Intel HEX, and raises whatever ``struct`` raises for a torn file.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import BadDataError, NotAuthenticError, NotFoundError
from teds_provision.files import read_limited
from teds_provision.lazy import how_to_install
from teds_provision.sanitize import printable

if TYPE_CHECKING:
    from imgtool.keys.general import KeyClass

MOST_OCTETS: Final = 16 << 20
"""Octets of the largest image file: more than any slot of a microcontroller."""
BOARD_TLV: Final = 0x54A0
"""Protected custom TLV that names the board (UTF-8): ``imgtool sign --custom-tlv 0x54a0 TEXT``."""
_COUNTER_TLV: Final = 0x50
_DIGEST_TLVS: Final = (0x10, 0x11, 0x12)
_DIGEST_OCTETS: Final = 32
_LONGEST_KEY: Final = 1 << 16

Version = tuple[int, int, int, int]
"""Major, minor, patch, build."""


@dataclass(frozen=True)
class FirmwareImage:
    """An image file whose header and digest are good.

    ``digest`` is MCUboot's (of SHA-384 and SHA-512 the first 32 octets), not that of the file. ``board`` is the text of
    the TLV 0x54A0, None if there is none; ``security_counter`` likewise. The payload begins at ``header_octets``.
    ``signed``: its signature was checked.
    """

    octets: bytes
    version: Version
    digest: bytes
    board: str | None
    security_counter: int | None
    header_octets: int
    signed: bool = False

    @property
    def version_text(self) -> str:
        """The version as imgtool writes it: 1.2.3+45, without a build of 0."""
        return version_text(self.version)


def version_text(version: Version) -> str:
    """Return a version as imgtool writes it: 1.2.3+45, without a build of 0."""
    major, minor, patch, build = version
    return f"{major}.{minor}.{patch}" + (f"+{build}" if build else "")


def load_firmware_image(path: Path, key: Path | None = None) -> FirmwareImage:
    """Read an image file, and check its signature if the owner's ``key`` (PEM, public or private) is given.

    Raises NotFoundError, BadDataError (no image, torn, padded), NotAuthenticError (wrong or no signature).
    """
    octets = read_limited(path, MOST_OCTETS, "firmware image")
    try:
        return read_firmware_image(octets, None if key is None else load_key(key))
    except (BadDataError, NotAuthenticError) as error:
        raise type(error)(f"{path}: {error.message}", hint=error.hint) from error


def load_key(path: Path) -> KeyClass:
    """Read the owner's key, public or private, of any kind that MCUboot checks; raises NotFoundError, BadDataError."""
    return read_key(read_limited(path, _LONGEST_KEY, "firmware key"))


def read_key(pem: bytes) -> KeyClass:
    """Read a key from PEM; raises BadDataError."""
    keys = _imgtool("keys")
    with tempfile.NamedTemporaryFile(suffix=".pem") as file:
        file.write(pem)
        file.flush()
        try:
            key: KeyClass | None = keys.load(file.name)
        except Exception as error:  # imgtool and cryptography raise ValueError, TypeError and Exception itself
            raise _no_key() from error
    if key is None:
        raise BadDataError(
            "The firmware key is encrypted with a passphrase.",
            hint="Give its public half: imgtool getpub -k KEY.pem -e pem",
        )
    return key


def _no_key() -> BadDataError:
    return BadDataError(
        "This is not a firmware key.", hint="Use the PEM file that imgtool keygen or getpub -e pem wrote."
    )


def public_pem(key: KeyClass) -> bytes:
    """Return the public half of a key as PEM."""
    with tempfile.NamedTemporaryFile(suffix=".pem") as file:
        key.export_public(file.name)
        return Path(file.name).read_bytes()


def read_firmware_image(octets: bytes, key: KeyClass | None = None) -> FirmwareImage:
    """Return the facts of an image file once its header, TLVs and digest are good, and with a key its signature.

    Raises BadDataError, NotAuthenticError.
    """
    image, dumpinfo = _imgtool("image"), _imgtool("dumpinfo")
    # it prints a warning about bad trailers to stdout, and its option silent does not prevent this
    dumpinfo.print = _no_output
    with tempfile.TemporaryDirectory() as folder:
        path, listing = Path(folder, "image.bin"), Path(folder, "image.json")
        path.write_bytes(octets)
        try:
            verdict, version, digest, _ = image.Image.verify(str(path), None)
            good = verdict is image.VerifyResult.OK
            if good:
                dumpinfo.dump_imginfo(str(path), outfile=str(listing), output_format="json", silent=True)
                info = json.loads(listing.read_bytes())
                signed = key is not None and image.Image.verify(str(path), key)[0] is image.VerifyResult.OK
        except Exception as error:  # struct.error, IndexError and TypeError for torn files
            raise _no_image() from error
    if not good:
        raise _no_image()
    board, counter = _named_in(info, digest)
    if key is not None and not signed:
        raise NotAuthenticError(
            "The firmware image is not signed with this key.",
            hint="Sign it with the owner's key (imgtool sign -k), or name the right one with --key.",
        )
    header = int(info["header"]["hdr_size"])
    return FirmwareImage(
        octets, tuple(version), digest[:_DIGEST_OCTETS], board, counter, header, signed=key is not None
    )


def _named_in(info: Any, digest: bytes) -> tuple[str | None, int | None]:
    """Return the board and the security counter of an image, whose TLVs must be whole; raises BadDataError."""
    area = info["tlv_area"]
    lists = (area["tlvs_prot"], area["tlvs"])
    if any(len(tlv["data"]) != 2 * tlv["len"] for tlvs in lists for tlv in tlvs):
        raise _no_image()
    if info["trailer"]:
        raise BadDataError(
            "The firmware image is padded, or has octets after its end.",
            hint="Sign it without --pad and --confirm: the trailer tells the boot loader which image to start.",
        )
    digests = [tlv["data"] for tlv in area["tlvs"] if tlv["type"] in _DIGEST_TLVS]
    if digests != [digest.hex()]:
        raise _no_image()
    counters = [bytes.fromhex(tlv["data"]) for tlv in area["tlvs_prot"] if tlv["type"] == _COUNTER_TLV]
    boards = [bytes.fromhex(tlv["data"]) for tlv in area["tlvs_prot"] if tlv["type"] == BOARD_TLV]
    if len(counters) > 1 or len(boards) > 1:
        raise _no_image()
    try:
        board = printable(boards[0].decode()) if boards else None
    except UnicodeDecodeError:
        raise BadDataError("The name of the board in the firmware image is not UTF-8.") from None
    return board, int.from_bytes(counters[0], "little") if counters else None


def _no_image() -> BadDataError:
    return BadDataError(
        "This is not a whole MCUboot image, or its digest is wrong.",
        hint="Use the file that imgtool sign wrote (zephyr.signed.bin), whole.",
    )


def _no_output(*_words: object, **_options: object) -> None:
    """Print nothing."""


def _imgtool(module: str) -> Any:
    """Import a module of imgtool; raises NotFoundError."""
    from importlib import import_module

    try:
        return import_module(f"imgtool.{module}")
    except ModuleNotFoundError as error:
        first: BaseException = error  # imgtool is installed but cbor2, and its replacement cbor, are missing
        while isinstance(first.__context__, ModuleNotFoundError):
            first = first.__context__
        missing = (getattr(first, "name", None) or "imgtool").partition(".")[0]
        raise NotFoundError(f"A firmware image needs the package {missing}.", hint=how_to_install("update")) from error
