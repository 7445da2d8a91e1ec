"""UUIDs of both editions: published and worked ones, and random ones that must never be refused."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.errors import BadDataError


def parts_of(digits: str) -> teds.UuidParts:
    parts = teds.unpack_uuid(bytes.fromhex(digits))
    assert parts is not None
    return parts


def test_published_example_lies_in_hangzhou() -> None:
    parts = parts_of("8D4D9DA65281F7000000")
    assert parts.degrees == pytest.approx((30.2719, 120.1272), abs=1e-4)
    assert (parts.year, parts.time, parts.moment) == (2012, 0, datetime(2012, 1, 1))
    assert parts.plausible


def test_bit_of_east_is_taken_as_the_standard_has_it() -> None:
    assert parts_of("81C0F9744881F5622E78").degrees == pytest.approx((3.99, -105.89), abs=0.02)
    turin_with_the_bit_turned = parts_of("93CC201AF4C1F7442ACC")
    assert turin_with_the_bit_turned.degrees == pytest.approx((45.05, -7.67), abs=0.01)
    assert turin_with_the_bit_turned.year == 2013


def test_worked_example() -> None:
    parts = parts_of("94A964323E81FA8003E8")
    assert (parts.latitude, parts.longitude, parts.manufacturer) == (169260, 51450, 0)
    assert parts.moment == datetime(2026, 1, 1, 2, 46, 40)
    assert teds.UuidParts.at(47 + 1 / 60, 14 + 17.5 / 60, manufacturer=0, year=2026, seconds=10000) == parts


@pytest.mark.parametrize(("seconds", "units"), [(0, 0), (6, 0), (9.9, 0), (10, 1), (365 * 86400 - 0.1, 3153599)])
def test_a_moment_counts_whole_units_of_ten_seconds(seconds: float, units: int) -> None:
    """Rounded up, the last seconds of a year would be a moment of no year."""
    parts = teds.UuidParts.at(0, 0, manufacturer=0, year=2026, seconds=seconds)
    assert parts.time == units
    assert parts.moment is not None


def test_2024_form() -> None:
    parts = parts_of("86258A0B72F612D68707E8054911DCF0")
    assert (parts.edition, parts.north, parts.latitude, parts.east, parts.longitude) == (
        2024,
        True,
        402826,
        False,
        750326,
    )
    assert (parts.manufacturer, parts.year, parts.time) == (0x12D687, 2024, 0x054911DCF0)
    assert parts.degrees is None
    assert parts.moment is not None
    assert parts.moment.timetuple().tm_yday == 263
    assert parts.plausible


@given(st.one_of(st.binary(min_size=10, max_size=10), st.binary(min_size=16, max_size=16)))
def test_any_uuid_is_unpacked_and_packed_again(octets: bytes) -> None:
    parts = teds.unpack_uuid(octets)
    assert parts is not None
    assert teds.pack_uuid(parts) == octets
    assert parts.plausible in (True, False)


@given(st.binary(max_size=20).filter(lambda octets: len(octets) not in (10, 16)))
def test_other_lengths_give_nothing(octets: bytes) -> None:
    assert teds.unpack_uuid(octets) is None


@pytest.mark.parametrize("digits", ["333333333333FFFE3333", "FF" * 10, "00" * 10, "FF" * 16])
def test_random_octets_are_not_plausible(digits: str) -> None:
    assert not parts_of(digits).plausible


@pytest.mark.parametrize(
    ("part", "value"), [("latitude", 1 << 20), ("longitude", -1), ("year", 4096), ("time", 1 << 22)]
)
def test_parts_that_do_not_fit_are_named(part: str, value: int) -> None:
    with pytest.raises(BadDataError, match=part):
        teds.pack_uuid(replace(parts_of("8D4D9DA65281F7000000"), **{part: value}))


@pytest.mark.parametrize(
    ("changed", "plausible"),
    [
        ({"latitude": 90 * 3600}, True),
        ({"latitude": 90 * 3600 + 1}, False),
        ({"longitude": 180 * 3600}, True),
        ({"longitude": 180 * 3600 + 1}, False),
        ({"year": 1989}, False),
        ({"year": 1990}, True),
        ({"year": 2199}, True),
        ({"year": 2200}, False),
        ({"year": 2026, "time": 3_153_599}, True),
        ({"year": 2026, "time": 3_153_600}, False),
        ({"year": 2024, "time": 3_162_239}, True),
    ],
)
def test_a_place_on_earth_and_a_moment_of_its_year_are_plausible(changed: dict[str, int], plausible: bool) -> None:
    assert replace(parts_of("8D4D9DA65281F7000000"), **changed).plausible == plausible


@pytest.mark.parametrize(
    ("year", "time", "moment"),
    [
        (0, 0, None),
        (1, 0, datetime(1, 1, 1)),
        (2026, 3_153_599, datetime(2026, 12, 31, 23, 59, 50)),
        (2026, 3_153_600, None),
        (4095, 1, datetime(4095, 1, 1, 0, 0, 10)),
    ],
)
def test_a_moment_lies_in_its_year_or_is_none(year: int, time: int, moment: datetime | None) -> None:
    assert replace(parts_of("8D4D9DA65281F7000000"), year=year, time=time).moment == moment


def test_the_parts_stand_at_their_bits() -> None:
    """North 1, latitude 20, east 1, longitude 20, manufacturer 4, year 12, time 22, the most significant bit first."""
    widths = {"north": 1, "latitude": 20, "east": 1, "longitude": 20, "manufacturer": 4, "year": 12, "time": 22}
    none = dict.fromkeys(widths, 0)
    at = 80
    for part, width in widths.items():
        full = {**none, part: (1 << width) - 1}
        at -= width
        octets = (full[part] << at).to_bytes(10, "big")
        parts = teds.unpack_uuid(octets)
        assert parts is not None
        assert {name: int(getattr(parts, name)) for name in widths} == full
        assert teds.pack_uuid(parts) == octets
        if width > 1:
            with pytest.raises(BadDataError, match=f"The {part} of a 2007 UUID has {width} bits"):
                teds.pack_uuid(replace(parts, **{part: 1 << width}))
    assert at == 0
