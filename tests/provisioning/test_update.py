"""Firmware update: what an update proves before it keeps an image, what it refuses, and every way to be interrupted."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, cast

import cbor2
import pytest
from smp.exceptions import SMPException

from teds_provision.errors import (
    BoardLostError,
    DowngradeError,
    FrozenError,
    GarbledError,
    LinkClosedError,
    LinkError,
    NodeRefusedError,
    NodeSilentError,
    NotAuthenticError,
    NotFoundError,
    NoUpdateError,
    PolicyError,
    RevertedError,
    StoreError,
    TedsProvisionError,
    WrongImageError,
)
from teds_provision.firmware_image import FirmwareImage
from teds_provision.links import LinkSettings
from teds_provision.node import virtual
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.messages.firmware import FirmwareFlag, FirmwareReport
from teds_provision.protocol.messages.frames import Function, Reason, refusal, security_command
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.messages.smp import UPLOAD, SmpPacket, decode_packet
from teds_provision.protocol.session import NodeSession
from teds_provision.provisioning import image_manager, update
from teds_provision.provisioning.agree import reset_node
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.image_manager import BoardImage, ImageManager
from teds_provision.provisioning.parallel import ParallelWork
from teds_provision.provisioning.progress import SilentReporter, StepResult
from teds_provision.provisioning.update import UpdateOrder, plan_update, update_at
from teds_provision.station.firmware import firmware_of
from teds_provision.station.station import Station
from teds_provision.teds.codec.frame import frame, unframe
from teds_provision.teds.image import SECURITY
from tests.bench import PASSPHRASE

from .update_bench import BenchPort, Owner, StationKilledError, UpdateBench


@pytest.fixture(scope="module")
def owner(tmp_path_factory: pytest.TempPathFactory) -> Owner:
    return Owner(tmp_path_factory.mktemp("owner"))


@pytest.fixture
def bench(owner: Owner, tmp_path: Path) -> Iterator[UpdateBench]:
    bench = UpdateBench.copy_of(owner, tmp_path)
    yield bench
    bench.close()


def test_a_new_image_is_proven_kept_and_nothing_else_changes(bench: UpdateBench, owner: Owner) -> None:
    flash = bench.node.tim.flash
    done = bench.update(owner.new)
    assert (done.result, done.before, done.octets, done.error) == ("updated", "1.0.0", len(owner.new.octets), None)
    assert list(bench.details) == ["upload", "restart", "prove"]
    assert bench.details["upload"] == f"{len(owner.new.octets)} octets"
    assert bench.runs == ("1.1.0", False, False)
    assert bench.node.tim.flash == flash
    exchanges = bench.exchanges
    again = bench.update(owner.new)
    assert (again.result, again.octets) == ("already", 0)
    assert bench.exchanges - exchanges < 12
    assert [entry.outcome for entry in bench.station.audit_log.entries() if entry.act == "update"] == ["updated"]


def test_a_node_that_an_older_store_signed_shows_the_change_too(bench: UpdateBench, owner: Owner) -> None:
    bench.station.firmware_reports.forget(bench.uuid)
    assert bench.update(owner.new).result == "updated"
    known = firmware_of(bench.station, bench.uuid)
    assert known is not None
    assert known.changed
    bench.update(owner.old, allow_downgrade=True)
    known = firmware_of(bench.station, bench.uuid)
    assert known is not None
    assert not known.changed, "the image under which it was signed runs again"


def test_a_plan_waits_for_the_command_that_is_using_the_board(bench: UpdateBench, owner: Owner) -> None:
    waits = threading.Event()
    bench.station.notice = lambda _text: waits.set()
    bench.station.unlock()
    with bench.patched(), ThreadPoolExecutor(1) as pool:
        with bench.station.node_lock(bench.uuid):
            plan = pool.submit(
                plan_update,
                bench.station,
                LinkSettings("can", via_chosen=True),
                bench.uuid,
                UpdateOrder(owner.new),
                SilentReporter(),
            )
            assert waits.wait(60)
            assert bench.exchanges == 0, "it leaves the session of the other command alone"
        assert plan.result(60).stage == "upload"


@pytest.mark.parametrize(
    ("board", "refused"),
    [("other/board", True), (None, True), ("virtual", False), ("virtual/finger", False), ("finger", True)],
)
def test_an_image_for_another_board_needs_a_person(
    bench: UpdateBench, owner: Owner, board: str | None, refused: bool
) -> None:
    image = owner.image("1.1.1", counter=1, board=board)
    done = bench.update(image)
    assert (done.result, type(done.error)) == (("refused", WrongImageError) if refused else ("updated", type(None)))
    if refused:
        assert bench.runs == ("1.0.0", False, False)
        assert bench.update(image, other_board=True).result == "updated"


def test_an_older_image_needs_a_word_and_the_counter_may_still_stop_it(bench: UpdateBench, owner: Owner) -> None:
    assert bench.update(owner.image("2.0.0", counter=2)).result == "updated"
    older = owner.image("1.9.0", counter=2)
    done = bench.update(older)
    assert (done.result, type(done.error), done.octets) == ("refused", DowngradeError, 0)
    assert bench.update(older, allow_downgrade=True).result == "updated"
    done = bench.update(owner.image("1.8.0", counter=1), allow_downgrade=True)
    assert (done.result, type(done.error)) == ("reverted", RevertedError)
    assert bench.runs == ("1.9.0", False, False)


def test_another_image_of_the_same_version_is_none_to_go_back_to(bench: UpdateBench, owner: Owner) -> None:
    assert bench.update(owner.image("1.0.0", counter=1, octets=700)).result == "updated"


@pytest.mark.parametrize(("passed_over", "result"), [(1, "updated"), (9, "refused")])
def test_a_board_that_did_not_restart_is_asked_once_more(
    bench: UpdateBench, owner: Owner, monkeypatch: pytest.MonkeyPatch, passed_over: int, result: str
) -> None:
    monkeypatch.setattr(update, "_RESTART_SECONDS", 0.01)
    restart, asked = ImageManager.restart, list[ImageManager]()

    def maybe(manager: ImageManager) -> None:
        asked.append(manager)
        if len(asked) > passed_over:
            restart(manager)

    monkeypatch.setattr(ImageManager, "restart", maybe)
    done = bench.update(owner.new)
    assert (done.result, len(asked)) == (result, 2), "c of its sessions shows that it is the same start"
    assert result == "updated" or "does not restart" in str(done.error)


def test_another_owners_image_never_starts(bench: UpdateBench, owner: Owner) -> None:
    done = bench.update(owner.image("6.0.0", owner.rival, counter=9))
    assert (done.result, type(done.error)) == ("reverted", RevertedError)
    assert "owner's key" in done.error.hint if done.error else False
    assert bench.runs == ("1.0.0", False, False)
    assert bench.update(owner.new).result == "updated"


def test_another_image_on_trial_or_pending_is_left_alone(bench: UpdateBench, owner: Owner) -> None:
    other = owner.image("1.0.5", counter=1)
    slots = bench.node._slots
    assert slots is not None
    slots.write(0, other.octets)
    assert slots.start_next(other.digest)
    done = bench.update(owner.new)
    assert (done.result, type(done.error)) == ("refused", PolicyError)
    bench.node.restart()
    assert bench.runs == ("1.0.5", True, False)
    done = bench.update(owner.new)
    assert (done.result, type(done.error)) == ("refused", PolicyError)
    assert bench.runs == ("1.0.5", True, False)
    assert bench.update(other).result == "updated", "the update that it belongs to goes on"


def test_a_board_on_trial_is_not_decommissioned_before_it_has_ended(bench: UpdateBench, owner: Owner) -> None:
    """It could forget its key under one image and have it again under the other."""
    slots = bench.node._slots
    assert slots is not None
    slots.write(0, owner.new.octets)
    assert slots.start_next(owner.new.digest)
    bench.node.restart()
    assert bench.runs == ("1.1.0", True, False)
    flash = bench.node.tim.flash
    bench.station.unlock()

    def reset() -> None:
        with Conversation(bench.contact(), notice=lambda _notice: None) as node:
            reset_node(bench.station, node, identify(bench.station, node))

    with pytest.raises(NodeRefusedError) as refused:
        reset()
    assert refused.value.reason == Reason.BUSY
    assert bench.node.tim.flash == flash
    assert bench.station.keys.held(bench.uuid)
    bench.node.restart()
    assert bench.runs == ("1.0.0", False, False)
    reset()
    assert bench.node.in_factory_state()
    assert bench.station.firmware_reports.get(bench.uuid) is None, "the next owner's board is another one"


def test_a_button_on_trial_ends_the_trial_before_it_resets(bench: UpdateBench, owner: Owner) -> None:
    """An image on trial changes nothing stored; the one that was kept does."""
    slots = bench.node._slots
    assert slots is not None
    slots.write(0, owner.new.octets)
    slots.flush()
    assert slots.start_next(owner.new.digest)
    bench.node.restart()
    assert bench.runs == (owner.new.version_text, True, False)
    bench.node.reset_by_hand()
    assert bench.runs == (owner.old.version_text, False, False)
    assert bench.node.in_factory_state()


def test_a_board_that_never_returns_is_lost_and_the_same_call_goes_on_later(bench: UpdateBench, owner: Owner) -> None:
    bench.node.when_restarted(lambda: setattr(bench, "present", False))
    done = bench.update(owner.new, wait=0.5)
    assert (done.result, type(done.error)) == ("lost", BoardLostError)
    bench.present = True
    assert bench.runs == ("1.1.0", True, False)
    assert bench.update(owner.new).result == "updated"
    assert bench.runs == ("1.1.0", False, False)


def test_a_board_that_lost_power_on_trial_runs_its_old_image_and_takes_the_new_one_again(
    bench: UpdateBench, owner: Owner
) -> None:
    bench.node.when_restarted(bench.power_on)
    done = bench.update(owner.new)
    assert (done.result, type(done.error)) == ("reverted", RevertedError)
    assert bench.runs == ("1.0.0", False, False)
    done = bench.update(owner.new)
    assert (done.result, done.octets) == ("updated", 0), "the image is in the other slot already"
    assert bench.details["upload"] == "already on the board"


@pytest.mark.parametrize(
    ("sabotage", "why"),
    [
        ("datasheet", "shows another datasheet"),
        ("key", "cannot prove that it holds the key"),
        ("values", "gives a valid value"),
        ("sequence", "lost key, epoch or sequence"),
        ("epoch", "lost key, epoch or sequence"),
        ("confirms nothing", "did not keep the new image"),
        ("confirms itself", "confirmed itself before it was proven"),
    ],
)
def test_an_image_that_does_not_prove_itself_is_reverted(
    bench: UpdateBench, owner: Owner, sabotage: str, why: str
) -> None:
    node, flash, key = bench.node, bench.node.tim.flash, bench.node.tim.key
    board, slots = node.board, node._slots
    assert board is not None
    assert slots is not None
    read, confirm = board.read, slots.confirm

    def spoil() -> None:
        """Do what the new image does wrong, and undo it when the old one runs."""
        new = slots.running.version_text == "1.1.0"
        if sabotage == "datasheet":
            other = {**flash.blocks, SECURITY: flash.blocks[SECURITY][:-2] + b"xx"}
            node.tim._flash = replace(flash, blocks=other) if new else flash
        elif sabotage in ("sequence", "epoch"):
            less: dict[str, Any] = {sabotage: 0}
            node.tim._flash = replace(flash, **less) if new else flash
        elif sabotage == "confirms nothing":
            slots.confirm = (lambda: True) if new else confirm  # type: ignore[method-assign, assignment]
        elif sabotage == "key":
            node.tim.key = SoftwareKey.generate() if new else key
        elif sabotage == "values":
            mute = lambda channel, tick: (read(channel, tick)[0], False)  # noqa: E731
            board.read = mute if new else read  # type: ignore[method-assign]
        elif new:
            slots.confirm()

    bench.node.when_restarted(spoil)
    done = bench.update(owner.new)
    assert why in str(done.error)
    if sabotage == "confirms itself":
        assert (done.result, type(done.error)) == ("refused", PolicyError)
        assert "keeps the new image" in str(done.error)
        return
    assert (done.result, type(done.error)) == ("reverted", RevertedError)
    assert bench.runs == ("1.0.0", False, False)


def test_a_resumed_update_compares_the_datasheet_with_the_one_of_the_store(bench: UpdateBench, owner: Owner) -> None:
    """The station was killed as the board restarted: what the new image shows now was never seen under the old one."""
    node, flash, slots = bench.node, bench.node.tim.flash, bench.node._slots
    assert slots is not None
    body = unframe(flash.blocks[SECURITY])
    other = {**flash.blocks, SECURITY: frame(body[:-1] + bytes([body[-1] ^ 1]))}  # it can be read as well

    def spoil() -> None:
        node.tim._flash = replace(flash, blocks=other) if slots.running.version_text == "1.1.0" else flash

    def cut(_number: int) -> None:
        if slots.running.version_text == "1.1.0":
            raise StationKilledError

    bench.node.when_restarted(spoil)
    bench.cut = cut
    with pytest.raises(StationKilledError):
        bench.update(owner.new)
    assert bench.runs == ("1.1.0", True, False)
    bench.cut = lambda _number: None
    done = bench.update(owner.new)
    assert (done.result, type(done.error)) == ("reverted", RevertedError)
    assert "shows another datasheet" in str(done.error)
    assert bench.runs == ("1.0.0", False, False)


# -- interruptions: at every exchange, at either end, before and after it ----------------------------------------------


def _request_lost(bench: UpdateBench, at: int) -> None:
    def cut(number: int) -> None:
        if number == at:
            raise NodeSilentError("The request was lost.")

    bench.cut = cut


def _reply_lost(bench: UpdateBench, at: int) -> None:
    def answered(number: int) -> None:
        if number == at:
            raise NodeSilentError("The reply was lost.")

    bench.answered = answered


def _station_killed(bench: UpdateBench, at: int) -> None:
    def cut(number: int) -> None:
        if number == at:
            raise StationKilledError

    bench.cut = cut


def _station_killed_after(bench: UpdateBench, at: int) -> None:
    def answered(number: int) -> None:
        if number == at:
            raise StationKilledError

    bench.answered = answered


def _node_off(bench: UpdateBench, at: int) -> None:
    def cut(number: int) -> None:
        if number == at:
            bench.power_on()

    bench.cut = cut


def _node_off_after(bench: UpdateBench, at: int) -> None:
    def answered(number: int) -> None:
        if number == at:
            bench.power_on()
            raise NodeSilentError("The board lost power with its reply.")

    bench.answered = answered


INTERRUPTIONS = (
    _request_lost,
    _reply_lost,
    _station_killed,
    _station_killed_after,
    _node_off,
    _node_off_after,
)
LATER = (_reply_lost, _station_killed_after, _node_off_after)
"""Those after the node's answer, which the loop of ``make quick`` leaves to the gate."""


def exchanges_of(owner: Owner, folder: Path) -> int:
    """Return how many exchanges an update without interruption takes."""
    bench = UpdateBench.copy_of(owner, folder)
    assert bench.update(owner.long).result == "updated"
    bench.close()
    return bench.exchanges


def interrupted(owner: Owner, folder: Path, interruption: Callable[[UpdateBench, int], None], at: int) -> None:
    """Interrupt an update, look at what is left, and run the same call again until it ends well."""
    bench = UpdateBench.copy_of(owner, folder)
    flash, old, new = bench.node.tim.flash, "1.0.0", owner.long
    interruption(bench, at)
    first = "killed"
    with suppress(StationKilledError):
        first = bench.update(new, wait=2.0).result
    bench.cut = bench.answered = lambda number: None
    assert bench.node.tim.flash == flash, "key, datasheet, address, epoch and sequence"
    assert bench.runs[0] in (old, new.version_text)
    assert first != "updated" or bench.runs == (new.version_text, False, False)
    bench.station.close()
    bench.station = Station.open(folder / "home", ask=lambda prompt, confirm: PASSPHRASE)
    again = [bench.update(new, wait=2.0)]
    if again[0].result == "reverted":  # power failed on trial, and nothing had been reported
        again.append(bench.update(new, wait=2.0))
    assert again[-1].result in ("updated", "already"), (again, first)
    assert bench.runs == (new.version_text, False, False)
    assert bench.node.tim.flash == flash
    bench.node.restart()
    assert bench.runs == (new.version_text, False, False), "it stays over a restart"
    bench.close()


@pytest.mark.parametrize(
    "interruption",
    [pytest.param(how, marks=pytest.mark.slow if how in LATER else ()) for how in INTERRUPTIONS],
    ids=lambda how: how.__name__.strip("_"),
)
def test_an_update_that_is_interrupted_resumes(
    owner: Owner, tmp_path: Path, interruption: Callable[[UpdateBench, int], None]
) -> None:
    last = exchanges_of(owner, tmp_path)
    for at in range(2 + INTERRUPTIONS.index(interruption), last + 1, 9):
        interrupted(owner, tmp_path / str(at), interruption, at)


@pytest.mark.soak
@pytest.mark.parametrize("interruption", INTERRUPTIONS, ids=lambda how: how.__name__.strip("_"))
def test_an_update_resumes_after_an_interruption_at_any_exchange(
    owner: Owner, tmp_path: Path, interruption: Callable[[UpdateBench, int], None]
) -> None:
    for at in range(1, exchanges_of(owner, tmp_path) + 1):
        interrupted(owner, tmp_path / str(at), interruption, at)


def test_losses_count_from_the_last_piece_that_arrived(monkeypatch: pytest.MonkeyPatch) -> None:
    """A long upload on a bad bus loses more in all than one piece may."""
    sent = iter(range(30))

    def once(self: ImageManager, octets: bytes) -> Iterator[tuple[int, int]]:
        for _ in range(2):
            if (at := next(sent, None)) is None:
                return
            yield 1, at + 1
        raise NodeSilentError("A frame is lost.")

    monkeypatch.setattr(ImageManager, "_upload_once", once)
    node: Any = SimpleNamespace(identity=SimpleNamespace(max_message=1000), is_alive=lambda: True, reopen=lambda: None)
    monkeypatch.setattr(image_manager, "_LOSSES", 3)
    assert ImageManager(node).upload(bytes(30), lambda done, of: None) == 30


@pytest.mark.parametrize(("taken", "most", "good"), [(1, 3, True), (1, 4, False), (0, 2, True), (0, 3, False)])
def test_only_a_piece_that_the_board_took_ends_the_count_of_losses(
    monkeypatch: pytest.MonkeyPatch, taken: int, most: int, good: bool
) -> None:
    """One loss, what the board then has, and as many losses as ``most``, of which three in a row are borne."""
    course: list[Any] = [None, (taken, 20), *[None] * most, (1, 30)]
    shown: list[tuple[int, int]] = []

    def once(self: ImageManager, octets: bytes) -> Iterator[tuple[int, int]]:
        while course:
            if (now := course.pop(0)) is None:
                raise NodeSilentError("A frame is lost.")
            yield now

    monkeypatch.setattr(ImageManager, "_upload_once", once)
    monkeypatch.setattr(image_manager, "_LOSSES", 3)
    manager, _ = a_manager()
    if good:
        assert manager.upload(bytes(30), lambda done, of: shown.append((done, of))) == taken + 1
        assert shown == [(20, 30), (30, 30)]
    else:
        with pytest.raises(NodeSilentError):
            manager.upload(bytes(30), lambda done, of: None)


# -- hostile boards and a hostile bus ----------------------------------------------------------------------------------


class HostileBoard:
    """A board whose replies to uploads a test replaces, past the filter; all else is the real one's."""

    def __init__(self, bench: UpdateBench, reply: Callable[[SmpPacket, int], bytes]) -> None:
        manage = bench.node.tim._manage
        assert manage is not None
        self._run, self._reply, self.uploads = manage.run, reply, 0
        manage.run = self.run  # type: ignore[method-assign]

    def run(self, octets: bytes, session: NodeSession, link: str) -> bytes:
        packet = decode_packet(octets)
        if packet.command != UPLOAD:
            return self._run(octets, session, link)
        self.uploads += 1
        assert self.uploads < 50, "the station follows a board that never takes the image"
        return self._reply(packet, self.uploads)


def reply_with(**values: object) -> Callable[[SmpPacket, int], bytes]:
    return lambda packet, number: packet.reply(cbor2.dumps(values)).encode()


HOSTILE: dict[str, tuple[Callable[[SmpPacket, int], bytes], type[Exception], int]] = {
    "an offset that never moves": (reply_with(off=0), NotAuthenticError, 3),
    "an offset that goes to and fro": (
        lambda packet, number: packet.reply(cbor2.dumps({"off": 100 + number % 2})).encode(),
        NotAuthenticError,
        5,
    ),
    "an offset beyond the image": (reply_with(off=10**6), NotAuthenticError, 1),
    "a negative offset": (reply_with(off=-1), NotAuthenticError, 1),
    "no offset": (reply_with(), NotAuthenticError, 1),
    "an offset that is text": (reply_with(off="9"), NotAuthenticError, 1),
    "a CBOR tag": (
        lambda packet, number: packet.reply(bytes.fromhex("a1636f6666c24101")).encode(),
        NotAuthenticError,
        1,
    ),
    "a floating number": (reply_with(off=1.5), NotAuthenticError, 1),
    "something after the map": (lambda packet, number: packet.reply(b"\xa0\xa0").encode(), NotAuthenticError, 1),
    "no map": (lambda packet, number: packet.reply(b"\xff").encode(), NotAuthenticError, 1),
    "half a packet": (lambda packet, number: packet.reply(b"\xa0").encode()[:5], NotAuthenticError, 1),
    "the reply to another request": (
        lambda packet, number: packet._replace(sequence=packet.sequence ^ 1).reply(b"\xa1\x63off\x05").encode(),
        NotAuthenticError,
        1,
    ),
    "the reply to another command": (
        lambda packet, number: (
            packet._replace(command=packet.command._replace(number=0)).reply(b"\xa1\x63off\x05").encode()
        ),
        NotAuthenticError,
        1,
    ),
    "the reply of another group": (
        lambda packet, number: (
            packet._replace(command=packet.command._replace(group=0)).reply(b"\xa1\x63off\x05").encode()
        ),
        NotAuthenticError,
        1,
    ),
    "its own request": (lambda packet, number: packet._replace(body=b"\xa1\x63off\x05").encode(), NotAuthenticError, 1),
    "a length that is wrong": (
        lambda packet, number: (
            packet.reply(b"\xa1\x63off\x05").encode()[:3]
            + b"\x05"
            + b"\0\1"
            + bytes([packet.sequence, 1])
            + b"\xa1\x63off\x05"
        ),
        NotAuthenticError,
        1,
    ),
    "flags": (lambda packet, number: b"\3\1" + packet.reply(b"\xa1\x63off\x05").encode()[2:], NotAuthenticError, 1),
    "other octets than were sent": (reply_with(off=9728, match=False), NotAuthenticError, 1),
    "SMP's error of version 1": (reply_with(rc=8), PolicyError, 1),
    "SMP's error of version 2": (reply_with(err={"group": 1, "rc": 30}), PolicyError, 1),
    "an error that nobody knows": (reply_with(err={"group": 1, "rc": 250}), PolicyError, 1),
}


@pytest.mark.parametrize("hostile", HOSTILE)
def test_a_board_that_answers_nonsense_ends_the_update_soon(bench: UpdateBench, owner: Owner, hostile: str) -> None:
    reply, error, most = HOSTILE[hostile]
    board = HostileBoard(bench, reply)
    image = owner.long
    if hostile == "other octets than were sent":
        board._reply = reply_with(off=len(image.octets), match=False)
    done = bench.update(image)
    assert (done.result, type(done.error)) == ("refused", error), done.error
    assert board.uploads <= most
    assert bench.runs == ("1.0.0", False, False)


@pytest.mark.parametrize("more", [1, 10**6])
def test_a_board_that_has_more_octets_than_were_sent_has_not_taken_the_image(
    bench: UpdateBench, owner: Owner, more: int
) -> None:
    length = len(owner.long.octets)
    HostileBoard(bench, reply_with(off=length + more))
    done = bench.update(owner.long)
    assert isinstance(done.error, NotAuthenticError)
    assert done.error.message == (f"The board reports {length + more} of {length} octets received, which cannot be.")


@pytest.mark.parametrize("octet", [3, 12, -1])
def test_a_bus_that_alters_replies_decides_nothing(owner: Owner, tmp_path: Path, octet: int) -> None:
    """Each seventh exchange has one octet of its reply changed; what is sealed then opens no more."""
    for at in range(3, 40, 7):
        bench = UpdateBench.copy_of(owner, tmp_path / str(at))
        flash = bench.node.tim.flash

        def changed(_request: bytes, reply: bytes, bench: UpdateBench = bench, at: int = at) -> bytes:
            if bench.exchanges != at or len(reply) < 13:
                return reply
            wrong = bytearray(reply)
            wrong[octet] ^= 0x40
            return bytes(wrong)

        bench.changed = changed
        done = bench.update(owner.new, wait=2.0)
        assert bench.node.tim.flash == flash
        assert done.result != "updated" or bench.runs == ("1.1.0", False, False)
        bench.changed = lambda request, reply: reply
        again = bench.update(owner.new, wait=2.0)
        assert again.result in ("updated", "already"), (at, done, again)
        bench.close()


def test_a_recorded_update_cannot_be_played_again_and_without_the_key_there_is_none(
    bench: UpdateBench, owner: Owner
) -> None:
    frames: list[bytes] = []

    def record(request: bytes, reply: bytes) -> bytes:
        frames.append(request)
        return reply

    bench.changed = record
    assert bench.update(owner.new).result == "updated"
    assert bench.update(owner.old, allow_downgrade=True).result == "updated"
    before = bench.runs
    for recorded in frames:
        if recorded[3] in (Function.SEALED, Function.OPEN):
            bench.node.request("can:f1", recorded, tapped=False)
    plain = security_command(Function.MANAGE, bytes.fromhex("0a00000100000705a0"))
    assert bench.node.request("can:f2", plain.encode(), tapped=False) == refusal(Reason.NOT_PERMITTED).encode()
    assert bench.runs == before
    assert before[0] == "1.0.0"


def test_a_board_that_is_asked_once_more_has_its_three_seconds_again(
    bench: UpdateBench, owner: Owner, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, asked, looks = [0.0], list[float](), list[float]()
    restart, same = ImageManager.restart, update._same_power_up

    def later(_seconds: float) -> None:
        now[0] += 1.0

    def maybe(manager: ImageManager) -> None:
        asked.append(now[0])
        if len(asked) > 1:
            restart(manager)

    def shown(before: bytes | None, after: bytes | None) -> bool:
        looks.append(now[0])
        return now[0] < 5.0 or same(before, after)

    monkeypatch.setattr(update, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=later))
    monkeypatch.setattr(update, "_same_power_up", shown)
    monkeypatch.setattr(ImageManager, "restart", maybe)
    assert bench.update(owner.new, wait=60.0).result == "updated"
    assert (asked, looks) == ([0.0, 3.0], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0])


@pytest.mark.parametrize(("ends", "logged"), [(False, ["lost"]), (True, [])])
def test_a_board_whose_update_is_cut_by_the_end_of_the_service_is_not_lost(
    bench: UpdateBench, owner: Owner, ends: bool, logged: list[str]
) -> None:
    """Whatever the error is that ends it then: the service goes on with the board at its next start."""
    bench.station.unlock()
    bench.present = False
    port: Any = BenchPort(bench)
    order = UpdateOrder(owner.new, wait=5.0)
    done = update_at(bench.station, port, bench.uuid, order, SilentReporter(), timeout=1.0, is_ending=lambda: ends)
    assert done.result == "lost"
    assert [entry.outcome for entry in bench.station.audit_log.entries() if entry.act == "update"] == logged


class KeptTimer:
    """Stands for a timer; a test lets its time pass."""

    made: ClassVar[list[KeptTimer]] = []

    def __init__(self, seconds: float, work: Callable[[], None]) -> None:
        self.seconds, self.work, self.started = seconds, work, False
        self.made.append(self)

    def start(self) -> None:
        self.started = True


@pytest.mark.parametrize(
    ("confirmed", "runs"), [(False, "1.0.0"), (True, "1.1.0")], ids=["nobody confirms", "it is confirmed"]
)
def test_a_trial_that_nobody_confirms_ends_after_ten_minutes(
    bench: UpdateBench, owner: Owner, monkeypatch: pytest.MonkeyPatch, *, confirmed: bool, runs: str
) -> None:
    monkeypatch.setattr(KeptTimer, "made", [])
    monkeypatch.setattr(virtual, "threading", SimpleNamespace(Timer=KeptTimer))
    slots = bench.node._slots
    assert slots is not None
    bench.node.restart()
    assert KeptTimer.made == [], "its image is confirmed"
    slots.write(0, owner.new.octets)
    slots.flush()
    slots.start_next(owner.new.digest)
    bench.node.restart()
    (timer,) = KeptTimer.made
    assert (timer.seconds, timer.started, slots.running.version_text, slots.on_trial) == (600.0, True, "1.1.0", True)
    if confirmed:
        slots.confirm()
    timer.work()
    assert (slots.running.version_text, slots.on_trial, len(KeptTimer.made)) == (runs, False, 1)


def test_the_time_of_one_trial_ends_no_later_one(
    bench: UpdateBench, owner: Owner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(KeptTimer, "made", [])
    monkeypatch.setattr(virtual, "threading", SimpleNamespace(Timer=KeptTimer))
    slots, restarts = bench.node._slots, list[str]()
    assert slots is not None
    slots.write(0, owner.new.octets)
    slots.flush()
    for _ in range(2):
        slots.start_next(owner.new.digest)
        bench.node.restart()
        bench.node.restart()
    slots.start_next(owner.new.digest)
    bench.node.restart()
    bench.node.when_restarted(lambda: restarts.append(slots.running.version_text))
    first, second, third = KeptTimer.made
    first.work()
    second.work()
    assert (restarts, slots.on_trial) == ([], True)
    third.work()
    assert (restarts, slots.on_trial) == (["1.0.0"], False)


# -- what a look at a board decides ------------------------------------------------------------------------------------

RUNS, NEWER = bytes([1]) * 32, bytes([2]) * 32


@pytest.mark.parametrize(
    ("state", "refused"),
    [(1, False), (1 | 2, True), (1 | 4, True), (2, False), (4, False), (1 | 16 | 32, False)],
    ids=["free", "claimed here", "claimed by another", "a sensor here", "a sensor by another", "stopped"],
)
def test_only_a_claimed_actuator_keeps_an_update_out(state: int, refused: bool) -> None:
    node: Any = SimpleNamespace(request_idempotent=lambda _command, _doing: bytes([1, 1, 0, 0, 7, state, 0xF2]))
    if not refused:
        update.require_free_actuators(node)
        return
    with pytest.raises(PolicyError, match="Actuator 7 of the board is in use"):
        update.require_free_actuators(node)


def look_at(
    monkeypatch: pytest.MonkeyPatch, image: Any, report: FirmwareReport, *, images: Any = (), **order: bool
) -> tuple[Any, list[str]]:
    """Return what an update of such a board would do, and whose actuators were asked for."""
    asked: list[str] = []
    monkeypatch.setattr(update, "read_about", lambda _node: report)
    monkeypatch.setattr(update, "require_free_actuators", lambda _node: asked.append("actuators"))
    monkeypatch.setattr(update, "ImageManager", lambda _node: SimpleNamespace(images=lambda: list(images)))
    station: Any = SimpleNamespace(measurements=SimpleNamespace(holder=lambda _uuid: "crane"))
    link = SimpleNamespace(capabilities=SimpleNamespace(octets_a_second=500))
    node: Any = SimpleNamespace(contact=SimpleNamespace(link=link))
    return update._Look(station, bytes(10), UpdateOrder(image, **order)).planned(node), asked


def image_of(digest: bytes, version: tuple[int, int, int, int] = (1, 2, 3, 45), board: str | None = "b/app") -> Any:
    return FirmwareImage(bytes(1000), version, digest, board, None, 32)


def reported(digest: bytes = RUNS, *flags: FirmwareFlag, build: int = 44) -> FirmwareReport:
    whole = FirmwareFlag.MANAGE
    for flag in flags:
        whole |= flag
    return FirmwareReport("b/app", (1, 2, 3), build, digest, whole)


@pytest.mark.parametrize(
    ("digest", "flag", "stage", "octets", "seconds", "interrupts", "actuators"),
    [
        (RUNS, None, "upload", 1000, 2.0, ("crane",), ["actuators"]),
        (RUNS, FirmwareFlag.PENDING, "restart", 0, 0.0, ("crane",), ["actuators"]),
        (NEWER, FirmwareFlag.ON_TRIAL, "prove", 0, 0.0, ("crane",), []),
        (NEWER, None, "nothing", 0, 0.0, (), []),
    ],
    ids=["upload", "restart", "prove", "nothing"],
)
def test_what_a_plan_says_of_each_first_step(
    digest: bytes,
    flag: FirmwareFlag | None,
    stage: str,
    octets: int,
    seconds: float,
    interrupts: tuple[str, ...],
    actuators: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    report = reported(digest, *([] if flag is None else [flag]))
    images = [BoardImage(NEWER, running=False, confirmed=False, pending=True)]
    for board, question in (
        ("b/app", ""),
        ("b", ""),
        ("c", "The image names the board 'c'; this board is 'b/app'."),
        (None, "The image does not name its board; this board is 'b/app'."),
    ):
        plan, asked = look_at(monkeypatch, image_of(NEWER, board=board), report, images=images)
        assert (plan.stage, plan.octets, plan.seconds, plan.interrupts) == (stage, octets, seconds, interrupts)
        assert plan.question == ("" if stage == "nothing" else question)
        assert asked == actuators


@pytest.mark.parametrize(
    ("version", "older"),
    [
        ((1, 2, 3, 44), False),
        ((1, 2, 3, 45), False),
        ((1, 2, 3, 43), True),
        ((1, 2, 2, 99), True),
        ((0, 9, 9, 9), True),
    ],
)
def test_a_lower_build_is_an_older_version_too(
    version: tuple[int, int, int, int], older: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = image_of(NEWER, version)
    if older:
        with pytest.raises(DowngradeError):
            look_at(monkeypatch, image, reported())
    assert look_at(monkeypatch, image, reported(), allow_downgrade=older)[0].stage == "upload"


@pytest.mark.parametrize(
    "images",
    [
        [],
        [BoardImage(NEWER, running=False, confirmed=False, pending=False)],
        [BoardImage(RUNS, running=False, confirmed=False, pending=True)],
        [
            BoardImage(NEWER, running=False, confirmed=False, pending=False),
            BoardImage(RUNS, running=True, confirmed=True, pending=True),
        ],
    ],
    ids=["none", "it is there and does not start", "another one starts", "another one than the one that is there"],
)
def test_only_the_very_image_that_starts_next_is_gone_on_with(
    images: list[BoardImage], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(PolicyError, match="Another image starts at the next restart"):
        look_at(monkeypatch, image_of(NEWER), reported(RUNS, FirmwareFlag.PENDING), images=images)


@pytest.mark.parametrize(
    ("outcome", "result", "logged"),
    [
        ("updated", "updated", True),
        ("already", "already", False),
        (RevertedError("It was reverted."), "reverted", True),
        (PolicyError("It is refused."), "refused", True),
        (NodeRefusedError("It is busy.", reason=17), "refused", True),
        (SessionLostError(NodeSilentError("It is silent.")), "lost", True),
        (LinkClosedError("The bus was closed."), "lost", False),
    ],
    ids=str,
)
@pytest.mark.parametrize("ending", [False, True])
def test_how_an_update_ends_is_in_the_log_unless_it_goes_on_later(
    outcome: Any, result: str, logged: bool, ending: bool
) -> None:
    """A log that cannot be written hides nothing."""
    log: list[tuple[object, ...]] = []

    def audit(*words: object, **facts: object) -> None:
        log.append((*words, facts["to"], facts.get("why")))
        raise StoreError("The disk is full.")

    def run(*, released: bool) -> Any:
        assert released
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    none: Any = None
    station: Any = SimpleNamespace(
        node_lock=lambda _uuid: nullcontext(), released=lambda _uuid, _why: nullcontext(True), audit=audit
    )
    made = update._Update(
        station, none, 1.0, bytes(10), UpdateOrder(image_of(NEWER)), SilentReporter(), None, lambda: ending
    )
    made._run = run  # type: ignore[method-assign,assignment]
    done = made.run()
    assert done.result == result
    cause = getattr(outcome, "cause", outcome)
    assert done.error is (cause if isinstance(outcome, Exception) else None)
    why = getattr(cause, "message", None)
    due = logged and not (ending and done.error is not None)
    assert log == ([("update", bytes(10), result, "1.2.3+45", why)] if due else [])


@pytest.mark.parametrize(
    ("before", "after", "same"),
    [
        (5, 5, True),
        (5, 6, True),
        (5, 5 + 2**32 - 1, True),
        (5, 5 + 2**32, False),
        (5, 4, False),
        (2**64 - 1, 0, True),
        (2**64 - 1, 2**32, False),
        (None, 5, False),
        (5, None, False),
    ],
)
def test_a_board_has_restarted_if_c_of_open_moved_by_2_to_the_32_or_more(
    before: int | None, after: int | None, same: bool
) -> None:
    def octets(c: int | None) -> bytes | None:
        return None if c is None else c.to_bytes(8, "big")

    assert update._same_power_up(octets(before), octets(after)) is same


# -- where boards are met, how many at a time, and who else has them ---------------------------------------------------


class _Ports:
    """Ports that are opened one after the other; ``done`` has each step of an update of boards in its order."""

    def __init__(self, patch: pytest.MonkeyPatch, places: dict[bytes, tuple[str, ...]], most: int) -> None:
        self.done: list[object] = []
        self.asked_for: list[bytes] = []
        self.at_once: list[int] = []

        def likely_places(_station: Any, _links: LinkSettings, uuids: list[bytes]) -> tuple[str, ...]:
            self.asked_for += uuids
            return places.get(uuids[0], ())

        def open_port(links: LinkSettings) -> Any:
            place = f"{links.via}:{links.can or links.nfc}"
            self.done.append(f"open {place}")
            return SimpleNamespace(
                capabilities=SimpleNamespace(max_parallel=most), close=lambda: self.done.append(f"close {place}")
            )

        def update_at(_station: Any, _port: Any, uuid: bytes, order: Any, reporter: Any, *, timeout: float) -> Any:
            assert (reporter, timeout) == (uuid.hex(), 7.0)
            return uuid, order

        work = ParallelWork

        def parallel(items: Any, one: Any, *, at_once: int, name: str) -> Any:
            self.at_once.append(at_once)
            return work(items, one, at_once=at_once, name=name)

        patch.setattr(update, "likely_places", likely_places)
        patch.setattr(update, "open_port", open_port)
        patch.setattr(update, "avoid_measuring_source", lambda _station, _port, uuid: self.done.append(uuid[-1]))
        patch.setattr(update, "update_at", update_at)
        patch.setattr(update, "ParallelWork", parallel)

    def updated(self, orders: list[tuple[bytes, Any]], parallel: int, **links: Any) -> list[Any]:
        none: Any = None
        told: Any = bytes.hex
        settings = LinkSettings(timeout=7.0, **links)
        found: list[Any] = []
        for board in update.update_boards(none, settings, orders, told, parallel=parallel):
            found.append(board)
            self.done.append("end")
        return found


A, B, C, D = (bytes(9) + bytes([number]) for number in range(4))


def test_boards_are_updated_bus_by_bus_where_each_was_met_last(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each port is closed before the next is opened; the own source address is looked at for every board of a port."""
    places = {A: ("can:a", "can:b"), B: ("can:b",), C: ("can:a",)}
    orders: list[tuple[bytes, Any]] = [(uuid, f"order {uuid[-1]}") for uuid in (A, B, C, D)]
    ports = _Ports(monkeypatch, places, 8)
    assert ports.updated(orders, 1) == [orders[0], orders[2], orders[1], orders[3]]
    assert ports.done == [
        *("open can:a", 0, 2, "end", "end", "close can:a"),
        *("open can:b", 1, "end", "close can:b"),
        *("open nfc:None", 3, "end", "close nfc:None"),
    ]
    assert ports.asked_for == [A, B, C, D]
    ports = _Ports(monkeypatch, places, 8)
    assert ports.updated(orders, 1, nfc="usb") == orders
    assert ports.asked_for == [], "a reader that is configured is waited at"
    assert ports.done[0] == "open nfc:usb"


@pytest.mark.parametrize(
    ("parallel", "most", "boards", "at_once"),
    [(4, 8, 3, [3]), (2, 8, 3, [2]), (4, 2, 3, [2]), (1, 8, 3, []), (4, 1, 3, []), (4, 8, 1, [])],
    ids=["all", "as asked", "as the link bears", "one asked", "the link bears one", "one board"],
)
def test_as_many_boards_at_a_time_as_were_asked_for_and_as_the_link_bears(
    parallel: int, most: int, boards: int, at_once: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    orders: list[tuple[bytes, Any]] = [(uuid, "order") for uuid in (A, B, C)[:boards]]
    ports = _Ports(monkeypatch, {}, most)
    assert sorted(ports.updated(orders, parallel)) == orders
    assert ports.at_once == at_once
    assert ports.done[-1] == "close nfc:None"


def test_who_stops_an_update_of_many_boards_begins_no_further_one(monkeypatch: pytest.MonkeyPatch) -> None:
    ports = _Ports(monkeypatch, {}, 2)
    dropped: list[bool] = []
    work: Any = SimpleNamespace(
        results=lambda: iter([SimpleNamespace(result=lambda: "first"), SimpleNamespace(result=lambda: "second")]),
        drop_waiting=lambda: dropped.append(True),
    )
    monkeypatch.setattr(update, "ParallelWork", lambda *_args, **_more: work)
    none: Any = None
    running: Any = update.update_boards(none, LinkSettings(), [(A, none), (B, none)], none, parallel=2)
    assert next(running) == "first"
    running.close()
    assert dropped == [True]
    assert ports.done[-1] == "close nfc:None"


def test_a_board_that_does_not_measure_has_no_actuator_in_use() -> None:
    def refuse(_command: object, _doing: object) -> bytes:
        raise NodeRefusedError("It is unknown.", reason=1)

    node: Any = SimpleNamespace(request_idempotent=refuse)
    update.require_free_actuators(node)


def test_a_board_that_is_measured_is_updated_only_if_it_was_let_go(
    bench: UpdateBench, owner: Owner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench.station.measurements, "holder", lambda _uuid: "crane")
    done = bench.update(owner.new)
    assert (done.result, type(done.error), done.octets) == ("refused", FrozenError, 0)
    assert bench.runs == ("1.0.0", False, False)
    let_go: list[bytes] = []

    def release(uuid: bytes) -> Any:
        let_go.append(uuid)
        return nullcontext(True)

    port: Any = BenchPort(bench)
    order = UpdateOrder(owner.new, wait=5.0)
    done = update_at(bench.station, port, bench.uuid, order, SilentReporter(), timeout=1.0, release=release)
    assert (done.result, let_go) == ("updated", [bench.uuid])


def test_a_plan_of_a_board_that_is_measured_needs_a_service_that_lets_it_go(
    bench: UpdateBench, owner: Owner, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.station.unlock()
    closed: list[bool] = []
    monkeypatch.setattr(BenchPort, "close", lambda _port: closed.append(True))
    holder, serves = "crane", False
    monkeypatch.setattr(bench.station.measurements, "holder", lambda _uuid: holder)
    bench.station.service_runs = lambda: serves

    def planned(image: FirmwareImage) -> Any:
        links = LinkSettings("can", via_chosen=True)
        with bench.patched():
            return update.plan_or_refusal(bench.station, links, bench.uuid, UpdateOrder(image), SilentReporter())

    refused = planned(owner.new)
    assert (refused.result, refused.before, refused.octets) == ("refused", "1.0.0", 0)
    assert refused.error.message == f"Node {bench.uuid.hex()} is being measured by crane."
    serves = True
    assert planned(owner.new).interrupts == ("crane",)
    holder, serves = None, False  # type: ignore[assignment]
    assert planned(owner.new).interrupts == ()
    assert closed == [True] * 3


def test_an_update_begins_with_free_actuators_and_a_board_that_runs_the_image_is_noted(
    bench: UpdateBench, owner: Owner, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_node: Conversation) -> None:
        raise PolicyError("Actuator 7 of the board is in use.")

    with monkeypatch.context() as patch:
        patch.setattr(update, "require_free_actuators", refuse)
        done = bench.update(owner.new)
        assert (done.result, done.octets, bench.runs) == ("refused", 0, ("1.0.0", False, False))
    bench.station.firmware_reports.forget(bench.uuid)
    assert bench.update(owner.old).result == "already"
    known = firmware_of(bench.station, bench.uuid)
    assert known is not None
    assert known.reading.report is not None
    assert known.reading.report.image == owner.old.digest


# -- single steps of an update, without a board ------------------------------------------------------------------------


def an_update(station: Any = None, **order: Any) -> Any:
    none: Any = None
    return update._Update(station, none, 1.0, bytes(10), UpdateOrder(image_of(NEWER), **order), SilentReporter())


@pytest.mark.parametrize(
    ("stage", "state", "course"),
    [
        ("nothing", NodeState.PROVISIONED, ["keep"]),
        ("prove", NodeState.PROVISIONED, ["note as kept", "prove in c0"]),
        ("restart", NodeState.PROVISIONED,
         ["actuators", "note", "as signed", "address", "restart", "restarted after c0", "prove in c0"]),
        ("restart", NodeState.KEYED, ["actuators", "note", "address", "restart", "restarted after c0", "prove in c0"]),
        ("upload", NodeState.FACTORY,
         ["actuators", "note", "address", "upload", "restart", "restarted after c1", "prove in c1"]),
    ],
)  # fmt: skip
def test_the_course_of_an_update_by_its_first_step(
    monkeypatch: pytest.MonkeyPatch, stage: str, state: NodeState, course: list[str]
) -> None:
    """A lost session is opened again while the image goes over: the restart is seen by c of the last one."""
    did, node = list[str](), SimpleNamespace(open_counter=b"c0")
    made = an_update()

    def upload(_node: object, _manager: object) -> None:
        did.append("upload")
        node.open_counter = b"c1"

    def note(_node: object, *, as_kept: bool) -> Any:
        did.append("note as kept" if as_kept else "note")
        return update._BeforeRestart(b"sheet", _identity(state), None, b"c0")

    @contextmanager
    def restarted(before: Any) -> Iterator[Any]:
        did.append(f"restarted after {before.c.decode()}")
        yield node

    made._met = lambda _seconds: nullcontext(node)
    made._look = lambda _node: (reported(), stage)
    made._mismatch = lambda _report: ""
    made._note, made._upload, made._restarted = note, upload, restarted
    made._keep = lambda _report: did.append("keep")
    made._keep_as_signed = lambda _report: did.append("as signed")
    made._keep_address = lambda _node: did.append("address")
    made._proven = lambda _node, _manager, before: (did.append(f"prove in {before.c.decode()}"), "updated")[1]
    monkeypatch.setattr(update, "require_not_measured", lambda *_, released: None)
    monkeypatch.setattr(update, "require_free_actuators", lambda _node: did.append("actuators"))
    manager = SimpleNamespace(restart=lambda: did.append("restart"))
    monkeypatch.setattr(update, "ImageManager", lambda _node: manager)
    assert made._run(released=False) == ("already" if stage == "nothing" else "updated")
    assert did == course


def test_an_address_that_a_claim_moved_is_made_durable_and_no_other_link_has_one() -> None:
    sent: list[object] = []
    for address in (None, 0x42):
        node: Any = SimpleNamespace(
            contact=SimpleNamespace(address=address), request=lambda command, _doing: sent.append(command)
        )
        an_update()._keep_address(node)
    assert sent == [security_command(Function.SET_CAN_ADDRESS, b"\x42")]


def _identity(state: NodeState = NodeState.PROVISIONED, epoch: int = 3, sequence: int = 4) -> Any:
    return SimpleNamespace(state=state, epoch=epoch, sequence=sequence)


@pytest.mark.parametrize(
    ("state", "kept", "as_kept", "security", "datasheet"),
    [
        (NodeState.PROVISIONED, b"old", False, b"now", "read"),
        (NodeState.PROVISIONED, b"now", False, b"now", "kept"),
        (NodeState.PROVISIONED, None, False, b"now", "read"),
        (NodeState.PROVISIONED, b"old", True, b"old", "kept"),
        (NodeState.PROVISIONED, None, True, b"now", "read"),
        (NodeState.KEYED, b"now", False, b"now", None),
        (NodeState.KEYED, b"old", True, b"now", None),
    ],
)
def test_what_is_noted_before_a_restart_is_of_the_node_unless_it_has_restarted(
    state: NodeState,
    kept: bytes | None,
    as_kept: bool,
    security: bytes,
    datasheet: str | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = None if kept is None else SimpleNamespace(security=kept)
    monkeypatch.setattr(update, "read_identity", lambda _node: _identity(state))
    monkeypatch.setattr(update, "read_block", lambda _node, _block: b"now")
    monkeypatch.setattr(update, "read_image", lambda _node: "read")
    station = SimpleNamespace(datasheets=SimpleNamespace(datasheet=lambda _uuid: known))
    node: Any = SimpleNamespace(open_counter=bytes(8))
    noted = an_update(station)._note(node, as_kept=as_kept)
    assert noted.security == security
    assert noted.datasheet is (known if datasheet == "kept" else datasheet)


@pytest.mark.parametrize(("known", "noted"), [(None, True), ("no signature", True), ("signed", False)])
def test_the_firmware_before_an_update_counts_as_that_of_the_signature_if_none_is_known(
    known: str | None, noted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[bool] = []
    monkeypatch.setattr(update, "keep_firmware", lambda *_args, signed: kept.append(signed))
    record = known and SimpleNamespace(signed=RUNS if known == "signed" else None)
    station = SimpleNamespace(
        firmware_reports=SimpleNamespace(get=lambda _uuid: record), durable=lambda _by: nullcontext()
    )
    an_update(station)._keep_as_signed(reported())
    assert kept == ([True] if noted else [])


ON_TRIAL = reported(NEWER, FirmwareFlag.ON_TRIAL)
KEEPS = reported(NEWER)


@pytest.mark.parametrize(
    ("first", "identity", "last", "error"),
    [
        (ON_TRIAL, _identity(), KEEPS, None),
        (None, _identity(), KEEPS, "did not start"),
        (reported(RUNS, FirmwareFlag.ON_TRIAL), _identity(), KEEPS, "did not start"),
        (KEEPS, _identity(), KEEPS, "confirmed itself"),
        (ON_TRIAL, _identity(NodeState.KEYED), KEEPS, "lost key, epoch or sequence"),
        (ON_TRIAL, _identity(epoch=2), KEEPS, "lost key, epoch or sequence"),
        (ON_TRIAL, _identity(sequence=5), KEEPS, "lost key, epoch or sequence"),
        (ON_TRIAL, _identity(), None, "did not keep"),
        (ON_TRIAL, _identity(), reported(RUNS), "did not keep"),
        (ON_TRIAL, _identity(), ON_TRIAL, "did not keep"),
    ],
)
def test_each_thing_that_a_new_image_proves_is_looked_at(
    first: Any, identity: Any, last: Any, error: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only then it is kept: the confirmation comes after every look but the last."""
    reports, did = [last, first], list[str]()
    monkeypatch.setattr(update, "read_about", lambda _node: reports.pop())
    monkeypatch.setattr(update, "prove", lambda _node, _point: did.append("prove"))
    monkeypatch.setattr(update, "read_block", lambda _node, _block: b"sheet")
    monkeypatch.setattr(update, "read_identity", lambda _node: identity)
    monkeypatch.setattr(update, "require_working_hardware", lambda _node, _sheet: did.append("hardware"))
    made = an_update()
    made._keep = lambda report: did.append(f"keep {report.image.hex()[:2]}")
    manager: Any = SimpleNamespace(confirm=lambda: did.append("confirm"))
    none: Any = None
    before = update._BeforeRestart(b"sheet", _identity(), none if error else "datasheet", None)  # type: ignore[arg-type]
    if error is None:
        made._prove(none, manager, before)
        assert did == ["prove", "hardware", "confirm", "keep 02"]
        return
    with pytest.raises(TedsProvisionError, match=error):
        made._prove(none, manager, before)
    assert ("confirm" in did) == (error == "did not keep")
    assert "keep 02" not in did
    assert "hardware" not in did, "without a datasheet there is nothing to hold the channels against"


class _Returns:
    """What comes of each session with a board after its restart: an error, or its report and c."""

    def __init__(self, patch: pytest.MonkeyPatch, made: Any, *sessions: Any) -> None:
        self.left, self.restarts, self.closed = list(sessions), 0, 0
        self.fault: TedsProvisionError = NodeRefusedError("It is busy.", reason=17)
        made._in_session = self.session
        patch.setattr(update, "_PAUSE", 0)
        patch.setattr(update, "read_about", lambda node: node.report)
        patch.setattr(update, "ImageManager", lambda _node: SimpleNamespace(restart=self.restart))

    @contextmanager
    def session(self, _seconds: float) -> Iterator[Any]:
        now = self.left.pop(0)
        if isinstance(now, Exception):
            raise now
        report, c = now
        yield SimpleNamespace(report=report, open_counter=c.to_bytes(8, "big"))

    def restart(self) -> None:
        self.restarts += 1
        if self.restarts == 1:
            raise self.fault

    def close(self) -> None:
        self.closed += 1


def test_a_board_whose_image_is_not_proven_is_waited_for_until_its_old_one_runs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A board that refuses the restart, is silent, busy, or reports nothing yet, is asked again."""
    later, old = 1 << 40, reported()
    made = an_update(wait=60.0)
    board = _Returns(
        monkeypatch,
        made,
        NodeSilentError("It is silent."),
        SessionLostError(NodeSilentError("It is silent.")),
        NodeRefusedError("It is busy.", reason=17),
        (None, later),
        (ON_TRIAL, 1),
        (ON_TRIAL, later),
        (old, later),
    )
    node: Any = SimpleNamespace(open_counter=bytes(8), contact=SimpleNamespace(link=SimpleNamespace(close=board.close)))
    with pytest.raises(RevertedError, match="did not prove itself: It is harmful"):
        made._revert(node, PolicyError("It is harmful."))
    assert (board.left, board.restarts, board.closed) == ([], 2, 1)
    board.left, board.restarts = [LinkClosedError("Ctrl-C")], 1
    with pytest.raises(LinkClosedError):
        made._revert(node, PolicyError("It is harmful."))


def test_a_restarted_board_is_waited_for_while_it_is_silent_or_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    later = 1 << 40
    made = an_update(wait=60.0)
    before = update._BeforeRestart(b"", _identity(), None, bytes(8))
    board = _Returns(
        monkeypatch,
        made,
        NodeSilentError("It is silent."),
        NodeRefusedError("It is busy.", reason=17),
        (ON_TRIAL, 1),
        (ON_TRIAL, later),
    )
    with made._restarted(before) as node:
        assert node.open_counter == later.to_bytes(8, "big")
    assert (board.left, board.restarts) == ([], 0)
    board.left = [LinkClosedError("Ctrl-C")]
    with pytest.raises(LinkClosedError), made._restarted(before):
        pass


def test_a_board_is_looked_for_two_seconds_at_a_time_within_what_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[float] = []
    made = an_update()

    @contextmanager
    def meeting(seconds: float) -> Iterator[Any]:
        looked.append(seconds)
        yield SimpleNamespace(uuid=bytes(10))

    made._meeting = meeting
    monkeypatch.setattr(update, "open_session", lambda _station, _node: None)
    monkeypatch.setattr(update, "unknown_key", lambda _station, _node: PolicyError("Its key is unknown."))
    for left in (60.0, 0.5):
        with pytest.raises(PolicyError, match="unknown"), made._in_session(left):
            pass
    assert looked == [2.0, 0.5]


# -- the image manager, without a board --------------------------------------------------------------------------------


def a_manager(answers: Callable[[bytes], bytes] = lambda _packet: b"", *, alive: bool = True) -> tuple[Any, Any]:
    """Return a manager, and the node that answers its packets."""
    node: Any = SimpleNamespace(
        identity=SimpleNamespace(max_message=1000),
        contact=SimpleNamespace(link=object()),
        is_alive=lambda: alive,
        reopened=0,
    )
    node.reopen = lambda: setattr(node, "reopened", node.reopened + 1)
    node.request = lambda command, _doing: answers(command.payload)
    return ImageManager(node), node


@pytest.mark.parametrize(
    ("alive", "losses", "error"),
    [
        (True, [NodeSilentError("1")] * 3, None),
        (True, [SessionLostError(NodeSilentError("1"))] * 3, None),
        (True, [SessionLostError(NodeSilentError("of a session"))] * 4, "of a session"),
        (True, [GarbledError("garbled")] * 4, "garbled"),
        (False, [SessionLostError(NodeSilentError("closed"))], "closed"),
    ],
)
def test_an_upload_goes_on_after_losses_in_shorter_packets_until_there_are_too_many(
    monkeypatch: pytest.MonkeyPatch, alive: bool, losses: list[Exception], error: str | None
) -> None:
    left = list(losses)
    manager, node = a_manager(alive=alive)
    monkeypatch.setattr(image_manager, "_LOSSES", 3)
    monkeypatch.setattr(image_manager, "_SMALLEST_PACKET", 200)
    largest: list[int] = []

    def once(octets: bytes) -> Iterator[tuple[int, int]]:
        largest.append(manager._largest)
        if left:
            raise left.pop(0)
        yield len(octets), len(octets)

    manager._upload_once, first = once, manager._largest
    if error is None:
        assert manager.upload(bytes(30), lambda done, of: None) == 30
        assert (largest, node.reopened) == ([first, first // 2, first // 4, 200], 3)
        return
    with pytest.raises(LinkError) as lost:
        manager.upload(bytes(30), lambda done, of: None)
    assert (lost.value.message, node.reopened) == (error, 3 if alive else 0)


def test_only_octets_that_the_board_took_from_here_are_counted_as_sent() -> None:
    """It has the first 300 of an earlier run, and a reply is lost later; length and digest go with the first piece."""
    manager, _ = a_manager()
    image, replies, asked = bytes(range(250)) * 4, [300, 700, 700, 1000], list[tuple[Any, ...]]()
    course: list[str] = []
    manager._room, manager._fit_buffer = lambda _offset, _more: 400, lambda: course.append("fit")

    def ask(request: Any, _kind: Any, _doing: str) -> Any:
        asked.append((request.off, request.data, request.len, request.sha))
        return SimpleNamespace(off=replies.pop(0), match=None)

    manager._ask = ask
    assert list(manager._upload_once(image)) == [(0, 300), (400, 700), (0, 700), (300, 1000)]
    assert asked == [
        (0, image[:400], 1000, hashlib.sha256(image).digest()),
        (300, image[300:700], None, None),
        (700, image[700:], None, None),
        (700, image[700:], None, None),
    ]
    assert course == ["fit"]


@pytest.mark.parametrize(("size", "good"), [(4096, True), (300, True), (137, True), (136, False)])
def test_packets_are_no_longer_than_the_board_and_its_messages_take(size: int, good: bool) -> None:
    manager, _ = a_manager()
    asked: list[str] = []

    def ask(_request: Any, _kind: Any, doing: str) -> Any:
        asked.append(doing)
        return SimpleNamespace(buf_size=size)

    manager._ask, most = ask, manager._largest
    if not good:
        with pytest.raises(NotAuthenticError, match="accepts packets of 136 octets only, too short for an image"):
            manager._fit_buffer()
        return
    manager._fit_buffer()
    manager._fit_buffer()
    assert (manager._largest, asked) == (min(most, size), ["its packet size"])


@pytest.mark.parametrize(
    ("error", "raised", "why"),
    [
        (SMPException("bad"), NotAuthenticError, "it lacks what belongs there"),
        (TypeError("bad"), NotAuthenticError, "it lacks what belongs there"),
        (ValueError("bad"), NotAuthenticError, "it lacks what belongs there"),
        (AssertionError("bad"), NotAuthenticError, "it lacks what belongs there"),
        (RuntimeError("a bug"), RuntimeError, "a bug"),
    ],
)
def test_a_reply_that_smp_cannot_load_is_the_boards_fault_and_a_bug_is_none(
    error: Exception, raised: type[Exception], why: str
) -> None:
    manager, _ = a_manager()
    manager._exchange = lambda packet, _doing: decode_packet(packet).reply(cbor2.dumps({})).encode()

    def loads(_octets: bytes) -> Any:
        raise error

    with pytest.raises(raised, match=why):
        manager._ask(manager._os.ResetWriteRequest(), SimpleNamespace(loads=loads), "to restart")


@pytest.mark.parametrize(
    ("reasons", "at", "busy"),
    [([Reason.BUSY, Reason.BUSY], 100.0, 2), ([Reason.NOT_PERMITTED], 100.0, None), ([Reason.BUSY], 1e9, None)],
)
def test_a_busy_image_manager_is_asked_again_for_a_while_and_another_refusal_counts(
    monkeypatch: pytest.MonkeyPatch, reasons: list[Reason], at: float, busy: int | None
) -> None:
    left, pauses, moments = list(reasons), list[float](), [100.0]

    def monotonic() -> float:
        return moments.pop() if moments else at

    def answer(_command: bytes) -> bytes:
        if left:
            raise NodeRefusedError("Refused.", reason=left.pop(0))
        return b"done"

    monkeypatch.setattr(image_manager, "time", SimpleNamespace(monotonic=monotonic, sleep=pauses.append))
    manager, _ = a_manager(answer)
    if busy is None:
        with pytest.raises(NodeRefusedError):
            manager._exchange(b"", "the image")
        assert pauses == []
    else:
        assert (manager._exchange(b"", "the image"), len(pauses)) == (b"done", busy)


def test_a_package_that_is_missing_is_named_with_its_installation() -> None:
    with pytest.raises(NotFoundError, match="A firmware update needs the package smp") as refused:
        image_manager._smp("nothing_of_that_name")
    assert "update" in refused.value.hint


# -- what an update says when it cannot be ----------------------------------------------------------------------------


def test_the_plan_of_an_update_that_is_refused_raises_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    none: Any = None
    board = update.BoardUpdate(bytes(10), "refused", None, 0, 0.0, DowngradeError("It is older."))
    monkeypatch.setattr(update, "plan_or_refusal", lambda *_: board)
    with pytest.raises(DowngradeError, match="It is older"):
        plan_update(none, none, bytes(10), none, SilentReporter())
    planned: Any = object()
    monkeypatch.setattr(update, "plan_or_refusal", lambda *_: planned)
    assert plan_update(none, none, bytes(10), none, SilentReporter()) is planned


def test_a_board_that_reports_no_firmware_or_does_not_manage_it_takes_none(monkeypatch: pytest.MonkeyPatch) -> None:
    none: Any = None
    for report, why, hint in (
        (
            None,
            "does not report its firmware, so it takes none over this link.",
            "Program it once by its",
        ),
        (replace(reported(), flags=FirmwareFlag(0)), "takes no firmware over its session", "It needs MCUboot with"),
    ):
        monkeypatch.setattr(update, "read_about", lambda _node, report=report: report)
        with pytest.raises(NoUpdateError, match=why) as refused:
            an_update()._look(none)
        assert refused.value.hint.startswith(hint)


def test_an_image_that_the_board_does_not_show_after_the_upload_is_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    made, course, none = an_update(), list[str](), cast(Any, None)
    shown: list[list[Any]] = []

    def upload(octets: bytes, _progress: Any) -> int:
        course.append("upload")
        return len(octets)

    steps, moments = list[Any](), list[float]()
    made._reporter = SimpleNamespace(started=steps.append, finished=steps.append, written=None)
    monkeypatch.setattr(update, "time", SimpleNamespace(monotonic=lambda: moments.pop(0)))
    manager: Any = SimpleNamespace(
        images=lambda: shown.pop(0), upload=upload, start_next=lambda digest: course.append(digest.hex()[:4])
    )
    other = BoardImage(b"other", running=False, confirmed=False, pending=False)
    ours = BoardImage(made._digest, running=False, confirmed=False, pending=False)
    running = replace(ours, running=True)
    for images, done in (
        ([[other], [other]], None),
        ([[other], [running]], None),
        ([[other], [other, ours]], ["upload", made._digest.hex()[:4]]),
        ([[running], [running, ours]], ["upload", made._digest.hex()[:4]]),
        ([[other, ours]], [made._digest.hex()[:4]]),
    ):
        shown[:], course[:], steps[:], moments[:] = images, [], [], [100.0]
        if done is None:
            with pytest.raises(NotAuthenticError, match="does not show the image that was sent"):
                made._upload(none, manager)
            assert course == ["upload"]
        else:
            moments[:], made._octets = [100.0, 103.5], 0
            made._upload(none, manager)
            assert course == done
            detail = "1000 octets" if "upload" in done else "already on the board"
            assert steps == ["upload", StepResult("upload", seconds=3.5, detail=detail)]


@pytest.mark.parametrize(
    "fault",
    [
        NodeSilentError("It is silent."),
        NodeRefusedError("It is busy.", reason=17),
        PolicyError("The board's image manager refused it."),
        NotAuthenticError("The reply was altered."),
    ],
    ids=lambda fault: type(fault).__name__,
)
def test_whatever_comes_of_the_restart_the_board_is_waited_for_until_its_old_image_runs(
    monkeypatch: pytest.MonkeyPatch, fault: TedsProvisionError
) -> None:
    made = an_update(wait=60.0)
    board = _Returns(monkeypatch, made, (reported(), 1 << 40))
    board.fault = fault
    node: Any = SimpleNamespace(open_counter=bytes(8), contact=SimpleNamespace(link=SimpleNamespace(close=board.close)))
    with pytest.raises(RevertedError, match="did not prove itself: It is harmful") as reverted:
        made._revert(node, PolicyError("It is harmful."))
    assert reverted.value.hint == "The image is at fault, not the board: it runs its old firmware again."
    assert (board.left, board.restarts, board.closed) == ([], 1, 1)


def test_a_board_is_let_go_for_an_update_unless_the_caller_has_it() -> None:
    let_go: list[Any] = []
    station: Any = SimpleNamespace(released=lambda *given: let_go.append(given))
    an_update(station)._release(bytes(10))
    assert let_go == [(bytes(10), "update")]


def test_a_plan_over_an_open_port_or_in_an_open_session_is_that_of_a_command(monkeypatch: pytest.MonkeyPatch) -> None:
    none: Any = None
    order, planned = UpdateOrder(image_of(NEWER)), list[Any]()
    monkeypatch.setattr(update._Update, "plan", lambda made: planned.append((made._uuid, made._order, made._timeout)))
    monkeypatch.setattr(update._Look, "planned", lambda look, node: planned.append((look._uuid, look._order, node)))
    update.plan_at(none, none, bytes(10), order, SilentReporter(), timeout=2.5)
    node: Any = SimpleNamespace(uuid=bytes(10))
    update.plan_in(none, node, order)
    assert planned == [(bytes(10), order, 2.5), (bytes(10), order, node)]


def test_a_board_that_does_not_come_back_from_its_trial_is_lost_after_the_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    made = an_update(wait=2.5)
    board = _Returns(monkeypatch, made, *[NodeSilentError("It is silent.")] * 9)
    moments = [100.0, 100.5, 101.9, 102.49, 102.5, 103.0]
    left: list[float] = []
    session = made._in_session
    made._in_session = lambda seconds: (left.append(round(seconds, 2)), session(seconds))[1]
    monkeypatch.setattr(update, "time", SimpleNamespace(monotonic=lambda: moments.pop(0), sleep=lambda _seconds: None))
    node: Any = SimpleNamespace(open_counter=bytes(8), contact=SimpleNamespace(link=SimpleNamespace(close=board.close)))
    with pytest.raises(BoardLostError, match=r"did not answer within 2\.5 s after its restart") as lost:
        made._revert(node, PolicyError("It is harmful."))
    assert left == [2.0, 0.6, 0.01], "to the end of the wait and no longer"
    assert lost.value.hint.startswith("Switch it off and on: it then runs its old firmware.")
