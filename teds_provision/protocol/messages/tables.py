"""Commands, replies and network services by name: one table for both decoding and composing.

A layout is a string of ``name:type`` words, in wire order. Types: ``u8 u16 u32 bool f32``, ``oN`` (N octets as they
are), ``uuid`` (16 octets), ``text`` (up to a NUL), ``time`` (TimeInstance of the 2024 messages, 10 octets),
``duration`` (8 octets), ``teds`` (a whole TEDS), ``octets`` (the rest), ``blocks`` (channel u16 and access code u8,
repeated), ``u16s texts uuids`` (as many as the ``count`` before).

Source: formats.md, "Messages"; class 128 is the security profile's. Classes 4 to 7 of the 2007 commands rest on one
public implementation, the layouts of announcements and departures of 2024 too.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from teds_provision.protocol.messages.frames import (
    COMMON,
    SECURITY_CLASS,
    Command,
    Function,
    Reason,
    Reply,
    TedsFunction,
)


class Spec(NamedTuple):
    """A command or a service: its name, the layout of its arguments, and of its reply (None: it has none).

    ``answer`` is the layout of the reply to the command without arguments, if that is another form of it (Open).
    """

    name: str
    arguments: str = ""
    reply: str | None = None
    answer: str | None = None


CLASSES: Final = {
    1: "CommonCmd",
    2: "XdcrIdle",
    3: "XdcrOperate",
    4: "XdcrEither",
    5: "TIMsleep",
    6: "TIMActive",
    7: "AnyState",
    SECURITY_CLASS: "Security profile",
}

STATUS = "attributes:u8 status:u8 size:u32 checksum:u16 max_size:u32"
SEGMENT = "offset:u32 octets:octets"

_COMMON = {
    1: Spec("Query TEDS", "access_code:u8", STATUS),
    2: Spec("Read TEDS segment", "access_code:u8 offset:u32", SEGMENT),
    3: Spec("Write TEDS segment", "access_code:u8 offset:u32 octets:octets"),
    4: Spec("Update TEDS", "access_code:u8", STATUS),
    5: Spec("Run self-test", "test:u8"),
    6: Spec("Write service-request mask", "mask:u32"),
    7: Spec("Read service-request mask", "", "mask:u32"),
    8: Spec("Read status-event register", "", "status_bits:u32"),
    9: Spec("Read status-condition register", "", "status_bits:u32"),
    10: Spec("Clear status-event register"),
    11: Spec("Write status-event protocol state", "enabled:bool"),
    12: Spec("Read status-event protocol state", "", "enabled:bool"),
}

_IDLE = {
    1: Spec("Set data-set repetition count", "repetitions:u16"),
    2: Spec("Set pre-trigger count", "pre_trigger:u16"),
    3: Spec("AddressGroup definition", "group:u16"),
    4: Spec("Sampling mode", "sampling_mode:u8"),
    5: Spec("Data transmission mode", "transmission_mode:u8"),
    6: Spec("Buffered state", "enabled:bool"),
    7: Spec("End-of-data-set operation", "operation:u8"),
    8: Spec("Actuator halt mode", "halt_mode:u8"),
    9: Spec("Edge to report", "edge:u8"),
    10: Spec("Calibrate TransducerChannel", "", "octets:octets"),
    11: Spec("Zero TransducerChannel", "", "octets:octets"),
    12: Spec("Write corrections state", "state:u8"),
    13: Spec("Read corrections state", "", "state:u8"),
    14: Spec("Write TransducerChannel initiate-trigger state", "enabled:bool"),
    15: Spec("Write TransducerChannel initiate-trigger configuration", "octets:octets"),
}

_OPERATE = {
    1: Spec("Read data-set segment", "offset:u32", SEGMENT),
    2: Spec("Write data-set segment", "offset:u32 octets:octets"),
    3: Spec("Trigger"),
    4: Spec("Abort trigger"),
}

_EITHER = {
    1: Spec("TransducerChannel Operate"),
    2: Spec("TransducerChannel Idle"),
    3: Spec("Write trigger state", "enabled:bool"),
    4: Spec("Read trigger state", "", "enabled:bool"),
    5: Spec("Read data-set repetition count", "", "repetitions:u16"),
    6: Spec("Read pre-trigger count", "", "pre_trigger:u16"),
    7: Spec("Read AddressGroup assignment", "", "group:u16"),
    8: Spec("Read sampling mode", "", "sampling_mode:u8"),
    9: Spec("Read data transmission mode", "", "transmission_mode:u8"),
    10: Spec("Read buffered state", "", "enabled:bool"),
    11: Spec("Read end-of-data-set operation", "", "operation:u8"),
    12: Spec("Read actuator halt mode", "", "halt_mode:u8"),
    13: Spec("Read edge to report", "", "edge:u8"),
    14: Spec("Read initiate-trigger state", "", "enabled:bool"),
    15: Spec("Read initiate-trigger configuration", "", "octets:octets"),
    16: Spec("Device clear"),
}

_ACTIVE = {
    1: Spec("Read TIM version", "", "version:u16"),
    2: Spec("TIM sleep"),
    3: Spec("Store operational set-up", "setup:u8"),
    4: Spec("Recall operational set-up", "setup:u8"),
    5: Spec("Read IEEE 1451.0 version", "", "version:u8"),
}

_PROFILE: Final[dict[int, Spec]] = {
    Function.REQUEST: Spec(
        "Request",
        "station_key:o65 station_key_signature:o64 ca_key:o65 one_time_key:o65",
        "nonce:o16 key_epoch:u32 tag:o16 security_teds:teds",
    ),
    Function.CONFIRM: Spec("Confirm", "tag:o16", ""),
    Function.OPEN: Spec("Open", "key_id:o8 one_time_key:o65 mac:o16", "one_time_key:o65 tag:o16", "opens:o8"),
    Function.SEALED: Spec("Sealed", "counter:u32 sealed:octets", "counter:u32 sealed:octets"),
    Function.CLOSE: Spec("Close", "", ""),
    Function.IDENTIFY: Spec(
        "Identify",
        "",
        "version:u8 node_uuid:o10 node_state:u8 key_epoch:u32 sequence:u32 max_message:u16 can_address:u8",
    ),
    Function.PROVE: Spec("Prove", "challenge:o32", "signature:o64"),
    Function.RESET: Spec("Reset", "challenge:o32", "signature:o64"),
    Function.SET_CAN_ADDRESS: Spec("Set CAN address", "can_address:u8", ""),
    Function.LIST: Spec("List", "", "blocks:blocks"),
    Function.SAMPLE: Spec("Sample", "channels:octets", "tick:o8 flags:u8 data_sets:octets"),
    Function.SET: Spec("Set", "values:octets", ""),
    Function.SUBSCRIBE: Spec(
        "Subscribe",
        "stream:u8 stream_kind:u8 n:u8 gap_us:u16 period_ns:o8 start:o8 channels:octets",
        "run:u16 message_octets:u16 start:o8",
    ),
    Function.STOP: Spec("Stop", "stream:u8", "next_counter:u32"),
    Function.CLOCK: Spec("Clock", "", "received:o8 sent:o8 mark:o8 step_ns:u32 drift_ppm:u16 last:u32"),
    Function.ARM: Spec("Arm", "commitment:o16 life_s:u8 action:u8", ""),
    Function.POWER: Spec("Power", "", "power_flags:u8 level:u8 millivolts:u16 milliamperes:o2 celsius:o1"),
    Function.OPERATION: Spec("Operation", "", "mode:u8 channel_states:octets"),
    Function.DRIVE: Spec("Drive", "channels:octets", "run:u16 message_octets:u16"),
    Function.ABOUT: Spec(
        "About", "", "form:u8 firmware_flags:u8 major:u8 minor:u8 patch:u16 build:u32 image:o32 firmware:octets"
    ),
    Function.LOCATE: Spec("Locate", "seconds:u8", ""),
    Function.MANAGE: Spec("Manage", "packet:octets", "packet:octets"),
}

COMMANDS: Final[dict[tuple[int, int], Spec]] = {
    (class_code, int(number)): spec
    for class_code, functions in (
        (1, _COMMON),
        (2, _IDLE),
        (3, _OPERATE),
        (4, _EITHER),
        (5, {1: Spec("Wake-up")}),
        (6, _ACTIVE),
        (7, {1: Spec("Reset")}),
        (SECURITY_CLASS, _PROFILE),
    )
    for number, spec in functions.items()
}

REASONS: Final = {int(reason): reason.name.lower().replace("_", " ") for reason in Reason} | {
    Reason.BAD_FORM: "bad length, checksum or form",
    Reason.UNKNOWN_KEY: "unknown key (never agree again because of it)",
    Reason.BUSY: "busy with another station's transfer, or claimed by another session",
    Reason.NO_SUCH_TEDS: "no such TEDS",
    Reason.WRONG_UUID: "wrong UUID",
    Reason.TOO_LATE: "too late, or too far ahead",
    Reason.DOES_NOT_FIT: "does not fit link or budget",
    Reason.FAULT: "hardware fault or no power",
}

STATUS_BITS: Final = (
    "service request",
    "TEDS changed",
    "invalid command",
    "command rejected",
    "missed data or event",
    "data or event",
    "hardware error",
    "not operational",
    "protocol error",
    "data available or processed",
    "busy",
    "failed calibration",
    "failed self-test",
    "over or under range",
    "corrections disabled",
    "consumables exhausted",
)
"""Bits of the status registers, from memory and unconfirmed."""

ERROR_SOURCES: Final = ("local .0", "local .X", "remote .X", "remote .0", "application", "?", "?", "?")
ERRORS: Final = (
    "no error",
    "invalid communication id",
    "unknown destination",
    "time-out",
    "network failure",
    "network corruption",
    "memory",
    "quality of service",
    "multicast unsupported",
    "unknown group",
    "unknown module",
    "unknown message id",
    "not a group member",
    "illegal mode",
    "locked resource",
    "fatal TEDS error",
    "non-fatal TEDS error",
    "close on locked resource",
    "lock broken",
    "network resource exceeded",
    "memory resource exceeded",
)

FLAGS: Final[dict[str, tuple[str, ...]]] = {
    "attributes": ("read-only", "not available", "invalid", "virtual", "text", "adaptive", "manufacturer-defined"),
    "status": ("too large",),
    "status_bits": STATUS_BITS,
}

ENUMERATIONS: Final[dict[str, dict[int, str]]] = {
    "node_state": {0: "factory", 1: "keyed", 2: "provisioned"},
    "transmission_mode": {1: "on command", 2: "buffer full", 3: "interval"},
    "edge": {0: "not applicable", 1: "rising", 2: "falling", 3: "both"},
    "halt_mode": {0: "not applicable", 1: "halt at once", 2: "halt at end of data set", 3: "ramp"},
    "address_type": {1: "IPv4", 2: "IPv6"},
}

# -- network services of the 2024 edition --------------------------------------------------------------------------

SERVICES: Final = {
    1: "discovery",
    2: "transducer access",
    3: "TEDS access",
    4: "event notification",
    5: "manager",
    9: "time synchronization",
}
MESSAGE_TYPES: Final = {1: "command", 2: "reply", 3: "announcement", 4: "notification", 5: "call-back"}

_NCAP = "app:uuid ncap:uuid"
_TIM = f"{_NCAP} tim:uuid"
_CHANNEL = f"{_TIM} channel:u16"
_ERROR = "error:u16 "

_DISCOVERY = {
    1: Spec("NCAP announcement", "ncap:uuid name:text address_type:u8 address:octets"),
    2: Spec("NCAP departure", "ncap:uuid"),
    3: Spec("NCAP abandonment", "ncap:uuid"),
    4: Spec("NCAP-TIM announcement", "ncap:uuid tim:uuid name:text"),
    5: Spec("NCAP-TIM departure", "ncap:uuid tim:uuid"),
    6: Spec("NCAP-TIM-channel announcement", "ncap:uuid tim:uuid channel:u16 name:text"),
    7: Spec("NCAP-TIM-channel departure", "ncap:uuid tim:uuid channel:u16"),
    8: Spec("NCAP discovery", "app:uuid", f"{_ERROR}{_NCAP} name:text address_type:u8 address:octets"),
    9: Spec("NCAP-TIM discovery", _NCAP, f"{_ERROR}{_NCAP} count:u16 tims:uuids names:texts"),
    10: Spec("NCAP-TIM-channel discovery", _TIM, f"{_ERROR}{_TIM} count:u16 channels:u16s names:texts"),
}

_TEDS = {
    1: Spec("Query TEDS", f"{_CHANNEL} access_code:u8 timeout:duration", f"{_ERROR}{_CHANNEL} octets:octets"),
    2: Spec(
        "Read TEDS",
        f"{_CHANNEL} access_code:u8 offset:u32 timeout:duration",
        f"{_ERROR}{_CHANNEL} offset:u32 teds:teds",
    ),
    3: Spec("Write TEDS", f"{_CHANNEL} octets:octets", f"{_ERROR}{_CHANNEL} octets:octets"),
    4: Spec("Update TEDS", f"{_CHANNEL} octets:octets", f"{_ERROR}{_CHANNEL} octets:octets"),
}

_REACH = ("one channel of one TIM", "several channels of one TIM", "several channels of several TIMs")
_ACCESS_NAMES = [
    *(
        f"Synchronous {verb} of {what}, {r}"
        for verb in ("read", "write")
        for r in _REACH
        for what in ("sample", "block")
    ),
    "Asynchronous read of block, one channel of one TIM",
    "Call-back of asynchronous read of block, one channel of one TIM",
    "Asynchronous read of stream, one channel of one TIM",
    "Call-back of asynchronous read of stream, one channel of one TIM",
    "Asynchronous read of block, several channels of one TIM",
    "Call-back of asynchronous read of block, several channels of one TIM",
    "Asynchronous read of block, several channels of several TIMs",
    "Call-back of asynchronous read of block, several channels of several TIMs",
]
_ACCESS = {
    number: Spec(name, "octets:octets", f"{_ERROR}octets:octets") for number, name in enumerate(_ACCESS_NAMES, 1)
} | {
    1: Spec(
        _ACCESS_NAMES[0],
        f"{_CHANNEL} sampling_mode:u8 timeout:duration",
        f"{_ERROR}{_CHANNEL} value:text time:time",
    ),
}

_EVENTS = {
    number: Spec(f"{verb} {what}", "octets:octets", f"{_ERROR}octets:octets")
    for number, (what, verb) in enumerate(
        (
            (what, verb)
            for what in (*(f"transducer event, {reach}" for reach in _REACH), "NCAP heartbeat")
            for verb in ("Subscribe", "Notify", "Unsubscribe")
        ),
        1,
    )
}

NETWORK: Final[dict[tuple[int, int], Spec]] = {
    (service, number): spec
    for service, entries in {1: _DISCOVERY, 2: _ACCESS, 3: _TEDS, 4: _EVENTS}.items()
    for number, spec in entries.items()
}


# Descriptions for users who look at the traffic of a link: names, numbers and sizes, no content.

_NUMBERS: Final = {kind: frozenset(map(int, kind)) for kind in (Function, TedsFunction)}


def describe_command(command: Command) -> str:
    """Describe a command: name, class and function, payload octets; "Prove (128.8), 31 octets"."""
    number = f"{command.command_class}.{command.function}"
    kind = Function if command.command_class == SECURITY_CLASS else TedsFunction
    if command.command_class in (COMMON, SECURITY_CLASS) and command.function in _NUMBERS[kind]:
        number = f"{kind(command.function).name.replace('_', ' ').capitalize()} ({number})"
    elif (spec := COMMANDS.get((command.command_class, command.function))) is not None:
        number = f"{spec.name} ({number})"
    return f"{number}, {len(command.payload)} octets"


def describe_reply(reply: Reply) -> str:
    """Describe a reply: "success, 64 octets", "refusal 4"."""
    if reply.ok:
        return f"success, {len(reply.payload)} octets"
    return f"refusal {reply.reason}" if len(reply.payload) == 1 else f"a refusal of {len(reply.payload)} octets"


def describe_request(command: Command) -> str:
    """Describe a command like :func:`describe_command`, with TEDS: "Read (1.2), 5 octets: TEDS 5 of channel 1 …"."""
    text = describe_command(command)
    payload = command.payload
    if (
        command.command_class != COMMON
        or not payload
        or command.function not in {int(function) for function in TedsFunction}
    ):
        return text
    where = f"{text}: TEDS {payload[0]} of channel {command.channel}"
    if command.function in (TedsFunction.READ, TedsFunction.WRITE) and len(payload) >= 5:
        where += f" from octet {int.from_bytes(payload[1:5], 'big')}"
    return where


def describe_answer(command: Command, reply: Reply) -> str:
    """Describe a reply with its command: "reply to Prove (128.8): success, 64 octets"."""
    text = f"reply to {describe_command(command).rpartition(',')[0]}: {describe_reply(reply)}"
    if reply.reason is not None and reply.reason in {int(reason) for reason in Reason}:
        text += f" ({Reason(reply.reason).name.lower().replace('_', ' ')})"
    return text
