"""``node check`` over real links, against a board in another process: rules of the link, and of a node that is gone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from teds_provision.check import session_rules
from teds_provision.check.run import CheckReport, check_at
from teds_provision.links import LinkSettings
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.station.station import Station
from tests.check.board import ADDRESS_SECONDS, BOARD
from tests.e2e.desk import Running
from tests.pace import PATIENCE
from tests.places import free_bus, free_reader

pytestmark = pytest.mark.link


@pytest.fixture(autouse=True)
def _as_quick_as_the_board(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_rules, "_ADDRESS_SECONDS", ADDRESS_SECONDS)


@contextmanager
def board(fault: str, link: str, *options: str) -> Iterator[LinkSettings]:
    """A board with this fault on a reader (``nfc``) or a bus (``can``, ``fd``) of its own."""
    place = free_reader() if link == "nfc" else free_bus() + ("&fd=1" if link == "fd" else "")
    via = "nfc" if link == "nfc" else "can"
    with closing(Running(fault, f"--{via}", place, *options, program=BOARD)) as process:
        process.wait_for("ready\n")
        yield LinkSettings(via, place, place, timeout=PATIENCE)


def checked(station: Station, fault: str, link: str, *options: str, factory: bool = False) -> CheckReport:
    with board(fault, link, *options) as links:
        return check_at(station, links, SilentReporter(), factory=factory)


def results(report: CheckReport) -> dict[str, str]:
    return {check.rule: check.result for check in report.checks}


def broken(report: CheckReport) -> dict[str, str]:
    return {check.rule: check.detail for check in report.checks if check.result == "failed"}


BUS = pytest.param(
    "can",
    marks=pytest.mark.nightly(
        "tests/check/test_node_check_cli.py::test_a_virtual_node_on_a_bus_keeps_every_rule: the same rules on the same "
        "link, by command; tests/check/test_link_rules.py::test_a_fault_of_the_link_is_found[can-form fd]"
    ),
)
FD = pytest.param(
    "fd",
    marks=pytest.mark.nightly(
        "tests/check/test_node_check_cli.py::test_a_virtual_node_on_a_bus_keeps_every_rule, and "
        "tests/check/test_link_rules.py::test_a_fault_of_the_link_is_found[can-form fd] breaks no other rule of FD"
    ),
)


@pytest.mark.parametrize("link", ["nfc", BUS, FD])
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
    pytest.param(
        *("found as of an older epoch", "can", (), "identify-found", "epoch=3"),
        marks=pytest.mark.nightly(
            "tests/check/test_link_rules.py::test_a_fault_of_the_link_is_found[identify-found nfc]"
        ),
    ),
]


@pytest.mark.parametrize(
    ("fault", "link", "options", "rule", "message"),
    FAULTS,
    ids=["can-form fd", "nfc-wait-time nfc", "nfc-wtx nfc", "identify-found nfc", "identify-found can"],
)
def test_a_fault_of_the_link_is_found(
    station: Station, fault: str, link: str, options: tuple[str, ...], rule: str, message: str
) -> None:
    found = broken(checked(station, fault, link, *options))
    assert set(found) == {rule}
    assert message in found[rule]


OTHER_CHOICE = pytest.mark.nightly(
    "tests/check/test_link_rules.py::test_what_a_node_may_choose_is_reported_and_not_failed, one choice of four; "
    "tests/links/can/test_can_small_nodes.py::test_a_node_asks_for_its_own_block_size_and_gap"
)


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        pytest.param("padding 00", "padding 00", marks=OTHER_CHOICE),
        pytest.param("block size 8", "block size 8, STmin 0 ms", marks=OTHER_CHOICE),
        ("each choice", "block size 8, STmin 2 ms; padding 00"),
        pytest.param("gap of 5 ms", "block size 16, STmin 5 ms", marks=OTHER_CHOICE),
    ],
)
def test_what_a_node_may_choose_is_reported_and_not_failed(station: Station, choice: str, message: str) -> None:
    """Small controllers need a block size of 0, or 20 ms between frames: they failed."""
    report = checked(station, choice, "can")
    assert broken(report) == {}
    (seen,) = [check.detail for check in report.checks if check.rule == "can-flow-control"]
    assert message in seen


def test_an_address_that_no_node_may_take_is_found_on_a_bus(station: Station) -> None:
    """A node that took 240 was not found any more; it is tried within 10 s of a write, which saves the node."""
    report = checked(station, "FAULT_ADDRESS_240", "can", factory=True)
    assert set(broken(report)) == {"address-checks"}
    assert report.lost is None
    assert results(report)["commit"] == "passed"
