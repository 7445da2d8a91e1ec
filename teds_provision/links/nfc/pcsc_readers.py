"""Lists the readers of the PC/SC service, without nfcpy."""

from __future__ import annotations

from contextlib import suppress
from typing import Final

from teds_provision.errors import NoReaderError
from teds_provision.links.nfc.pcsclite import PcscError, PcscLibrary, load

PREFIX: Final = "pcsc"


def context_of(library: PcscLibrary) -> int:
    """Return a context of the PC/SC service; raises NoReaderError if it does not answer."""
    try:
        return library.establish()
    except PcscError as error:
        raise NoReaderError(
            f"The PC/SC service does not answer: {error}.",
            hint="sudo apt install pcscd; sudo systemctl start pcscd.socket. Over ssh polkit may refuse; run as root.",
        ) from error


def names() -> list[str]:
    """Return the names of all PC/SC readers; raises NoReaderError if the service or the library is missing."""
    library = load()
    context = context_of(library)
    try:
        return library.readers(context)
    except PcscError:
        return []
    finally:
        with suppress(PcscError):
            library.release(context)


def names_if_any() -> list[str]:
    """Return the same as :func:`names`, empty if there is no PC/SC here."""
    try:
        return contactless(names())
    except NoReaderError:
        return []


def contactless(found: list[str]) -> list[str]:
    """Return the readers without the slots for security modules that many have beside their antenna."""
    return [name for name in found if " SAM " not in f" {name} "]


def paths() -> list[str]:
    """Return the path of each PC/SC reader, as ``--nfc`` takes it."""
    return [f"{PREFIX}:{name}" for name in names_if_any()]
