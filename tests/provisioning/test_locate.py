"""``locate``: one node after the other blinks, and may get a name while it does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NodeRefusedError, NodeSilentError, NoNodeError, PolicyError
from teds_provision.links import LinkSettings
from teds_provision.protocol.messages.frames import Command, Function, Reason, security_command
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning import locate as locating
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.provisioning.locate import LocatedNode, locate, locate_at, locate_here, locate_measured
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.station.station import Station

FIRST, SECOND = bytes([0xA1] * 10), bytes([0xA2] * 10)


class MockNode:
    def __init__(self, uuid: bytes = FIRST, error: Exception | None = None) -> None:
        self.uuid, self.error = uuid, error
        self.identity = SimpleNamespace(state=NodeState.KEYED)
        self.sealed = False
        self.blinked: list[int] = []

    def request_retry_once(self, frame: Command, _why: str) -> None:
        if self.error is not None:
            raise self.error
        self.blinked += [count for count in range(256) if frame == security_command(Function.LOCATE, bytes([count]))]


@pytest.fixture
def sessions(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    opened: list[bytes] = []
    monkeypatch.setattr(locating, "require_session", lambda _station, node: opened.append(node.uuid))
    return opened


def test_a_session_is_opened_unless_there_is_one_or_the_node_is_new(station: Station, sessions: list[bytes]) -> None:
    keyed, sealed, new = MockNode(), MockNode(), MockNode()
    sealed.sealed, new.identity.state = True, NodeState.FACTORY
    for node in (keyed, sealed, new):
        locate_here(station, node, 8)  # type: ignore[arg-type]
        assert node.blinked == [8]
    assert sessions == [FIRST]


def test_a_node_that_cannot_blink_says_so_and_other_refusals_stay_what_they_are(
    station: Station, sessions: list[bytes]
) -> None:
    node: Any = MockNode(error=NodeRefusedError("no such command", reason=Reason.UNKNOWN_COMMAND))
    with pytest.raises(NodeRefusedError) as refused:
        locate(node, 5)
    assert refused.value.message == f"Node {FIRST.hex()} cannot blink or beep."
    assert (refused.value.reason, refused.value.hint) == (Reason.UNKNOWN_COMMAND, "Press its button instead.")
    busy = NodeRefusedError("it is busy", reason=Reason.BUSY)
    with pytest.raises(NodeRefusedError, match=r"^it is busy$"):
        locate(MockNode(error=busy), 5)  # type: ignore[arg-type]
    lost = MockNode(error=SessionLostError(NodeSilentError("gone")))
    steps: tuple[Callable[[Any], None], ...] = (
        lambda node: locate_here(station, node, 5),
        lambda node: locate_measured(node, 5),
    )
    for step in steps:
        with pytest.raises(NodeSilentError, match=r"^gone$"):
            step(lost)


def located(
    station: Station,
    monkeypatch: pytest.MonkeyPatch,
    ask_name: Callable[[bytes, str], str] | None = None,
    missing: bytes = b"",
) -> tuple[list[Any], list[MockNode], list[str]]:
    nodes: list[MockNode] = []
    ways: list[str] = []

    @contextmanager
    def at_node(_station: Station, links: LinkSettings, uuid: bytes, _reporter: object) -> Iterator[Any]:
        ways.append(links.via)
        if uuid == missing:
            raise NoNodeError("no node came")
        nodes.append(MockNode(uuid))
        yield SimpleNamespace(node=nodes[-1])

    monkeypatch.setattr(locating, "at_node", at_node)
    links = LinkSettings(nfc="usb", ble="hci0")
    found = list(locate_at(station, links, [FIRST.hex(), SECOND.hex()], 9, SilentReporter(), ask_name=ask_name))
    return found, nodes, ways


def test_one_node_after_the_other_blinks_and_one_that_is_missing_costs_no_other(
    station: Station, sessions: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    with station.transaction():
        station.nodes.remember(SECOND, name="crane")
    found, nodes, ways = located(station, monkeypatch)
    assert found == [LocatedNode(FIRST, None), LocatedNode(SECOND, "crane")]
    assert ([node.blinked for node in nodes], ways) == ([[9], [9]], ["ble", "ble"])
    found, nodes, _ways = located(station, monkeypatch, missing=FIRST)
    assert (found[0][0], found[0][1].message) == (FIRST, "no node came")
    assert found[1:] == [LocatedNode(SECOND, "crane")]


def test_a_node_gets_a_name_while_it_blinks_and_stops_then(
    station: Station, sessions: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    with station.transaction():
        station.nodes.remember(FIRST)
        station.nodes.remember(SECOND, name="crane")
    asked: list[tuple[bytes, str]] = []
    answers = {FIRST: "boom", SECOND: ""}

    def ask(uuid: bytes, name: str) -> str:
        asked.append((uuid, name))
        return answers[uuid]

    def named() -> list[tuple[bytes, dict[str, Any]]]:
        return [(entry.uuid, entry.detail) for entry in station.audit_log.entries() if entry.act == "name"]

    found, nodes, _ways = located(station, monkeypatch, ask)
    assert found == [LocatedNode(FIRST, "boom"), LocatedNode(SECOND, "crane")]
    assert [node.blinked for node in nodes] == [[9, 0], [9, 0]]
    assert asked == [(FIRST, ""), (SECOND, "crane")]
    assert named() == [(FIRST, {"name": "boom"})]
    answers[SECOND] = "crane"
    assert located(station, monkeypatch, ask)[0] == found
    assert named() == [(FIRST, {"name": "boom"})], "the same names are no change"
    answers[SECOND] = "boom"
    found, nodes, _ways = located(station, monkeypatch, ask)
    assert isinstance(found[1][1], PolicyError)
    record = station.nodes.get(SECOND)
    assert record is not None
    assert record.name == "crane"
