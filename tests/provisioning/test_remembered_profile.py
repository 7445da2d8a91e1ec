"""The profile of a node is the file that it was made of, wherever the next command stands and whatever lies there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.provisioning import build as build_module
from teds_provision.provisioning.agree import reset_node
from teds_provision.provisioning.build import (
    BuildOrder,
    PreparedOrder,
    UnrequestedChangeError,
    build,
    content_digests,
    profile_files_digest,
)
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.station.shown_units import shown_units
from teds_provision.station.station import Station
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.profile.load import shipped_profiles
from tests.bench import Board, talk
from tests.pace import until

CELL = (shipped_profiles() / "load-cell.toml").read_text()
OVEN = (shipped_profiles() / "temperature-sensor.toml").read_text()


def provisioned(station: Station, board: Board, order: BuildOrder) -> ProvisionResult:
    with talk(board) as node:
        return provision(station, node, order, operator=AcceptingOperator(), reporter=SilentReporter())


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    (tmp_path / "here/own.toml").write_text(CELL)
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


def test_a_relative_path_is_remembered_whole(
    station: Station, board: Board, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    provisioned(station, board, BuildOrder("./own.toml"))
    record = station.nodes.get(board.uuid)
    assert record is not None
    assert record.profile == str(here / "own.toml")
    before = build(station, board.uuid, BuildOrder(name="a")).image
    monkeypatch.chdir(here.parent / "there")
    assert build(station, board.uuid, BuildOrder(name="a")).image.unsigned_blocks() == before.unsigned_blocks()
    Path("own.toml").write_text(OVEN)
    assert build(station, board.uuid, BuildOrder(name="a")).image.unsigned_blocks() == before.unsigned_blocks()


def test_a_profile_that_changed_since_is_reported_and_asked(station: Station, board: Board, here: Path) -> None:
    provisioned(station, board, BuildOrder("./own.toml"))
    assert not any("has changed since" in text for text in build(station, board.uuid, BuildOrder(name="a")).warnings)
    (here / "own.toml").write_text(CELL.replace("\n", "\n# a comment changes nothing\n", 1))
    assert not any("has changed since" in text for text in build(station, board.uuid, BuildOrder(name="a")).warnings)
    (here / "own.toml").write_text(CELL.replace("high-limit = 500.0", "high-limit = 400.0"))
    warnings = build(station, board.uuid, BuildOrder(name="a")).warnings
    assert any("has changed since this node's datasheet was built" in text for text in warnings)
    station.datasheets.drop_draft(board.uuid)
    reset(station, board)
    with pytest.raises(UnrequestedChangeError):
        provisioned(station, board, BuildOrder())
    assert provisioned(station, board, BuildOrder("./own.toml")).verified.verdict == "authentic"
    reset(station, board)
    again = provisioned(station, board, BuildOrder())
    assert again.verified.verdict == "authentic", "it is remembered anew"


def reset(station: Station, board: Board) -> None:
    """To factory state: its datasheet is judged by the profile that is remembered."""
    with talk(board) as node:
        reset_node(station, node, identify(station, node))


def test_a_change_of_a_profile_that_another_one_extends_reaches_a_process_that_runs(station: Station) -> None:
    """A base station shows units by profiles that it has read; one of them may rest on a file that changes later."""
    folder = station.home / "profiles"
    folder.mkdir()
    uuid = bytes.fromhex("8d4d9da65281f7000000")

    def show_in(unit: str) -> None:
        (folder / "base.toml").write_text(OVEN.replace('unit = "degC"\n', f'unit = "degC"\ndisplay-unit = "{unit}"\n'))

    (folder / "own.toml").write_text('extends = "base"\ntitle = "Own"\n')
    station.nodes.remember(uuid, profile="own")
    for unit in ("degF", "K"):
        show_in(unit)
        until(lambda unit=unit: shown_units(station, uuid) == {1: unit})


def test_the_files_of_a_profile_have_a_digest_as_long_as_they_are_those_of_the_datasheet(
    station: Station, board: Board, here: Path
) -> None:
    provisioned(station, board, BuildOrder(profile="own.toml"))
    record = station.nodes.get(board.uuid)
    assert record is not None
    digest = profile_files_digest(station, record)
    assert digest is not None
    assert len(digest) == 64
    for unknown in (None, replace(record, profile=None), replace(record, profile_digest=None)):
        assert profile_files_digest(station, unknown) is None
    assert profile_files_digest(station, replace(record, profile_digest="ab" * 32)) is None
    file = here / "own.toml"
    kept = file.read_text()
    file.write_text(kept.replace("title", "titel", 1))
    assert profile_files_digest(station, record) is None, "it is being edited"
    file.unlink()
    assert profile_files_digest(station, record) is None
    file.write_text(kept)
    assert profile_files_digest(station, record) == digest


def test_a_damaged_security_teds_has_no_sequence() -> None:
    assert build_module._sequence(None) == -1
    assert build_module._sequence(Image(bytes(10), {})) == -1
    assert build_module._sequence(Image(bytes(10), {SECURITY: frame(b"\xff\xff")})) == -1


def test_without_a_profile_there_is_no_content_and_without_calibrations_only_that_of_the_profile() -> None:
    gripper = load_profile("gripper")
    assert content_digests(PreparedOrder(BuildOrder())) == ("", "")
    of_profile, none = content_digests(PreparedOrder(BuildOrder(), gripper))
    assert (len(of_profile), none) == (64, "")
