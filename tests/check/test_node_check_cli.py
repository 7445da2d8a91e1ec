"""``node check`` by subprocess, against a virtual node in another process on a CAN bus of datagrams."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.check import (
    agreement_rules,
    firmware_rules,
    frame_rules,
    link_rules,
    measuring_rules,
    plain_rules,
    session_rules,
    write_rules,
)
from teds_provision.check.rule import RULES, Stage
from tests.bench import PASSPHRASE, make_station
from tests.cli.shell import Outcome, spawn
from tests.e2e.desk import Desk

pytestmark = pytest.mark.link


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    for name in ("bench", "rival"):
        make_station(tmp_path / name, name).close()
    made = Desk(tmp_path, tmp_path)
    yield made
    made.clear()


ROOMS = (
    agreement_rules, firmware_rules, frame_rules, link_rules, measuring_rules, plain_rules, session_rules, write_rules,
)  # fmt: skip
"""Rules are registered when these are imported."""


def check(desk: Desk, name: str, *words: object) -> Outcome:
    where = ("--via", "can", "--can", desk.links.can)
    return spawn("--home", desk.folder / name, "--json", "node", *words, *where, passphrase=PASSPHRASE)


def test_a_virtual_node_on_a_bus_keeps_every_rule(desk: Desk) -> None:
    assert {rule.run.__module__ for rule in RULES} == {module.__name__ for module in ROOMS}
    node = desk.node().start(nfc=False, can=True)
    outcome = check(desk, "bench", "check", "--factory", "--yes")
    assert outcome.code == 0, outcome
    report = outcome.json
    assert report["uuid"] == node.uuid
    skipped = {check["rule"] for check in report["checks"] if check["result"] == "skipped"}
    of_channels = {rule.name for rule in RULES if rule.stage == Stage.MEASURING}
    assert skipped == {"nfc-wait-time", "nfc-wtx", "confirm-elsewhere", "write-read-only", *of_channels}
    assert (report["passed"], report["failed"]) == (len(RULES) - len(skipped), 0)
    assert set(report["checks"][0]) == {"rule", "clause", "result", "detail", "slip"}
    assert {check["slip"] for check in report["checks"]} == {None}
    assert "explain" not in report


def test_explain_prints_a_test_agreement_and_no_key_of_a_node(desk: Desk) -> None:
    desk.node().start(nfc=False, can=True)
    outcome = check(desk, "bench", "check", "--explain")
    assert outcome.code == 0, outcome
    explain = outcome.json["explain"]
    assert {key: len(explain[key]) // 2 for key in ("t", "okm", "m", "tag_n", "tag_s")} == {
        "t": 32, "okm": 48, "m": 32, "tag_n": 16, "tag_s": 16
    }  # fmt: skip
    assert explain["tag_n"] == explain["tag_n_received"]
    assert (explain["problem"], explain["slip"]) == (None, None)
    where = ("--via", "can", "--can", desk.links.can)
    words = spawn("--home", desk.folder / "bench", "node", "check", "--explain", *where, passphrase=PASSPHRASE)
    assert "never confirmed" in words.out
    assert "tagN, expected" in words.out


def test_without_a_word_nothing_is_keyed(desk: Desk) -> None:
    desk.node().start(nfc=False, can=True)
    assert check(desk, "bench", "check", "--factory").code == 6
    planned = check(desk, "bench", "check", "--factory", "--dry-run")
    assert (planned.code, "plan" in planned.json) == (0, True)
    outcome = check(desk, "bench", "check")
    assert (outcome.code, outcome.json["failed"]) == (0, 0)
    assert all(c["result"] == "skipped" for c in outcome.json["checks"] if c["rule"] in ("commit", "reset", "open-tag"))


def test_exit_codes_of_no_node_and_of_another_owner(desk: Desk) -> None:
    assert check(desk, "bench", "check", "--timeout", "1").code == 5
    desk.node().start(nfc=False, can=True)
    where = ("--via", "can", "--can", desk.links.can)
    words = ("provision", "--profile", "temperature-sensor", "--yes", *where)
    done = spawn("--home", desk.folder / "rival", "--json", *words, passphrase=PASSPHRASE)
    assert done.code == 0, done
    outcome = check(desk, "bench", "check", "--factory", "--yes")
    assert (outcome.code, outcome.json["error"]["code"]) == (6, "refused")
    own = check(desk, "rival", "check")
    assert (own.code, own.json["failed"]) == (0, 0), own
