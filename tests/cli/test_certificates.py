"""Calibration certificates on the command line: shown, chosen from, trusted, written."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from teds_provision.teds.certificate import certificate_reference_of
from teds_provision.teds.dcc import xml_tree
from teds_provision.teds.image import Image
from tests.bench import PASSPHRASE
from tests.teds.certificates import ANGLE, EXAMPLES, POINTS, TEMPERATURE, changed, signer
from tests.terminal import on_terminal

from .shell import call

UUID = "8d4d9da65281f7000000"
BUILD = ("build", UUID, "--profile", "magnetic-angular-position-sensor", "--calibration")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    lab = signer()
    (tmp_path / "lab.pem").write_bytes(lab.certificate)
    (tmp_path / "good.xml").write_bytes(lab.sign(ANGLE))
    (tmp_path / "bad.xml").write_bytes(changed(lab.sign(ANGLE), ("91.6", "81.6")))
    return tmp_path


def test_a_certificate_is_shown_with_its_items_and_what_was_not_checked(home: Path, folder: Path) -> None:
    file = EXAMPLES / "temperature.xml"
    done = call(home, "--json", "show", file)
    assert done.code == 0, done.err
    (known,) = done.json["certificates"]
    assert (known["certificate"], known["date"], known["signature"]) == ("T-2026-118", "2026-09-30", "not checked")
    assert known["sha256"] == hashlib.sha256(TEMPERATURE).hexdigest()
    assert [(item["id"], item["state"]) for item in known["items"]] == [
        ("as-found", "as found"),
        ("as-left", "as left"),
    ]
    assert known["items"][1]["points"][1] == [313.21, 40.0]
    assert known["not_checked"] == ["The certificate has no signature."]
    people = call(home, "show", file).out
    for text in ("Thermolab Example, AT", "S-2044 (manufacturer)", "Ambient temperature: 296.2 K", "item as-left"):
        assert text in people
    good = call(home, "--json", "show", folder / "good.xml", "--trust-dcc", folder / "lab.pem")
    assert good.json["certificates"][0]["signature"] == "good"
    for more in ((), ("--trust-dcc", folder / "lab.pem")):
        refused = call(home, "--json", "show", folder / "bad.xml", *more)
        assert (refused.code, refused.json["error"]["code"]) == (4, "not-authentic")
    assert call(home, "show", file, "--format", "xml").code == 8, "it holds no TEDS"


def test_build_reports_certificate_and_signature_and_a_bad_one_ends_it(home: Path, folder: Path) -> None:
    image = folder / "image.json"
    trusted = ("--trust-dcc", folder / "lab.pem")
    done = call(home, "--json", *BUILD, folder / "good.xml", *trusted, "--due", "2027-06-30", "--output", image)
    assert done.code == 0, done.err
    calibration = done.json["calibration"]
    assert calibration == {
        "certificate": "B2-2026-0042",
        "laboratory": "Bench 2, robot laboratory",
        "date": "2026-10-12",
        "sha256": hashlib.sha256((folder / "good.xml").read_bytes()).hexdigest(),
        "signature": "good",
    }
    assert done.json["calibrations"][0]["due"].startswith("2027-06-30")
    reference = certificate_reference_of(Image.from_json(image.read_text()).blocks, 1)
    assert reference is not None
    assert reference.sha256 == calibration["sha256"]
    plain = call(home, "--json", *BUILD, f"1={EXAMPLES / 'angle.xml'}")
    assert plain.json["calibration"]["signature"] == "not checked"
    assert call(home, "--json", *BUILD, EXAMPLES / "angle.csv").json.keys() & {"calibration"} == set()
    for file in (folder / "bad.xml", EXAMPLES / "angle.xml"):
        refused = call(home, "--json", *BUILD, file, *trusted)
        assert (refused.code, refused.json["error"]["code"]) == (4, "not-authentic")


def test_an_unclear_item_is_asked_about_and_without_a_terminal_refused(home: Path) -> None:
    build = ("--json", "build", UUID, "--profile", "temperature-sensor", "--calibration", EXAMPLES / "temperature.xml")
    refused = call(home, *build)
    assert (refused.code, refused.json["error"]["code"]) == (2, "unclear-item")
    assert "as-found" in refused.json["error"]["message"]
    assert call(home, *build, "--item", "as-left").json["calibration"]["certificate"] == "T-2026-118"
    assert call(home, *build, "--item", "nothing").code == 2
    assert call(home, *build, "--item", "as-left", "--due", "soon").code == 2
    assert call(home, "--json", "build", UUID, "--item", "as-left").code == 2
    other = call(home, *build[:-1], f"2={EXAMPLES / 'temperature.xml'}")
    assert other.code == 8
    assert "channels 1 to 1" not in other.out


def test_a_person_at_a_terminal_chooses_the_item(home: Path) -> None:
    words = ("build", UUID, "--profile", "temperature-sensor", "--calibration", EXAMPLES / "temperature.xml")
    shown = on_terminal(home, *words, answers=["as-left"], passphrase=PASSPHRASE)
    assert shown.code == 0, shown.screen
    assert "as-found: Before adjustment, as found" in shown.screen.replace("\r\n", " ").replace("  ", " ")
    assert "certificate T-2026-118" in shown.screen.replace("\r\n", " ")
    assert shown.screen.count("Which one") == 1, "asked once, however often the file is read"


def test_without_the_extra_its_install_command_is_named(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(xml_tree, "find_spec", lambda _: None)
    refused = call(home, "--json", "show", EXAMPLES / "angle.xml")
    assert refused.code == 2
    assert "needs lxml" in refused.json["error"]["message"]
    assert "[bench]" in refused.json["error"]["hint"]


def test_a_fit_is_written_as_a_certificate_that_calibrates(home: Path, tmp_path: Path) -> None:
    out, csv = tmp_path / "angle.xml", EXAMPLES / "angle.csv"
    fit = ("--json", "calibrate", "fit", csv, "--method", "linear")
    done = call(home, *fit, "--dcc", out, "--laboratory", EXAMPLES / "laboratory.toml")
    assert done.code == 0, done.err
    assert done.json["dcc"] == str(out)
    assert done.json["method"] == "linear"
    shown = call(home, "--json", "show", out).json["certificates"][0]
    assert shown["items"][0]["points"] == [list(pair) for pair in POINTS]
    assert shown["conditions"] == [{"name": "Ambient temperature", "text": "23.1 °C"}]
    assert call(home, "--json", *BUILD, out).json["calibration"]["certificate"] == "B2-2026-0042"
    bare = call(home, *fit, "--dcc", out)
    assert bare.code == 0
    assert "does not state: laboratory, country, person, customer, certificate" in bare.err
    assert call(home, *fit, "--laboratory", EXAMPLES / "laboratory.toml").code == 2
    certified = call(home, "--json", "calibrate", "fit", out)
    assert certified.code == 2
    assert "--profile" in certified.json["error"]["hint"]
    again = call(home, "--json", "calibrate", "fit", out, "--profile", "magnetic-angular-position-sensor")
    assert again.json["residuals"][0]["raw"] == POINTS[0][0]
