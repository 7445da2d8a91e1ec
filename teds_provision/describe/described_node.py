"""The facts about one node from which every description is made, and the error for one that a format requires.

Only a datasheet that is authentic today is described: other programs take a description for the node's own word, and
none of them checks a signature.
"""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

from teds_provision.errors import BadDataError, NotFoundError
from teds_provision.provisioning.readings import verdict_of
from teds_provision.provisioning.verify import require_authentic
from teds_provision.station.shown_units import shown_units
from teds_provision.station.station import Station
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.formats.xmlform import parse
from teds_provision.teds.image import Image
from teds_provision.teds.sheet import Sheet

IDENTIFICATION: Final = '[[text]] with kind = "meta-identification"'
"""Place of the nameplate in a profile: its XML becomes the Meta-Identification TEDS (access code 11)."""


class MissingFieldError(BadDataError):
    """A format requires a field that the datasheet lacks (exit 8)."""

    code: ClassVar[str] = "missing-field"


@dataclass(frozen=True)
class DescribedNode:
    """A node with its datasheet.

    ``name`` is the station's name for it, else the datasheet's. ``nameplate`` holds the elements of its
    Meta-Identification TEDS in lower case, ``fingerprint`` is the SHA-256 of its Security TEDS (64 hex digits).
    """

    uuid: bytes
    name: str
    profile: str
    sheet: Sheet
    nameplate: Mapping[str, str]
    fingerprint: str

    def missing(self, form: str, field: str, key: str) -> MissingFieldError:
        """Return the error for a field that ``form`` requires; ``key`` is the profile key that provides it."""
        own = self.profile.endswith(".toml") or not self.profile
        file = (self.profile or "NAME") if own else "my-type.toml"
        place = f"its profile{f' {file}' if self.profile else ''}"
        hint = f"Add {key} to {place}, then: provision {self.uuid.hex()} --profile {file}"
        if not own:  # built-in types cannot be changed, only extended
            hint = f"Make a type of your own: profile new my-type --extends {self.profile} -o {file}. {hint}"
        return MissingFieldError(
            f"{form} requires {field}, which the datasheet of node {self.uuid.hex()} lacks.", hint=hint
        )

    def identification(self, form: str, field: str, element: str) -> str:
        """Return an element of the nameplate; raises MissingFieldError if it is absent."""
        value = self.nameplate.get(element.lower(), "")
        if not value:
            raise self.missing(form, field, f"<{element}> in the xml of {IDENTIFICATION}")
        return value


def described_node(station: Station, uuid: bytes) -> DescribedNode:
    """Return the facts about a node from its last reading.

    Raises NotFoundError if no datasheet of it is known, NotAuthenticError or UnprovenError if its verdict is not
    authentic today.
    """
    image, verdict = station.datasheets.datasheet(uuid), verdict_of(station, uuid)
    if image is None or verdict is None:
        raise NotFoundError(
            f"No datasheet of node {uuid.hex()} is known here.", hint=f"Read it first: verify {uuid.hex()}"
        )
    require_authentic(verdict.verified)
    sheet = Sheet.from_image(image).shown_in(shown_units(station, uuid))
    record = station.nodes.get(uuid)
    name = (record.name if record else None) or sheet.meta.name
    return DescribedNode(
        uuid,
        name,
        (record.profile if record else None) or "",
        sheet,
        nameplate_of(image),
        hashlib.sha256(image.security or b"").hexdigest(),
    )


def nameplate_of(image: Image) -> dict[str, str]:
    """Return the leaf elements of an image's Meta-Identification TEDS by lower-case local name; empty if malformed.

    The texts of all languages are merged, the first one wins. Never raises: a datasheet without a readable nameplate
    lacks its fields.
    """
    octets = image.blocks.get((0, AccessCode.META_ID))
    if octets is None:
        return {}
    found: dict[str, str] = {}
    for text in decode(octets).text:
        try:
            root = parse(text)
        except BadDataError:
            continue
        for element in root.iter():
            if len(element) == 0 and (value := (element.text or "").strip()):
                found.setdefault(_local_name(element), value)
    return found


def _local_name(element: ET.Element) -> str:
    return str(element.tag).rpartition("}")[2].lower()
