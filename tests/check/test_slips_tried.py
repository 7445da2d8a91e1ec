"""Slips that are tried on the board, one request each; and the ends of a check at which nothing explains a fault."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
from cryptography.hazmat.primitives.ciphers.aead import AESCCM

from teds_provision.check import agreement_rules, measuring_rules, plain_rules, session_rules, write_rules
from teds_provision.check.agreement_rules import StrangerStation
from teds_provision.check.probe import NotApplicableError, Probe, RuleBrokenError
from teds_provision.check.run import _Run
from teds_provision.check.slips import Slip
from teds_provision.errors import BadDataError, GarbledError, LinkError, NotAuthenticError, PolicyError
from teds_provision.protocol.keys import GROUP_ORDER, SoftwareKey, verify
from teds_provision.protocol.messages.frames import Command, Reason, Reply, TedsStatus
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.protocol.operation.can_frames import DataAddress, cut
from teds_provision.teds.sheet import ChannelKind

from . import bends

UUID, KEY, OKM = bytes(range(10)), bytes(range(16)), bytes(range(48))
NODE = SoftwareKey.generate()


def _refusal(reason: int) -> Reply:
    return Reply(False, bytes([reason]))


def _name(slip: Slip | None) -> str | None:
    return slip.name if slip is not None else None


# -- Open and Sealed ---------------------------------------------------------------------------------------------------


def _key_id(label: bytes = b"TEDS1 key id\0") -> bytes:
    return bends.sha(label + KEY)[:8]


def _mac(counter: bytes, point: bytes, label: bytes = b"station open") -> bytes:
    return bends.mac(KEY, label + UUID + counter + point)[:16]


@pytest.mark.parametrize(
    ("reason", "key_id", "label", "slip"),
    [
        (16, _key_id(b"TEDS1 key id"), b"station open", "key-id-label-without-00"),
        (12, _key_id(), b"", "mac-without-label"),
        (12, _key_id(), b"station open", None),  # it takes a right Open now
        (16, None, b"station open", None),  # it takes any keyId
        (12, _key_id(), None, None),  # it takes any mac
        (12, _key_id(), b"any but the right one", None),
        (16, _key_id(), b"any but the right one", None),
        (12, b"", b"", None),  # it takes nothing
        (17, _key_id(), b"", None),  # another refusal: nothing is tried
    ],
)
def test_a_refused_open_is_explained_by_what_the_node_takes(
    reason: int, key_id: bytes | None, label: bytes | None, slip: str | None
) -> None:
    """profile.md, "Sessions": 16 is an unknown keyId, 12 a wrong mac; c is fetched anew for each try."""
    counters: list[bytes] = []

    def counter() -> bytes:
        counters.append(len(counters).to_bytes(8, "big"))
        return counters[-1]

    def plain(command: Command) -> Reply:
        known, point, mac = command.payload[:8], command.payload[8:73], command.payload[73:]
        if label == b"any but the right one":
            return _refusal(12) if (known, mac) == (key_id, _mac(counters[-1], point)) else Reply(True, b"")
        good = (key_id is None or known == key_id) and (label is None or mac == _mac(counters[-1], point, label))
        return Reply(True, b"") if good else _refusal(16)

    rig: Any = SimpleNamespace(link_key=KEY, uuid=UUID, okm=OKM, plain=plain, opening_counter=counter)
    assert _name(Probe._slip_of_open(rig, _refusal(reason), SoftwareKey.generate())) == slip
    assert (counters == []) == (reason == 17)


@pytest.mark.parametrize(
    ("takes", "slip"),
    [
        ("little", "nonce-counter-little-endian"),
        ("right", None),
        ("anything", None),
        ("nothing", None),
        ("wrong", None),
    ],
)
def test_a_sealed_frame_with_a_wrong_tag_is_explained_by_what_the_node_takes(takes: str, slip: str | None) -> None:
    key, identify = bytes(range(16)), bytes.fromhex("000080070000")
    asked: list[bytes] = []

    def sealed(payload: bytes) -> bytes:
        counter = payload[:4]
        nonce = bytes(9) + (counter[::-1] if takes == "little" else counter)
        padded = identify + b"\x0a" * 10
        return counter + AESCCM(key, 16).encrypt(nonce, padded, b"")

    def plain(command: Command) -> Reply:
        asked.append(command.payload)
        if takes in ("nothing", "wrong"):
            good = takes == "wrong" and command.payload != sealed(command.payload)
            return Reply(True, b"") if good else _refusal(12)
        return Reply(True, b"") if takes == "anything" or command.payload == sealed(command.payload) else _refusal(12)

    def seal(_command: Command, *, counter: int) -> Any:
        number = counter.to_bytes(4, "big")
        sealed_frame = AESCCM(key, 16).encrypt(bytes(9) + number, identify + b"\x0a" * 10, b"")
        return SimpleNamespace(payload=number + sealed_frame)

    session: Any = SimpleNamespace(seal=seal, keys=SimpleNamespace(to_node=key, to_station=key[::-1]))
    rig: Any = SimpleNamespace(plain=plain)
    assert _name(Probe._slip_of_sealed(rig, session)) == slip
    counters = [int.from_bytes(payload[:4], "big") for payload in asked]
    assert counters[0] == 1000, "far beyond what the session has used"
    assert counters[2:] == list(range(1001, 1001 + len(counters[2:]))), "another one for each try"


# -- the key agreement -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("state", "takes", "slip"),
    [
        (NodeState.FACTORY, b"", "station-without-label"),
        (NodeState.FACTORY, b"TEDS1 station key", "station-label-without-00"),
        (NodeState.FACTORY, b"TEDS1 station key\0", None),  # it takes a good Request now
        (NodeState.FACTORY, None, None),  # it takes any
        (NodeState.FACTORY, b"unknown", None),
        (NodeState.FACTORY, b"any but the right one", None),
        (NodeState.KEYED, b"", None),  # strangers are refused there, whatever they send
    ],
)
def test_a_refused_sig104_is_explained_by_what_the_node_verifies(
    state: NodeState, takes: bytes | None, slip: str | None
) -> None:
    asked: list[Command] = []

    def plain(command: Command) -> Reply:
        asked.append(command)
        station, signature, ca = command.payload[:65], command.payload[65:129], command.payload[129:194]
        if takes == b"any but the right one":
            good = not verify(ca, b"TEDS1 station key\0" + station, signature)
        else:
            good = takes is None or verify(ca, takes + station, signature)
        return Reply(True, b"") if good else _refusal(5)

    rig: Any = SimpleNamespace(identity=lambda: Identity(UUID, state, 1, 0, 512, 17), plain=plain)
    assert _name(agreement_rules._slip_of_request(rig)) == slip
    assert bool(asked) == (state == NodeState.FACTORY)


@pytest.mark.parametrize(("reason", "tried"), [(5, 1), (3, 0)])
@pytest.mark.parametrize("sealed", [False, True])
def test_only_a_refused_signature_of_a_request_is_looked_into(
    monkeypatch: pytest.MonkeyPatch, reason: int, tried: int, sealed: bool
) -> None:
    slip, looked, asked = Slip("a-slip", "what it did"), list[Any](), list[str]()

    def slip_of(probe: Any) -> Slip:
        looked.append(probe)
        return slip

    monkeypatch.setattr(agreement_rules, "_slip_of_request", slip_of)

    def answer(kind: str) -> Any:
        def answered(_command: Command) -> Reply:
            asked.append(kind)
            return _refusal(reason)

        return answered

    probe: Any = SimpleNamespace(uuid=UUID, teds=lambda _: b"", plain=answer("plain"), sealed=answer("sealed"))
    with pytest.raises(RuleBrokenError) as broken:
        agreement_rules.try_agreement(probe, StrangerStation.make().credentials, sealed=sealed)
    assert str(broken.value).startswith(f"Request (128.1), 259 octets: success is due, refusal {reason} came.")
    assert (broken.value.slip, looked) == ((slip, [probe]) if tried else (None, []))
    assert asked == ["sealed" if sealed else "plain"]


@pytest.mark.parametrize(
    ("takes", "slip", "keyed"),
    [("right", None, True), ("zeros", None, True), ("mac-reversed", "mac-reversed", True), ("nothing", None, False)],
)
def test_a_refused_tag_is_explained_by_the_one_that_the_node_takes(
    monkeypatch: pytest.MonkeyPatch, takes: str, slip: str | None, keyed: bool
) -> None:
    """Each is tried with a Request of its own, whose key is kept before the node can have it."""
    script, right = bytes(range(32)), bytes(range(100, 116))
    agreed: Any = SimpleNamespace(key=KEY, confirm=Command(0, 128, 2, right))
    tried: Any = SimpleNamespace(okm=OKM, script=script)
    monkeypatch.setattr(agreement_rules, "agree", lambda _probe: (agreed, tried))
    reverse = bends.mac(OKM[16:], b"station" + script)[:16][::-1]
    due = {"right": right, "zeros": bytes(16), "mac-reversed": reverse, "nothing": None}[takes]
    kept, asked = list[Any](), list[bytes]()

    def plain(command: Command) -> Reply:
        asked.append(command.payload)
        assert len(kept) == len(asked)
        return Reply(True, b"") if command.payload == due else _refusal(12)

    probe: Any = SimpleNamespace(keep=kept.append, plain=plain, key=None, okm=b"")
    assert _name(agreement_rules._slip_of_confirm(probe)) == slip
    assert (probe.key, probe.okm) == ((KEY, OKM) if keyed else (None, b""))
    assert asked[:2] == [right, bytes(16)][: len(asked)]
    assert len(asked) == len(set(asked))
    assert takes != "nothing" or len(asked) == 8, "the right one, zeros, and six slips"


@pytest.mark.parametrize(
    ("reply", "words"),
    [(Reply(True, b""), "success, 0 octets came."), (_refusal(2), "refusal 2 came."), (_refusal(12), "")],
)
@pytest.mark.parametrize(("state", "tapped", "way"), [
    (NodeState.FACTORY, True, "plain"), (NodeState.KEYED, True, "plain"), (NodeState.KEYED, False, "sealed"),
])  # fmt: skip
def test_a_test_agreement_is_ended_on_the_node(
    monkeypatch: pytest.MonkeyPatch, reply: Reply, words: str, state: NodeState, tapped: bool, way: str
) -> None:
    """A Confirm of zeros gets 12 and ends it; in a session over CAN, as the node's owner asks there."""
    asked, closed = list[tuple[str, str]](), list[int]()
    made = SimpleNamespace(request=b"rq", reply=b"rp", teds=b"te", tags=lambda okm, _: iter([(None, okm[16:32])]))
    tried = SimpleNamespace(agreement=made, broken=None, script=b"s" * 32, okm=OKM)
    how: list[Any] = []

    def request(_probe: Any, credentials: Any, *, sealed: bool) -> Any:
        how.append((credentials == "own", sealed))
        return tried

    def answer(kind: str) -> Any:
        def answered(command: Command) -> Reply:
            asked.append((kind, command.payload.hex()))
            return reply

        return answered

    monkeypatch.setattr(agreement_rules, "try_agreement", request)
    probe: Any = SimpleNamespace(
        identity=lambda: Identity(UUID, state, 1, 0, 512, 17), tapped=tapped, station="own",
        plain=answer("plain"), sealed=answer("sealed"), close=lambda: closed.append(1),
    )  # fmt: skip
    if words:
        with pytest.raises(RuleBrokenError) as broken:
            agreement_rules.explain(probe)
        assert str(broken.value) == f"Confirm (128.2) with a wrong tagS, to end the test: refusal 12 is due, {words}"
    else:
        explained = agreement_rules.explain(probe)
        assert (explained.problem, explained.slip, explained.station_tag) == (
            "", None, bends.mac(OKM[16:], b"station" + b"s" * 32)[:16]
        )  # fmt: skip
        assert explained.tag_due == OKM[16:32]
    assert asked == [(way, "00" * 16)]
    assert how == [(state == NodeState.KEYED, way == "sealed")]
    assert closed == [] if words else closed == [1]


# -- a proof, and rules that find nothing to try -----------------------------------------------------------------------


def _high(signature: bytes) -> bytes:
    return signature[:32] + (GROUP_ORDER - int.from_bytes(signature[32:], "big")).to_bytes(32, "big")


@pytest.mark.parametrize(
    ("label", "change", "found"),
    [
        (b"TEDS1 prove\0", bytes, "64 octets, good under field 101"),
        (b"TEDS1 prove\0", _high, "64 octets, good under field 101"),  # the rule prove-low-s looks at s
        (b"TEDS1 prove", bytes, "label-without-00"),
        (b"TEDS1 prove\0", lambda proof: proof[:-1], None),
    ],
)
def test_a_proof_counts_with_either_s(label: bytes, change: Any, found: str | None) -> None:
    def good(command: Command) -> bytes:
        return bytes(change(NODE.sign(label + UUID + command.payload)))

    probe: Any = SimpleNamespace(uuid=UUID, good=good, security=lambda: SimpleNamespace(node_key=NODE.point))
    if found is not None and found.startswith("64"):
        assert plain_rules.prove(probe) == found
        return
    with pytest.raises(RuleBrokenError) as broken:
        plain_rules.prove(probe)
    assert _name(broken.value.slip) == found
    assert found is not None or str(broken.value).startswith("Prove (128.8): 64 octets are due, 63 came.")


def test_a_fault_of_the_channels_is_reported_once_and_then_skips_their_rules(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> Any:
        raise RuleBrokenError("Operate (4.1): torn")

    monkeypatch.setattr(measuring_rules, "_operation", lambda _: SimpleNamespace(channels={}))
    monkeypatch.setattr(measuring_rules, "_fitting", broken)
    probe: Any = SimpleNamespace(channels={}, no_channels="", keep=None, sealed=lambda _: _refusal(3))
    with pytest.raises(RuleBrokenError, match=r"Operate \(4.1\): torn"):
        measuring_rules.channels(probe)
    with pytest.raises(NotApplicableError) as no:
        measuring_rules.channels(probe)
    assert str(no.value) == "No channel can be claimed: Operate (4.1): torn"

    probe.no_channels = ""
    monkeypatch.setattr(measuring_rules, "_operation", lambda _: SimpleNamespace(channels={1: (0, 0), 2: (0, 0)}))
    monkeypatch.setattr(measuring_rules, "_fitting", lambda *_: {})
    for _ in range(2):
        with pytest.raises(NotApplicableError) as no:
            measuring_rules.channels(probe)
        assert str(no.value) == (
            "No Channel TEDS fits any of its 2 channels. Provision the board with its datasheet, or let the check write"
            " one: --factory"
        )
    assert measuring_rules._octets(b"\0\0\0\4no TEDS") == 0


@pytest.mark.parametrize(("slow", "found"), [((), 1), ((1,), 4), ((1, 4), 12), ((1, 4, 12), None)])
def test_a_lease_shorter_than_an_exchange_is_tried_longer(
    monkeypatch: pytest.MonkeyPatch, slow: tuple[int, ...], found: int | None
) -> None:
    """A claim that ran out before Operation was asked accuses no node."""
    now, pauses, lease_now = [0.0], list[float](), [0]

    def claimed(_probe: Any, channel: int, *, lease: int) -> Any:
        assert channel == 3
        lease_now[0] = lease
        return nullcontext()

    def operation(_probe: Any) -> Any:
        late = lease_now[0] in slow
        now[0] += lease_now[0] if late else 0
        here = not late and len(pauses) == 0
        return SimpleNamespace(channels={3: (2 if here else 0, 0)}, measuring=False)

    monkeypatch.setattr(measuring_rules, "_sensor", lambda _: 3)
    monkeypatch.setattr(measuring_rules, "_claimed", claimed)
    monkeypatch.setattr(measuring_rules, "_operation", operation)
    probe: Any = SimpleNamespace(now=lambda: now[0], pause=pauses.append)
    if found is None:
        with pytest.raises(NotApplicableError) as no:
            measuring_rules.operate_expires(probe)
        assert str(no.value) == "An exchange took longer than 12 s."
        return
    assert measuring_rules.operate_expires(probe) == f"a lease of {found} s ends the claim"
    assert pauses == [pytest.approx(found + 0.4)]


def test_the_size_of_a_large_teds_is_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Above 32 KiB it would take minutes; what was staged goes all the same."""
    closed, written = list[int](), list[int]()
    status = TedsStatus(0, 0, 0, 32769)
    monkeypatch.setattr(write_rules, "absent", lambda _: (255, 17))
    probe: Any = SimpleNamespace(
        sealed_good=lambda command: written.append(command.function), sealed_refused=lambda *_: "refused",
        good=lambda _: status.encode(), close=lambda: closed.append(1), max_message=512,
    )  # fmt: skip
    assert write_rules.write_drops(probe) == "MaxTEDSSize 32769 was not tried"
    assert (written, closed) == ([3, 3], [1])


# -- the run -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("knows", "found"), [(b"1" * 16, 0), (b"3" * 16, 2), (b"9" * 16, None)])
def test_a_node_that_opens_no_session_still_shows_which_key_it_knows(knows: bytes, found: int | None) -> None:
    """It answers a wrong mac with 12 under a keyId that it knows, else with 16."""
    keys = [SimpleNamespace(key=letter * 16) for letter in (b"1", b"2", b"3")]
    known = bends.sha(b"TEDS1 key id\0" + knows)[:8]
    rig: Any = SimpleNamespace(
        _node=SimpleNamespace(uuid=UUID),
        _station=SimpleNamespace(keys=SimpleNamespace(unwrapped=lambda _uuid: keys)),
        _probe=SimpleNamespace(plain=lambda command: _refusal(12 if command.payload[:8] == known else 16)),
    )
    held: Any = _Run._known_there(rig)
    assert held is (keys[found] if found is not None else None)


@pytest.mark.parametrize("error", [RuleBrokenError("tagN is wrong."), NotApplicableError("Needs NFC.")])
def test_why_nothing_is_explained_is_kept(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def explain(_probe: Any) -> Any:
        raise error

    monkeypatch.setattr("teds_provision.check.run.explain", explain)
    rig: Any = SimpleNamespace(_explaining=True, _probe=None, _explained=None)
    _Run._explain(rig)
    assert rig._explained == str(error)
    rig = SimpleNamespace(_explaining=False, _probe=None, _explained=None)
    _Run._explain(rig)
    assert rig._explained is None


def test_a_channel_of_an_unknown_form_has_no_octets() -> None:
    teds = measuring_rules.channel_teds(ChannelKind.SENSOR, 1, 2)
    assert measuring_rules._octets(teds) == 2


def test_a_counter_that_was_used_a_lower_one_and_0_are_tried() -> None:
    """profile.md, "Sessions": the counter ascends from 1; 13 for any other."""
    sealed: list[tuple[int | None, int]] = []

    def session() -> Any:
        def seal(command: Command, *, counter: int | None = None) -> Command:
            sealed.append((counter, command.function))
            return Command(0, 128, 4, bytes([counter or 0]))

        return SimpleNamespace(seal=seal, unseal=lambda _octets: None)

    asked: list[int] = []

    def plain(command: Command) -> Reply:
        asked.append(command.payload[0])
        return _refusal(13)

    probe: Any = SimpleNamespace(
        open=session, good=lambda command: b"", plain=plain, sealed_good=lambda command: asked.append(-1)
    )
    assert session_rules.sealed_counter(probe) == "13 for the same frame, for 8, 0, and for another command under 9"
    assert sealed == [(9, 7), (8, 7), (0, 7), (9, 11), (0, 7)]
    assert asked == [9, 8, 0, 9, -1, 0, -1], "the session stays open"


def test_an_address_that_was_taken_twice_within_ten_seconds_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rule fails, and the rules after it still reach the board: at the address that it went back to."""
    moves, addresses = list[int](), [17, 70]
    monkeypatch.setattr(session_rules, "_free_address", lambda *_: 70)
    monkeypatch.setattr(session_rules, "_moved", lambda *_: "session")
    probe: Any = SimpleNamespace(
        identity=lambda: Identity(UUID, NodeState.KEYED, 1, 0, 512, addresses.pop(0)), session="open", home_address=0,
        sealed_good=lambda _command: b"", sealed=lambda _command: Reply(True, b""), move=moves.append,
        contact=SimpleNamespace(link=object()),
    )  # fmt: skip
    with pytest.raises(RuleBrokenError, match="a second write within 10 s"):
        session_rules.address_moves(probe)
    assert (moves, probe.session, probe.home_address) == ([17], None, 17)


@pytest.mark.parametrize("fd", [False, True])
def test_of_the_frames_of_a_bus_those_of_the_stream_itself_make_its_messages(fd: bool) -> None:
    """Another stream, another node, another station, and a frame that is none of data come between them."""
    wanted, other = bytes(range(30)), bytes(range(100, 130))
    queue: list[Any] = []
    parts = list(zip(cut(wanted, fd=fd), cut(other, fd=fd), strict=True))
    for _ in range(2):
        for mine, foreign in parts:
            for station, stream, node in ((0xF1, 2, 17), (0xF1, 1, 18), (0xF2, 1, 17)):
                queue.append((DataAddress(station, stream, foreign.segment, node).identifier, foreign.data))
            queue += [(0x18DA11F1, b"\x30\0\0"), (DataAddress(0xF1, 1, mine.segment, 17).identifier, mine.data)]
    frames: Any = SimpleNamespace(
        fd=fd, own=0xF1,
        next=lambda _seconds: SimpleNamespace(**dict(zip(("identifier", "octets"), queue.pop(0), strict=True)))
        if queue else None,
    )  # fmt: skip
    probe: Any = SimpleNamespace(now=lambda: 0.0, contact=SimpleNamespace(address=17))
    asked: Any = SimpleNamespace(stream=1)
    assert measuring_rules._messages(probe, frames, asked, 30, 3, 1.0) == [wanted, wanted]


# -- errors ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error", [NotAuthenticError("No tag."), PolicyError("Another key."), BadDataError("No point on the curve.")]
)
@pytest.mark.parametrize("point", [True, False])
def test_a_reply_to_request_that_this_station_does_not_accept_breaks_the_rule(
    monkeypatch: pytest.MonkeyPatch, error: Any, point: bool
) -> None:
    """Without a point nothing more can be derived from it; with one the slip is looked for."""

    class Agreement:
        def __init__(self, *_: Any, **__: Any) -> None: ...

        def request(self) -> Command:
            return Command(0, 128, 1, bytes(259))

        def accept(self, *_: Any, **__: Any) -> Any:
            raise error

    made = SimpleNamespace(
        en=NODE.point if point else bytes(65), shared=b"", transcripts=lambda: [(None, b"t")],
        material=lambda *_: [(None, bytes(64))],
    )  # fmt: skip
    monkeypatch.setattr(agreement_rules, "StationAgreement", Agreement)
    monkeypatch.setattr("teds_provision.check.slips.Agreement", lambda *_: made)
    monkeypatch.setattr(agreement_rules, "_explained", lambda _made, otherwise: RuleBrokenError(f"so: {otherwise}"))
    probe: Any = SimpleNamespace(
        uuid=UUID, teds=lambda _: b"", plain=lambda _command: Reply(True, bytes(165)),
        security=lambda: SimpleNamespace(node_key=NODE.point),
    )  # fmt: skip
    credentials = StrangerStation.make().credentials
    if not point:
        with pytest.raises(RuleBrokenError) as broken:
            agreement_rules.try_agreement(probe, credentials)
        assert str(broken.value) == f"Request (128.1): {error.message}"
        return
    tried = agreement_rules.try_agreement(probe, credentials)
    assert (str(tried.broken), tried.agreed, len(tried.okm)) == (f"so: {error.message}", None, 48)


@pytest.mark.parametrize("error", [GarbledError("Torn."), NotAuthenticError("No tag.")])
def test_a_sealed_reply_that_does_not_open_breaks_the_rule_and_ends_the_session(
    monkeypatch: pytest.MonkeyPatch, error: Any
) -> None:
    def unseal(_octets: bytes) -> Any:
        raise error

    looked: list[Any] = []
    monkeypatch.setattr("teds_provision.check.probe.slips.of_sealed_reply", lambda *words: looked.append(words))
    notes: list[Any] = []
    rig: Any = SimpleNamespace(
        octets=lambda *_, **__: Reply(True, b"sealed"), session="open",
        contact=SimpleNamespace(note=lambda *words, **_: notes.append(words)),
    )  # fmt: skip
    session: Any = SimpleNamespace(
        seal=lambda _command: Command(0, 128, 4, b"\0\0\0\7rest"), unseal=unseal, keys="keys"
    )
    with pytest.raises(RuleBrokenError) as broken:
        Probe._sealed(rig, session, Command(0, 128, 7, b""))
    assert str(broken.value) == f"Identify (128.7), 0 octets, sealed: {error.message}"
    assert (rig.session, looked, len(notes)) == (None, [("keys", b"sealed", 7)], 1)


@pytest.mark.parametrize("error", [RuleBrokenError("torn"), LinkError("silent")])
def test_a_board_that_moved_without_a_whole_reply_is_found_at_its_new_address(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def sealed(_command: Command) -> Reply:
        raise error

    monkeypatch.setattr(session_rules, "MultiStationLink", SimpleNamespace)
    moves: list[int] = []
    for there, found in ((UUID, "the node is there now"), (bytes(10), str(error)), (None, str(error))):
        identity = None if there is None else Identity(there, NodeState.KEYED, 1, 0, 512, 70)
        link = SimpleNamespace(identify_at=lambda _address, identity=identity: identity)
        probe: Any = SimpleNamespace(
            session="open", sealed=sealed, contact=SimpleNamespace(link=link), uuid=UUID, move=moves.append
        )
        with pytest.raises((RuleBrokenError, LinkError)) as raised:
            session_rules._moved(probe, 17, 70)
        assert found in str(raised.value)
    assert moves == [70]


@pytest.mark.parametrize("error", [BadDataError("No."), NotAuthenticError("No."), PolicyError("No.")])
def test_a_node_that_cannot_be_reset_fails_the_rule_reset(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fails(*_: Any) -> Any:
        raise error

    monkeypatch.setattr("teds_provision.check.run.examine", lambda *_: None)
    monkeypatch.setattr("teds_provision.check.run.reset_node", fails)
    rig: Any = SimpleNamespace(_station=None, _node=None, _checks={}, _probe=SimpleNamespace(key=KEY))
    assert _Run._reset(rig) == "The node could not be reset. No."
    failed = rig._checks["reset"]
    assert (failed.rule, failed.result, failed.detail, rig._probe.key) == ("reset", "failed", "No.", KEY)
    monkeypatch.setattr("teds_provision.check.run.reset_node", lambda *_: None)
    assert _Run._reset(rig) == ""
    assert (rig._probe.key, rig._probe.session, rig._probe.no_session, rig._probe.no_agreement) == (None, None, "", "")


@pytest.mark.parametrize("error", [RuleBrokenError("torn"), NotApplicableError("no TEDS")])
def test_the_boards_own_teds_that_cannot_be_restored_keep_it_from_no_reset(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """A rule has reported the fault already; the node still gets its next key, and goes back to factory state."""

    def restore(_probe: Any) -> None:
        raise error

    monkeypatch.setattr(measuring_rules, "restore", restore)
    stages, removed = list[str](), list[bytes]()
    station = SimpleNamespace(
        credentials=lambda: "own", durable=lambda _what: nullcontext(), audit=lambda *_, **__: None,
        keys=SimpleNamespace(remove=removed.append),
    )  # fmt: skip
    rig: Any = SimpleNamespace(
        _probe=SimpleNamespace(key=KEY), _station=station, _keep=None, _node=SimpleNamespace(uuid=UUID),
        _stage=lambda stage: stages.append(stage.name), _checks={"reset": SimpleNamespace(result="passed")},
    )  # fmt: skip
    _Run._key_and_back(rig, sessions_too=True)
    assert stages == ["AGREEMENT", "KEYED", "SESSION", "COMMIT", "MEASURING", "ROTATION", "RESET"]
    assert removed == [UUID]
    rig._checks["reset"] = SimpleNamespace(result="failed")
    _Run._key_and_back(rig, sessions_too=False)
    assert stages[7:] == ["AGREEMENT", "COMMIT", "MEASURING", "ROTATION", "RESET"]
    assert removed == [UUID], "a node that was not reset still has the key"


def _commit_of(monkeypatch: pytest.MonkeyPatch, stored: bytes) -> tuple[Any, list[str]]:
    """Return a board that stores this Security TEDS after a commit that is to be refused, and what it was sent."""
    sent: list[str] = []

    def sealed_refused(*_: Any) -> str:
        sent.append("refused?")
        raise RuleBrokenError("it was accepted")

    monkeypatch.setattr(write_rules, "_write", lambda _probe, _block, octets: sent.append(f"write {octets.decode()}"))
    monkeypatch.setattr(write_rules, "_signed", lambda *_: b"good")
    monkeypatch.setattr(write_rules, "_sheet", lambda *_: None)
    monkeypatch.setattr(write_rules, "stored_blocks", lambda _probe: {})
    probe: Any = SimpleNamespace(
        identity=lambda: "identity", teds=lambda _block: stored, listed=list, sealed_refused=sealed_refused,
        sealed=lambda _command: sent.append("update"), close=lambda: sent.append("close"),
    )  # fmt: skip
    return probe, sent


@pytest.mark.parametrize(("stored", "repair"), [(b"wrong", ["write good", "update", "close"]), (b"former", [])])
def test_a_board_that_accepted_a_wrong_datasheet_gets_a_good_one_for_the_rules_after_it(
    monkeypatch: pytest.MonkeyPatch, stored: bytes, repair: list[str]
) -> None:
    probe, sent = _commit_of(monkeypatch, stored)
    with pytest.raises(RuleBrokenError, match="it was accepted"):
        write_rules._refused_over(probe, Reason.BAD_SIGNATURE, "104 wrong", b"wrong")
    assert sent == ["write wrong", "refused?", *repair]


@pytest.mark.parametrize("again", [b"first", b"another"])
def test_a_repeated_open_opens_the_session_of_its_first_reply(monkeypatch: pytest.MonkeyPatch, again: bytes) -> None:
    """profile.md, "Repetition": the stored reply is given, and the session of it is used."""
    order: list[str] = []
    made = SimpleNamespace(
        open=lambda counter: SimpleNamespace(encode=lambda: b"open " + counter),
        accept=lambda payload: order.append(f"accept {payload.decode()}"),
    )
    monkeypatch.setattr(session_rules, "StationSession", lambda *_: made)
    monkeypatch.setattr(session_rules, "_opens", lambda _probe: order.append("opens"))
    probe: Any = SimpleNamespace(
        link_key=KEY, uuid=UUID, session=None, opening_counter=lambda: b"c",
        resending=SimpleNamespace(resend=lambda frame: Reply(True, again).encode() if frame == b"open c" else b""),
        octets=lambda _frame, _what: Reply(True, b"first"), close=lambda: order.append("close"),
    )  # fmt: skip
    probe.sealed_good = lambda _command: order.append(f"sealed {probe.session is made}")
    if again != b"first":
        with pytest.raises(RuleBrokenError, match=r"Open \(128.3\) repeated: the stored reply is due"):
            session_rules.repetition_open(probe)
        return
    assert session_rules.repetition_open(probe) == "the stored reply, and a session under it"
    assert order == ["opens", "accept first", "sealed True", "close"]
