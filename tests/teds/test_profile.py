"""Profiles: what is shipped is right, what is wrong is named with file, line and field."""

from __future__ import annotations

import errno
import hashlib
import math
import os
import re
import tomllib
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.errors import BadDataError, NotFoundError
from teds_provision.teds.calibration import fit
from teds_provision.teds.codec.frame import frame, unframe
from teds_provision.teds.formats import TedsBlock, lost, read_blocks
from teds_provision.teds.profile import (
    Profile,
    check,
    default_folders,
    find_profile,
    keys,
    list_profiles,
    load,
    load_profile,
    passed_over,
    shipped_profiles,
    template,
)
from teds_provision.teds.profile.load import _is_base, describe_channel, files_digest, listed, parse_profile
from teds_provision.teds.profile.model import CalibrationDemand
from teds_provision.teds.profile.reader import key_lines
from teds_provision.teds.show import describe
from teds_provision.teds.units import parse_unit

UUID = bytes.fromhex("81c0f9744881f5622e78")
CHANNEL = """\
[channel.1]
name = "force"
type = "sensor"
unit = "N"
low-limit = 0
high-limit = 10
uncertainty = 0.1
update-time = "1 ms"
read-setup-time = 0.0
sampling-period = "1 kHz"
warm-up-time = 1
read-delay-time = 0.0
sample = { model = "unsigned", octets = 2, bits = 12 }
sampling = { modes = ["trigger"] }
"""
GOOD = (
    """\
title = "Force"
[meta]
operation-timeout = "100 ms"
self-test-time = 0.0
"""
    + CHANNEL
)


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / f"{name}.toml"
    path.write_text(text, encoding="utf-8")
    return path


def shipped() -> list[str]:
    return [listed.name for listed in list_profiles([shipped_profiles()])]


# --- what is shipped


def test_the_two_types_of_the_papers_and_more_are_shipped() -> None:
    assert {"tactile-finger-sensor", "magnetic-angular-position-sensor"} < set(shipped())
    assert len(shipped()) >= 6


@pytest.mark.parametrize("edition", [2007, 2024])
@pytest.mark.parametrize("name", shipped())
def test_every_shipped_profile_builds_clean_teds_without_a_warning(name: str, edition: teds.Edition) -> None:
    profile = load_profile(name, [shipped_profiles()])
    assert profile.warnings == ()
    if profile.abstract:
        with pytest.raises(BadDataError, match="base"):
            profile.build(UUID)
        return
    built = profile.build(UUID if edition == 2007 else bytes(16), edition=edition)
    assert built.blocks
    for (channel, access_code), octets in built.blocks.items():
        decoded = teds.decode(octets)
        assert (decoded.verdict, decoded.edition, decoded.access_code) == ("clean", edition, access_code)
        assert 0 <= channel <= len(profile.channels)


def test_the_angular_sensor_says_what_the_paper_says() -> None:
    profile = load_profile("magnetic-angular-position-sensor", [shipped_profiles()])
    channel = teds.decode(profile.build(UUID).blocks[1, 3])
    assert channel.get("PhyUnits") == parse_unit("rad").units
    assert channel.get("LowLimit") == 0
    assert channel.get("HiLimit") == pytest.approx(2 * math.pi)
    assert channel.get("OError") == pytest.approx(math.radians(1))
    assert channel.get("SPeriod") == pytest.approx(1e-4)
    assert (channel.get("DatModel"), channel.get("ModLenth"), channel.get("SigBits")) == (0, 2, 16)
    demand = profile.channels[0].calibration
    assert (demand.required, demand.method, demand.zero_offset, demand.standard_deviation) == (
        True,
        "table",
        True,
        0.4619,
    )
    assert "can" in profile.links


def test_the_tactile_sensor_has_a_channel_for_each_stage_of_its_converter() -> None:
    profile = load_profile("tactile-finger-sensor", [shipped_profiles()])
    built = profile.build(UUID, name="left index")
    meta = teds.decode(built.blocks[0, 1])
    assert (meta.get("UUID"), meta.get("MaxChan")) == (UUID, 12)
    assert meta.get("MemList") == tuple(range(1, 13))
    assert teds.decode(built.blocks[0, 12]).get("TCName") == "left index"
    assert teds.decode(built.blocks[12, 12]).get("TCName") == "taxel 12"
    assert teds.decode(built.blocks[7, 3]).get("PhyUnits") == parse_unit("N").units
    assert profile.links == ("nfc", "ble")


def test_the_gripper_has_an_actuator_and_the_switch_an_event_sensor() -> None:
    gripper = load_profile("gripper", [shipped_profiles()])
    assert [channel.type for channel in gripper.channels] == [1, 0, 0]
    switch = load_profile("limit-switch", [shipped_profiles()]).build(UUID)
    assert teds.decode(switch.blocks[1, 3]).get("EdgeRpt") == 7


def test_limits_may_be_written_in_another_unit_than_the_channel() -> None:
    axis = load_profile("accelerometer", [shipped_profiles()]).channels[0]
    assert axis.low_limit == pytest.approx(-4 * 9.80665)
    assert axis.uncertainty == pytest.approx(0.04 * 9.80665)


def test_a_profile_is_found_by_name_in_the_users_folders_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    home = tmp_path / "home"
    (home / "profiles").mkdir(parents=True)
    mine = write(home / "profiles", "load-cell", GOOD)
    folders = default_folders(home)
    assert find_profile("load-cell", folders).resolve() == mine.resolve()
    listed = {entry.name: entry for entry in list_profiles(folders)}
    assert listed["load-cell"].path.resolve() == mine.resolve()
    assert "gripper" in listed


def test_a_profile_that_may_not_be_read_is_listed_with_its_error_beside_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path, "arm", GOOD)
    write(tmp_path, "locked", GOOD)
    opened = os.open

    def refused(path: Any, *words: Any, **more: Any) -> int:
        if str(path).endswith("locked.toml"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return opened(path, *words, **more)

    monkeypatch.setattr(os, "open", refused)
    good, locked = list_profiles([tmp_path])
    assert good.profile is not None
    assert (locked.name, locked.profile) == ("locked", None)
    assert "locked.toml" in locked.error


def test_a_broken_profile_is_listed_with_its_error(tmp_path: Path) -> None:
    write(tmp_path, "broken", "title = \n")
    (entry,) = list_profiles([tmp_path])
    assert entry.profile is None
    assert "broken.toml:1" in entry.error
    file = str(tmp_path / "broken.toml")
    assert listed(entry) == {"name": "broken", "file": file, "error": entry.error}
    write(tmp_path, "broken", 'extends = "no-such-type"\n')
    (entry,) = list_profiles([tmp_path])
    assert (entry.profile, "no-such-type" in entry.error) == (None, True)
    write(tmp_path, "broken", 'links = ["nfc", "can"]\n' + GOOD)
    (entry,) = list_profiles([tmp_path])
    assert listed(entry) == {
        "name": "broken",
        "title": "Force",
        "file": file,
        "abstract": False,
        "links": ["nfc", "can"],
        "channels": 1,
    }


def test_a_file_that_is_removed_while_the_folder_is_listed_is_no_end_of_the_list(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone, good = tmp_path / "gone.toml", write(tmp_path, "good", GOOD)
    monkeypatch.setattr(load, "_files", lambda _: [gone, good])
    first, second = list_profiles([tmp_path])
    assert (first.name, first.profile, first.error) == ("gone", None, f"There is no profile file {gone}.")
    assert second.profile is not None


def test_a_channel_of_a_type_as_data(tmp_path: Path) -> None:
    """In the unit of the channel; an uncertainty is a difference, a time is in seconds."""
    text = GOOD.replace('unit = "N"', 'unit = "degC"').replace("uncertainty = 0.1", 'uncertainty = "0.1 K"')
    (channel,) = load_profile(write(tmp_path, "force", text)).channels
    expected: dict[str, object] = {
        "number": 1,
        "name": "force",
        "type": "sensor",
        "unit": "degC",
        "low_limit": 0.0,
        "high_limit": 10.0,
        "uncertainty": 0.1,
        "frame": None,
        "raw_range": [0.0, 4095.0],
        "sampling_period": 0.001,
        "calibration": {
            "required": False,
            "method": None,
            "degree": None,
            "monotone": None,
            "interval": None,
            "zero_offset": False,
            "standard_deviation": None,
        },
    }
    found = describe_channel(channel)
    for name in ("low_limit", "high_limit", "uncertainty"):
        assert found.pop(name) == pytest.approx(expected.pop(name), abs=1e-9), name  # type: ignore[arg-type]
    assert found == expected
    assert describe_channel(replace(channel, frame="a"))["frame"] == "a"


def test_an_unknown_profile_is_not_found_and_the_nearest_is_named() -> None:
    with pytest.raises(NotFoundError) as caught:
        load_profile("tactile-finger-senser", [shipped_profiles()])
    assert '"tactile-finger-sensor"' in caught.value.hint
    with pytest.raises(NotFoundError):
        load_profile("../secret", [shipped_profiles()])
    with pytest.raises(NotFoundError):
        load_profile(Path("/no/such.toml"))


# --- building


def test_a_calibration_becomes_a_block_and_its_key(tmp_path: Path) -> None:
    profile = load_profile(write(tmp_path, "force", GOOD))
    line = fit([(0, 0.0), (4095, 10.0)], "linear", channel=1)
    assert teds.decode(profile.build(UUID).blocks[1, 3]).get("CalKey") == 0
    built = profile.build(UUID, calibration={1: line})
    assert teds.decode(built.blocks[1, 3]).get("CalKey") == 1
    assert teds.decode(built.blocks[1, 5]).verdict == "clean"
    assert list(built.blocks) == sorted(built.blocks)
    again = profile.build(UUID, name="another")  # what all nodes have alike is kept; the key and the name are not
    assert teds.decode(again.blocks[1, 3]).get("CalKey") == 0
    assert teds.decode(again.blocks[0, 12]).get("TCName") == "another"
    fresh = load_profile(write(tmp_path, "force", GOOD)).build(UUID, name="another")
    assert again.blocks == fresh.blocks


def test_what_a_person_should_know_is_a_warning(tmp_path: Path) -> None:
    text = GOOD + '[channel.1.calibration]\nrequired = true\nmethod = "table"\ninterval = "1 year"\n'
    profile = load_profile(write(tmp_path, "force", text))
    now = datetime(2026, 11, 21, tzinfo=UTC)
    assert "asks for one" in profile.build(UUID).warnings[0]
    line = replace(fit([(0, 0.0), (4095, 10.0)], "linear", channel=1), date=now - timedelta(days=500))
    warnings = profile.build(UUID, calibration={1: line}, now=now).warnings
    assert any("due again" in warning for warning in warnings)
    assert any("method table" in warning for warning in warnings)


def test_a_uuid_of_the_wrong_length_and_a_foreign_channel_are_refused(tmp_path: Path) -> None:
    profile = load_profile(write(tmp_path, "force", GOOD))
    with pytest.raises(BadDataError, match="10 octets"):
        profile.build(bytes(16))
    with pytest.raises(BadDataError) as refused:
        profile.build(UUID, calibration={2: fit([(0, 0.0), (1, 1.0)], "linear", channel=2)})
    assert refused.value.message == "The calibration is for channel 2; force has channel 1 only."
    assert refused.value.hint.endswith("or --no-calibration to drop the one that the node has.")
    with pytest.raises(BadDataError, match=r"for channel 13; tactile-finger-sensor has channels 1 to 12\.$"):
        load_profile("tactile-finger-sensor").build(
            UUID, calibration={13: fit([(0, 0.0), (1, 1.0)], "linear", channel=13)}
        )
    base = load_profile(write(tmp_path, "base", "abstract = true\n" + GOOD))
    with pytest.raises(BadDataError) as refused:
        base.build(UUID)
    assert refused.value.message == "The profile base is only a base for others."
    assert refused.value.hint == "Use a profile that extends it; see profile list."
    built = profile.build(UUID, edition=2024)
    assert "six zero octets" in built.warnings[0]
    assert teds.decode(built.blocks[0, 1]).get("UUID") == bytes(6) + UUID


def test_texts_and_phy_are_built_if_the_profile_has_them(tmp_path: Path) -> None:
    text = GOOD + '[phy]\nradio = "bluetooth"\nbattery = true\n[[text]]\nkind = "title"\nxml = "<Title>Ä</Title>"\n'
    built = load_profile(write(tmp_path, "force", text)).build(UUID)
    phy = teds.decode(built.blocks[0, 13])
    assert (phy.verdict, phy.get("Radio"), phy.get("Battery")) == ("clean", 1, 1)
    assert teds.decode(built.blocks[0, 11]).text == ("<Title>Ä</Title>".encode(),)


def test_groups_proxies_and_places_go_into_the_meta_teds(tmp_path: Path) -> None:
    extra = """\
[[meta.control-group]]
type = 0
members = [1]
[[meta.control-group]]
type = 1
members = [1]
[[meta.proxy]]
channel = 2
organization = 1
members = [1]
[[meta.geo-location]]
location = 1
type = 0
members = [1]
"""
    decoded = teds.decode(load_profile(write(tmp_path, "force", GOOD + extra)).build(UUID).blocks[0, 1])
    assert decoded.verdict == "clean"
    assert [field.name for field in decoded.fields].count("CGroup") == 2
    assert decoded.get("Organiz") == 1


# --- inheritance


def test_a_profile_says_only_what_differs_from_the_one_it_extends(tmp_path: Path) -> None:
    write(tmp_path, "base", GOOD)
    profile = load_profile(write(tmp_path, "mine", 'extends = "base"\n[channel.1]\nhigh-limit = 20\n'), [tmp_path])
    assert (profile.channels[0].high_limit, profile.channels[0].low_limit) == (20, 0)
    assert profile.lineage == ("mine", "base")


def test_tables_are_laid_over_each_other_key_by_key_and_lists_replaced_whole(tmp_path: Path) -> None:
    more = 'links = ["nfc", "can"]\nabstract = true\n'
    texts = '[[text]]\nkind = "title"\nxml = "a"\n[[text]]\nkind = "commands"\nxml = "b"\n'
    write(tmp_path, "base", more + GOOD.replace('modes = ["trigger"]', 'modes = ["trigger", "immediate"]') + texts)
    own = 'links = ["ble"]\n[channel.1]\nsample = { bits = 10 }\nsampling = { modes = ["continuous"] }\n'
    own += '[[text]]\nkind = "title"\nxml = "c"\n'
    profile = load_profile(write(tmp_path, "mine", f'extends = "base"\n{own}'), [tmp_path])
    assert (profile.links, profile.abstract) == (("ble",), False)
    fields = profile.channels[0].fields
    assert fields["Sample"] == {"DatModel": 0, "ModLenth": 2, "SigBits": 10}
    assert fields["Sampling"] == {"SampMode": 8, "SDefault": 8}
    assert [(text.access_code, text.text) for text in profile.texts] == [(11, "c")]


def test_a_nodes_name_is_the_title_and_the_title_that_of_the_file(tmp_path: Path) -> None:
    without = GOOD.partition("\n")[2]
    for head, names in (
        ("", ("force", "force")),
        ('title = "Force"\n', ("Force", "Force")),
        ('title = "Force"\nname = "f"\n', ("Force", "f")),
    ):
        profile = load_profile(write(tmp_path, "force", head + without))
        assert (profile.name, profile.title, profile.tim_name) == ("force", *names)


def test_the_digest_of_a_type_is_that_of_its_file_or_of_all_from_the_outermost_base_on(tmp_path: Path) -> None:
    """contract/plant.md section 9: each preceded by its length as u32."""
    base = write(tmp_path, "base", GOOD)
    middle = write(tmp_path, "middle", 'extends = "base"\n')
    own = write(tmp_path, "own", 'extends = "middle"\ntitle = "Ä"\n')
    assert files_digest(base, [tmp_path]) == hashlib.sha256(GOOD.encode()).hexdigest()
    framed = len(GOOD).to_bytes(4, "big") + GOOD.encode() + b'\0\0\0\x11extends = "base"\n'
    assert files_digest(middle, [tmp_path]) == hashlib.sha256(framed).hexdigest()
    framed += b"\0\0\0\x20" + 'extends = "middle"\ntitle = "Ä"\n'.encode()
    assert files_digest(own, [tmp_path]) == hashlib.sha256(framed).hexdigest()


def test_a_name_has_120_octets_and_a_degree_is_from_1_to_12(tmp_path: Path) -> None:
    long = "ä" * 60
    for degree in (1, 12):
        text = GOOD.replace('name = "force"', f'name = "{long}"').replace('"Force"', f'"Force"\nname = "{long}"')
        profile = load_profile(write(tmp_path, "force", f"{text}[channel.1.calibration]\ndegree = {degree}\n"))
        assert (profile.tim_name, profile.channels[0].name) == (long, long)
        assert profile.channels[0].calibration.degree == degree


@pytest.mark.parametrize(
    ("model", "octets", "wanted"),
    [("unsigned", 0, "1 to 8"), ("unsigned", 9, "1 to 8"), ("bits", 0, "1 to 255"), ("float32", 8, "4")],
)
def test_a_sample_has_as_many_octets_as_its_model_allows(tmp_path: Path, model: str, octets: int, wanted: str) -> None:
    """A sample of no octets was accepted: nothing that is measured could be read."""
    text = re.sub(r"sample = .*", f'sample = {{ model = "{model}", octets = {octets}, bits = 0 }}', GOOD)
    with pytest.raises(BadDataError, match=f"a sample of model {model} has {wanted} octets, not {octets}"):
        load_profile(write(tmp_path, "force", text))


def test_a_number_that_is_no_data_model_is_named(tmp_path: Path) -> None:
    """It ended in an error of Python, also where a profile was made from a datasheet that has it."""
    with pytest.raises(BadDataError, match=r"channel\.1\.sample\.model: 8 is no data model; unsigned, float32,"):
        load_profile(write(tmp_path, "force", GOOD.replace('"unsigned"', "8")))
    assert load_profile(write(tmp_path, "force", GOOD.replace('"unsigned"', "0"))).warnings == ()
    path = shipped_profiles() / "load-cell.toml"
    blocks = read_blocks(path.read_bytes(), path=path)
    (place,) = [number for number, block in enumerate(blocks) if block.access_code == 3]
    changed = unframe(blocks[place].octets).replace(bytes.fromhex("280100"), bytes.fromhex("28015d"))
    blocks[place] = blocks[place]._replace(octets=frame(changed))
    assert "93 is no data model" in lost(blocks, "toml")[0]


def test_the_narrower_selection_of_channels_wins(tmp_path: Path) -> None:
    text = GOOD.replace("[channel.1]", "[channel.all]").replace(
        '"force"', '"f {channel}"\nframe = "{node}/{channel}_{channel}"'
    )
    text += "[channel.2]\nhigh-limit = 2\n[channel.1-3]\nhigh-limit = 3\n"
    profile = load_profile(write(tmp_path, "many", text))
    assert [channel.high_limit for channel in profile.channels] == [3, 2, 3]
    assert [channel.name for channel in profile.channels] == ["f 1", "f 2", "f 3"]
    assert [channel.frame for channel in profile.channels] == ["{node}/1_1", "{node}/2_2", "{node}/3_3"]
    twice = load_profile(write(tmp_path, "twice", text.replace('"f {channel}"', '"{channel} of {channel}"')))
    assert [channel.name for channel in twice.channels] == ["1 of 1", "2 of 2", "3 of 3"]


@pytest.mark.parametrize("circle", [("a",), ("a", "b"), ("a", "b", "c")])
def test_a_circle_of_profiles_is_refused(circle: tuple[str, ...], tmp_path: Path) -> None:
    for name, base in zip(circle, circle[1:] + circle[:1], strict=True):
        write(tmp_path, name, f'extends = "{base}"\n')
    with pytest.raises(BadDataError, match="circle: a -> "):
        load_profile("a", [tmp_path])


def test_a_users_profile_may_extend_the_shipped_one_of_the_same_name(tmp_path: Path) -> None:
    path = write(tmp_path, "load-cell", 'extends = "load-cell"\n[channel.1]\nhigh-limit = 100\nlow-limit = -100\n')
    assert load_profile(path, [tmp_path, shipped_profiles()]).channels[0].high_limit == 100


def test_what_a_text_without_a_file_extends_is_never_a_file_of_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """docs/formats.md: a file in the working folder never replaces a type that comes with the tool."""
    shipped_one = load_profile("load-cell", [shipped_profiles()])
    monkeypatch.chdir(tmp_path)
    write(tmp_path, "load-cell", GOOD)
    (tmp_path / "profiles").mkdir()
    write(tmp_path / "profiles", "load-cell", GOOD)
    write(tmp_path / "profiles", "own-cell", GOOD)
    assert parse_profile('extends = "load-cell"\n').channels == shipped_one.channels
    assert parse_profile('extends = "own-cell"\n').channels[0].high_limit == 10
    beside = load_profile(write(tmp_path, "mine", 'extends = "load-cell"\n'))
    assert beside.channels[0].high_limit == 10, "what a file extends may lie beside it"


def test_an_error_in_an_inherited_file_names_that_file(tmp_path: Path) -> None:
    write(tmp_path, "base", GOOD.replace('unit = "N"', 'unit = "Newtons of"'))
    write(tmp_path, "mine", 'extends = "base"\n')
    with pytest.raises(BadDataError, match=r"base\.toml:8: channel\.1\.unit: "):
        load_profile("mine", [tmp_path])


# --- errors


@pytest.mark.parametrize(
    ("old", "new", "line", "field", "words"),
    [
        ('unit = "N"', 'unit = "newtn"', 8, "channel.1.unit", '"newtn" is not a unit'),
        ('unit = "N"\n', "", 5, "channel.1.unit", "missing"),
        ("low-limit = 0", "low-limit = 11", 9, "channel.1.low-limit", "below the high limit"),
        ("low-limit = 0", 'low-limit = "1 mm"', 9, "channel.1.low-limit", "unit of this channel"),
        ("low-limit = 0", 'low-limit = "1"', 9, "channel.1.low-limit", '"1" is not in a unit of this channel (N).'),
        (
            "low-limit = 0",
            'low-limit = "1 qq"',
            9,
            "channel.1.low-limit",
            '"qq" is not a unit. Write it like "degree",',
        ),
        ('"1 kHz"', '"soon"', 14, "channel.1.sampling-period", "'soon' is not a time. Write a number of seconds, or"),
        ('unit = "N"', 'unit = "qq"', 8, "channel.1.unit", '"qq" is not a unit. Write it like "degree",'),
        (
            'unit = "N"',
            'unit = "N"\ndisplay-unit = "qq"',
            9,
            "channel.1.display-unit",
            '"qq" is not a unit. Write it like "degree",',
        ),
        ("bits = 12 }", "bits = 12, qqq = 1 }", 17, "channel.1.sample.qqq", "there is no such key"),
        ('["trigger"] }', '["trigger"], qqq = 1 }', 18, "channel.1.sampling.qqq", "there is no such key"),
        ("low-limit = 0", "low-limit = nan", 9, "channel.1.low-limit", "Float32"),
        ("low-limit = 0", "low-limit = 1e39", 9, "channel.1.low-limit", "Float32"),
        ("low-limit = 0", f"low-limit = {10**400}", 9, "channel.1.low-limit", "Float32"),
        ('"1 kHz"', str(10**400), 14, "channel.1.sampling-period", "time"),
        ("low-limit = 0", "low-limt = 0", 9, "channel.1.low-limt", 'Did you mean "low-limit"'),
        ("low-limit = 0\n", "", 5, "channel.1.low-limit", "missing"),
        ("uncertainty = 0.1", "uncertainty = -0.1", 11, "channel.1.uncertainty", "negative"),
        ("uncertainty = 0.1", "uncertainty = true", 11, "channel.1.uncertainty", "number"),
        ('type = "sensor"', 'type = "senser"', 7, "channel.1.type", '"sensor"'),
        ('type = "sensor"', "type = 256", 7, "channel.1.type", "255"),
        ('"1 kHz"', '"1 kg"', 14, "channel.1.sampling-period", "time"),
        ("bits = 12", "bits = 17", 17, "channel.1.sample.bits", "16 bits"),
        ("octets = 2", "octets = 9", 17, "channel.1.sample.octets", "1 to 8"),
        ('"unsigned", octets = 2', '"float32", octets = 8', 17, "channel.1.sample.octets", "has 4 octets"),
        ('"unsigned", octets = 2', '"float64", octets = 4', 17, "channel.1.sample.octets", "has 8 octets"),
        ('"unsigned", octets = 2', '"fraction", octets = 9', 17, "channel.1.sample.octets", "1 to 8"),
        ('"unsigned", octets = 2', '"long-integer", octets = 8', 17, "channel.1.sample.octets", "9 to 255"),
        ('"unsigned", octets = 2', '"long-fraction", octets = 8', 17, "channel.1.sample.octets", "9 to 255"),
        ('"unsigned", octets = 2', '"time-of-day", octets = 4', 17, "channel.1.sample.octets", "has 8 octets"),
        ('model = "unsigned"', 'model = "int"', 17, "channel.1.sample.model", "unsigned"),
        ('modes = ["trigger"]', "modes = []", 18, "channel.1.sampling.modes", "at least one"),
        ('modes = ["trigger"]', 'modes = ["triger"]', 18, "channel.1.sampling.modes", "triger"),
        ('["trigger"] }', '["trigger"], default = "continuous" }', 18, "channel.1.sampling.default", "not among"),
        ('operation-timeout = "100 ms"', "operation-timeout = -1", 3, "meta.operation-timeout", "negative"),
        ('operation-timeout = "100 ms"\n', "", 2, "meta.operation-timeout", "missing"),
        ("[meta]", "[metta]", 2, "metta", '"meta"'),
        ("[channel.1]", "[channel.2]", 5, "channel", "1 is missing"),
        ("[channel.1]", "[channel.0]", 5, "channel.0", "1 to 255"),
        ("[channel.1]", "[channel.one]", 5, "channel.one", "[channel.1]"),
        ('title = "Force"', "title = 3", 1, "title", "quotes"),
        ('title = "Force"', 'links = ["usb"]', 1, "links", "usb"),
        ('title = "Force"', f'name = "{"x" * 121}"', 1, "name", "120 octets"),
        ('title = "Force"', f'name = "{"ä" * 61}"', 1, "name", "120 octets"),
        ('name = "force"', f'name = "{"ä" * 61}"', 6, "channel.1.name", "120 octets"),
    ],
)
def test_a_mistake_is_named_with_file_line_and_field(
    old: str, new: str, line: int, field: str, words: str, tmp_path: Path
) -> None:
    assert old in GOOD
    path = write(tmp_path, "force", GOOD.replace(old, new, 1))
    with pytest.raises(BadDataError) as caught:
        load_profile(path)
    _, problems = check(path)
    errors = [str(problem) for problem in problems if problem.severity == "error"]
    assert any(text.startswith(f"{path}:{line}: {field}: ") and words in text for text in errors), errors
    assert str(path) in caught.value.message
    assert "profile check" in caught.value.hint


@pytest.mark.parametrize(
    ("extra", "field"),
    [
        ("[channel.1.calibration]\nmonotone = 'up'\n", "channel.1.calibration.monotone"),
        ("[channel.1.calibration]\nraw-range = [5, 1]\n", "channel.1.calibration.raw-range"),
        ("[channel.1.calibration]\nmethod = 'cubic'\n", "channel.1.calibration.method"),
        ("[channel.1.calibration]\ninterval = 'soon'\n", "channel.1.calibration.interval"),
        ("[channel.1.calibration]\ninterval = inf\n", "channel.1.calibration.interval"),
        (f"[channel.1.calibration]\nraw-range = [0, {10**400}]\n", "channel.1.calibration.raw-range"),
        ("[channel.1.data-set]\nunit = 'wibble'\nrepeats = 0\n", "channel.1.data-set.unit"),
        ("[channel.1.data-set]\nrepeats = 70000\n", "channel.1.data-set.repeats"),
        ("[[meta.vector-group]]\ntype = 0\nmembers = [1, 9]\n", "meta.vector-group[0].members"),
        ("[meta.vector-group]\ntype = 0\n", "meta.vector-group"),
        ("[[text]]\nkind = 'poem'\nxml = 'x'\n", "text[0].kind"),
        ("[[text]]\nkind = 'title'\nxml = 'x'\n[[text]]\nkind = 'title'\nchannel = 4\nxml = 'x'\n", "text[1].channel"),
        ("[phy]\nradio = 'wifi'\n", "phy.radio"),
    ],
)
def test_a_mistake_in_an_added_table_is_named(extra: str, field: str, tmp_path: Path) -> None:
    _, problems = check(write(tmp_path, "force", GOOD + extra))
    assert field in [problem.field for problem in problems if problem.severity == "error"]
    at = GOOD.count("\n")
    assert all(problem.where.line > at for problem in problems if problem.severity == "error")


def test_both_the_octets_and_the_bits_of_a_sample_are_judged(tmp_path: Path) -> None:
    _, problems = check(write(tmp_path, "force", GOOD.replace("octets = 2, bits = 12", "octets = 9, bits = 73")))
    assert [problem.field for problem in problems] == ["channel.1.sample.octets", "channel.1.sample.bits"]


def test_all_mistakes_are_found_at_once(tmp_path: Path) -> None:
    text = GOOD.replace('"N"', '"newtn"').replace('"sensor"', '"x"').replace("[meta]", "[meta]\nfoo = 1")
    path = write(tmp_path, "force", text)
    assert len([problem for problem in check(path)[1] if problem.severity == "error"]) == 3
    with pytest.raises(BadDataError, match=r"\(2 more\)"):
        load_profile(path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("links = 3", 'links: a list of texts is expected, like ["nfc", "can"], not 3.'),
        ("links = 'nfc'", """links: a list of texts is expected, like ["nfc", "can"], not 'nfc'."""),
        ("links = ['nfc', 3]", """links: a list of texts is expected, like ["nfc", "can"], not ['nfc', 3]."""),
        ("links = [{ a = 1 }]", 'links: a list of texts is expected, like ["nfc", "can"], not a list of tables [[…]].'),
        ("phy = 3", "phy: a table [phy] is expected, not 3."),
        ("firmware = []", "firmware: a table [firmware] is expected, not []."),
        ("title = { a = 1 }", "title: a value is expected here, not a table."),
        ("text = 3", "text: tables [[text]] are expected."),
        ("text = [1]", "text: tables [[text]] are expected."),
        ("text = { a = 1 }", "text: tables [[text]] are expected."),
        ("abstract = 1", "abstract: true or false is expected, not 1."),
    ],
)
def test_a_value_of_another_kind_is_named_with_what_is_expected(line: str, message: str, tmp_path: Path) -> None:
    text = GOOD if not line.startswith("title") else GOOD.partition("\n")[2]
    _, problems = check(write(tmp_path, "force", f"{line}\n{text}"))
    assert [str(problem).partition(": ")[2] for problem in problems if problem.severity == "error"] == [message]


def test_an_empty_list_of_tables_is_none(tmp_path: Path) -> None:
    profile = load_profile(write(tmp_path, "force", f"text = []\n{GOOD}"))
    assert profile.texts == ()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("multi-range = 1", "channel.1.multi-range: true or false is expected, not 1."),
        ("self-test = 'yes'", "channel.1.self-test: true or false is expected, not 'yes'."),
        ('direction = "3 mm"', 'channel.1.direction: "3 mm" is not an angle.'),
        ('direction = "x degree"', "channel.1.direction: a number and a unit are expected"),
        ("direction = true", "channel.1.direction: a number is expected, not True."),
    ],
)
def test_a_flag_and_an_angle_are_of_their_kind(line: str, message: str, tmp_path: Path) -> None:
    _, problems = check(write(tmp_path, "force", f"{GOOD}{line}\n"))
    errors = [str(problem).partition(": ")[2] for problem in problems if problem.severity == "error"]
    assert len(errors) == 1
    assert errors[0].startswith(message)


@pytest.mark.parametrize(
    ("line", "radians"),
    [
        ('direction = "180 degree"', math.pi),
        ('direction = "2"', 2.0),
        ("direction = 3", 3.0),
        ('direction = "1 rad"', 1.0),
    ],
)
def test_an_angle_without_a_unit_is_in_radians(line: str, radians: float, tmp_path: Path) -> None:
    profile = load_profile(write(tmp_path, "force", f"{GOOD}{line}\n"))
    assert profile.channels[0].fields["Directon"] == pytest.approx(radians)


@pytest.mark.parametrize("extends", ["3", '["a"]', "{ a = 1 }", "true"])
def test_a_profile_extends_one_by_its_name(extends: str, tmp_path: Path) -> None:
    path = write(tmp_path, "force", f"extends = {extends}\n{GOOD}")
    with pytest.raises(BadDataError) as refused:
        load_profile(path)
    assert refused.value.message == (
        f'{path}:1: extends: the name of one profile is expected, like extends = "smart-sensor".'
    )


def test_at_most_sixteen_profiles_extend_each_other(tmp_path: Path) -> None:
    write(tmp_path, "p0", GOOD)
    for number in range(1, 18):
        write(tmp_path, f"p{number}", f'extends = "p{number - 1}"\n')
    assert len(load_profile("p16", [tmp_path]).lineage) == 17, "itself, and sixteen above it"
    with pytest.raises(BadDataError) as refused:
        load_profile("p17", [tmp_path])
    assert refused.value.message.endswith("p1.toml:1: extends: more than 16 profiles extend each other.")


def test_a_file_that_cannot_be_read_is_among_the_known_ones_and_a_base_is_not(tmp_path: Path) -> None:
    """Its name may be what was meant: the message about its content comes when it is asked for."""
    (tmp_path / "damaged.toml").write_bytes(b"abstract = true # \xff\n")
    assert not _is_base(tmp_path), "a folder cannot be read"
    write(tmp_path, "base", f"abstract = true\n{GOOD}")
    write(tmp_path, "near", f"# abstract = true\n{GOOD}")
    with pytest.raises(NotFoundError) as refused:
        load_profile("qqqq", [tmp_path])
    assert refused.value.hint.startswith("Known are: damaged, near. ")


def test_a_calibration_that_the_key_denies_is_a_warning(tmp_path: Path) -> None:
    curve = fit([(0, 0.0), (4095, 10.0)], "linear", channel=1)
    dated = replace(curve, unit=parse_unit("N"), date=datetime.now(UTC))
    for key, warnings in (
        ("none", ("Channel 1 (force) has a calibration, but its calibration key says that there is none.",)),
        ("auto", ()),
    ):
        profile = load_profile(write(tmp_path, key, f'{GOOD}calibration-key = "{key}"\n'))
        assert profile.build(UUID, calibration={1: dated}).warnings == warnings


@pytest.mark.parametrize(
    ("octets", "words"), [(b"a = \n", ":1: "), (b"\n\xff\n", ":2: the text is not UTF-8"), (b"x" * (1 << 21), "octets")]
)
def test_what_is_not_toml_is_bad_data(octets: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_bytes(octets)
    with pytest.raises(BadDataError, match=words):
        load_profile(path)


def test_lines_are_found_in_every_way_of_writing_toml() -> None:
    text = '''\
a = 1
b.c = """
[not.a.table]
d = 2
"""
"quoted key" = 3
[t."dotted.name"]   # comment
x = [
  1,
]
[[list]]
k = 1
[[list]]
k = 2
[list.sub]
y = 3
'''
    tomllib.loads(text)
    lines = key_lines(text)
    assert lines["a",] == 1
    assert lines["b", "c"] == 2
    assert ("d",) not in lines
    assert lines["quoted key",] == 6
    assert lines["t", "dotted.name", "x"] == 8
    assert lines["list", 0, "k"] == 12
    assert lines["list", 1, "k"] == 14
    assert lines["list", 1, "sub", "y"] == 16
    assert (lines["t",], lines["t", "dotted.name"]) == (7, 7)
    assert (lines["list",], lines["list", 0], lines["list", 1], lines["list", 1, "sub"]) == (11, 11, 13, 15)
    assert key_lines("[a.b]\nc = 1\n[a]\nd = 2\n")["a",] == 1, "where it is first named"


def test_the_template_is_a_profile_without_errors_and_names_every_key(tmp_path: Path) -> None:
    profile, problems = check(write(tmp_path, "fresh", template("fresh")))
    assert isinstance(profile, Profile)
    assert [problem for problem in problems if problem.severity == "error"] == []
    uncommented = "\n".join(
        line[2:] if line.startswith("# ") and ("=" in line.split("#")[1] or line[2:].startswith("[")) else line
        for line in template("fresh").splitlines()
        if "extends" not in line and "models:" not in line and "modes:" not in line
    )
    full, problems = check(write(tmp_path, "full", uncommented.replace("members = [1, 2]", "members = [1]")))
    assert [str(problem) for problem in problems if problem.severity == "error"] == []
    assert full is not None
    assert all(teds.decode(octets).verdict == "clean" for octets in full.build(UUID).blocks.values())


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_profile_is_a_profile_or_bad_data(data: st.DataObject, tmp_path: Path) -> None:
    at = data.draw(st.integers(0, len(GOOD)))
    to = data.draw(st.integers(at, min(len(GOOD), at + 20)))
    text = GOOD[:at] + data.draw(st.text("[]{}=\"'.\n#,- 019aex", max_size=6)) + GOOD[to:]
    with suppress(BadDataError, NotFoundError):
        assert load_profile(write(tmp_path, "damaged", text), [tmp_path]).channels


def test_the_manual_names_every_key() -> None:
    manual = (Path(__file__).parents[2] / "docs" / "profiles.md").read_text(encoding="utf-8")
    tables = (
        *(keys.META_KEYS, keys.GEO_KEYS, keys.PROXY_KEYS, keys.SAMPLE_KEYS, keys.DATA_SET_KEYS),
        *(keys.CHANNEL_KEYS, keys.PHY_KEYS),
    )
    for key in (key for table in tables for key in table):
        assert f"`{key.key}`" in manual, key.key
        assert all(f"`{choice}`" in manual for choice in key.choices)
    assert all(f"`{name}`" in manual for name in shipped())


def test_a_file_in_the_working_folder_never_stands_in_for_a_shipped_type(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "profiles").mkdir()
    write(tmp_path / "profiles", "load-cell", GOOD)
    write(tmp_path / "profiles", "mine", GOOD)
    folders = default_folders(tmp_path / "home")
    assert find_profile("load-cell", folders).parent == shipped_profiles()
    assert find_profile("mine", folders) == Path("profiles/mine.toml")
    (message,) = passed_over("load-cell", folders)
    assert message.startswith("profiles/load-cell.toml was not used: load-cell is ")
    assert passed_over("mine", folders) == ()
    assert passed_over("profiles/load-cell.toml", folders) == ()


def test_a_folder_is_no_profile_and_a_text_with_a_slash_is_a_path(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    (first / "arm.toml").mkdir(parents=True)
    second.mkdir()
    write(second, "arm", GOOD)
    assert find_profile("arm", [first, second]) == second / "arm.toml"
    assert passed_over("arm", [second, first]) == ()
    plain = write(second, "arm", GOOD).rename(second / "plain")
    assert find_profile(str(plain), [first]) == plain
    with pytest.raises(NotFoundError, match="There is no profile file"):
        find_profile(f"{second}/absent", [first])


RICH = """\
title = "Rich"
name = "rich board"
description = " all of it "
links = ["can", "nfc"]

[meta]
operation-timeout = "100 ms"
slow-timeout = 2
self-test-time = "1 min"
[[meta.control-group]]
type = 1
members = [1, 2]
[[meta.vector-group]]
type = 3
members = [2, 3]
[[meta.geo-location]]
location = 4
type = 5
members = [1]
[[meta.proxy]]
channel = 3
organization = 6
members = [1, 2]

[channel.all]
type = "sensor"
unit = "degC"
low-limit = -40
high-limit = "100 degC"
uncertainty = "0.9 degF"
update-time = "1 ms"
write-setup-time = "2 us"
read-setup-time = "50 us"
sampling-period = "1 kHz"
warm-up-time = "2 min"
read-delay-time = "3 ms"
self-test-time = "1 s"
sample = { model = "fraction", octets = 2, bits = 12 }
sampling = { modes = ["immediate", "trigger"] }
[channel.1-2]
name = "t{channel}"
[channel.2]
type = "event-sensor"
self-test = true
multi-range = true
time-source = 7
incoming-delay = "1 us"
outgoing-delay = "2 us"
trigger-uncertainty = "3 us"
transmission = "buffer-or-interval"
buffered = 8
end-of-set = 9
edge-report = "selectable-both"
direction = "90 degree"
direction-angles = ["0 degree", "180 degree"]
event-options = "changeable-checked"
calibration-key = "tim-self"
sampling = { modes = ["continuous", "free-running", "free-running-pre-trigger"], default = "free-running" }
[channel.2.data-set]
repeats = 10
origin = 20
step = 1.8
unit = "degF"
pre-trigger = 3
[channel.3]
name = "valve"
type = "actuator"
actuator-halt = "ramp"
frame = "{node}_valve{channel}"
display-unit = "degF"
[channel.3.calibration]
required = true
method = "polynomial"
degree = 3
monotone = true
interval = "1 year"
raw-range = [0, 4095]
standard-deviation = 0.5
zero-offset = true
indication = [0.5, -40]
[[text]]
kind = "title"
xml = "<a/>"
language = "de"
[phy]
radio = "bluetooth"
bit-rate = 1000000
encryption = 0x0110
authentication = true
battery = false
retries = 2
"""


def words_of(blocks: dict[tuple[int, int], bytes]) -> dict[tuple[int, int], str]:
    """Return each TEDS as its fields in words, in their order."""
    found = {}
    for place, octets in blocks.items():
        pending, out = list(describe(TedsBlock(*place, octets), blocks).fields), []
        while pending:
            field = pending.pop(0)
            pending = [*field.children, *pending]
            out.append(f"{field.name} {field.meaning or field.text}".strip())
        found[place] = "; ".join(out[1:])  # without the TEDSID
    return found


TIMES = "UpdateT 1 ms; WSetupT 2 µs; RSetupT 50 µs; SPeriod 1 ms; WarmUpT 120 s; RDelayT 3 ms; TestTime 1 s; "
KELVINS = "PhyUnits K; LowLimit -40 °C; HiLimit 100 °C; OError 0.5 °C; "
SAMPLE = "Sample; DatModel fraction; ModLenth 2; SigBits 12; "


def test_every_key_of_a_profile_is_in_the_teds_that_it_builds(tmp_path: Path) -> None:
    profile = load_profile(write(tmp_path, "rich", RICH))
    assert (profile.title, profile.tim_name, profile.description) == ("Rich", "rich board", "all of it")
    assert (profile.links, profile.warnings, profile.abstract) == (("can", "nfc"), (), False)
    built = profile.build(bytes(range(10)))
    assert built.warnings == (
        "Channel 3 (valve) has no calibration, and its type asks for one: give it with --calibration FILE.",
    )
    assert words_of(built.blocks) == {
        (0, 1): "UUID 00010203040506070809; OholdOff 100 ms; SHoldOff 2 s; TestTime 60 s; MaxChan 3; "
        "CGroup; GrpType 1; MemList 1, 2; VGroup; GrpType 3; MemList 2, 3; GeoLoc; GrpType 5; MemList 1; LocEnum 4; "
        "Proxies; MemList 1, 2; ChanNum 3; Organiz 6",
        (0, 11): "NumLang 1; DirBlock; LangCode de; Offset 38; Length 6; Compress 0; SubSum 65131",
        (0, 12): "Format user defined; TCName rich board",
        (0, 13): "Radio Bluetooth; MaxBPS 1000000 bit/s; Encrypt 272; Authent 1; Battery 0; MaxRetry 2",
        (1, 3): f"CalKey CAL_NONE; ChanType sensor; {KELVINS}SelfTest none; {SAMPLE}{TIMES}"
        "Sampling; SampMode trigger, immediate; SDefault 16",
        (1, 12): "Format user defined; TCName t1",
        (2, 3): f"CalKey TIM_CAL_SELF; ChanType event sensor; {KELVINS}SelfTest provided; MRange 1; {SAMPLE}"
        f"DataSet; Repeats 10; SOrigin -6.66666 °C; StepSize 1 °C; SUnits K; PreTrigg 3; {TIMES}"
        "TimeSrc 7; InPropDl 1 µs; OutPropD 2 µs; TSError 3 µs; "
        "Sampling; SampMode free-running, free-running with pre-trigger, continuous; SDefault 2; "
        "DataXmit buffer or interval; Buffered 8; EndOfSet 9; EdgeRpt selectable, default both; "
        "Directon 1.570796; DAngles 0, 3.141593; ESOption changeable, inconsistencies detected",
        (2, 12): "Format user defined; TCName t2",
        (3, 3): f"CalKey CAL_NONE; ChanType actuator; {KELVINS}SelfTest none; {SAMPLE}{TIMES}"
        "Sampling; SampMode trigger, immediate; SDefault 16; ActHalt ramp",
        (3, 12): "Format user defined; TCName valve",
    }
    assert [
        (channel.number, channel.calibration_key, channel.display, channel.frame) for channel in profile.channels
    ] == [
        (1, None, None, ""),
        (2, 5, None, ""),
        (3, None, "degF", "{node}_valve3"),
    ]
    own = profile.build(bytes(range(10)), name="mine").blocks
    assert words_of(own) == words_of(built.blocks) | {(0, 12): "Format user defined; TCName mine"}
    assert profile.channels[0].calibration == CalibrationDemand()
    assert profile.channels[2].calibration == CalibrationDemand(
        required=True,
        method="polynomial",
        degree=3,
        monotone="either",
        interval=31556952.0,
        raw_range=(0.0, 4095.0),
        zero_offset=True,
        standard_deviation=0.5,
        indication=(0.5, -40.0),
    )
    assert profile.channels[2].calibration.indication == (0.5, -40.0)


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (
            "[channel.1.calibration]\nmonotone = 'up'\n",
            'channel.1.calibration.monotone: "increasing", "decreasing", true',
        ),
        (
            "[channel.1.calibration]\nraw-range = [5, 5]\n",
            "channel.1.calibration.raw-range: two numbers, the lower one",
        ),
        ("[channel.1.calibration]\nraw-range = [0, true]\n", "channel.1.calibration.raw-range: two numbers, the lower"),
        ("[channel.1.calibration]\nindication = [0, 1]\n", "channel.1.calibration.indication: slope and intercept are"),
        ("[channel.1.calibration]\nindication = [1, 2, 3]\n", "channel.1.calibration.indication: slope and intercept"),
        *(
            (f"[channel.1.calibration]\nindication = {pair}\n", "channel.1.calibration.indication: slope and intercept")
            for pair in ("[1e39, 0]", "[-1e39, 0]", "[1, 1e39]", "[1, -1e39]", "[true, 0]", "['1', 0]", "[nan, 0]", "3")
        ),
        (
            "[channel.1.calibration]\ninterval = 'soon'\n",
            "channel.1.calibration.interval: 'soon' is not a time. Write a number of seconds, or",
        ),
        *(
            (
                f"[channel.1.data-set]\nrepeats = {number}\n",
                f"channel.1.data-set.repeats: a whole number from 0 to 65535 is expected, not {shown}.",
            )
            for number, shown in (("-1", "-1"), ("65536", "65536"), ("true", "True"), ("1.0", "1.0"))
        ),
        ("[channel.1-1]\ndirection-angles = [1]\n", "channel.1-1.direction-angles: two angles are expected, not 1."),
        ("[channel.1-1]\ndirection-angles = 3\n", "channel.1-1.direction-angles: a list is expected, like "),
        ("[channel.1-1]\ndirection-angles = []\n", "channel.1-1.direction-angles: a list is expected, like "),
        ("[channel.1.calibration]\ninterval = 0\n", "channel.1.calibration.interval: 0 is not a time that a TEDS can"),
        (
            "[channel.1.calibration]\ninterval = 4294967296\n",
            "channel.1.calibration.interval: 4294967296 is not a time",
        ),
        ("[channel.1.calibration]\nmethod = 'cubic'\n", 'channel.1.calibration.method: "cubic" is no method; linear, '),
        ("[channel.1.calibration]\nrequired = 1\n", "channel.1.calibration.required: "),
        ("[channel.1.calibration]\ndegree = 0\n", "channel.1.calibration.degree: the degree of a polynomial goes"),
        ("[channel.1.calibration]\ndegree = 13\n", "channel.1.calibration.degree: the degree of a polynomial goes"),
        ("[firmware]\nminimum = '1.2'\n", 'firmware.minimum: "1.2" is not a version such as 1.2.0'),
        ("[firmware]\nminimum = '1.2.0+4294967296'\n", 'firmware.minimum: "1.2.0+4294967296" is not a version'),
        ("[firmware]\nminimum = '1.2.65536'\n", 'firmware.minimum: "1.2.65536" is not a version such as'),
        ("[firmware]\nbad = ['1.2.0', '1.02.0']\n", 'firmware.bad: "1.02.0" is neither a version'),
        ("[firmware]\nbad = ['1.2.0', '1.2.0+07']\n", 'firmware.bad: "1.2.0+07" is neither a version'),
        ("[firmware]\nbad = ['1.2.\u0663']\n", 'firmware.bad: "1.2.\u0663" is neither a version'),
        (f"[firmware]\nbad = ['{'a' * 63}']\n", 'firmware.bad: "aaaa'),
        (
            "[channel.1-1]\ncalibration-key = 'none'\n[channel.1.calibration]\nrequired = true\n",
            'channel.1-1.calibration-key: "none" contradicts calibration.required = true.',
        ),
        ("[channel.1-1]\nframe = '9x'\n", "channel.1-1.frame: letters, digits, _ and / are expected, and {node}"),
        (
            "[channel.1-1]\ndisplay-unit = 'mm'\n",
            'channel.1-1.display-unit: "mm" is not of the same kind as the channel\'s',
        ),
        ("[channel.1-1]\ndisplay-unit = 'qq'\n", 'channel.1-1.display-unit: "qq" is not a unit'),
        ("[channel.3]\nunit = 'N'\n", "channel: channels are numbered from 1 without gaps; 2 is missing."),
        ("[channel.2-1]\nunit = 'N'\n", "channel.2-1: channel numbers go from 1 to 255, the lower one first."),
        ("[channel.1-256]\nunit = 'N'\n", "channel.1-256: channel numbers go from 1 to 255, the lower one first."),
        ("[[text]]\nkind = 'title'\n", "text[0].xml: the text is missing."),
        (
            "[[text]]\nkind = 'title'\nxml = 'x'\nlanguage = 'deu'\n",
            "text[0].language: a language has two letters, like",
        ),
        (
            "[[text]]\nkind = 'title'\nxml = 'x'\nlanguage = 'äö'\n",
            "text[0].language: a language has two letters, like",
        ),
        (
            "[[text]]\nkind = 'title'\nxml = 'x'\nlanguage = 'd1'\n",
            "text[0].language: a language has two letters, like",
        ),
        (
            "[[text]]\nkind = 'title'\nxml = 'x'\nlanguage = 'd'\n",
            "text[0].language: a language has two letters, like",
        ),
        ("[[text]]\nkind = 'title'\nxml = 'x'\nchannel = 2\n", "text[0].channel: the type has no channel 2."),
        (
            "[[meta.proxy]]\nchannel = 1\norganization = 1\nmembers = [1, 2, 3]\n",
            "meta.proxy[0].members: the type has no channel 2, 3.",
        ),
        *(
            (f"{table}\nqqq = 1\n", f"{field}.qqq: there is no such key. Known here: ")
            for table, field in (
                ("[[meta.proxy]]", "meta.proxy[0]"),
                ("[[meta.vector-group]]\ntype = 0\n[[meta.vector-group]]", "meta.vector-group[1]"),
                ("[phy]", "phy"),
                ("[[text]]", "text[0]"),
                ("[firmware]", "firmware"),
                ("[channel.1.calibration]", "channel.1.calibration"),
                ("[channel.1.data-set]", "channel.1.data-set"),
            )
        ),
    ],
)
def test_a_mistake_in_what_may_be_added_is_named_in_whole_words(extra: str, message: str, tmp_path: Path) -> None:
    _, problems = check(write(tmp_path, "force", GOOD + extra))
    errors = [str(problem).partition(": ")[2] for problem in problems if problem.severity == "error"]
    assert any(error.startswith(message) for error in errors), errors


def test_what_is_doubtful_in_a_profile_is_a_warning(tmp_path: Path) -> None:
    text = GOOD.replace('name = "force"\n', "") + "[channel.1.calibration]\nrequired = true\nmethod = 'polynomial'\n"
    profile = load_profile(write(tmp_path, "force", text))
    assert [warning.partition(": ")[2] for warning in profile.warnings] == [
        "channel.1.calibration: the degree of the polynomial is left to the calibration file.",
        "channel.1.name: the channel has no name; people will see its number only.",
    ]
    fixed = load_profile(write(tmp_path, "force2", text + "degree = 2\n"))
    assert len(fixed.warnings) == 1


def test_an_indication_may_fall_and_a_whole_number_goes_up_to_its_limit(tmp_path: Path) -> None:
    more = "[channel.1.calibration]\nindication = [-0.5, 3]\n[channel.1.data-set]\nrepeats = 65535\n"
    (channel,) = load_profile(write(tmp_path, "force", GOOD + more)).channels
    assert channel.calibration.indication == (-0.5, 3.0)
    assert dict(channel.fields["DataSet"])["Repeats"] == 65535


def test_a_text_is_english_and_of_the_whole_node_unless_the_profile_states_another(tmp_path: Path) -> None:
    texts = "[[text]]\nkind = 'title'\nxml = 'a'\n[[text]]\nkind = 'title'\nchannel = 1\nxml = 'b'\nlanguage = 'de'\n"
    profile = load_profile(write(tmp_path, "force", GOOD + texts))
    assert [(text.channel, text.text, text.language) for text in profile.texts] == [(0, "a", "en"), (1, "b", "de")]
    assert {(0, 11), (1, 11)} < set(profile.build(UUID).blocks)
