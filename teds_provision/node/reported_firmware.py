"""Report of a virtual node's firmware (128.21), from its description, and its reaction to being located (128.22)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from teds_provision import __version__
from teds_provision.protocol.messages.firmware import FirmwareFlag, FirmwareReport, parse_version


def own_report() -> FirmwareReport:
    """Return the report of a node whose description names no firmware: this package is what runs on it."""
    release = "".join(c if c.isdigit() else " " for c in __version__).split()
    version = parse_version(".".join([*release, "0", "0", "0"][:3]))
    return FirmwareReport("virtual/teds-provision", version, flags=FirmwareFlag.LOCATE)


def report_from_json(described: Mapping[str, Any]) -> FirmwareReport:
    """Read the member ``firmware`` of a node's description; raises KeyError, TypeError, ValueError."""
    image = described["image"]
    flags = FirmwareFlag(0)
    for name in described["flags"]:
        flags |= FirmwareFlag[name.upper()]
    return FirmwareReport(
        described["text"],
        parse_version(described["version"]),
        described["build"],
        None if image is None else bytes.fromhex(image),
        flags,
    )


def report_to_json(report: FirmwareReport) -> dict[str, Any]:
    """Return the member ``firmware`` of a node's description."""
    return {
        "text": report.text,
        "version": report.version_text,
        "build": report.build,
        "image": None if report.image is None else report.image.hex(),
        "flags": [str(flag.name).lower() for flag in FirmwareFlag if flag in report.flags],
    }


@dataclass(frozen=True)
class ReportedFirmware:
    """The firmware of a virtual node: ``report`` is its answer to About, ``located`` shows a person the board."""

    report: FirmwareReport
    located: Callable[[int], None]

    def about(self) -> FirmwareReport | None:
        """Return the report; see Firmware."""
        return self.report

    def locate(self, seconds: int) -> None:
        """Blink; see Firmware."""
        self.located(seconds)
