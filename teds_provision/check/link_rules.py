"""Rules of the link itself, for links whose frames were recorded: ISO-TP on CAN, ISO-DEP and TNEP over NFC.

They change nothing on the node.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from teds_provision.check.probe import OVER_CAN, OVER_NFC, HeardFrame, NotApplicableError, Probe, holds
from teds_provision.check.rule import Stage, rule
from teds_provision.links.can.isotp import OVERFLOW, addresses, gap_seconds, read_single
from teds_provision.links.ports import AnnouncingLink, MultiStationLink
from teds_provision.protocol.messages.frames import Reason, refusal, write_teds
from teds_provision.teds.image import SECURITY

_SINGLE, _FIRST, _CONSECUTIVE, _FLOW = range(4)
_OVERFLOW: Final = OVERFLOW & 0xF
_HALF_SENT: Final = 200
_GIVEN_UP: Final = 1.2
_WTX: Final = 0xF2
_MOST_WTX: Final = 59


_LONG: Final = write_teds(0, 12, 0, bytes(96))
"""Takes several frames, in FD too; refused outside a session."""


def _of_the_node(probe: Probe) -> tuple[HeardFrame, list[HeardFrame]]:
    """Return the first CAN frame of a request, and the node's frames of a long request and a long answer."""
    if probe.heard is None or probe.contact.address is None:
        raise NotApplicableError(f"A rule of CAN. {OVER_CAN}")
    began = len(probe.heard.frames)
    probe.plain(_LONG)
    probe.teds(SECURITY)
    frames = probe.heard.frames[began:]
    asked = next(frame for frame in frames if frame.direction == "out")
    return asked, [frame for frame in frames if _is_from(frame, probe.contact.address)]


def _is_from(frame: HeardFrame, node: int) -> bool:
    ends = addresses(frame.identifier) if frame.identifier is not None else None
    return frame.direction == "in" and bool(frame.octets) and ends is not None and ends[1] == node


def _used(frames: list[HeardFrame]) -> Iterator[tuple[HeardFrame, int]]:
    """Yield each frame with the number of its octets in use (ISO 15765-2, N_PDU table).

    After a frame that was lost or heard twice, the rest of that message is left out.
    """
    left = number = 0
    for frame in frames:
        data = frame.octets
        kind, low = data[0] >> 4, data[0] & 0xF
        if kind == _SINGLE:
            yield frame, 1 + low if low else 2 + data[1]
        elif kind == _FIRST:
            left, number = (low << 8 | data[1]) - (len(data) - 2), 0
            yield frame, len(data)
        elif kind == _FLOW:
            yield frame, 3
        elif left > 0 and low == (number + 1) % 16:
            yield frame, 1 + min(left, len(data) - 1)
            left, number = left - (len(data) - 1), low
        else:
            left = 0


@rule("can-flow-control", "CAN", Stage.PLAIN)
def can_flow_control(probe: Probe) -> str:
    """Check that flow control is well formed; block size, STmin and padding are the node's choice and are reported.

    A reserved STmin counts as 127 ms (ISO 15765-2, table of STmin).
    """
    _, frames = _of_the_node(probe)
    controls = {frame.octets for frame in frames if frame.octets[0] >> 4 == _FLOW}
    wrong = " ".join(sorted(control.hex() for control in controls if len(control) < 3 or control[0] & 0xF > _OVERFLOW))
    holds(not wrong, f"Flow control {wrong}: 30 to 32, block size and STmin are due.")
    asked = {
        f"block size {control[1]}, STmin {gap_seconds(control[2]) * 1000:g} ms"
        for control in controls
        if control[0] & 0xF == 0
    }
    padding = {octet for frame, used in _used(frames) for octet in frame.octets[used:]}
    return f"{', '.join(sorted(asked))}; padding {' '.join(f'{octet:02X}' for octet in sorted(padding)) or 'none'}"


@rule("can-busy", "CAN", Stage.PLAIN)
def can_busy(probe: Probe) -> str:
    """Check that during another station's long request a first frame gets a flow control, or a single frame with 17."""
    other = probe.from_station(1).line
    assert isinstance(other, MultiStationLink)
    first = probe.bus.begin(_HALF_SENT)
    holds(
        first[:1] == b"\x30",
        f"The first frame of {_HALF_SENT} octets: {first.hex() or 'nothing'} came, not a flow control.",
    )
    second = other.begin(_HALF_SENT)
    refused = read_single(second)
    fine = second[:1] in (b"\x30", b"\x31") or (refused is not None and refused[1:] == refusal(Reason.BUSY).encode())
    came = second.hex() or "nothing"
    due = "a flow control, or a single frame with refusal 17, is due"
    holds(fine, f"A second station's first frame beside another's long request: {came} came; {due}.")
    probe.pause(_GIVEN_UP)  # past N_Cr, the node drops both unfinished messages
    return probe.refused(_LONG, Reason.NOT_PERMITTED, "a long request after it") + (
        "; 17 for the second" if refused is not None else "; both taken up"
    )


@rule("can-form", "CAN", Stage.PLAIN)
def can_form(probe: Probe) -> str:
    """Check that the node answers in the form of the request: classic or FD."""
    asked, frames = _of_the_node(probe)
    form = {True: "CAN FD", False: "classic CAN"}
    same = all(frame.fd == asked.fd for frame in frames)
    holds(same, f"Asked in {form[asked.fd]} it answered in {form[not asked.fd]}.")
    return f"asked and answered in {form[asked.fd]}"


@rule("nfc-wait-time", "NFC", Stage.PLAIN)
def nfc_wait_time(probe: Probe) -> str:
    """Check that the service record announces a WT_INT that is a multiple of 4."""
    link = probe.contact.link
    if not isinstance(link, AnnouncingLink):
        raise NotApplicableError(f"A rule of NFC. {OVER_NFC}")
    wt_int = link.announced["WT_INT"]
    holds(wt_int % 4 == 0, f"WT_INT is {wt_int}: implementations round what is no multiple of 4 differently.")
    return ", ".join(f"{name} {value}" for name, value in link.announced.items())


@rule("nfc-wtx", "NFC", Stage.PLAIN)
def nfc_wtx(probe: Probe) -> str:
    """Check that an S(WTX) asks for 1 to 59 times the frame waiting time (ISO/IEC 14443-4, clause 7.3)."""
    blocks = (
        [frame.octets for frame in probe.heard.frames if frame.direction == "in"] if probe.heard is not None else []
    )
    asked = {block[1] & 0x3F for block in blocks if len(block) == 2 and block[0] == _WTX}
    if probe.contact.address is not None:
        raise NotApplicableError(f"A rule of NFC. {OVER_NFC}")
    if not asked:
        raise NotApplicableError("The board never asked for more time, so there is no S(WTX) to look at.")
    wrong = sorted(asked - set(range(1, _MOST_WTX + 1)))
    holds(not wrong, f"S(WTX) with multiplier {', '.join(map(str, wrong))}: 1 to {_MOST_WTX} are allowed.")
    return f"multiplier {', '.join(map(str, sorted(asked)))}"


@rule("identify-found", "Identify, Prove, List", Stage.PLAIN)
def identify_found(probe: Probe) -> str:
    """Check that the id record (NFC) or functional Identify (CAN) that found the node agrees with Identify."""
    found, now = probe.contact.identity, probe.identity()
    holds(found == now, f"The node was found as {found}; Identify says {now}.")
    return "the same when it was found and when it is asked"
