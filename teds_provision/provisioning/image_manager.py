"""The station's side of SMP inside a session: a board's images, the upload, trial and confirm (profile.md, "Manage").

``smp`` makes packets and reads replies. Replies that it would accept too easily are refused before:
those of another request, CBOR tags, an upload that does not advance.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final, TypeVar

from teds_provision.errors import (
    GarbledError,
    LinkError,
    NodeRefusedError,
    NodeSilentError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
)
from teds_provision.lazy import how_to_install
from teds_provision.links.ports import TransferLink
from teds_provision.protocol.messages.frames import Function, Reason, security_command
from teds_provision.protocol.messages.smp import (
    LEAST_OCTETS,
    MANAGE_OVERHEAD,
    SMP_ERROR_KEYS,
    decode_map,
    decode_packet,
)
from teds_provision.provisioning.conversation import Conversation, SessionLostError

if TYPE_CHECKING:
    from smp.message import Request, Response

_STUCK: Final = 3
"""Replies in a row whose offset does not grow: such a board never takes the rest."""
_BUSY_SECONDS: Final = 15.0
"""A board refuses another image for 10 s after the start of an upload, and other sessions end."""
_BUSY_PAUSE: Final = 0.5
_LOSSES: Final = 20
_SMALLEST_PACKET: Final = 128
_SHORT_PACKET: Final = 256
"""Octets of a packet beside streams: commands go before data on CAN, and this one takes 10 ms at 500 kbit/s."""

Reply = TypeVar("Reply", bound="Response")
Progress = Callable[[int, int], None]
"""``progress(octets on the board, octets of the image)``."""


@dataclass(frozen=True)
class BoardImage:
    """An image on a board: digest, and whether it runs, is confirmed, or starts next."""

    digest: bytes
    running: bool
    confirmed: bool
    pending: bool


class ImageManager:
    """The images of the board in an open session.

    Each call raises SessionLostError, LinkError, NodeRefusedError; NotAuthenticError for a reply that no image manager
    gives, PolicyError for an error of the manager.
    """

    def __init__(self, node: Conversation) -> None:
        self._node = node
        self._os, self._image = _smp("os_management"), _smp("image_management")
        self._largest = node.identity.max_message - MANAGE_OVERHEAD
        self._asked_size = False

    # -- commands --------------------------------------------------------------------------------------------------

    def images(self) -> list[BoardImage]:
        """Return the images in the slots of the board."""
        found = self._ask(self._image.ImageStatesReadRequest(), self._image.ImageStatesReadResponse, "its images")
        return [
            BoardImage(bytes(image.hash or b""), bool(image.active), bool(image.confirmed), bool(image.pending))
            for image in found.images
            if not image.image
        ]

    def start_next(self, digest: bytes) -> None:
        """Have an image start next, on trial."""
        request = self._image.ImageStatesWriteRequest(hash=digest)
        self._ask(request, self._image.ImageStatesWriteResponse, "to try the image")

    def confirm(self) -> None:
        """Keep the running image."""
        request = self._image.ImageStatesWriteRequest(confirm=True)
        self._ask(request, self._image.ImageStatesWriteResponse, "to keep the image")

    def restart(self) -> None:
        """Restart the board; a lost reply is not an error, because c of the next Open shows if it restarted."""
        with suppress(NodeSilentError, GarbledError, SessionLostError):
            self._ask(self._os.ResetWriteRequest(), self._os.ResetWriteResponse, "to restart")
        self._node.forget()

    # -- the upload ------------------------------------------------------------------------------------------------

    def upload(self, octets: bytes, progress: Progress) -> int:
        """Upload an image into the other slot, starting after the octets that the board has; return the octets sent.

        A lost session is opened again, and lost frames make the packets shorter.
        """
        sent = losses = 0
        while True:
            try:
                for taken, on_board in self._upload_once(octets):
                    sent += taken
                    losses = 0 if taken else losses
                    progress(on_board, len(octets))
                return sent
            except SessionLostError as lost:
                failure: LinkError | SessionLostError = lost
            except (NodeSilentError, GarbledError) as lost:
                failure = lost
            losses += 1
            if losses > _LOSSES or not self._node.is_alive():
                raise failure.cause if isinstance(failure, SessionLostError) else failure
            self._largest = max(_SMALLEST_PACKET, self._largest // 2)
            self._node.reopen()

    def _upload_once(self, octets: bytes) -> Iterator[tuple[int, int]]:
        """Yield octets of each piece that advanced the upload, and how many the board has."""
        self._fit_buffer()
        sha, length = hashlib.sha256(octets).digest(), len(octets)
        offset = highest = stuck = 0
        while offset < length:
            more: dict[str, Any] = {"len": length, "sha": sha} if offset == 0 else {}
            piece = octets[offset : offset + self._room(offset, more)]
            reply = self._ask(
                self._image.ImageUploadWriteRequest(off=offset, data=piece, **more),
                self._image.ImageUploadWriteResponse,
                "the image",
            )
            after = reply.off
            if after is None or not 0 <= after <= length:
                raise NotAuthenticError(f"The board reports {after} of {length} octets received, which cannot be.")
            stuck = 0 if after > highest else stuck + 1
            if stuck >= _STUCK:
                raise NotAuthenticError(
                    f"The board does not accept the image beyond octet {after}.",
                    hint="Its image manager is defective. The board still runs its old firmware.",
                )
            if after == length and reply.match is False:
                raise NotAuthenticError(
                    "The board received other octets than were sent.",
                    hint="Try again. If the error persists, the board's flash is defective.",
                )
            yield (len(piece) if after == offset + len(piece) else 0), after
            offset, highest = after, max(highest, after)

    def _room(self, offset: int, more: dict[str, Any]) -> int:
        """Return how many octets of the image one packet takes."""
        link = self._node.contact.link
        largest = self._largest
        if isinstance(link, TransferLink) and link.wait_for_air():
            largest = min(largest, _SHORT_PACKET)
        empty = self._image.ImageUploadWriteRequest(off=offset, data=b"", **more)
        return max(1, largest - len(empty.BYTES) - 2)  # the length of the data takes up to 2 more octets

    def _fit_buffer(self) -> None:
        """Ask once how long a packet may be."""
        if self._asked_size:
            return
        request = self._os.MCUMgrParametersReadRequest()
        found = self._ask(request, self._os.MCUMgrParametersReadResponse, "its packet size")
        if found.buf_size < LEAST_OCTETS + _SMALLEST_PACKET:
            raise NotAuthenticError(
                f"The board accepts packets of {found.buf_size} octets only, too short for an image."
            )
        self._largest = min(self._largest, found.buf_size)
        self._asked_size = True

    # -- requests and replies --------------------------------------------------------------------------------------

    def _ask(self, request: Request, kind: type[Reply], doing: str) -> Reply:
        asked = decode_packet(request.BYTES)
        octets = self._exchange(request.BYTES, doing)
        try:
            reply = decode_packet(octets)
            values = decode_map(reply.body)
        except ValueError as error:
            raise _no_reply(doing, str(error)) from error
        due = asked.reply(reply.body)
        if not reply.whole or (reply.command, reply.sequence) != (due.command, due.sequence):
            raise _no_reply(doing, "it belongs to another request")
        if failed := next((values[key] for key in SMP_ERROR_KEYS if values.get(key)), None):
            raise PolicyError(
                f"The board's image manager refused {doing}: {_error_text(failed)}.",
                hint="The board still runs its present firmware. Check that the image fits its slot.",
            )
        try:
            loaded = kind.loads(octets)
        except (ValueError, AssertionError, TypeError) as error:  # pydantic's errors are ValueErrors
            raise _no_reply(doing, "it lacks what belongs there") from error
        except Exception as error:
            from smp.exceptions import SMPException

            if not isinstance(error, SMPException):
                raise
            raise _no_reply(doing, "it lacks what belongs there") from error
        if not _is_same(values, loaded.model_dump(include=set(values))):
            raise _no_reply(doing, "a value is of another type")
        return loaded

    def _exchange(self, packet: bytes, doing: str) -> bytes:
        """Send one packet; a busy board is asked again for a while."""
        until = time.monotonic() + _BUSY_SECONDS
        while True:
            try:
                return self._node.request(security_command(Function.MANAGE, packet), doing)
            except NodeRefusedError as refusal:
                if refusal.reason != Reason.BUSY or time.monotonic() >= until:
                    raise
            time.sleep(_BUSY_PAUSE)


def _is_same(came: object, loaded: object) -> bool:
    """Return True if what smp loaded is what came: it takes the text "9" for the number."""
    if isinstance(came, dict):
        return isinstance(loaded, dict) and all(_is_same(value, loaded.get(key)) for key, value in came.items())
    if isinstance(came, list):
        return isinstance(loaded, list) and len(came) == len(loaded) and all(map(_is_same, came, loaded))
    return (isinstance(loaded, type(came)) and isinstance(came, bool) == isinstance(loaded, bool)) and came == loaded


def _error_text(failed: object) -> str:
    if isinstance(failed, dict):
        return f"group {failed.get('group')}, error {failed.get('rc')}"
    return f"error {failed}"


def _no_reply(doing: str, why: str) -> NotAuthenticError:
    return NotAuthenticError(f"The board's reply to {doing} is no reply of an image manager: {why}.")


def _smp(module: str) -> ModuleType:
    """Import a module of smp; raises NotFoundError."""
    from importlib import import_module

    try:
        return import_module(f"smp.{module}")
    except ModuleNotFoundError as error:
        raise NotFoundError("A firmware update needs the package smp.", hint=how_to_install("update")) from error
