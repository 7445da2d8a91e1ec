"""Nodes that are made from a datasheet: what lies on them, what is their hardware, and what no node can be made of."""

from __future__ import annotations

from pathlib import Path

import pytest

from teds_provision.errors import BadDataError, NotFoundError, UsageError
from teds_provision.node import node_template
from teds_provision.node.flash_file import FlashFile
from teds_provision.teds import compose
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.formats import TedsBlock, write_blocks
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.sheet import Sheet

UUID = bytes.fromhex("8d4d9da65281f7000000")
OTHER = bytes.fromhex("8d4d9da65281f7000001")


@pytest.fixture
def image() -> Image:
    return Image(UUID, load_profile("gripper").build(UUID).blocks)


def files(folder: Path, image: Image) -> dict[str, Path]:
    """Return the same TEDS in each format that says their channels."""
    blocks = [TedsBlock(channel, code, teds) for (channel, code), teds in image.blocks.items()]
    paths = {"image": folder / "node.json"}
    paths["image"].write_text(image.to_json())
    for form in ("xml", "hex", "json"):
        paths[form] = folder / f"node.{form}"
        paths[form].write_text(write_blocks(blocks, form))  # type: ignore[arg-type]
    return paths


def test_every_format_makes_the_same_node(tmp_path: Path, image: Image) -> None:
    for form, path in files(tmp_path, image).items():
        made = node_template.create(tmp_path / form / "node", teds=path)
        assert (made.load().uuid, made.hardware, dict(made.load().blocks)) == (UUID, image.blocks, image.blocks), form
        assert not made.load().provisioned


def test_the_security_teds_of_a_file_is_left_out(tmp_path: Path, image: Image) -> None:
    path = tmp_path / "node.json"
    path.write_text(image.with_block(SECURITY, image.blocks[0, AccessCode.META]).to_json())
    assert SECURITY not in node_template.create(tmp_path / "node", teds=path).load().blocks


def test_another_uuid_is_in_its_meta_teds_too(tmp_path: Path, image: Image) -> None:
    path = tmp_path / "node.json"
    path.write_text(image.to_json())
    made = node_template.create(tmp_path / "node", teds=path, uuid=OTHER)
    sheet = Sheet.from_image(Image(OTHER, made.hardware))
    assert (made.load().uuid, sheet.meta.uuid, sheet.errors) == (OTHER, OTHER, ())


def test_the_same_command_again_changes_nothing_and_another_is_refused(tmp_path: Path, image: Image) -> None:
    path = tmp_path / "node.json"
    path.write_text(image.to_json())
    for order in ({"teds": path}, {"profile": "gripper"}, {}):
        folder = tmp_path / ("node" + "".join(order))
        first = node_template.create(folder, **order).path.read_bytes()  # type: ignore[arg-type]
        assert node_template.create(folder, **order).path.read_bytes() == first  # type: ignore[arg-type]
        with pytest.raises(UsageError, match="another node"):
            node_template.create(folder, profile="limit-switch")


def test_a_profile_gives_its_channels_and_a_random_uuid(tmp_path: Path) -> None:
    made = [node_template.create(tmp_path / name, profile="gripper", name=name) for name in ("left", "right")]
    assert made[0].load().uuid != made[1].load().uuid
    sheet = Sheet.from_image(Image(made[0].load().uuid, made[0].hardware))
    assert sheet.meta.name == "left"
    assert any(channel.actuator for channel in sheet.channels)


def test_what_no_node_can_be_made_of_is_reported(tmp_path: Path, image: Image) -> None:
    path = tmp_path / "node.json"
    damaged = image.blocks[1, AccessCode.CHANNEL][:-1] + b"\0"
    for blocks, match in (
        ({(300, AccessCode.CHANNEL): image.blocks[1, AccessCode.CHANNEL]}, "channel 300"),
        ({(1, AccessCode.CHANNEL): damaged}, "damaged"),
        ({}, "no TEDS"),
    ):
        path.write_text(Image(UUID, blocks).to_json())
        with pytest.raises(BadDataError, match=match):
            node_template.create(tmp_path / "node", teds=path)
    silent = compose(AccessCode.CHANNEL, {"ChanType": 0, "LowLimit": 0.0, "HiLimit": 1.0})
    path.write_text(Image(UUID, {(1, AccessCode.CHANNEL): silent}).to_json())
    with pytest.raises(BadDataError, match="how a sample of channel 1 is coded"):
        node_template.create(tmp_path / "node", teds=path)
    path.write_text("junk")
    with pytest.raises(BadDataError, match=r"node\.json"):
        node_template.create(tmp_path / "node", teds=path)
    with pytest.raises(NotFoundError):
        node_template.create(tmp_path / "node", teds=tmp_path / "nothing")
    with pytest.raises(NotFoundError):
        node_template.create(tmp_path / "node", profile="nothing")
    assert not (tmp_path / "node").exists()


def test_hardware_stays_when_the_datasheet_changes(tmp_path: Path) -> None:
    made = node_template.create(tmp_path / "node", profile="gripper")
    before = made.hardware
    made.commit(made.load().__class__(**{**made.load().__dict__, "blocks": {}}))
    assert FlashFile(tmp_path / "node").hardware == before


def test_a_name_that_is_given_replaces_the_one_in_the_file(tmp_path: Path, image: Image) -> None:
    for form, path in files(tmp_path, image).items():
        made = node_template.create(tmp_path / form / "node", teds=path, name="left hand")
        assert (made.name, Sheet.from_blocks(made.hardware).meta.name) == ("left hand", "left hand"), form
        assert Sheet.from_image(Image(UUID, made.hardware)).errors == (), form
        assert node_template.create(tmp_path / form / "node", teds=path, name="left hand").hardware == made.hardware
