"""A node of the store has one form: nodes --json, the API's node and its description follow from it."""

from __future__ import annotations

import ast
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args, get_origin, get_type_hints

import pytest

from teds_provision.api.answers import Node
from teds_provision.api.operations import document
from teds_provision.ncap.live import Live
from teds_provision.ncap.nodes.directory import NodeDirectory, channel_facts
from teds_provision.provisioning.inventory import inventory
from teds_provision.shapes.node import HINTS, PUBLISHED, KnownNode
from teds_provision.teds.channel import Channel, ChannelKind, Timing
from teds_provision.teds.units import parse_unit

from ..bench import make_station
from ..test_architecture import MODULES, name_of, parsed

ALL = list(KnownNode._fields)


def test_nodes_json_has_every_field_in_its_order(tmp_path: Path) -> None:
    uuid = bytes(range(10))
    with make_station(tmp_path / "home") as station:
        station.nodes.remember(uuid, name="finger 1")
        (found,) = inventory(station, [uuid])
    assert list(found.to_json()) == ALL
    assert found.name == "finger 1"


@pytest.mark.parametrize("stored", [True, False])
def test_the_node_of_the_api_has_the_members_of_its_description(tmp_path: Path, stored: bool) -> None:
    uuid = bytes(range(10))
    with make_station(tmp_path / "home") as station:
        if stored:
            station.nodes.remember(uuid, name="finger 1")
        directory = NodeDirectory(station, Live())
        directory.refresh()
        node = directory.node(uuid.hex())
    assert set(node) == set(get_type_hints(Node)) == set(schema())
    assert node["name"] == ("finger 1" if stored else None)


def test_what_the_api_takes_from_the_store_has_one_type() -> None:
    """But a verdict and channels, of which ``nodes`` has a word and a count, and objects, which are typed there."""
    kinds = {str: "string", int: "integer", bool: "boolean", Sequence: "array"}
    assert set(PUBLISHED) <= set(schema())
    for name in set(PUBLISHED) - {"wrapped", "firmware"}:
        whole = get_args(HINTS[name])[0]
        parts = (
            [part for part in get_args(whole) if part is not type(None)] if type(None) in get_args(whole) else [whole]
        )
        kind = kinds[get_origin(parts[0]) or parts[0]]
        assert schema()[name]["type"] == ([kind, "null"] if type(None) in get_args(whole) else kind), name


def test_no_other_place_puts_a_node_of_the_store_together() -> None:
    found = [
        f"{name_of(path)}:{node.lineno}"
        for path in MODULES
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.Dict)
        and {"uuid", "whitelisted", "epoch", "retired"} <= {getattr(key, "value", "") for key in node.keys}
    ]
    assert found == []


def test_a_field_without_facts_is_of_the_command_line_alone() -> None:
    assert KnownNode(uuid="00" * 10).published().keys() == set(PUBLISHED) < set(ALL)


def schema() -> dict[str, Any]:
    found: dict[str, Any] = document()["components"]["schemas"]["Node"]["properties"]
    return found


def test_what_the_api_says_of_a_channel_has_no_number_that_the_datasheet_lacks() -> None:
    """SI units; the number that people see is the SI value times ``factor`` plus ``offset``."""
    oil = Channel(
        3, "oil", True, ChannelKind.SENSOR, parse_unit("degC").units, True, 233.15, 398.15, 0.5,
        timing=Timing(period=0.05), display="degC",
    )  # fmt: skip
    found = channel_facts(oil)
    assert found["shown"] == {"unit": "°C", "factor": 1.0, "offset": pytest.approx(-273.15)}
    assert {name: found[name] for name in ("number", "name", "kind", "unit", "low", "high", "uncertainty", "rate")} == {
        "number": 3, "name": "oil", "kind": "sensor", "unit": "K", "low": 233.15, "high": 398.15, "uncertainty": 0.5,
        "rate": 20.0,
    }  # fmt: skip
    bare = channel_facts(replace(oil, low=math.nan, high=math.inf, timing=Timing(), kind=None))
    assert (bare["low"], bare["high"], bare["rate"], bare["kind"]) == (None, None, None, None)
    assert (bare["calibrated"], bare["due"], bare["overdue"]) == (None, None, False)
    vars(bare_unit := replace(oil))["shown"] = SimpleNamespace(text="far", from_si=lambda value: math.inf)
    assert channel_facts(bare_unit)["shown"] == {"unit": "far", "factor": None, "offset": None}, "JSON has no infinity"
