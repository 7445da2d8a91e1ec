"""Commands and replies in words, for people who look at what goes over a link: names, numbers and sizes, no content."""

from __future__ import annotations

from teds_provision.protocol.messages.frames import COMMON, SECURITY, Command, Function, Reason, Reply, TedsFunction
from teds_provision.protocol.messages.tables import COMMANDS


def named(command: Command) -> str:
    """A command in words: name, class and function, payload octets; "Prove (128.8), 31 octets"."""
    number = f"{command.command_class}.{command.function}"
    kind = Function if command.command_class == SECURITY else TedsFunction
    if command.command_class in (COMMON, SECURITY) and command.function in {int(each) for each in kind}:
        number = f"{kind(command.function).name.replace('_', ' ').capitalize()} ({number})"
    elif (spec := COMMANDS.get((command.command_class, command.function))) is not None:
        number = f"{spec.name} ({number})"
    return f"{number}, {len(command.payload)} octets"


def told(reply: Reply) -> str:
    """A reply in words: "success, 64 octets", "refusal 4"."""
    if reply.ok:
        return f"success, {len(reply.payload)} octets"
    return f"refusal {reply.reason}" if len(reply.payload) == 1 else f"a refusal of {len(reply.payload)} octets"


def asked(command: Command) -> str:
    """As :func:`named`, and of a TEDS command which TEDS and where: "Read (1.2), 5 octets: TEDS 5 of channel 1 …"."""
    text = named(command)
    payload = command.payload
    if command.command_class != COMMON or not payload or command.function not in {int(each) for each in TedsFunction}:
        return text
    where = f"{text}: TEDS {payload[0]} of channel {command.channel}"
    if command.function in (TedsFunction.READ, TedsFunction.WRITE) and len(payload) >= 5:
        where += f" from octet {int.from_bytes(payload[1:5], 'big')}"
    return where


def answered(command: Command, reply: Reply) -> str:
    """A reply in words, with what it answers: "reply to Prove (128.8): success, 64 octets"."""
    text = f"reply to {named(command).rpartition(',')[0]}: {told(reply)}"
    if reply.reason is not None and reply.reason in {int(each) for each in Reason}:
        text += f" ({Reason(reply.reason).name.lower().replace('_', ' ')})"
    return text
