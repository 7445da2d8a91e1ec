"""``node create`` and ``node run`` as commands: what they refuse, and many nodes in one process."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from teds_provision.node.flash_file import FlashFile
from tests.bench import make_station
from tests.cli.shell import spawn as run
from tests.e2e.desk import Links, Running


@contextmanager
def running(*words: object) -> Iterator[Running]:
    with closing(Running("--json", "node", "run", *words)) as process:
        yield process


def test_a_name_keeps_to_120_octets(tmp_path: Path) -> None:
    assert run("node", "create", tmp_path / "long", "--name", "ü" * 61).code == 2
    done = run("--json", "node", "create", tmp_path / "node", "--name", "ü" * 60)
    assert (done.code, json.loads(done.out)["name"]) == (0, "ü" * 60)


def test_create_says_the_channels_of_its_datasheet(tmp_path: Path) -> None:
    done = run("--json", "node", "create", tmp_path / "node", "--profile", "gripper")
    channels = json.loads(done.out)["channels"]
    assert done.code == 0
    assert {channel["kind"] for channel in channels} >= {"actuator"}
    assert run("node", "create", tmp_path / "x", "--profile", "gripper", "--teds", "y.json").code == 2


def test_a_reader_on_which_another_node_lies_is_told(tmp_path: Path) -> None:
    run("node", "create", tmp_path / "node")
    links = Links()
    port = int(links.nfc.rpartition(":")[2])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port))
        done = run("--json", "node", "run", tmp_path / "node", "--nfc", links.nfc, "--can", links.can)
    assert done.code == 5
    assert "ready" not in done.out
    assert links.nfc in json.loads(done.out)["error"]["message"]


def test_a_source_that_is_unknown_or_of_no_use_is_told(tmp_path: Path) -> None:
    run("node", "create", tmp_path / "plain")
    links = Links()
    assert run("node", "run", tmp_path / "plain", "--can", links.can, "--source", "sinus:2").code == 2
    with running(tmp_path / "plain", "--can", links.can, "--source", "sine:2") as process:
        process.wait_for("has no channels")
        assert process.wait_for_lines(1)[0]["ready"]


def test_what_is_for_one_node_is_refused_for_two(tmp_path: Path) -> None:
    for name in ("a", "b"):
        run("node", "create", tmp_path / name)
    links = Links()
    for words in (["--nfc", links.nfc], ["--can", links.can, "--source", "-"], ["--can", links.can, "--source", "x"]):
        assert run("node", "run", tmp_path / "a", tmp_path / "b", *words).code == 2


@pytest.mark.parametrize("count", [30])
def test_many_nodes_on_one_bus_in_one_process_are_all_found(tmp_path: Path, count: int) -> None:
    """Some of so many random UUIDs nearly always have one default address: they sort themselves out."""
    folders = [tmp_path / f"node{number}" for number in range(count)]
    uuids = {FlashFile.create(folder).load().uuid.hex() for folder in folders}
    make_station(tmp_path / "home", "bench").close()
    links = Links()
    with running(*folders, "--can", links.can) as process:
        ready = process.wait_for_lines(1)[0]
        assert {node["uuid"] for node in ready["nodes"]} == uuids
        found: set[str] = set()
        for _ in range(4):  # the first seconds belong to the claims of addresses
            done = run("--json", "--home", tmp_path / "home", "identify", "--via", "can", "--can", links.can)
            found = {node["uuid"] for node in json.loads(done.out).get("nodes", [])} if done.code == 0 else set()
            if found == uuids:
                break
        assert found == uuids, done
