"""Which way a node that came is inspected: in a session, or by its plain answers; and which datasheet counts."""

from __future__ import annotations

import itertools
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError, NotAuthenticError, PolicyError
from teds_provision.measure import verified_session
from teds_provision.measure.verified_session import open_unverified
from teds_provision.ncap.nodes import inspection
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.teds.image import SECURITY, Image


@pytest.mark.parametrize(
    ("held", "state", "opens", "way"),
    [
        (True, NodeState.PROVISIONED, True, "session"),
        (True, NodeState.KEYED, True, "session"),
        (True, NodeState.PROVISIONED, False, "session stranger"),
        (True, NodeState.FACTORY, True, "stranger"),
        (False, NodeState.PROVISIONED, True, "stranger"),
    ],
)
def test_a_node_is_inspected_in_a_session_if_its_key_is_held_and_it_reports_one(
    held: bool, state: NodeState, opens: bool, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that was reset has no key: each try would cost the bus a refusal, and the node its turn."""
    went: list[str] = []
    found = object()

    def in_session(*_words: Any) -> object | None:
        went.append("session")
        return found if opens else None

    def stranger(*_words: Any) -> object:
        went.append("stranger")
        return found

    monkeypatch.setattr(inspection, "_in_session", in_session)
    monkeypatch.setattr(inspection, "_stranger", stranger)
    monkeypatch.setattr(inspection, "identify", lambda *_words: None)
    station: Any = SimpleNamespace(keys=SimpleNamespace(held=lambda _uuid: held))
    node: Any = SimpleNamespace(uuid=bytes(10), identity=SimpleNamespace(state=state))
    assert inspection.look(station, node) is found
    assert went == way.split()


@pytest.mark.parametrize(
    ("verdict", "kept", "again", "opens"),
    [
        ("unsigned", False, "", True),
        ("unsigned", True, "unsigned", True),
        ("unsigned", True, "not authentic", False),
        ("authentic", False, "", False),
        ("not authentic", False, "", False),
    ],
)
def test_an_unsigned_datasheet_counts_only_as_it_was_read_since_the_start_of_the_node(
    verdict: str, kept: bool, again: str, opens: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its Security TEDS names no digest of the others: one that was swapped since would calibrate the values."""
    before, now = (Image(bytes(10), {SECURITY: octets}) for octets in (b"before", b"now"))
    looked = SimpleNamespace(verified=SimpleNamespace(verdict=verdict), kept=kept, image=before)

    def require_authentic(verified: Any) -> None:
        raise NotAuthenticError(f"It is {verified.verdict}.")

    replaced: dict[str, Any] = {
        "require_measurable": lambda *_words: None,
        "require_session": lambda *_words: None,
        "verify_in_session": lambda *_words, **_more: looked,
        "read_image": lambda _node: now,
        "freshness_floor_of": lambda *_words: None,
        "keep": lambda *_words, **_more: SimpleNamespace(verified=SimpleNamespace(verdict=again)),
        "require_authentic": require_authentic,
    }
    for name, stands_for in replaced.items():
        monkeypatch.setattr(verified_session, name, stands_for)
    sheets: list[Image] = []
    monkeypatch.setattr(verified_session, "Sheet", SimpleNamespace(from_image=sheets.append))
    node: Any = SimpleNamespace(uuid=bytes(10), open_counter=3, proven=None)
    none: Any = None
    if not opens:
        with pytest.raises((NotAuthenticError, PolicyError)):
            open_unverified(none, node, by="ncap")
        return
    assert open_unverified(none, node, by="ncap").unverified
    assert sheets == [now if kept else before]


def strangers_reading(
    monkeypatch: pytest.MonkeyPatch, listed: list[tuple[int, int]], octets: int
) -> tuple[dict[tuple[int, int], float | None], dict[tuple[int, int], bytes]]:
    """Inspect a stranger with these TEDS of so many octets each; return what was read until when, and what is shown."""
    read: dict[tuple[int, int], float | None] = {}
    shown: dict[tuple[int, int], bytes] = {}

    def read_block(_node: Any, block: tuple[int, int], *, until: float | None = None) -> bytes:
        read[block] = until
        return bytes(octets)

    def from_image(image: Image) -> None:
        shown.update(image.blocks)

    clock = itertools.count(1000.0, 7.0)  # each look at the clock is seven seconds later
    monkeypatch.setattr(inspection, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    monkeypatch.setattr(inspection, "list_blocks", lambda _node: listed)
    monkeypatch.setattr(inspection, "read_block", read_block)
    monkeypatch.setattr(inspection, "is_keyed", lambda *_words: False)
    monkeypatch.setattr(inspection, "read_firmware", lambda _node, *, once: None)
    monkeypatch.setattr(inspection, "firmware_of", lambda *_words: None)
    monkeypatch.setattr(inspection, "freshness_floor_of", lambda *_words: None)
    monkeypatch.setattr(inspection, "verify_image", lambda *_words, floor: ())
    monkeypatch.setattr(inspection, "Sheet", SimpleNamespace(from_image=from_image))
    nobody: Any = None
    node: Any = SimpleNamespace(uuid=bytes(10))
    who: Any = SimpleNamespace(security_teds=b"read before")
    found = inspection._stranger(nobody, node, who)
    assert (found.judged.origin, found.power) == ("plain", None)
    return read, shown


def test_of_a_stranger_256_teds_are_read_within_a_minute_and_its_security_teds_not_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    listed = [SECURITY, *((channel, 3) for channel in range(1, 256)), (1, 5), (2, 5)]
    read, shown = strangers_reading(monkeypatch, listed, 12)
    assert list(read) == listed[1:256]
    assert set(read.values()) == {1060.0}
    assert set(shown) == set(listed[:256])
    assert shown[SECURITY] == b"read before"


def test_a_strangers_teds_of_more_than_65535_octets_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    _, shown = strangers_reading(monkeypatch, [(1, 3)], 65_535)
    assert len(shown[1, 3]) == 65_535
    with pytest.raises(BadDataError, match="TEDS 3 of channel 1 has 65536 octets: too long"):
        strangers_reading(monkeypatch, [(1, 3)], 65_536)


@pytest.mark.parametrize("verdict", ["authentic", "unsigned", "not authentic"])
def test_of_a_node_in_a_session_the_datasheet_is_shown_apart_only_if_it_is_not_authentic(
    verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = SimpleNamespace(verified=SimpleNamespace(verdict=verdict), judged="judged", image="image")
    none: Any = None
    monkeypatch.setattr(inspection, "session_if_keyed", lambda *_: None)
    assert inspection._in_session(none, none) is None
    assert inspection.read_anew(none, none) is None, "without a session nothing is read"
    monkeypatch.setattr(inspection, "session_if_keyed", lambda *_: object())
    monkeypatch.setattr(
        inspection, "verify_in_session", lambda _station, _node, *, by: looked if by == "ncap" else None
    )
    monkeypatch.setattr(inspection, "power_of", lambda _node: {"level": 80})
    monkeypatch.setattr(inspection.Sheet, "from_image", lambda image: f"sheet of {image}")
    found = inspection._in_session(none, none)
    assert found is not None
    shown = "sheet of image" if verdict == "not authentic" else None
    assert (found.judged, found.sheet, found.power) == ("judged", shown, {"level": 80})


def test_a_node_is_read_anew_in_its_session_and_that_reading_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    course: list[Any] = []
    node: Any = SimpleNamespace(uuid=bytes(10), open_counter=b"c")
    station: Any = SimpleNamespace(durable=lambda what: nullcontext(course.append(what)))
    monkeypatch.setattr(inspection, "session_if_keyed", lambda *_: object())
    monkeypatch.setattr(inspection, "read_identity", lambda _node: "identity")
    monkeypatch.setattr(inspection, "read_image", lambda _node: "image")
    monkeypatch.setattr(inspection, "freshness_floor_of", lambda *given: given[1:])
    monkeypatch.setattr(inspection, "keep", lambda *given, **how: (given[2], how))
    image, kept = inspection.read_anew(station, node) or (None, None)
    assert (image, course) == ("image", ["read"])
    assert kept == ("image", {"by": "ncap", "floor": (bytes(10), "identity"), "c": b"c"})
