"""The numbered tables of messages as they stand in the format study, by hand: what has a reply, and of which octets.

Nothing here is computed from the tables that it holds; a peer reads these numbers.
"""

from __future__ import annotations

import pytest

from teds_provision.errors import GarbledError
from teds_provision.protocol.messages import tables
from teds_provision.protocol.messages.frames import TedsStatus, decode_list, decode_reply

STATUS = "attributes:u8 status:u8 size:u32 checksum:u16 max_size:u32"
SEGMENT = "offset:u32 octets:octets"

COMMANDS = {  # class and function: name, arguments, reply (None: it has none)
    (1, 1): ("Query TEDS", "access_code:u8", STATUS),
    (1, 2): ("Read TEDS segment", "access_code:u8 offset:u32", SEGMENT),
    (1, 3): ("Write TEDS segment", "access_code:u8 offset:u32 octets:octets", None),
    (1, 4): ("Update TEDS", "access_code:u8", STATUS),
    (1, 5): ("Run self-test", "test:u8", None),
    (1, 6): ("Write service-request mask", "mask:u32", None),
    (1, 7): ("Read service-request mask", "", "mask:u32"),
    (1, 8): ("Read status-event register", "", "status_bits:u32"),
    (1, 9): ("Read status-condition register", "", "status_bits:u32"),
    (1, 10): ("Clear status-event register", "", None),
    (1, 11): ("Write status-event protocol state", "enabled:bool", None),
    (1, 12): ("Read status-event protocol state", "", "enabled:bool"),
    (2, 1): ("Set data-set repetition count", "repetitions:u16", None),
    (2, 2): ("Set pre-trigger count", "pre_trigger:u16", None),
    (2, 3): ("AddressGroup definition", "group:u16", None),
    (2, 4): ("Sampling mode", "sampling_mode:u8", None),
    (2, 5): ("Data transmission mode", "transmission_mode:u8", None),
    (2, 6): ("Buffered state", "enabled:bool", None),
    (2, 7): ("End-of-data-set operation", "operation:u8", None),
    (2, 8): ("Actuator halt mode", "halt_mode:u8", None),
    (2, 9): ("Edge to report", "edge:u8", None),
    (2, 10): ("Calibrate TransducerChannel", "", "octets:octets"),
    (2, 11): ("Zero TransducerChannel", "", "octets:octets"),
    (2, 12): ("Write corrections state", "state:u8", None),
    (2, 13): ("Read corrections state", "", "state:u8"),
    (2, 14): ("Write TransducerChannel initiate-trigger state", "enabled:bool", None),
    (2, 15): ("Write TransducerChannel initiate-trigger configuration", "octets:octets", None),
    (3, 1): ("Read data-set segment", "offset:u32", SEGMENT),
    (3, 2): ("Write data-set segment", SEGMENT, None),
    (3, 3): ("Trigger", "", None),
    (3, 4): ("Abort trigger", "", None),
    (4, 1): ("TransducerChannel Operate", "", None),
    (4, 2): ("TransducerChannel Idle", "", None),
    (4, 3): ("Write trigger state", "enabled:bool", None),
    (4, 4): ("Read trigger state", "", "enabled:bool"),
    (4, 5): ("Read data-set repetition count", "", "repetitions:u16"),
    (4, 6): ("Read pre-trigger count", "", "pre_trigger:u16"),
    (4, 7): ("Read AddressGroup assignment", "", "group:u16"),
    (4, 8): ("Read sampling mode", "", "sampling_mode:u8"),
    (4, 9): ("Read data transmission mode", "", "transmission_mode:u8"),
    (4, 10): ("Read buffered state", "", "enabled:bool"),
    (4, 11): ("Read end-of-data-set operation", "", "operation:u8"),
    (4, 12): ("Read actuator halt mode", "", "halt_mode:u8"),
    (4, 13): ("Read edge to report", "", "edge:u8"),
    (4, 14): ("Read initiate-trigger state", "", "enabled:bool"),
    (4, 15): ("Read initiate-trigger configuration", "", "octets:octets"),
    (4, 16): ("Device clear", "", None),
    (5, 1): ("Wake-up", "", None),
    (6, 1): ("Read TIM version", "", "version:u16"),
    (6, 2): ("TIM sleep", "", None),
    (6, 3): ("Store operational set-up", "setup:u8", None),
    (6, 4): ("Recall operational set-up", "setup:u8", None),
    (6, 5): ("Read IEEE 1451.0 version", "", "version:u8"),
    (7, 1): ("Reset", "", None),
}
CHANNEL = "app:uuid ncap:uuid tim:uuid channel:u16"
NETWORK = {  # type and id of a network service with arguments that are known
    (1, 1): ("NCAP announcement", "ncap:uuid name:text address_type:u8 address:octets", None),
    (1, 2): ("NCAP departure", "ncap:uuid", None),
    (1, 3): ("NCAP abandonment", "ncap:uuid", None),
    (1, 4): ("NCAP-TIM announcement", "ncap:uuid tim:uuid name:text", None),
    (1, 5): ("NCAP-TIM departure", "ncap:uuid tim:uuid", None),
    (1, 6): ("NCAP-TIM-channel announcement", "ncap:uuid tim:uuid channel:u16 name:text", None),
    (1, 7): ("NCAP-TIM-channel departure", "ncap:uuid tim:uuid channel:u16", None),
    (1, 8): ("NCAP discovery", "app:uuid", "error:u16 app:uuid ncap:uuid name:text address_type:u8 address:octets"),
    (1, 9): (
        "NCAP-TIM discovery",
        "app:uuid ncap:uuid",
        "error:u16 app:uuid ncap:uuid count:u16 tims:uuids names:texts",
    ),
    (1, 10): (
        "NCAP-TIM-channel discovery",
        "app:uuid ncap:uuid tim:uuid",
        "error:u16 app:uuid ncap:uuid tim:uuid count:u16 channels:u16s names:texts",
    ),
    (2, 1): (
        "Synchronous read of sample, one channel of one TIM",
        f"{CHANNEL} sampling_mode:u8 timeout:duration",
        f"error:u16 {CHANNEL} value:text time:time",
    ),
    (3, 1): ("Query TEDS", f"{CHANNEL} access_code:u8 timeout:duration", f"error:u16 {CHANNEL} octets:octets"),
    (3, 2): (
        "Read TEDS",
        f"{CHANNEL} access_code:u8 offset:u32 timeout:duration",
        f"error:u16 {CHANNEL} offset:u32 teds:teds",
    ),
    (3, 3): ("Write TEDS", f"{CHANNEL} octets:octets", f"error:u16 {CHANNEL} octets:octets"),
    (3, 4): ("Update TEDS", f"{CHANNEL} octets:octets", f"error:u16 {CHANNEL} octets:octets"),
}


def test_every_command_of_the_2007_edition() -> None:
    found = {number: tuple(spec[:3]) for number, spec in tables.COMMANDS.items() if number[0] < 128}
    assert found == COMMANDS
    assert tables.CLASSES == {
        1: "CommonCmd", 2: "XdcrIdle", 3: "XdcrOperate", 4: "XdcrEither", 5: "TIMsleep", 6: "TIMActive", 7: "AnyState",
        128: "Security profile",
    }  # fmt: skip


def test_every_network_service_of_the_2024_edition() -> None:
    known = {number: tuple(spec[:3]) for number, spec in tables.NETWORK.items() if spec.arguments != "octets:octets"}
    assert known == NETWORK
    rest = {number: spec.reply for number, spec in tables.NETWORK.items() if spec.arguments == "octets:octets"}
    numbers = [*((2, number) for number in range(2, 21)), *((4, number) for number in range(1, 13))]
    assert rest == dict.fromkeys(numbers, "error:u16 octets:octets")
    assert tables.SERVICES == {
        1: "discovery", 2: "transducer access", 3: "TEDS access", 4: "event notification", 5: "manager",
        9: "time synchronization",
    }  # fmt: skip
    assert tables.MESSAGE_TYPES == {1: "command", 2: "reply", 3: "announcement", 4: "notification", 5: "call-back"}


def test_bits_of_the_registers_and_of_query_from_bit_0_on() -> None:
    assert tables.FLAGS == {
        "attributes": ("read-only", "not available", "invalid", "virtual", "text", "adaptive", "manufacturer-defined"),
        "status": ("too large",),
        "status_bits": (
            "service request", "TEDS changed", "invalid command", "command rejected", "missed data or event",
            "data or event", "hardware error", "not operational", "protocol error", "data available or processed",
            "busy", "failed calibration", "failed self-test", "over or under range", "corrections disabled",
            "consumables exhausted",
        ),
    }  # fmt: skip


def test_error_codes_from_0_on() -> None:
    assert tables.ERROR_SOURCES[:5] == ("local .0", "local .X", "remote .X", "remote .0", "application")
    assert tables.ERRORS == (
        "no error", "invalid communication id", "unknown destination", "time-out", "network failure",
        "network corruption", "memory", "quality of service", "multicast unsupported", "unknown group",
        "unknown module", "unknown message id", "not a group member", "illegal mode", "locked resource",
        "fatal TEDS error", "non-fatal TEDS error", "close on locked resource", "lock broken",
        "network resource exceeded", "memory resource exceeded",
    )  # fmt: skip


def test_modes_of_the_commands_are_not_the_capabilities_of_the_teds() -> None:
    """Command 2.5 counts 1 to 3; DataXmit of the TEDS has 1 to 7 with other meanings."""
    assert tables.ENUMERATIONS == {
        "node_state": {0: "factory", 1: "keyed", 2: "provisioned"},
        "transmission_mode": {1: "on command", 2: "buffer full", 3: "interval"},
        "edge": {0: "not applicable", 1: "rising", 2: "falling", 3: "both"},
        "halt_mode": {0: "not applicable", 1: "halt at once", 2: "halt at end of data set", 3: "ramp"},
        "address_type": {1: "IPv4", 2: "IPv6"},
    }


@pytest.mark.parametrize(("flag", "ok"), [(0, False), (1, True), (2, True), (0x80, True), (0xFF, True)])
def test_a_reply_has_failed_if_its_flag_is_0_alone(flag: int, ok: bool) -> None:
    reply = decode_reply(bytes([flag, 0, 2, 7, 8]))
    assert (reply.ok, reply.payload) == (ok, b"\7\10")


@pytest.mark.parametrize("reply", ["", "01", "0100", "010000ff", "010001", "010002ff", "000001"])
def test_a_reply_whose_length_does_not_count_its_octets_is_garbled(reply: str) -> None:
    assert decode_reply(bytes.fromhex("010000")).payload == b""
    octets = bytes.fromhex(reply)
    with pytest.raises(GarbledError) as no:
        decode_reply(octets)
    assert no.value.message == (
        f"A reply frame has at least 3 octets, this one {len(octets)}."
        if len(octets) < 3
        else f"A reply frame announces {int(reply[2:6], 16)} octets and carries {len(octets) - 3}."
    )


def test_a_query_reply_has_twelve_octets_in_the_order_of_the_standard() -> None:
    octets = bytes.fromhex("50 01 0000001d faf5 00000100")
    status = TedsStatus(attributes=0x50, size=29, checksum=0xFAF5, max_size=256, status=1)
    assert TedsStatus.decode(octets) == status
    assert status.encode() == octets
    for wrong in (octets[:-1], octets + b"\0", b""):
        with pytest.raises(GarbledError):
            TedsStatus.decode(wrong)


@pytest.mark.parametrize(
    ("payload", "found"),
    [
        ("", []),
        ("0000 01 0000 80 0001 03 ffff ff", [(0, 1), (0, 128), (1, 3), (65535, 255)]),
        ("0000 01 0000", None),
        ("0000 01 0000 01", None),
        ("0000 80 0000 01", None),
        ("0001 01 0000 03", None),
    ],
)
def test_a_list_has_each_teds_once_ascending(payload: str, found: list[tuple[int, int]] | None) -> None:
    octets = bytes.fromhex(payload)
    if found is not None:
        assert decode_list(octets) == found
        return
    with pytest.raises(GarbledError):
        decode_list(octets)
