"""The model's steps on a desk: three real stations that one CA certified, and one real node.

An agreement waits in a thread of its own wherever the model may have something else happen: before the key is stored,
before Confirm leaves, and for its reply. A Confirm is kept and comes to the node when the model says so.
"""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final, cast
from unittest.mock import patch

import pytest

from teds_provision.backup.backup import backup
from teds_provision.backup.restore import rebuild
from teds_provision.backup.sealed_file import SealedFile
from teds_provision.errors import PolicyError, TedsProvisionError
from teds_provision.handover.incoming import ImportPlan, import_bundle, plan_import
from teds_provision.handover.outgoing import ExportOrder, ExportPlan, _announced, export_bundle, plan_export
from teds_provision.handover.pending import close, undo
from teds_provision.links import LINKS, Capabilities, Contact
from teds_provision.measure.standing import NodeStanding
from teds_provision.protocol.datasheet import SignedNodeKey
from teds_provision.protocol.handover.bundle import Mode
from teds_provision.protocol.keys import fingerprint
from teds_provision.protocol.messages.frames import Function, decode_reply, security_command
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.protocol.wire_agreement import key_id
from teds_provision.provisioning.agree import _agree_anew, agree, open_session, reset_node
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.sign import SignResult, sign
from teds_provision.provisioning.teds_read import read_block, read_identity
from teds_provision.provisioning.write import _commit, write
from teds_provision.station import node_keys
from teds_provision.station.station import Station
from teds_provision.station.store.records import TrustRecord, WhitelistEntry
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.profile import load_profile
from teds_provision.vault.passphrase import THROWAWAY
from teds_provision.vault.selection import forget_vaults
from tests.bench import PASSPHRASE, Board, make_station
from tests.model.traces import NONE, Kind, State, Step, Trace
from tests.pace import PATIENCE

NAMES: Final = ("north", "south", "west")
_LIE: Final = 1_000_000
"""What every bundle says of the node's sequence."""


class CutError(BaseException):
    """The station's power went: nothing catches it."""


class SameHandoverError(Exception):
    """The model has two copies where the code has one: the same keys to the same station are the same handover."""


class LostRequestError(Exception):
    """A wrong Confirm made the node forget the Request in its RAM: a separate step in the model, at any time."""


@dataclass
class Link:
    """The way from one station to the node; ``before`` sees each frame first and may raise CutError."""

    board: Board
    name: str
    before: Callable[[bytes], None] = lambda frame: None
    after: Callable[[bytes], None] = lambda frame: None
    via: str = "nfc"

    def exchange(self, frame: bytes) -> bytes:
        self.before(frame)
        reply = self.board.tim.handle(frame, link=self.name, tapped=True)
        self.after(frame)
        return reply

    @property
    def capabilities(self) -> Capabilities:
        return LINKS[self.via].capabilities

    def close(self) -> None:
        """A station that goes leaves the node as it is: a Confirm may still be on its way."""


class _StepwiseStation:
    """A station whose durable steps wait for their turn."""

    def __init__(self, station: Station, pause: Callable[[str], None]) -> None:
        self._station, self._pause = station, pause

    def __getattr__(self, name: str) -> Any:
        return getattr(self._station, name)

    @contextmanager
    def durable(self, command: str, *, more_follows: bool = False) -> Iterator[None]:
        self._pause("store")
        with self._station.durable(command, more_follows=more_follows):
            yield


class Agreement:
    """One agreement, stopped at each point where the model has a step."""

    def __init__(self, desk: Desk, station: int, *, reply_lost: bool) -> None:
        self.desk, self.station, self.reply_lost = desk, station, reply_lost
        self.at = ""
        self.number = 0
        self._go: SimpleQueue[bool] = SimpleQueue()
        self._stopped: SimpleQueue[str] = SimpleQueue()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self._wait()

    def go(self) -> None:
        """Take the next step, to the next point."""
        self._go.put(True)
        self._wait()

    def cut(self) -> None:
        """End it where it is."""
        if self.at != "ended":
            self._go.put(False)
            self._wait()
        self._thread.join(PATIENCE)

    def _wait(self) -> None:
        self.at = self._stopped.get(timeout=PATIENCE)
        if self._failure is not None:
            raise self._failure

    def _pause(self, where: str) -> None:
        self._stopped.put(where)
        if not self._go.get(timeout=PATIENCE):
            raise CutError

    def _run(self) -> None:
        desk, station = self.desk, self.desk.stations[self.station]
        try:
            with desk.talk(self.station, Link(desk.board, NAMES[self.station], self._before, self._after)) as node:
                entry = station.pins.entry(node.uuid)
                assert entry is not None
                stepwise = cast("Station", _StepwiseStation(station, self._pause))
                _agree_anew(stepwise, node, entry, desk.ca, read_block(node, SECURITY))
        except CutError:
            pass
        except BaseException as failure:  # noqa: BLE001  raised by the test
            self._failure = failure
        self._stopped.put("ended")

    def _before(self, frame: bytes) -> None:
        if not _is(frame, Function.CONFIRM):
            return
        self._pause("send")
        self.desk.confirms[self.number] = NAMES[self.station], frame
        self._pause("reply")
        raise CutError  # it comes or not: an Open shows it

    def _after(self, frame: bytes) -> None:
        if not _is(frame, Function.REQUEST):
            return
        self.number = self.desk.note_request()
        if self.reply_lost:
            raise CutError


def _is(frame: bytes, function: Function) -> bool:
    """Return True if a frame is this command outside a session."""
    return frame[2:4] == security_command(function).encode()[2:4]


@dataclass
class _Bundle:
    """A bundle that left: its plan, then its octets, then its receipt."""

    sender: int
    receiver: int
    mode: Mode
    id: str
    octets: bytes = b""
    receipt: bytes = b""


@dataclass
class Desk:
    """Three stations and a node, and what of the model's numbers is what here."""

    folder: Path
    stations: list[Station] = field(default_factory=list)
    board: Board = field(default_factory=Board)
    ca: bytes = b""
    agreements: dict[int, Agreement] = field(default_factory=dict)
    confirms: dict[int, tuple[str, bytes]] = field(default_factory=dict)
    numbers: dict[str, int] = field(default_factory=dict)
    bundles: list[_Bundle] = field(default_factory=list)
    made: int = 0
    saved: Path | None = None
    saved_of: int = -1
    sessions: dict[int, tuple[Conversation, NodeStanding]] = field(default_factory=dict)
    signed: dict[int, SignResult] = field(default_factory=dict)

    @classmethod
    def make(cls, folder: Path) -> Desk:
        """Three stations under the CA of the first; each trusts the others and has the node's key pinned."""
        desk = cls(folder)
        desk.stations = [make_station(folder / name, name) for name in NAMES]
        desk.ca = desk.stations[0].ca
        for station in desk.stations:
            for other in desk.stations:
                station.identity.keep_certificate(desk.ca, other.point, desk.stations[0].identity.certify(other.point))
                if other is not station:
                    station.policy.trust(TrustRecord(other.name, "station", other.point, other.fingerprint))
            station.pins.put(WhitelistEntry(desk.board.uuid, fingerprint(desk.board.key.point), assurance="tap"))
            station.nodes.remember(desk.board.uuid, point=desk.board.key.point)
        return desk

    def copy(self, folder: Path) -> Desk:
        """Return the same desk in another folder: as long as nothing has happened on it."""
        for name in NAMES:
            shutil.copytree(self.folder / name, folder / name)
        desk = Desk(folder, [Station.open(folder / name, ask=_ask) for name in NAMES], ca=self.ca)
        desk.board = Board(key=self.board.key)
        return desk

    def leave(self) -> None:
        """End every agreement and close the stations."""
        for agreement in self.agreements.values():
            agreement.cut()
        for station in self.stations:
            station.close()

    # -- the model's steps -----------------------------------------------------------------------------------------

    def take(self, step: Step) -> None:
        """Take one step; raises TedsProvisionError, or AssertionError, if the code refuses it."""
        _STEPS[step.kind](self, step)

    def refuse(self, step: Step, state: State) -> bool:
        """Try a step that the model does not permit in this state; return False for one that there is no way to try.

        Raises AssertionError if the code takes it.
        """
        refusal = _REFUSALS.get(step.kind)
        running = self.agreements.get(step.station)
        busy = running is not None and running.at != "ended" and step.kind not in (Kind.SEND_CONFIRM, Kind.CONFIRM)
        return refusal is not None and not busy and refusal(self, step, state)

    def _refuse_send(self, step: Step, state: State) -> bool:
        """The agreement is at another of its steps, and no Confirm of it has left."""
        agreement = self.agreements.get(step.station)
        if agreement is None or agreement.at == "ended":
            return False
        assert agreement.at != "send"
        assert agreement.number not in self.confirms
        return True

    def _refuse_confirm(self, step: Step, state: State) -> bool:
        """Send every Confirm that ever left to the node once more."""
        for link, frame in self.confirms.values():
            assert not decode_reply(self.board.tim.handle(frame, link=link, tapped=True)).ok
        if self.pending() != state.ram:
            assert self.pending() == 0
            raise LostRequestError
        return bool(self.confirms)

    def _refuse_request(self, step: Step, state: State) -> bool:
        station = self.stations[step.station]
        with self.talk(step.station) as node, pytest.raises(TedsProvisionError):
            agree(station, node, identify(station, node), rotate=True)
        return True

    def _refuse_open(self, step: Step, state: State) -> bool:
        assert self._opens(step.station) == (step.station in state.opens)
        return True

    def _refuse_sign(self, step: Step, state: State) -> bool:
        return self._refuse_open(step, state) and step.station not in state.opens

    def _refuse_commit(self, step: Step, state: State) -> bool:
        """Try it outside a session: there is none that this station could open."""
        signed = self.signed.get(step.station)
        if signed is None or step.station in state.opens:
            return False
        with self.talk(step.station) as node, pytest.raises((TedsProvisionError, SessionLostError)):
            _commit(self.stations[step.station], node, signed.image, None, None)
        return True

    def _refuse_export(self, step: Step, state: State) -> bool:
        with pytest.raises(TedsProvisionError):
            self._plan(step, "move" if step.kind == Kind.MOVE else "copy")
        return True

    def _refuse_import(self, step: Step, state: State) -> bool:
        if step.aim >= len(self.bundles) or not self.bundles[step.aim].octets:
            return False
        assert not self._takes(step.station, self.bundles[step.aim])
        return True

    def _refuse_receipt(self, step: Step, state: State) -> bool:
        if step.aim >= len(self.bundles):
            return False
        if not self.bundles[step.aim].receipt:
            return self._cut_import(self.bundles[step.aim])
        with suppress(TedsProvisionError):
            assert not close(self.stations[step.station], self.bundles[step.aim].receipt).fresh
        return True

    def _cut_import(self, bundle: _Bundle) -> bool:
        """Cut the receiver's power before it has taken the bundle in: no receipt leaves, and none is kept."""
        receiver = self.stations[bundle.receiver]
        if not bundle.octets or not self._takes(bundle.receiver, bundle):
            return False
        plan = plan_import(receiver, bundle.octets)
        assert isinstance(plan, ImportPlan)
        with patch.object(receiver, "audit", side_effect=CutError), pytest.raises(CutError):
            import_bundle(receiver, plan)
        assert receiver.handovers.get(bundle.id, "in") is None
        return True

    def _refuse_undo(self, step: Step, state: State) -> bool:
        tombstone = self.stations[step.station].policy.tombstone(self.board.uuid)
        if tombstone is None:
            return False
        with pytest.raises(TedsProvisionError):
            self.take_back(step)
        return True

    def _refuse_proof(self, step: Step, state: State) -> bool:
        station = self.stations[step.station]
        with self.talk(step.station) as node, pytest.raises(TedsProvisionError):
            reset_node(station, node, replace(identify(station, node), state=NodeState.FACTORY))
        return True

    def request(self, step: Step) -> None:
        self.agreements[step.station] = Agreement(self, step.station, reply_lost=not step.aim)

    def go_on(self, step: Step) -> None:
        agreement = self.agreements.get(step.station)
        assert agreement is not None
        assert agreement.at == {Kind.STORE: "store", Kind.SEND_CONFIRM: "send"}[step.kind]
        agreement.go()

    def cut(self, step: Step) -> None:
        self.signed.pop(step.station, None)
        self.sessions.pop(step.station, None)
        agreement = self.agreements.pop(step.station, None)
        if agreement is not None:
            agreement.cut()

    def confirm(self, step: Step) -> None:
        link, frame = self.confirms[self.pending()]
        assert decode_reply(self.board.tim.handle(frame, link=link, tapped=True)).ok

    def lose_ram(self, step: Step) -> None:
        for name in NAMES:
            self.board.tim.link_lost(name)

    def reset(self, step: Step) -> None:
        self.board.tim.reset_by_hand()

    def prove_reset(self, step: Step) -> None:
        station = self.stations[step.station]
        with self.talk(step.station) as node:
            reset_node(station, node, identify(station, node))

    def open(self, step: Step) -> None:
        with self.talk(step.station) as node:
            assert open_session(self.stations[step.station], node, word=True) is not None

    def forget(self, step: Step) -> None:
        """Open a session long after the Request whose key is still pending here."""
        if self.pending() in self.held(step.station):
            self.lose_ram(step)
        with patch.object(node_keys, "CONFIRM_MAY_ARRIVE", timedelta(minutes=-1)):
            self.open(step)

    def move(self, step: Step) -> None:
        """Have the move durable; its file comes with the next step."""
        station, plan = self.stations[step.station], self._plan(step, "move")
        with station.transaction():
            _announced(station, plan, plan.id)
        self.bundles.append(_Bundle(step.station, step.aim, "move", plan.id))

    def make_file(self, step: Step) -> None:
        """Run the same move again, which makes its file."""
        station = self.stations[step.station]
        bundle = next(made for made in reversed(self.bundles) if made.sender == step.station and made.mode == "move")
        if not bundle.octets:
            plan = self._plan(Step(Kind.MOVE, bundle.sender, bundle.receiver), "move")
            assert plan.id == bundle.id
            bundle.octets = self._sealed(station, plan)

    def copy_key(self, step: Step) -> None:
        plan = self._plan(step, "copy")
        made = _Bundle(step.station, step.aim, "copy", plan.id, self._sealed(self.stations[step.station], plan))
        self.bundles.append(made)

    def take_back(self, step: Step) -> None:
        station = self.stations[step.station]
        tombstone = station.policy.tombstone(self.board.uuid)
        assert tombstone is not None
        row = station.handovers.get(tombstone.handover_id, "out")
        assert row is not None
        undo(station, row)

    def bring_in(self, step: Step) -> None:
        station, bundle = self.stations[step.station], self.bundles[step.aim]
        plan = plan_import(station, bundle.octets)
        if not isinstance(plan, ImportPlan) and self._is_double(bundle):
            raise SameHandoverError
        assert isinstance(plan, ImportPlan), "it was taken in before"
        bundle.receipt = import_bundle(station, plan).receipt

    def take_receipt(self, step: Step) -> None:
        station, bundle = self.stations[step.station], self.bundles[step.aim]
        row = station.handovers.get(bundle.id, "out")
        assert row is not None
        if row.state != "undone":  # then it is refused, and changes nothing
            close(station, bundle.receipt)

    def save(self, step: Step) -> None:
        self.saved, self.saved_of = self.folder / "backup", step.station
        backup(self.stations[step.station], self.saved, _ask, costs=THROWAWAY)

    def restore(self, step: Step) -> None:
        self.cut(step)
        assert self.saved is not None
        assert self.saved_of == step.station
        self.stations[step.station].close()
        forget_vaults()
        home = self.folder / f"{NAMES[step.station]} again"
        with SealedFile(self.saved).open_with_passphrase(PASSPHRASE) as content:
            rebuild(home, content, _ask, costs=THROWAWAY)
        self.stations[step.station] = Station.open(home, ask=_ask)

    def begin_session(self, step: Step) -> None:
        """Open a session that lasts beyond this step, as a measurement has one."""
        station, node = self.stations[step.station], self.talk(step.station)
        node.__enter__()
        assert open_session(station, node, word=True) is not None
        self.sessions[step.station] = node, NodeStanding(station, self.board.uuid)
        assert self._session_lives(step.station)

    def end_session(self, step: Step) -> None:
        self.sessions.pop(step.station)[0].__exit__(None, None, None)

    def _session_lives(self, station: int) -> bool:
        """Return True if the station still asks the node in its session, and the node replies."""
        node, standing = self.sessions[station]
        if standing.ended is not None or not node.sealed:
            return False
        try:
            standing.require()
            read_identity(node)
        except (TedsProvisionError, SessionLostError):
            return False
        return True

    def sign_datasheet(self, step: Step) -> None:
        """Sign a datasheet against what the node says of itself in a session."""
        board = self.board
        with self.talk(step.station) as node:
            assert open_session(self.stations[step.station], node, word=True) is not None
            at = read_identity(node)
        keys = SignedNodeKey(board.uuid, board.key.point, board.state.node_key_signature)
        image = Image(board.uuid, load_profile("temperature-sensor").build(board.uuid).blocks)
        done = sign(self.stations[step.station], keys, image, epoch=at.epoch, node_sequence=at.sequence)
        self.signed[step.station] = done

    def commit(self, step: Step) -> None:
        """Write the datasheet that was signed; the node refuses a stale one, as the station does before."""
        station, signed, key = self.stations[step.station], self.signed.pop(step.station), self.board.state.key
        assert key is not None
        assert self._number_of(key) in self.held(step.station)
        with self.talk(step.station) as node:
            node.open(key)  # open_session would note, too, which key it was: a separate step in the model
            try:
                write(station, node, signed.image)
            except PolicyError:
                with pytest.raises(TedsProvisionError):
                    _commit(station, node, signed.image, None, None)

    # -- what is there ---------------------------------------------------------------------------------------------

    def compare(self, state: State, *, thorough: bool = False) -> None:
        """Compare the desk with the model's state; ``thorough``: also what would succeed now, which spends the desk."""
        flash = self.board.state
        there = self._number_of(flash.key), flash.epoch, flash.sequence
        assert there == (state.node, state.epoch, state.sequence), "the node's key, epoch and sequence"
        assert self.pending() == state.ram, "the agreement in the node's RAM"
        for number, (station, model) in enumerate(zip(self.stations, state.stations, strict=True)):
            keys = station.keys.keys_of(self.board.uuid)
            where = f"station {number}"
            assert self.held(number) == model.held, f"{where}: the keys that it holds"
            present = next((self.numbers[key.key_id] for key in keys if key.state == "active"), 0)
            assert present == (model.present if model.present in model.held else 0), f"{where}: its active key"
            tombstone = station.policy.tombstone(self.board.uuid)
            gone = next(
                (n for n, made in enumerate(self.bundles) if tombstone and made.id == tombstone.handover_id), NONE
            )
            assert gone == model.tombstone, f"{where}: the move by which it gave the node away"
            assert (station.keys.rotation_due(self.board.uuid) is not None) == model.due, f"{where}: a rotation is due"
            assert station.keys.holders(self.board.uuid) or not model.shared, f"{where}: who else has the key"
            signed = self.signed[number].sequence if number in self.signed else 0
            assert signed == model.signed, f"{where}: the sequence of the datasheet that it signed"
            if number in self.sessions and not model.session:
                assert not self._session_lives(number), f"{where}: its session has ended"
        if thorough:
            self._try_imports(state)
            self._try_sessions(state)

    def _try_imports(self, state: State) -> None:
        for n, bundle in enumerate(self.bundles):
            for s, model in enumerate(state.stations):
                if bundle.octets and model.idle and not self._is_double(bundle):
                    assert self._takes(s, bundle) == ((s, n) in state.takes), f"station {s} takes bundle {n} in"

    def _try_sessions(self, state: State) -> None:
        for s, model in enumerate(state.stations):
            if model.idle:
                assert self._opens(s) == (s in state.opens), f"station {s} opens a session"

    def _is_double(self, bundle: _Bundle) -> bool:
        return sum(other.id == bundle.id for other in self.bundles) > 1

    def _takes(self, station: int, bundle: _Bundle) -> bool:
        try:
            return isinstance(plan_import(self.stations[station], bundle.octets), ImportPlan)
        except TedsProvisionError:
            return False

    def _opens(self, station: int) -> bool:
        try:
            with self.talk(station) as node:
                return open_session(self.stations[station], node, word=True) is not None
        except TedsProvisionError:
            return False

    def held(self, station: int) -> frozenset[int]:
        """Return the model's numbers of the keys that a station holds."""
        return frozenset(self.numbers[key.key_id] for key in self.stations[station].keys.keys_of(self.board.uuid))

    def pending(self) -> int:
        """Return the model's number of the key that the node has in RAM, 0 for none."""
        pending = self.board.tim._agreeing._pending
        return 0 if pending is None else self._number_of(pending.agreement.key)

    def note_request(self) -> int:
        """Give the key of the Request that the node has just answered the model's next number."""
        pending = self.board.tim._agreeing._pending
        assert pending is not None
        self.made += 1
        self.numbers[key_id(pending.agreement.key).hex()] = self.made
        return self.made

    def _number_of(self, key: bytes | None) -> int:
        return 0 if key is None else self.numbers[key_id(key).hex()]

    def talk(self, station: int, link: Link | None = None) -> Conversation:
        """Return a conversation of a station with the node, at the reader."""
        identity = Identity.decode(self.board.tim.identity().encode())
        contact = Contact(identity, link or Link(self.board, NAMES[station]), tag_uid=bytes(7))
        return Conversation(contact, notice=lambda notice: None)

    def _plan(self, step: Step, mode: Mode) -> ExportPlan:
        order = ExportOrder((NAMES[step.aim],), (self.board.uuid,), mode)
        return plan_export(self.stations[step.station], order)

    def _sealed(self, station: Station, plan: ExportPlan) -> bytes:
        """Return a bundle, in which the sender lies about the node's sequence."""
        path = self.folder / f"bundle {len(list(self.folder.glob('bundle *')))}"
        known = station.nodes.get(self.board.uuid)
        assert known is not None
        statement = "UPDATE nodes SET sequence = ? WHERE uuid = ?"
        station._store.execute(statement, (_LIE, self.board.uuid))
        export_bundle(station, plan, path)
        station._store.execute(statement, (known.sequence, self.board.uuid))
        return path.read_bytes()


def _ask(prompt: str, confirm: bool) -> str:
    return PASSPHRASE


_STEPS: Final[dict[Kind, Callable[[Desk, Step], None]]] = {
    Kind.CUT: Desk.cut,
    Kind.REQUEST: Desk.request,
    Kind.STORE: Desk.go_on,
    Kind.SEND_CONFIRM: Desk.go_on,
    Kind.END_CONFIRM: Desk.cut,
    Kind.OPEN: Desk.open,
    Kind.FORGET: Desk.forget,
    Kind.MOVE: Desk.move,
    Kind.FILE: Desk.make_file,
    Kind.FILE_AGAIN: Desk.make_file,
    Kind.UNDO: Desk.take_back,
    Kind.COPY: Desk.copy_key,
    Kind.IMPORT: Desk.bring_in,
    Kind.RECEIPT: Desk.take_receipt,
    Kind.BACKUP: Desk.save,
    Kind.RESTORE: Desk.restore,
    Kind.RESET: Desk.reset,
    Kind.PROOF: Desk.prove_reset,
    Kind.CONFIRM: Desk.confirm,
    Kind.LOST_RAM: Desk.lose_ram,
    Kind.SESSION: Desk.begin_session,
    Kind.END_SESSION: Desk.end_session,
    Kind.SIGN: Desk.sign_datasheet,
    Kind.COMMIT: Desk.commit,
}
_REFUSALS: Final[dict[Kind, Callable[[Desk, Step, State], bool]]] = {
    Kind.REQUEST: Desk._refuse_request,
    Kind.OPEN: Desk._refuse_open,
    Kind.MOVE: Desk._refuse_export,
    Kind.COPY: Desk._refuse_export,
    Kind.IMPORT: Desk._refuse_import,
    Kind.RECEIPT: Desk._refuse_receipt,
    Kind.UNDO: Desk._refuse_undo,
    Kind.PROOF: Desk._refuse_proof,
    Kind.SEND_CONFIRM: Desk._refuse_send,
    Kind.CONFIRM: Desk._refuse_confirm,
    Kind.SESSION: Desk._refuse_open,
    Kind.SIGN: Desk._refuse_sign,
    Kind.COMMIT: Desk._refuse_commit,
}


@dataclass
class Replayed:
    """How many steps of a trace were taken, and how many tried that the model refused.

    ``untried`` is the first of those for which the code has no action that could be tried; None if there was one.
    """

    taken: int = 0
    tried: int = 0
    untried: Step | None = None


def replay(desk: Desk, trace: Trace, script: Sequence[Step] = ()) -> Replayed:
    """Take every step of a trace, comparing after each.

    ``script`` has the steps that the trace was made from, if the model refused some of them (None in the trace).
    """
    done, refused = Replayed(), 0
    for at, (step, state) in enumerate(zip(trace.steps, trace.states, strict=True)):
        try:
            if step is not None:
                desk.take(step)
                done.taken += 1
            elif desk.refuse(script[at], state):
                done.tried += 1
            elif not refused:
                done.untried = script[at]
            refused += step is None
            desk.compare(state, thorough=at == len(trace.steps) - 1)
        except SameHandoverError:
            break
        except LostRequestError:
            done.tried += 1
            break
        except (AssertionError, TedsProvisionError) as difference:
            way = ", ".join(str(step or f"(refused: {script[n]})") for n, step in enumerate(trace.steps[: at + 1]))
            raise AssertionError(f"{way}\nThe model: {state}\n{difference}") from difference
    return done
