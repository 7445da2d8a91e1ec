"""The firmware that a node reports, the check against its type, and Locate (profile.md, "About and Locate").

A report is read once per session. In a session it is a statement by the holder of the node's key, outside one a hint,
which may refuse and never permit. It does not affect the verdict, which covers only the datasheet.
"""

from __future__ import annotations

from typing import Final

from teds_provision.errors import GarbledError, LinkError, NodeRefusedError, PolicyError
from teds_provision.protocol.messages.firmware import ABOUT
from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.conversation import Conversation
from teds_provision.station.firmware import (
    CHANGED,
    FirmwareReading,
    FirmwareState,
    KnownFirmware,
    decoded_report,
    plant_event,
    state_of,
)
from teds_provision.station.station import Station
from teds_provision.teds.profile.firmware import FirmwareDemand


def read_firmware(node: Conversation, *, once: bool = False) -> FirmwareReading | None:
    """Ask a node which firmware it runs, once per session; None if it may not be asked here, or cannot answer now.

    ``once``: a single question, even if it or its answer is lost. Raises LinkError, and what a lost session raises.
    """
    session = node.open_counter if node.sealed else None
    if node.reported_firmware is not None and node.reported_firmware[0] == session:
        return FirmwareReading(node.reported_firmware[1], session is not None)
    if session is None and not node.wired and node.identity.state != NodeState.FACTORY:
        return None  # the node would refuse with 3
    try:
        payload = (node.request if once else node.request_idempotent)(ABOUT, "to report its firmware")
    except NodeRefusedError as refusal:
        if refusal.reason != Reason.UNKNOWN_COMMAND:
            return None
        report = None
    except (LinkError, GarbledError):
        if not once:
            raise
        return None
    else:
        report = decoded_report(payload)
    node.reported_firmware = (node.open_counter if node.sealed else None, report)
    return FirmwareReading(report, node.sealed)


class FirmwareError(PolicyError):
    """The firmware of a board is not what its type demands."""

    code = "firmware"


_REFUSED: Final[dict[FirmwareState, str]] = {
    "bad": "runs firmware that its type rules out",
    "other": "runs other firmware than its type",
    "outdated": "runs outdated firmware",
    "not-reported": "does not report its firmware",
}


def require_firmware(uuid: bytes, demand: FirmwareDemand | None, reading: FirmwareReading | None) -> None:
    """Refuse a board whose firmware its type does not accept, before it is keyed or signed; raises FirmwareError.

    An answer outside a session may refuse, never permit; None (it could not be asked) never refuses.
    """
    if demand is None or reading is None:
        return
    state = state_of(demand, reading.report)
    if state not in _REFUSED:
        return
    report, node = reading.report, uuid.hex()
    named = "" if report is None else f": {report.text} {report.version_text}+{report.build}"
    wanted = ", ".join(
        filter(None, (demand.text, f"at least {demand.minimum}" if demand.minimum and state == "outdated" else ""))
    )
    raise FirmwareError(
        f"Board {node} {_REFUSED[state]}{named}{f' (wanted: {wanted})' if wanted else ''}. Nothing was signed.",
        hint=f"Install other firmware in the same run: provision {node} --firmware IMAGE",
    )


def require_good_firmware(uuid: bytes, known: KnownFirmware | None) -> None:
    """Refuse a node to measure with whose firmware is not good (or unjudged, if its type demands none)."""
    state = known.state if known is not None else "not-reported"
    if state not in ("good", "unjudged"):
        raise FirmwareError(
            f"The firmware of node {uuid.hex()} is {state}.",
            hint=f"See nodes {uuid.hex()}; to install other firmware: update {uuid.hex()} IMAGE",
        )


def firmware_warning(known: KnownFirmware | None) -> str:
    """Return a measurement's warning about a node's firmware, "" for none."""
    if known is None or known.state in ("good", "unjudged"):
        return CHANGED if known is not None and known.changed else ""
    return f"its firmware is {known.state}" + (f", and {CHANGED}" if known.changed else "")


def keep_firmware(station: Station, uuid: bytes, reading: FirmwareReading | None, *, signed: bool = False) -> None:
    """Keep a node's answer. ``signed``: its datasheet was signed now, under this firmware.

    A change reported in a session becomes an event of the plant; an unauthenticated report is only stored here.
    """
    if reading is None:
        return
    with station.transaction():
        before = station.firmware_reports.get(uuid)
        after = station.firmware_reports.keep(uuid, reading.payload, in_session=reading.sealed, signed=signed)
        stated = plant_event(after)
        if not reading.sealed or stated is None or station.plant.joined is None:
            return
        if stated == plant_event(before):
            if not station.plant.reports_other_firmware(uuid, stated.runs, after.at):
                return
            # other firmware was reported in between, so this is news again
            after = station.firmware_reports.renew(after)
        station.plant.record_event("firmware", uuid, at=after.at, runs=stated.members)
