"""People see the unit of the profile, programs get SI; limits are told in the unit that was given."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from teds_provision.teds.profile import shipped_profiles
from teds_provision.teds.sheet import Channel
from teds_provision.teds.units import units_of
from tests.e2e.desk import ANGLE
from tests.terminal import on_terminal

from .rig import Rig

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    made = Rig(tmp_path_factory.mktemp("rig"))
    made.nodes["a"].start()
    made.nodes["g"].start()
    yield made
    made.close()


def shown_in(rig: Rig, unit: str) -> None:
    """The station's own version of the type says in which unit its values are shown."""
    folder = rig.station.home / "profiles"
    folder.mkdir(exist_ok=True)
    text = (shipped_profiles() / f"{ANGLE}.toml").read_text()
    text = text.replace('unit = "degree"\n', f'unit = "degree"\ndisplay-unit = "{unit}"\n', 1)
    (folder / f"{ANGLE}.toml").write_text(text)


def test_a_reading_is_shown_in_the_unit_of_the_profile_and_json_stays_si(rig: Rig) -> None:
    for unit, factor in (("degree", 180 / math.pi), ("mrad", 1000.0)):
        shown_in(rig, unit)
        (sample,) = rig.ask("sample", "a")["samples"]
        assert sample["unit"] == "rad"
        assert sample["shown"]["unit"].startswith({"degree": "°", "mrad": "mrad"}[unit])
        assert sample["shown"]["value"] == pytest.approx(sample["value"] * factor)
        assert sample["shown"]["uncertainty"] == pytest.approx(sample["uncertainty"] * factor)
        outcome = rig.station.run("sample", "a", "--can", rig.can)
        assert f" {sample['shown']['unit']} " in outcome.out.replace("\n", " "), outcome.out


def test_a_profile_that_is_gone_or_of_another_dimension_changes_nothing(rig: Rig) -> None:
    shown_in(rig, "kg")
    assert rig.ask("sample", "a")["samples"][0]["shown"]["unit"] == "°"
    assert Channel(1, units=units_of(radians=1), display="kg").shown.text == "°"
    assert Channel(1, units=units_of(radians=1), display="no unit").shown.text == "°"


def test_limits_are_stated_in_the_unit_that_was_given(rig: Rig) -> None:
    for unit, words in (("mm", "0 to 110 mm"), ("m", "0 to 0.11 m"), ("cm", "0 to 11 cm")):
        reply = rig.ask("set", "g", "1", "5000", "--unit", unit, "--hold", "0.1", code=6)
        assert words in reply["error"]["message"]
        assert f"5000 {unit} exceeds the limits" in reply["error"]["message"]


def test_a_bare_number_is_refused_if_another_unit_is_shown(rig: Rig) -> None:
    words = ["set", "g", "1", "0.05", "--hold", "0.1", "--can", rig.can]
    outcome = on_terminal(rig.station.home, *words, passphrase=rig.station.passphrase)
    assert (outcome.code, "--unit mm or --unit m" in " ".join(outcome.screen.split())) == (2, True), outcome
    applied = rig.station.run("--json", "set", "g", "1", "0.05", "--hold", "0.1", "--can", rig.can)
    assert applied.code == 0, "a program means SI"
