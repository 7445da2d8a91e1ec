"""The guard of every datasheet before it is signed, written or believed: a calibration that would hurt is refused."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from teds_provision import teds
from teds_provision.errors import PolicyError
from teds_provision.station.station import Station
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.image import Image


def guard(
    station: Station,
    image: Image,
    has: Image | None,
    accepted: str | None,
    calibrations: Mapping[int, teds.calibration.Calibration] | None = None,
    profile: teds.profile.Profile | None = None,
    *,
    record: bool = True,
    expected: Collection[str] = (),
) -> tuple[str, ...]:
    """Refuse a calibration that would hurt (exit 6), unless a reason was given to accept it; return warnings.

    That reason goes into the audit log, unless ``record`` is False (dry run). ``expected`` are codes of warnings about
    what was ordered, which are suppressed.
    """
    if not is_calibrated(image, has):
        return ()
    old = has.unsigned_blocks() if has is not None else None
    findings = teds.guard.check_calibration(image.unsigned_blocks(), old, profile, calibrations=calibrations)
    errors = [_finding_text(finding) for finding in findings if finding.severity == "error"]
    if errors and accepted is None:
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        raise PolicyError(
            f"The calibration is refused: {errors[0]}{more}.",
            hint='Fix it; or, if it is correct, give a reason: --accept-calibration "why".',
        )
    if errors and record:
        station.audit("accept-calibration", image.uuid, "accepted", why=accepted, findings=errors)
    return merged(
        tuple(
            _finding_text(finding)
            for finding in findings
            if finding.severity == "error" or finding.code not in expected
        )
    )


def is_calibrated(*images: Image | None) -> bool:
    """Return True if one of these datasheets has a teds.calibration.Calibration TEDS."""
    return any(code == AccessCode.CALIBRATION for image in images for _, code in image or ())


def merged(warnings: Sequence[str]) -> tuple[str, ...]:
    """Return warnings, with the same one for several channels in one line: ``Channels 1 to 12: …``."""
    order: list[tuple[str, str]] = []
    channels: dict[tuple[str, str], list[int]] = {}
    for text in warnings:
        head, number, rest = _of_channel(text)
        if (head, rest) not in channels:
            order.append((head, rest))
        channels.setdefault((head, rest), [])
        if number is not None and number not in channels[head, rest]:
            channels[head, rest].append(number)
    return tuple(_joined(head, channels[head, rest], rest) for head, rest in order)


def _of_channel(text: str) -> tuple[str, int | None, str]:
    """Split ``Channel 3 (force): x`` into ("Channel", 3, ": x"); the name of the channel does not matter."""
    head, _, rest = text.partition(" ")
    digits = len(rest) - len(rest.lstrip("0123456789"))
    if head.lower() != "channel" or not digits:
        return text, None, ""
    number, rest = int(rest[:digits]), rest[digits:]
    if rest.startswith(" (") and ")" in rest:
        rest = rest[rest.index(")") + 1 :]
    return head, number, rest


def _joined(head: str, numbers: list[int], rest: str) -> str:
    if not numbers:
        return head
    if len(numbers) == 1:
        return f"{head} {numbers[0]}{rest}"
    whole = numbers == list(range(numbers[0], numbers[-1] + 1))
    text = f"{numbers[0]} to {numbers[-1]}" if whole else ", ".join(map(str, numbers))
    if rest.startswith(" has "):
        rest = f" have {rest.removeprefix(' has ')}"
    return f"{head}s {text}{rest}"


def _finding_text(finding: teds.guard.GuardFinding) -> str:
    return f"channel {finding.channel}: {finding.message}"
