"""``verify`` at a node: what is no session, what is kept of a plain answer, and what is said of another holder."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NodeRefusedError, UnprovenError
from teds_provision.links import LinkSettings
from teds_provision.protocol.messages.frames import Reason
from teds_provision.provisioning import readings, verify_node
from teds_provision.provisioning.conversation import HEARD
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.verify_node import open_or_say_why, verify_at, verify_at_node
from teds_provision.station.station import Station
from teds_provision.teds.image import Image
from tests.bench import Board, make_station, talk

from .test_provision import run


@pytest.mark.parametrize(
    ("message", "sealed", "second"),
    [(f"{HEARD}it is busy.", True, True), ("it is busy.", True, False), (f"{HEARD}it is busy.", False, False)],
)
def test_a_session_that_only_says_busy_counts_as_none(
    station: Station, monkeypatch: pytest.MonkeyPatch, message: str, sealed: bool, second: bool
) -> None:
    read: list[str] = []

    def read_image(_node: object) -> str:
        read.append("image")
        if len(read) == 1:
            raise NodeRefusedError(message, reason=Reason.BUSY)
        return "the image"

    judged: list[Any] = []
    monkeypatch.setattr(verify_node, "open_or_say_why", lambda *_: "")
    monkeypatch.setattr(verify_node, "read_image", read_image)
    monkeypatch.setattr(verify_node, "judge_and_keep", lambda *args, **more: judged.append((args[2:], more)))
    node: Any = SimpleNamespace(sealed=sealed, open_counter=b"c", forget=lambda: read.append("forget"))
    who: Any = SimpleNamespace(point=b"point")
    if second:
        verify_at_node(station, node, who)
        assert read == ["image", "forget", "image"]
        assert judged == [(("the image", b"point"), {"why": "it is busy", "c": b"c"})]
    else:
        with pytest.raises(NodeRefusedError):
            verify_at_node(station, node, who)
        assert (read, judged) == (["image"], [])


@pytest.mark.parametrize(("elsewhere", "more"), [("", ""), ("it reports key epoch 2", "; it reports key epoch 2")])
def test_why_a_key_that_is_held_opens_no_session(
    station: Station, monkeypatch: pytest.MonkeyPatch, elsewhere: str, more: str
) -> None:
    monkeypatch.setattr(verify_node, "session_if_keyed", lambda *_: None)
    monkeypatch.setattr(verify_node, "agreed_elsewhere", lambda *_: elsewhere)
    node: Any = SimpleNamespace(uuid=bytes(10))
    assert open_or_say_why(station, node) == "", "no key is held"
    monkeypatch.setattr(type(station.keys), "held", lambda *_: True)
    assert open_or_say_why(station, node) == f"the node does not open a session with any key held here{more}"
    monkeypatch.setattr(type(station.policy), "tombstone", lambda *_: object())
    assert open_or_say_why(station, node) == "", "the key was given away"


def test_a_refusal_outside_a_session_decides_nothing_of_a_node_whose_key_is_held(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_args: object, **_more: object) -> None:
        raise NodeRefusedError(f"{HEARD}it is busy.", reason=Reason.BUSY)

    monkeypatch.setattr(verify_node, "at_node", refuse)

    def verify() -> Any:
        return verify_at(station, LinkSettings(), board.uuid.hex(), SilentReporter())

    with pytest.raises(NodeRefusedError):
        verify()
    monkeypatch.setattr(type(station.keys), "held", lambda *_: True)
    report = verify()
    assert (report.verified.verdict, type(report.error)) == ("unproven", UnprovenError)
    (line,) = [entry for entry in station.audit_log.entries() if entry.act == "verify"]
    assert (line.uuid, line.outcome, line.detail) == (board.uuid, "unproven", {"why": f"{HEARD}it is busy."})
    monkeypatch.setattr(type(station.policy), "tombstone", lambda *_: object())
    with pytest.raises(NodeRefusedError):
        verify()


def test_a_plain_answer_changes_no_fact_of_a_session_and_is_no_session_later(
    station: Station, board: Board, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(station, board)
    station.keys.remove(board.uuid)
    with station.transaction():
        station.nodes.remember(board.uuid, channels=99)
    with talk(board) as node:
        verify_at_node(station, node, identify(station, node))
    known = station.nodes.get(board.uuid)
    assert known is not None
    assert known.channels == 99
    stranger = make_station(tmp_path / "other", "other")
    with talk(board) as node:
        verify_at_node(stranger, node, identify(stranger, node))
    monkeypatch.setattr(readings, "is_keyed", lambda *_: True)
    later = readings.verdict_of(stranger, board.uuid)
    stranger.close()
    assert later is not None
    (session,) = [check for check in later.verified.checks if check.name == "session"]
    assert session.why == "its datasheet was last read outside a session"


def test_a_refusal_in_a_session_is_an_error_and_one_outside_of_it_a_reason(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> Any:
        raise NodeRefusedError(f"{HEARD}it is busy.", reason=Reason.BUSY)

    monkeypatch.setattr(verify_node, "session_if_keyed", refuse)
    node: Any = SimpleNamespace(uuid=bytes(10), sealed=False)
    assert "busy" in open_or_say_why(station, node)
    node.sealed = True
    with pytest.raises(NodeRefusedError):
        open_or_say_why(station, node)


def test_an_image_file_is_verified_without_a_node(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = Image(bytes(10), {})
    monkeypatch.setattr(verify_node, "node_or_image", lambda _station, what, *, is_node: image if not is_node else what)
    monkeypatch.setattr(verify_node, "verify_image_alone", lambda *given: given)
    found = verify_at(station, LinkSettings(), "image.json", SilentReporter(), accept_calibration="it is so")
    assert found == (station, image, "it is so")
