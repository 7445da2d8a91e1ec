"""Fingerprints of 32 digits and more: what they pin, what they refuse, and that the first contact makes them whole."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from .desk import ANGLE, Desk, Node, Station
from .test_a_day import on_a_terminal


def made(desk: Desk, name: str) -> tuple[Node, str]:
    """Return a factory node that no station has met, and the fingerprint of its key."""
    done = desk.start("--json", "node", "create", desk.folder / name).end()
    assert done.code == 0, done
    return Node(desk, desk.folder / name, done.json["uuid"]), str(done.json["fingerprint"])


def entry(station: Station, uuid: str) -> dict[str, Any]:
    (found,) = [item for item in station.ask("whitelist", "list")["whitelist"] if item["uuid"] == uuid]
    return dict(found)


BY_BUS = pytest.mark.nightly(
    "tests/e2e/test_fingerprints.py::test_first_digits_pin_a_key_and_the_first_contact_makes_them_whole[nfc]; "
    "tests/provisioning/test_whitelist_pin.py::test_a_bus_pins_nothing holds what differs over a bus"
)


@pytest.mark.parametrize("via", ["nfc", pytest.param("can", marks=BY_BUS)])
def test_first_digits_pin_a_key_and_the_first_contact_makes_them_whole(desk: Desk, via: str) -> None:
    station, (node, digits) = desk.station(), made(desk, "node")
    spoken = " ".join(digits[at : at + 4] for at in range(0, 32, 4)).upper()
    station.ask("whitelist", "add", node.uuid, "--fingerprint", spoken)
    assert entry(station, node.uuid)["fingerprint"] == digits[:32]
    node.start(nfc=via == "nfc", can=via == "can")
    station.provision(via, "--profile", ANGLE)
    assert (entry(station, node.uuid)["fingerprint"], entry(station, node.uuid)["assurance"]) == (digits, "import")
    station.ask("whitelist", "add", node.uuid, "--fingerprint", digits[:40])
    assert entry(station, node.uuid)["fingerprint"] == digits
    refused = station.refuses("whitelist", "add", node.uuid, "--fingerprint", "0" * 32, code=6)
    assert digits[:32] in refused["message"]


def test_a_board_whose_key_begins_otherwise_is_another_key(desk: Desk) -> None:
    station, (node, digits) = desk.station(), made(desk, "node")
    other = digits[:31] + ("0" if digits[31] != "0" else "1")
    station.ask("whitelist", "add", node.uuid, "--fingerprint", other)
    node.start()
    assert station.ask("provision", "--profile", ANGLE, "--yes", *desk.links.over("nfc"), code=6)["error"]
    assert node.flash["key"] is None
    assert entry(station, node.uuid)["fingerprint"] == other


def test_lists_take_first_digits_and_join_them(desk: Desk, tmp_path: Path) -> None:
    station, digits = desk.station(), "0123456789abcdef" * 4
    listed = tmp_path / "list.json"
    both = [{"uuid": "0a" * 10, "fingerprint": digits[:32]}, {"uuid": "0a" * 10, "fingerprint": digits}]
    listed.write_text(json.dumps({"whitelist": both}))
    station.ask("whitelist", "import", listed)
    assert entry(station, "0a" * 10)["fingerprint"] == digits
    both[0]["fingerprint"] = "f" * 32
    listed.write_text(json.dumps({"whitelist": both}))
    assert "another key" in station.refuses("whitelist", "import", listed, code=8)["message"]
    station.refuses("whitelist", "add", "0b" * 10, "--fingerprint", digits[:31], code=2)


def test_trust_by_the_digits_that_its_owner_reads(desk: Desk, tmp_path: Path) -> None:
    bench, rival = desk.station("bench"), desk.station("rival")
    shown = rival.ask("init")
    key = tmp_path / "rival.pem"
    key.write_text(shown["public_key"])
    digits = shown["fingerprint"]
    refused = bench.refuses("trust", "add", "rival", key, "--fingerprint", "0" * 32, code=6)
    assert digits[:32] in refused["message"]
    assert bench.refuses("trust", "add", "rival", key, code=6)["code"] == "refused"
    added = bench.ask("trust", "add", "rival", key, "--fingerprint", digits[:48])
    assert added["trusted"][0]["fingerprint"] == digits
    assert bench.ask("trust", "list")["trusted"][0]["name"] == "rival"


PLAIN = pytest.mark.nightly(
    "tests/e2e/test_a_day.py::test_no_at_the_question_skips_the_board answers n and y; digits of the key are here"
)


@pytest.mark.parametrize(
    ("answer", "code"),
    [
        pytest.param("y", 0, marks=PLAIN),
        pytest.param("n", 6, marks=PLAIN),
        ("whole", 0),
        ("first", 0),
        ("other", 6),
        ("", 6),
    ],
)
def test_a_question_takes_the_digits_of_the_key(desk: Desk, answer: str, code: int) -> None:
    station, (node, digits) = desk.station(), made(desk, "node")
    node.start()
    typed = {"whole": digits, "first": digits[:32].upper(), "other": "0" * 32}.get(answer, answer)
    ended, shown = on_a_terminal(station, "provision", "--profile", ANGLE, *desk.links.over("nfc"), answer=typed)
    assert ended == code, shown
    assert digits[:32] in shown
    assert (node.flash["key"] is not None) == (code == 0)
