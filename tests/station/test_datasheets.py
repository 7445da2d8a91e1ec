"""Datasheets and drafts: octets once, ten older ones, found by sequence."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from datetime import date
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.station.datasheets import _first_due, packed, unpacked
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft, NodeReading, NodeRecord
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile

NODE = bytes.fromhex("0102030405060708090a")
BLOCKS = st.dictionaries(st.tuples(st.integers(0, 0xFFFF), st.integers(0, 255)), st.binary(max_size=300), max_size=12)


@given(BLOCKS)
def test_what_was_packed_comes_back(blocks: dict[tuple[int, int], bytes]) -> None:
    image = Image(NODE, blocks)
    assert unpacked(NODE, packed(image)) == image


@given(st.binary(max_size=200))
def test_what_was_not_packed_is_refused_with_value_error(octets: bytes) -> None:
    try:
        image = unpacked(NODE, octets)
    except ValueError:
        return
    assert unpacked(NODE, packed(image)) == image


def test_a_truncated_image_is_damage() -> None:
    with pytest.raises(ValueError):
        unpacked(NODE, packed(Image(NODE, {(0, 1): b"meta"}))[:-2])


def test_the_same_datasheet_is_kept_once(station: Station) -> None:
    image = Image(NODE, {(0, 1): b"meta"})
    assert station.datasheets.put(image, "finger")
    assert not station.datasheets.put(image)
    (only,) = station.datasheets.whole_history(NODE)
    assert (only.image, only.profile, only.digest) == (image, "finger", image.digest())


def test_the_present_one_and_ten_older_ones_are_kept(station: Station) -> None:
    images = [Image(NODE, {(0, 1): bytes([number])}) for number in range(15)]
    for image in images:
        station.datasheets.put(image)
    assert [record.image for record in station.datasheets.whole_history(NODE)] == images[:3:-1]
    assert station.datasheets.datasheet(NODE) == images[-1]


def test_a_datasheet_that_comes_back_is_the_present_one_again(station: Station) -> None:
    first, second = Image(NODE, {(0, 1): b"1"}), Image(NODE, {(0, 1): b"2"})
    for image in (first, second, first):
        station.datasheets.put(image)
    assert [record.image for record in station.datasheets.whole_history(NODE)] == [first, second, first]


@pytest.mark.parametrize(("named", "kept"), [(None, "of the draft"), ("of the node", "of the node")])
def test_a_draft_that_was_written_gives_its_datasheet_the_profile_and_goes(
    station: Station, named: str | None, kept: str
) -> None:
    image = Image(NODE, {(0, 1): b"x"})
    station.datasheets.keep_draft(Draft(NODE, image, profile="of the draft"))
    station.datasheets.keep_datasheet(Image(NODE, {(0, 1): b"another one"}))
    assert station.datasheets.draft(NODE) is not None
    station.datasheets.keep_datasheet(image, named)
    assert [record.profile for record in station.datasheets.history(NODE)] == [kept, None]
    assert station.datasheets.draft(NODE) is None


def test_after_a_restart_a_reading_is_of_its_session_and_no_longer_whole(station: Station) -> None:
    reading = NodeReading(NODE, "2026-11-27T12:00:00Z", "verify", bytes(8), True, b"digests")
    assert station.datasheets.keep_reading(reading)
    station.datasheets.started_anew(NODE, b"12345678")
    assert station.datasheets.reading(NODE) == replace(reading, c=b"12345678", whole=False)
    outside = replace(reading, c=None, by="identify")
    assert not station.datasheets.keep_reading(outside), "one outside a session takes the place of none of a session"
    assert station.datasheets.keep_reading(reading)
    assert station.datasheets.reading(NODE) == reading


def test_what_a_reading_says_of_itself() -> None:
    checks = json.dumps([["signed", "passed"], ["form", "failed", "why"], ["origin", "skipped"], ["ca", "unknown", ""]])
    reading = NodeReading(NODE, "2026-11-27T12:00:00Z", "verify", None, False, b"", checks=checks)
    assert reading.failed == {"form"}
    assert replace(reading, checks="[]").failed == frozenset()
    session = (1 << 64) - 2
    seen = [(None, False), (None, True), (session.to_bytes(8, "big"), False)]
    assert [(r.in_session, r.is_datasheet) for r in (replace(reading, c=c, whole=whole) for c, whole in seen)] == [
        (False, False), (False, True), (True, True)
    ]  # fmt: skip
    steps = (-1, 0, 1, 2, (1 << 32) - 1, 1 << 32)
    later = [((session + step) % (1 << 64)).to_bytes(8, "big") for step in steps]
    assert [replace(reading, c=seen[2][0]).is_of_this_start(c) for c in later] == [False, True, True, True, True, False]
    assert not reading.is_of_this_start(later[1])


def test_with_its_reading_a_node_that_was_reset_loses_its_firmware_report(station: Station) -> None:
    station.datasheets.keep_reading(NodeReading(NODE, "2026-11-27T12:00:00Z", "verify", None, False, b""))
    station.firmware_reports.keep(NODE, bytes(42), in_session=True)
    station.datasheets.forget_reading(NODE)
    assert (station.datasheets.reading(NODE), station.firmware_reports.get(NODE)) == (None, None)


def test_the_firmware_report_of_one_node_is_forgotten_and_no_other(station: Station) -> None:
    other = bytes(9) + b"x"
    for uuid in (NODE, other):
        station.firmware_reports.keep(uuid, bytes(42), in_session=True)
    station.firmware_reports.forget(NODE)
    assert [record.uuid for record in station.firmware_reports.all()] == [other]


def test_a_report_in_a_session_is_dated_anew_though_a_hint_said_the_same(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = [f"2026-11-27T12:00:0{second}Z" for second in range(4)]
    monkeypatch.setattr("teds_provision.station.firmware_reports.utc_now", iter(times).__next__)
    kept = [
        station.firmware_reports.keep(NODE, bytes(42), in_session=sealed)
        for sealed in (False, False, True, True, False)
    ]
    assert [(record.in_session, record.at) for record in kept] == [
        *[(False, times[0])] * 2,
        *[(True, times[1])] * 3,
    ]
    assert station.firmware_reports.keep(NODE, bytes(43), in_session=True).at == times[2]


def test_drafts_of_all_nodes_are_listed_and_dropped_one_by_one(station: Station) -> None:
    other = os.urandom(10)
    for uuid in (NODE, other):
        station.datasheets.keep_draft(Draft(uuid, Image(uuid, {(0, 1): b"x"}), profile="finger"))
    assert {draft.uuid for draft in station.datasheets.drafts()} == {NODE, other}
    assert station.datasheets.drop_draft(NODE)
    assert not station.datasheets.drop_draft(NODE)
    assert [draft.uuid for draft in station.datasheets.drafts()] == [other]


def test_a_node_costs_little_in_the_file(station: Station) -> None:
    """Issue 13 row 12: 5 kB with one datasheet, 2 KiB for each older one; signatures and digests do not deflate."""
    blocks = load_profile("tactile-finger-sensor").build(NODE).blocks
    nodes = 40

    def pages() -> int:
        return int(station._store.execute("PRAGMA page_count")[0][0]) * 4096

    def keep(version: int) -> int:
        before = pages()
        with station.transaction():
            for number in range(nodes):
                image = Image(bytes([number]) * 10, {**blocks, (0, 128): os.urandom(1200), (0, 12): bytes([version])})
                station.nodes.restore(NodeRecord(image.uuid, name=f"node {number}"))
                station.datasheets.put(image, "tactile-finger-sensor")
        return (pages() - before) // nodes

    assert keep(0) <= 5000
    assert max(keep(version) for version in range(1, 4)) <= 2048


@pytest.mark.parametrize("ends", [("2027-03-01", "2026-12-24"), ("2026-12-24", "2027-03-01"), ("2026-12-24", None)])
def test_a_datasheet_is_due_when_the_first_of_its_calibrations_ends(
    monkeypatch: pytest.MonkeyPatch, ends: tuple[str | None, ...]
) -> None:
    channels = [SimpleNamespace(due=None if day is None else date.fromisoformat(day)) for day in ends]
    sheet = SimpleNamespace(from_image=lambda _image: SimpleNamespace(channels=channels))
    monkeypatch.setattr("teds_provision.station.datasheets.teds", SimpleNamespace(sheet=SimpleNamespace(Sheet=sheet)))
    assert _first_due(Image(bytes(10), {(1, 5): b"a calibration"})) == "2026-12-24"
    assert _first_due(Image(bytes(10), {(1, 3): b"no calibration"})) is None
