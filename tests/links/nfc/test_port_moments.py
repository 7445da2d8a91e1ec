"""What a station does at a reader, and when (wire.md, "NFC" and "Repetition"). Reader, node and clock are mocks."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import GarbledError, LinkError, NodeSilentError, NoNodeError, NoReaderError
from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc import port as of_port
from teds_provision.links.nfc.message import NdefRecord
from teds_provision.links.nfc.port import ForeignTag, NfcLink, NfcPort, NodeInField, look
from teds_provision.links.nfc.tag import FieldLostError, ReaderLostError
from teds_provision.links.ports import Link, Notice
from teds_provision.protocol.messages.identity import Identity, NodeState

SILENT, TORN = NodeSilentError("It is silent."), GarbledError("It is torn.")
WANTED, OTHER = bytes(range(10)), bytes(range(10, 20))


def at_reader(uuid: bytes = WANTED, *, present: bool = True) -> NodeInField:
    """Return a node in the field; it still answers its reader if it is ``present``."""
    tag: Any = SimpleNamespace(is_present=present, uid=b"\4\1", kind="Type 4")
    return NodeInField(
        tag, tnep.ServiceParameters(tnep.SERVICE, 4, 15, 300), Identity(uuid, NodeState.KEYED, 1, 2, 512, 0)
    )


class Scene:
    """A reader that sees what is listed, poll after poll (the last for ever), and exchanges that end as listed."""

    again, name = "usb:1", "a reader"

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.takes = 100.0, 0.0
        self.sees: list[NodeInField | ForeignTag | LinkError | None] = [None]
        self.outcomes: list[bytes | LinkError] = []
        self.asked: list[tuple[int, bytes]] = []
        self.pollers, self.restarts, self.deselected = 0, 0, 0
        self.opened, self.closed = 0, 0
        self.refuses: list[LinkError] = []
        self.notices: list[tuple[float, str, str]] = []
        self.polls: list[float] = []
        self.stop_at = 1e9
        monkeypatch.setattr(of_port, "time", SimpleNamespace(monotonic=lambda: self.now, sleep=self.wait))
        events = SimpleNamespace(RLock=threading.RLock, Event=lambda: self)
        monkeypatch.setattr(of_port, "threading", events)
        monkeypatch.setattr(of_port, "open_reader", self._open)
        monkeypatch.setattr(of_port, "look", lambda tag: tag)
        monkeypatch.setattr(of_port, "Poller", self._poller)
        self.port = NfcPort("usb")

    # -- the reader

    def _open(self, path: str, trace: object) -> Scene:
        if self.refuses:
            raise self.refuses.pop(0)
        self.opened += 1
        return self

    def sense(self) -> object:
        self.polls.append(round(self.now - 100, 3))
        seen = self.sees.pop(0) if len(self.sees) > 1 else self.sees[0]
        if isinstance(seen, LinkError):
            raise seen
        return seen

    def close(self) -> None:
        self.closed += 1

    # -- the clock, and the caller's wish to stop

    def wait(self, seconds: float) -> bool:
        self.now += seconds
        return self.is_set()

    def is_set(self) -> bool:
        return self.now >= self.stop_at

    # -- the exchanges

    def _poller(self, tag: object, service: object) -> Scene:
        self.pollers += 1
        return self

    def transact(self, transaction: int, frame: bytes) -> bytes:
        self.asked.append((transaction, frame))
        self.now += self.takes
        outcome = self.outcomes.pop(0) if len(self.outcomes) > 1 else self.outcomes[0]
        if isinstance(outcome, LinkError):
            raise outcome
        return outcome

    def restart(self) -> None:
        self.restarts += 1

    def deselect(self) -> None:
        self.deselected += 1

    def link(self, visit: NodeInField | None = None) -> NfcLink:
        self.port._transaction = 0xFFFE
        return NfcLink(self.port, visit or at_reader(), self.note)

    def note(self, notice: Notice) -> None:
        self.notices.append((round(self.now - 100, 3), notice.kind, notice.text))

    @property
    def kinds(self) -> list[str]:
        return [kind for _, kind, _ in self.notices]


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    return Scene(monkeypatch)


# -- an exchange -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("failure", [SILENT, TORN], ids=["silent", "torn"])
@pytest.mark.parametrize(("takes", "tries"), [(0.0, 3), (5.0, 3), (7.5, 3), (7.6, 2), (15.1, 1)])
def test_a_frame_is_repeated_twice_at_most_within_15_s(
    scene: Scene, failure: LinkError, takes: float, tries: int
) -> None:
    scene.outcomes, scene.takes = [failure], takes
    with pytest.raises(type(failure)):
        scene.link().exchange(b"frame")
    assert scene.asked == [(0xFFFF, b"frame")] * tries, "the same octets under the same transaction"
    assert scene.kinds == ["retry"] * (tries - 1)
    assert all(text.endswith("Trying again.") for _, _, text in scene.notices)


def test_each_frame_has_its_own_transaction_and_one_that_is_sent_again_keeps_it(scene: Scene) -> None:
    scene.outcomes = [b"reply"]
    link = scene.link()
    assert link.exchange(b"one") == link.resend(b"one") == link.exchange(b"two") == b"reply"
    assert link.exchange(b"three") == link.resend(b"three") == b"reply"
    assert scene.asked == [(0xFFFF, b"one"), (0xFFFF, b"one"), (0, b"two"), (1, b"three"), (1, b"three")]


@pytest.mark.parametrize(
    ("failure", "present", "activations", "restarts"),
    [
        (SILENT, True, 1, 1),  # it answers its reader still: the service is selected again
        (TORN, True, 1, 1),
        (SILENT, False, 2, 0),
        (FieldLostError(), True, 2, 0),
    ],
)
def test_a_node_that_is_still_there_is_selected_again_and_another_activated_again(
    scene: Scene, failure: LinkError, present: bool, activations: int, restarts: int
) -> None:
    scene.outcomes, scene.sees = [failure, b"reply"], [None, FieldLostError(), at_reader()]
    link = scene.link(at_reader(present=present))
    assert link.exchange(b"frame") == b"reply"
    assert (scene.pollers, scene.restarts) == (activations, restarts)
    assert scene.polls == ([] if restarts else [0.0, 0.1, 0.2])
    assert not link.lost


def test_a_node_that_has_left_may_return_within_three_seconds(scene: Scene) -> None:
    scene.outcomes = [FieldLostError()]
    link = scene.link()
    with pytest.raises(FieldLostError):
        link.exchange(b"frame")
    assert link.lost
    assert len(scene.asked) == 1, "to nobody"
    gaps = [later - sooner for sooner, later in zip(scene.polls, scene.polls[1:], strict=False)]
    assert all(gap == pytest.approx(0.1) for gap in gaps)
    assert len([poll for poll in scene.polls if poll <= 3.0]) >= 30
    assert scene.kinds == ["retry"]


def test_a_frame_for_one_node_goes_to_no_other(scene: Scene) -> None:
    scene.outcomes, scene.sees = [FieldLostError(), b"reply"], [None, at_reader(OTHER)]
    with pytest.raises(NodeSilentError, match=OTHER.hex()) as removed:
        scene.link().exchange(b"frame")
    assert WANTED.hex() in (removed.value.hint or "")
    assert len(scene.asked) == 1


def test_a_reader_that_fails_once_is_opened_again_without_a_word_and_one_that_fails_twice_is_lost(
    scene: Scene,
) -> None:
    scene.sees = [at_reader()]
    scene.outcomes = [ReaderLostError("EIO"), b"reply"]
    assert scene.link().exchange(b"frame") == b"reply"
    assert (scene.closed, scene.opened, scene.notices) == (1, 2, [])
    scene.outcomes = [ReaderLostError("EIO")]
    with pytest.raises(ReaderLostError):
        scene.link().exchange(b"frame")
    assert len(scene.asked) == 4
    assert (scene.closed, scene.opened) == (3, 3)


def test_a_reader_that_is_gone_is_not_tried_again(scene: Scene) -> None:
    scene.sees = [at_reader()]
    scene.outcomes, scene.refuses = [ReaderLostError("EIO"), b"reply"], [NoReaderError("None.")]
    with pytest.raises(NoReaderError):
        scene.link().exchange(b"frame")
    assert len(scene.asked) == 1
    scene.outcomes = [NoReaderError("None."), b"reply"]
    with pytest.raises(NoReaderError):
        scene.link().exchange(b"frame")
    assert len(scene.asked) == 2
    assert scene.port._reader is None, "it was released"


def test_the_service_is_deselected_at_the_end_and_an_end_never_fails(scene: Scene) -> None:
    link = scene.link()
    link.close()
    assert scene.deselected == 1
    scene.deselect = lambda: (_ for _ in ()).throw(SILENT)  # type: ignore[method-assign]
    link.close()
    link.close()


# -- who is there ------------------------------------------------------------------------------------------------------


def is_wanted(identity: Identity) -> bool:
    return identity.uuid == WANTED


def test_others_are_named_once_and_waited_past(scene: Scene) -> None:
    foreign, other = ForeignTag(at_reader().tag, "A tag."), at_reader(OTHER)
    gone = ForeignTag(at_reader(present=False).tag, "Another tag.")
    scene.sees = [None, None, foreign, foreign, gone, other, other, at_reader()]
    contact = scene.port.find(is_wanted, seconds=60, notice=scene.note)
    assert contact.identity.uuid == WANTED
    assert [(kind, text) for _, kind, text in scene.notices] == [
        ("waiting", "Place the node on the reader."),
        ("foreign-tag", "A tag."),
        ("foreign-tag", "Another tag."),
        ("waiting", f"Node {OTHER.hex()} is not the one that is expected."),
    ]
    assert scene.polls[:3] == [0.0, 0.1, 0.2]
    waits = [later - sooner for sooner, later in zip(scene.polls[2:], scene.polls[3:], strict=False)]
    assert waits == pytest.approx([1.0, 1.0, 0.0, 1.0, 1.0], abs=0.04), "one that has left is not waited for"


@pytest.mark.parametrize(
    ("sees", "error", "text"),
    [
        (None, NoNodeError, "No node was placed on the reader within 2 s."),
        (at_reader(OTHER), NoNodeError, f"Node {OTHER.hex()} is on the reader, but another node was requested."),
        (ForeignTag(at_reader().tag, "A tag."), NoNodeError, "No node was placed on the reader within 2 s."),
        (ReaderLostError("EIO"), NoReaderError, "The reader was unplugged."),
    ],
)
def test_what_is_said_if_the_node_did_not_come(
    scene: Scene, sees: NodeInField | ForeignTag | LinkError | None, error: type[LinkError], text: str
) -> None:
    scene.sees = [sees]
    with pytest.raises(error) as failure:
        scene.port.find(is_wanted, seconds=2, notice=scene.note, address=0x21)
    assert failure.value.message == text
    assert failure.value.hint != ""
    if error is NoReaderError:
        assert failure.value.hint == "Plug it in again."
    assert 2.0 <= scene.now - 100 < 3.1


def watched(scene: Scene, seconds: float, serve: Callable[[Link], None] | None = None) -> list[float]:
    """Watch for so long; return when a visit began."""
    scene.stop_at, visits = 100 + seconds, []
    for contact in scene.port.watch(stop=cast("threading.Event", scene), notice=scene.note):
        visits.append((round(scene.now - 100, 2), contact.identity.uuid))
        if serve is not None:
            serve(contact.link)
    assert {uuid for _, uuid in visits} <= {WANTED, OTHER}
    return [at for at, _ in visits]


def test_a_node_that_is_back_within_700_ms_has_not_left(scene: Scene) -> None:
    here = at_reader(present=False)
    scene.sees = [here, *[None] * 20, here, *[None] * 30, here, None]
    visits = watched(scene, 6)
    assert len(visits) == 2
    assert scene.kinds[:4] == ["waiting", "node-left", "waiting", "node-left"]
    left = [at for at, kind, _ in scene.notices if kind == "node-left"]
    assert left[0] == pytest.approx(0.6 + 0.73, abs=0.05)
    assert len(left) == 2


def test_a_node_that_left_in_the_middle_of_an_exchange_is_a_new_visit_when_it_is_back(scene: Scene) -> None:
    scene.sees = [at_reader(), *[None] * 35, at_reader(), None]
    scene.outcomes = [FieldLostError(), b"reply"]

    def serve(link: Link) -> None:
        with suppress(FieldLostError):
            assert link.exchange(b"frame") == b"reply"

    assert len(watched(scene, 10, serve)) == 2
    assert scene.deselected == 1, "of a visit that ended well"
    assert scene.kinds == ["waiting", "retry", "node-left", "waiting"]


def test_the_field_is_polled_more_often_while_boards_are_changed(scene: Scene) -> None:
    scene.sees = [*[None] * 5, at_reader(present=False), None]
    watched(scene, 6)
    gaps = {at: round(later - at, 2) for at, later in zip(scene.polls, scene.polls[1:], strict=False)}
    assert {gap for at, gap in gaps.items() if 0.51 <= at < 2.4} == {0.03}
    assert {gap for at, gap in gaps.items() if at < 0.5 or at > 2.6} == {0.1}


def test_a_foreign_tag_is_named_again_after_a_node(scene: Scene) -> None:
    foreign = ForeignTag(at_reader().tag, "A tag.")
    scene.sees = [foreign, foreign, at_reader(present=False), foreign, None]
    watched(scene, 6)
    assert scene.kinds == ["waiting", "foreign-tag", "node-left", "waiting", "foreign-tag"]


def test_another_node_ends_the_visit_at_once(scene: Scene) -> None:
    scene.sees = [at_reader(present=False), at_reader(OTHER, present=False), None]
    assert len(watched(scene, 0.5)) == 2
    assert [text for _, kind, text in scene.notices if kind == "node-left"] == [
        f"Node {WANTED.hex()} was taken off the reader."
    ]


def test_a_reader_that_is_away_is_named_once_and_tried_each_second(scene: Scene) -> None:
    scene.sees = [ReaderLostError("EIO")]
    scene.refuses = [NoReaderError("None is there.")] * 3
    scene.port.close()
    scene.sees = [None]
    watched(scene, 4)
    assert [(at, kind) for at, kind, _ in scene.notices if kind.startswith("reader")] == [
        (0.1, "reader-lost"),
        (2.3, "reader-ready"),
    ], "the first failure is passed over"
    assert [text for _, kind, text in scene.notices if kind.startswith("reader")] == [
        "None is there. Waiting for it.",
        "The reader is back: a reader.",
    ]


# -- what an initial message shows -------------------------------------------------------------------------------------

IDENTITY = Identity(WANTED, NodeState.KEYED, 1, 2, 512, 0).encode()
SERVICE = tnep.ServiceParameters(tnep.SERVICE, 4, 15, 300).record()


@pytest.mark.parametrize(
    ("records", "text"),
    [
        ([], "It holds an empty NDEF message."),
        (
            [NdefRecord(1, b"U", b"\4x"), NdefRecord(4, b"example:x", b"")],
            "It holds the NDEF records urn:nfc:wkt:U (2 octets), urn:nfc:ext:example:x (0 octets).",
        ),
        ([tnep.id_record(IDENTITY)], "It holds the NDEF records urn:nfc:ext:teds-provision:id (23 octets)."),
        ([SERVICE], "It offers the service but gives no UUID (no id record)."),
        ([SERVICE, tnep.id_record(IDENTITY[:-1])], None),
        (None, None),
    ],
)
def test_a_tag_that_is_no_node_is_described_by_type_uid_and_records(
    records: list[NdefRecord] | None, text: str | None
) -> None:
    octets = b"\xd1torn" if records is None else message.encode(records)
    tag: Any = SimpleNamespace(kind="Type 2", uid=b"\4\xab\xcd", read=lambda: octets)
    seen = look(tag)
    assert isinstance(seen, ForeignTag)
    assert seen.text.startswith("This tag is not a node of this profile: Type 2, UID 04ABCD. ")
    assert text is None or seen.text.endswith(text)


def test_a_node_is_known_by_its_service_and_its_id_record() -> None:
    octets = message.encode([SERVICE, tnep.id_record(IDENTITY)])
    tag: Any = SimpleNamespace(kind="Type 4", uid=b"\4", read=lambda: octets)
    seen = look(tag)
    assert isinstance(seen, NodeInField)
    assert seen.identity.uuid == WANTED
    assert (seen.service.n_wait, seen.charging, seen.ble) == (15, None, None)


@pytest.mark.parametrize(
    ("sees", "remedy"),
    [
        (None, "Place the node's NFC antenna flat on the reader, or allow more time with --timeout."),
        (at_reader(OTHER), "Place the requested node on the reader, or name the one that is on it."),
    ],
)
def test_each_reason_why_a_node_did_not_come_has_its_remedy(
    scene: Scene, sees: NodeInField | None, remedy: str
) -> None:
    scene.sees = [sees]
    with pytest.raises(NoNodeError) as failure:
        scene.port.find(is_wanted, seconds=2, notice=scene.note)
    assert failure.value.hint == remedy
