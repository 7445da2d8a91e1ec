"""``calibrate``: all that it prints, for people and as JSON, and what it passes on to the work below."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision import __version__, measure, provisioning
from teds_provision.measure.capture import CaptureResult
from teds_provision.measure.zero import ZeroOrder, ZeroResult
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.progress import StepResult
from teds_provision.teds.calibration import fit_points
from teds_provision.teds.calibration.points import Point
from teds_provision.teds.channel import Channel
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.sheet import Sheet
from teds_provision.teds.units import parse_unit

from .shell import Outcome, call

UUID = bytes(range(10))
NODE = UUID.hex()
BUS = ("--can", "virtual:calibrate")
NAMED = "magnetic-angular-position-sensor"


def angle(**changes: Any) -> Channel:
    """Return a channel that people see in degrees."""
    sheet = Sheet.from_image(Image(UUID, load_profile(NAMED).build(UUID).blocks))
    return replace(sheet.channels[0], display="degree", **changes)


def degrees(value: float) -> float:
    return value * math.pi / 180


ZEROED = ZeroResult(
    uuid=UUID,
    channel=angle(),
    offset=degrees(-3.0),
    moved=degrees(-0.5),
    before=degrees(10.5),
    after=degrees(10.0),
    spread=degrees(0.02),
    count=16,
    sequence=7,
    changes=("channel 1: the zero offset changes",),
    warnings=("the battery is low",),
    steps=(StepResult("read", "done", 0.5), StepResult("sign", "nothing to do", 0.0)),
    written=True,
)


class Zeroing:
    """Stands for the work below: keeps what it was asked, and returns this result."""

    def __init__(self, result: ZeroResult) -> None:
        self.result = result
        self.asked: list[Any] = []

    def __call__(
        self, _station: Any, _links: Any, node: str, order: ZeroOrder, _reporter: Any, **more: Any
    ) -> ZeroResult:
        self.asked += [node, order, more["dry_run"]]
        return self.result


def zero(
    home: Path, patch: pytest.MonkeyPatch, result: ZeroResult, *words: str, json: bool = False
) -> tuple[Outcome, list[Any]]:
    work = Zeroing(result)
    patch.setattr(measure.zero, "zero_at", work)
    return call(home, *(["--json"] if json else []), "calibrate", "zero", NODE, *words, *BUS), work.asked


def test_a_zero_is_reported_whole(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outcome, asked = zero(home, monkeypatch, ZEROED, "angle", "--value", "-0.5", "--unit", "degree", "--yes")
    assert (outcome.code, outcome.out) == (
        0,
        "Channel 1 (angle) read 10.5 ° (16 samples, spread 0.02 °) and now reads 10 °: "
        "zero offset -3 ° (moved by -0.5 °).\n"
        "  channel 1: the zero offset changes\nWritten and verified, sequence 7.\n",
    )
    assert "the battery is low" in outcome.err
    assert asked == [NODE, ZeroOrder("angle", -0.5, "degree", False, None), False]


def test_a_zero_of_which_nothing_moved_and_a_plan_are_reported(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    still, asked = zero(home, monkeypatch, replace(ZEROED, moved=0.0, channel=angle(name="")), "1")
    assert still.out == "Channel 1 reads 10.5 ° (16 samples, spread 0.02 °): nothing to do.\n"
    assert asked == [NODE, ZeroOrder(1), False]
    plan, asked = zero(home, monkeypatch, ZEROED, "1", "--dry-run", "--accept-calibration", "it is mounted so")
    assert plan.out == (
        "Plan: Channel 1 (angle) read 10.5 ° (16 samples, spread 0.02 °); it would read 10 °, "
        "zero offset -3 ° (moved by -0.5 °).\n  channel 1: the zero offset changes\n"
    )
    assert asked == [NODE, ZeroOrder(1, accept_calibration="it is mounted so"), True]


def test_a_zero_as_json_is_si_with_the_shown_unit_beside(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    celsius = replace(angle(), name="oil", units=parse_unit("K").units, display="degC")
    warm = replace(ZEROED, channel=celsius, offset=1.5, moved=-0.5, before=293.15, after=292.65, spread=0.25)
    outcome, _ = zero(home, monkeypatch, warm, "1", "--dry-run", json=True)
    found = outcome.json
    assert found.pop("shown") == {
        "offset": 1.5, "moved": -0.5, "spread": 0.25, "before": pytest.approx(20.0), "after": pytest.approx(19.5),
        "unit": "°C",
    }  # fmt: skip
    assert found == {
        "uuid": NODE,
        "channel": 1,
        "name": "oil",
        "offset": 1.5,
        "moved": -0.5,
        "spread": 0.25,
        "before": 293.15,
        "after": 292.65,
        "unit": "K",
        "count": 16,
        "sequence": 7,
        "written": True,
        "dry_run": True,
        "changes": ["channel 1: the zero offset changes"],
        "warnings": ["the battery is low"],
        "steps": [
            {"name": "read", "result": "done", "seconds": 0.5},
            {"name": "sign", "result": "nothing to do", "seconds": 0.0},
        ],
    }


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("zero", NODE, "1", "--value", "nan", *BUS), "--value is not a finite number."),
        (("zero", NODE, "1", "--value", "inf", *BUS), "--value is not a finite number."),
        (("capture", NODE, "1", "--reference", "nan", "--to", "x.csv", *BUS), "--reference is not a finite number."),
        (("capture", NODE, "1", "--reference", "inf", "--to", "x.csv", *BUS), "--reference is not a finite number."),
        (("fit", "points.csv", "--laboratory", "points.csv"), "--laboratory belongs to a certificate."),
        (("fit", "points.xml"), "A certificate is fitted for a transducer type."),
        (("fit", "points.csv", "-p", NAMED, "--method", "table"), "The profile already sets the method."),
        (("fit", "points.csv", "-p", NAMED, "--degree", "2"), "The profile already sets the method."),
        (("fit", "lines.csv"), "There are no points to fit."),
    ],
)
def test_what_cannot_be_meant_is_refused(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("points.csv", "points.xml"):
        (tmp_path / name).write_text(FIT)
    (tmp_path / "lines.csv").write_text("# coefficients: 0, 0.1\n# unit: degree\n# raw range: 0, 100\n")
    refused = call(home, "--json", "calibrate", *words)
    if "lines.csv" not in words:
        assert (refused.code, refused.json["error"]["message"]) == (2, message)
    assert refused.code != 0


@pytest.mark.parametrize(("points", "holds"), [(1, "1 point."), (2, "2 points.")])
def test_a_captured_point_is_reported_whole(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, points: int, holds: str
) -> None:
    file, asked = tmp_path / "joint.csv", list[Any]()
    held = tuple({"raw": 32768.25, "value": 180.0 + number, "count": None} for number in range(points))
    result = CaptureResult(UUID, angle(), Point(1, 32768.25, degrees(180), 2.25, 32), held)

    def capture(*given: Any, **more: Any) -> CaptureResult:
        asked.extend((*given[2:6], more))
        return result

    monkeypatch.setattr(measure.capture, "capture_at", capture)
    words = ("calibrate", "capture", NODE, "angle", "--reference", "-180", "--unit", "degree", "--to", file, *BUS)
    outcome = call(home, *words)
    assert outcome.out == f"Channel 1: raw 32768.25 at 180 ° (32 samples, spread 2.25). {file} holds {holds}\n"
    assert asked == [NODE, "angle", -180.0, file, {"unit": "degree", "shown_unit_asked": False}]
    assert call(home, "--json", *words).json == {
        "uuid": NODE,
        "channel": 1,
        "name": "angle",
        "file": str(file),
        "added": {
            "raw": 32768.25,
            "mean": 32768.25,
            "reference": degrees(180),
            "unit": "rad",
            "spread": 2.25,
            "count": 32,
        },
        "points": [dict(point) for point in held],
    }


FIT = "# method: polynomial\n# degree: 1\nraw,value [degree]\n0,0\n100,90\n200,182\n300,270\n"


def test_a_fit_is_shown_with_its_residuals(home: Path, tmp_path: Path) -> None:
    """The line through these points is 0.2 + 0.902 raw; without an inner point it misses that one by 0.571 and 2."""
    file = tmp_path / "points.csv"
    file.write_text(FIT)
    shown = call(home, "calibrate", "fit", file, passphrase=None)
    assert [line.rstrip() for line in shown.out.splitlines()] == [
        "raw  value [degree]  fit       residual",
        "0    0               0.199998  -0.2",
        "100  90              90.4      -0.4",
        "200  182             180.6     +1.4",
        "300  270             270.8     -0.8",
        "channel 1: polynomial of degree 1, 4 points, largest residual 1.4 degree at raw 200, rms 0.837 degree",
        "Leave-one-out error of the inner points: up to 2 degree, rms 1.47 degree.",
    ]
    found = call(home, "--json", "calibrate", "fit", file, passphrase=None).json
    rows = [(0.0, 0.0, 0.2, -0.2), (100.0, 90.0, 90.4, -0.4), (200.0, 182.0, 180.6, 1.4), (300.0, 270.0, 270.8, -0.8)]
    one = {
        "channel": 1,
        "method": "polynomial",
        "kind": "polynomial of degree 1",
        "unit": "degree",
        "residuals": [
            {"raw": raw, "value": value, "fit": pytest.approx(fit, abs=1e-5),
             "residual": pytest.approx(left, abs=1e-5)}
            for raw, value, fit, left in rows
        ],
        "rms": pytest.approx(math.sqrt(0.7)),
        "maximum": pytest.approx(1.4, abs=1e-5),
        "left_out": {"rms": pytest.approx(1.4708, abs=1e-4), "maximum": pytest.approx(2.0)},
    }  # fmt: skip
    assert found == {"file": str(file), **one, "channels": [one], "warnings": []}
    other = call(home, "--json", "calibrate", "fit", file, "--method", "polynomial", "--degree", "2", passphrase=None)
    assert other.json["kind"] == "polynomial of degree 2"
    two = tmp_path / "two.csv"
    two.write_text("raw,value [degree]\n0,0\n100,90\n")
    assert call(home, "--json", "calibrate", "fit", two, passphrase=None).json["left_out"] is None
    assert "Leave-one-out" not in call(home, "calibrate", "fit", two, passphrase=None).out


def test_a_certificate_of_a_fit_says_what_it_does_not_state(home: Path, tmp_path: Path) -> None:
    file, dcc = tmp_path / "points.csv", tmp_path / "joint.xml"
    file.write_text(FIT)
    made = call(home, "--json", "calibrate", "fit", file, "--dcc", dcc, passphrase=None)
    assert (made.code, made.json["dcc"]) == (0, str(dcc))
    assert f"{dcc} does not state: " in made.err
    assert "--laboratory FILE.toml" in made.err
    again = call(home, "calibrate", "fit", file, "--dcc", dcc, passphrase=None)
    assert f"Wrote {dcc}; it is not signed." in again.err + again.out
    assert dcc.read_text().startswith("<?xml")
    assert dcc.stat().st_mode & 0o777 == 0o644
    assert "dcc" not in json.loads(call(home, "--json", "calibrate", "fit", file, passphrase=None).out)


@pytest.mark.parametrize(
    ("words", "message", "hint"),
    [
        (("points.csv", "--laboratory", "lab.toml"), "--laboratory belongs to a certificate.", "Add --dcc OUT.xml."),
        (("a.xml",), "A certificate is fitted for a transducer type.",
         "Add --profile P, or see: teds-provision show {}/a.xml"),
        (("points.csv", "-p", "magnetic-angular-position-sensor", "--method", "table"),
         "The profile already sets the method.", "Omit --method and --degree, or write them into the file."),
        (("points.csv", "-p", "magnetic-angular-position-sensor", "--degree", "2"),
         "The profile already sets the method.", "Omit --method and --degree, or write them into the file."),
    ],
)  # fmt: skip
def test_a_fit_that_contradicts_itself_is_refused_and_writes_nothing(
    words: tuple[str, ...], message: str, hint: str, home: Path, tmp_path: Path
) -> None:
    for name, text in (("points.csv", FIT), ("lab.toml", ""), ("a.xml", "<a/>")):
        (tmp_path / name).write_text(text)
    named = [str(tmp_path / word) if "." in word else word for word in words]
    certified = () if "--laboratory" in words else ("--dcc", tmp_path / "out.xml")
    done = call(home, "--json", "calibrate", "fit", *named, *certified, passphrase=None)
    error = done.json["error"]
    assert (done.code, error["message"], error["hint"]) == (2, message, hint.format(tmp_path))
    assert not (tmp_path / "out.xml").exists()


def test_the_method_of_the_command_goes_before_that_of_the_file(home: Path, tmp_path: Path) -> None:
    plain, file = tmp_path / "plain.csv", tmp_path / "points.csv"
    plain.write_text(FIT.partition("raw,")[1] + FIT.partition("raw,")[2])
    file.write_text(FIT)

    def kind(name: Path, *words: str) -> tuple[str, str]:
        shown = call(home, "--json", "calibrate", "fit", name, *words, passphrase=None).json
        return shown["method"], shown["kind"]

    assert kind(plain)[0] == "table"
    assert kind(plain, "--method", "polynomial") == ("polynomial", "polynomial of degree 3")
    assert kind(plain, "--method", "polynomial", "--degree", "1") == ("polynomial", "polynomial of degree 1")
    assert kind(file) == ("polynomial", "polynomial of degree 1")
    assert kind(file, "--degree", "2") == ("polynomial", "polynomial of degree 2")
    assert kind(file, "--method", "table")[0] == "table"


def test_the_largest_error_of_what_was_left_out_counts_without_its_sign(home: Path, tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_text("raw,value [degree]\n0,0\n100,90\n200,210\n300,270\n")
    found = call(home, "--json", "calibrate", "fit", file, passphrase=None).json
    # without 100 its value would be 105, without 200 it would be 180
    assert found["left_out"] == {"maximum": pytest.approx(30.0), "rms": pytest.approx(math.sqrt((225 + 900) / 2))}
    shown = call(home, "calibrate", "fit", file, passphrase=None)
    assert shown.out.endswith("Leave-one-out error of the inner points: up to 30 degree, rms 23.7 degree.\n")


def test_a_fit_for_a_type_is_that_of_the_profile_and_of_the_guard(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, orders = tmp_path / "joint.csv", list[BuildOrder]()
    file.write_text("raw,value [degree]\n0,0\n32768,180.5\n65535,360\n")
    words = ("calibrate", "fit", file, "--profile", "magnetic-angular-position-sensor")
    found = call(home, "--json", *words, passphrase=None).json
    assert (found["channel"], found["unit"], found["warnings"]) == (1, "degree", [])
    assert [row["raw"] for row in found["residuals"]] == [0, 32768, 65535]
    one, two = (
        replace(calibration, channel=number)
        for number in (1, 2)
        for calibration in fit_points(FIT, "points.csv").values()
    )

    def prepare(_station: Any, order: BuildOrder) -> Any:
        orders.append(order)
        return SimpleNamespace(calibrations={2: two, 1: one}, warnings=("Its slope is odd.",))

    monkeypatch.setattr(provisioning.build, "prepare", prepare)
    done = call(home, "--json", *words, passphrase=None)
    assert [fit["channel"] for fit in done.json["channels"]] == [1, 2]
    assert (done.json["channel"], done.json["warnings"]) == (1, ["Its slope is odd."])
    assert orders == [BuildOrder("magnetic-angular-position-sensor", calibration=file)]
    shown = call(home, *words, passphrase=None)
    assert shown.err == "Warning: Its slope is odd.\n"
    lines = [line for line in shown.out.splitlines() if line.startswith("channel")]
    assert [line.partition(":")[0] for line in lines] == ["channel 1", "channel 2"]


def test_a_certificate_has_the_laboratory_the_node_the_day_and_the_program(home: Path, tmp_path: Path) -> None:
    file, dcc, lab = tmp_path / "points.csv", tmp_path / "joint.xml", tmp_path / "lab.toml"
    file.write_text("# node: 8d4d9da65281f7000000\n" + FIT)
    lab.write_text('laboratory = "Metrology of Stockholm"\n')
    words = ("calibrate", "fit", file, "--dcc", dcc)
    done = call(home, "--json", *words, "--laboratory", lab, passphrase=None)
    assert done.code == 0, done
    text = dcc.read_text()
    assert "Metrology of Stockholm" in text
    assert "8d4d9da65281f7000000" in text
    assert f"<dcc:release>v{__version__.partition('.dev')[0]}<" in text
    assert str(datetime.now(UTC).date()) in text
    call(home, *words, passphrase=None)
    assert "Metrology of Stockholm" not in dcc.read_text(), "written again, without the laboratory"


def test_a_zero_in_a_unit_with_an_offset_shows_differences_as_differences(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A spread of 0.25 K is 0.25 °C, and not -272.9 °C; the name of a channel is foreign text."""
    celsius = replace(angle(), name="oil\nWritten", units=parse_unit("K").units, display="degC")
    warm = replace(ZEROED, channel=celsius, offset=1.5, moved=-0.5, before=293.15, after=292.65, spread=0.25)
    outcome, _ = zero(home, monkeypatch, warm, "1")
    assert outcome.out.splitlines()[0] == (
        "Channel 1 (oil?Written) read 20 °C (16 samples, spread 0.25 °C) and now reads 19.5 °C: "
        "zero offset 1.5 °C (moved by -0.5 °C)."
    )


def test_the_largest_error_may_be_one_below_the_curve(home: Path, tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_text("raw,value [degree]\n0,0\n100,90\n200,150\n300,270\n")
    found = call(home, "--json", "calibrate", "fit", file, passphrase=None).json["left_out"]
    # without 100 its value would be 75, without 200 it would be 180
    assert found == {"maximum": pytest.approx(30.0), "rms": pytest.approx(math.sqrt((225 + 900) / 2))}


@pytest.mark.parametrize("name", ["JOINT.XML", "joint.Xml"])
def test_a_certificate_is_one_in_any_case_of_its_extension(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    file = tmp_path / name
    file.write_bytes(b"\xff\xfe<certificate/>")
    refused = call(home, "--json", "calibrate", "fit", file)
    assert (refused.code, refused.json["error"]["message"]) == (2, "A certificate is fitted for a transducer type.")
    one = fit_points(FIT, "points.csv")
    monkeypatch.setattr(
        provisioning.build, "prepare", lambda _station, _order: SimpleNamespace(calibrations=one, warnings=())
    )
    assert call(home, "calibrate", "fit", file, "-p", NAMED).code == 0, "it is not read as text"
