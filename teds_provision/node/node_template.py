"""A virtual transducer from a datasheet: the TEDS that it is made with, which are its hardware from then on."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from teds_provision.errors import BadDataError
from teds_provision.files import read_limited
from teds_provision.limits import LIMITS
from teds_provision.node.flash_file import FILE, FlashFile
from teds_provision.node.hardware.board import Board
from teds_provision.node.wrapped.description import WrappedSensor
from teds_provision.protocol.datasheet import can_be_stored, passes_own_check
from teds_provision.teds.formats import UUID_OCTETS, placed, stated_uuid, under
from teds_provision.teds.image import SECURITY, BlockId, Image
from teds_provision.teds.origin import ORIGIN
from teds_provision.teds.profile import load_profile
from teds_provision.teds.profile.model import renamed
from teds_provision.teds.sheet import Sheet


@dataclass(frozen=True)
class NodeTemplate:
    """TEDS of one node, without Security TEDS; ``uuid`` is the one in them, None if they have none (or all zeros)."""

    blocks: Mapping[BlockId, bytes]
    uuid: bytes | None = None

    def with_uuid(self, uuid: bytes) -> NodeTemplate:
        """Return the same node under another UUID, also in field 4 of a Meta-TEDS of the 2007 form."""
        return NodeTemplate(under(self.blocks, uuid), uuid)


def from_file(path: Path) -> NodeTemplate:
    """Read an image, XML, JSON, hex or binary file; a channel's TEDS without a channel are those of channel 1.

    Raises NotFoundError, and BadDataError that names the TEDS which no node holds.
    """
    found = _placed(path)
    for (channel, code), teds in found.items():
        if not can_be_stored((channel, code)) or not passes_own_check((channel, code), teds):
            raise BadDataError(
                f"{path}: no node can hold the TEDS of access code {code} of channel {channel}, or it is damaged.",
                hint=f"To see what is wrong: show {path}",
            )
    return NodeTemplate(found, stated_uuid(found))


def _placed(path: Path) -> dict[BlockId, bytes]:
    """Return the TEDS of a file by place, without Security TEDS; a profile is read with those that it extends."""
    octets = read_limited(path, LIMITS.teds_file, "file of TEDS")
    try:
        return placed(octets, path=path)
    except BadDataError as error:
        raise BadDataError(f"{path}: {error.message}", hint=error.hint) from error


def from_profile(profile: str, folders: tuple[Path, ...] | None, uuid: bytes, name: str = "") -> NodeTemplate:
    """Return the TEDS of a type, without calibration; raises NotFoundError and BadDataError."""
    made = load_profile(profile, folders).build(uuid, name=name or None)
    return NodeTemplate({key: teds for key, teds in made.blocks.items() if key != SECURITY}, uuid)


def create(
    folder: Path,
    *,
    uuid: bytes | None = None,
    name: str = "",
    max_message: int = 2048,
    teds: Path | None = None,
    profile: str | None = None,
    folders: tuple[Path, ...] | None = None,
    sensor: WrappedSensor | None = None,
) -> FlashFile:
    """Make a node, or open the one that was made so before. Its UUID: the one given, else the file's, else random.

    ``name`` replaces the one in the file.
    With ``sensor`` it wraps that one: its Origin TEDS is read-only.

    Raises UsageError (the folder holds another node), NotFoundError, BadDataError, StoreError.
    """
    described = from_file(teds) if teds is not None else None
    if described is not None and name:
        described = NodeTemplate(renamed(described.blocks, name), described.uuid)
    wanted = uuid or (described.uuid if described is not None else None)
    if wanted is None:
        wanted = FlashFile(folder).load().uuid if (folder / FILE).exists() else secrets.token_bytes(UUID_OCTETS)
    if profile is not None:
        described = from_profile(profile, folders, wanted, name)
    if sensor is not None:
        described = NodeTemplate(sensor.blocks(wanted, name), wanted)
    blocks = None
    if described is not None:
        blocks = described.with_uuid(wanted).blocks
        Board(Sheet.from_image(Image(wanted, blocks)))  # reports now, not at run time, what a board cannot imitate
    read_only = frozenset({ORIGIN}) if sensor is not None else frozenset[BlockId]()
    return FlashFile.create(folder, uuid=wanted, name=name, max_message=max_message, blocks=blocks, read_only=read_only)
