"""A W3C Thing Description 1.1 of a node; its forms are the API of the base station (docs/contract/api.md).

Each sensor is a property that is read as the API's channel, each actuator an action whose input is the API's set point.
Limits and uncertainty are in SI units. Source: Web of Things Thing Description 1.1, W3C Recommendation 2023-12-05,
sections 5.3 (core vocabulary) and 5.3.3 (security).
"""

from __future__ import annotations

import math
import re
from typing import Any, Final

from teds_provision.api.operations import API
from teds_provision.describe.described_node import DescribedNode
from teds_provision.teds.channel import Channel

CONTEXT: Final = "https://www.w3.org/2022/wot/td/v1.1"
MEDIA_TYPE: Final = "application/td+json"
_SECURITY: Final = "token"


def thing_description(node: DescribedNode, base: str = "") -> dict[str, Any]:
    """Return the Thing Description of a node; raises MissingFieldError.

    ``base`` is the address of its base station (``https://bench:8443``), to which the forms are relative; "" leaves it
    out. No credential is in it: a client sends a token of the station (``ncap token add``).
    """
    if not node.name:
        raise node.missing("A Thing Description", "title", "name")
    uuid = node.uuid.hex()
    names = _names(node)
    sensors = [channel for channel in node.sheet.channels if not channel.actuator]
    actuators = [channel for channel in node.sheet.channels if channel.actuator]
    description: dict[str, Any] = {
        "@context": [CONTEXT, {"teds": "urn:iso:std:iso-iec-ieee:21450:"}],
        "id": f"urn:teds:{uuid}",
        "title": node.name,
        "description": f"Transducer node {uuid}; its datasheet is signed (SHA-256 of the Security TEDS: "
        f"{node.fingerprint}).",
        "securityDefinitions": {
            _SECURITY: {"scheme": "bearer", "format": "opaque", "in": "header", "name": "Authorization"}
        },
        "security": _SECURITY,
        "properties": {names[channel.number]: _property(uuid, channel) for channel in sensors},
        "actions": {f"set_{names[channel.number]}": _action(uuid, channel) for channel in actuators},
    }
    if base:
        description["base"] = base.rstrip("/") + "/"
    return {key: value for key, value in description.items() if value != {}}


def _names(node: DescribedNode) -> dict[int, str]:
    """Return a unique name of each channel, from the datasheet's: letters, digits and ``_``."""
    found: dict[int, str] = {}
    for channel in node.sheet.channels:
        own = re.sub(r"\W+", "_", channel.name.lower(), flags=re.ASCII).strip("_") or f"channel_{channel.number}"
        while own in found.values():  # channels "a", "a 3" and "a" with numbers 1, 2 and 3 need the number twice
            own = f"{own}_{channel.number}"
        found[channel.number] = own
    return found


def _property(uuid: str, channel: Channel) -> dict[str, Any]:
    value = {**_number(channel), "type": ["number", "null"], "description": "null if the last value is invalid"}
    last = {"type": ["object", "null"], "properties": {"value": value, "time": {"type": "number", "unit": "s"}}}
    return {
        "title": channel.name or f"Channel {channel.number}",
        "teds:channel": channel.number,
        "type": "object",
        "readOnly": True,
        "properties": {"last": _untyped(last)},
        "unit": channel.si_unit,
        "forms": [_form(uuid, channel, "readproperty", "GET")],
    }


def _action(uuid: str, channel: Channel) -> dict[str, Any]:
    hold = {"type": "number", "minimum": 0, "unit": "s", "description": "held for so long; 0 releases it"}
    return {
        "title": f"Set {channel.name or f'channel {channel.number}'}",
        "description": "The node brings the actuator to its safe state unless the set point is repeated.",
        "teds:channel": channel.number,
        "input": {"type": "object", "properties": {"value": {"type": "number", **_number(channel)}, "hold": hold}},
        "safe": False,
        "idempotent": True,
        "forms": [_form(uuid, channel, "invokeaction", "PUT")],
    }


def _form(uuid: str, channel: Channel, operation: str, method: str) -> dict[str, Any]:
    return {
        "href": f"{API.lstrip('/')}/nodes/{uuid}/channels/{channel.number}",
        "contentType": "application/json",
        "op": [operation],
        "htv:methodName": method,
    }


def _number(channel: Channel) -> dict[str, Any]:
    limits = {"minimum": channel.low, "maximum": channel.high}
    uncertainty = channel.stated_uncertainty
    stated = {"teds:uncertainty": uncertainty} if math.isfinite(uncertainty) else {}
    return {
        "unit": channel.si_unit,
        **{key: value for key, value in limits.items() if math.isfinite(value)},
        **stated,
    }


def _untyped(schema: dict[str, Any]) -> dict[str, Any]:
    """Return a schema in which a type that may be null is a choice: a TD has one type for each data schema."""
    kinds = schema.get("type")
    inner = {
        key: {name: _untyped(part) for name, part in value.items()} if key == "properties" else value
        for key, value in schema.items()
        if key != "type"
    }
    if isinstance(kinds, list):
        described = {key: value for key, value in inner.items() if key in {"description"}}
        rest = {key: value for key, value in inner.items() if key not in described}
        return {**described, "oneOf": [{"type": kinds[0], **rest}, {"type": "null"}]}
    return {"type": kinds, **inner} if kinds else inner
