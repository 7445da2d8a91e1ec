"""Request bodies: each class is the body of one operation, in the order of ``operations``.

A member that may be left out may be null too. Conditions that depend on the station's state (does the node exist, may
this name be taken) are not here: they have separate error codes.
"""

from __future__ import annotations

from dataclasses import dataclass, field, make_dataclass
from typing import Annotated, Any, ClassVar, Final, Literal, get_args

from teds_provision.shapes.measurement import HINTS, PUBLISHED
from teds_provision.shapes.metadata import Meta

LONGEST_HOLD: Final = 60.0
"""Seconds for which one request holds an actuator, at most."""
_LARGEST: Final = 1e300

Mode = Literal["transparent", "whitelist"]
ProfileName = Annotated[
    str,
    Meta(
        pattern=r"^(?!.*\.toml$)[a-z0-9][a-z0-9._-]{0,63}$",
        description="a name that GET /profiles lists, never a path",
    ),
]


@dataclass(frozen=True)
class Detection:
    """PUT /detection."""

    mode: Mode


@dataclass(frozen=True)
class Nothing:
    """POST /discover."""


@dataclass(frozen=True)
class Locate:
    """POST /nodes/{uuid}/locate."""

    seconds: Annotated[int, Meta(minimum=0, maximum=60, description="for how long it blinks; 0 stops it")]


@dataclass(frozen=True)
class SheetText:
    """PUT /nodes/{uuid}/teds."""

    content: Annotated[str, Meta(description="XML, JSON or hex")]
    format: Annotated[str, Meta(description="ignored: the content shows what it is")] | None = None
    accept_calibration: Annotated[str, Meta(description="why a calibration that the guard refuses is right")] | None = (
        None
    )
    retype: Annotated[bool, Meta(description="whether the board may become one of another type")] | None = None


@dataclass(frozen=True)
class Order:
    """POST /nodes/{uuid}/provision."""

    profile: ProfileName | None = None
    name: str | None = None
    calibration: (
        Annotated[str, Meta(description="the content of a calibration file, or of a certificate (DCC) in UTF-8")] | None
    ) = None
    calibration_name: Annotated[str, Meta(description="the name of that file, .xml for a certificate")] | None = None
    calibration_channel: (
        Annotated[int, Meta(minimum=1, maximum=255, description="the only channel that it is for")] | None
    ) = None
    calibration_item: Annotated[str, Meta(description="the result of the certificate to use")] | None = None
    adopt: (
        Annotated[bool, Meta(description="sign the datasheet that the board brought, in place of a profile")] | None
    ) = None
    accept_calibration: (
        Annotated[str, Meta(description="why a datasheet with findings of severity error is right")] | None
    ) = None
    cancel: Annotated[bool, Meta(description="stop waiting for a tap")] | None = None


@dataclass(frozen=True)
class SetPoint:
    """PUT /nodes/{uuid}/channels/{number}."""

    value: Annotated[float, Meta(minimum=-_LARGEST, maximum=_LARGEST)] | None = None
    unit: Annotated[str, Meta(description="of the value; else the SI unit of the datasheet")] | None = None
    hold: Annotated[float, Meta(minimum=0, maximum=LONGEST_HOLD, description="seconds; 0 lets go")] | None = None

    RULE: ClassVar = Meta(
        anyOf=[
            {"required": ["value"], "properties": {"value": {"type": "number"}}},
            {"required": ["hold"], "properties": {"hold": {"type": "number", "maximum": 0}}},
        ],
        description='Send {"value": …} to set the actuator, or {"hold": 0} to let it go.',
    )


@dataclass(frozen=True)
class NewGroup:
    """POST /groups."""

    name: str
    uuids: list[str] | None = None


@dataclass(frozen=True)
class GroupMembers:
    """PUT /groups/{name}."""

    uuids: list[str]


def _body_member(name: str) -> tuple[str, Any, Any]:
    """Return a setting of a measurement as a member of its body: what may be left out may be null, but for a list."""
    hint = HINTS[name]
    if name == "uuids":
        return name, hint, field(default_factory=list)
    whole = get_args(hint)[0]
    return name, hint if type(None) in get_args(whole) else hint | None, field(default=None)


NewMeasurement: Final[Any] = make_dataclass(
    "NewMeasurement",
    [_body_member(name) for name in PUBLISHED],
    frozen=True,
    namespace={
        "__doc__": "POST /measurements.",
        "__module__": __name__,
        "RULE": Meta(
            oneOf=[
                {"required": ["group"], "properties": {"group": {"type": "string"}}},
                {"required": ["uuids"], "properties": {"uuids": {"type": "array", "minItems": 1}}},
                {"required": ["match"], "properties": {"match": {"type": "string"}}},
            ],
            description='A measurement needs one of "group", "uuids" and "match".',
        ),
    },
)
"""POST /measurements: the settings of a measurement (shapes/measurement.py)."""


@dataclass(frozen=True)
class NewName:
    """PUT /names; a row of GET /names may be sent back as it is."""

    uuid: str
    channel: Annotated[int, Meta(minimum=0, maximum=255, description="0: the node itself")] | None = None
    name: Annotated[str, Meta(description="null restores the default")] | None = None
    topic: Annotated[str, Meta(description="ignored")] | None = None


@dataclass(frozen=True)
class NewVirtual:
    """POST /virtual."""

    name: str | None = None
    source: (
        Annotated[str, Meta(description="noise (default), sine:S, ramp:S, simulation, file:/P or unix:/P")] | None
    ) = None
    content: Annotated[str, Meta(description="a datasheet in XML or JSON")] | None = None
    format: Annotated[str, Meta(description="ignored: the content shows what it is")] | None = None
    profile: ProfileName | None = None
    new_uuid: Annotated[bool, Meta(description="give it another UUID than its datasheet has")] | None = None

    RULE: ClassVar = Meta(
        oneOf=[
            {"required": ["content"], "properties": {"content": {"type": "string"}}},
            {"required": ["profile"], "properties": {"profile": {"type": "string"}}},
        ],
        description='A virtual transducer needs either "content" or "profile".',
    )


@dataclass(frozen=True)
class LoginLink:
    """POST /login-link."""

    read_only: bool | None = None
