"""Key agreement between a station and a node, and every row of the loss table that concerns it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import (
    BadDataError,
    KeyMismatchError,
    NodeRefusedError,
    NodeSilentError,
    NotAuthenticError,
    NotWhitelistedError,
    PolicyError,
)
from teds_provision.protocol.messages.frames import Command, Reason, Reply, refusal
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.wire_agreement import TranscriptMismatchError, key_id
from teds_provision.provisioning import agree as agree_module
from teds_provision.provisioning.agree import (
    AgreeResult,
    _agree_anew,
    _pin_for,
    agree,
    open_session,
    require_session,
    session_if_keyed,
    unknown_key,
)
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.provisioning.identify import identify
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry
from teds_provision.teds.codec import security
from tests.bench import Board, MemoryLink, make_station, talk

from .test_provision import run as provision


def run(station: Station, board: Board, link: MemoryLink | None = None, *, rotate: bool = False) -> AgreeResult:
    with talk(board, link) as node:
        return agree(station, node, identify(station, node), rotate=rotate)


def whitelist(station: Station, board: Board) -> None:
    station.pins.put(WhitelistEntry(board.uuid))


def held(station: Station, board: Board) -> list[tuple[str, int]]:
    return [(record.state, record.epoch) for record in station.keys.keys_of(board.uuid)]


def test_a_whitelisted_node_gets_a_key_and_its_entry_is_pinned(station: Station, board: Board) -> None:
    whitelist(station, board)
    agreed = run(station, board)
    assert (agreed.epoch, agreed.fresh) == (1, True)
    assert board.state.state == NodeState.KEYED
    assert board.state.key is not None
    assert key_id(board.state.key).hex() == agreed.key_id
    assert board.state.ca == station.ca
    entry = station.pins.entry(board.uuid)
    assert entry is not None
    assert (entry.assurance, entry.fingerprint) == ("tap", identify(station, talk(board)).fingerprint)
    assert held(station, board) == [("active", 1)]


def test_a_second_agreement_has_nothing_to_do(station: Station, board: Board) -> None:
    whitelist(station, board)
    first = run(station, board)
    again = run(station, board)
    assert (again.key_id, again.fresh) == (first.key_id, False)


def test_rotation_gives_a_new_key_over_any_link(station: Station, board: Board) -> None:
    whitelist(station, board)
    first = run(station, board)
    rotated = run(station, board, MemoryLink(board, via="can", tapped=False), rotate=True)
    assert (rotated.epoch, rotated.fresh) == (2, True)
    assert rotated.key_id != first.key_id
    assert held(station, board) == [("active", 2)]


def test_over_a_bus_a_node_that_has_a_key_is_never_pinned(station: Station, board: Board) -> None:
    """Its entry knows the UUID alone, which anyone on a bus can show."""
    whitelist(station, board)
    run(station, board)
    whitelist(station, board)
    with pytest.raises(PolicyError, match="can only be pinned by tap"):
        run(station, board, MemoryLink(board, via="can", tapped=False), rotate=True)
    entry = station.pins.entry(board.uuid)
    assert entry is not None
    assert entry.fingerprint is None
    assert run(station, board, rotate=True).epoch == 2


def test_a_board_that_replaces_another_begins_at_its_own_epoch(station: Station, board: Board) -> None:
    """The operator let the old pin go: epoch 2 was the old board's, the new one offers 1."""
    whitelist(station, board)
    run(station, board)
    run(station, board, rotate=True)
    station.pins.unpin(board.uuid)
    station.pins.remove(board.uuid)
    new = Board()
    whitelist(station, new)
    assert run(station, new).epoch == 1
    assert held(station, new) == [("active", 1)]


def test_an_unknown_node_is_refused_before_any_key(station: Station, board: Board) -> None:
    with pytest.raises(NotWhitelistedError):
        run(station, board)
    assert board.state.epoch == 0


def test_a_known_uuid_with_another_key_is_refused(station: Station, board: Board) -> None:
    whitelist(station, board)
    run(station, board)
    with pytest.raises(KeyMismatchError):
        run(station, Board())


def test_a_station_of_another_owner_cannot_rekey_a_node(station: Station, board: Board, tmp_path) -> None:  # type: ignore[no-untyped-def]
    whitelist(station, board)
    first = run(station, board)
    stranger = make_station(tmp_path / "stranger")
    whitelist(stranger, board)
    with pytest.raises(NodeRefusedError) as refused:
        run(stranger, board, rotate=True)
    assert refused.value.reason == Reason.UNTRUSTED_STATION
    assert board.state.key is not None
    assert key_id(board.state.key).hex() == first.key_id


def test_over_the_bus_a_node_with_nfc_refuses_its_first_key(station: Station, board: Board) -> None:
    whitelist(station, board)
    with pytest.raises(NodeRefusedError) as refused:
        run(station, board, MemoryLink(board, via="can", tapped=False))
    assert refused.value.reason == Reason.NOT_PERMITTED


# -- the reply to Request ----------------------------------------------------------------------------------------------

REPLY_OCTETS = 3 + 165
TAG, PROOF = 3 + 16 + 4 + 65, 3 + 16 + 4 + 65 + 16


def flipped(octet: int, times: int = 99) -> Callable[[int, bytes], bytes]:
    """Disturbs one octet of the first so many replies to Request."""
    left = [times]

    def flip(_count: int, reply: bytes) -> bytes:
        if len(reply) != REPLY_OCTETS or not left[0]:
            return reply
        left[0] -= 1
        return reply[:octet] + bytes([reply[octet] ^ 1]) + reply[octet + 1 :]

    return flip


def requests(link: MemoryLink) -> list[bytes]:
    return [frame for frame in link.frames if frame[2:4] == b"\x80\x01"]


def security_reads(link: MemoryLink) -> int:
    return sum(frame[:4] == b"\0\0\1\2" and frame[6:7] == b"\x80" for frame in link.frames)


def test_after_a_wrong_node_tag_the_teds_is_read_again_and_a_new_request_is_made_once(
    station: Station, board: Board
) -> None:
    whitelist(station, board)
    link = MemoryLink(board, tamper=flipped(TAG, times=1))
    assert run(station, board, link).epoch == 1
    first, second = requests(link)
    assert first[-65:] != second[-65:], "E is for one Request"
    assert security_reads(link) == 2


def test_a_second_wrong_node_tag_ends_it_and_is_no_key(station: Station, board: Board) -> None:
    whitelist(station, board)
    link = MemoryLink(board, tamper=flipped(TAG))
    with pytest.raises(NotAuthenticError, match="tagN"):
        run(station, board, link)
    assert (len(requests(link)), held(station, board)) == (2, [])


def test_a_wrong_proof_of_the_agreement_is_not_asked_for_again(station: Station, board: Board) -> None:
    whitelist(station, board)
    link = MemoryLink(board, tamper=flipped(PROOF))
    with pytest.raises(NotAuthenticError, match="does not hold the key that it shows"):
        run(station, board, link)
    assert (len(requests(link)), held(station, board)) == (1, [])
    entry = station.pins.entry(board.uuid)
    assert entry is not None


def test_a_datasheet_that_changed_between_reading_and_request_is_read_again(station: Station, board: Board) -> None:
    whitelist(station, board)

    def another_station_was_here(count: int, reply: bytes) -> bytes:
        if count == 2:  # the proof of identify; the TEDS has been read
            board.flash.state = board.tim._flash = replace(board.state, sequence=7)
        return reply

    link = MemoryLink(board, tamper=another_station_was_here)
    assert run(station, board, link).epoch == 1
    assert (len(requests(link)), security_reads(link)) == (2, 2)


def test_a_node_that_shows_another_key_after_a_wrong_tag_gets_no_second_request(station: Station, board: Board) -> None:
    whitelist(station, board)
    other = Board()

    def two_boards(_count: int, reply: bytes) -> bytes:
        if len(reply) == REPLY_OCTETS:
            board.flash.state = board.tim._flash = other.state
            return flipped(TAG)(0, reply)
        return reply

    link = MemoryLink(board, tamper=two_boards)
    with pytest.raises(KeyMismatchError):  # identify has pinned the first one
        run(station, board, link)
    assert (len(requests(link)), held(station, board)) == (1, [])


def test_a_node_that_reports_another_epoch_than_it_agreed_on_is_not_agreed_with(station: Station, board: Board) -> None:
    """A datasheet for the one would never fit the other; the key stays pending, because the node has it."""
    whitelist(station, board)

    def counts_twice(_count: int, reply: bytes) -> bytes:
        if board.state.epoch == 1:
            board.flash.state = board.tim._flash = replace(board.state, epoch=2)
        return reply

    with pytest.raises(NotAuthenticError, match="offered key epoch 1 but reports 2 in its session"):
        run(station, board, MemoryLink(board, tamper=counts_twice))
    assert held(station, board) == [("pending", 1)]


@pytest.mark.parametrize(
    ("field", "name"), [(105, "ProfileVersion 2"), (109, "SessionSuite 1"), (110, "KeyAgreement 1")]
)
def test_a_node_of_another_wire_is_named_and_gets_no_request(
    station: Station, board: Board, field: int, name: str
) -> None:
    whitelist(station, board)
    shown = security.decode(board.state.security_teds())
    value = int(name[-1])
    teds = replace(shown, values={**shown.values, field: value}).encode()
    whole = Reply(True, bytes(4) + teds).encode()

    def older(_count: int, reply: bytes) -> bytes:
        return whole if len(reply) == len(whole) else reply

    link = MemoryLink(board, tamper=older)
    with pytest.raises(BadDataError, match=name):
        run(station, board, link)
    assert (requests(link), held(station, board)) == ([], [])


def test_a_rotation_in_a_session_hashes_the_datasheet_that_was_read_in_it(station: Station, board: Board) -> None:
    """What came plain before says nothing: whoever sits on the bus may have bent it."""
    whitelist(station, board)
    run(station, board)
    shown = security.decode(board.state.security_teds())
    whole = Reply(True, bytes(4) + shown.encode()).encode()
    bent = Reply(True, bytes(4) + replace(shown, sequence=9).encode()).encode()

    def on_the_bus(_count: int, reply: bytes) -> bytes:
        return bent if reply == whole else reply

    link = MemoryLink(board, via="can", tapped=False, tamper=on_the_bus)
    assert run(station, board, link, rotate=True).epoch == 2


# -- lost messages -----------------------------------------------------------------------------------------------------

EXCHANGES = 6  # Read 128, Prove, Request, Confirm, Open, Identify (sealed)


@pytest.mark.parametrize("lost", range(1, EXCHANGES + 1))
@pytest.mark.parametrize("half", ["lose_request", "lose_reply"])
def test_whatever_message_is_lost_the_same_command_carries_on(
    station: Station, board: Board, half: str, lost: int
) -> None:
    whitelist(station, board)
    with pytest.raises(NodeSilentError):
        run(station, board, MemoryLink(board, **{half: lost}))  # type: ignore[arg-type]
    agreed = run(station, board)
    assert board.state.key is not None
    assert key_id(board.state.key).hex() == agreed.key_id
    assert [state for state, _ in held(station, board)] == ["active"]


@pytest.mark.parametrize("lost", range(1, EXCHANGES + 5))  # c, Open and Read 128 in the session too
@pytest.mark.parametrize("half", ["lose_request", "lose_reply"])
def test_a_cut_rotation_leaves_a_working_key(
    station: Station, board: Board, half: str, lost: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    whitelist(station, board)
    run(station, board)
    with pytest.raises(NodeSilentError):
        run(station, board, MemoryLink(board, **{half: lost}), rotate=True)  # type: ignore[arg-type]
    run(station, board)
    later(monkeypatch)
    run(station, board)
    assert [state for state, _ in held(station, board)] == ["active"]


def later(monkeypatch: pytest.MonkeyPatch) -> None:
    """So much later that no Confirm can arrive any more."""
    monkeypatch.setattr("teds_provision.station.node_keys.CONFIRM_MAY_ARRIVE", timedelta(seconds=-5))


def test_a_confirm_that_is_held_back_finds_its_key_at_the_station(station: Station, board: Board) -> None:
    """Model, HELD_BACK: the station opened a session under the old key meanwhile; the new one must not be gone."""
    whitelist(station, board)
    run(station, board)
    with talk(board) as node:
        who, real = identify(station, node), node.request

        def hold_back(command: Command, why: str) -> bytes:
            if why == "the key confirmation":
                raise KeyboardInterrupt  # the Confirm is on its way, and this station ends here
            return real(command, why)

        node.request = hold_back  # type: ignore[method-assign]
        with pytest.raises(KeyboardInterrupt):
            agree(station, node, who, rotate=True)
    assert [state for state, _ in held(station, board)] == ["pending", "active"]
    run(station, board)  # a session under the old key, before that Confirm arrives
    assert [state for state, _ in held(station, board)] == ["pending", "active"]


@pytest.mark.parametrize("when", ["die_before", "die_after"])
def test_a_node_that_dies_inside_confirm_heals(
    station: Station, board: Board, when: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    whitelist(station, board)
    run(station, board)
    setattr(board.flash, when, True)
    with pytest.raises(NodeSilentError):
        run(station, board, rotate=True)
    assert len(held(station, board)) == 2
    run(station, board)
    later(monkeypatch)
    run(station, board)
    assert held(station, board) == [("active", 2 if when == "die_after" else 1)]


def test_a_forged_refusal_of_open_deletes_nothing(station: Station, board: Board) -> None:
    whitelist(station, board)
    run(station, board)
    board.flash.die_after = True
    with pytest.raises(NodeSilentError):
        run(station, board, rotate=True)
    forged = refusal(Reason.UNKNOWN_KEY).encode()
    with pytest.raises(PolicyError):
        run(station, board, MemoryLink(board, tamper=lambda n, reply: forged if n > 2 else reply))
    assert len(held(station, board)) == 2
    assert run(station, board).epoch == 2


def test_a_second_agreement_whose_confirm_is_lost_keeps_every_pending_key(station: Station, board: Board) -> None:
    whitelist(station, board)
    board.flash.die_after = True
    with pytest.raises(NodeSilentError):
        run(station, board)  # K1 is on the node, pending here
    with pytest.raises(NodeSilentError):
        run(station, board, MemoryLink(board, lose_request=5), rotate=True)
    assert run(station, board).epoch == 1
    assert held(station, board) == [("active", 1)]


def test_a_rotation_by_another_station_is_reported_and_never_healed_by_itself(station: Station, board: Board) -> None:
    whitelist(station, board)
    run(station, board)
    board.flash.state = board.flash.state.__class__(**{**vars(board.flash.state), "key": bytes(16)})
    board.power_on()
    with pytest.raises(PolicyError, match="knows none of the keys"):
        run(station, board)
    assert held(station, board) == [("active", 1)]
    assert run(station, board, rotate=True).epoch == 2


def test_a_copy_with_the_uuid_of_a_known_node_is_named_as_such(station: Station, board: Board) -> None:
    """Another board under the same UUID knows no key of ours: it is no reason to rotate the key."""
    whitelist(station, board)
    run(station, board)
    copy = Board(uuid=board.uuid)
    with talk(copy) as node, pytest.raises(KeyMismatchError, match="is known with key"):
        require_session(station, node)


def test_a_lost_store_is_healed_by_a_tap_if_identity_and_ca_were_kept(station: Station, board: Board) -> None:
    whitelist(station, board)
    run(station, board)
    station.keys.remove(board.uuid)
    with pytest.raises(PolicyError, match="has a key that this station does not hold"):
        run(station, board)  # the owner of the key is unknown: a person states that it has no other
    assert run(station, board, rotate=True).epoch == 2


def test_a_pending_key_made_before_a_rotation_became_due_does_not_end_it(station: Station, board: Board) -> None:
    whitelist(station, board)
    run(station, board)
    board.flash.die_after = True
    with pytest.raises(NodeSilentError):
        run(station, board, rotate=True)
    assert [state for state, _ in held(station, board)] == ["pending", "active"]
    station.keys.demand_rotation(board.uuid, "others may have it")
    with talk(board) as node:
        opened = open_session(station, node)
    assert opened is not None
    assert held(station, board) == [("active", 2)]
    assert station.keys.rotation_due(board.uuid) is not None


def test_a_forged_factory_state_takes_no_node_over(station: Station, board: Board) -> None:
    """Identify is a hint; the datasheet that the node's signature covers shows that somebody holds it."""
    provision(station, board)
    station.flush()
    station.keys.remove(board.uuid)
    before = board.state

    def as_new(_count: int, reply: bytes) -> bytes:
        is_identify = len(reply) == 26 and reply[4:14] == board.uuid
        return reply[:14] + b"\0" + reply[15:] if is_identify else reply

    with pytest.raises(PolicyError, match="would lock out the current holder"):
        run(station, board, MemoryLink(board, tamper=as_new))
    assert board.state == before
    assert held(station, board) == [], "no key is kept"


class KeyedMeanwhile(MemoryLink):
    """A link on which another station keys the board, which was new, just before the Request reaches it."""

    def exchange(self, frame: bytes) -> bytes:
        if frame[2:4] == b"\x80\x01" and self.board.state.state == NodeState.FACTORY:
            self.board.flash.state = self.becomes
            self.board.power_on()
        return super().exchange(frame)


def test_a_node_that_was_keyed_since_it_was_found_new_is_not_taken_over(station: Station, board: Board) -> None:
    provision(station, board)
    station.flush()
    link = KeyedMeanwhile(board)
    link.becomes = board.state  # type: ignore[attr-defined]
    board.tim.reset_by_hand()
    station.keys.remove(board.uuid)
    with pytest.raises(PolicyError, match="would lock out the current holder"):
        run(station, board, link)
    assert [frame[3] for frame in link.frames if frame[2] == 0x80].count(1) == 2, "one Request more, for its new TEDS"
    assert board.state == link.becomes  # type: ignore[attr-defined]
    assert held(station, board) == []


def test_the_first_open_under_a_new_key_knows_both_static_keys(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The node's one-time key is due to be neither of them."""
    opened: list[tuple[bytes, ...]] = []
    real = Conversation.open

    def noting(self: Conversation, key: bytes, *, statics: tuple[bytes, ...] = ()) -> None:
        opened.append(statics)
        real(self, key, statics=statics)

    monkeypatch.setattr(Conversation, "open", noting)
    whitelist(station, board)
    run(station, board)
    run(station, board)
    assert opened == [(station.point, board.key.point)] * 2


DIGITS = "ab" * 32


@pytest.mark.parametrize(
    ("pinned", "tapped", "wired", "state", "assurance"),
    [
        (DIGITS, False, False, NodeState.KEYED, "import"),
        (DIGITS, True, True, NodeState.FACTORY, "import"),
        (None, True, False, NodeState.KEYED, "tap"),
        (None, True, True, NodeState.FACTORY, "tap"),
        (None, False, True, NodeState.FACTORY, "bus"),
        (None, False, True, NodeState.KEYED, None),
        (None, False, False, NodeState.FACTORY, None),
    ],
)
def test_a_key_is_pinned_by_a_tap_or_over_the_bus_of_a_new_node_and_never_anew(
    pinned: str | None, tapped: bool, wired: bool, state: NodeState, assurance: str | None
) -> None:
    uuid, fingerprint = bytes(range(10)), "cd" * 32
    entry = WhitelistEntry(uuid, fingerprint=pinned, assurance="import" if pinned else "uuid")
    node: Any = SimpleNamespace(uuid=uuid, tapped=tapped, wired=wired)
    who: Any = SimpleNamespace(state=state, fingerprint=fingerprint)
    if assurance is None:
        with pytest.raises(
            PolicyError, match=f"{uuid.hex()} is whitelisted by UUID only; its key can only be"
        ) as refused:
            _pin_for(entry, node, who)
        assert refused.value.hint.startswith("Tap it once (--via nfc), or add the fingerprint: whitelist add UUID")
        return
    found = _pin_for(entry, node, who)
    assert (found.fingerprint, found.assurance) == (pinned or fingerprint, assurance)


@pytest.mark.parametrize("same", [True, False])
def test_a_node_that_shows_two_keys_in_one_agreement_gets_none(
    station: Station, monkeypatch: pytest.MonkeyPatch, same: bool
) -> None:
    """A Security TEDS that changed on the way is read once more; with another key two boards answer, or a copy."""
    asked: list[tuple[bytes, bytes]] = []

    def request(_station: Any, _node: Any, _entry: Any, ca: bytes, teds: bytes) -> Any:
        asked.append((ca, teds))
        if len(asked) == 1:
            raise TranscriptMismatchError("It changed.")
        raise PolicyError("Asked again.")

    keys = {b"before": b"one key", b"again": b"one key" if same else b"another key"}
    monkeypatch.setattr(agree_module, "_request", request)
    monkeypatch.setattr(agree_module, "read_block", lambda _node, _block: b"again")
    monkeypatch.setattr(agree_module, "fit_to_agree", lambda teds, *_: SimpleNamespace(node_key=keys[teds]))
    node: Any = SimpleNamespace(uuid=bytes(10))
    with pytest.raises(PolicyError if same else NotAuthenticError) as refused:
        _agree_anew(station, node, WhitelistEntry(bytes(10), fingerprint=DIGITS), b"ca", b"before")
    assert asked == [(b"ca", b"before"), (b"ca", b"again")][: 2 if same else 1]
    if not same:
        assert refused.value.message == "The node presented two different keys."
        assert refused.value.hint.startswith("Either two boards are answering, or the tag is a copy.")


def test_a_session_that_is_lost_while_a_key_is_agreed_on_ends_with_its_cause(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    cause = NodeSilentError("It is silent.")

    def lose(*_: Any, **__: Any) -> Any:
        raise SessionLostError(cause)

    whitelist(station, board)
    with monkeypatch.context() as patch:
        patch.setattr(agree_module, "_agree_anew", lose)
        with pytest.raises(NodeSilentError) as lost:
            run(station, board)
    assert lost.value is cause
    run(station, board)
    monkeypatch.setattr(type(station.keys), "rotates_now", lambda *_: True)
    monkeypatch.setattr(agree_module, "_agree_anew", lose)
    with talk(board) as node, pytest.raises(NodeSilentError) as lost:
        session_if_keyed(station, node)
    assert lost.value is cause


@pytest.mark.parametrize(
    ("another", "elsewhere", "foreign", "message", "hint"),
    [
        (True, "", False, "It shows another key.", "x"),
        (False, "", False, ". That answer is unsigned and proves nothing.", "Try it on the reader. If it was reset"),
        (False, "it is at 3", False, "; it is at 3.", "Use it at that station, or have the key handed over."),
        (False, "it is at 3", True, "; it is at 3.", None),
        (False, "", True, ". That answer is unsigned and proves nothing.", "Try it on the reader. If it was reset"),
    ],
)
def test_a_node_that_knows_none_of_our_keys_is_explained_by_what_else_it_shows(
    station: Station,
    monkeypatch: pytest.MonkeyPatch,
    another: bool,
    elsewhere: str,
    foreign: bool,
    message: str,
    hint: str | None,
) -> None:
    node: Any = SimpleNamespace(uuid=bytes(10))
    shown = PolicyError("It shows another key.", hint="x") if another else None
    monkeypatch.setattr(agree_module, "_shows_another_key", lambda *_: shown)
    monkeypatch.setattr(agree_module, "agreed_elsewhere", lambda *_: elsewhere)
    monkeypatch.setattr(agree_module, "_signed_for_another_ca", lambda *_: foreign)
    monkeypatch.setattr(agree_module, "_shown_security", lambda _node: b"")
    error = unknown_key(station, node)
    assert error.message.endswith(message)
    assert another or error.message.startswith(f"No session with node {bytes(10).hex()}: it answers that it knows none")
    assert error.hint == agree_module.OTHER_OWNER_REMEDY if hint is None else error.hint.startswith(hint)
