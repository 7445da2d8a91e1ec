"""Rules of what a board reports of its firmware and of how it is found."""

from __future__ import annotations

from typing import Final

from teds_provision.check.probe import NotApplicableError, Probe, RuleBrokenError, demand, holds
from teds_provision.check.rule import Stage, rule
from teds_provision.errors import GarbledError
from teds_provision.protocol.messages.firmware import ABOUT, LOCATE_SECONDS, FirmwareFlag, FirmwareReport
from teds_provision.protocol.messages.frames import Command, Function, Reason, Reply, security_command

_SECTION: Final = "About and Locate"
_PARAMETERS: Final = bytes.fromhex("0800000100000006a0")
"""An SMP packet that every manager serves: read its parameters."""
_SECONDS: Final = 1


def _locate(*octets: int) -> Command:
    return security_command(Function.LOCATE, bytes(octets))


def _none(reply: Reply) -> bool:
    """Return True for the answer of a board that does not know About."""
    return not reply.ok and reply.reason == Reason.UNKNOWN_COMMAND


def _report(octets: bytes) -> FirmwareReport:
    try:
        report = FirmwareReport.decode(octets)
    except GarbledError as error:
        raise RuleBrokenError(f"About (128.21): {error.message}") from None
    holds(octets[1] & 0xC0 == 0, f"About (128.21): bits 6 and 7 of the flags are 0, these are {octets[1]:02x}.")
    return report


def _told(report: FirmwareReport) -> str:
    return f"{report.text or '(no text)'} {report.version_text}+{report.build}"


def _in_session(probe: Probe) -> FirmwareReport:
    """Return the board's report in a session; raises NotApplicableError for one that has none."""
    reply = probe.sealed(ABOUT)
    if _none(reply):
        raise NotApplicableError("The board does not report its firmware (128.21 gets 1).")
    holds(reply.ok, f"About (128.21) in a session: success is due, refusal {reply.reason} came.")
    return _report(reply.payload)


def _known(probe: Probe) -> Reply:
    """Return the answer to a plain About; raises NotApplicableError for a board that does not know it."""
    reply = probe.plain(ABOUT)
    if _none(reply):
        raise NotApplicableError("The board does not report its firmware (128.21 gets 1).")
    return reply


@rule("about", _SECTION, Stage.FACTORY)
def about(probe: Probe) -> str:
    """Check form, length and characters of a plain report; 4 for a payload."""
    reply = _known(probe)
    holds(reply.ok, f"About (128.21): success is due, refusal {reply.reason} came.")
    report = _report(reply.payload)
    probe.refused(security_command(Function.ABOUT, b"\0"), Reason.BAD_FORM, "one octet of payload")
    return _told(report)


@rule("about-keyed", _SECTION, Stage.KEYED)
def about_keyed(probe: Probe) -> str:
    """Check that a board with a key reports outside a session on its wired bus only: by NFC or BLE 3."""
    reply = _known(probe)
    if not probe.contact.link.capabilities.wired:
        return demand(reply, Reason.NOT_PERMITTED, "About (128.21) by radio, with a key")
    holds(reply.ok, f"About (128.21): success is due, refusal {reply.reason} came.")
    return _told(_report(reply.payload))


@rule("locate", _SECTION, Stage.FACTORY)
def locate(probe: Probe) -> str:
    """Check that a board without a key blinks for any station, at most a minute; one that cannot blink answers 1."""
    if FirmwareFlag.LOCATE not in _report(_known(probe).payload).flags:
        return probe.refused(_locate(_SECONDS), Reason.UNKNOWN_COMMAND, "a board without anything to blink")
    probe.good(_locate(_SECONDS))
    probe.good(_locate(0))
    for wrong in (_locate(), _locate(1, 1), _locate(LOCATE_SECONDS + 1)):
        seen = probe.refused(wrong, Reason.BAD_FORM, f"payload {wrong.payload.hex() or 'empty'}")
    return seen


@rule("locate-keyed", _SECTION, Stage.KEYED)
def locate_keyed(probe: Probe) -> str:
    """Check that a board with a key does not blink outside a session; the state is checked before the form."""
    _known(probe)
    probe.refused(_locate(_SECONDS), Reason.NOT_PERMITTED, "outside a session, with a key")
    return probe.refused(_locate(), Reason.NOT_PERMITTED, "no octet, outside a session, with a key")


@rule("manage-needs-session", _SECTION, Stage.PLAIN)
def manage_needs_session(probe: Probe) -> str:
    """Check that no packet passes outside a session, and that the state is checked before the form."""
    _known(probe)
    probe.refused(security_command(Function.MANAGE), Reason.NOT_PERMITTED, "no packet, outside a session")
    return probe.refused(security_command(Function.MANAGE, _PARAMETERS), Reason.NOT_PERMITTED, "outside a session")


@rule("about-in-session", _SECTION, Stage.SESSION)
def about_in_session(probe: Probe) -> str:
    """Check that the report comes in a session too, and Manage gets 1 if the report does not offer it."""
    report = _in_session(probe)
    probe.sealed_refused(security_command(Function.ABOUT, b"\0"), Reason.BAD_FORM, "one octet of payload")
    if FirmwareFlag.MANAGE not in report.flags:
        manage = security_command(Function.MANAGE, _PARAMETERS)
        probe.sealed_refused(manage, Reason.UNKNOWN_COMMAND, "bit 1 of the flags is 0")
    probe.close()
    return _told(report)


@rule("locate-in-session", _SECTION, Stage.SESSION)
def locate_in_session(probe: Probe) -> str:
    """Check that a board with a key blinks in a session, for at most a minute."""
    if FirmwareFlag.LOCATE not in _in_session(probe).flags:
        seen = probe.sealed_refused(_locate(_SECONDS), Reason.UNKNOWN_COMMAND, "a board without anything to blink")
    else:
        probe.sealed_good(_locate(_SECONDS))
        probe.sealed_good(_locate(0))
        for wrong in (_locate(), _locate(LOCATE_SECONDS + 1)):
            seen = probe.sealed_refused(wrong, Reason.BAD_FORM, f"payload {wrong.payload.hex() or 'empty'}")
    probe.close()
    return seen
