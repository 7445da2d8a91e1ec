"""Which datasheet counts: the one that was verified in the session; raw values of an unsigned one where asked for."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

from teds_provision.node.flash_file import FlashFile
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.frame import frame, unframe
from tests.e2e.desk import ANGLE
from tests.measure.rig import Rig, of, states

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    made = Rig(tmp_path_factory.mktemp("rig"), {"a": ANGLE, "g": "gripper", "u": f"keyed:{ANGLE}"})
    try:
        for node in made.nodes.values():
            node.start()
        yield made
    finally:
        made.close()


def test_a_group_whose_datasheets_suffice_together_is_measured(rig: Rig, tmp_path: Path) -> None:
    file = tmp_path / "task.toml"
    file.write_text('[angle]\nrange = ">= 300 deg"\n\n["grip force"]\nrange = ">= 100 N"\n')
    uuids = [rig.nodes[name].uuid for name in "ag"]
    lines = rig.measure(*uuids, "--rate", 10, "--duration", 1, "--require", file)
    assert of(lines, rig.nodes["a"].uuid)
    assert {fit["result"] for fit in lines[-1]["fits"] if fit["channel"] is not None} == {"passed"}


LATE = """
import runpy, sys, time
from teds_provision.measure.running.measurement import Measurement
told = Measurement._describe
Measurement._describe = lambda self, facts: (time.sleep(1), told(self, facts))[1]
sys.argv[0] = "teds-provision"
runpy.run_module("teds_provision", run_name="__main__")
"""


def test_no_value_is_handed_on_before_it_is_known_what_it_means(rig: Rig, tmp_path: Path) -> None:
    """On a busy machine data came before the sinks knew the channels: a part without units, a topic without a mark."""
    file, uuids = tmp_path / "run.csv", {"a": rig.nodes["a"].uuid, "u": rig.nodes["u"].uuid}
    late = {"program": (sys.executable, "-c", LATE), "fork": False}
    words = ("--rate", 100, "--duration", 2, "--unsigned", "--to", file)
    lines = rig.measure(*uuids.values(), *words, "--to", file.with_suffix(".jsonl"), **late)
    parts = [Path(file).read_text().splitlines() for file in lines[-1]["files"] if file.endswith(".csv")]
    facts = [json.loads(line.partition(": ")[2]) for part in parts for line in part if line.startswith("# channel: ")]
    assert facts
    for item in facts:
        assert item["unsigned"] if item["uuid"] == uuids["u"] else item["fingerprint"], item
    rows = [row for part in parts for row in csv.DictReader(line for line in part if not line.startswith("#"))]
    assert {row["note"] for row in rows if row["uuid"] == uuids["u"]} == {"unsigned datasheet"}
    for name, uuid in uuids.items():
        indices = [int(row["index"]) for row in rows if row["uuid"] == uuid]
        assert indices == sorted(set(indices)), f"what was held back of {name} comes in its order"
        assert all(line.get("unsigned", False) is (name == "u") for line in of(lines, uuid))
        assert of(lines, uuid)[0]["name"] == "angle"


def test_a_requirement_that_one_of_them_lacks_stops_all_before_anything_is_claimed(rig: Rig, tmp_path: Path) -> None:
    file = tmp_path / "task.toml"
    file.write_text('["grip force"]\nrange = ">= 5 kN"\n')
    uuids = [rig.nodes[name].uuid for name in "ag"]
    lines = rig.measure(*uuids, "--rate", 10, "--duration", 1, "--require", file, code=6)
    assert not [line for line in lines if line["event"] == "data"]
    assert set(states(lines)) == {"waiting", "refused"}
    assert "grip force" in lines[-1]["error"]["message"]
    assert any(fit["result"] == "failed" for fit in lines[-1]["fits"])
    for uuid in uuids:
        assert rig.ask("mode", uuid)["mode"] == "configuration"


def test_raw_values_of_an_unsigned_datasheet_come_only_if_requested_and_are_marked(rig: Rig) -> None:
    uuid, file = rig.nodes["u"].uuid, rig.folder / "unsigned.csv"
    lines = rig.measure(uuid, "--rate", 20, "--duration", 1, code=4)
    assert not of(lines)
    assert lines[-1]["error"]["code"] == "not-authentic"
    lines = rig.measure(uuid, "--rate", 20, "--duration", 1, "--unsigned", "--to", file,
                         "--to", file.with_suffix(".mcap"), "--to", file.with_suffix(".jsonl"))  # fmt: skip
    assert of(lines)
    for line in of(lines):
        assert line["unsigned"] is True
        assert set(line["value"]) == {None}
        assert set(line["valid"]) == {False}
        assert line["unit"] == ""
        assert line["uncertainty"] is None
    assert len({raw for line in of(lines) for raw in line["raw"]}) > 1
    assert any("the datasheet is unsigned" in line.get("why", "") for line in lines)
    text = file.read_text().splitlines()
    rows = list(csv.DictReader(line for line in text if not line.startswith("#")))
    assert {row["note"] for row in rows} == {"unsigned datasheet"}
    assert any('"unsigned": true' in line for line in text if line.startswith("# channel"))
    written_events = [json.loads(line) for line in file.with_suffix(".jsonl").read_text().splitlines()]
    assert all(line["unsigned"] for line in written_events if line["event"] in ("channel", "data"))
    with file.with_suffix(".mcap").open("rb") as recording:
        found = make_reader(recording)
        streams = [channel for channel in found.get_summary().channels.values() if "/stream_" in channel.topic]
        channels = [metadata.metadata for metadata in found.iter_metadata() if metadata.name == "channel"]
    assert all(json.loads(stream.metadata["channels"])[0]["unsigned"] is True for stream in streams)
    assert [channel["unsigned"] for channel in channels] == ["true"]
    signed = of(rig.measure(rig.nodes["a"].uuid, "--rate", 20, "--duration", 1, "--unsigned"))
    assert all("unsigned" not in line and None not in line["value"] for line in signed)


def test_a_restart_of_the_node_is_seen_by_c_and_sample_states_what_its_values_rest_on(rig: Rig) -> None:
    """Two processes: c of Open goes on within a power-up, whoever asks, and is another one after it."""
    node = rig.nodes["a"]
    rig.ask("verify", "a", "--via", "can")
    assert [rig.ask("sample", "a")["from"] for _ in range(3)] == ["session"] * 3, "no restart"
    for _ in range(2):
        node.kill()
        node.start()
        assert [rig.ask("sample", "a")["from"] for _ in range(2)] == ["kept"] * 2, "nobody has read the rest since"
        (listed,) = rig.station.ask("nodes", node.uuid)["nodes"]
        assert (listed["verdict"], listed["reading"]["from"]) == ("authentic", "kept")
        rig.ask("verify", "a", "--via", "can")
        assert rig.ask("sample", "a")["from"] == "session"


def test_a_teds_that_was_changed_in_flash_ends_the_measurement_that_began_by_the_kept_copy(
    rig: Rig, tmp_path: Path
) -> None:
    """It had been "authentic" for ever: the kept copy stood in for octets that nobody read."""
    node, file = rig.nodes["g"], tmp_path / "run.csv"
    node.kill()
    flash = FlashFile(rig.folder / "g")
    state = flash.load()
    block = (1, AccessCode.CALIBRATION)
    body = bytearray(unframe(state.blocks[block]))
    body[-1] ^= 1
    flash.commit(replace(state, blocks={**state.blocks, block: frame(bytes(body))}))
    flash.release()
    node.start()
    try:
        lines = rig.measure(node.uuid, "--rate", 10, "--duration", 30, "--to", file, code=4)
        assert "data" in {line["event"] for line in lines}, "it was measured at once, by the signed copy"
        assert "refused" in states(lines)
        assert "do not count" in lines[-1]["error"]["message"]
        assert any("refused" in line and "do not count" in line for line in file.read_text().splitlines())
        (listed,) = rig.station.ask("nodes", node.uuid)["nodes"]
        assert (listed["verdict"], listed["reading"]["by"]) == ("not authentic", "measure")
        refused = rig.station.refuses("sample", node.uuid, "--can", node.bus, code=4)
        assert "TEDS 5 of channel 1 is missing or changed" in refused["message"]
    finally:
        flash = FlashFile(rig.folder / "g")
        flash.commit(replace(flash.load(), blocks=state.blocks))
        flash.release()
