"""A datasheet in a file: whether a word means a node or a file, and what is said if it means neither."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from teds_provision.errors import BadDataError, NotFoundError
from teds_provision.provisioning import image_file
from teds_provision.provisioning.image_file import node_or_image, read_image_file, verify_image_file
from teds_provision.station.station import Station
from teds_provision.teds.image import Image
from tests.bench import Board

from .test_provision import run


@pytest.fixture
def image(station: Station, board: Board, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Image:
    run(station, board)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    found = station.datasheets.datasheet(board.uuid)
    assert found is not None
    return found


def test_a_word_that_names_both_means_the_file_unless_a_node_is_wanted(station: Station, image: Image) -> None:
    with station.transaction():
        station.nodes.remember(image.uuid, name="gripper")
    assert node_or_image(station, "gripper") == image.uuid
    Path("gripper").write_text(image.to_json())
    assert node_or_image(station, "gripper") == image
    assert node_or_image(station, "gripper", is_node=True) == image.uuid
    Path("other").write_text(image.to_json())
    assert node_or_image(station, "other", is_node=True) == image


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("folder", "folder is a folder, and no node has that name."),
        ("pipe", "pipe is not a regular file, and no node has that name."),
        ("crane.json", "There is no file crane.json, and no node with that name."),
        ("sub/crane", "There is no file sub/crane, and no node with that name."),
        ("crane", "No node is known as 'crane'."),
    ],
)
def test_a_word_that_names_neither(station: Station, image: Image, word: str, message: str) -> None:
    Path("folder").mkdir()
    os.mkfifo("pipe")
    for is_node in (False, True):
        with pytest.raises(NotFoundError) as refused:
            node_or_image(station, word, is_node=is_node)
        assert refused.value.message == message


def test_a_file_that_is_no_image(station: Station, image: Image, monkeypatch: pytest.MonkeyPatch) -> None:
    assert image_file.MAX_IMAGE_OCTETS == 16_777_216
    path = Path("node.json")
    path.write_text("{}")
    with pytest.raises(BadDataError, match=r"^node\.json is not a TEDS image: ") as refused:
        read_image_file(path)
    assert refused.value.hint == "Images come from build, sign and read."
    path.write_text(image.to_json())
    monkeypatch.setattr(image_file, "MAX_IMAGE_OCTETS", path.stat().st_size)
    assert read_image_file(path) == image
    monkeypatch.setattr(image_file, "MAX_IMAGE_OCTETS", path.stat().st_size - 1)
    with pytest.raises(BadDataError, match=r"octets, which is too large for an image\.$"):
        read_image_file(path)


def test_a_file_is_verified_by_itself(station: Station, image: Image) -> None:
    path = Path("node.json")
    path.write_text(image.to_json())
    report = verify_image_file(station, path)
    assert (report.verified.scope, report.verified.uuid, report.error, report.warnings) == (
        "image",
        image.uuid,
        None,
        (),
    )
    path.write_text(Image(image.uuid, image.unsigned_blocks()).to_json())
    report = verify_image_file(station, path)
    assert report.error is not None
    assert (report.verified.verdict, report.warnings) == ("unsigned", ())
