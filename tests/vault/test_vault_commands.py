"""``vault passphrase`` and ``vault rewrap``: as commands, and cut at every durable write."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path

import pytest

from teds_provision.errors import VaultChangedError, VaultLockedError, WrongPassphraseError
from teds_provision.station.station import Station, rewrap
from teds_provision.station.store.database import Database
from teds_provision.station.store.lock import StoreLock
from teds_provision.vault import agent
from teds_provision.vault.file_vault import FileVault
from teds_provision.vault.master import MasterKeys
from teds_provision.vault.master_socket import MasterSocket, hand_over
from teds_provision.vault.passphrase import THROWAWAY
from teds_provision.vault.selection import forget_vaults
from tests.bench import PASSPHRASE, make_station
from tests.cli.shell import clean_environment, spawn
from tests.vault.softhsm import PIN, loaded, unload

NODES = [number.to_bytes(10, "big") for number in range(1, 5)]
NEW = "four other random words"


class KilledError(BaseException):
    """The process died here."""


@contextmanager
def dying_at(step: int) -> Iterator[list[int]]:
    """Die before the given durable step: a statement of the store, an fsync, a rename, a link. Gives the count."""
    count = [0]

    def counted(real: Callable[..., object]) -> Callable[..., object]:
        def run(*args: object, **more: object) -> object:
            count[0] += 1
            if count[0] == step:
                raise KilledError
            return real(*args, **more)

        return run

    with pytest.MonkeyPatch.context() as patch:
        for owner, names in ((os, ("fsync", "replace", "link")), (Database, ("execute", "change", "execute_many"))):
            for name in names:
                patch.setattr(owner, name, counted(getattr(owner, name)))
        yield count


def asking(*answers: str) -> Callable[[str, bool], str]:
    remaining = list(answers)
    return lambda prompt, confirm: remaining.pop(0)


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Path]:
    """Yield a station with a key of each of four nodes, one of them with a pending key beside it."""
    forget_vaults()
    station = make_station(tmp_path / "home")
    for uuid in NODES:
        station.keys.add_pending(uuid, key=uuid + b"first!", key_id=uuid[-8:], epoch=1)
        station.keys.promote(uuid, uuid[-8:].hex())
    station.keys.add_pending(NODES[0], key=NODES[0] + b"second", key_id=b"pending!", epoch=2)
    station.close()
    yield tmp_path / "home"
    forget_vaults()


def keys(station: Station) -> list[tuple[int, bytes]]:
    return [(held.record.epoch, held.key) for uuid in NODES for held in station.keys.unwrapped(uuid)]


def opened(home: Path, passphrase: str = PASSPHRASE) -> Station:
    forget_vaults()
    return Station.open(home, ask=asking(*[passphrase] * 9))


def test_rewrap_cut_at_every_durable_write_loses_no_key(home: Path) -> None:
    station = opened(home)
    before, wrapped = keys(station), {record.wrapped for record in station.keys.all()}
    station.close()
    step, came = 0, True
    while came:
        step += 1
        station = opened(home)
        station.unlock()
        came = False
        with dying_at(step):
            try:
                rewrap(station)
            except KilledError:
                came = True
        station.close()
        again = opened(home)
        assert keys(again) == before, f"cut before durable step {step}"
        masters = len(again.vault.masters())
        assert masters <= 2
        if not came:
            assert masters == 1
            assert not wrapped & {record.wrapped for record in again.keys.all()}
        again.close()
    assert step > 15


def test_a_run_that_was_cut_is_carried_on_and_not_begun_again(home: Path) -> None:
    station = opened(home)
    station.vault.add_master()
    station.identity.begin_rewrapping(2)
    assert rewrap(station).keys == 5
    assert station.vault.masters() == (2,)
    assert rewrap(station).keys == 5
    assert station.vault.masters() == (3,)
    station.close()


def test_a_key_that_was_lost_before_does_not_keep_the_old_master_key(home: Path) -> None:
    station = opened(home)
    station._store.execute("UPDATE keys SET wrapped = zeroblob(60) WHERE uuid = ?", (NODES[3],))
    done = rewrap(station)
    assert (done.keys, done.damaged) == (4, 1)
    assert station.vault.masters() == (2,)
    station.close()


def test_a_process_that_opened_the_vault_before_goes_on_with_the_new_master_key(home: Path) -> None:
    """A ``--watch`` that runs for hours must neither lose the keys it makes nor fail to read those of others."""
    long_running = opened(home)
    before = keys(long_running)
    other = opened(home)
    rewrap(other)
    assert keys(long_running) == before
    third = opened(home)
    rewrap(third)
    long_running.keys.add_pending(NODES[1], key=b"made later......", key_id=b"later...", epoch=7)
    assert (7, b"made later......") in keys(opened(home))
    rewrap(opened(home))
    named = long_running.keys.unwrap_named({uuid: uuid[-8:].hex() for uuid in NODES})
    assert named == {uuid: (1, uuid + b"first!") for uuid in NODES}, "an export goes on as well"
    assert long_running.keys.unwrap_named({NODES[0]: "00" * 8}) == {}
    for station in (long_running, other, third):
        station.close()


def test_a_new_passphrase_cut_at_every_durable_write_opens_with_the_old_or_the_new(home: Path) -> None:
    before = FileVault.open(home, Station.open(home, ask=asking()).id, asking(PASSPHRASE)).identity().point
    store_id = opened(home).id
    step, came = 0, True
    while came:
        step += 1
        vault = FileVault.open(home, store_id, asking(PASSPHRASE))
        came = False
        with dying_at(step):
            try:
                vault.new_passphrase(asking(NEW), costs=THROWAWAY)()
            except KilledError:
                came = True
        fits = []
        for passphrase in (PASSPHRASE, NEW):
            try:
                assert FileVault.open(home, store_id, asking(passphrase)).identity().point == before
            except WrongPassphraseError:
                continue
            fits.append(passphrase)
        assert len(fits) == 1, f"cut before durable step {step}"
        if fits == [NEW]:
            FileVault.open(home, store_id, asking(NEW)).new_passphrase(asking(PASSPHRASE), costs=THROWAWAY)()
        assert [path.name for path in home.iterdir() if path.name.startswith(".")] == []
    assert step == 4  # the file, its name, the folder, and the run that was not cut


# -- as commands -------------------------------------------------------------------------------------------------------


def passphrase_command(home: Path, old: str, new: str) -> subprocess.CompletedProcess[str]:
    pipes = []
    for secret in (old, new):
        read, write = os.pipe()
        os.write(write, secret.encode() + b"\n")
        os.close(write)
        pipes.append(read)
    words = ["--home", home, "--json", "--passphrase-fd", pipes[0], "vault", "passphrase"]
    words += ["--new-passphrase-fd", pipes[1]]
    done = subprocess.run(
        [sys.executable, "-m", "teds_provision", *map(str, words)],
        pass_fds=pipes,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        stdin=subprocess.DEVNULL,
        env=clean_environment(),
    )
    for read in pipes:
        os.close(read)
    return done


def test_a_new_passphrase_by_command(home: Path) -> None:
    assert passphrase_command(home, "some other words", NEW).returncode == 7
    assert passphrase_command(home, PASSPHRASE, "short").returncode == 7
    done = passphrase_command(home, PASSPHRASE, NEW)
    assert done.returncode == 0, done.stdout
    assert '"keystore": "file"' in done.stdout
    assert PASSPHRASE not in done.stdout + done.stderr
    assert NEW not in done.stdout + done.stderr
    assert spawn("--home", home, "vault", "rewrap", passphrase=PASSPHRASE).code == 7
    assert spawn("--home", home, "vault", "rewrap", passphrase=NEW).code == 0
    station = opened(home, NEW)
    assert len(keys(station)) == 5
    *_, changed, rewrapped = station.audit_log.entries()
    assert changed.outcome == "new passphrase"
    assert (rewrapped.act, rewrapped.outcome, rewrapped.detail) == ("vault", "rewrapped", {"keys": 5, "damaged": 0})
    station.close()


def test_rewrap_by_command_and_its_plan(home: Path) -> None:
    planned = spawn("--home", home, "--json", "vault", "rewrap", "--dry-run")
    assert (planned.code, planned.json["rewrapped"]) == (0, 5)
    done = spawn("--home", home, "--json", "vault", "rewrap", passphrase=PASSPHRASE)
    assert (done.code, done.json) == (0, {"keystore": "file", "rewrapped": 5, "damaged": 0})


def test_the_vault_is_not_changed_while_another_command_holds_the_store(home: Path) -> None:
    with StoreLock(home, command="provision"):
        process = spawn("--home", home, "--json", "vault", "rewrap", passphrase=PASSPHRASE)
    assert process.code == 7
    assert process.json["error"]["code"] == "store-locked"


def changed_passphrase(home: Path) -> Station:
    """Return the station as a command opens it after the passphrase was changed."""
    station = opened(home)
    set_it = station.vault.new_passphrase(asking(NEW))
    with station.lock("test"):
        set_it()
    return station


def test_a_process_that_is_handed_the_master_key_loses_no_key_if_rewrap_is_cut_anywhere(home: Path) -> None:
    long_running = opened(home)
    before = keys(long_running)
    changed_passphrase(home).close()
    with MasterSocket(home, long_running.accept_masters):
        step, came = 0, True
        while came:
            step += 1
            other = opened(home, NEW)
            other.unlock()
            came = False
            with dying_at(step):
                try:
                    rewrap(other)
                except KilledError:
                    came = True
            other.close()
            assert keys(long_running) == before, f"cut before durable step {step}"
            long_running.keys.add_pending(NODES[1], key=b"made here.......", key_id=b"made....", epoch=step + 2)
            restarted = opened(home, NEW)
            assert (step + 2, b"made here.......") in keys(restarted)
            restarted.keys.remove_key(NODES[1], b"made....".hex())
            restarted.close()
    assert long_running.vault.masters() == opened(home, NEW).vault.masters()
    long_running.close()


def test_a_process_that_is_locked_out_says_so_until_the_vault_is_unlocked(home: Path) -> None:
    long_running = opened(home)
    before = keys(long_running)
    other = changed_passphrase(home)
    assert long_running.current_vault() is long_running.vault, "the master key is the same"
    rewrap(other)
    forget_vaults()  # the other process ends
    for act in (lambda: keys(long_running), long_running.unlock, lambda: long_running.plant.keep_login(b"", b"")):
        with pytest.raises(VaultLockedError) as error:
            act()
    assert (error.value.exit_code, error.value.code) == (7, "vault-locked")
    agent.start(home, "file", other.vault.opener(), 60)
    try:
        assert keys(long_running) == before
    finally:
        agent.lock(home)
    assert keys(long_running) == before
    long_running.close()
    other.close()


def test_master_keys_come_only_from_a_process_that_knows_one_of_this_store(home: Path) -> None:
    station = opened(home)
    before = keys(station)
    foreign = MasterKeys.generate()
    assert not station.accept_masters(foreign), "the vault was not opened" if station._vault is None else "another key"
    assert not station.accept_masters(foreign.with_new().newest_only())
    assert station.accept_masters(station.vault.master_keys().with_new())
    here = station.vault.master_keys().keys
    assert not station.accept_masters(MasterKeys({**here, 2: bytes(32)})), "the first key is the same, not the second"
    assert station.vault.master_keys().keys == here
    assert keys(station) == before
    rewrap(other := opened(home))
    assert hand_over(home, other.vault.master_keys()) is None, "no process listens"
    fresh = opened(home)
    fresh.unlock()
    fresh.vault.accept(MasterKeys({1: bytes(32)}))
    assert fresh.accept_masters(other.vault.master_keys()), "they open the key of the seals"
    assert keys(fresh) == before
    for any_station in (station, other, fresh):
        any_station.close()


def test_three_processes_that_wait_for_the_store_lose_no_key(home: Path) -> None:
    """The real thing: all have opened the vault when the first of them gets the store."""
    with ThreadPoolExecutor() as pool, StoreLock(home, command="provision"):
        waiting = [pool.submit(spawn, "--home", home, "vault", "rewrap", passphrase=PASSPHRASE) for _ in range(2)]
        waiting.append(pool.submit(spawn, "--home", home, "trust", "ca", "drop", "--yes", passphrase=PASSPHRASE))
        for act in waiting:
            wait([act], timeout=1.0)
            assert not act.done()
    assert [act.result().code for act in waiting] == [0, 0, 0], [act.result() for act in waiting]
    station = opened(home)
    assert len(keys(station)) == 5
    assert station.vault.masters() == (3,)
    assert station.vault.ca() is None
    station.close()


@pytest.mark.system
def test_what_another_process_did_to_a_tokens_file_is_taken_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from teds_provision.vault.pkcs11 import Pkcs11Vault
    from teds_provision.vault.selection import create_vault

    forget_vaults()
    uri, store = loaded(tmp_path, monkeypatch, ("pair",))["pair"], "77" * 16
    try:
        vault, _ = create_vault(tmp_path, store, uri, asking(PIN))
        other = Pkcs11Vault.open(tmp_path, store, uri, asking(PIN))
        other.add_master()
        set_pin = vault.new_passphrase(asking(PIN, "654321"))
        assert vault.drop_ca()
        assert Pkcs11Vault.open(tmp_path, store, uri, asking(PIN)).masters() == (1, 2)
        late = other.new_passphrase(asking(PIN, "111111"))
        set_pin()
        for change in (late, other.add_master, other.retire_masters, other.drop_ca):
            with pytest.raises(VaultChangedError):
                change()
        Pkcs11Vault.open(tmp_path, store, uri, asking("654321")).retire_masters()
        other.reread()
        assert other.masters() == (2,), "an open session outlasts the PIN that opened it"
        with pytest.raises(VaultChangedError):
            other.add_master()
        assert vault.refresh()
        assert vault.masters() == (2,)
    finally:
        forget_vaults()
        unload()


@pytest.mark.system
def test_a_tokens_pin_and_master_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from teds_provision.station.station import initialise

    forget_vaults()
    uri = loaded(tmp_path, monkeypatch, ("bench",))["bench"]
    try:
        station, _ = initialise(tmp_path / "home", name="bench", keystore=uri, ask=lambda prompt, confirm: PIN)
        station.keys.add_pending(NODES[0], key=bytes(16), key_id=b"pending!", epoch=1)
        rewrap(station)
        assert [held.key for held in station.keys.unwrapped(NODES[0])] == [bytes(16)]
        with pytest.raises(WrongPassphraseError):
            station.vault.new_passphrase(asking("0000", "654321"))()
        station.vault.new_passphrase(asking(PIN, "654321"))()
        station.vault.new_passphrase(asking("654321", PIN))()
        station.close()
    finally:
        forget_vaults()
        unload()
