"""`calibrate zero` at virtual sensors on a CAN bus: read, offset, guard, sign, write, verify, in one step."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

from teds_provision.teds.calibration.model import from_decoded
from teds_provision.teds.codec.decode import decode
from tests.e2e.desk import ANGLE
from tests.measure import rig as rigs
from tests.measure.rig import Rig, RigNode
from tests.ncap.service import Service, verified
from tests.pace import until

pytestmark = pytest.mark.link
LOAD = "load-cell"
TURN = 2 * math.pi


class Shaft:
    """A sensor that is turned by hand: each line of a file is a reading."""

    def __init__(self, rig: Rig, name: str) -> None:
        self.node: RigNode = rig.nodes[name]
        self.file = rig.folder / f"{name}.lines"
        self.file.write_text("")

    def start(self) -> Shaft:
        self.node.start("--source", f"exec:tail -n +1 -f {self.file}")
        return self

    def turn(self, channel: str, raw: float) -> None:
        with self.file.open("a") as lines:
            lines.write(json.dumps({"raw": {channel: raw}}) + "\n")
        time.sleep(0.3)  # tail hands it on

    def calibration(self) -> Any:
        flash = json.loads((self.node.folder / "flash.json").read_text())["flash"]
        octets = next(bytes.fromhex(teds) for channel, code, teds in flash["blocks"] if (channel, code) == (1, 5))
        return from_decoded(decode(octets), channel=1)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(rigs.CALIBRATIONS, ANGLE, "# date: 2026-10-01\nraw,value [degree]\n0,0\n65536,360\n")
        patch.setitem(rigs.CALIBRATIONS, LOAD, "# date: 2026-10-01\n# method: linear\n4194304,-499\n12582912,499\n")
        rig = Rig(tmp_path_factory.mktemp("zero") / "rig", {"angle": ANGLE, "load": LOAD})
    try:
        yield rig
    finally:
        rig.close()


@pytest.fixture(scope="module")
def angle(rig: Rig) -> Shaft:
    return Shaft(rig, "angle").start()


def reads(rig: Rig, node: str = "angle") -> float:
    return float(rig.ask("sample", node)["samples"][0]["value"])


def test_this_is_0_now_in_one_step(rig: Rig, angle: Shaft) -> None:
    angle.turn("angle", 6000)
    before, had = reads(rig), angle.calibration()
    done = rig.ask("calibrate", "zero", "angle", 1)
    assert done["written"]
    assert done["warnings"] == [], "that it reads otherwise than before is what was asked for"
    assert done["before"] == pytest.approx(before)
    assert done["after"] == pytest.approx(0, abs=1e-6), "not a whole turn"
    assert done["offset"] == pytest.approx(-6000 / 65536 * TURN, abs=1e-6)
    assert (done["unit"], done["shown"]["unit"]) == ("rad", "°")
    assert done["shown"]["offset"] == pytest.approx(-6000 / 65536 * 360, abs=1e-4)
    assert min(reads(rig), TURN - reads(rig)) < 1e-6
    now = angle.calibration()
    assert (now.date, now.coefficients, had.zeroed) == (had.date, had.coefficients, None)
    assert now.zeroed.date().isoformat() == time.strftime("%Y-%m-%d", time.gmtime())
    assert rig.ask("verify", "angle", "--via", "can")["verdict"] == "authentic"


def test_the_same_again_changes_nothing(rig: Rig, angle: Shaft) -> None:
    angle.turn("angle", 9000)
    first = rig.ask("calibrate", "zero", "angle", 1)
    again = rig.ask("calibrate", "zero", "angle", 1)
    assert not again["written"]
    assert (again["moved"], again["sequence"], again["changes"]) == (0, first["sequence"], [])
    assert again["offset"] == pytest.approx(first["offset"])


def test_another_value_in_another_unit_and_a_plan_that_writes_nothing(rig: Rig, angle: Shaft) -> None:
    angle.turn("angle", 20_000)
    words = ("calibrate", "zero", "angle", 1, "--value", -90, "--unit", "degree")
    plan = rig.ask(*words, "--dry-run")
    assert (plan["written"], plan["dry_run"]) == (False, True)
    assert plan["shown"]["after"] == pytest.approx(270, abs=1e-3)
    done = rig.ask(*words)
    assert done["sequence"] == plan["sequence"] + 1
    assert reads(rig) == pytest.approx(TURN * 3 / 4, abs=1e-5)
    assert abs(done["offset"]) <= TURN / 2


def test_an_angle_that_trembles_across_the_wrap_has_a_circular_mean(rig: Rig, angle: Shaft) -> None:
    angle.turn("angle", 30_000)
    rig.ask("calibrate", "zero", "angle", 1)
    with angle.file.open("a") as lines:  # a part of a degree to either side of the zero that stands there now
        for step in range(400):
            lines.write(json.dumps({"raw": {"angle": 30_000 + (-20, 20)[step % 2]}}) + "\n")
            lines.flush()
            time.sleep(0.004)
            if step == 50:
                running = rig.station.start("--json", "calibrate", "zero", "angle", 1, "--can", rig.can)
    done = running.end().json
    assert min(done["before"], TURN - done["before"]) < math.radians(0.2)
    assert min(done["after"], TURN - done["after"]) < math.radians(0.2)


def test_a_sensor_that_turns_is_refused(rig: Rig, angle: Shaft) -> None:
    had = angle.calibration()
    running = rig.station.start("--json", "calibrate", "zero", "angle", 1, "--can", rig.can)
    with angle.file.open("a") as lines:
        for step in range(2000):
            lines.write(json.dumps({"raw": {"angle": step * 10 % 65536}}) + "\n")
            lines.flush()
            time.sleep(0.002)
            if not running.runs:
                break
    refused = running.end()
    assert refused.code == 6
    assert "not steady" in refused.json["error"]["message"]
    assert angle.calibration() == had


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["angle", 2], 8, "no channel 2"),
        (["angle", 1, "--value", "nan"], 2, "finite"),
        (["angle", 1, "--value", 1, "--unit", "N"], 8, "not a unit for channel"),
        (["nobody", 1], 3, "nobody"),
    ],
)
def test_what_cannot_be_meant_is_refused(rig: Rig, angle: Shaft, words: list[object], code: int, message: str) -> None:
    del angle
    assert message in rig.ask("calibrate", "zero", *words, code=code)["error"]["message"]


def test_limits_are_kept_and_the_guard_is_in_force(rig: Rig) -> None:
    load = Shaft(rig, "load").start()
    load.turn("force", 8_388_608 + 2000)
    assert "exceeds the limits" in rig.ask("calibrate", "zero", "load", 1, "--value", 501, code=6)["error"]["message"]
    kilo = rig.ask("calibrate", "zero", "load", 1, "--value", 0.6, "--unit", "kN", code=6)["error"]["message"]
    assert kilo == "0.6 kN exceeds the limits of channel 1 (force), -0.5 kN to 0.5 kN."
    small = rig.ask("calibrate", "zero", "load", 1)
    assert small["before"] == pytest.approx(2000 / 8_388_608 * 998, abs=1e-3)
    assert small["after"] == pytest.approx(0, abs=1e-3)
    load.turn("force", 8_388_608 + 300_000)
    refused = rig.ask("calibrate", "zero", "load", 1, code=6)["error"]
    assert "limit" in refused["message"]
    assert "--accept-calibration" in refused["hint"]
    accepted = "--accept-calibration", "the hook weighs that much"
    assert not rig.ask("calibrate", "zero", "load", 1, "--dry-run", *accepted)["written"]
    done = rig.ask("calibrate", "zero", "load", 1, *accepted)
    assert done["written"]
    acts = [entry["act"] for entry in rig.station.ask("log")["entries"]]
    assert acts.count("accept-calibration") == 1, "a plan is no act"
    load.node.kill()


CUT = """
import os, runpy, sys
from teds_provision.measure import zero
zero.judge_and_keep = lambda *a, **k: os.kill(os.getpid(), 9)
sys.argv[0] = "teds-provision"
runpy.run_module("teds_provision", run_name="__main__")
"""


def test_a_command_killed_between_write_and_verify_is_carried_on_by_the_same_words(rig: Rig, angle: Shaft) -> None:
    angle.turn("angle", 41_000)
    words = ("--json", "calibrate", "zero", "angle", 1, "--can", rig.can)
    cut = rig.station.start(*words, program=(sys.executable, "-c", CUT), fork=False).end()
    assert cut.code == -9
    assert angle.calibration().zero_offset == pytest.approx(-41_000 / 65536 * 360 + 360, abs=1e-3)
    again = rig.ask("calibrate", "zero", "angle", 1)
    assert not again["written"]
    assert rig.ask("verify", "angle", "--via", "can")["verdict"] == "authentic"


def test_two_at_once_follow_each_other(rig: Rig, angle: Shaft) -> None:
    angle.turn("angle", 50_000)
    words = ("--json", "calibrate", "zero", "angle", 1, "--can", rig.can, "--unit", "degree", "--value")
    both = [rig.station.start(*words, value) for value in (10, 20)]
    done = [running.end() for running in both]
    assert [outcome.code for outcome in done] == [0, 0], done
    last = max((outcome.json for outcome in done), key=lambda item: item["sequence"])
    assert abs(done[0].json["sequence"] - done[1].json["sequence"]) == 1
    assert reads(rig) == pytest.approx(last["after"], abs=1e-5)


def test_a_trial_build_beside_it_is_reported_and_the_next_provisioning_keeps_the_zero(rig: Rig, angle: Shaft) -> None:
    uuid = angle.node.uuid
    rig.station.ask("build", uuid, "--name", "elbow")
    angle.turn("angle", 55_000)
    done = rig.ask("calibrate", "zero", uuid, 1)
    assert any("draft" in text for text in done["warnings"])
    assert [draft["stage"] for draft in rig.station.ask("draft", "list")["drafts"]] == ["built"]
    rig.station.ask("draft", "drop", uuid)
    for name in ("elbow", "angle"):
        rig.station.ask("provision", uuid, "--name", name, "--yes", "--via", "can", "--can", rig.can)
        assert angle.calibration().zeroed is not None
        assert min(reads(rig, name), TURN - reads(rig, name)) < 1e-5


def test_a_running_ncap_lets_the_node_go_and_measures_it_by_its_new_zero(rig: Rig, angle: Shaft) -> None:
    angle.turn("angle", 55_000)  # a sensor that never had a reading gives no value, and tests run in any order
    service = Service(rig.desk, rig.station).start()
    try:
        with service.client() as asked:
            verified(service, angle.node.uuid)
            asked.request("POST", "/measurements", {"uuids": [angle.node.uuid], "rate": 50})

            def last() -> float | None:
                channel = asked.node(angle.node.uuid)["channels"][0]
                return channel["last"]["value"] if channel["last"] and channel["last"]["age"] < 1 else None

            until(lambda: last() is not None, lambda: str(asked.node(angle.node.uuid)))
            angle.turn("angle", 60_000)
            until(lambda: (last() or 0) > 0.1)
            assert rig.ask("calibrate", "zero", "angle", 1)["written"]
            until(lambda: (value := last()) is not None and min(value, TURN - value) < 1e-5)
        assert service.process is not None
        service.process.wait_for("let go for calibrate zero")
    finally:
        service.end()  # in order: the claim of one that was killed would last until its lease ends, into the next test


def test_while_another_station_measures_it_nothing_is_signed(rig: Rig, angle: Shaft) -> None:
    angle.turn("angle", 12_345)
    sequence = rig.ask("calibrate", "zero", "angle", 1, "--dry-run")["sequence"]
    elsewhere = rig.begin("angle", "--rate", 20, can=f"{rig.can}&source=0xF4", station=rig.copy("other"))
    here = rig.begin("angle", "--rate", 20)
    for running, reason in ((here, "by pid"), (elsewhere, "by another station, source address 0xF4")):
        running.wait_for('"event":"data"')
        refused = rig.ask("calibrate", "zero", "angle", 1, code=6)["error"]
        assert f"is being measured {reason}" in refused["message"]
        running.signal(2)
        assert running.end().code == 0
    assert rig.ask("calibrate", "zero", "angle", 1)["sequence"] == sequence + 1
