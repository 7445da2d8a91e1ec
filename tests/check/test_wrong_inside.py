"""``node check`` against nodes that are wrong inside: a check left out, a value kept too long, a secret used twice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from cryptography.hazmat.primitives.ciphers.aead import AESCCM

from teds_provision.check.run import check_node
from teds_provision.protocol import commit, datasheet
from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import SoftwareKey, normalise_signature, verify
from teds_provision.protocol.messages.frames import Command, Function, Reason, Refused, Reply
from teds_provision.protocol.session import NodeSession
from teds_provision.protocol.tim import node, teds_access
from teds_provision.protocol.tim.agreeing import Agreeing
from teds_provision.protocol.tim.sessions import Sessions
from teds_provision.station.station import Station

from ..bench import Board, talk
from ..protocol.desk import META, NAME
from .faulty import FaultyLink, _is, _reads

Patch = pytest.MonkeyPatch


def any_padding(patch: Patch) -> None:
    """The tag is looked at, the padding is taken off as its last octet says."""

    def unseal(self: NodeSession, payload: bytes) -> bytes | None:
        nonce = bytes(9) + payload[:4]
        try:
            padded = AESCCM(self._keys.to_node, tag_length=16).decrypt(nonce, payload[4:], None)
        except Exception:  # noqa: BLE001 - whatever is wrong with it
            return None
        return padded[: 6 + int.from_bytes(padded[4:6], "big")]

    patch.setattr(NodeSession, "unseal", unseal)


def one_time_key_twice(patch: Patch) -> None:
    key, original = SoftwareKey.generate(), NodeSession.__init__
    patch.setattr(NodeSession, "__init__", lambda self, k, uuid, es, _: original(self, k, uuid, es, key))


def open_ends_the_session(patch: Patch) -> None:
    original = Sessions.open

    def opened(self: Sessions, payload: bytes, link: str, flash: Flash) -> bytes:
        reply = original(self, payload, link, flash)
        if payload:
            self._links[link].session = None
        return reply

    patch.setattr(Sessions, "open", opened)


def any_address(patch: Patch) -> None:
    patch.setattr(node, "LAST_ADDRESS", 255)


def nonce_twice(patch: Patch) -> None:
    original = Agreeing.request

    def request(self: Agreeing, *args: Any) -> bytes:
        self._random = bytes
        return original(self, *args)

    patch.setattr(Agreeing, "request", request)


def confirm_from_anywhere(patch: Patch) -> None:
    original = Agreeing.confirm

    def confirm(self: Agreeing, payload: bytes, origin: Any, flash: Flash) -> Flash:
        if self._pending is not None:
            self._pending.link, self._pending.session = origin.link, origin.session
        return original(self, payload, origin, flash)

    patch.setattr(Agreeing, "confirm", confirm)


def write_keeps_the_rest(patch: Patch) -> None:
    original = teds_access.TedsAccess.write

    def write(self: Any, flash: Flash, command: Command, staging: Any, session: Any, *, now: float) -> Reply:
        block = (command.channel, command.payload[0])
        before = staging.of(session).get(block, b"")
        reply = original(self, flash, command, staging, session, now=now)
        staging._images[block] += before[len(staging._images[block]) :]
        return reply

    patch.setattr(teds_access.TedsAccess, "write", write)


def any_size(patch: Patch) -> None:
    original = teds_access.TedsAccess.write

    def write(self: Any, *args: Any, now: float) -> Reply:
        return original(replace(self, max_teds=self.max_teds + 100), *args, now=now)

    patch.setattr(teds_access.TedsAccess, "write", write)


def staging_for_ever(patch: Patch) -> None:
    patch.setattr(teds_access.Staging, "of", lambda self, session: self._images)
    patch.setattr(teds_access.Staging, "require", lambda self, session, untouched=None: None)
    patch.setattr(teds_access.Staging, "end", lambda self, session=None: None if session else self._images.clear())


def listed_is_enough(patch: Patch) -> None:
    """Commit looks whether what 108 lists is there, and not at its digest."""

    def listed(flash: Flash, staged: Any, signed: Any) -> dict[Any, bytes]:
        found = {block: staged.get(block) or flash.teds(block) for block in signed.signed_blocks}
        if None in found.values() or staged.keys() - {(0, 128)} - found.keys():
            raise Refused(Reason.DIGEST_MISMATCH)
        return {block: teds for block, teds in found.items() if teds is not None}

    patch.setattr(commit, "_listed_blocks", listed)


def a_refused_commit_counts(patch: Patch) -> None:
    original = commit.verified_commit

    def committed(flash: Flash, *args: Any) -> Flash:
        try:
            return original(flash, *args)
        except Refused:
            object.__setattr__(flash, "sequence", flash.sequence + 1)
            raise

    patch.setattr(teds_access, "verified_commit", committed)


def _reset_to(change: Callable[[Flash, Flash], Flash]) -> Callable[[Patch], None]:
    original = node.in_factory_state
    return lambda patch: patch.setattr(node, "in_factory_state", lambda flash: change(flash, original(flash)))


def _lenient(verified: Any) -> Any:
    return lambda point, message, signature: verified(point, message, normalise_signature(signature))


def any_s_in_a_request(patch: Patch) -> None:
    original = Agreeing.request

    def request(self: Agreeing, *args: Any) -> bytes:
        self._verify = _lenient(verify)
        return original(self, *args)

    patch.setattr(Agreeing, "request", request)


def any_s_in_a_datasheet(patch: Patch) -> None:
    def lenient(flash: Flash, staged: Any, verified: Any) -> Flash:
        return commit.verified_commit(flash, staged, _lenient(verified))

    patch.setattr(teds_access, "verified_commit", lenient)


def the_first_request_stays(patch: Patch) -> None:
    original = Agreeing.request

    def request(self: Agreeing, *args: Any) -> bytes:
        before, reply = self._pending, original(self, *args)
        self._pending = before or self._pending
        return reply

    patch.setattr(Agreeing, "request", request)


def the_first_open_stays(patch: Patch) -> None:
    original = Sessions.open

    def opened(self: Sessions, payload: bytes, link: str, flash: Flash) -> bytes:
        before = self._links[link].half_open if link in self._links else None
        reply = original(self, payload, link, flash)
        if payload and before is not None:
            self._links[link].half_open = before
        return reply

    patch.setattr(Sessions, "open", opened)


def a_refused_write_drops(patch: Patch) -> None:
    original = teds_access.TedsAccess.write

    def write(self: Any, flash: Flash, command: Command, staging: Any, session: Any, *, now: float) -> Reply:
        try:
            return original(self, flash, command, staging, session, now=now)
        except Refused:
            staging._images.pop((command.channel, command.payload[0]), None)
            raise

    patch.setattr(teds_access.TedsAccess, "write", write)


def an_empty_write_stages_nothing(patch: Patch) -> None:
    original = teds_access.TedsAccess.write

    def write(self: Any, flash: Flash, command: Command, staging: Any, session: Any, *, now: float) -> Reply:
        reply = original(self, flash, command, staging, session, now=now)
        if len(command.payload) == 5:
            del staging._images[command.channel, command.payload[0]]
        return reply

    patch.setattr(teds_access.TedsAccess, "write", write)


def any_challenge_of_reset(patch: Patch) -> None:
    original = node._length
    patch.setattr(node, "_length", lambda payload, octets: None if octets == 32 else original(payload, octets))


INSIDE: dict[str, tuple[Callable[[Patch], None], str]] = {
    "padding that is wrong": (any_padding, "sealed-padding"),
    "a one-time key for every Open": (one_time_key_twice, "open-one-time"),
    "an Open that ends the session": (open_ends_the_session, "open-beside"),
    "CAN address 240": (any_address, "address-checks"),
    "the same nonce for every Request": (nonce_twice, "agreement-fresh"),
    "a Confirm from anywhere": (confirm_from_anywhere, "confirm-elsewhere"),
    "Write keeps what lay behind": (write_keeps_the_rest, "write-drops"),
    "more than MaxTEDSSize": (any_size, "write-drops"),
    "staged TEDS live on": (staging_for_ever, "staging-ends"),
    "a digest that is not looked at": (listed_is_enough, "commit-digest"),
    "a staged TEDS with a wrong checksum": (
        lambda patch: patch.setattr(datasheet, "passes_own_check", lambda *_: True),
        "commit-own-check",
    ),
    "fields of another profile": (
        lambda patch: patch.setattr(datasheet, "own_values", lambda _: True),
        "commit-values",
    ),
    "the Meta-TEDS of another node": (
        lambda patch: patch.setattr(datasheet, "meta_names", lambda *_: True),
        "commit-uuid",
    ),
    "a refused commit uses a sequence up": (a_refused_commit_counts, "commit-signatures"),
    "a high s in a Request": (any_s_in_a_request, "request-high-s"),
    "a high s in a datasheet": (any_s_in_a_datasheet, "commit-high-s"),
    "an older Request that still counts": (the_first_request_stays, "confirm-newest"),
    "an older Open that still counts": (the_first_open_stays, "open-replaced"),
    "a session beyond the last counter": (
        lambda patch: patch.setattr(node, "LAST_COUNTER", -1),
        "sealed-last-counter",
    ),
    "a refused Write drops what is staged": (a_refused_write_drops, "write-keeps"),
    "an empty Write stages nothing": (an_empty_write_stages_nothing, "write-keeps"),
    "Reset takes the other TEDS": (_reset_to(lambda _, reset: replace(reset, blocks={})), "reset"),
    "Reset keeps the CA": (_reset_to(lambda flash, reset: replace(reset, ca=flash.ca)), "reset-forgets"),
    "Reset with any challenge": (any_challenge_of_reset, "prove-length"),
}


@pytest.mark.parametrize("what", INSIDE)
def test_what_is_wrong_inside_is_found_by_its_rule(station: Station, patch: Patch, what: str) -> None:
    wrong, rule = INSIDE[what]
    wrong(patch)
    assert rule in failed(station)


@pytest.fixture
def patch(monkeypatch: Patch) -> Patch:
    return monkeypatch


def failed(station: Station, **link: Any) -> set[str]:
    """The rules that a node with a Meta-TEDS and a name breaks."""
    board = Board()
    board.flash.state = replace(board.state, blocks={(0, 1): META, (1, 12): NAME})
    board.power_on()
    report = check_node(station, talk(board, FaultyLink(board, **link)), factory=True)
    return {check.rule for check in report.checks if check.result == "failed"}


def test_the_good_node_breaks_none(station: Station) -> None:
    assert not failed(station)


def test_identify_with_a_payload_is_found(station: Station) -> None:
    def any_payload(_board: Board, octets: bytes, reference: Any) -> bytes:
        answer: bytes = reference(octets[:4] + b"\0\0" if _is(octets, Function.IDENTIFY) else octets)
        return answer

    assert failed(station, fault=any_payload) == {"no-payload"}


def test_a_reply_longer_than_max_message_is_found(station: Station) -> None:
    def long(_board: Board, octets: bytes, reference: Any) -> bytes:
        answer: bytes = reference(octets)
        return Reply(True, bytes(2046)).encode() if _is(octets, Function.LIST) else answer

    board = Board()
    report = check_node(station, talk(board, FaultyLink(board, fault=long)))
    assert any("maxMessage is 2048" in check.detail for check in report.checks if check.rule == "list-ascending")


def test_an_attribute_that_is_wrong_is_found(station: Station) -> None:
    def texts(_board: Board, octets: bytes, reference: Any) -> bytes:
        answer: bytes = reference(octets)
        query = _is(octets, 1, 1) and answer[:1] == b"\1"
        return answer[:3] + bytes([answer[3] | 0x10]) + answer[4:] if query else answer

    assert "query-present" in failed(station, fault=texts)


def test_an_initial_teds_of_an_older_epoch_is_found(station: Station) -> None:
    def stale(board: Board, octets: bytes, reference: Any) -> bytes:
        if board.state.key is None or board.state.provisioned:
            answer: bytes = reference(octets)
            return answer
        older = replace(board.state, epoch=board.state.epoch - 1).security_teds()
        return _reads(lambda _: older)(board, octets, reference)

    assert "keyed-security" in failed(station, fault=stale)
