"""What a calibration file may look like, what it then says of each channel, and how a mistake in it is named."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone

import pytest

from teds_provision.errors import BadDataError
from teds_provision.teds.calibration import Calibration, CalibrationInput, load_calibrations, read_calibrations
from teds_provision.teds.calibration.files import CSV_KEYS, CsvTable, Row, fit_points, read_csv
from teds_provision.teds.certificate import CertificateChoice
from teds_provision.teds.profile import Profile, load_profile


@pytest.fixture(scope="module")
def angle() -> Profile:
    return load_profile("magnetic-angular-position-sensor")


@pytest.fixture(scope="module")
def finger() -> Profile:
    return load_profile("tactile-finger-sensor")


def table(text: str) -> CsvTable:
    return read_csv(text, "c.csv", CSV_KEYS)


def pairs(text: str) -> list[tuple[float, ...]]:
    return [row.values for row in table(text).rows]


@pytest.mark.parametrize(
    "text",
    [
        "1,2\n3,4.5\n",
        "1;2\n3;4,5\n",
        "1;2,0\n3;4,5\n",
        "1\t2\n3\t4,5\n",
        "1 2\n3   4.5\n",
        "1, 2\n\n ,;\n3, 4.5,,\n",
        '"1","2"\n"3","4.5"\n',
        "raw,value\n0x1,2\n0X3,4.5\n",
        "value;raw\n2;1\n4,5;3\n",
        "# a remark\nADC, Torque [N]\n1,2\n3,4.5\n",
        "value,x,#\n2,1,why\n4.5,3\n",
        "a,b\n1,2\n3,4.5\n",
    ],
)
def test_the_same_two_points_in_each_form_that_instruments_write(text: str) -> None:
    assert pairs(text) == [(1.0, 2.0), (3.0, 4.5)]


def test_a_table_keeps_the_line_of_each_row_its_unit_and_its_metadata() -> None:
    text = "# Date : 2026-10-31\n# zero offset: 1 \n# note: no key\n\nch,Raw,Force (mN),# by\n2,0,0,me\n1,5,6\n"
    found = table(text)
    assert found.metadata == {"date": ("2026-10-31", 1), "zero-offset": ("1", 2)}
    assert (found.unit, found.segments) == (("mN", 5), False)
    assert found.rows == [Row(6, 2, (0.0, 0.0)), Row(7, 1, (5.0, 6.0))]
    assert found.by_channel() == {2: [found.rows[0]], 1: [found.rows[1]]}
    segments = table("to,from,offset,c0,c1,channel\n1,0,5,6,7,3\n")
    assert (segments.segments, segments.unit) == (True, None)
    assert segments.rows == [Row(2, 3, (0.0, 1.0, 5.0, 6.0, 7.0))]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# by: me\n", "c.csv:1: the file holds no points."),
        ("# a\nraw,value\n", "c.csv:2: the file holds a header and no points."),
        ("1,2,3\n", "c.csv:1: 3 columns and no header."),
        (
            "raw,value,more\n1,2,3\n",
            "c.csv:1: the header names 3 columns besides the channel; raw value and value are two.",
        ),
        ("ch,raw\n1,2\n", "c.csv:1: the header names 1 columns besides the channel; raw value and value are two."),
        ("raw,value\n1,2,3\n", "c.csv:2: 3 columns where 2 are expected."),
        ("raw,value,ch\n1,2\n", "c.csv:2: 2 columns where 3 are expected."),
        ("raw,value,#\n1,2,3,4\n", "c.csv:2: 4 columns where 3 are expected."),
        ("raw,value\n1\n", "c.csv:2: 1 columns where 2 are expected."),
        ("raw,value\n1,2.x\n", 'c.csv:2: value: "2.x" is not a number.'),
        ("raw,value\n1_0,2\n", 'c.csv:2: raw: "1_0" is not a number.'),
        ("raw,value\n1,inf\n", 'c.csv:2: value: "inf" is not a number.'),
        (f"raw,value\n0x{'f' * 300},1\n", f'c.csv:2: raw: "0x{"f" * 38}" is not a number.'),
        (
            f"1,0x{'f' * 300},3\n1,2,3\n",
            "c.csv:1: the header names 3 columns besides the channel; raw value and value are two.",
        ),
        ("raw;value\n1;1,000,5\n", 'c.csv:2: value: "1,000,5" is not a number.'),
        (f"raw,value\n1,{'y' * 50}\n", f'c.csv:2: value: "{"y" * 40}" is not a number.'),
        ("ch,raw,value\n1.5,1,2\n", 'c.csv:2: channel: "1.5" is not the number of a channel.'),
        ("ch,raw,value\n123456,1,2\n", 'c.csv:2: channel: "123456" is not the number of a channel.'),
        ("ch,raw,value\n²,1,2\n", 'c.csv:2: channel: "²" is not the number of a channel.'),
        ("# date: 1\n# DATE: 2\n1,2\n", "c.csv:2: date: given twice."),
        ("# intervall: 1 year\n1,2\n", 'c.csv:1: intervall: there is no such key. Did you mean "interval"?'),
        ("from,to,offset,c0,c0\n0,1,0,1,2\n", 'c.csv:1: the column "c0" appears twice.'),
        (
            "from,to,offset,c1\n0,1,0,1\n",
            'c.csv:1: "c1" is no column: a table of segments has from, to, offset, c0, c1 and so on.',
        ),
        (
            "from,to,offset\n0,1,0\n",
            'c.csv:1: the column "c0" is missing: a table of segments has from, to, offset, c0, c1 and so on.',
        ),
        (f"1,2\n3,{'4' * 20_000}\n", "c.csv:2: the line has more than 20000 characters."),
        ("1,2\n" * 200_001, "c.csv:200001: more than 200000 lines."),
    ],
)
def test_a_mistake_in_a_csv_is_named_with_its_line(text: str, message: str) -> None:
    with pytest.raises(BadDataError) as refused:
        table(text)
    assert refused.value.message == message


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("1,2,3\n", 'Name them in the first line: "raw, value" or "channel, raw, value".'),
        ("# by: me\n", "It takes lines of raw value and value, like: 512, 10.5"),
    ],
)
def test_a_file_that_is_no_table_of_points_is_answered_with_how_one_looks(text: str, hint: str) -> None:
    with pytest.raises(BadDataError) as refused:
        table(text)
    assert refused.value.hint == hint


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        ("slope = 1\nslop = 2\n", "c.toml", 'c.toml:2: slop: there is no such key. Did you mean "slope"?'),
        ("slope = 1\nqqq = 2\n", "c.toml", "c.toml:2: qqq: there is no such key. Known are: channel, date, interval,"),
        ("slope = true\n", "c.toml", "c.toml:1: slope: a number is expected, not True."),
        ("slope = 'nan'\n", "c.toml", "c.toml:1: slope: a number is expected, not 'nan'."),
        ("coefficients = []\n", "c.toml", "c.toml:1: coefficients: a list of numbers is expected, not []."),
        (
            "coefficients = [1, true]\n",
            "c.toml",
            "c.toml:1: coefficients: a list of numbers is expected, not [1, True].",
        ),
        (
            "coefficients = [1]\nboundaries = [0, 1, 2]\n",
            "c.toml",
            "c.toml:1: coefficients: 1 are too few for 2 segments.",
        ),
        (
            "coefficients = [1, 2]\nboundaries = [0, 0]\n",
            "c.toml",
            "c.toml:2: boundaries: the boundaries of the segments must ascend.",
        ),
        (
            "slope = 1\nlow-limit = 1\nhigh-limit = 1\n",
            "c.toml",
            "c.toml:2: low-limit: it must be below the high limit.",
        ),
        ("slope = 1\ndegree = 1.5\n", "c.toml", "c.toml:2: degree: a whole number from 0 to 255 is expected, not 1.5."),
        ("slope = 1\ndegree = 256\n", "c.toml", "c.toml:2: degree: a whole number from 0 to 255 is expected, not 256."),
        ("slope = 1\ndegree = -1\n", "c.toml", "c.toml:2: degree: a whole number from 0 to 255 is expected, not -1."),
        (
            "slope = 1\nmethod = 'steps2'\n",
            "c.toml",
            "c.toml:2: method: 'steps2' is no method. Did you mean \"steps\"?",
        ),
        (
            "slope = 1\nmethod = 'q'\n",
            "c.toml",
            "c.toml:2: method: 'q' is no method. One of linear, polynomial, table, steps is expected.",
        ),
        (
            "slope = 1\nunit = 'N'\n",
            "c.toml",
            'c.toml:2: unit: "N" is not of the same kind as "degree" of the channel.',
        ),
        (
            "slope = 1\nuncertainty = '1 N'\n",
            "c.toml",
            'c.toml:2: uncertainty: "N" is not of the same kind as "degree".',
        ),
        ("slope = 1\nuncertainty = 'x mrad'\n", "c.toml", "c.toml:2: uncertainty: a number is expected, not 'x'."),
        ("slope = 1\nuncertainty = '-1 mrad'\n", "c.toml", "c.toml:2: uncertainty: it must not be negative."),
        (
            "slope = 1\ndate = '31.10.2026'\n",
            "c.toml",
            'c.toml:2: date: "31.10.2026" is not a date; write it like 2026-10-31.',
        ),
        ("slope = 1\ndate = 7\n", "c.toml", "c.toml:2: date: a date like 2026-10-31 is expected, not 7."),
        (
            "slope = 1\ndate = 2106-01-01\n",
            "c.toml",
            "c.toml:2: date: a TEDS can say the years 1970 to 2105, not 2106.",
        ),
        (
            "slope = 1\ndate = 1969-12-31\n",
            "c.toml",
            "c.toml:2: date: a TEDS can say the years 1970 to 2105, not 1969.",
        ),
        ("slope = 1\ninterval = 0\n", "c.toml", "c.toml:2: interval: 0 is not a time that a TEDS can hold."),
        (
            "slope = 1\ninterval = 4294967296\n",
            "c.toml",
            "c.toml:2: interval: 4294967296 is not a time that a TEDS can hold.",
        ),
        (
            "slope = 1\nchannel = '1-2'\n",
            "c.toml",
            "c.toml:2: channel: magnetic-angular-position-sensor has channel 1, not 1-2.",
        ),
        (
            "slope = 1\nchannel = true\n",
            "c.toml",
            'c.toml:2: channel: a channel is a number, a range like 1-12, or "all", not True.',
        ),
        (
            "slope = 1\ncoefficients = [1]\n",
            "c.toml",
            "c.toml:1: slope: only one of slope, coefficients can be the calibration.",
        ),
        (
            "inputs = 3\ncoefficients = [1]\n",
            "c.toml",
            "c.toml:1: inputs: tables [[inputs]] with channel, degree, boundaries and offsets are expected.",
        ),
        ("points = [[1, 2], [3]]\n", "c.toml", "c.toml:1: points: point 2 is not a pair of numbers [raw, value]."),
        ("points = []\n", "c.toml", "c.toml:1: points: a list of pairs [raw, value] is expected."),
        (
            "by = 'x'\n",
            "c.toml",
            "c.toml:1: there is nothing to calibrate with: points, coefficients, or slope and intercept.",
        ),
        (
            '{\n"by": 1,\n"slope":\n2, "degree": 0.5}',
            "c.json",
            "c.json:4: degree: a whole number from 0 to 255 is expected, not 0.5.",
        ),
        ("by = 'x'\n[slope]\na = 1\n", "c.toml", "c.toml:2: slope: a value is expected here, not a table."),
        ('{"by": 1,\n"slope": {"a": 1}}', "c.json", "c.json:2: slope: a value is expected here, not a table."),
        (
            "by = 'x'\n[calibration]\nslope = 1\n",
            "c.toml",
            "c.toml:2: calibration: tables [[calibration]] are expected.",
        ),
        ("calibration = 3\n", "c.toml", "c.toml:1: calibration: tables [[calibration]] are expected."),
        (
            "slope = 1\nuncertainty = '1 qq'\n",
            "c.toml",
            'c.toml:2: uncertainty: "qq" is not a unit. Write it like "degree", "N",',
        ),
        (
            "slope = 1\ninterval = '1 qq'\n",
            "c.toml",
            'c.toml:2: interval: "qq" is not a unit. Write it like "degree", "N",',
        ),
        ("slope = 1\nunit = 'qq'\n", "c.toml", 'c.toml:2: unit: "qq" is not a unit. Write it like "degree", "N",'),
        (
            "from,to,offset,c0\n0,1,0,5\n1,2,0,5\n3,4,0,6\n",
            "c.csv",
            "c.csv:4: from: the segment does not begin where the last one ends.",
        ),
    ],
)
def test_a_mistake_in_what_a_file_says_is_named_with_its_place(
    text: str, name: str, message: str, angle: Profile
) -> None:
    with pytest.raises(BadDataError) as refused:
        read_calibrations(text, name, angle)
    assert refused.value.message.startswith(message)


def test_an_uncertainty_with_a_unit_is_the_same_for_every_channel_of_the_file(finger: Profile) -> None:
    """200 mN became 200 N for all channels but the first."""
    text = "# channel: 1-3\n# uncertainty: 200 mN\n0,0\n65535,10\n"
    found = read_calibrations(text, "c.csv", finger)
    assert {number: calibration.uncertainty for number, calibration in found.items()} == {
        number: pytest.approx(0.2) for number in (1, 2, 3)
    }


def test_each_word_of_a_file_is_in_the_calibration(angle: Profile) -> None:
    text = """
date = 2026-10-31
interval = "180 d"
method = "polynomial"
unit = "mrad"
uncertainty = "1 degree"
zero-offset = 4
low-limit = -5
high-limit = 6
by = "me"
coefficients = [1.0, 2.0, 3.0]
boundaries = [0, 100]
offsets = [50]
"""
    found = read_calibrations(text, "c.toml", angle)[1]
    assert found.inputs == (CalibrationInput(1, 2, (0.0, 100.0), (50.0,)),)
    assert (found.method, found.coefficients, found.unit.text) == ("polynomial", (1.0, 2.0, 3.0), "mrad")
    assert (found.zero_offset, found.low_limit, found.high_limit, found.by) == (4.0, -5.0, 6.0, "me")
    assert found.uncertainty == pytest.approx(math.radians(1) * 1000)
    assert (found.date, found.interval) == (datetime(2026, 10, 31, tzinfo=UTC), 180 * 86400.0)
    assert found.raw_range == angle.channels[0].calibration.raw_range
    assert found.monotone == angle.channels[0].calibration.monotone
    east = timezone(timedelta(hours=2))
    for date, expected in (
        ("2026-10-31T12:00:00+02:00", datetime(2026, 10, 31, 12, tzinfo=east)),
        ("2026-10-31T12:00:00", datetime(2026, 10, 31, 12, tzinfo=UTC)),
        (" 2026-10-31 ", datetime(2026, 10, 31, tzinfo=UTC)),
    ):
        assert read_calibrations(f'slope = 1\ndate = "{date}"\n', "c.toml", angle)[1].date == expected


@pytest.mark.parametrize(
    ("text", "method", "degree", "segments"),
    [
        ("points = [[0, 0], [1, 1]]", "table", 1, 1),
        ("points = [[0, 0], [1, 1]]\nmethod = 'linear'", "linear", 1, 1),
        ("points = [[0, 0], [1, 1], [2, 4]]\nmethod = 'polynomial'\ndegree = 2", "polynomial", 2, 1),
        ("slope = 1", "linear", 1, 1),
        ("slope = 0\nintercept = 2", "linear", 1, 1),
        ("slope = 1\nmethod = 'table'", "table", 1, 1),
        ("coefficients = [1, 2]", "linear", 1, 1),
        ("coefficients = [1, 2, 3]", "polynomial", 2, 1),
        ("coefficients = [1]", "polynomial", 0, 1),
        ("coefficients = [1, 2, 3, 4]\nboundaries = [0, 1, 2]", "table", 1, 2),
        ("coefficients = [1, 2]\nboundaries = [0, 1, 2]", "table", 0, 2),
    ],
)
def test_the_method_that_a_file_does_not_name_follows_from_what_it_holds(
    text: str, method: str, degree: int, segments: int, angle: Profile
) -> None:
    found = read_calibrations(text, "c.toml", angle)[1]
    part = found.inputs[0]
    assert (found.method, part.degree, part.segments) == (method, degree, segments)


@pytest.mark.parametrize(
    ("columns", "row", "method"), [("c0", "5", "steps"), ("c0,c1", "5,6", "table"), ("c0,c1,c2", "5,6,7", "polynomial")]
)
def test_the_method_of_segments_follows_from_their_degree(columns: str, row: str, method: str, angle: Profile) -> None:
    found = read_calibrations(f"from,to,offset,{columns}\n0,1,8,{row}\n1,3,9,{row}\n", "c.csv", angle)[1]
    coefficients = tuple(float(part) for part in row.split(","))
    assert (found.method, found.coefficients) == (method, 2 * coefficients)
    assert found.inputs == (CalibrationInput(1, len(coefficients) - 1, (0.0, 1.0, 3.0), (8.0, 9.0)),)


def test_which_channels_a_file_is_for(finger: Profile, angle: Profile) -> None:
    points = "points = [[0, 0], [65535, 1]]\n"
    for channel, numbers in (("2", [2]), ("'2-4'", [2, 3, 4]), ("' all '", list(range(1, 13))), ("' 3 - 3 '", [3])):
        assert list(read_calibrations(f"channel = {channel}\n{points}", "c.toml", finger)) == numbers
    assert list(read_calibrations(points, "c.toml", finger, channel=5)) == [5]
    assert list(read_calibrations(f"channel = '1-3'\n{points}", "c.toml", finger, channel=2)) == [2]
    assert read_calibrations(f"channel = 1\n{points}", "c.toml", finger, channel=2) == {}
    assert list(read_calibrations(points, "c.toml", angle)) == [1]
    shared = "by = 'me'\n[[calibration]]\nchannel = 1\nslope = 1\n[[calibration]]\nchannel = 2\nslope = 2\nby = 'you'\n"
    assert [(n, c.by, c.coefficients) for n, c in read_calibrations(shared, "c.toml", finger).items()] == [
        (1, "me", (0.0, 1.0)),
        (2, "you", (0.0, 2.0)),
    ]


def test_the_due_date_of_the_caller_goes_before_that_of_the_file(tmp_path, finger: Profile) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "c.csv"
    path.write_text("# channel: 1-2\n# date: 2026-01-01\n# interval: 1 d\n0,0\n65535,10\n")
    due = datetime(2026, 1, 11, tzinfo=UTC)
    found = load_calibrations(path, finger, CertificateChoice(channel=2), due=due)
    assert {number: calibration.interval for number, calibration in found.items()} == {2: 10 * 86400.0}
    with pytest.raises(BadDataError, match=r"holds no calibration of channel 3\.$"):
        load_calibrations(path, finger, CertificateChoice(channel=3))
    for wrong in (datetime(2026, 1, 1, tzinfo=UTC), datetime(2163, 1, 1, tzinfo=UTC)):
        with pytest.raises(BadDataError, match=f"2026-01-01 cannot be due on {wrong:%Y-%m-%d}"):
            load_calibrations(path, finger, due=wrong)
    path.write_text("# channel: 1\n0,0\n65535,10\n")
    with pytest.raises(BadDataError, match="states no date, so it cannot be due on 2026-01-11"):
        load_calibrations(path, finger, due=due)


def test_points_are_fitted_as_they_are_without_a_type() -> None:
    text = "# method: linear\nch,raw,value [mN]\n3,0,0\n3,1,2\n3,2,4\n1,0,1\n1,1,2\n"
    found = fit_points(text, "c.csv")
    assert {n: (c.method, c.unit.text) for n, c in found.items()} == {3: ("linear", "mN"), 1: ("linear", "mN")}
    assert found[3].coefficients == pytest.approx((0.0, 2.0))
    assert found[1].coefficients == pytest.approx((1.0, 1.0))
    whole: Calibration = fit_points("0,0\n1,1\n2,4\n", "c.csv", method="polynomial", degree=2)[1]
    assert (whole.method, whole.inputs[0].degree, whole.unit.text) == ("polynomial", 2, "1")
    with pytest.raises(BadDataError, match="these are segments with coefficients; there are no points to fit"):
        fit_points("from,to,offset,c0\n0,1,0,5\n", "c.csv")


def test_two_points_make_a_line_and_more_a_table_and_the_unit_of_a_line_goes_before_the_headers() -> None:
    assert fit_points("0,0\n1,1\n", "c.csv")[1].method == "linear"
    assert fit_points("0,0\n1,1\n2,2\n", "c.csv")[1].method == "table"
    assert fit_points("# unit: mrad\nraw,value [degree]\n0,0\n1,1\n", "c.csv")[1].unit.text == "mrad"


@pytest.mark.parametrize(
    ("stated", "uncertainty"), [("", 0.675), ("# uncertainty: 0.1\n", 0.675), ("# uncertainty: 3\n", 3.0)]
)
def test_the_uncertainty_is_the_stated_one_or_the_largest_residual_if_that_is_greater(
    stated: str, uncertainty: float
) -> None:
    text = f"# method: linear\n{stated}0,0\n1,1.75\n2,1.25\n3,3\n"
    found = fit_points(text, "c.csv")[1]
    assert found.uncertainty == pytest.approx(uncertainty)


def test_an_uncertainty_in_another_unit_is_converted_as_a_difference() -> None:
    """500 mK are 0.5 degC of uncertainty; as a value they are -272.65 degC."""
    celsius = load_profile("temperature-sensor")
    points = "raw,value [degC]\n0,-40\n21120,125\n"
    assert read_calibrations(f"# uncertainty: 500 mK\n{points}", "c.csv", celsius)[1].uncertainty == pytest.approx(0.5)


POINTS = "0,0\n1,1\n2,3\n3,8\n4,5\n"


@pytest.mark.parametrize(
    ("asked", "text", "method", "degree", "interval"),
    [
        ({"method": "polynomial", "degree": 2, "interval": 7.0}, POINTS, "polynomial", 2, 7.0),
        (
            {"method": "polynomial", "degree": 2, "interval": 7.0},
            f"# degree: 1\n# interval: 9 s\n{POINTS}",
            "polynomial",
            1,
            9.0,
        ),
        ({"method": "polynomial", "degree": None, "interval": None}, POINTS, "polynomial", 3, None),
        ({"method": "polynomial", "degree": None}, "0,0\n1,1\n2,3\n", "polynomial", 2, 31556952.0),
        ({"method": "linear", "degree": None}, POINTS, "linear", 1, 31556952.0),
        ({"method": "linear", "degree": None}, f"# method: steps\n{POINTS}", "steps", 0, 31556952.0),
        ({"method": "", "degree": None}, POINTS, "table", 1, 31556952.0),
        ({"method": "", "degree": None}, "0,0\n1,1\n", "linear", 1, 31556952.0),
    ],
)
def test_what_a_file_leaves_out_is_the_profiles_or_the_usual(
    asked: dict[str, object], text: str, method: str, degree: int, interval: float | None, angle: Profile
) -> None:
    channel = angle.channels[0]
    profile = replace(angle, channels=(replace(channel, calibration=replace(channel.calibration, **asked)),))  # type: ignore[arg-type]
    found = read_calibrations(text, "c.csv", profile)[1]
    assert (found.method, found.inputs[0].degree, found.interval) == (method, degree, interval)


@pytest.mark.parametrize(
    ("text", "method", "degrees"),
    [
        ("slope = 2\nboundaries = [1, 5]", "linear", (1,)),
        ("coefficients = [0, 2]\nboundaries = [1, 5]", "linear", (1,)),
        ("coefficients = [0, 2]\n[[inputs]]\nboundaries = [1, 5]\noffsets = [0]", "polynomial", (1,)),
        ("method = 'linear'\ncoefficients = [0, 2]\n[[inputs]]\nboundaries = [1, 5]\noffsets = [0]", "linear", (1,)),
        ("from,to,offset,c0,c1\n1,5,0,0,2\n", "table", (1,)),
        ("1,10\n5,30\n9,50\n", "linear", (1,)),
    ],
)
def test_every_form_is_of_an_actuator_or_of_a_sensor_as_its_channel_is(
    text: str, method: str, degrees: tuple[int, ...]
) -> None:
    gripper = load_profile("gripper")
    name = "c.csv" if text[0] in "f1" else "c.toml"
    for number in (1, 2):
        found = read_calibrations(text, name, gripper, channel=number)[number]
        assert (found.actuator, found.method, found.channel) == (number == 1, method, number)
        assert tuple(part.degree for part in found.inputs) == degrees
        assert [part.channel for part in found.inputs] == [number]
        if text[0] != "1":
            assert found.inputs[0].boundaries == (1.0, 5.0)


def test_a_line_without_boundaries_goes_over_raw_values_or_from_limit_to_limit() -> None:
    gripper = load_profile("gripper")
    ends = {n: read_calibrations("slope = 2", "c.toml", gripper, channel=n)[n].inputs[0].boundaries for n in (1, 2)}
    assert ends == {1: (0.0, pytest.approx(110.0)), 2: (0.0, 4095.0)}


def test_a_line_without_boundaries_needs_a_raw_range(angle: Profile) -> None:
    """Samples of floats have none: only the file or the profile can bound the line."""
    own = angle.channels[0]
    fields = {**own.fields, "Sample": {"DatModel": 1, "ModLenth": 4, "SigBits": 24}}
    floats = replace(
        angle, channels=(replace(own, fields=fields, calibration=replace(own.calibration, raw_range=None)),)
    )
    with pytest.raises(BadDataError) as refused:
        read_calibrations("by = 'x'\nslope = 1\n", "c.toml", floats)
    assert refused.value.message == ("c.toml:1: boundaries: missing: the data model of the channel sets no raw range.")
    found = read_calibrations("boundaries = [2, 9]\nslope = 1\n", "c.toml", floats)[1]
    assert found.inputs[0].boundaries == (2.0, 9.0)


def test_what_is_just_allowed(angle: Profile) -> None:
    def read(text: str) -> Calibration:
        return read_calibrations(f"slope = 1\n{text}", "c.toml", angle)[1]

    assert read("uncertainty = 0").uncertainty is None
    assert read("date = 1970-01-01").date == datetime(1970, 1, 1, tzinfo=UTC)
    assert read("date = 2105-12-31").date == datetime(2105, 12, 31, tzinfo=UTC)
    assert read("interval = 4294967295").interval == 4294967295
    assert read("degree = 255").method == "linear"
    assert pairs(f"1,2\n3,{'4'.rjust(19_998)}\n") == [(1.0, 2.0), (3.0, 4.0)]
    with pytest.raises(BadDataError, match=r"c\.csv:2: the line has more than 20000 characters"):
        pairs(f"1,2\n3,{'4'.rjust(19_999)}\n")


def test_an_input_is_of_its_own_channel_and_degree_1_unless_the_file_states_another() -> None:
    inputs = "[[inputs]]\nboundaries = [0, 9]\noffsets = [1]\n"
    finger = load_profile("tactile-finger-sensor")
    for more, part in (
        ("", CalibrationInput(2, 1, (0.0, 9.0), (1.0,))),
        ("degree = 0\n", CalibrationInput(2, 0, (0.0, 9.0), (1.0,))),
        ("degree = 3\nchannel = 5\nkey = 6\n", CalibrationInput(5, 3, (0.0, 9.0), (1.0,), 6)),
    ):
        coefficients = list(range(1, part.degree + 2))
        text = f"coefficients = {coefficients}\n{inputs}{more}"
        assert read_calibrations(text, "c.toml", finger, channel=2)[2].inputs == (part,), more
