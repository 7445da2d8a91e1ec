"""Profiles: what is shipped is right, what is wrong is named with file, line and field."""

from __future__ import annotations

import math
import tomllib
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.errors import BadDataError, NotFoundError
from teds_provision.teds.calibration import fit
from teds_provision.teds.profile import (
    Profile,
    check,
    default_folders,
    find_profile,
    keys,
    list_profiles,
    load_profile,
    passed_over,
    shipped_profiles,
    template,
)
from teds_provision.teds.profile.reader import key_lines
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


def test_a_broken_profile_is_listed_with_its_error(tmp_path: Path) -> None:
    write(tmp_path, "broken", "title = \n")
    (entry,) = list_profiles([tmp_path])
    assert entry.profile is None
    assert "broken.toml:1" in entry.error


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
    with pytest.raises(BadDataError, match="channel 2"):
        profile.build(UUID, calibration={2: fit([(0, 0.0), (1, 1.0)], "linear", channel=2)})
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


def test_the_narrower_selection_of_channels_wins(tmp_path: Path) -> None:
    text = GOOD.replace("[channel.1]", "[channel.all]").replace('"force"', '"f {channel}"')
    text += "[channel.2]\nhigh-limit = 2\n[channel.1-3]\nhigh-limit = 3\n"
    profile = load_profile(write(tmp_path, "many", text))
    assert [channel.high_limit for channel in profile.channels] == [3, 2, 3]
    assert [channel.name for channel in profile.channels] == ["f 1", "f 2", "f 3"]


@pytest.mark.parametrize("circle", [("a",), ("a", "b"), ("a", "b", "c")])
def test_a_circle_of_profiles_is_refused(circle: tuple[str, ...], tmp_path: Path) -> None:
    for name, base in zip(circle, circle[1:] + circle[:1], strict=True):
        write(tmp_path, name, f'extends = "{base}"\n')
    with pytest.raises(BadDataError, match="circle: a -> "):
        load_profile("a", [tmp_path])


def test_a_users_profile_may_extend_the_shipped_one_of_the_same_name(tmp_path: Path) -> None:
    path = write(tmp_path, "load-cell", 'extends = "load-cell"\n[channel.1]\nhigh-limit = 100\nlow-limit = -100\n')
    assert load_profile(path, [tmp_path, shipped_profiles()]).channels[0].high_limit == 100


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
        ("octets = 2", "octets = 9", 17, "channel.1.sample.octets", "0 to 8"),
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


def test_all_mistakes_are_found_at_once(tmp_path: Path) -> None:
    text = GOOD.replace('"N"', '"newtn"').replace('"sensor"', '"x"').replace("[meta]", "[meta]\nfoo = 1")
    path = write(tmp_path, "force", text)
    assert len([problem for problem in check(path)[1] if problem.severity == "error"]) == 3
    with pytest.raises(BadDataError, match=r"\(2 more\)"):
        load_profile(path)


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
