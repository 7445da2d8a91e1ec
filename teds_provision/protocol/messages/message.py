"""Messages between NCAP and TIM (2007) and between application and NCAP (2024): octets to names, and back.

:func:`decode_message` never raises, whatever the octets; ``findings`` lists what is wrong or guessed. Of the two
payload schools of the 2007 commands both are read, only plain concatenation is written (formats.md, "Messages").
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from teds_provision.errors import BadDataError
from teds_provision.protocol.messages.arguments import (
    Argument,
    Blocks,
    MessageValue,
    read_plain,
    read_tagged,
    write_plain,
)
from teds_provision.protocol.messages.tables import (
    CLASSES,
    COMMANDS,
    MESSAGE_TYPES,
    NETWORK,
    REASONS,
    SEGMENT,
    SERVICES,
    STATUS,
    Spec,
)
from teds_provision.teds.codec.model import Edition, Finding

__all__ = ["Argument", "Message", "compose_command", "compose_service", "decode_message", "looks_like_message"]

Kind = Literal["command", "reply", "network-service", "unknown"]
School = Literal["concatenated", "tagged"]

COMMAND_HEADER, REPLY_HEADER, NETWORK_HEADER = 6, 3, 5


@dataclass(frozen=True)
class Message:
    """A decoded message.

    ``group`` and ``function`` are the numbers of command class and function (2007) or of service type and service
    (2024), None in a 2007 reply, which does not carry them; ``message_type`` is that of 2024; ``ok`` the success flag
    of a reply. ``teds`` holds the offset and octets of each whole TEDS inside.
    """

    octets: bytes
    kind: Kind
    edition: Edition
    name: str
    arguments: tuple[Argument, ...] = ()
    findings: tuple[Finding, ...] = ()
    group: int | None = None
    group_name: str = ""
    function: int | None = None
    message_type: int | None = None
    channel: int | None = None
    ok: bool | None = None
    school: School = "concatenated"
    teds: tuple[tuple[int, bytes], ...] = ()

    def get(self, name: str) -> MessageValue | Blocks | None:
        """Return the value of the argument of that name, None if it is absent."""
        return next((argument.value for argument in self.arguments if argument.name == name), None)


def looks_like_message(octets: bytes) -> bool:
    """Return True if header, length and codes fit a known command, reply or network service; never for a TEDS."""
    return _sniff(octets) != "unknown"


def decode_message(octets: bytes, *, request: Message | None = None) -> Message:
    """Decode any octets as a message; a 2007 reply is decoded by its ``request`` if given."""
    if request is not None and request.kind == "command":
        return _reply(octets, request)
    kind = _sniff(octets, lenient=True)
    if kind == "network-service":
        return _network(octets)
    if kind == "command":
        return _command(octets)
    if kind == "reply":
        return _reply(octets, None)
    message = "These octets fit no command, reply or network service."
    return Message(octets, "unknown", 2007, "", findings=(Finding("error", "not-a-message", message, 0),))


def compose_command(
    channel: int, group: int, function: int, arguments: Mapping[str, MessageValue | Blocks] | None = None
) -> bytes:
    """Write a 2007 command frame by argument names (see :data:`.tables.COMMANDS`); raises BadDataError."""
    spec = COMMANDS.get((group, function))
    if spec is None:
        raise BadDataError(f"There is no command {group}.{function}.")
    if not 0 <= channel <= 0xFFFF:
        raise BadDataError(f"A channel is a number from 0 to 65535, not {channel}.")
    asked = spec.answer is not None and not arguments
    payload = b"" if asked else write_plain(spec.arguments, arguments or {}, of=spec.name)
    head = channel.to_bytes(2, "big") + bytes([group, function])
    return head + _u16(len(payload), spec.name) + payload


def compose_service(
    service: int, number: int, message_type: int, arguments: Mapping[str, MessageValue | Blocks]
) -> bytes:
    """Write a 2024 network-service message by argument names (see :data:`.tables.NETWORK`); raises BadDataError."""
    spec = NETWORK.get((service, number))
    if spec is None or message_type not in MESSAGE_TYPES:
        raise BadDataError(f"There is no network service {service}.{number} with message type {message_type}.")
    body = write_plain(_service_layout(spec, message_type), arguments, of=spec.name)
    return bytes([service, number, message_type]) + _u16(len(body), spec.name) + body


def _u16(length: int, name: str) -> bytes:
    if length > 0xFFFF:
        raise BadDataError(f"{name} would carry {length} octets; a message carries at most 65535.")
    return length.to_bytes(2, "big")


def _sniff(octets: bytes, *, lenient: bool = False) -> Kind:
    """Return the kind by header; ``lenient`` counts unknown functions of the standard's classes as commands, too."""
    if _is_network(octets):
        return "network-service"
    if _is_command(octets, lenient=lenient):
        return "command"
    if len(octets) >= REPLY_HEADER and octets[0] <= 1:
        return "reply" if int.from_bytes(octets[1:3], "big") == len(octets) - REPLY_HEADER else "unknown"
    return "unknown"


def _is_network(octets: bytes) -> bool:
    if len(octets) < NETWORK_HEADER or octets[0] not in SERVICES or octets[2] not in MESSAGE_TYPES or not octets[1]:
        return False
    known = (octets[0], octets[1]) in NETWORK or octets[0] in {5, 9}
    body = len(octets) - NETWORK_HEADER
    return known and int.from_bytes(octets[3:5], "big") in {body, body - 1}


def _is_command(octets: bytes, *, lenient: bool) -> bool:
    if len(octets) < COMMAND_HEADER or int.from_bytes(octets[4:6], "big") != len(octets) - COMMAND_HEADER:
        return False
    group, function = octets[2], octets[3]
    if (group, function) in COMMANDS:
        return True
    return function != 0 and (group >= 128 or (lenient and group in CLASSES))


def _network(octets: bytes) -> Message:
    service, number, message_type = octets[:3]
    spec = NETWORK.get((service, number), Spec(f"Service {number}", "octets:octets", "octets:octets"))
    length, body = int.from_bytes(octets[3:5], "big"), octets[NETWORK_HEADER:]
    arguments, findings = read_plain(body, _service_layout(spec, message_type), NETWORK_HEADER)
    if length != len(body):
        text = f"The length says {length} octets, {len(body)} follow; one known NCAP counts one too few."
        findings.insert(0, Finding("warning", "message-length", text, 3, "length", str(len(body)), str(length)))
    error = _number(arguments, "error")
    return Message(
        octets,
        "network-service",
        2024,
        f"{spec.name}, {MESSAGE_TYPES[message_type]}",
        tuple(arguments),
        tuple(findings),
        service,
        SERVICES[service],
        number,
        message_type,
        _number(arguments, "channel"),
        None if error is None else error == 0,
        teds=_embedded(arguments),
    )


def _service_layout(spec: Spec, message_type: int) -> str:
    return spec.reply if message_type == 2 and spec.reply is not None else spec.arguments


def _command(octets: bytes) -> Message:
    channel, group, function = int.from_bytes(octets[:2], "big"), octets[2], octets[3]
    findings: list[Finding] = []
    spec = COMMANDS.get((group, function))
    if spec is None:
        spec = Spec(f"Function {function}", "octets:octets")
        own = group >= 128 or function >= 128
        text = f"Function {group}.{function} is {'a maker’s own' if own else 'reserved'}."
        findings.append(Finding("note" if own else "error", "unknown-function", text, 3))
    payload = octets[COMMAND_HEADER:]
    layout = "" if spec.answer is not None and not payload else spec.arguments
    tagged = read_tagged(payload, layout, COMMAND_HEADER)
    if tagged is None:
        arguments, more = read_plain(payload, layout, COMMAND_HEADER)
    else:
        text = "The arguments are tagged with type and length; the standard's tables put them one after the other."
        arguments, more = tagged, [Finding("note", "tagged-arguments", text, COMMAND_HEADER)]
    return Message(
        octets,
        "command",
        2007,
        spec.name,
        tuple(arguments),
        (*findings, *more),
        group,
        CLASSES.get(group, "manufacturer"),
        function,
        channel=channel,
        school="concatenated" if tagged is None else "tagged",
        teds=_embedded(arguments),
    )


def _reply(octets: bytes, request: Message | None) -> Message:
    payload = octets[REPLY_HEADER:]
    findings = _reply_length(octets)
    ok = octets[:1] not in {b"", b"\0"}
    layout, name, guessed = _reply_layout(ok, payload, request)
    if guessed and payload:
        text = "A reply does not say what it answers; it is read as what its form fits."
        findings.append(Finding("note", "reply-guessed", text, REPLY_HEADER))
    tagged = read_tagged(payload, layout, REPLY_HEADER) if request is not None and request.school == "tagged" else None
    arguments, more = (tagged, []) if tagged is not None else read_plain(payload, layout, REPLY_HEADER)
    asked = request or Message(b"", "unknown", 2007, "")  # an unknown request
    return Message(
        octets,
        "reply",
        2007,
        name,
        tuple(map(_with_reason, arguments)),
        (*findings, *more),
        asked.group,
        asked.group_name,
        asked.function,
        channel=asked.channel,
        ok=ok,
        school="tagged" if tagged is not None else "concatenated",
        teds=_embedded(arguments),
    )


def _reply_length(octets: bytes) -> list[Finding]:
    length, carried = int.from_bytes(octets[1:3], "big"), max(0, len(octets) - REPLY_HEADER)
    if len(octets) >= REPLY_HEADER and length == carried:
        return []
    text = f"The reply announces {length} octets and carries {carried}."
    return [Finding("error", "message-length", text, min(1, len(octets)), "length")]


def _reply_layout(ok: bool, payload: bytes, request: Message | None) -> tuple[str, str, bool]:
    """Return layout and name, and whether they are guessed from the form."""
    if not ok and len(payload) == 1:
        return "reason:u8", "Refusal", request is None
    if request is not None and request.group is not None and request.function is not None:
        spec = COMMANDS.get((request.group, request.function), Spec(request.name, reply="octets:octets"))
        # A failure has a payload of the reply's form, or none.
        form = spec.reply if spec.answer is None or request.arguments else spec.answer
        layout = (form or "") if ok or len(payload) in {4, 12} else "octets:octets"
        return layout, f"Reply to {spec.name}" if ok else f"Failure of {spec.name}", False
    return (*_layout_guessed(ok, payload), True)


def _layout_guessed(ok: bool, payload: bytes) -> tuple[str, str]:
    """Guess layout and name from the octets alone."""
    if len(payload) == 12 and int.from_bytes(payload[2:6], "big") <= int.from_bytes(payload[8:12], "big"):
        return STATUS, "Reply to Query or Update TEDS"
    if len(payload) >= 4:
        whole = payload[:4] == bytes(4) and _is_whole_teds(payload[4:])
        name = "Reply to Read TEDS segment" if whole else "Reply with a segment of a TEDS or data set"
        return SEGMENT, name if ok else "Failure with a segment"
    return "octets:octets" if payload else "", "Success" if ok else "Failure"


def _with_reason(argument: Argument) -> Argument:
    if argument.name != "reason" or not isinstance(argument.value, int):
        return argument
    meaning = REASONS.get(argument.value, "unknown reason")
    return Argument(argument.name, argument.type, argument.value, argument.raw, argument.offset, meaning)


def _is_whole_teds(octets: bytes) -> bool:
    return len(octets) >= 12 and int.from_bytes(octets[:4], "big") == len(octets) - 4 and octets[4] == 3


def _embedded(arguments: list[Argument]) -> tuple[tuple[int, bytes], ...]:
    return tuple(
        (argument.offset, argument.raw)
        for argument in arguments
        if argument.type in {"teds", "octets"} and _is_whole_teds(argument.raw)
    )


def _number(arguments: list[Argument], name: str) -> int | None:
    value = next((argument.value for argument in arguments if argument.name == name), None)
    return value if isinstance(value, int) else None
