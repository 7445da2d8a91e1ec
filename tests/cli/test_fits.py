"""``nodes --fits``: which of the known nodes suffice for a task."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.errors import PolicyError
from teds_provision.provisioning.inventory import NodeFit, require
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord
from teds_provision.teds.calibration import fit
from teds_provision.teds.fits import Fit, parse_fits, parse_require
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.units import parse_unit

from .shell import call

GOOD, COARSE, UNSEEN = (bytes([number]) * 10 for number in (1, 2, 3))
TASK = "angle >= 360 deg, uncertainty <= 1 deg, rate >= 1 kHz"


def image(uuid: bytes, uncertainty: float) -> Image:
    line = fit([(0, 0.0), (65535, 360.0)], "linear", channel=1)
    line = replace(line, unit=parse_unit("degree"), uncertainty=uncertainty)
    return Image(uuid, load_profile("magnetic-angular-position-sensor").build(uuid, calibration={1: line}).blocks)


@pytest.fixture
def known(home: Path) -> Path:
    with Station.inspect(home) as store:
        for uuid in (GOOD, COARSE, UNSEEN):
            store.nodes.restore(NodeRecord(uuid))
        for uuid, uncertainty in ((GOOD, 0.5), (COARSE, 5.0)):
            store.datasheets.put(image(uuid, uncertainty))
    return home


def test_each_known_node_is_judged_by_its_datasheet(known: Path) -> None:
    done = call(known, "--json", "nodes", "--fits", TASK)
    assert done.code == 0, done.err
    found = {entry["uuid"]: entry for entry in done.json["fits"]}
    assert found[GOOD.hex()]["result"] == "passed"
    assert found[GOOD.hex()]["channel"] == 1
    assert found[COARSE.hex()]["result"] == "failed"
    assert "uncertainty is 5 °" in found[COARSE.hex()]["why"]
    assert found[UNSEEN.hex()] | {"name": ""} == {
        "uuid": UNSEEN.hex(),
        "channel": None,
        "name": "",
        "result": "skipped",
        "why": "its datasheet is unknown here.",
    }


def test_one_node_is_judged_alone_and_people_see_a_table(known: Path) -> None:
    done = call(known, "nodes", GOOD.hex(), "--fits", TASK)
    assert done.code == 0
    assert GOOD.hex() in done.out
    assert "passed" in done.out
    assert COARSE.hex() not in done.out


def test_the_table_names_node_channel_result_and_why(known: Path) -> None:
    rows = [line.split(None, 1) for line in call(known, "nodes", "--fits", TASK).out.splitlines()]
    assert rows[0] == ["UUID", "channel  result   why"]
    found = {uuid: " ".join(rest.split()) for uuid, rest in rows[1:]}
    entries = call(known, "--json", "nodes", "--fits", TASK).json["fits"]
    assert len(entries) == len(found)
    for entry in entries:
        channel = "" if entry["channel"] is None else f"{entry['channel']} {entry['name']} "
        assert found[entry["uuid"]] == " ".join(f"{channel}{entry['result']} {entry['why']}".split())


def test_an_expression_that_means_nothing_is_a_usage_error(known: Path) -> None:
    done = call(known, "nodes", "--fits", "angel >= 3 deg")
    assert done.code == 2
    assert "angel" in done.err


def test_a_group_that_does_not_suffice_is_refused_with_what_it_has() -> None:
    requirement = parse_fits(TASK)
    (named,) = parse_require('["Joint 3"]\nrate = "1 kHz"', "task.toml")
    good, bad = Fit(1, "a", "passed", "fine."), Fit(1, "a", "failed", "uncertainty is 5 °.")
    require([NodeFit(GOOD, requirement, bad), NodeFit(COARSE, requirement, good)])
    with pytest.raises(PolicyError, match="uncertainty is 5 °"):
        require([NodeFit(GOOD, requirement, bad)])
    with pytest.raises(PolicyError, match="Joint 3"):
        require([NodeFit(GOOD, named, good), NodeFit(COARSE, named, bad)])
