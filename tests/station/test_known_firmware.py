"""What is known of a node's firmware, which two reports are of one image, and what the plant hears of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from teds_provision.protocol.messages.firmware import FirmwareFlag, FirmwareReport
from teds_provision.station.firmware import (
    FirmwareReading,
    KnownFirmware,
    PlantFirmware,
    decoded_report,
    known_firmware,
    plant_event,
    release_of,
    same_firmware,
)
from teds_provision.station.store.records import FirmwareRecord

ONE, TWO = b"\x11" * 32, b"\x22" * 32
AT = "2026-01-31T12:00:00Z"


def report(image: bytes | None = None, **changes: Any) -> FirmwareReport:
    return replace(FirmwareReport("board/app", (1, 2, 3), 4, image), **changes)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        (None, None, True),
        (None, report(), False),
        (report(), None, False),
        (report(), report(), True),
        (report(ONE), report(ONE, text="x", version=(9, 9, 9), build=9), True),  # the digest alone
        (report(ONE), report(TWO), False),
        (report(ONE), report(), False),  # one of them has none
        (report(), report(ONE), False),
        (report(), report(text="board/other"), False),
        (report(), report(version=(1, 2, 4)), False),
        (report(), report(build=5), False),
        (report(), report(flags=FirmwareFlag.PENDING), True),
    ],
)
def test_which_reports_are_of_one_image(one: FirmwareReport | None, other: FirmwareReport | None, same: bool) -> None:
    assert same_firmware(one, other) is same


def record(
    now: FirmwareReport | None, signed: FirmwareReport | str | None = "never", *, session: bool = True
) -> FirmwareRecord:
    kept = None if signed == "never" else b"" if signed is None else signed.encode()  # type: ignore[union-attr]
    return FirmwareRecord(bytes(10), b"" if now is None else now.encode(), session, AT, kept)


@pytest.mark.parametrize(
    ("kept", "changed"),
    [
        (record(report(ONE)), False),  # it was never signed
        (record(report(ONE), report(ONE)), False),
        (record(report(ONE), report(TWO)), True),
        (record(report(ONE), report(TWO), session=False), False),  # a hint shows no change
        (record(None, report(TWO)), True),  # it reports none any more
        (record(report(ONE), None), True),
        (record(None, None), False),
    ],
)
def test_a_change_since_the_signature_is_seen_in_sessions_alone(kept: FirmwareRecord, changed: bool) -> None:
    known = known_firmware(kept, lambda: None)
    assert known is not None
    assert (known.changed, known.state, known.reading.sealed) == (changed, "unjudged", kept.in_session)


def test_an_answer_of_now_goes_before_what_is_kept() -> None:
    assert known_firmware(None, lambda: None) is None
    now = FirmwareReading(report(TWO), sealed=True)
    fresh = known_firmware(None, lambda: None, now)
    assert fresh == KnownFirmware(now, "unjudged", changed=False)
    known = known_firmware(record(report(ONE), report(ONE)), lambda: None, now)
    assert known is not None
    assert (known.reading, known.changed) == (now, True)
    plain = known_firmware(record(report(ONE), report(ONE)), lambda: None, FirmwareReading(report(TWO), sealed=False))
    assert plain is not None
    assert not plain.changed


def test_firmware_as_json() -> None:
    known = KnownFirmware(FirmwareReading(report(ONE), sealed=True), "good", changed=True)
    assert known.to_json() == {
        "text": "board/app", "version": "1.2.3", "build": 4, "image": "11" * 32, "state": "good", "from": "session",
        "changed": True,
    }  # fmt: skip
    known = KnownFirmware(FirmwareReading(report(), sealed=False), "bad")
    assert (known.to_json()["image"], known.to_json()["from"], known.to_json()["changed"]) == (None, "plain", False)
    none = KnownFirmware(FirmwareReading(None, sealed=True), "not-reported").to_json()
    assert [none[name] for name in ("text", "version", "build", "image")] == [None] * 4
    assert release_of(report()) == (1, 2, 3, 4)
    assert FirmwareReading(None, sealed=True).payload == b""
    assert decoded_report(b"x" * 42) is None


def test_what_the_plant_hears_of_firmware() -> None:
    assert plant_event(None) is None
    assert plant_event(record(report(ONE), session=False)) is None, "a hint"
    assert plant_event(record(None)) == PlantFirmware(None)
    assert plant_event(record(report(ONE, flags=FirmwareFlag.ON_TRIAL))) is None, "it may be gone after a restart"
    said = plant_event(record(report(ONE, flags=FirmwareFlag.PENDING)))
    assert said is not None
    assert said.members == ["board/app", "1.2.3+4", "11" * 32]
    assert PlantFirmware(None).members is None
