"""Firmware updates by the API: a service, boards on its bus, and images that an owner signed."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import pytest

from teds_provision.api.operations import LARGEST_IMAGE
from teds_provision.client import ApiError
from tests.e2e.desk import ANGLE, Desk, Node, nothing_lost
from tests.firmware_images import make_key, sign
from tests.ncap.service import Service, verified, virtual
from tests.pace import until

pytestmark = pytest.mark.link
RESULTS = ("updated", "already", "reverted", "refused", "lost")


class Bench:
    """A station that runs, boards of one owner, and a board that takes no firmware."""

    def __init__(self, desk: Desk) -> None:
        self.desk, self.service = desk, Service(desk, desk.station())
        self.key = make_key(desk.folder / "owner.pem")
        self.old, self.new = self.image("1.0.0"), self.image("1.1.0")
        self.boards = [self.board(f"board{number}") for number in range(2)]
        self.plain = desk.node("plain").start(nfc=False, can=True)
        calibration = desk.folder / "angle.csv"
        calibration.write_text("# date: 2026-10-01\nraw,value [degree]\n0,0\n65535,359.9\n")
        words = ["--profile", ANGLE, "--calibration", calibration, "--yes", *desk.links.over("can")]
        for node in (*self.boards, self.plain):
            assert self.service.station.ask("provision", node.uuid, *words)["verdict"] == "authentic"

    def image(self, version: str, **more: Any) -> Path:
        return sign(self.desk.folder, version, more.pop("key", self.key), **{"counter": 1, **more})

    def board(self, name: str) -> Node:
        made = self.desk.node(name, type_=ANGLE, firmware=(self.old, self.key))
        return made.start("--source", "ramp:5", nfc=False, can=True)

    def start(self) -> Service:
        self.service.start()
        for node in (*self.boards, self.plain):
            verified(self.service, node.uuid)
        return self.service

    @property
    def kept(self) -> list[Path]:
        """The images that the home keeps."""
        return list((self.service.station.home / "updates").glob("*.image"))

    def update(self, image: Path, *nodes: Node, **more: Any) -> dict[str, Any]:
        """An update, or its plan, as a script asks for it; which version the boards ran before does not matter."""
        more = {"allow_downgrade": True, **more}
        with self.service.client() as asked:
            return dict(asked.update(image.read_bytes(), *(node.uuid for node in nodes), **more))

    def runs(self, node: Node) -> str:
        """Return the version that a board runs."""
        return str(verified(self.service, node.uuid)["firmware"]["version"])

    def ended(self, action: dict[str, Any]) -> dict[str, Any]:
        """Wait for the end of an update."""

        def over() -> Any:
            with self.service.client() as asked:
                found = asked.follow_update(action["id"])
            return found if found["state"] != "running" else None

        return dict(until(over, "the update does not end"))

    def done(self, image: Path, *nodes: Node, **more: Any) -> dict[str, Any]:
        return self.ended(self.update(image, *nodes, **more))


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory, prepared: Path) -> Iterator[Bench]:
    desk = Desk(tmp_path_factory.mktemp("updates"), prepared)
    try:
        made = Bench(desk)
        made.start()
        yield made
        made.service.end()
    finally:
        desk.clear()


@contextmanager
def paused(node: Node) -> Iterator[None]:
    """Yield a board that answers nothing for the time of the block: its update stands still."""
    assert node.process is not None
    node.process.signal(signal.SIGSTOP)
    try:
        yield
    finally:
        node.process.signal(signal.SIGCONT)


def rows(action: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {row["uuid"]: row for row in action["boards"]}


def refusal(bench: Bench, image: bytes, *nodes: Node, **more: Any) -> ApiError:
    with bench.service.client() as asked, pytest.raises(ApiError) as caught:
        asked.update(image, *(node.uuid for node in nodes), **more)
    return caught.value


def test_a_plan_says_what_happens_to_each_board_and_changes_nothing(bench: Bench) -> None:
    first, second = bench.boards
    before = [node.octets for node in bench.boards]
    plan = bench.update(bench.new, first, second, bench.plain, dry_run=True)
    assert (plan["id"], plan["state"], plan["owner"]) == (None, "planned", "ncap")
    assert (plan["image"]["version"], plan["image"]["board"]) == ("1.1.0", "virtual/finger")
    for node in bench.boards:
        row = rows(plan)[node.uuid]
        size = bench.new.stat().st_size
        assert (row["from"], row["to"], row["plan"], row["octets"]) == (bench.runs(node), "1.1.0", "upload", size)
        assert row["seconds"] > 0
        assert (row["question"], row["error"], row["result"]) == ("", None, None)
    refused = rows(plan)[bench.plain.uuid]
    assert (refused["result"], refused["error"]["code"]) == ("refused", "no-update")
    other = rows(bench.update(bench.image("1.2.0", board="other/board"), first, dry_run=True))[first.uuid]
    assert "names the board 'other/board'" in other["question"]
    older = rows(bench.update(bench.image("0.9.0"), first, dry_run=True, allow_downgrade=False))[first.uuid]
    assert (older["result"], older["error"]["code"]) == ("refused", "downgrade")
    allowed = rows(bench.update(bench.image("0.9.0"), first, dry_run=True, allow_downgrade=True))[first.uuid]
    assert (allowed["plan"], allowed["error"]) == ("upload", None)
    assert [node.octets for node in bench.boards] == before
    assert not bench.kept


def test_many_boards_are_updated_and_everything_else_stays(bench: Bench) -> None:
    key, image = bench.service.token("robot"), bench.image("1.3.0")
    before = {node.uuid: bench.runs(node) for node in bench.boards}
    with bench.service.client(key) as robot:
        seen: dict[str, Any] = {}
        live = robot.live()
        next(live)
        begun = robot.update(image.read_bytes(), match=f"type:{ANGLE}", parallel=4, allow_downgrade=True)
        assert (begun["state"], begun["owner"]) == ("running", "api:robot")
        for message in live:
            if message.get("event") == "update" and "board" in message:
                seen.setdefault(message["uuid"], []).append(message["board"]["step"])
            if message.get("event") == "update" and message["state"] != "running":
                break
    done = bench.ended(dict(begun))
    results = {uuid: row["result"] for uuid, row in rows(done).items()}
    assert results == {**{node.uuid: "updated" for node in bench.boards}, bench.plain.uuid: "refused"}
    assert {name: done["totals"][name] for name in RESULTS} == {
        "updated": 2, "already": 0, "reverted": 0, "refused": 1, "lost": 0,
    }  # fmt: skip
    for node in bench.boards:
        assert {"upload", "restart", "prove"} <= set(seen[node.uuid])
        assert (rows(done)[node.uuid]["from"], rows(done)[node.uuid]["to"]) == (before[node.uuid], "1.3.0")
        shown = until(
            lambda node=node: (n := verified(bench.service, node.uuid))["firmware"]["version"] == "1.3.0" and n
        )
        assert shown["verdict"]["verdict"] == "authentic"
    assert not bench.kept
    with bench.service.client() as asked:
        entries = [entry for entry in asked.log() if entry["act"] == "update"]
        outcomes = [entry["outcome"] for entry in entries]
        entries = entries[len(outcomes) - 1 - outcomes[::-1].index("begun") :]
        assert {entry["actor"] for entry in entries} == {"robot"}
        assert {entry["outcome"] for entry in entries} == {"begun", "updated", "refused", "ended"}
        assert asked.updates()[0]["id"] == begun["id"]
    again = bench.done(image, *bench.boards)
    assert again["totals"]["already"] == 2


def test_an_image_for_another_board_needs_a_word_about_that_very_board(bench: Bench) -> None:
    first, second = bench.boards
    other = bench.image("1.4.0", board="other/board")
    done = rows(bench.done(other, first, second, other_board=[first.uuid]))
    assert done[first.uuid]["result"] == "updated"
    assert (done[second.uuid]["result"], done[second.uuid]["error"]["code"]) == ("refused", "wrong-image")
    with bench.service.client() as asked:
        begun = [entry for entry in asked.log() if entry["outcome"] == "begun"][-1]
    assert begun["facts"]["other_board"] == [first.uuid]
    back = bench.image("1.3.1")  # to a board that the other image made another one
    assert (
        bench.done(back, first, other_board=[first.uuid], allow_downgrade=False)["boards"][0]["error"]["code"]
        == "downgrade"
    )
    assert bench.done(back, first, other_board=[first.uuid], allow_downgrade=True)["totals"]["updated"] == 1


def test_another_owners_image_is_reverted_by_the_boot_loader(bench: Bench) -> None:
    board = bench.boards[0]
    rival = bench.image("3.0.0", key=make_key(bench.desk.folder / "rival.pem"))
    row = rows(bench.done(rival, board))[board.uuid]
    assert (row["result"], row["error"]["code"]) == ("reverted", "reverted")
    assert verified(bench.service, board.uuid)["verdict"]["verdict"] == "authentic"


def test_what_is_no_image_and_who_may_not_is_refused(bench: Bench) -> None:
    board, image = bench.boards[0], bench.image("1.5.0").read_bytes()
    for octets in (b"x", image[:-9], image + b"\0", b"\0" * 100_000, b"#!/bin/sh\nreboot\n"):
        refused = refusal(bench, octets, board)
        assert (refused.status, refused.code) == (422, "bad-data"), octets[:9]
    assert refusal(bench, b"", board).code == "bad-data"
    assert refusal(bench, image).status == 422
    assert refusal(bench, image, board, match="all").status == 422
    assert refusal(bench, image, match="name:nothing*").status == 404
    with bench.service.client() as asked, pytest.raises(ApiError) as unknown:
        asked.update(image, "f" * 20)
    assert unknown.value.status == 404
    large = refusal(bench, b"\0" * (LARGEST_IMAGE + 1), board)
    assert (large.status, large.code) == (413, "too-large")
    octets = {"Content-Type": "application/octet-stream"}
    path = f"/api/v1/updates?nodes={board.uuid}"
    assert bench.service.raw("POST", path, octets, image).status == 401
    assert bench.service.raw("POST", path, {**octets, "Authorization": "Bearer x"}, image).status == 401
    reader = {"Authorization": f"Bearer {bench.service.token('reader', '--read-only')}"}
    assert bench.service.raw("POST", path, octets | reader, image).status == 403
    assert bench.service.raw("DELETE", "/api/v1/updates/none", reader).status == 403
    writer = {"Authorization": f"Bearer {bench.service.token('writer')}"}
    for kind in ("application/json", "multipart/form-data", "text/plain", ""):
        assert bench.service.raw("POST", path, {**writer, "Content-Type": kind}, image).status == 415
    assert bench.service.raw("POST", path, {**writer, **octets, "Origin": "http://evil.example"}, image).status == 403
    assert bench.service.raw("POST", "/api/v1/groups", {**writer, **octets}, image).status == 415
    for words in ("dryrun=1", "dry_run=1&Wait=9", "allow_downgrade=no", "dry_run=perhaps"):
        assert bench.service.raw("POST", f"{path}&{words}", {**writer, **octets}, image).status == 422, words
    assert not bench.kept
    with bench.service.client() as asked:
        assert all(update["state"] != "running" for update in asked.updates())


def test_a_script_may_write_a_switch_as_its_language_does(bench: Bench) -> None:
    board, older = bench.boards[0], bench.image("0.9.0").read_bytes()
    headers = {
        "Content-Type": "application/octet-stream",
        "Authorization": f"Bearer {bench.service.token('script')}",
    }
    for word, code in (("False", "downgrade"), ("0", "downgrade"), ("True", None), ("1", None)):
        path = f"/api/v1/updates?nodes={board.uuid}&dry_run=True&allow_downgrade={word}"
        (row,) = bench.service.raw("POST", path, headers, older).json["boards"]
        assert (row["error"] or {"code": None})["code"] == code, word


def test_a_second_update_is_refused_with_who_updates(bench: Bench) -> None:
    board = bench.boards[0]
    with paused(board):
        begun = bench.update(bench.image("1.6.0"), board)
        second_is_refused(bench)
    assert bench.ended(begun)["totals"]["updated"] == 1


def second_is_refused(bench: Bench) -> None:
    two = bench.boards[1]
    [image] = bench.kept
    assert (image.stat().st_mode & 0o777, image.parent.stat().st_mode & 0o777) == (0o600, 0o700)
    second = refusal(bench, bench.image("1.6.1").read_bytes(), two)
    assert (second.status, second.code) == (423, "node-busy")
    assert "ncap is updating 1 boards to 1.6.0" in second.message


def test_no_further_board_is_begun_after_a_cancel(bench: Bench) -> None:
    with paused(bench.boards[0]), bench.service.client() as asked:
        begun = bench.update(bench.image("1.7.0"), *bench.boards)

        def begins() -> bool:
            return asked.follow_update(begun["id"])["boards"][0]["state"] == "running"

        until(begins)
        asked.cancel_update(begun["id"])
        kept = json.loads((bench.service.station.home / "updates" / f"{begun['id']}.json").read_bytes())
        assert [row["state"] for row in kept["rows"]] == ["running", "skipped"], "nor after a restart of the service"
    done = bench.ended(begun)
    assert done["state"] == "stopped"
    assert [(row["state"], row["result"]) for row in done["boards"]] == [("ended", "updated"), ("skipped", None)]


def events_of(bench: Bench, node: Node) -> list[str]:
    """Return what the service said of the measurement of a node, in order."""
    process = bench.service.process
    assert process is not None
    while process.read(0.1):
        pass
    lines = [json.loads(line) for line in process.out[: process.out.rfind("\n") + 1].splitlines()]
    mine = [line for line in lines if line.get("event") == "measurement" and line.get("uuid") == node.uuid]
    return [line["state"] if line["state"] != "left" else line["why"] for line in mine]


@contextmanager
def measured(bench: Bench) -> Iterator[Callable[[Node], dict[str, Any]]]:
    """Both boards are measured, each by its own measurement; gives how that goes for a board."""
    with bench.service.client() as asked:
        ids = [asked.measure(node.uuid, rate=20)["id"] for node in bench.boards]

        def report(node: Node) -> dict[str, Any]:
            every = [report for found in asked.measurements() for report in found["nodes"]]
            return dict(next((report for report in every if report["uuid"] == node.uuid), {}))

        try:
            until(lambda: all(report(node).get("samples", 0) > 10 for node in bench.boards))
            yield report
        finally:
            for measurement in ids:
                asked.end_measurement(measurement)


def test_the_measurement_of_a_board_pauses_and_that_of_another_one_does_not(bench: Bench) -> None:
    first, second = bench.boards
    with measured(bench) as report:
        before = {node.uuid: len(events_of(bench, node)) for node in bench.boards}
        image = bench.image("1.8.0", octets=8_000)
        assert rows(bench.update(image, first, dry_run=True))[first.uuid]["interrupts"]
        assert rows(bench.done(image, first))[first.uuid]["result"] == "updated"
        until(lambda: report(first)["state"] == "running")
        until(lambda: events_of(bench, first)[before[first.uuid] :][-1:] == ["joined"], lambda: events_of(bench, first))
        assert "let go for update" in events_of(bench, first)[before[first.uuid] :]
        assert "let go for update" not in events_of(bench, second)[before[second.uuid] :]


@pytest.mark.nightly("tests/e2e/test_update.py::test_a_measurement_beside_an_update_loses_nothing")
@pytest.mark.realtime
def test_no_value_of_a_measured_board_is_lost_beside_an_update(bench: Bench) -> None:
    first, second = bench.boards
    with measured(bench) as report:
        before, image = report(second), bench.image(f"4.0.{time.monotonic_ns() // 10**9 % 10_000}", octets=8_000)
        with nothing_lost(second, lambda: report(second)):
            assert rows(bench.done(image, first))[first.uuid]["result"] == "updated"
        assert report(second)["samples"] > before["samples"]


def test_a_board_whose_actuator_is_in_use_is_refused(bench: Bench) -> None:
    hand = virtual(bench.service)
    image = bench.image("1.9.0").read_bytes()
    with bench.service.client() as asked:
        for measurement in (False, True):
            if measurement:
                asked.measure(hand, rate=20)
                until(lambda: any(channel["last"] for channel in asked.node(hand)["channels"]))
            actuator = next(channel for channel in asked.node(hand)["channels"] if channel["kind"] == "actuator")
            asked.set(hand, actuator["number"], actuator["low"], hold=60)
            row = asked.update(image, hand, dry_run=True)["boards"][0]
            assert row["result"] == "refused"
            assert f"Actuator {actuator['number']} of the board is in use" in row["error"]["message"]
            asked.release_actuator(hand, actuator["number"])
        row = asked.update(image, hand, dry_run=True)["boards"][0]
        assert "Actuator" not in row["error"]["message"]
        for measurement in asked.measurements():
            asked.end_measurement(measurement["id"])
        asked.request("DELETE", f"/virtual/{hand}")


@pytest.mark.parametrize("how", ["kill -9", "restart, measured"])
def test_the_same_update_goes_on_after_the_service_was_cut(bench: Bench, how: str) -> None:
    version = {"kill -9": "2.0.0", "restart, measured": "2.1.0"}[how]
    with measured(bench) if "measured" in how else nullcontext() as report:
        begun = bench.update(bench.image(version, octets=12_000), *bench.boards)
        if how == "kill -9":

            def under_way() -> bool:
                with bench.service.client() as asked:
                    first = asked.follow_update(begun["id"])["boards"][0]
                return first["written"] > 2000 or first["result"] is not None

            until(under_way)
            bench.service.kill()
        else:
            bench.service.end()
        bench.start()
        done = bench.ended(begun)
        # cut between the board's last reply and the record of it, it is found done
        assert {row["result"] for row in done["boards"]} <= {"updated", "already"}, done["boards"]
        for node in bench.boards:
            until(lambda node=node: verified(bench.service, node.uuid)["firmware"]["version"] == version)
        assert not bench.kept
        with bench.service.client() as asked:
            outcomes = [entry["outcome"] for entry in asked.log() if entry["act"] == "update"]
        assert set(outcomes[len(outcomes) - outcomes[::-1].index("begun") :]) <= {"updated", "ended"}, (
            "no word of the cut"
        )
        if report is not None:
            until(lambda: all(report(node)["state"] == "running" for node in bench.boards), "both are measured again")
