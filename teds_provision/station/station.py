"""The base station on this machine: it opens, locks, audits and closes, and holds the parts.

============  ======================================================================
part          content
============  ======================================================================
``identity``  name, key, owner's CA, certificates
``keys``      link keys, the CA of each node, other holders, rotations due
``pins``      the whitelist, and the pinned key of each UUID
``policy``    trusted stations and CAs, the deny list, nodes given away
``nodes``     each node's record and names
``datasheets`` what each node had, was read of it last, and is being given
``firmware_reports`` what each node last reported of its firmware
``overview``  all that is known of nodes, across the topics
``groups``    nodes that are measured together
``measurements`` measurements, also after a restart; detection; names
``handovers`` bundles that left and came
``plant``     the joined registry, and events for its other stations
``bulk``      many rows of several topics as one change
``row_macs``  MACs over the rows that decide whom the station trusts
============  ======================================================================

Opening a station reads the store only; the vault opens at the first secret.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from teds_provision.errors import (
    NoPassphraseError,
    NotFoundError,
    UnknownMasterKeyError,
    VaultChangedError,
    VaultError,
    VaultLockedError,
)
from teds_provision.lazy import late
from teds_provision.protocol import keys
from teds_provision.station.bulk import Bulk
from teds_provision.station.datasheets import Datasheets
from teds_provision.station.firmware_reports import FirmwareReports
from teds_provision.station.groups import Groups
from teds_provision.station.handovers import Handovers
from teds_provision.station.identity import DEFAULT_NAME, StationIdentity
from teds_provision.station.measurements import Measurements
from teds_provision.station.node_keys import NodeKey, NodeKeys
from teds_provision.station.nodes import Nodes
from teds_provision.station.overview import Overview
from teds_provision.station.pins import Pins
from teds_provision.station.plant.plant import Plant
from teds_provision.station.policy import Policy
from teds_provision.station.row_macs import RowMacs
from teds_provision.station.store.audit import AuditLog
from teds_provision.station.store.background_writer import BackgroundWriter
from teds_provision.station.store.dump import RowSource, dump, load
from teds_provision.station.store.lock import NodeLock, StoreLock
from teds_provision.station.store.records import KeyRecord
from teds_provision.station.store.row_sample import RowSample
from teds_provision.station.store.sqlite import has_store
from teds_provision.station.store.store import Store
from teds_provision.vault.base import Ask, Vault, node_key_context
from teds_provision.vault.master import MasterKeys

if TYPE_CHECKING:
    from teds_provision.vault import master_socket, selection
else:
    # Sockets and processes; commands such as `nodes` open no vault.
    master_socket, selection = late("teds_provision.vault.master_socket"), late("teds_provision.vault.selection")

__all__ = ["DEFAULT_NAME", "NodeKey", "Station", "initialise", "not_certified", "not_initialised"]


@dataclass(frozen=True)
class _JoiningStep:
    """Rows for the transaction of the next durable step, and a callback once they are stored."""

    write: Callable[[], object]
    kept: Callable[[], object]


@dataclass
class _DurableRun:
    """A run of steps: its background writer, and the number of its ``last`` commit that was not waited for.

    ``joining``: what its next durable step writes as well.
    """

    background: BackgroundWriter
    last: int = 0
    joining: list[_JoiningStep] = field(default_factory=list)


class Station:
    """A base station (NCAP) on this machine."""

    def __init__(self, store: Store, ask: Ask, notify: Callable[[str], object] = lambda text: None) -> None:
        self._store = store
        self._ask = ask
        self._vault: Vault | None = None
        self._turn, self._held = threading.RLock(), 0
        self._opening = threading.RLock()
        self._runs = threading.local()
        self.notice: Callable[[str], object] = lambda text: None
        """Receives one sentence about what this station waits for."""
        self.released: Callable[[bytes, str], AbstractContextManager[object]] = lambda uuid, command: nullcontext()
        """``with station.released(uuid, "write"):`` no process of this home measures the node during the block.

        A command that writes enters it before it contacts the node. Raises PolicyError if a running `ncap` does not
        release the node; if none runs, or in that process itself, there is nothing to do.
        """
        self.service_runs: Callable[[], bool] = lambda: False
        """Returns True if a running `ncap` of this home answers, which could release a node that it measures."""
        self.use_agent = True
        """True if an agent's secret (``unlock``) opens the vault; False if the passphrase itself is asked for."""
        store.notice = lambda text: self.notice(text)  # noqa: PLW0108 - it is replaced later
        self.row_macs = RowMacs(self._opened)
        self.identity = StationIdentity(store, self._opened, self.row_macs)
        self.plant = Plant(store, self.current_vault, self.identity, self.row_macs)
        self.nodes = Nodes(store, self.row_macs, self.plant)
        self.firmware_reports = FirmwareReports(store, self.row_macs)
        self.datasheets = Datasheets(store, self.nodes, self.firmware_reports)
        self.keys = NodeKeys(store, self._opened, self.identity, self.row_macs, self._reopened, self.plant)
        self.pins = Pins(store, self.nodes, self.datasheets, self.keys, self.row_macs, self.plant)
        self.handovers = Handovers(store)
        self.policy = Policy(
            store, self.identity, self.keys, self.pins, self.handovers, self.row_macs, self.plant, notify
        )
        self.groups = Groups(store, store.home, self.plant)
        self.measurements = Measurements(store, self.groups, store.home)
        self.overview = Overview(store)
        self.bulk = Bulk(store, self.nodes, self.pins, self.keys, self.policy, self.groups)
        self.row_macs.sources = (
            self.identity.mac_rows,
            self.policy.mac_rows,
            self.pins.mac_rows,
            self.nodes.mac_rows,
            self.keys.mac_rows,
            self.firmware_reports.mac_rows,
            self.policy.decision_rows,
            self.plant.mac_rows,
        )

    @classmethod
    def open(cls, home: Path, *, ask: Ask, notify: Callable[[str], object] = lambda text: None) -> Station:
        """Open the station of ``home``; raises NotFoundError if init was never finished.

        ``ask`` gives a passphrase when the vault opens, ``notify`` gets messages for the user.
        """
        if not has_store(home):
            raise not_initialised(home)
        station = cls(Store.open(home), ask, notify)
        if not station.identity.is_complete():
            asked = station.identity.requested is not None
            station.close()
            raise not_certified() if asked else not_initialised(home)
        return station

    @classmethod
    def make(cls, home: Path, *, ask: Ask | None = None) -> Station:
        """Open the station of ``home``, as far as init has come; its store is made if it is missing."""
        return cls(Store.open(home, create=True), ask or _ask_no_one)

    @classmethod
    def of_backup(cls, rows: RowSource) -> Station:
        """Return the station in a backup, as a private copy without a vault.

        Raises BadDataError (form, unknown tables, rows that break a rule), StoreError.
        """
        return cls(load(rows), _ask_no_one)

    @classmethod
    def inspect(cls, home: Path, *, ask: Ask | None = None) -> Station:
        """Open the station of ``home`` to look at it, also one whose init was not finished.

        Without ``ask`` no passphrase is asked for: what needs the vault raises NoPassphraseError. Raises StoreError.
        """
        return cls(Store.open(home), ask or _ask_no_one)

    def close(self) -> None:
        """Close the store."""
        self._store.close()

    def __enter__(self) -> Station:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # -- identity --------------------------------------------------------------------------------------------------

    @property
    def home(self) -> Path:
        """The folder of the store."""
        return self._store.home

    @property
    def id(self) -> str:
        """Identifier of the store, 32 hex digits: wrapped keys and the audit log are bound to it."""
        return self._store.id

    @property
    def name(self) -> str:
        """The station's name."""
        return self.identity.name

    @property
    def point(self) -> bytes:
        """P(base station), 65 octets."""
        return self.identity.point

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the station's key."""
        return self.identity.fingerprint

    @property
    def ca(self) -> bytes:
        """P(CA) of the owner, 65 octets."""
        return self.identity.ca

    # -- secrets ---------------------------------------------------------------------------------------------------

    @property
    def vault(self) -> Vault:
        """The vault, unlocked at first use."""
        return self._opened()

    def _opened(self) -> Vault:
        if self._vault is None:
            self._store.drain()
            with self._opening:  # only one thread asks for the passphrase
                if self._vault is None:
                    keystore = self.identity.keystore
                    self.adopt(selection.open_vault(self.home, self.id, keystore, self._ask, use_agent=self.use_agent))
        assert self._vault is not None
        return self._vault

    def adopt(self, vault: Vault) -> None:
        """Use a vault that is open; raises StoreChangedError if the store no longer matches it."""
        self._vault = vault  # needed to make and check row MACs
        try:
            self._check_row_macs(vault)
        except BaseException:
            self._vault = None
            raise

    def _check_row_macs(self, vault: Vault) -> None:
        try:
            self.identity.unlocked(vault)
        except UnknownMasterKeyError:  # another command changed the master key after the vault was opened
            if not vault.refresh():
                raise
            self.identity.unlocked(vault)
        self.policy.unlocked()

    def ask_by(self, ask: Ask) -> None:
        """Ask for the passphrase by another function from now on."""
        self._ask = ask

    def _reopened(self) -> Vault:
        """Read the master keys again after another command has changed them. No person is asked: the store may be held.

        Raises VaultLockedError if the vault has another passphrase by now and ``unlock`` does not hold it open.
        """
        with self._opening:
            vault = self._opened()
            try:
                vault.reread()
                return vault
            except VaultChangedError as changed:
                if self.identity.master in vault.masters():  # the command that made the new key handed it over
                    return vault
                try:
                    opened = selection.open_vault(
                        self.home, self.id, self.identity.keystore, _ask_no_one, use_agent=True
                    )
                except VaultError:
                    raise VaultLockedError(
                        "The vault's passphrase and master key were changed by another command.",
                        hint="To let a running ncap continue: teds-provision unlock. Start any other command again.",
                    ) from changed
                self.adopt(opened)
                return opened

    def current_vault(self) -> Vault:
        """Return the vault with the master key that wraps now; raises VaultLockedError, VaultError."""
        vault = self._opened()
        return vault if self.identity.master in vault.masters() else self._reopened()

    def accept_masters(self, masters: MasterKeys) -> bool:
        """Use master keys that a command of this user hands over; False if they are not those of this store.

        They are if the sender knows one that is in use here, or if they open the key of this store's row MACs.
        """
        with self._opening:
            vault = self._vault
            if vault is None or self.identity.master not in masters.keys:
                return False
            here = vault.master_keys().keys
            common = here.keys() & masters.keys.keys()
            if any(here[number] != masters.keys[number] for number in common):
                return False
            if not common and not self.identity.opened_by(masters):
                return False
            vault.accept(masters)
            return True

    def unlock(self, uuid: bytes | None = None) -> None:
        """Open the vault now, so that no passphrase is asked for while the store is locked or a node waits.

        With ``uuid`` only if a key of that node is held, as nothing is unwrapped otherwise.
        """
        if uuid is None or self.keys.held(uuid):
            self.current_vault()

    def credentials(self, uuid: bytes | None = None) -> keys.Credentials:
        """Return the credentials for node ``uuid`` under the CA that this node keeps, else the station's own."""
        return self.identity.credentials(None if uuid is None else self.keys.ca_of(uuid))

    def damage(self, sample: RowSample | None = None) -> str | None:
        """Return what is wrong with the store's file, None if nothing; with ``sample`` of large tables those rows."""
        return self._store.damage(sample)

    def version(self) -> int:
        """Return a number that changes exactly when another process has changed the store: earlier plans are stale."""
        return self._store.version()

    def require_known_schema(self) -> None:
        """Raise NewerStoreError if a newer version of this tool has brought the store to its schema meanwhile."""
        self._store.require_known_schema()

    def changes(self) -> tuple[int, int]:
        """Return what differs after any change of the store, by this process or another one."""
        return self._store.changes()

    def rows(self) -> Iterator[bytes]:
        """Yield the whole store as it is at one moment (see :mod:`teds_provision.station.store.dump`)."""
        return dump(self._store)

    # -- locks, transactions, and the actor of the audit log -------------------------------------------------------

    @contextmanager
    def lock(self, command: str, notice: Callable[[str], object] | None = None) -> Iterator[None]:
        """Hold the store: one command, and one thread of it, at a time; waits, then names the holder.

        May be nested in the same thread.
        """
        self._store.drain()
        with self._turn:
            if self._held:
                yield
                return
            with StoreLock(self.home, command=command, notice=notice or self.notice):
                self._held += 1
                try:
                    yield
                finally:
                    self._held -= 1

    @contextmanager
    def durable(self, command: str, *, more_follows: bool = False) -> Iterator[None]:
        """Run one durable step: the store held, and all of the block on the disk or nothing of it.

        Never held while a node is talked to: a slow node would delay every other command. ``more_follows``: in a
        :meth:`run` it may reach the disk together with the step after it. Only for data that was not promised to any
        party before: a loss of power in between is then as one an instant earlier.
        """
        run: _DurableRun | None = getattr(self._runs, "now", None)
        later = run is not None and more_follows
        with self.lock(command):
            joined: list[_JoiningStep] = []
            try:
                with self._store.transaction(later=later):
                    if run is not None:
                        if later:
                            run.last = self._store.commits_not_waited_for + 1  # the number of this commit
                        while run.joining:  # a failing step is removed, and makes this one fail
                            step = run.joining.pop(0)
                            step.write()
                            joined.append(step)
                    yield
            except BaseException:
                if run is not None:  # they are rolled back with this step
                    run.joining = [*joined, *run.joining]
                raise
            for step in joined:
                step.kept()

    @contextmanager
    def run(self) -> Iterator[None]:
        """Run several steps of one thread; all are durable when the block has ended."""
        self._runs.now = run = _DurableRun(BackgroundWriter(self._store.background))
        try:
            try:
                yield
            finally:
                try:
                    self.write_joining()
                finally:
                    self._runs.now = None
                    run.background.close()
        finally:
            self._store.flush(run.last)  # only this run's commits: other threads flush their own

    def run_in_background(self, step: Callable[[], object]) -> None:
        """Run a durable write during exchanges with the node: within :meth:`run` in its background thread, else now.

        Later calls of the store wait for it and raise its error; the run ends after it. So the order of durable writes
        is that of the program, and only messages to the node may overtake this one: use it only if no message that may
        follow depends on it. Not inside a durable step.
        """
        run: _DurableRun | None = getattr(self._runs, "now", None)
        if run is None:
            step()
            return

        def taken() -> None:
            self._runs.now = run  # this thread runs the step
            try:
                step()
            finally:
                self._runs.now = None

        run.background.submit(taken)

    def join_next_step(self, write: Callable[[], object], kept: Callable[[], object] = lambda: None) -> None:
        """Have rows written in the transaction of the next durable step of this :meth:`run`; elsewhere at once.

        It saves a commit for what no message before that step depends on, and what nothing before it reads. If that
        step is undone they join the one after it; the run ends with them at the latest. An error that ``write`` raises
        is that step's, and then it is not written. ``kept`` is called when the rows are. Not inside a durable step.
        """
        run: _DurableRun | None = getattr(self._runs, "now", None)
        if run is not None:
            self._store.drain()
            run.joining.append(_JoiningStep(write, kept))
            return
        with self.durable("run"):
            write()
        kept()

    def write_joining(self) -> None:
        """Write now what waits for the next durable step of this thread's run."""
        run: _DurableRun | None = getattr(self._runs, "now", None)
        if run is not None and run.joining:
            with self.durable("run"):
                pass

    def flush(self) -> None:
        """Wait until all that this thread's run has written is on the disk; outside a run it is."""
        run: _DurableRun | None = getattr(self._runs, "now", None)
        if run is not None:
            self._store.flush(run.last)

    def node_lock(self, uuid: bytes) -> NodeLock:
        """Have one node to oneself: two commands of this station do not work on the same node at once."""
        return NodeLock(self.home, uuid, notice=self.notice)

    def transaction(self) -> AbstractContextManager[None]:
        """Write all of the block to the disk, or nothing of it; may be nested."""
        return self._store.transaction()

    def reading(self) -> AbstractContextManager[None]:
        """Read many things of one moment; the block must not contact nodes or wait."""
        return self._store.reading()

    def audit(self, act: str, uuid: bytes | None, outcome: str, **detail: object) -> None:
        """Append to the audit log: who did what to which node, with which outcome; never a secret."""
        self._store.audit.append(act, uuid, outcome, detail)

    @property
    def audit_log(self) -> AuditLog:
        """The audit log, to be read and checked."""
        return self._store.audit


def _ask_no_one(_prompt: str, _confirm: bool) -> str:
    raise NoPassphraseError("The vault's passphrase is needed.", hint="teds-provision unlock")


def not_initialised(home: Path) -> NotFoundError:
    """Return the error for a home without a station."""
    return NotFoundError(f"There is no base station in {home} yet.", hint="To create one: teds-provision init")


def not_certified() -> NotFoundError:
    """Return the error for a station that requested a certificate and has none yet."""
    return NotFoundError(
        "This station is waiting for its CA's certificate.",
        hint="To install it: teds-provision init --certificate CERT",
    )


def initialise(
    home: Path,
    *,
    name: str | None,
    keystore: str | None,
    ask: Ask,
    costs: object | None = None,
    notify: Callable[[str], object] = lambda text: None,
) -> tuple[Station, str]:
    """Make the station key and the CA key, or open what an earlier run made; returns it and why this keystore.

    Each part is durable before the next begins, so that an interrupted init is carried on by the same command.
    """
    station = Station.make(home, ask=ask)
    if station.identity.is_complete():
        return station, station.identity.keystore_why
    reported: set[str] = set()

    def notify_once(text: str) -> None:
        if text not in reported:
            reported.add(text)
            notify(text)

    def make(known: Ask) -> str:
        with StoreLock(home, command="init"):
            if station.identity.is_complete():  # another init was first
                return station.identity.keystore_why
            if station.identity.requested is not None:
                raise not_certified()
            more: dict[str, Any] = {} if costs is None else {"costs": costs}
            vault, why = selection.create_vault(home, station.id, keystore, known, notify=notify_once, **more)
            key, ca = vault.identity(), vault.ca()
            if ca is None:
                raise NotFoundError(
                    "The vault does not contain a CA key.", hint="Choose another keystore, or import the CA key."
                )
            station.adopt(vault)
            with station.transaction():
                where = keystore if keystore and keystore.startswith("pkcs11:") else vault.kind
                station.identity.establish(name, where, why)
                station.identity.complete(key.point, ca.point, ca.sign(keys.station_key_message(key.point)))
                station.audit("init", None, "done", fingerprint=keys.fingerprint(key.point), keystore=vault.kind)
            return why

    return station, selection.asked_first(ask, make)


# A new master key: every link key in the store is wrapped again, and the old master key is deleted.
#
# Each part is durable before the next begins, so that a later run can continue an interrupted one: the new master key,
# a note in the store with its number, the keys (one transaction), deletion of the old master keys, removal of the note.
# At each moment, the vault opens all keys in the store. A process that opened the vault before learns from the note
# that it must read it again (:class:`.node_keys.NodeKeys`).


@dataclass(frozen=True)
class RewrapResult:
    """Numbers of keys: wrapped under the new master key, and damaged (no master key opens them; left unchanged)."""

    keys: int
    damaged: int


def rewrap(station: Station) -> RewrapResult:
    """Wrap every link key under a new master key; the caller holds the StoreLock and has unlocked the vault.

    Raises VaultError and its leaves, StoreError; the same command carries on.
    """
    vault, identity = station.vault, station.identity
    vault.refresh()
    if identity.rewrapping != vault.masters()[-1]:
        # otherwise an earlier run made a new one and was cut before the note
        if vault.masters()[-1] <= identity.master:
            vault.add_master()
        # other processes need the new one before any row does
        master_socket.hand_over(station.home, vault.master_keys())
        identity.begin_rewrapping(vault.masters()[-1])
    damaged = 0

    def anew(record: KeyRecord) -> bytes:
        nonlocal damaged
        context = node_key_context(station.id, record.uuid, record.epoch, record.slot)
        try:
            key = vault.unwrap(record.wrapped, context=context)
        except VaultError:  # damaged before this run; that is no reason to keep the old master key
            damaged += 1
            return record.wrapped
        return vault.wrap(key, context=context)

    count = station.keys.wrap_anew(anew)
    identity.rewrap(vault)
    station.plant.rewrap(vault)
    vault.retire_masters()
    master_socket.hand_over(station.home, vault.master_keys())
    with station.transaction():
        identity.end_rewrapping()
        station.audit("vault", None, "rewrapped", keys=count - damaged, damaged=damaged)
    return RewrapResult(count - damaged, damaged)
