"""A virtual node's flash: taken by one process before it is read, and told plainly where it cannot be used."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.errors import BadData, NotFound, StoreFailure, StoreLocked
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.virtual import VirtualNode


def test_a_running_node_is_refused_to_another_process(tmp_path: Path) -> None:
    FlashFile.create(tmp_path / "node")
    running = VirtualNode(tmp_path / "node", exclusive=True)
    with pytest.raises(StoreLocked):
        VirtualNode(tmp_path / "node", exclusive=True)
    running.flash_file.release()
    VirtualNode(tmp_path / "node", exclusive=True).flash_file.release()


def test_what_was_committed_before_the_node_was_taken_is_what_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last commit of the process before happens while this one is starting."""
    import fcntl

    before = FlashFile.create(tmp_path / "node")
    take = fcntl.flock

    def late(descriptor: int, how: int) -> None:
        monkeypatch.setattr(fcntl, "flock", take)  # a commit takes a lock too
        before.commit(replace(before.load(), epoch=7))
        take(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", late)
    node = VirtualNode(tmp_path / "node", exclusive=True)
    assert node.tim.flash.epoch == 7
    node.flash_file.release()


@pytest.mark.parametrize("document", ["", "[]", "{}", '{"format": "teds-virtual-node/1"}', "damaged key"])
def test_a_damaged_flash_is_bad_data(tmp_path: Path, document: str) -> None:
    path = FlashFile.create(tmp_path / "node").path
    if document == "damaged key":
        document = json.dumps(json.loads(path.read_text()) | {"key": "00" * 32})
    path.write_text(document)
    with pytest.raises(BadData):
        FlashFile(tmp_path / "node")


def test_a_folder_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreFailure, match="cannot be used"):
        FlashFile.create(tmp_path / "file" / "node")
    with pytest.raises(NotFound):
        FlashFile(tmp_path / "nothing", exclusive=True)
