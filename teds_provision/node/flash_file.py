"""The virtual transducer's flash: one file, replaced whole at every commit, so that a power cut leaves old or new."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import secrets
import time
from collections.abc import Mapping
from pathlib import Path
from shlex import quote
from typing import Any

from teds_provision.errors import BadDataError, NotFoundError, StoreError, StoreLockedError, UsageError
from teds_provision.files import read_limited, whole_file
from teds_provision.limits import load_json
from teds_provision.node.reported_firmware import own_report, report_from_json, report_to_json
from teds_provision.protocol.announce import default_can_address
from teds_provision.protocol.flash import Flash, FlashError, in_factory_state
from teds_provision.protocol.keys import SoftwareKey, node_key_message
from teds_provision.protocol.messages.firmware import FirmwareReport
from teds_provision.protocol.messages.frames import LIST_OVERHEAD
from teds_provision.teds.image import BlockId

FORMAT = "teds-virtual-node/3"
_OLDER = ("teds-virtual-node/1", "teds-virtual-node/2")
FILE = "flash.json"
_MOST_OCTETS = 64 << 20


class FlashFile:
    """Flash and identity key of one virtual node in ``folder/flash.json`` (mode 0600); ``delay`` seconds a commit.

    ``exclusive`` takes the node for this process until it ends. Raises NotFoundError, BadDataError, StoreLockedError
    (it runs), StoreError (the folder cannot be used).
    """

    def __init__(self, folder: Path, *, delay: float = 0.0, exclusive: bool = False) -> None:
        self.path = folder / FILE
        self._delay = delay
        self._lock: int | None = None
        if exclusive and folder.is_dir():
            self._hold()  # before reading, so that the last write of another process is not undone
        self._document = self._read()

    @classmethod
    def create(
        cls,
        folder: Path,
        *,
        uuid: bytes | None = None,
        name: str = "",
        max_message: int = 2048,
        blocks: Mapping[BlockId, bytes] | None = None,
        read_only: frozenset[BlockId] = frozenset(),
        firmware: FirmwareReport | None = None,
    ) -> FlashFile:
        """Make a node in factory state with its own key; an existing one of that UUID is opened instead.

        ``blocks`` are TEDS that it is made with: stored unsigned, and kept aside as what its hardware is; those of
        ``read_only`` cannot be written. ``firmware`` is what it reports as running, by default this package.
        """
        if (folder / FILE).exists():
            existing = cls(folder)
            if uuid not in (None, existing.load().uuid) or blocks not in (None, existing.hardware):
                raise UsageError(f"{folder} already holds another node.", hint="Choose another folder.")
            return existing
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise _unusable(folder, error) from error
        uuid = secrets.token_bytes(10) if uuid is None else uuid
        least = LIST_OVERHEAD + 3 * (len(blocks or {}) + 1)
        if max_message < least:
            raise UsageError(
                f"A node with {len(blocks or {})} TEDS needs messages of {least} octets to list them.",
                hint=f"--max-message {least}",
            )
        key = SoftwareKey.generate()
        flash = Flash(
            uuid,
            key.point,
            key.sign(node_key_message(uuid, key.point)),
            blocks=dict(blocks or {}),
            read_only=read_only,
            can_address=default_can_address(uuid),
        )
        head = {"format": FORMAT, "name": name, "max_message": max_message, "key": key.secret().hex()}
        if blocks:
            head["hardware"] = _blocks_to_json(blocks)
        if firmware is not None:
            head["firmware"] = report_to_json(firmware)
        try:
            _replace(folder / FILE, head | {"flash": _flash_to_json(flash)})
        except OSError as error:
            raise _unusable(folder, error) from error
        return cls(folder)

    @property
    def key(self) -> SoftwareKey:
        """The node's identity key."""
        return SoftwareKey.from_secret(bytes.fromhex(self._document["key"]))

    @property
    def name(self) -> str:
        """The name that its maker chose."""
        return str(self._document["name"])

    @property
    def max_message(self) -> int:
        """Octets of the longest frame that this node handles."""
        return int(self._document["max_message"])

    @property
    def hardware(self) -> dict[BlockId, bytes]:
        """The TEDS that it was made with: what its channels are, whatever datasheet is written later."""
        return _blocks_from_json(self._document.get("hardware", []))

    @property
    def firmware(self) -> FirmwareReport | None:
        """The firmware that it reports; None (``"firmware": null`` in the file) makes it a node from before 128.21."""
        return _report(self._document)

    def load(self) -> Flash:
        """Return the committed state."""
        return _flash_from_json(self._document["flash"])

    def commit(self, state: Flash) -> None:
        """Replace the file in one atomic step (write, fsync, rename, fsync of the folder)."""
        time.sleep(self._delay)
        document = {**self._document, "flash": _flash_to_json(state)}
        try:
            _replace(self.path, document)
        except OSError as error:
            raise FlashError from error
        self._document = document

    def release(self) -> None:
        """Let another process take the node."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _hold(self) -> None:
        """Take the node for this process until it ends."""
        try:
            self._lock = os.open(
                self.path.with_name("lock"), os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600
            )
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StoreLockedError(f"The node in {self.path.parent} is already running.") from None
        except OSError as error:
            raise _unusable(self.path.parent, error) from error

    def _read(self) -> dict[str, Any]:
        try:
            octets = read_limited(self.path, _MOST_OCTETS, "flash", failure=StoreError)
        except NotFoundError:
            if self.path.exists():
                raise
            raise NotFoundError(
                f"There is no virtual node in {self.path.parent}.",
                hint=f"Make one: teds-provision node create {quote(str(self.path.parent))}",
            ) from None
        try:
            document = load_json(octets, "the flash", octets=_MOST_OCTETS)
        except BadDataError as error:
            raise BadDataError(f"{self.path} is not a virtual node's flash.") from error
        try:
            document = _migrated(document)
            whole = document["format"] == FORMAT and "name" in document and int(document["max_message"]) > 0
            SoftwareKey.from_secret(bytes.fromhex(document["key"]))
            _flash_from_json(document["flash"])
            _blocks_from_json(document.get("hardware", []))
            _report(document)
        except (KeyError, TypeError, ValueError, AttributeError, BadDataError):
            whole = False
        if not whole:
            raise BadDataError(f"{self.path} is not a virtual node's flash, or it is damaged.", hint="Make a new node.")
        return dict(document)


def _report(document: Mapping[str, Any]) -> FirmwareReport | None:
    if "firmware" not in document:
        return own_report()
    described = document["firmware"]
    return None if described is None else report_from_json(described)


def _migrated(document: dict[str, Any]) -> dict[str, Any]:
    """Return a flash of KeyAgreement 1 as the board is after firmware that uses 2: in factory state.

    Identity key, UUID, epoch, sequence and address stay, and the other TEDS, which count as unsigned. Everything agreed
    under KeyAgreement 1 goes: link key, CA, station, and the Security TEDS that names it. Written with the next commit.
    """
    if document["format"] not in _OLDER:
        return document
    flash = in_factory_state(_flash_from_json(document["flash"]))
    return {**document, "format": FORMAT, "flash": _flash_to_json(flash)}


def _unusable(folder: Path, error: OSError) -> StoreError:
    return StoreError(f"The folder {folder} cannot be used: {error.strerror}.", hint="Choose another folder.")


def _blocks_to_json(blocks: Mapping[BlockId, bytes]) -> list[list[int | str]]:
    return [[channel, code, blocks[channel, code].hex()] for channel, code in sorted(blocks)]


def _blocks_from_json(blocks: Any) -> dict[BlockId, bytes]:
    return {(channel, code): bytes.fromhex(teds) for channel, code, teds in blocks}


def _flash_to_json(flash: Flash) -> dict[str, Any]:
    def text(octets: bytes | None) -> str | None:
        return None if octets is None else octets.hex()

    return {
        "uuid": flash.uuid.hex(),
        "node_key": flash.node_key.hex(),
        "node_key_signature": flash.node_key_signature.hex(),
        "blocks": _blocks_to_json(flash.blocks),
        "read_only": sorted(map(list, flash.read_only)),
        "epoch": flash.epoch,
        "sequence": flash.sequence,
        "key": text(flash.key),
        "station": text(flash.station),
        "ca": text(flash.ca),
        "provisioned": flash.provisioned,
        "can_address": flash.can_address,
    }


def _flash_from_json(data: dict[str, Any]) -> Flash:
    def octets(text: str | None) -> bytes | None:
        return None if text is None else bytes.fromhex(text)

    return Flash(
        uuid=bytes.fromhex(data["uuid"]),
        node_key=bytes.fromhex(data["node_key"]),
        node_key_signature=bytes.fromhex(data["node_key_signature"]),
        blocks=_blocks_from_json(data["blocks"]),
        read_only=frozenset((channel, code) for channel, code in data["read_only"]),
        epoch=data["epoch"],
        sequence=data["sequence"],
        key=octets(data["key"]),
        station=octets(data["station"]),
        ca=octets(data["ca"]),
        provisioned=data["provisioned"],
        can_address=data["can_address"],
    )


def _replace(path: Path, document: dict[str, Any]) -> None:
    octets = json.dumps(document).encode()
    with whole_file(path, replace=True) as file:
        file.write(octets)
        file.seek(0)
        if file.read() != octets:  # the old file is replaced only by octets that were read back
            raise OSError(errno.EIO, "the flash does not read back as it was written", str(path))
