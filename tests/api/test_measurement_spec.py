"""A setting of a measurement is defined once: options, request, answer, row and client have the same ones."""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_type_hints

from teds_provision.api import answers, bodies
from teds_provision.cli.measure.measure import CONTINUED_WITH, measure
from teds_provision.cli.measure.sample import set_value
from teds_provision.cli.service import ncap
from teds_provision.measure.request import MeasurementRequest
from teds_provision.measure.running.measurement_job import request_of
from teds_provision.shapes.measurement import NAMES, OPTIONS, PUBLISHED, MeasurementMembers, MeasurementSpec
from teds_provision.station.store.records import KeptMeasurement

from ..bench import make_station
from ..test_architecture import PACKAGE, parsed

CHANGED: Mapping[str, Any] = {
    "group": "arm",
    "uuids": (bytes(10), bytes(range(10))),
    "match": "type:gripper",
    "frozen": True,
    "channels": (3, 1),
    "rate": 12.5,
    "kind": "event",
    "trigger": True,
    "test_pattern": True,
    "unsigned": True,
    "sinks": ("ros2", "/r/run.csv"),
    "actuators": True,
    "dead_man": 250,
    "require": '[angle]\nrange = ">= 360 deg"\n',
    "scalar_rate": 2.5,
}
"""Of each known setting a value that is not its default."""


def changed() -> MeasurementSpec:
    return MeasurementSpec(**{name: CHANGED[name] for name in NAMES if name in CHANGED})


def test_a_row_keeps_each_setting(tmp_path: Path) -> None:
    """One without a column fails here: see ``station/store/schema.py``."""
    wanted = KeptMeasurement("m1", **changed().settings() | {"group": None, "match": None})
    with make_station(tmp_path / "home") as station:
        station.measurements.keep(wanted)
        assert station.measurements.get("m1") == wanted


def test_the_request_to_each_node_has_each_setting() -> None:
    kept = KeptMeasurement("m1", **changed().settings())
    found = request_of(kept, MeasurementRequest(patient=True, timeout=3.0))
    assert found.settings() == kept.settings()
    assert (found.patient, found.timeout) == (True, 3.0)


def test_request_and_answer_of_the_api_have_the_published_settings() -> None:
    assert tuple(member.name for member in dataclasses.fields(bodies.NewMeasurement)) == PUBLISHED
    assert get_type_hints(answers.Measurement).keys() >= set(PUBLISHED)
    assert MeasurementMembers.__annotations__.keys() == set(PUBLISHED) - {"uuids"}, "the client's keywords"


def test_a_body_becomes_the_settings_and_back() -> None:
    """Of a command only, such as a test pattern, a body has none."""
    published = {name: getattr(changed(), name) for name in PUBLISHED}
    body = bodies.NewMeasurement(**published | {"uuids": [uuid.hex() for uuid in CHANGED["uuids"]]})
    spec = MeasurementSpec.from_json(vars(body), actuators=True, dead_man=99)
    assert spec == replace(MeasurementSpec(), **published)
    assert bodies.NewMeasurement(**spec.to_json()) == replace(
        body, channels=list(body.channels), sinks=list(body.sinks)
    )
    assert MeasurementSpec.from_json(vars(bodies.NewMeasurement(group="arm")), dead_man=99).dead_man == 99
    twice = {"uuids": ["ab" * 10, "cd" * 10, "AB" * 10], "channels": [2, 1, 2], "sinks": ["a.csv", "a.csv"]}
    once = MeasurementSpec.from_json(twice)
    assert [uuid.hex()[:2] for uuid in once.uuids] == ["ab", "cd"], "no node has two supervisors"
    assert (once.channels, once.sinks) == ((2, 1), ("a.csv",))


def test_the_command_has_an_option_for_each_setting_that_names_one() -> None:
    flags = {parameter.name: "/".join(parameter.opts) for parameter in measure.params if parameter.name in OPTIONS}
    assert flags == {name: option.flags.partition("/")[0] for name, option in OPTIONS.items()}


def test_other_commands_have_the_options_of_the_settings_as_they_are() -> None:
    """One written by hand differs from ``measure`` as soon as a bound or a default changes; the help alone may."""
    ways = {option.flags.partition("/")[0]: name for name, option in OPTIONS.items()}
    own = {parameter.name: parameter.to_info_dict() for parameter in measure.params}
    found = set()
    for command in (set_value, ncap.run, ncap.measure):
        for parameter in command.params:
            name = ways.get(parameter.opts[0], "")
            if name and not parameter.multiple:
                assert parameter.to_info_dict() | {"help": ""} == own[name] | {"help": ""}, f"{command.name} {name}"
                found.add((command.name, name))
    assert found == {
        ("set", "dead_man"),
        ("run", "actuators"),
        ("run", "dead_man"),
        ("run", "rate"),
        ("measure", "rate"),
    }


def test_each_option_of_a_setting_is_made_from_it() -> None:
    flags = {option.flags for option in OPTIONS.values()} - {"--channel", "--kind", "--require"}
    found = [
        f"{path.name}: {flag}"
        for path in (PACKAGE / "cli").rglob("*.py")
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "option" and node.args
        if ast.unparse(node.func) == "click.option"
        for flag in [getattr(node.args[0], "value", "")]
        if flag in flags
    ]
    assert found == []


NOT_SAID = frozenset(
    ("group", "uuids", "match", "frozen", "channels", "kind", "trigger", "actuators", "dead_man", "scalar_rate")
)
"""Settings of a continued measurement that need no word: what it measures and how is seen in its values."""


def test_each_setting_is_said_of_a_continued_measurement_or_needs_no_word() -> None:
    """A new one belongs into ``CONTINUED_WITH``, where people are to know of it, or above."""
    said = {"rate", "sinks", *CONTINUED_WITH}
    assert said | NOT_SAID == set(NAMES)
    assert not said & NOT_SAID
