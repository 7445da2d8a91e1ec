"""``identify``, ``agree``, ``reset``, ``address``, ``locate``, ``update``: what they print and pass on, whole."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from teds_provision import firmware_image, provisioning
from teds_provision.cli.context import App
from teds_provision.cli.node.at_node import PressLines, _locate_each
from teds_provision.cli.node.update import _ProgressTable
from teds_provision.errors import (
    BoardLostError,
    DowngradeError,
    NoNodeError,
    NotAuthenticError,
    PolicyError,
    StoreError,
    TedsProvisionError,
)
from teds_provision.links.ports import Notice
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.address import AddressReport
from teds_provision.provisioning.agree import AgreeReport, AgreeResult, ResetReceipt
from teds_provision.provisioning.identify import IdentifiedNode, ProvenNode
from teds_provision.provisioning.locate import LocatedNode
from teds_provision.provisioning.meeting import Arrival
from teds_provision.provisioning.progress import StepResult
from teds_provision.provisioning.update import BoardUpdate, UpdatePlan
from teds_provision.station.firmware import FirmwareReading, KnownFirmware

from .shell import Screen, call
from .test_datasheet_words import NFC, Work, both

UUID, OTHER, THIRD = bytes(range(10)), bytes(range(10, 20)), bytes(range(20, 30))
NODE = UUID.hex()
POINT = b"\x04" + bytes(64)


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any, str, Any], Work]:
    def put(room: Any, name: str, result: Any) -> Work:
        work = Work(result)
        monkeypatch.setattr(room, name, work)
        return work

    return put


# -- identify ----------------------------------------------------------------------------------------------------------


def proven(uuid: bytes = UUID, **changes: Any) -> ProvenNode:
    who = IdentifiedNode(uuid, POINT, bytes(64), NodeState.FACTORY, bytes.fromhex("04a2b3c4"), None, b"", None)
    identity: Any = SimpleNamespace(epoch=3, sequence=7, can_address=0x21)
    return replace(ProvenNode(who, identity, whitelisted=True, channels=4, name="thumb"), **changes)


def arrival(found: ProvenNode | None, error: TedsProvisionError | None = None, uuid: bytes = UUID) -> Any:
    return Arrival(uuid, "nfc:usb", 0.5, found, error)


def test_a_tapped_board_is_shown_whole(home: Path, stand_in: Any) -> None:
    charging = {"state": "charging", "text": "charging, 82 %", "battery_percent": 82}
    one = proven(charging=charging, pressed=True, ble="C1:D8:57:00:01:01")
    work = stand_in(provisioning.identify, "identify_at", [arrival(one)])
    people, found = both(home, "identify", "--add", *NFC)
    key = one.who.fingerprint
    assert people.out == (
        f"{NODE}  key {key[:16]}  factory  whitelisted  thumb  tag 04a2b3c4  charging, 82 %  says it was pressed\n"
    )
    assert found == {
        "uuid": NODE,
        "fingerprint": key,
        "tag_uid": "04a2b3c4",
        "state": "factory",
        "whitelisted": True,
        "channels": 4,
        "name": "thumb",
        "epoch": 3,
        "sequence": 7,
        "can_address": 0x21,
        "charging": charging,
        "ble": "C1:D8:57:00:01:01",
        "firmware": None,
        "pressed": True,
    }
    assert work.named["add"] is True
    assert work.named["watch"] is False
    bare = proven(name=None, whitelisted=False, firmware=KnownFirmware(FirmwareReading(None, False), "not-reported"))
    work.result = [arrival(replace(bare, who=replace(bare.who, tag_uid=None)))]
    people, found = both(home, "identify", *NFC)
    assert people.out == (f"{NODE}  key {key[:16]}  factory  not whitelisted  firmware not reported (not verified)\n")
    assert (found["tag_uid"], found["name"], found["charging"], work.named["add"]) == (None, None, None, False)
    assert found["firmware"]["state"] == "not-reported"


def test_of_several_nodes_the_first_is_on_top_and_all_are_listed(home: Path, stand_in: Any) -> None:
    nodes = [proven(), proven(OTHER, name="index")]
    stand_in(provisioning.identify, "identify_at", [arrival(node) for node in nodes])
    people, found = both(home, "identify", *NFC)
    assert [line.split()[0] for line in people.out.splitlines()] == [NODE, OTHER.hex()]
    every = found.pop("nodes")
    assert [node["uuid"] for node in every] == [NODE, OTHER.hex()]
    assert found == every[0]


@pytest.mark.parametrize(("link", "listed"), [(("--can", "virtual:x"), True), (("--ble", "hci0"), True), (NFC, False)])
def test_over_a_bus_all_are_listed_if_there_is_one_too(
    home: Path, stand_in: Any, link: tuple[str, str], listed: bool
) -> None:
    """A script that reads ``nodes`` of a bus works on a bus of one node."""
    stand_in(provisioning.identify, "identify_at", [arrival(proven())])
    found = call(home, "--json", "identify", *link).json
    nodes = found.pop("nodes", None)
    assert nodes == ([found] if listed else None)
    assert found["uuid"] == NODE


def test_who_watches_gets_a_line_a_node_and_one_that_fails_ends_nothing(home: Path, stand_in: Any) -> None:
    bad = arrival(None, NotAuthenticError("It cannot prove its key.", hint="Set it aside."), OTHER)
    stand_in(provisioning.identify, "identify_at", [bad, arrival(proven())])
    people = call(home, "identify", "--watch", *NFC)
    assert (people.code, len(people.out.splitlines())) == (0, 1)
    assert OTHER.hex() in people.err
    assert "It cannot prove its key." in people.err
    assert "→ Set it aside." in people.err
    first, second = map(json.loads, call(home, "--json", "identify", "--watch", *NFC).out.splitlines())
    assert first["error"] == {
        "code": "not-authentic",
        "message": "It cannot prove its key.",
        "hint": "Set it aside.",
    }
    assert (first["uuid"], second["uuid"], "nodes" in second) == (OTHER.hex(), NODE, False)
    assert {"time"} == second.keys() - set(found_keys())


def found_keys() -> tuple[str, ...]:
    return (
        "uuid", "fingerprint", "tag_uid", "state", "whitelisted", "channels", "name", "epoch", "sequence",
        "can_address", "charging", "ble", "firmware", "pressed",
    )  # fmt: skip


@pytest.mark.parametrize("words", [["--locate"], ["--locate", "--watch"], ["--locate", "--dry-run"]])
def test_locating_needs_a_person_and_boards_that_are_there(home: Path, words: list[str]) -> None:
    outcome = call(home, "--json", "identify", *words, *NFC)
    assert (outcome.code, outcome.json["error"]["message"].startswith("--locate ")) == (2, True)


# -- agree, reset, address, locate -------------------------------------------------------------------------------------


def test_what_agree_prints(home: Path, stand_in: Any) -> None:
    work = stand_in(
        provisioning.agree, "agree_at", AgreeReport(UUID, AgreeResult(epoch=2, key_id="22" * 8, fresh=True))
    )
    people, found = both(home, "agree", NODE, *NFC)
    assert people.out == f"Node {NODE}: key {'22' * 8}, epoch 2.\n"
    assert found == {"uuid": NODE, "epoch": 2, "key_id": "22" * 8, "fresh": True}
    assert (work.named["rotate"], work.named["dry_run"], work.given[2]) == (False, False, NODE)
    work.result = AgreeReport(UUID, AgreeResult(epoch=2, key_id="22" * 8, fresh=False))
    assert call(home, "agree", NODE, *NFC).out == f"Node {NODE}: key {'22' * 8}, epoch 2 (nothing to do).\n"
    work.result = AgreeReport(UUID, None, "agree", ("22" * 8, "33" * 8))
    people, found = both(home, "agree", NODE, "--rotate", "--dry-run", *NFC)
    assert people.out == f"Plan: agree ({'22' * 8}, {'33' * 8}).\n"
    assert found == {"uuid": NODE, "plan": "agree", "held": ["22" * 8, "33" * 8]}
    assert (work.named["rotate"], work.named["dry_run"]) == (True, True)
    work.result = AgreeReport(UUID, None, "agree")
    assert call(home, "agree", NODE, "--dry-run", *NFC).out == "Plan: agree (no key yet).\n"


@pytest.mark.parametrize(
    ("words", "agreed"), [([], False), (["--yes"], False), (["--rotate"], False), (["--rotate", "--yes"], True)]
)
def test_another_stations_key_is_replaced_only_with_the_option_that_names_it(
    home: Path, stand_in: Any, words: list[str], agreed: bool
) -> None:
    work = stand_in(provisioning.agree, "agree_at", AgreeReport(UUID, AgreeResult(1, "22" * 8, fresh=True)))
    assert call(home, "agree", NODE, *words, *NFC).code == 0
    if agreed:
        work.named["confirm"]("Lock the other station out?")
        return
    with pytest.raises(PolicyError) as refused:
        work.named["confirm"]("Lock the other station out?")
    assert refused.value.hint == "Add --rotate --yes."
    assert "Lock the other station out?" in refused.value.message


def test_what_reset_prints(home: Path, stand_in: Any) -> None:
    work = stand_in(provisioning.agree, "reset_at", ResetReceipt(4, b"\x11" * 16, b"\x22" * 64))
    plan, found = both(home, "reset", NODE, "--dry-run", *NFC)
    assert (plan.out, found) == (f"Plan: reset {NODE} to factory state.\n", {"uuid": NODE, "plan": "reset"})
    refused = call(home, "--json", "reset", NODE, *NFC)
    assert (refused.code, refused.json["error"]["hint"]) == (6, "Add --yes, or --dry-run to see the plan.")
    assert work.given == []
    people, found = both(home, "reset", NODE, "--yes", *NFC)
    assert people.out == f"Node {NODE} is back in factory state and signed a receipt (epoch 4).\n"
    assert found == {"uuid": NODE, "state": "factory", "epoch": 4, "challenge": "11" * 16, "proof": "22" * 64}


@pytest.mark.parametrize(
    ("text", "address"), [("1", 1), ("0x21", 0x21), ("239", 239), ("0xEF", 239), ("0", 0), ("240", 0), ("0xF1", 0),
                          ("x", 0), ("-1", 0), ("2.0", 0)]
)  # fmt: skip
def test_a_can_address_is_1_to_239(home: Path, stand_in: Any, text: str, address: int) -> None:
    work = stand_in(provisioning.address, "set_address_at", AddressReport(UUID, True))
    outcome = call(home, "--json", "address", *NFC, "--", NODE, text)
    assert outcome.code == (0 if address else 2)
    if address:
        assert (work.given[3], work.named) == (address, {"dry_run": False})
        assert outcome.json == {"uuid": NODE, "can_address": address, "changed": True}
    else:
        assert work.given == []
        assert "a CAN address is 1 to 239 (0x01 to 0xEF)." in outcome.json["error"]["message"]


def test_what_address_prints(home: Path, stand_in: Any) -> None:
    work = stand_in(provisioning.address, "set_address_at", AddressReport(UUID, True))
    assert call(home, "address", NODE, "0x21", *NFC).out == f"Node {NODE} now has CAN address 0x21.\n"
    work.result = AddressReport(UUID, False)
    assert call(home, "address", NODE, "0x21", *NFC).out == f"Node {NODE} already has CAN address 0x21.\n"
    work.result = AddressReport(UUID, None)
    plan, found = both(home, "address", NODE, "33", "--dry-run", *NFC)
    assert plan.out == f"Plan: change the CAN address of node {NODE} to 0x21.\n"
    assert found == {"uuid": NODE, "plan": "address", "can_address": 33}
    assert work.named == {"dry_run": True}


@pytest.mark.parametrize(
    ("words", "seconds"),
    [
        ([], 10), (["--for", "30s"], 30), (["--for", "5"], 5), (["--for", "60"], 60), (["--for", "1min"], 60),
        (["--for", "10 s"], 10), (["--for", "0"], 0), (["--for", "61"], None), (["--for", "2min"], None),
        (["--for", "soon"], None), (["--for", "1.5"], None), (["--for", "1h"], None),
    ],
)  # fmt: skip
def test_a_board_blinks_for_ten_seconds_and_a_minute_at_most(
    home: Path, stand_in: Any, words: list[str], seconds: int | None
) -> None:
    work = stand_in(provisioning.locate, "locate_at", [LocatedNode(UUID, "thumb")])
    outcome = call(home, "locate", NODE, *words, *NFC)
    if seconds is None:
        assert (outcome.code, "0 to 60 seconds are expected" in outcome.err) == (2, True)
        return
    assert work.given[2:4] == [[NODE], seconds]
    ends = f"blinks for {seconds} s." if seconds else "no longer blinks."
    assert outcome.out == f"thumb ({NODE}) {ends}\n"
    assert call(home, "--json", "locate", NODE, *words, *NFC).json == {"located": [{"uuid": NODE, "name": "thumb"}]}


def test_a_board_that_does_not_blink_ends_the_command(home: Path, stand_in: Any) -> None:
    stand_in(provisioning.locate, "locate_at", [(UUID, NoNodeError("No node answered."))])
    assert call(home, "locate", NODE, *NFC).code == 5
    stand_in(provisioning.locate, "locate_at", [LocatedNode(UUID, None)])
    assert call(home, "locate", NODE, *NFC).out == f"Node ({NODE}) blinks for 10 s.\n"


# -- update ------------------------------------------------------------------------------------------------------------

IMAGE: Any = SimpleNamespace(
    octets=bytes(7000), digest=bytes.fromhex("ab" * 32), version_text="1.4.0", version=(1, 4, 0, 0), board="finger/r1"
)
RUNS: Any = SimpleNamespace(version=(1, 3, 0), build=7, text="finger/app")


@pytest.fixture
def updating(home: Path, tmp_path: Path, stand_in: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what runs an update with these plans and ends."""
    file = tmp_path / "finger.bin"
    file.write_bytes(b"image")
    for uuid in (NODE, OTHER.hex(), "ab" * 10):
        call(home, "whitelist", "add", uuid)
    stand_in(firmware_image, "load_firmware_image", IMAGE)

    def run(plans: dict[bytes, Any], ends: Any, *words: str, as_json: bool = False, terminal: bool = False) -> Any:
        monkeypatch.setattr(
            provisioning.update, "plan_or_refusal", lambda _station, _links, uuid, _order, _reporter: plans[uuid]
        )
        done = stand_in(provisioning.update, "update_boards", ends)
        if callable(ends):
            monkeypatch.setattr(provisioning.update, "update_boards", ends)
        uuids = [uuid.hex() for uuid in plans]
        given = ["--json"] if as_json else []
        outcome = call(home, *given, "update", *uuids, file, *words, *NFC, terminal=terminal)
        return outcome, done

    return run


def plan(uuid: bytes = UUID, **changes: Any) -> UpdatePlan:
    return replace(UpdatePlan(uuid, RUNS, "upload", 7000, 3.5, ("ncap",)), **changes)


def ended(result: Any, error: TedsProvisionError | None = None, uuid: bytes = UUID) -> BoardUpdate:
    return BoardUpdate(uuid, result, "1.3.0+7", 7000, 12.3456, error)


def lines_of(outcome: Any) -> list[Any]:
    return [json.loads(line) for line in outcome.out.splitlines()]


def test_the_plan_of_an_update_says_from_to_size_time_and_what_it_interrupts(updating: Any) -> None:
    outcome, done = updating({UUID: plan()}, [], "--dry-run")
    digest = "ab" * 32
    assert (outcome.code, outcome.out.splitlines()) == (
        0,
        [
            f"Plan for {NODE}: install 1.4.0 (image {digest}).",
            "  now: 1.3.0+7, finger/app",
            "  7000 octets, about 4 s if nothing else uses the link; this link is slow, keep the board where it is",
            "  interrupts the measurement by ncap",
        ],
    )
    assert done.given == []
    [found] = lines_of(updating({UUID: plan(question="The image names no board.")}, [], "--dry-run", as_json=True)[0])
    assert found == {
        "uuid": NODE,
        "plan": "upload",
        "from": "1.3.0+7",
        "to": "1.4.0",
        "image": digest,
        "octets": 7000,
        "seconds": 3.5,
        "interrupts": ["ncap"],
        "question": "The image names no board.",
    }


def test_an_update_has_a_line_a_board_and_totals(updating: Any) -> None:
    plans = {UUID: plan(), OTHER: plan(OTHER)}
    outcome, done = updating(plans, [ended("updated"), ended("already", uuid=OTHER)], "--yes", as_json=True)
    one, two, totals = lines_of(outcome)
    assert outcome.code == 0
    assert one == {
        "uuid": NODE,
        "from": "1.3.0+7",
        "to": "1.4.0",
        "image": "ab" * 32,
        "octets": 7000,
        "seconds": 12.346,
        "result": "updated",
    }
    assert (two["uuid"], two["result"]) == (OTHER.hex(), "already")
    seconds = totals["totals"].pop("seconds")
    assert seconds >= 0
    assert totals == {"totals": {"updated": 1, "already": 1, "reverted": 0, "refused": 0, "lost": 0}}
    order = done.given[2][0][1]
    assert (done.named["parallel"], order.wait, order.allow_downgrade, order.other_board) == (1, 180, False, False)
    people, done = updating(plans, [ended("updated"), ended("already", uuid=OTHER)], "--yes", "--parallel", "4")
    assert people.out.splitlines()[:2] == [
        f"{NODE}  1.3.0+7 → 1.4.0  updated  12.3 s",
        f"{OTHER.hex()}  1.4.0  already  12.3 s",
    ]
    assert people.out.splitlines()[2].startswith("1 updated, 1 already in ")
    assert done.named["parallel"] == 4


LOST, REFUSED, FORGED = BoardLostError("It is gone."), DowngradeError("It is older."), NotAuthenticError("Forged.")


@pytest.mark.parametrize(
    ("errors", "code"),
    [
        ([LOST, REFUSED, FORGED], 4),
        ([LOST, REFUSED], 6),
        ([LOST], 5),
        ([REFUSED, LOST], 6),
        ([StoreError("full"), LOST], 5),
        ([StoreError("full")], 7),
    ],
)
def test_the_worst_board_decides_how_updates_end(updating: Any, errors: list[TedsProvisionError], code: int) -> None:
    uuids = [UUID, OTHER, bytes.fromhex("ab" * 10)][: len(errors)]
    ends = [ended("refused", error, uuid) for uuid, error in zip(uuids, errors, strict=True)]
    outcome, _ = updating({uuid: plan(uuid) for uuid in uuids}, ends, "--yes", as_json=True)
    assert outcome.code == code
    assert [line["error"]["message"] for line in lines_of(outcome)[:-1]] == [error.message for error in errors]


def test_an_update_asks_unless_yes_answers_and_an_image_of_another_board_needs_its_own_option(updating: Any) -> None:
    outcome, done = updating({UUID: plan()}, [ended("updated")], as_json=True)
    assert (outcome.code, outcome.json["error"]["code"], done.given) == (6, "refused", [])
    question = "The image names the board 'arm'; this board is 'finger/app'."
    outcome, done = updating({UUID: plan(question=question)}, [], "--yes", as_json=True)
    refused, _ = lines_of(outcome)
    assert (outcome.code, refused["result"], refused["error"]) == (
        6,
        "refused",
        {
            "code": "wrong-image",
            "message": question,
            "hint": "If it is the right one all the same: --other-board",
        },
    )
    assert (done.given[2], refused["octets"], refused["seconds"], refused["from"]) == ([], 0, 0.0, "1.3.0+7")
    outcome, done = updating(
        {UUID: plan(question=question)}, [ended("updated")], "--yes", "--other-board", as_json=True
    )
    assert (outcome.code, done.given[2][0][1].other_board) == (0, True)
    outcome, done = updating({UUID: plan(stage="nothing", octets=0)}, [ended("already")], as_json=True)
    assert outcome.code == 0, "nothing to do: nothing is asked"


@pytest.mark.parametrize(
    ("answers", "ended_as", "orders"),
    [
        ([False, True], ["refused", "updated"], [(OTHER, False)]),
        ([True, True], ["updated", "updated"], [(UUID, True), (OTHER, False)]),
        ([True, False], [], None),
    ],
)
def test_a_person_decides_about_an_image_of_another_board_for_that_board_alone(
    updating: Any,
    monkeypatch: pytest.MonkeyPatch,
    answers: list[bool],
    ended_as: list[str],
    orders: list[tuple[bytes, bool]] | None,
) -> None:
    question, asked, left = "The image is for finger/r1, the board is a thumb.", list[str](), list(answers)
    monkeypatch.setattr(App, "interactive", property(lambda _app: True))
    monkeypatch.setattr(App, "ask_yes_no", lambda _app, question: (asked.append(question), left.pop(0))[1])
    plans = {UUID: plan(question=question), OTHER: plan(OTHER)}
    ends = [ended("updated", uuid=uuid) for uuid, _ in orders or ()]
    outcome, done = updating(plans, ends)
    boards = "1 board" if len(ends) == 1 else "2 boards"
    assert asked == [f"{question} Install it all the same?", f"Install 1.4.0 on {boards}?"]
    plans_shown = [line.split()[2] for line in outcome.err.splitlines() if line.startswith("Plan for ")]
    assert plans_shown == [f"{uuid.hex()}:" for uuid, agreed in ((UUID, answers[0]), (OTHER, True)) if agreed]
    if orders is None:
        assert (outcome.code, done.given) == (6, []), "no board was touched"
        assert "Cancelled. Nothing was changed." in outcome.err
        return
    assert [(uuid, order.other_board) for uuid, order in done.given[2]] == orders
    assert outcome.code == (6 if "refused" in ended_as else 0)
    hint = "\n  → If it is the right one all the same: --other-board\n"
    assert (f"Error ({NODE}): {question}{hint}" in outcome.err) is ("refused" in ended_as)
    counts = "1 updated, 1 refused" if "refused" in ended_as else "2 updated"
    assert outcome.out.splitlines()[-1].startswith(f"{counts} in ")


def test_of_several_boards_a_terminal_shows_a_row_each_and_how_many_ended(home: Path) -> None:
    table = _ProgressTable(App(home=home, quiet=True), [UUID, OTHER, THIRD])

    def rows() -> list[list[str]]:
        out = Screen()
        Console(file=out, width=120, color_system=None, force_terminal=False).print(table._render())
        return [line.split() for line in out.getvalue().splitlines()]

    try:
        assert rows() == [
            ["board"], [NODE, "waits"], [OTHER.hex(), "waits"], [THIRD.hex(), "waits"], ["0", "of", "3"],
        ]  # fmt: skip
        first, second = table.reporter_of(UUID), table.reporter_of(OTHER)
        first.started("agree")
        second.started("upload")
        second.written(3500, 7000)
        assert rows()[1:3] == [[NODE, "agree"], [OTHER.hex(), "upload", "50", "%"]]
        first.notice(Notice("retry", "The board is [b]busy[/b]."))
        second.notice(Notice("idle", "Nothing."))
        assert rows()[1:3] == [
            [NODE, "waits", "The", "board", "is", "[b]busy[/b]."],
            [OTHER.hex(), "upload", "50", "%"],
        ]
        table.ended(ended("lost", BoardLostError("It is away.", hint="Look.")))
        table.ended(ended("updated", uuid=OTHER))
        assert rows()[1:] == [
            [NODE, "lost", "It", "is", "away.", "Look."],
            [OTHER.hex(), "updated", "12.3", "s"],
            [THIRD.hex(), "waits"],
            ["2", "of", "3"],
        ]
    finally:
        table.close()


def test_on_a_terminal_the_last_table_stays_and_no_board_has_a_line_besides(
    updating: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    plans = {UUID: plan(), OTHER: plan(OTHER)}
    ends = [ended("updated"), ended("lost", BoardLostError("It is away.", hint="Look."), uuid=OTHER)]

    def update(_station: Any, _links: Any, _orders: Any, reporter_of: Any, **_how: Any) -> Any:
        reporter_of(UUID).started("upload")
        yield from ends

    outcome, _ = updating(plans, update, "--yes", terminal=True)
    assert outcome.out.split()[:4] == ["1", "updated,", "1", "lost"]
    last = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", outcome.err.replace("\r", "\n")).splitlines()
    shown = [line.split() for line in last if line.strip()][-3:]
    assert shown == [
        [NODE, "updated", "12.3", "s"],
        [OTHER.hex(), "lost", "It", "is", "away.", "Look."],
        ["2", "of", "2"],
    ]
    one, _ = updating({UUID: plan()}, [ended("updated")], "--yes", terminal=True)
    assert (NODE in one.out, "1 of 1" in one.err) == (True, False), "one board needs no table"


def test_a_dry_run_of_several_boards_counts_them(updating: Any) -> None:
    plans = {UUID: plan(), OTHER: plan(OTHER, stage="nothing", octets=0, seconds=0.0)}
    outcome, _ = updating(plans, [], "--dry-run", as_json=True)
    assert lines_of(outcome)[-1] == {
        "totals": {
            "planned": 1, "updated": 0, "already": 1, "reverted": 0, "refused": 0, "lost": 0,
            "octets": 7000, "seconds": 3.5,
        },
    }  # fmt: skip
    people, _ = updating(plans, [], "--dry-run")
    assert people.out.splitlines()[-1] == "1 planned, 1 already; 7000 octets, about 4 s one board after the other"


@pytest.mark.parametrize("words", [[], ["--match", "all"]])
def test_an_update_is_of_boards_or_of_those_that_match(home: Path, tmp_path: Path, words: list[str]) -> None:
    file = tmp_path / "finger.bin"
    file.write_bytes(b"image")
    boards = [NODE] if words else []
    assert call(home, "--json", "update", *boards, file, *words, *NFC).code == 2


def test_a_plan_names_everyone_whose_measurement_it_interrupts_and_one_to_do_nothing_none(updating: Any) -> None:
    outcome, _ = updating({UUID: plan(interrupts=("ncap", "bench2"), seconds=7000 / 3000)}, [], "--dry-run")
    digest = "ab" * 32
    assert outcome.out.splitlines() == [
        f"Plan for {NODE}: install 1.4.0 (image {digest}).",
        "  now: 1.3.0+7, finger/app",
        "  7000 octets, about 2 s if nothing else uses the link",
        "  interrupts the measurement by ncap",
        "  interrupts the measurement by bench2",
    ]
    still = plan(stage="nothing", octets=0, seconds=0.0, interrupts=())
    assert updating({UUID: still}, [], "--dry-run")[0].out.splitlines() == [
        f"Plan for {NODE}: nothing to do, it runs 1.4.0 (image {digest})."
    ]
    nameless: Any = SimpleNamespace(version=(1, 3, 0), build=7, text="")
    assert "  now: 1.3.0+7, no name" in updating({UUID: plan(report=nameless)}, [], "--dry-run")[0].out.splitlines()


def test_boards_of_a_plan_take_their_time_one_after_the_other(updating: Any) -> None:
    plans = {
        UUID: plan(),
        OTHER: plan(OTHER, octets=500, seconds=6.25),
        bytes.fromhex("ab" * 10): ended("refused", REFUSED, bytes.fromhex("ab" * 10)),
    }
    totals = lines_of(updating(plans, [], "--dry-run", as_json=True)[0])[-1]["totals"]
    assert (totals["planned"], totals["refused"], totals["octets"], totals["seconds"]) == (2, 1, 7500, 9.8)
    people = updating(plans, [], "--dry-run")[0]
    assert people.out.splitlines()[-1] == "2 planned, 1 refused; 7500 octets, about 10 s one board after the other"
    assert people.code == 6


@pytest.mark.parametrize("refused", [False, True])
def test_of_several_boards_each_line_names_its_board_also_if_one_is_left(updating: Any, refused: bool) -> None:
    def update(_station: Any, _links: Any, _orders: Any, reporter_of: Any, **_how: Any) -> Any:
        reporter_of(UUID).finished(StepResult("upload", "done", 0.5))
        yield ended("updated")

    plans: dict[bytes, Any] = {UUID: plan()}
    if refused:
        plans[OTHER] = ended("refused", REFUSED, OTHER)
    outcome, _ = updating(plans, update, "--yes")
    line = f"{NODE}: ✓ upload" if refused else "✓ upload"
    assert [text for text in outcome.err.splitlines() if text.startswith(line)] != []
    assert outcome.out.splitlines()[-1].startswith("1 updated, 1 refused in " if refused else "1 updated in ")
    assert outcome.code == (6 if refused else 0)


def test_who_watches_has_a_line_for_each_press_and_all_else_is_progress_as_before() -> None:
    course: list[Any] = []
    inner: Any = SimpleNamespace(
        started=lambda step: course.append(("started", step)),
        finished=lambda step: course.append(("finished", step.name)),
        notice=lambda notice: course.append(("notice", notice.text)),
        written=lambda octets, total: course.append(("written", octets, total)),
    )
    app: Any = SimpleNamespace(emit=lambda result, text: course.append((result, text)))
    lines = PressLines(app, inner)
    lines.started("identify")
    lines.finished(StepResult("identify"))
    lines.written(7, 9)
    lines.notice(Notice("waiting", "Tap it."))
    lines.notice(Notice("pressed", "Somebody pressed."))
    assert course == [
        ("started", "identify"), ("finished", "identify"), ("written", 7, 9), ("notice", "Tap it."),
        ("notice", "Somebody pressed."),
    ]  # fmt: skip
    course.clear()
    lines.notice(Notice("pressed", "It was pressed.", uuid=UUID))
    [(result, text)] = course
    assert result.pop("time").endswith("Z")
    assert (result, text) == ({"uuid": NODE, "pressed": True}, f"{NODE}  says it was pressed")


@pytest.mark.parametrize(
    ("add", "listed", "steps"), [(True, False, ["whitelist"]), (True, True, []), (False, False, []), (False, True, [])]
)
def test_a_plan_adds_a_node_that_is_not_listed(
    home: Path, stand_in: Any, add: bool, listed: bool, steps: list[str]
) -> None:
    stand_in(provisioning.identify, "identify_at", [arrival(proven(whitelisted=listed))])
    words = ("identify", *(["--add"] if add else []), "--dry-run", *NFC)
    assert call(home, "--json", *words).json["plan"] == steps
    text = "would be whitelisted" if steps else "whitelisted" if listed else "not whitelisted"
    assert f"  factory  {text}  thumb" in call(home, *words).out


def test_boards_that_were_located_are_listed_with_their_names(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def locate(_station: Any, _links: Any, uuids: list[str], seconds: int, _reporter: Any, *, ask_name: Any) -> Any:
        asked.append((uuids, seconds, ask_name(OTHER, "old")))
        return [LocatedNode(UUID, "thumb"), (OTHER, NoNodeError("No node answered.")), LocatedNode(THIRD, None)]

    monkeypatch.setattr(provisioning.locate, "locate_at", locate)
    course: list[Any] = []
    app: Any = SimpleNamespace(
        station=lambda: None,
        ask_text=lambda question, default: course.append((question, default)) or "new",
        fail_line=lambda error, *, uuid: course.append((error.message, uuid)),
        emit=lambda result, text: course.append((result, text)),
    )
    boards = [{"uuid": uuid.hex()} for uuid in (UUID, OTHER, THIRD)]
    _locate_each(app, None, boards, None)  # type: ignore[arg-type]
    assert asked == [([NODE, OTHER.hex(), THIRD.hex()], 60, "new")]
    assert course == [
        (f"Board 2 of 3 ({OTHER.hex()}) blinks. Its name", "old"),
        ("No node answered.", OTHER.hex()),
        (
            {"located": [{"uuid": NODE, "name": "thumb"}, {"uuid": THIRD.hex(), "name": None}]},
            f"{NODE}  thumb\n{THIRD.hex()}  (no name)",
        ),
    ]


def test_a_board_that_may_not_be_updated_has_its_line_before_the_others_are_asked_about(updating: Any) -> None:
    refused = ended("refused", REFUSED, OTHER)
    lines = lines_of(updating({OTHER: refused, UUID: plan()}, [ended("updated")], "--yes", as_json=True)[0])
    assert [(line.get("uuid"), line.get("result")) for line in lines] == [
        (OTHER.hex(), "refused"), (NODE, "updated"), (None, None),
    ]  # fmt: skip
    assert lines[0]["error"]["message"] == "It is older."
    people = updating({OTHER: refused, UUID: plan()}, [ended("updated")], "--yes")[0]
    assert f"Error ({OTHER.hex()}): It is older." in people.err
