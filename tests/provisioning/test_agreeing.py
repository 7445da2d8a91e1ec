"""``agree``: how often it begins, whom it asks, and what it says of a node with another station's key."""

from __future__ import annotations

from contextlib import closing, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import (
    BadDataError,
    GarbledError,
    NodeRefusedError,
    NodeSilentError,
    NotAuthenticError,
    NotWhitelistedError,
    PolicyError,
    TedsProvisionError,
)
from teds_provision.links import LinkSettings
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning import agree as agreeing
from teds_provision.provisioning.agree import (
    AgreeResult,
    agree,
    agree_at,
    agreed_elsewhere,
    must_take_over,
    proof_of_reset,
    require_own_ca,
    reset_node,
)
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeyRecord, RevocationRecord, TrustRecord, WhitelistEntry
from tests.bench import Board, make_station, talk

from .test_provision import run as provisioned

DONE = AgreeResult(3, "ab" * 8, fresh=True)


@pytest.mark.parametrize(("losses", "alive", "begun"), [(4, True, 5), (5, True, 5), (1, False, 1)])
def test_an_agreement_that_is_lost_begins_five_times_at_a_node_that_answers(
    station: Station, monkeypatch: pytest.MonkeyPatch, losses: int, alive: bool, begun: int
) -> None:
    seen: list[tuple[bool, object]] = []
    forgotten: list[int] = []
    node: Any = SimpleNamespace(is_alive=lambda: alive, forget=lambda: forgotten.append(len(seen)))

    def begin(*_args: object, again: bool, word: object, **_more: object) -> AgreeResult:
        seen.append((again, word))
        if len(seen) <= losses:
            raise NodeSilentError("silent") if len(seen) % 2 else GarbledError("garbled")
        return DONE

    monkeypatch.setattr(agreeing, "_agree", begin)
    who: Any = None
    if losses < begun:
        assert agree(station, node, who) is DONE
    else:
        with pytest.raises((NodeSilentError, GarbledError)):
            agree(station, node, who)
    assert [again for again, _word in seen] == [False] + [True] * (begun - 1)
    assert len({id(word) for _again, word in seen}) == 1, "a person's word counts for all of them"
    assert forgotten == list(range(1, begun))


def test_a_take_over_is_asked_for_once(station: Station, board: Board) -> None:
    asked: list[tuple[str, PolicyError]] = []
    consent = agreeing._TakeoverConsent(rotate=False, take_over=lambda text, error: asked.append((text, error)))
    with talk(board) as node:
        consent.require(station, node)
        consent.require(station, node)
        with pytest.raises(PolicyError, match="would lock out the current holder"):
            agreeing._TakeoverConsent(rotate=False, take_over=None).require(station, node)
        agreeing._TakeoverConsent(rotate=True, take_over=None).require(station, node)
    ((text, error),) = asked
    uuid = board.uuid.hex()
    assert text == (
        f"Node {uuid} has a key that this station does not hold. Take the node over and lock out the current holder?"
    )
    begin = "Have the key handed over (export-keys there), or take the node over at a tap: "
    assert error.hint == f"{begin}identify --add, then agree {uuid} --rotate --yes"
    station.pins.put(WhitelistEntry(board.uuid))
    assert must_take_over(station, board.uuid).hint == f"{begin}agree {uuid} --rotate --yes"


def keyed(station: Station, board: Board) -> None:
    station.pins.put(WhitelistEntry(board.uuid))
    with talk(board) as node:
        agree(station, node, identify(station, node))


@pytest.mark.parametrize("again", [False, True])
def test_a_key_that_opens_after_a_lost_reply_is_the_one_that_this_run_agreed_on(
    station: Station, board: Board, again: bool
) -> None:
    keyed(station, board)
    word = agreeing._TakeoverConsent(rotate=False, take_over=None)
    with talk(board) as node:
        who = identify(station, node)
        found = agreeing._agree(station, node, who, rotate=again, newcomer=None, word=word, again=again)
    assert (found.epoch, found.fresh, found.listed) == (1, again, False), "not rotated once more"


def test_what_a_plan_says(station: Station, board: Board) -> None:
    node = board.uuid.hex()

    def plan(*, rotate: bool) -> tuple[str, tuple[str, ...]]:
        report = agree_at(station, LinkSettings(), node, SilentReporter(), rotate=rotate, dry_run=True)
        assert (report.uuid, report.agreed) == (board.uuid, None)
        return report.plan, report.held

    for rotate in (False, True):
        with pytest.raises(NotWhitelistedError):
            plan(rotate=rotate)
    station.pins.put(WhitelistEntry(board.uuid))
    assert plan(rotate=True) == ("agree on a first key", ())
    with talk(board) as talking:
        agree(station, talking, identify(station, talking))
    assert plan(rotate=False) == ("keep", ("active key of epoch 1",))
    assert plan(rotate=True) == ("rotate", ("active key of epoch 1",))


def test_a_key_from_a_backup_is_asked_about_where_no_tap_proves_it(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    keyed(station, board)
    monkeypatch.setattr(type(station.keys), "restored", lambda _keys, _uuid: True)
    monkeypatch.setattr(type(station.keys), "rotation_due", lambda _keys, _uuid: "of a backup")
    reached: list[tuple[str, bool, Any]] = []

    def at_node(_station: object, links: LinkSettings, _uuid: bytes, _reporter: object, **more: Any) -> Any:
        reached.append((links.via, links.via_chosen, more))
        raise NodeSilentError("nobody")

    monkeypatch.setattr(agreeing, "at_node", at_node)
    questions: list[str] = []
    for via, rotate in (("nfc", True), ("can", False), ("can", True)):
        with pytest.raises(NodeSilentError):
            agree_at(
                station,
                LinkSettings(via, can="a:1"),
                board.uuid.hex(),
                SilentReporter(),
                rotate=rotate,
                confirm=questions.append,
            )
    assert questions == [f"Node {board.uuid.hex()} is of a backup. Is it still this station's?"]
    assert reached == [(via, True, {"unlock": "always", "writes": "agree"}) for via in ("nfc", "can", "can")]


def test_a_node_of_the_epoch_held_here_was_not_keyed_elsewhere(station: Station, board: Board) -> None:
    provisioned(station, board)  # a datasheet signed here tells nothing of another station
    with talk(board) as node:
        node.identity = replace(node.identity, epoch=1)
        assert agreed_elsewhere(station, node) == ""
        node.identity = replace(node.identity, epoch=2)
        assert agreed_elsewhere(station, node) == (
            "it reports key epoch 2, after 1 here: keyed elsewhere by tap or rotated by another holder (unverified);"
            " which station did so will show once it signs the datasheet"
        )


def test_a_datasheet_of_another_owner_refuses_unless_a_key_of_the_node_is_held(
    station: Station, board: Board, tmp_path: Path
) -> None:
    provisioned(station, board)
    image = station.datasheets.datasheet(board.uuid)
    assert image is not None
    assert image.security is not None
    station.keys.remove(board.uuid)
    require_own_ca(station, board.uuid, NodeState.PROVISIONED, image.security)
    with closing(make_station(tmp_path / "other", "other")) as other:
        for state, teds in ((NodeState.FACTORY, image.security), (NodeState.PROVISIONED, b"")):
            require_own_ca(other, board.uuid, state, teds)
        for state in (NodeState.KEYED, NodeState.PROVISIONED):
            with pytest.raises(PolicyError) as refused:
                require_own_ca(other, board.uuid, state, image.security)
        assert refused.value.message == (
            f"Node {board.uuid.hex()} belongs to another owner's CA: station {fingerprint(station.point)[:16]} signed"
            " its datasheet."
        )
        with other.transaction():
            other.keys.add_pending(board.uuid, key=bytes(16), key_id=bytes(8), epoch=1)
        require_own_ca(other, board.uuid, NodeState.PROVISIONED, image.security)


def test_a_whitelist_entry_is_made_once_and_a_bare_one_replaces_none(station: Station, board: Board) -> None:
    def added() -> list[dict[str, Any]]:
        return [entry.detail for entry in station.audit_log.entries() if entry.act == "whitelist"]

    def enlist(entry: WhitelistEntry) -> None:
        with station.transaction():
            agreeing._enlist(station, entry)

    bare = WhitelistEntry(board.uuid)
    whole = replace(bare, fingerprint="ab" * 32, assurance="tap")
    enlist(bare)
    enlist(whole)
    enlist(bare)
    entry = station.pins.entry(board.uuid)
    assert entry is not None
    assert entry.fingerprint == "ab" * 32
    assert [(facts["fingerprint"], facts["assurance"]) for facts in added()] == [(None, bare.assurance)]


def test_a_reset_whose_reply_was_lost_is_proven_afterwards(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    keyed(station, board)
    with talk(board) as node:
        who = identify(station, node)
        whole = node.request

        def lose(command: Any, why: str) -> bytes:
            reply = whole(command, why)
            if why == "the reset":
                raise SessionLostError(NodeSilentError("lost"))
            return reply

        monkeypatch.setattr(node, "request", lose)
        receipt = reset_node(station, node, who)
    assert not station.keys.held(board.uuid)
    (line,) = [entry for entry in station.audit_log.entries() if entry.act == "reset"]
    facts = {"epoch": receipt.epoch, "challenge": receipt.challenge.hex(), "proof": receipt.proof.hex()}
    assert (line.outcome, line.detail) == ("done", facts)
    with talk(board) as node:
        assert proof_of_reset(node, who.point).proof != receipt.proof, "another challenge"


@pytest.mark.parametrize(
    "error",
    [BadDataError("It is damaged."), NodeRefusedError("No.", reason=3), NodeSilentError("It is silent.")],
    ids=lambda error: type(error).__name__,
)
def test_a_node_that_shows_no_datasheet_outside_a_session_gives_no_more_than_a_hint(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch, error: TedsProvisionError
) -> None:
    def fail(*_: object) -> bytes:
        raise error

    monkeypatch.setattr(agreeing, "read_block", fail)
    with talk(board) as node:
        assert agreeing._shown_security(node) == b""
        assert agreeing._shows_another_key(station, node) is None
        node.identity = replace(node.identity, epoch=2)
        assert agreed_elsewhere(station, node) == (
            "it reports key epoch 2, after 0 here: keyed elsewhere by tap or rotated by another holder (unverified)"
        )


@pytest.mark.parametrize(
    ("signed", "trusted", "certified", "words"),
    [
        (True, True, False, "its datasheet is signed by north ({})"),
        (True, False, True, "its datasheet is signed by station {}, which your CA certified"),
        (True, False, False, "which station did so will show once it signs the datasheet"),
        (False, True, True, "which station did so will show once it signs the datasheet"),
    ],
)
def test_only_a_datasheet_that_is_trusted_names_the_station_that_keyed_a_node(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch, signed: bool, trusted: bool, certified: bool,
    words: str,
) -> None:  # fmt: skip
    other = SoftwareKey(201).point
    shown = SimpleNamespace(station_key=other, node_key=None)
    monkeypatch.setattr(agreeing, "security", SimpleNamespace(decode=lambda _octets: shown))
    monkeypatch.setattr(agreeing, "signature_good", lambda *_: signed)
    monkeypatch.setattr(agreeing, "station_signature_good", lambda _shown, ca: certified and ca == station.ca)
    if trusted:
        station.policy.trust(TrustRecord("north", "station", other, fingerprint(other)))
    station.pins.put(WhitelistEntry(board.uuid, "ab" * 32))
    with talk(board) as node:
        node.identity = replace(node.identity, epoch=2)
        assert agreed_elsewhere(station, node).endswith(f"(unverified); {words.format(fingerprint(other)[:16])}")
        assert agreeing._shows_another_key(station, node) is None, "it shows no key"


@pytest.mark.parametrize(
    ("error", "goes_on"),
    [
        (NodeRefusedError("It does not know the key.", reason=Reason.UNKNOWN_KEY), True),
        (NodeRefusedError("It has no key.", reason=Reason.WRONG_STATE), True),
        (NotAuthenticError("Its proof is wrong."), True),
        (NodeRefusedError("It is busy.", reason=Reason.BUSY), False),
        (NodeSilentError("It is silent."), False),
    ],
    ids=str,
)
def test_the_next_key_is_tried_if_the_node_does_not_know_the_first(
    station: Station, monkeypatch: pytest.MonkeyPatch, error: TedsProvisionError, goes_on: bool
) -> None:
    tried: list[object] = []

    def open_(key: object, *, statics: tuple[bytes, ...]) -> None:
        assert statics == (station.point,)
        tried.append(key)
        if key == "first":
            raise error

    held = [SimpleNamespace(key=name) for name in ("first", "second", "third")]
    node: Any = SimpleNamespace(uuid=bytes(10), tapped=True, open=open_)
    monkeypatch.setattr(type(station.keys), "unwrapped", lambda *_: held)
    monkeypatch.setattr(agreeing, "_take_up", lambda _station, _node, opened: opened)
    if goes_on:
        assert agreeing.open_session(station, node) is held[1]  # type: ignore[comparison-overlap]
    else:
        with pytest.raises(type(error)):
            agreeing.open_session(station, node)
    assert tried == ["first", "second"][: 1 + goes_on]


@pytest.mark.parametrize(
    ("entry", "due", "held", "anew"),
    [
        (WhitelistEntry(bytes(10), "ab" * 32), True, True, True),
        (WhitelistEntry(bytes(10), "ab" * 32), False, True, False),
        (WhitelistEntry(bytes(10), None), True, True, False),  # no key to hold it against: a rotation would take any
        (None, True, True, False),
        (WhitelistEntry(bytes(10), "ab" * 32), True, False, False),
    ],
)
def test_a_key_that_is_due_is_rotated_at_a_node_whose_identity_key_is_known(
    station: Station, monkeypatch: pytest.MonkeyPatch, entry: WhitelistEntry | None, due: bool, held: bool, anew: bool
) -> None:
    agreed: list[object] = []
    node: Any = SimpleNamespace(uuid=bytes(10))
    monkeypatch.setattr(agreeing, "open_session", lambda *_: "held" if held else None)
    monkeypatch.setattr(type(station.pins), "entry", lambda *_: entry)
    monkeypatch.setattr(type(station.keys), "rotates_now", lambda *_: due)
    monkeypatch.setattr(type(station.keys), "unwrapped", lambda *_: ["new", "old"])
    monkeypatch.setattr(agreeing, "read_block", lambda *_: b"teds")
    monkeypatch.setattr(agreeing, "_agree_anew", lambda *given: agreed.append(given[2:]))
    found = agreeing.session_if_keyed(station, node)
    assert found == ("new" if anew else "held" if held else None)  # type: ignore[comparison-overlap]
    assert agreed == ([(entry, station.ca, b"teds")] if anew else [])


@pytest.mark.parametrize(
    ("reason", "state", "demanded", "opens", "fresh"),
    [
        (Reason.NOT_PERMITTED, NodeState.FACTORY, False, True, True),
        (Reason.NOT_PERMITTED, NodeState.FACTORY, False, False, None),
        (Reason.NOT_PERMITTED, NodeState.FACTORY, True, True, None),
        (Reason.NOT_PERMITTED, NodeState.KEYED, False, True, None),
        (Reason.BUSY, NodeState.FACTORY, False, True, None),
    ],
)
def test_a_new_node_that_stored_the_key_of_a_run_that_was_cut_is_opened_with_it(
    station: Station, monkeypatch: pytest.MonkeyPatch, reason: Reason, state: NodeState, demanded: bool, opens: bool,
    fresh: bool | None,
) -> None:  # fmt: skip
    def refuse(*_: object, **__: object) -> Any:
        raise NodeRefusedError("It has a key.", reason=reason)

    held = SimpleNamespace(record=SimpleNamespace(epoch=3, key_id="ab" * 8)) if opens else None
    node: Any = SimpleNamespace(uuid=bytes(10), sealed=False)
    who: Any = SimpleNamespace(state=state, recalled=False, security_teds=b"teds")
    monkeypatch.setattr(agreeing, "_pin_for", lambda entry, *_: entry)
    monkeypatch.setattr(agreeing, "_agree_anew", refuse)
    monkeypatch.setattr(agreeing, "open_session", lambda *_: held)
    new_key = partial(agreeing._new_key, station, node, who, WhitelistEntry(bytes(10)), returning=False)
    if fresh is None:
        with pytest.raises(NodeRefusedError, match="It has a key"):
            new_key(demanded=demanded)
    else:
        assert new_key(demanded=demanded) == AgreeResult(3, "ab" * 8, fresh=fresh)


@pytest.mark.parametrize(
    ("change", "taken_up"),
    [({}, True), ({"state": "pending"}, False), ({"unsettled": True}, False), ({"outdated": ["old"]}, False),
     ({"epoch": 2}, False), ({"epoch": None}, False)],
)  # fmt: skip
def test_a_key_is_taken_up_if_nothing_of_before_is_left(
    station: Station, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], taken_up: bool
) -> None:
    how = {"state": "active", "unsettled": False, "outdated": [], "epoch": 3} | change
    if how["epoch"] is not None:
        station.nodes.remember(bytes(10), epoch=how["epoch"])
    monkeypatch.setattr(type(station.pins), "is_unsettled", lambda *_: how["unsettled"])
    monkeypatch.setattr(type(station.keys), "outdated", lambda *_: how["outdated"])
    record: Any = SimpleNamespace(uuid=bytes(10), state=how["state"], epoch=3)
    assert agreeing._is_taken_up(station, record) is taken_up


@pytest.mark.parametrize("source", ["import", "agreement"])
def test_epoch_and_sequence_of_a_bundle_are_replaced_by_those_of_the_session(
    station: Station, monkeypatch: pytest.MonkeyPatch, source: str
) -> None:
    uuid = bytes(9) + b"\1"
    record = KeyRecord(uuid, 3, "ab" * 8, "pending", 1, b"w", source, "2026-01-01T00:00:00Z")  # type: ignore[arg-type]
    station.keys.add(record)
    corrected = replace(record, epoch=5)
    activated: list[KeyRecord] = []
    node: Any = SimpleNamespace(uuid=uuid, contact=SimpleNamespace(bus=None))
    monkeypatch.setattr(agreeing, "without_source", lambda bus: bus)
    monkeypatch.setattr(type(station.nodes), "met_at", lambda *_: None)
    monkeypatch.setattr(agreeing, "read_identity", lambda _node: SimpleNamespace(epoch=5, sequence=9))
    monkeypatch.setattr(
        type(station.keys), "correct_epoch", lambda _keys, _record, epoch: replace(_record, epoch=epoch)
    )
    monkeypatch.setattr(agreeing, "_activate", lambda _station, used: activated.append(used))
    found = agreeing._take_up(station, node, agreeing.NodeKey(record, bytes(16)))
    known = station.nodes.get(uuid)
    assert known is not None
    log = [entry.detail for entry in station.audit_log.entries() if entry.outcome == "epoch corrected"]
    if source == "import":
        assert (found.record, activated, known.epoch, known.sequence) == (corrected, [corrected], 5, 9)
        assert log == [{"key_id": "ab" * 8, "said": 3, "epoch": 5}]
    else:
        assert (found.record, activated, known.epoch, known.sequence, log) == (record, [record], 3, 0, [])


@pytest.mark.parametrize("with_person", [False, True])
def test_a_node_of_another_owner_is_met_for_a_rotation_alone_and_a_revoked_one_never(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch, with_person: bool
) -> None:
    """Its CA may refuse the take-over, and then an entry of the whitelist would not help."""
    given: list[dict[str, Any]] = []
    questions: list[str] = []

    def agreed(_station: object, node: object, who: object, **how: Any) -> AgreeResult:
        assert (node, who) == ("node", "who")
        given.append(how)
        return DONE

    visit: Any = SimpleNamespace(node="node", who="who")
    monkeypatch.setattr(agreeing, "at_node", lambda *_, **__: nullcontext(visit))
    monkeypatch.setattr(agreeing, "agree", agreed)

    def at(*, rotate: bool) -> Any:
        confirm = questions.append if with_person else None
        return agree_at(station, LinkSettings(), board.uuid.hex(), SilentReporter(), rotate=rotate, confirm=confirm)

    with pytest.raises(NotWhitelistedError):
        at(rotate=False)
    assert given == []
    assert at(rotate=True).agreed is DONE
    (how,) = given
    take_over = how.pop("take_over")
    assert how == {"rotate": True}
    if with_person:
        take_over("Take it over?", PolicyError("Another owner's."))
    else:
        assert take_over is None
    assert questions == ["Take it over?"] * with_person
    station.policy.deny(RevocationRecord(board.uuid, None, "lost", "{}"))
    with pytest.raises(PolicyError, match="lost"):
        at(rotate=True)
    assert len(given) == 1
