"""What a virtual node reports as its firmware, and what its description keeps of it."""

from __future__ import annotations

from typing import Any

import pytest

from teds_provision.node import reported_firmware
from teds_provision.node.reported_firmware import ReportedFirmware, own_report, report_from_json, report_to_json
from teds_provision.protocol.messages.firmware import FirmwareFlag, FirmwareReport


@pytest.mark.parametrize(
    ("release", "version"),
    [
        ("2.1.3", (2, 1, 3)),
        ("2.1", (2, 1, 0)),
        ("3", (3, 0, 0)),
        ("2.1.3rc4", (2, 1, 3)),
        ("10.20.30.40", (10, 20, 30)),
    ],
)
def test_a_node_without_a_description_runs_this_package(
    monkeypatch: pytest.MonkeyPatch, release: str, version: tuple[int, int, int]
) -> None:
    monkeypatch.setattr(reported_firmware, "__version__", release)
    report = own_report()
    assert (report.text, report.version, report.build, report.image) == ("virtual/teds-provision", version, 0, None)
    assert report.flags == FirmwareFlag.LOCATE, "it can show itself, and takes no image"


WHOLE: dict[str, Any] = {
    "text": "nrf52840dk/sensor", "version": "1.2.3", "build": 77, "image": "ab" * 32,
    "flags": ["locate", "manage", "on_trial"],
}  # fmt: skip
FLAGS = FirmwareFlag.LOCATE | FirmwareFlag.MANAGE | FirmwareFlag.ON_TRIAL


@pytest.mark.parametrize(
    ("described", "report"),
    [
        (WHOLE, FirmwareReport("nrf52840dk/sensor", (1, 2, 3), 77, bytes.fromhex("ab" * 32), FLAGS)),
        ({**WHOLE, "image": None, "flags": []}, FirmwareReport("nrf52840dk/sensor", (1, 2, 3), 77)),
        ({**WHOLE, "text": "", "build": 0}, FirmwareReport("", (1, 2, 3), 0, bytes.fromhex("ab" * 32), FLAGS)),
    ],
)
def test_a_report_is_kept_in_the_description_of_a_node(described: dict[str, Any], report: FirmwareReport) -> None:
    assert report_from_json(described) == report
    kept = report_to_json(report)
    assert {**kept, "flags": sorted(kept["flags"])} == {**described, "flags": sorted(described["flags"])}


@pytest.mark.parametrize(
    ("change", "error"),
    [({"flags": ["blinks"]}, KeyError), ({"image": "xy"}, ValueError), ({"image": 7}, TypeError),
     ({"flags": None}, TypeError), ({"version": "one"}, ValueError)],
)  # fmt: skip
def test_a_description_of_firmware_that_is_none(change: dict[str, Any], error: type[Exception]) -> None:
    with pytest.raises(error):
        report_from_json({**WHOLE, **change})
    for name in WHOLE:
        with pytest.raises(KeyError):
            report_from_json({key: value for key, value in WHOLE.items() if key != name})


def test_a_node_answers_about_with_its_report_and_is_shown() -> None:
    shown: list[int] = []
    firmware = ReportedFirmware(own_report(), shown.append)
    assert firmware.about() == own_report()
    firmware.locate(7)
    assert shown == [7]
