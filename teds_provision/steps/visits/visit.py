"""One meeting with a node: unlock, wait for it, have its turn, identify. Every command at a node begins with this."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from teds_provision.errors import BadData, NotFound
from teds_provision.files import read_limited
from teds_provision.links import LinkSettings
from teds_provision.station.station import Station
from teds_provision.steps.agree import require_session
from teds_provision.steps.identify import Identified, identify
from teds_provision.talk.conversation import Conversation
from teds_provision.talk.meeting import meet
from teds_provision.talk.progress import Reporter
from teds_provision.teds.codec import security
from teds_provision.teds.image import Image

MAX_IMAGE_OCTETS: Final = 16 << 20
Unlock = Literal["always", "if held", "never"]


@dataclass(frozen=True)
class Visit:
    """A node that was met and proved its identity key, for as long as the meeting lasts."""

    station: Station
    node: Conversation
    who: Identified

    def session(self) -> None:
        """Open a session under the key that is held; raises PolicyRefused where there is none."""
        require_session(self.station, self.node)


@contextmanager
def at_node(
    station: Station, links: LinkSettings, uuid: bytes, reporter: Reporter, *, unlock: Unlock = "if held"
) -> Iterator[Visit]:
    """Meet node ``uuid`` on the chosen link and have it prove its key.

    The vault is opened before anyone is waited for: always, where a key of this node is held, or never. Another
    command of this station that works on the same node is waited for. Raises NoReader, NoNode after ``links.timeout``
    seconds, OtherKey, NotAuthentic, LinkFailure.
    """

    def before() -> None:
        if unlock != "never":
            station.unlock(None if unlock == "always" else uuid)

    with meet(station, links, uuid, reporter, before=before) as node, station.turn(uuid):
        yield Visit(station, node, identify(station, node))


def node_or_image(station: Station, text: str, *, node: bool = False) -> bytes | Image:
    """The image of a file, or the UUID that ``text`` names; raises NotFound which says what of the two it is not.

    Of both the file, but with ``node`` the node.
    """
    path = Path(text)
    if node:
        with suppress(NotFound):
            return station.nodes.resolve(text)
    if path.is_file():
        return read_image_file(path)
    try:
        return station.nodes.resolve(text)
    except NotFound:
        if path.is_dir():
            raise NotFound(f"{text} is a folder, and no node is known by that name.") from None
        if path.exists():
            raise NotFound(f"{text} is no regular file, and no node is known by that name.") from None
        if path.suffix or len(path.parts) > 1:
            raise NotFound(f"There is no file {text}, and no node is known by that name.") from None
        raise


def read_image_file(path: Path) -> Image:
    """Read an image file; raises NotFound, BadData (of KeyAgreement 1 too, by name)."""
    try:
        image = Image.from_json(read_limited(path, MAX_IMAGE_OCTETS, "image"))
    except BadData as error:
        raise BadData(
            f"{path} is no TEDS image: {error.message}", hint=error.hint or "Images come from build, sign and read."
        ) from error
    return security.require_our_wire(image)
