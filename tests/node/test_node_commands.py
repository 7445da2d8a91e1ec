"""``node create`` and ``node run`` as commands: what they refuse, and many nodes in one process."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from teds_provision.node.flash_file import FlashFile
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from tests.bench import make_station
from tests.cli.shell import spawn as run
from tests.e2e.desk import Links, Running
from tests.terminal import on_terminal

UUID = bytes.fromhex("8d4d9da65281f7000000")


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


def test_a_reader_with_another_node_on_it_is_reported(tmp_path: Path) -> None:
    run("node", "create", tmp_path / "node")
    links = Links()
    port = int(links.nfc.rpartition(":")[2])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port))
        done = run("--json", "node", "run", tmp_path / "node", "--nfc", links.nfc, "--can", links.can)
    assert done.code == 5
    assert "ready" not in done.out
    assert links.nfc in json.loads(done.out)["error"]["message"]


def test_a_source_that_is_unknown_or_of_no_use_is_reported(tmp_path: Path) -> None:
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


def test_a_copy_of_a_known_node_gets_a_new_uuid_or_is_refused(tmp_path: Path) -> None:
    """A datasheet's UUID that this station knows is never taken over without a word."""
    home, file = tmp_path / "home", tmp_path / "real.json"
    with closing(make_station(home)) as station:
        image = Image(UUID, load_profile("gripper").build(UUID, name="hand").blocks)
        file.write_text(image.to_json())
        station.nodes.remember(UUID, name="hand")
    make = ("--home", home, "--json", "node", "create")
    refused = run(*make, tmp_path / "copy", "--teds", file)
    assert (refused.code, refused.json["error"]["code"]) == (6, "uuid-known")
    assert all(word in refused.json["error"]["hint"] for word in ("--new-uuid", f"--uuid {UUID.hex()}"))
    assert not (tmp_path / "copy").exists()

    made = run(*make, tmp_path / "copy", "--teds", file, "--new-uuid", "--name", "spare")
    assert (made.code, made.json["name"]) == (0, "spare")
    assert made.json["uuid"] != UUID.hex()
    again = run(*make, tmp_path / "copy", "--teds", file, "--new-uuid", "--name", "spare")
    assert (again.code, again.json["uuid"]) == (0, made.json["uuid"])

    asked = run(*make, tmp_path / "twin", "--teds", file, "--uuid", UUID.hex())
    assert (asked.code, asked.json["uuid"]) == (0, UUID.hex())
    assert "cannot be distinguished" in asked.err
    assert run(*make, tmp_path / "no", "--new-uuid").code == 2

    answered = on_terminal(home, "node", "create", tmp_path / "third", "--teds", file, answers=["y"])
    assert answered.code == 0, answered
    assert FlashFile(tmp_path / "third").load().uuid != UUID
