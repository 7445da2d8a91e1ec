"""Wrapped node keys, master keys that follow one another, and the one line that holds them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import VaultError
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeyRecord
from teds_provision.vault.base import node_key_context
from teds_provision.vault.file_vault import FileVault
from teds_provision.vault.master import MasterKeys, Material
from tests.vault.passphrase import STORE, Person

NODE = bytes(range(10))


def test_a_wrapped_key_opens_only_in_its_own_place(vault: FileVault) -> None:
    key = bytes(range(16))
    place = node_key_context(STORE, NODE, 3, 1)
    wrapped = vault.wrap(key, context=place)
    assert key not in wrapped
    assert vault.unwrap(wrapped, context=place) == key
    for moved in (
        node_key_context("77" * 16, NODE, 3, 1),
        node_key_context(STORE, bytes(10), 3, 1),
        node_key_context(STORE, NODE, 4, 1),
        node_key_context(STORE, NODE, 3, 2),
        b"",
    ):
        with pytest.raises(VaultError):
            vault.unwrap(wrapped, context=moved)


def test_every_flipped_bit_of_a_wrapped_key_is_noticed(vault: FileVault) -> None:
    wrapped = vault.wrap(bytes(16), context=b"c")
    for bit in range(8 * len(wrapped)):
        torn = bytearray(wrapped)
        torn[bit // 8] ^= 1 << bit % 8
        with pytest.raises(VaultError):
            vault.unwrap(bytes(torn), context=b"c")
    for length in range(len(wrapped)):
        with pytest.raises(VaultError):
            vault.unwrap(wrapped[:length], context=b"c")


def test_the_same_key_is_never_wrapped_alike(vault: FileVault) -> None:
    assert len({vault.wrap(bytes(16), context=b"c") for _ in range(100)}) == 100


@given(key=st.binary(max_size=64), context=st.binary(max_size=64))
def test_wrapping_goes_both_ways(key: bytes, context: bytes) -> None:
    masters = MasterKeys.generate()
    assert masters.unwrap(masters.wrap(key, context=context), context=context) == key
    assert masters.with_new().unwrap(masters.wrap(key, context=context), context=context) == key


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), st.binary(min_size=10, max_size=10))
def test_no_two_places_share_a_context(epoch: int, slot: int, uuid: bytes) -> None:
    context = node_key_context(STORE, uuid, epoch, slot)
    assert context.endswith(uuid + epoch.to_bytes(4, "big") + slot.to_bytes(4, "big"))
    assert context != node_key_context(STORE + "0", uuid, epoch, slot)


def test_a_master_change_cut_at_any_point_keeps_every_key(tmp_path: Path, vault: FileVault) -> None:
    key = bytes(range(16))

    def place(record: KeyRecord) -> bytes:
        return node_key_context(STORE, record.uuid, record.epoch, record.slot)

    with Station.make(tmp_path / "home") as store:
        for number in range(3):
            blank = KeyRecord(NODE, number, f"{number:016x}", "pending", number, b"")
            store.keys.add(
                KeyRecord(NODE, number, f"{number:016x}", "pending", number, vault.wrap(key, context=place(blank)))
            )

        def all_open(with_vault: FileVault) -> bool:
            return all(with_vault.unwrap(record.wrapped, context=place(record)) == key for record in store.keys.all())

        def rewrap(record: KeyRecord) -> bytes:
            opened = vault.unwrap(record.wrapped, context=place(record))
            return vault.wrap(opened, context=place(record))

        vault.add_master()
        assert all_open(FileVault.open(tmp_path, STORE, Person()))
        store.keys.wrap_anew(rewrap)
        assert all_open(FileVault.open(tmp_path, STORE, Person()))
        vault.retire_masters()
        vault.retire_masters()
        assert all_open(FileVault.open(tmp_path, STORE, Person()))
        assert list(vault._material.masters.keys) == [2]


def test_the_secret_line_fits_every_keyring_and_goes_both_ways() -> None:
    material = Material.generate()
    material = Material(material.identity, material.ca, material.masters.with_new().with_new())
    line = material.encode()
    assert line.isascii()
    assert line.isprintable()
    assert len(line) < 1280
    assert Material.decode(line) == material
    assert Material.decode(material.with_ca(None).encode()).ca is None


@given(
    st.text(max_size=200) | st.binary(max_size=100).map(lambda b: "teds1:" + __import__("base64").b64encode(b).decode())
)
def test_no_secret_line_raises_anything_foreign(line: str) -> None:
    with pytest.raises(VaultError):
        Material.decode(line)


def test_keys_without_a_master_key_are_damaged() -> None:
    """Nothing could be opened with them, and the next rewrap would begin from none."""
    with pytest.raises(VaultError, match="damaged"):
        Material.decode(replace(Material.generate(), masters=MasterKeys({})).encode())
