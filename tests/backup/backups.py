"""A station to back up, and backups made, opened and restored, for the tests of this room."""

from __future__ import annotations

from pathlib import Path

from teds_provision.backup.backup import BackupResult, backup
from teds_provision.backup.content import Content
from teds_provision.backup.restore import RestoreResult, rebuild
from teds_provision.backup.sealed_file import SealedFile
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.station.station import Station
from teds_provision.vault.passphrase import THROWAWAY
from teds_provision.vault.selection import forget_vaults

from ..bench import PASSPHRASE

FIXTURES = Path(__file__).parent / "fixtures"
SEALED = "sealed under other words"
ONE, TWO, NEW = (bytes.fromhex(f"8d4d9da65281f700000{n}") for n in (1, 2, 3))
POINT = SoftwareKey.generate().point


def ask(prompt: str, confirm: bool) -> str:
    return SEALED if "backup" in prompt else PASSPHRASE


def add_key(station: Station, uuid: bytes, epoch: int, *, active: bool = True) -> bytes:
    key = bytes([epoch]) * 16
    key_id = epoch.to_bytes(8, "big")
    station.keys.add_pending(uuid, key=key, key_id=key_id, epoch=epoch)
    if active:
        station.keys.promote(uuid, key_id.hex())
    return key


def keys_of(station: Station, uuid: bytes) -> list[tuple[int, str, bytes]]:
    return [(held.record.epoch, held.record.state, held.key) for held in station.keys.unwrapped(uuid)]


def back_up(station: Station, path: Path, recovery: bytes | None = None) -> BackupResult:
    return backup(station, path, ask, recovery=recovery, costs=THROWAWAY)


def opened(path: Path) -> Content:
    return SealedFile(path).open_with_passphrase(SEALED)


def opened_octets(folder: Path, octets: bytes, passphrase: str = SEALED) -> Content:
    (folder / "octets").write_bytes(octets)
    return SealedFile(folder / "octets").open_with_passphrase(passphrase)


def copy_of(station: Station, folder: Path) -> Content:
    """Return the station as it is now, as a backup that was opened."""
    back_up(station, folder / "copy.backup")
    return opened(folder / "copy.backup")


def restored_into(home: Path, content: Content) -> RestoreResult:
    forget_vaults()
    return rebuild(home, content, ask, costs=THROWAWAY)
