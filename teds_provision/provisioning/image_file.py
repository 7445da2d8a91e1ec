"""A datasheet in a file: read, and verified by itself, without any link."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from teds_provision.errors import BadDataError, NotFoundError, TedsProvisionError
from teds_provision.files import read_limited
from teds_provision.provisioning.calibration_guard import guard
from teds_provision.provisioning.verify import require_authentic, verify_image
from teds_provision.shapes.verdict import Verification
from teds_provision.station.firmware import KnownFirmware
from teds_provision.station.station import Station
from teds_provision.teds.codec import security
from teds_provision.teds.image import Image

MAX_IMAGE_OCTETS: Final = 16 << 20


def node_or_image(station: Station, text: str, *, is_node: bool = False) -> bytes | Image:
    """Return the image of a file, or the UUID that ``text`` names; raises NotFoundError if it is neither.

    If both match, the file wins unless ``is_node`` is true.
    """
    path = Path(text)
    if is_node:
        with suppress(NotFoundError):
            return station.nodes.resolve(text)
    if path.is_file():
        return read_image_file(path)
    try:
        return station.nodes.resolve(text)
    except NotFoundError:
        if path.is_dir():
            raise NotFoundError(f"{text} is a folder, and no node has that name.") from None
        if path.exists():
            raise NotFoundError(f"{text} is not a regular file, and no node has that name.") from None
        if path.suffix or len(path.parts) > 1:
            raise NotFoundError(f"There is no file {text}, and no node with that name.") from None
        raise


def read_image_file(path: Path) -> Image:
    """Read an image file; raises NotFoundError, BadDataError (of KeyAgreement 1 too, by name)."""
    try:
        image = Image.from_json(read_limited(path, MAX_IMAGE_OCTETS, "image"))
    except BadDataError as error:
        raise BadDataError(
            f"{path} is not a TEDS image: {error.message}", hint=error.hint or "Images come from build, sign and read."
        ) from error
    return security.require_our_wire(image)


@dataclass(frozen=True)
class VerifyReport:
    """All checks of a node or an image, warnings, and the error that the verification ends with, None for none."""

    verified: Verification
    warnings: tuple[str, ...]
    error: TedsProvisionError | None
    firmware: KnownFirmware | None = None


def verify_image_file(station: Station, path: Path, accept_calibration: str | None = None) -> VerifyReport:
    """Read an image file and check it by itself, as :func:`verify_image_alone`."""
    return verify_image_alone(station, read_image_file(path), accept_calibration)


def verify_image_alone(station: Station, image: Image, accept_calibration: str | None = None) -> VerifyReport:
    """Check a datasheet by itself; ``accept_calibration``: why a calibration that the guard refuses is right."""
    verified = Verification(image.uuid, tuple(verify_image(station, image)), scope="image")
    return concluded(station, image, verified, accept_calibration)


def concluded(
    station: Station,
    image: Image,
    verified: Verification,
    accept_calibration: str | None,
    firmware: KnownFirmware | None = None,
) -> VerifyReport:
    """Return the report of a verification, with the error that it ends with and the guard's warnings."""
    try:
        require_authentic(verified)
        return VerifyReport(verified, guard(station, image, None, accept_calibration), None, firmware)
    except TedsProvisionError as error:
        return VerifyReport(verified, (), error, firmware)
