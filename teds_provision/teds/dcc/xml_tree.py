"""XML of a certificate: parsed without DTD, entities or network, bounded in size, and walked by name.

A certificate comes from a stranger. Whatever its octets, the result is a tree or a BadDataError with file and line.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Final, Protocol

from teds_provision.errors import BadDataError, UsageError
from teds_provision.lazy import how_to_install
from teds_provision.limits import LIMITS, check_size, check_xml

DCC: Final = "https://ptb.de/dcc"
SI: Final = "https://ptb.de/si"
SIGNATURES: Final = "http://www.w3.org/2000/09/xmldsig#"
NAMESPACES: Final = {"dcc": DCC, "si": SI, "ds": SIGNATURES}
ROOT: Final = f"{{{DCC}}}digitalCalibrationCertificate"
_ENCODING: Final = re.compile(rb"\s*<\?xml[^>]{0,200}?\bencoding\s*=\s*[\"']([A-Za-z0-9._-]{1,40})[\"']")
_ENCODINGS: Final = frozenset({b"utf-8", b"us-ascii", b"ascii", b"iso-8859-1", b"iso-8859-15", b"windows-1252"})
"""Those in which ``<!DOCTYPE`` is written in the octets of ASCII."""
_SHOWN: Final = 60


class XmlElement(Protocol):
    """The part of lxml's elements that is used here."""

    tag: str
    text: str | None
    sourceline: int | None

    def get(self, key: str) -> str | None:
        """Return the value of an attribute."""

    def __iter__(self) -> Iterator[XmlElement]: ...
    def __len__(self) -> int: ...


def require_bench(package: str) -> None:
    """Raise UsageError with the command that installs it if a package of the extra ``bench`` is missing."""
    if find_spec(package) is None:
        raise UsageError(f"Reading a calibration certificate needs {package}.", hint=how_to_install("bench"))


def parse_xml(octets: bytes, file: str) -> XmlElement:
    """Return the root of a certificate; raises BadDataError for what is no XML or is refused.

    Refused are a DTD, entities, an encoding that is no superset of ASCII, and more octets, tags, attributes or levels
    than ``limits`` allows. Nothing is fetched.
    """
    require_bench("lxml")
    from lxml import etree

    check_size(len(octets), LIMITS.certificate, f"the certificate {file}")
    encoding = _ENCODING.match(octets.removeprefix(b"\xef\xbb\xbf"))
    if b"\x00" in octets or (encoding is not None and encoding[1].lower() not in _ENCODINGS):
        raise BadDataError(f"{file}:1: a certificate is XML in UTF-8.")
    if b"<!DOCTYPE" in octets or b"<!ENTITY" in octets:
        raise BadDataError(f"{file}:1: the XML holds a DTD or an entity, which is refused.")
    check_xml(octets, file)
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        dtd_validation=False,
        huge_tree=False,
        remove_comments=True,
        remove_pis=True,
    )
    try:
        root: XmlElement = etree.fromstring(octets, parser)
    except etree.XMLSyntaxError as error:
        line = error.lineno or 1
        raise BadDataError(f"{file}:{line}: this is not XML: {str(error.msg)[:200]}.") from error
    except (ValueError, LookupError) as error:
        raise BadDataError(f"{file}:1: this is not XML: {str(error)[:200]}.") from error
    _check_depth(root, file)
    return root


def _check_depth(root: XmlElement, file: str) -> None:
    level = [root]
    for _ in range(LIMITS.xml_depth):
        level = [child for element in level for child in element]
        if not level:
            return
    raise BadDataError(f"{file}: the XML nests deeper than {LIMITS.xml_depth} levels.")


def qualified(name: str) -> str:
    """Return the name that lxml gives to ``dcc:result``."""
    prefix, _, local = name.partition(":")
    return f"{{{NAMESPACES[prefix]}}}{local}"


@dataclass(frozen=True)
class Node:
    """An element of a certificate, and the file that errors name."""

    element: XmlElement
    file: str

    @property
    def name(self) -> str:
        """Local name of the element."""
        return self.element.tag.rpartition("}")[2]

    @property
    def line(self) -> int:
        """Line of the file."""
        return self.element.sourceline or 1

    @property
    def id(self) -> str:
        """Attribute ``id``, "" if it has none."""
        return (self.element.get("id") or "").strip()

    @property
    def ref_types(self) -> tuple[str, ...]:
        """Words of the attribute ``refType``."""
        return tuple((self.element.get("refType") or "").split())

    def children_named(self, *names: str) -> list[Node]:
        """Return the children of these names, in the order of the document."""
        wanted = {qualified(name) for name in names}
        return [Node(child, self.file) for child in self.element if child.tag in wanted]

    def optional_child(self, name: str) -> Node | None:
        """Return the one child of this name, None without one; raises BadDataError if there are several."""
        found = self.children_named(name)
        if len(found) > 1:
            raise found[1].wrong("it appears twice.")
        return found[0] if found else None

    def child(self, name: str) -> Node:
        """Return the one child of this name; raises BadDataError without it, or if there are several."""
        found = self.optional_child(name)
        if found is None:
            raise self.wrong(f"{name.partition(':')[2]} is missing.")
        return found

    def all_of(self, path: str) -> list[Node]:
        """Return the elements at the end of a path of names; every step may have many."""
        level = [self]
        for name in path.split("/"):
            level = [child for node in level for child in node.children_named(name)]
        return level

    @property
    def text(self) -> str:
        """Text of the element, runs of white space as one space; of an element with children "" ."""
        return "" if len(self.element) else " ".join((self.element.text or "").split())

    def required_text(self) -> str:
        """Return the text; raises BadDataError if it is empty."""
        if not self.text:
            raise self.wrong("it is empty.")
        return self.text

    def wrong(self, message: str) -> BadDataError:
        """Return the error for this element."""
        return BadDataError(f"{self.file}:{self.line}: {self.name[:_SHOWN]}: {message}")
