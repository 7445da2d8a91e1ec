"""A job for a line: what may be built, of what, how often, by whom and until when (contract/plant.md section 9).

Signed by a keeper. The owner of a home could ignore a job; only an office that signs can enforce it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final, Literal

from teds_provision.errors import BadDataError
from teds_provision.protocol.handover.strict_json import time_text
from teds_provision.protocol.keys import PrivateKey, fingerprint
from teds_provision.protocol.plant.document import (
    JOB,
    Fields,
    is_form,
    is_name,
    is_number,
    open_document,
    sign_document,
)

MOST_BOARDS: Final = 32_768
MOST_STATIONS: Final = 256
MOST_READ_ONLY: Final = 2_000
ASSURANCES: Final = ("uuid", "bus", "tap")
WORTH: Final[Mapping[str, int]] = {"uuid": 0, "import": 0, "registry": 0, "bus": 1, "tap": 2}
"""How well a key was seen to belong to its board; a greater number is worth more."""
BY_STATION: Final = "station"
"""The ``sign`` of a job whose stations sign themselves."""
_FIELD: Final = re.compile(r"\{(unit(?::0[1-9])?|uuid8?)\}")

Rule = Literal["none", "one", "list", "any"]


@dataclass(frozen=True)
class CalibrationRule:
    """The rule for a board's calibration, by SHA-256 of its file.

    ``none``: no calibration; ``one``: this one for all; ``list``: by board; ``any``: whichever is at most so many days
    old.
    """

    rule: Rule = "none"
    sha256: str | None = None
    by_uuid: Mapping[bytes, str] = field(default_factory=dict)
    max_age_days: int | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the member ``calibration``."""
        if self.rule == "one":
            return {"rule": "one", "sha256": self.sha256}
        if self.rule == "list":
            return {"rule": "list", "by_uuid": {uuid.hex(): digest for uuid, digest in self.by_uuid.items()}}
        if self.rule == "any":
            return {"rule": "any", "max_age_days": self.max_age_days}
        return {"rule": "none"}

    def wants(self, uuid: bytes) -> str | None:
        """Return the digest that the calibration of a board must have, None if any will do, or none is meant."""
        return self.by_uuid.get(uuid) if self.rule == "list" else self.sha256


@dataclass(frozen=True)
class Job:
    """One job; ``hash`` and ``signer`` are "" until it is signed.

    ``count`` or ``boards`` (UUID to fingerprint) limits the units. ``stations`` are fingerprints with their allotments.
    ``sign`` is :data:`BY_STATION` or the fingerprint of the office.
    """

    id: str
    registry: str
    title: str
    profile: str
    profile_sha256: str
    calibration: CalibrationRule
    count: int | None
    boards: Mapping[bytes, str]
    not_before: datetime
    ends: datetime
    stations: Mapping[str, int]
    assurance: str
    sign: str = BY_STATION
    evidence: bool = True
    read_only: tuple[tuple[int, int], ...] = ()
    name: str | None = None
    hash: str = ""
    signer: str = ""
    octets: bytes = field(default=b"", repr=False)

    @property
    def total(self) -> int:
        """How many boards it is for."""
        return self.count if self.count is not None else len(self.boards)

    @property
    def office(self) -> str | None:
        """Fingerprint of the office that signs, None if each station does."""
        return None if self.sign == BY_STATION else self.sign

    def why_not(self, now: datetime, station: str) -> str | None:
        """Return why ``station`` (fingerprint) may not work on it now, None if it may."""
        if now < self.not_before:
            return f"it begins {time_text(self.not_before)}"
        if now >= self.ends:
            return f"it ended {time_text(self.ends)}"
        if station not in self.stations:
            return f"it is not for this station ({station[:16]})"
        return None

    def name_for(self, uuid: bytes, unit: int) -> str | None:
        """Return the name of the board that got this unit, None if the job gives none."""
        if self.name is None:
            return None

        def value(found: re.Match[str]) -> str:
            word = found[1]
            if word.startswith("unit"):
                return f"{unit:0{int(word[-1])}d}" if ":" in word else str(unit)
            return uuid.hex()[:8] if word == "uuid8" else uuid.hex()

        return _FIELD.sub(value, self.name)

    def unsigned(self) -> dict[str, Any]:
        """Return what a keeper signs, in the order of the contract."""
        listed = [{"uuid": uuid.hex(), "fingerprint": key} for uuid, key in self.boards.items()]
        return {
            "format": JOB.format,
            "id": self.id,
            "registry": self.registry,
            "title": self.title,
            "profile": self.profile,
            "profile_sha256": self.profile_sha256,
            "calibration": self.calibration.to_json(),
            "nodes": {"count": self.count} if self.count is not None else {"list": listed},
            "not_before": time_text(self.not_before),
            "ends": time_text(self.ends),
            "stations": dict(self.stations),
            "assurance": self.assurance,
            "sign": self.sign,
            "evidence": self.evidence,
            "read_only": [list(block) for block in self.read_only],
            "name": self.name,
        }


def seal_job(job: Job, key: PrivateKey) -> bytes:
    """Sign a job; what no reader would take raises BadDataError."""
    octets = sign_document(job.unsigned(), key, JOB)
    open_job(octets, lambda kid: key.point if kid == fingerprint(key.point) else None)
    return octets


def open_job(octets: bytes, find_key: Callable[[str], bytes | None]) -> Job:
    """Read a job; ``find_key`` gives the point of a keeper.

    Raises NotAuthenticError, BadDataError, NewerFormatError.
    """
    document = open_document(octets.strip(), find_key, JOB)
    fields = Fields(document.members, "The job")
    count, boards = _nodes(fields)
    name = fields.members.get("name")
    job = Job(
        fields.text_of_form("random_id", "id"),
        fields.text_of_form("random_id", "registry"),
        fields.name("title"),
        fields.name("profile"),
        fields.text_of_form("sha256", "profile_sha256"),
        _calibration(fields),
        count,
        boards,
        fields.time("not_before"),
        fields.time("ends"),
        _stations(fields),
        fields.one_of("assurance", ASSURANCES),
        _sign(fields),
        fields.flag("evidence"),
        tuple(_block(fields, block) for block in fields.list_of("read_only", MOST_READ_ONLY)),
        None if name is None else _pattern(fields),
        document.hash,
        document.signer,
        document.octets,
    )
    if job.not_before >= job.ends:
        raise fields.bad("ends", "is not after not_before")
    if job.count is not None and sum(job.stations.values()) > job.count:
        raise fields.bad("stations", f"have allotments of more than the {job.count} boards of the job")
    return job


def _nodes(fields: Fields) -> tuple[int | None, dict[bytes, str]]:
    nodes = Fields(fields.members.get("nodes"), "The nodes of the job")
    if ("count" in nodes.members) == ("list" in nodes.members):
        raise fields.bad("nodes", "is not one of count and list")
    if "count" in nodes.members:
        return nodes.number("count", 1), {}
    boards: dict[bytes, str] = {}
    listed = nodes.list_of("list", MOST_BOARDS)
    for item in listed:
        board = Fields(item, "A board of the job")
        boards[bytes.fromhex(board.text_of_form("uuid", "uuid"))] = board.text_of_form("sha256", "fingerprint")
    if len(boards) != len(listed) or not boards:
        raise fields.bad("nodes", "lists no board, or one twice")
    return None, boards


def _calibration(fields: Fields) -> CalibrationRule:
    calibration = Fields(fields.members.get("calibration"), "The calibration of the job")
    rule = calibration.one_of("rule", ("none", "one", "list", "any"))
    if rule == "one":
        return CalibrationRule("one", calibration.text_of_form("sha256", "sha256"))
    if rule == "any":
        return CalibrationRule("any", max_age_days=calibration.number("max_age_days", 1))
    if rule == "list":
        by_uuid = calibration.members.get("by_uuid")
        if not isinstance(by_uuid, dict) or not 1 <= len(by_uuid) <= MOST_BOARDS:
            raise calibration.bad("by_uuid", f"is no object of 1 to {MOST_BOARDS} boards")
        if not all(is_form("uuid", uuid) and is_form("sha256", digest) for uuid, digest in by_uuid.items()):
            raise calibration.bad("by_uuid", "does not give each UUID a SHA-256")
        return CalibrationRule("list", by_uuid={bytes.fromhex(uuid): digest for uuid, digest in by_uuid.items()})
    return CalibrationRule()


def _stations(fields: Fields) -> dict[str, int]:
    stations = fields.members.get("stations")
    if not isinstance(stations, dict) or not 1 <= len(stations) <= MOST_STATIONS:
        raise fields.bad("stations", f"is no object of 1 to {MOST_STATIONS} stations")
    if not all(is_form("sha256", key) and is_number(number) for key, number in stations.items()):
        raise fields.bad("stations", "does not give each fingerprint an allotment")
    return dict(stations)


def _sign(fields: Fields) -> str:
    sign = fields.members.get("sign")
    return BY_STATION if sign == BY_STATION else fields.text_of_form("sha256", "sign")


def _block(fields: Fields, value: object) -> tuple[int, int]:
    match value:
        case [int(channel), int(code)] if 0 <= channel <= 0xFFFF and 0 <= code <= 0xFF:
            return channel, code
    raise fields.bad("read_only", "is no list of [channel, access code]")


def _pattern(fields: Fields) -> str:
    pattern = fields.name("name")
    require_pattern(pattern)
    return pattern


def require_pattern(pattern: str) -> None:
    """Raise BadDataError for a pattern of names with other fields than {unit}, {unit:03}, {uuid} and {uuid8}."""
    rest = _FIELD.sub("", pattern)
    if "{" in rest or "}" in rest or not is_name(pattern):
        raise BadDataError(
            f"The pattern of names {pattern!r} holds something else than {{unit}}, {{unit:03}}, {{uuid}}, {{uuid8}}."
        )
