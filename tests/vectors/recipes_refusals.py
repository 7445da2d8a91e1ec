"""Refusals outside sessions: the table of states, the order of Request's checks, TEDS access (profile section 4)."""

# ruff: noqa: E501 - one row per case, its note in words included
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from teds_provision.protocol.messages.frames import (
    Command,
    Function,
    query_teds,
    read_teds,
    security_command,
    update_teds,
    write_teds,
)
from teds_provision.protocol.wire_agreement import StationAgreement

from .recipes import CAN, CHALLENGE, IDENTIFY, changed_request
from .scene import BLOCKS, SIGNED, UUID, Scene, credentials, high, key


def refusals() -> Iterator[Scene]:
    """Reasons outside sessions: the table of states, the order of Request's checks, TEDS access, lengths."""
    for state in ("factory", "keyed", "provisioned"):
        for tapped in (True, False):
            yield _state_table(state, tapped)
    yield from _requests()
    scene = Scene("frames", "A frame whose length lies gets 4, after permission.")
    for octets, note in [
        (b"", "No octets."),
        (bytes.fromhex("0000800700"), "Five octets."),
        (bytes.fromhex("000080070001"), "Length 1, nothing follows."),
        (bytes.fromhex("00008007000000"), "Length 0, one octet follows."),
        (bytes.fromhex("0000800b000100"), "List with a payload."),
        (bytes.fromhex("00008008001f") + bytes(31), "Prove with 31 octets."),
        (bytes.fromhex("000001010000"), "Query without an access code."),
        (bytes.fromhex("00000102000180"), "Read without an offset."),
        (bytes.fromhex("000080050001"), "A plain Close is not permitted: 3 goes before 4."),
    ]:
        scene.exchange(octets, note)
    yield scene

    scene = Scene(
        "teds-access",
        "Query, Read and List on a provisioned node; maxMessage 1024, so that a Read gives at most 978 octets.",
        "provisioned",
        max_message=1024,
    )
    size = len(SIGNED)
    for command, note in [
        (security_command(Function.LIST), "List: (0, 1), (0, 128), (1, 3), (1, 12)."),
        (query_teds(0, 1), "Query of Meta."),
        (query_teds(0, 128), "Query of 128: MfgrDefine (bit 6); its largest size is maxMessage - 78."),
        (
            query_teds(1, 128),
            "Query of 128 on channel 1: any other TEDS that may be held and is absent; NotAvail and MfgrDefine.",
        ),
        (query_teds(1, 5), "Query of an absent one: NotAvail, size 0, checksum 0, largest size."),
        (query_teds(1, 11), "Absent and text-based: NotAvail and TextTEDS."),
        (read_teds(1, 12, 0), "Read from 0."),
        (read_teds(0, 128, 600), "Read from within."),
        (read_teds(0, 128, size), "Read at the end: the offset and no octets."),
        (read_teds(0, 128, size + 9), "Read past the end: the offset is the length."),
        (read_teds(1, 5, 0), "Read of an absent one: 18."),
        (query_teds(0, 0), "Access code 0: 18."),
        (query_teds(0, 18), "Access code 18: 18."),
        (read_teds(0, 127, 0), "Access code 127: 18."),
        (query_teds(0, 136), "Access code 136: 18."),
        (query_teds(256, 3), "Channel 256: 18."),
        (query_teds(0xFFFF, 1), "Every channel at once: 18."),
    ]:
        scene.exchange(command, note)
    yield scene

    scene = Scene("flash-fails", "A command whose transaction fails gets 11 and changes nothing.")
    scene.event("flash_fails", "The flash refuses to be written.")
    scene.exchange(security_command(Function.SET_CAN_ADDRESS, b"\x21"), "11.")
    scene.exchange(IDENTIFY, "The old address stands.")
    yield scene


def _state_table(state: str, tapped: bool) -> Scene:
    how = "tapped" if tapped else "untapped"
    scene = Scene(f"table-{state}-{how}", f"Every command, plain and {how}, to a {state} node.", state)
    commands: list[tuple[Command, str]] = [
        (security_command(Function.IDENTIFY), "Identify"),
        (security_command(Function.PROVE, CHALLENGE), "Prove"),
        (security_command(Function.LIST), "List"),
        (query_teds(0, 1), "Query"),
        (read_teds(0, 128, 0), "Read"),
        (security_command(Function.CONFIRM, bytes(16)), "Confirm, none pending"),
        (security_command(Function.OPEN), "Open without payload"),
        (security_command(Function.OPEN, bytes(89)), "Open, a key that nobody has"),
        (security_command(Function.SEALED, bytes(36)), "Sealed"),
        (security_command(Function.CLOSE), "Close"),
        (write_teds(0, 1, 0, BLOCKS[0, 1]), "Write"),
        (update_teds(0, 1), "Update"),
        (Command(0, 1, 5, b"\0"), "Class 1, function 5"),
        (Command(1, 3, 1, bytes(4)), "Class 3"),
        (Command(0, 7, 1), "Class 7, function 1: the standard's own reset"),
        (Command(0, 128, 6), "Class 128, function 6"),
        (Command(0, 128, 12, b"\1"), "Sample"),
        (Command(0, 128, 21), "Class 128, function 21"),
        (Command(1, 128, 7), "Identify to channel 1"),
        (security_command(Function.SET_CAN_ADDRESS, b"\x21"), "Set CAN address"),
        (security_command(Function.SET_CAN_ADDRESS, b"\xf0"), "Set CAN address 240"),
        (StationAgreement(credentials(), UUID, one_time=key("one_time")).request(), "Request"),
        (security_command(Function.RESET, CHALLENGE), "Reset"),
    ]
    for command, note in commands:
        reply = scene.exchange(command, note, link="nfc" if tapped else "can:f1")
        scene.steps[-1]["note"] += ": refused." if not reply.ok else ": yes."
    return scene


def _requests() -> Iterator[Scene]:
    scene = Scene(
        "request-checks",
        "Request on a keyed node: state and permission 3, length 4, points 15, CA other than the kept one 14, field 104 wrong 5; the first that fails.",
        "keyed",
    )
    good, foreign = changed_request(), credentials("foreign_station", "foreign_ca")
    off_curve = bytes([4]) + bytes(31) + b"\x01" + bytes(31) + b"\x01"
    cases: list[tuple[Command, str, dict[str, Any]]] = [
        (replace(good, payload=good.payload[:-1]), "258 octets, untapped: 3 goes before 4.", CAN),
        (replace(good, payload=good.payload[:-1]), "258 octets: 4.", {}),
        (replace(good, payload=good.payload + b"\0"), "260 octets: 4.", {}),
        (changed_request(one_time=off_curve), "E is not on the curve: 15.", {}),
        (changed_request(one_time=bytes(65)), "E is 65 zero octets: 15.", {}),
        (changed_request(one_time=b"\x06" + key("one_time").point[1:]), "E begins with 06 (hybrid form): 15.", {}),
        (changed_request(one_time=key("node").point), "E is the node's own point: 15.", {}),
        (changed_request(one_time=key("station").point), "E is P(station): 15, a one-time key is due.", {}),
        (changed_request(station=key("node").point), "P(station) is the node's own point: 15.", {}),
        (changed_request(ca=off_curve), "P(CA) is not on the curve: 15.", {}),
        (changed_request(station=off_curve, ca=foreign.ca), "P(station) bad and a foreign CA: 15 goes before 14.", {}),
        (changed_request(ca=foreign.ca, station_signature=bytes(64)), "Foreign CA and a wrong field 104: 14 goes before 5.", {}),
        (changed_request(station=foreign.key.point, ca=foreign.ca, station_signature=foreign.station_signature), "A foreign owner's station, in itself right: 14.", {}),
        (changed_request(station=foreign.key.point, station_signature=foreign.station_signature), "The kept CA named, field 104 by another: 5.", {}),
        (changed_request(station_signature=high(credentials().station_signature)), "Field 104 with a high s, otherwise right: 5.", {}),
        (changed_request(station_signature=bytes(64)), "Field 104 of zeros: 5.", {}),
        (changed_request(station=key("second_station").point), "Field 104 over another station's key: 5.", {}),
    ]  # fmt: skip
    for command, note, more in cases:
        scene.exchange(command, note, **more)
    yield scene
    scene = Scene("last-epoch", "A node at epoch 2^32 - 1 cannot go on: our node refuses with 8.", epoch=0xFFFFFFFF)
    scene.exchange(good, "8.")
    yield scene


FILES = {"refusals": refusals}
