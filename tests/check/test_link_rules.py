"""``node check`` over real links, against a board in another process: rules of the link, and of a node that is gone."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from teds_provision.check import session_rules
from teds_provision.check.run import CheckReport, check_at
from teds_provision.links import LinkSettings
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.station.station import Station
from tests.check.board import ADDRESS_SECONDS
from tests.cli.shell import clean_environment
from tests.pace import PATIENCE
from tests.places import free_bus, free_reader

pytestmark = pytest.mark.link
ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def _as_quick_as_the_board(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_rules, "_ADDRESS_SECONDS", ADDRESS_SECONDS)


@contextmanager
def board(fault: str, link: str, *options: str) -> Iterator[LinkSettings]:
    """A board with this fault on a reader (``nfc``) or a bus (``can``, ``fd``) of its own."""
    place = free_reader() if link == "nfc" else free_bus() + ("&fd=1" if link == "fd" else "")
    via = "nfc" if link == "nfc" else "can"
    with subprocess.Popen(
        [sys.executable, "-m", "tests.check.board", fault, f"--{via}", place, *options],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=clean_environment(),
    ) as process:  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "ready\n"
            yield LinkSettings(via, place, place, timeout=PATIENCE)
        finally:
            process.stdin.close()


def checked(station: Station, fault: str, link: str, *options: str, factory: bool = False) -> CheckReport:
    with board(fault, link, *options) as links:
        return check_at(station, links, SilentReporter(), factory=factory)


def results(report: CheckReport) -> dict[str, str]:
    return {check.rule: check.result for check in report.checks}


def broken(report: CheckReport) -> dict[str, str]:
    return {check.rule: check.detail for check in report.checks if check.result == "failed"}


@pytest.mark.parametrize("link", ["nfc", "can", "fd"])
def test_the_good_board_breaks_no_rule_of_its_link(station: Station, link: str) -> None:
    report = checked(station, "", link, factory=True)
    assert broken(report) == {}
    found = results(report)
    assert found["identify-found"] == "passed"
    for name in ("can-flow-control", "can-busy", "can-form", "two-sessions", "repetition-everyone"):
        assert found[name] == ("skipped" if link == "nfc" else "passed")
    assert found["nfc-wait-time"] == ("passed" if link == "nfc" else "skipped")


FAULTS = [
    ("always classic", "fd", (), "can-form", "Asked in CAN FD it answered in classic CAN"),
    ("", "nfc", ("--wait-time", "5"), "nfc-wait-time", "WT_INT is 5"),
    ("WTX 63", "nfc", (), "nfc-wtx", "multiplier 63: 1 to 59"),
    ("found as of an older epoch", "nfc", (), "identify-found", "epoch=3"),
    ("found as of an older epoch", "can", (), "identify-found", "epoch=3"),
]


@pytest.mark.parametrize(
    ("fault", "link", "options", "rule", "told"), FAULTS, ids=[f"{rule} {link}" for _, link, _, rule, _ in FAULTS]
)
def test_a_fault_of_the_link_is_found(
    station: Station, fault: str, link: str, options: tuple[str, ...], rule: str, told: str
) -> None:
    found = broken(checked(station, fault, link, *options))
    assert set(found) == {rule}
    assert told in found[rule]


@pytest.mark.parametrize(
    ("choice", "told"),
    [
        ("padding 00", "padding 00"),
        ("block size 8", "block size 8, STmin 0 ms"),
        ("gap of 5 ms", "block size 16, STmin 5 ms"),
    ],
)
def test_what_a_node_may_choose_is_told_and_not_failed(station: Station, choice: str, told: str) -> None:
    """Small controllers need a block size of 0, or 20 ms between frames: they failed."""
    report = checked(station, choice, "can")
    assert broken(report) == {}
    (seen,) = [check.detail for check in report.checks if check.rule == "can-flow-control"]
    assert told in seen


def test_an_address_that_no_node_may_take_is_found_on_a_bus(station: Station) -> None:
    """A node that took 240 was not found any more; it is tried within 10 s of a write, which saves the node."""
    report = checked(station, "FAULT_ADDRESS_240", "can", factory=True)
    assert set(broken(report)) == {"address-checks"}
    assert report.lost is None
    assert results(report)["commit"] == "passed"
