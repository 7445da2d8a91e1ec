"""What ``identify`` keeps of each node, what it shows, and which error ends it; the nodes are in memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import (
    KeyringUnavailableError,
    NotAuthenticError,
    PolicyError,
    StoreError,
    TedsProvisionError,
    WrongPassphraseError,
)
from teds_provision.links import LinkSettings, Notice
from teds_provision.protocol.keys import fingerprint, node_key_message
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning import identify as step
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.identify import (
    Description,
    ProvenNode,
    identify,
    identify_at,
    new_whitelist_entry,
)
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.station.station import Station
from teds_provision.station.store.records import RevocationRecord
from tests.bench import Board, MemoryLink, talk

from .test_provision import run as provision

LINKS = LinkSettings("can", can="a:1")


class Reporter(SilentReporter):
    """What a person is told meanwhile."""

    def __init__(self) -> None:
        self.notices: list[Notice] = []

    def notice(self, notice: Notice) -> None:
        self.notices.append(notice)


@pytest.fixture
def there(monkeypatch: pytest.MonkeyPatch) -> list[Conversation]:
    """Return the nodes that are met, each of which calls itself finger and has three channels."""
    nodes: list[Conversation] = []

    @contextmanager
    def meet_all(_links: object, _reporter: object) -> Iterator[list[Conversation]]:
        yield nodes

    monkeypatch.setattr(step, "meet_all", meet_all)
    monkeypatch.setattr(step, "describe", lambda _node: Description("finger", 3))
    return nodes


def on_bus(board: Board) -> Conversation:
    return talk(board, MemoryLink(board, via="can", tapped=False))


def found(station: Station, reporter: Reporter | None = None, **how: bool) -> list[ProvenNode]:
    arrivals = list(identify_at(station, LINKS, reporter or Reporter(), **how))
    return [arrival.result for arrival in arrivals if arrival.result is not None]


def acts(station: Station, board: Board) -> list[tuple[str, str]]:
    return [(line.act, line.outcome) for line in station.audit_log.entries() if line.uuid == board.uuid]


@pytest.mark.parametrize(
    ("how", "known", "listed", "log"),
    [
        ({}, True, False, [("identify", "proven")]),
        ({"add": True}, True, True, [("whitelist", "added"), ("identify", "proven")]),
        ({"dry_run": True}, False, False, []),
        ({"add": True, "dry_run": True}, False, False, []),
    ],
)
def test_what_is_kept_of_a_node(
    station: Station,
    there: list[Conversation],
    monkeypatch: pytest.MonkeyPatch,
    how: dict[str, bool],
    known: bool,
    listed: bool,
    log: list[tuple[str, str]],
) -> None:
    opened: list[object] = []
    unlock = type(station).unlock
    monkeypatch.setattr(type(station), "unlock", lambda own, *more: opened.append(1) or unlock(own, *more))
    board = Board()
    there.append(on_bus(board))
    (one,) = found(station, **how)
    assert bool(opened) == (how == {"add": True}), "the MAC of a pin needs the vault, before the wait for a node"
    assert (one.whitelisted, one.name, one.channels) == (listed, "finger", 3)
    record = station.nodes.get(board.uuid)
    assert (None if record is None else (record.name, record.channels)) == (("finger", 3) if known else None)
    entry = station.pins.entry(board.uuid)
    assert (entry is not None) == listed
    if entry is not None:
        assert (entry.fingerprint, entry.assurance) == (fingerprint(board.key.point), "bus")
    assert acts(station, board) == log


@pytest.mark.parametrize("dry_run", [False, True])
def test_a_revoked_node_is_not_added_in_a_plan_either(
    station: Station, there: list[Conversation], dry_run: bool
) -> None:
    board = Board()
    station.policy.deny(RevocationRecord(board.uuid, None, "stolen", "{}"))
    there.append(on_bus(board))
    with pytest.raises(PolicyError, match=rf"^Node {board.uuid.hex()} was revoked: stolen\.$"):
        found(station, add=True, dry_run=dry_run)
    assert station.pins.entry(board.uuid) is None


def test_the_stations_name_of_a_node_goes_before_its_own_and_no_two_nodes_get_one(
    station: Station, there: list[Conversation]
) -> None:
    named, twin = Board(), Board(bytes(9) + b"\1")
    station.nodes.remember(named.uuid, name="crane")
    station.nodes.remember(bytes(9) + b"\2", name="finger")
    there += [on_bus(named), on_bus(twin)]
    assert [one.name for one in found(station)] == ["crane", "finger"]
    kept = [station.nodes.get(board.uuid) for board in (named, twin)]
    assert [record and record.name for record in kept] == ["crane", None], "another node has that name"
    assert [record and record.channels for record in kept] == [3, 3]


def test_what_a_node_says_of_itself_replaces_nothing_of_its_datasheet(
    station: Station, board: Board, there: list[Conversation]
) -> None:
    provision(station, board)
    before = station.nodes.get(board.uuid)
    there.append(on_bus(board))
    found(station)
    after = station.nodes.get(board.uuid)
    assert before is not None
    assert after is not None
    assert (after.name, after.channels) == (before.name, before.channels) != ("finger", 3)


def test_a_node_that_is_not_identified_is_told_of_beside_others_and_an_error_alone(
    station: Station, there: list[Conversation], monkeypatch: pytest.MonkeyPatch
) -> None:
    good, *bad = (Board(bytes(9) + bytes([number])) for number in range(3))
    errors: dict[bytes, TedsProvisionError] = {
        bad[0].uuid: NotAuthenticError("first"),
        bad[1].uuid: PolicyError("second"),
    }
    own = step.identify

    def identify_or_not(station: Station, node: Conversation, **more: Any) -> Any:
        if node.uuid in errors:
            raise errors[node.uuid]
        return own(station, node, **more)

    monkeypatch.setattr(step, "identify", identify_or_not)
    for boards, proven, told, error in (
        ([good, *bad], 1, 2, None),
        (bad, 0, 2, "first"),
        (bad[1:], 0, 0, "second"),
        ([good], 1, 0, None),
    ):
        there[:] = [on_bus(board) for board in boards]
        reporter = Reporter()
        if error is None:
            assert len(found(station, reporter)) == proven
        else:
            with pytest.raises(TedsProvisionError, match=f"^{error}$"):
                found(station, reporter)
        assert [notice.kind for notice in reporter.notices] == ["unfinished"] * told
        for notice in reporter.notices:
            assert notice.uuid is not None
            assert notice.text == f"Node {notice.uuid.hex()} was not identified: {errors[notice.uuid].message}"


@pytest.mark.parametrize(
    ("via", "tapped", "keyed", "assurance", "pinned"),
    [
        ("nfc", True, False, "tap", True),
        ("nfc", True, True, "tap", True),
        ("can", False, False, "bus", True),
        ("can", False, True, "uuid", False),
        ("ble", False, False, "uuid", False),  # over the air nothing is pinned
        ("ble", False, True, "uuid", False),
    ],
)
def test_how_sure_a_station_is_of_a_newcomers_key(
    station: Station, board: Board, via: str, tapped: bool, keyed: bool, assurance: str, pinned: bool
) -> None:
    if keyed:
        provision(station, board)
    node = talk(board, MemoryLink(board, via=via, tapped=tapped))
    entry = new_whitelist_entry(station, node, identify(station, node))
    assert (entry.assurance, entry.fingerprint) == (assurance, fingerprint(board.key.point) if pinned else None)


@pytest.mark.parametrize("error", [WrongPassphraseError("No."), KeyringUnavailableError("No."), StoreError("full")])
def test_a_vault_that_stays_locked_leaves_the_pin_to_the_first_agreement(
    station: Station, monkeypatch: pytest.MonkeyPatch, error: TedsProvisionError
) -> None:
    assert step._opened(station)

    def locked(_own: Station) -> None:
        raise error

    monkeypatch.setattr(type(station), "unlock", locked)
    if type(error) is StoreError:
        with pytest.raises(StoreError):
            step._opened(station)
    else:
        assert not step._opened(station)


@pytest.mark.parametrize(
    ("change", "recalled"),
    [
        ("nothing", True),
        ("no key held", False),
        ("no datasheet", False),
        ("no reading", False),
        ("read plainly", False),
        ("factory state", False),
        ("no node key", False),
        ("no signature", False),
        ("another node's signature", False),
        ("it cannot prove it", False),
    ],
)
def test_a_node_proves_the_key_of_its_last_session_unless_anything_of_it_is_not_as_it_was(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch, change: str, recalled: bool
) -> None:
    provision(station, board)
    row = station.datasheets.reading(board.uuid)
    assert row is not None
    assert row.in_session
    forged = board.key.sign(node_key_message(bytes(10), board.key.point))
    good = {"in_session": True, "node_key": row.node_key, "node_key_signature": row.node_key_signature}
    changes: dict[str, Any] = {
        "read plainly": SimpleNamespace(**good | {"in_session": False}),
        "no node key": SimpleNamespace(**good | {"node_key": None}),
        "no signature": SimpleNamespace(**good | {"node_key_signature": None}),
        "another node's signature": SimpleNamespace(**good | {"node_key_signature": forged}),
        "no reading": None,
    }
    if change in changes:
        monkeypatch.setattr(type(station.datasheets), "reading", lambda *_: changes[change])
    if change == "no key held":
        monkeypatch.setattr(type(station.keys), "held", lambda *_: [])
    if change == "no datasheet":
        monkeypatch.setattr(type(station.datasheets), "datasheet", lambda *_: None)
    proved: list[bytes] = []

    def prove(_node: Conversation, point: bytes) -> None:
        proved.append(point)
        if change == "it cannot prove it":
            raise NotAuthenticError("It cannot.")

    monkeypatch.setattr(step, "prove", prove)
    with talk(board) as node:
        if change == "factory state":
            node.identity = replace(node.identity, state=NodeState.FACTORY)
        who = step._recalled(station, node)
    assert (who is not None and who.recalled and who.point == board.key.point) is recalled
    assert proved == ([board.key.point] if recalled or change == "it cannot prove it" else [])
