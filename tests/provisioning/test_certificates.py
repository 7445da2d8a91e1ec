"""A calibration certificate takes every way that a calibration file takes, and leaves its trace on the node."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from teds_provision.errors import BadDataError, UsageError
from teds_provision.provisioning.batch_sheet import read_sheet
from teds_provision.provisioning.build import BuildOrder, prepare
from teds_provision.provisioning.datasheet_edit import without_stale_certificates
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.station.station import Station
from teds_provision.teds.calibration.zero import with_zero_offset
from teds_provision.teds.certificate import certificate_reference_of
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.image import Image
from tests.bench import Board, talk
from tests.teds.certificates import ANGLE, EXAMPLES, TEMPERATURE, changed

PROFILE = "magnetic-angular-position-sensor"
CERTIFICATE = (1, AccessCode.CERTIFICATE)


def run(station: Station, board: Board, calibration: Path | None, **more: object) -> ProvisionResult:
    order = replace(BuildOrder(PROFILE, calibration), **more)  # type: ignore[arg-type]
    with talk(board) as node:
        return provision(station, node, order, operator=AcceptingOperator(), reporter=SilentReporter())


def test_the_certificate_teds_is_signed_with_its_calibration_kept_with_it_and_goes_with_it(
    station: Station, board: Board, tmp_path: Path
) -> None:
    done = run(station, board, EXAMPLES / "angle.xml")
    assert done.verified.verdict == "authentic"
    reference = certificate_reference_of(done.image.blocks, 1)
    assert reference is not None
    assert reference == done.certificate
    assert (reference.number, reference.date) == ("B2-2026-0042", "2026-10-12")
    assert any("The certificate has no signature." in text for text in done.warnings)
    kept = run(station, board, None, name="left knee")
    assert kept.image.blocks[CERTIFICATE] == done.image.blocks[CERTIFICATE], "another name leaves the calibration"
    assert kept.certificate is None, "this run read none"
    again = run(station, board, EXAMPLES / "angle.xml", name="left knee")
    assert again.image.blocks == kept.image.blocks
    csv = tmp_path / "angle.csv"
    csv.write_text("# date: 2026-11-20\nraw, value [degree]\n0, 0\n65535, 360\n")
    after = run(station, board, csv)
    assert CERTIFICATE not in after.image.blocks
    assert after.verified.verdict == "authentic"
    assert CERTIFICATE not in run(station, board, None, drop_calibration=True).image.blocks


def test_an_edited_datasheet_keeps_the_certificate_only_of_the_same_curve(
    station: Station, board: Board, tmp_path: Path
) -> None:
    before = Image(board.uuid, run(station, board, EXAMPLES / "angle.xml").image.unsigned_blocks())
    place = (1, AccessCode.CALIBRATION)
    zeroed = {**before.blocks, place: with_zero_offset(before.blocks[place], -1.5, datetime(2026, 11, 26, tzinfo=UTC))}
    assert CERTIFICATE in without_stale_certificates(before, Image(board.uuid, zeroed)).blocks
    csv = tmp_path / "other.csv"
    csv.write_text((EXAMPLES / "angle.csv").read_text().replace("91.6", "91.5"))
    other = prepare(station, BuildOrder(PROFILE, csv))
    assert other.profile is not None
    exchanged = other.profile.build(board.uuid, calibration=other.calibrations).blocks[place]
    edited = Image(board.uuid, {**before.blocks, place: exchanged})
    assert CERTIFICATE not in without_stale_certificates(before, edited).blocks
    without = Image(board.uuid, {block: teds for block, teds in before.blocks.items() if block != place})
    assert CERTIFICATE not in without_stale_certificates(before, without).blocks


def test_a_certificate_for_one_channel_leaves_those_of_the_other_channels(station: Station, tmp_path: Path) -> None:
    board = Board()
    force = changed(
        ANGLE, (r"\degree", r"\newton"), ("271.4", "9.4"), ("181.9", "6.9"), ("91.6", "3.6"), ("2.1", "0.1")
    )
    (tmp_path / "one.xml").write_bytes(changed(force, ("B2-2026-0042", "first")))
    (tmp_path / "two.xml").write_bytes(changed(force, ("B2-2026-0042", "second")))

    def calibrate(file: str, channel: int) -> ProvisionResult:
        order = BuildOrder("tactile-finger-sensor", tmp_path / file, channel=channel, accept_calibration="a test")
        with talk(board) as node:
            return provision(station, node, order, operator=AcceptingOperator(), reporter=SilentReporter())

    calibrate("one.xml", 1)
    both = calibrate("two.xml", 2).image.blocks
    assert [getattr(certificate_reference_of(both, number), "number", None) for number in (1, 2, 3)] == [
        "first",
        "second",
        None,
    ]


def test_a_sheet_names_certificate_channel_and_item(station: Station, tmp_path: Path) -> None:
    (tmp_path / "t.xml").write_bytes(TEMPERATURE)
    (tmp_path / "a.csv").write_text("# date: 2026-11-20\nraw, value\n0, 0\n21120, 100\n")
    order = BuildOrder("temperature-sensor", accept_calibration="a test")
    file = tmp_path / "boards.csv"
    file.write_text("name,calibration,item\na,1=t.xml,as-left\nb,t.xml,as-found\nc,a.csv,\n")
    rows = read_sheet(station, file, order).rows
    numbers = [row.prepared.calibrations[1].certificate for row in rows if row.prepared.calibrations]
    assert [known.number if known else None for known in numbers] == ["T-2026-118", "T-2026-118", None]
    first, second = (row.prepared.calibrations[1].points[0][1] for row in rows[:2] if row.prepared.calibrations)
    assert (first, second) == (0.01, 0.02)
    assert rows[0].content["calibration"] != rows[1].content["calibration"]
    file.write_text("name,calibration\na,t.xml\n")
    with pytest.raises(BadDataError, match=r"2 results of .*t\.xml fit channel 1"):
        read_sheet(station, file, order)


def test_an_unclear_certificate_is_refused_before_a_node_is_waited_for(station: Station) -> None:
    with pytest.raises(UsageError, match="fit channel 1"):
        prepare(station, BuildOrder("temperature-sensor", EXAMPLES / "temperature.xml"))
