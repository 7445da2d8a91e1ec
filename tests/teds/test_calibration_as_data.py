"""A calibration as plain data, as recordings and topics hold it: every member, and what is refused."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

from teds_provision.errors import BadDataError
from teds_provision.teds.calibration import Calibration, CalibrationInput, evaluate
from teds_provision.teds.calibration.plain import calibration_as_json, calibration_from_json
from teds_provision.teds.units import parse_unit

WHOLE = Calibration(
    3,
    "table",
    (CalibrationInput(3, 1, (0.0, 10.0, 20.0), (0.0, 10.0)), CalibrationInput(5, 0, (1.0, 2.0), (0.0,))),
    (0.0, 1.0, 10.0, 2.0),
    parse_unit("degC"),
    zero_offset=0.5,
    uncertainty=0.25,
    date=datetime(2026, 10, 1, tzinfo=UTC),
    interval=86400.0,
    actuator=True,
)
DATA: dict[str, Any] = {
    "method": "table",
    "unit": "degC",
    "si": [1.0, 273.15],
    "inputs": [
        {"channel": 3, "degree": 1, "boundaries": [0.0, 10.0, 20.0], "offsets": [0.0, 10.0]},
        {"channel": 5, "degree": 0, "boundaries": [1.0, 2.0], "offsets": [0.0]},
    ],
    "coefficients": [0.0, 1.0, 10.0, 2.0],
    "zero_offset": 0.5,
    "uncertainty": 0.25,
    "date": "2026-10-01T00:00:00+00:00",
    "interval": 86400.0,
    "actuator": True,
}
KELVIN = parse_unit("K").units


def test_a_calibration_is_held_whole_and_comes_back() -> None:
    assert calibration_as_json(WHOLE) == DATA
    again = calibration_from_json(json.loads(json.dumps(DATA)), 3, KELVIN)
    assert calibration_as_json(again) == {**DATA, "unit": "°C"}
    assert (again.channel, again.actuator, again.date, again.interval) == (3, True, WHOLE.date, 86400.0)
    inputs = np.array([0.0, 15.0, 20.0]), np.array([1.5] * 3)
    assert evaluate(again, *inputs).value.tolist() == [0.5, 20.5, 30.5]


def test_what_is_not_stated_is_left_out_and_not_invented() -> None:
    plain = {name: DATA[name] for name in ("method", "unit", "si", "inputs", "coefficients", "zero_offset")}
    again = calibration_from_json(plain, 3, KELVIN)
    assert (again.uncertainty, again.date, again.interval, again.actuator) == (None, None, None, False)
    assert calibration_as_json(again) == {**plain, "unit": "°C"}
    assert calibration_from_json({**plain, "actuator": 1}, 3, KELVIN).actuator is False, "true alone"


@pytest.mark.parametrize(
    "change",
    [
        {"method": "spline"},
        {"method": None},
        {"si": [1.0]},
        {"si": [1.0, float("nan")]},
        {"si": "12"},
        {"inputs": 5},
        {"inputs": [{}]},
        {"inputs": [{**DATA["inputs"][0], "channel": 65536}]},
        {"inputs": [{**DATA["inputs"][0], "channel": -1}]},
        {"inputs": [{**DATA["inputs"][0], "channel": True}]},
        {"inputs": [{**DATA["inputs"][0], "degree": 1.0}]},
        {"coefficients": [0.0, True, 1.0, 2.0]},
        {"coefficients": [0.0, "1", 1.0, 2.0]},
        {"coefficients": [0.0, float("inf"), 1.0, 2.0]},
        {"coefficients": [10**400]},
        {"coefficients": [0.0] * 100_001},
        {"zero_offset": None},
        {"uncertainty": "0.1"},
        {"date": "soon"},
        {"interval": [1]},
    ],
)
def test_what_is_no_calibration_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(BadDataError, match=r"^The calibration is not that of a recording\.$"):
        calibration_from_json({**DATA, **change}, 3, KELVIN)


def test_a_member_that_is_missing_is_refused_and_so_is_what_is_no_object() -> None:
    for name in ("method", "si", "inputs", "coefficients", "zero_offset"):
        with pytest.raises(BadDataError):
            calibration_from_json({key: value for key, value in DATA.items() if key != name}, 3, KELVIN)
    for data in (None, [], "x", 5):
        with pytest.raises(BadDataError):
            calibration_from_json(data, 3, KELVIN)
    assert calibration_from_json({**DATA, "inputs": [{**DATA["inputs"][0], "channel": 65535}]}, 3, KELVIN).channel == 3
