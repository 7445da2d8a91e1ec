"""A node as this station's store knows it: ``nodes --json``, and what the API's node has besides its link.

One more member is a field of :class:`KnownNode` and its value in ``provisioning/inventory.py``. If the API has it, it
has a :class:`Meta`, and its name is repeated in ``Node`` of ``api/answers.py``, for type checkers: the answer, its
description and ``client`` have it then. ``tests/shapes/test_node.py`` holds them together.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import Annotated, Any, Final, NamedTuple, get_origin, get_type_hints

from teds_provision.shapes.metadata import Meta
from teds_provision.shapes.verdict import VerdictWord


class KnownNode(NamedTuple):  # a tuple: lists hold a hundred thousand of them, and a dataclass took 6 us more to make
    """One node, each member as JSON has it; None and empty for what is not known.

    ``verdict`` is judged by today's trust from the row that ``reading`` is about. ``channels`` counts them; ``due`` is
    the first day (ISO 8601) on which a calibration ends, ``rotation_due`` the reason for a new link key.
    """

    uuid: Annotated[str, Meta()]
    name: Annotated[str | None, Meta()] = None
    profile: Annotated[str | None, Meta()] = None
    state: Annotated[str | None, Meta()] = None
    epoch: Annotated[int, Meta()] = 0
    sequence: Annotated[int, Meta()] = 0
    fingerprint: Annotated[str | None, Meta()] = None
    whitelisted: Annotated[bool, Meta()] = False
    assurance: str | None = None
    verdict: VerdictWord | None = None
    retired: Annotated[str | None, Meta()] = None
    reading: dict[str, str] | None = None
    last_seen: Annotated[str | None, Meta()] = None
    due: Annotated[str | None, Meta()] = None
    charging: dict[str, Any] | None = None
    channels: int = 0
    can_address: int = 0
    group: Annotated[str | None, Meta()] = None
    groups: Annotated[Sequence[str], Meta()] = ()
    teds_sha256: str | None = None
    keys: Sequence[dict[str, Any]] = ()
    rotation_due: str | None = None
    moved_to: dict[str, str] | None = None
    holders: Sequence[dict[str, str]] = ()
    wrapped: Annotated[dict[str, Any] | None, Meta()] = None
    revoked: dict[str, str] | None = None
    firmware: Annotated[dict[str, Any] | None, Meta()] = None

    def to_json(self) -> dict[str, Any]:
        """Return the node as ``nodes --json`` has it."""
        return self._asdict()

    def published(self) -> dict[str, Any]:
        """Return the members that the API's node takes from the store."""
        return dict(zip(PUBLISHED, _published(self), strict=True))


HINTS: Final = get_type_hints(KnownNode, include_extras=True)
PUBLISHED: Final = tuple(name for name in KnownNode._fields if get_origin(HINTS[name]) is Annotated)
"""The fields that the API has too."""
_published: Final = itemgetter(*map(KnownNode._fields.index, PUBLISHED))
