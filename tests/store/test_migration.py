"""A store that version 0.1 made opens, whole: every key, pin, mark, image and entry of the log is there."""

from __future__ import annotations

import hashlib
import json
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from teds_provision.errors import StoreFailure
from teds_provision.store import Store
from teds_provision.store.schema import SCHEMA_VERSION
from teds_provision.vault import forget_vaults, node_key_context, open_vault

MADE = Path(__file__).parent / "fixtures" / "version1"
PASSPHRASE = "correct horse battery"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A home as version 0.1 left it."""
    place = tmp_path / "home"
    place.mkdir(mode=0o700)
    for name in ("store.sqlite3", "vault.json"):
        shutil.copy(MADE / name, place / name)
        (place / name).chmod(0o600)
    forget_vaults()
    return place


@pytest.fixture
def store(home: Path) -> Iterator[Store]:
    with Store.open(home) as opened:
        yield opened


@pytest.fixture
def expected() -> dict[str, Any]:
    return dict(json.loads((MADE / "expected.json").read_text()))


def test_the_fixture_is_of_schema_1() -> None:
    with closing(sqlite3.connect(f"file:{MADE / 'store.sqlite3'}?mode=ro&immutable=1", uri=True)) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (1,)


def test_facts_whitelist_pins_and_trust_are_what_they_were(store: Store, expected: dict[str, Any]) -> None:
    facts = store.facts()
    assert facts is not None
    assert facts.point is not None
    assert facts.ca is not None
    assert (facts.name, facts.keystore) == ("north", "file")
    assert (facts.point.hex(), facts.ca.hex()) == (expected["point"], expected["ca"])
    assert {entry.uuid.hex(): entry.fingerprint for entry in store.whitelist()} == expected["whitelist"]
    assert [record.name for record in store.trusted()] == expected["trusted"]
    assert {record.uuid.hex() for record in store.nodes()} == expected["nodes"].keys()
    assert len(store.certificates()) == 3


def test_every_link_key_still_opens_under_the_vault(home: Path, store: Store, expected: dict[str, Any]) -> None:
    vault = open_vault(home, store.id, "file", lambda prompt, confirm: PASSPHRASE)
    opened = {}
    for key in store.all_keys():
        context = node_key_context(store.id, key.uuid, key.epoch, key.slot)
        clear = vault.unwrap(key.wrapped, context=context)
        opened[f"{key.uuid.hex()}:{key.key_id}"] = hashlib.sha256(clear).hexdigest()
    assert opened == expected["link_keys"]
    assert [[key.uuid.hex(), key.epoch, key.key_id, key.state] for key in store.all_keys()] == expected["keys"]


def test_settings_by_name_became_marks(store: Store, expected: dict[str, Any]) -> None:
    marks = store.all_marks()
    assert {uuid.hex(): mark.rotation for uuid, mark in marks.items() if mark.rotation} == expected["rotations"]
    assert {uuid.hex(): mark.ca.hex() for uuid, mark in marks.items() if mark.ca} == expected["cas"]
    assert {uuid.hex(): mark.former for uuid, mark in marks.items() if mark.former} == expected["former"]


def test_images_and_drafts_came_along_as_octets(store: Store, expected: dict[str, Any]) -> None:
    assert {uuid: record.digest for uuid in expected["images"] if (record := store.datasheet(bytes.fromhex(uuid)))} == (
        expected["images"]
    )
    assert {draft.uuid.hex(): draft.stage for draft in store.drafts()} == expected["drafts"]


def test_handovers_tombstones_and_the_deny_list_stay(store: Store, expected: dict[str, Any]) -> None:
    assert [one.uuid.hex() for one in store.tombstones()] == expected["tombstones"]
    assert [one.uuid.hex() for one in store.revocations()] == expected["revoked"]
    assert len(store.handovers()) == expected["handovers"]


def test_the_audit_log_goes_on_where_it_ended(store: Store, expected: dict[str, Any]) -> None:
    verdict = store.audit.check()
    assert (verdict.intact, verdict.count, verdict.head) == (True, *expected["audit"])
    store.audit.append("test", None, "done")
    assert store.audit.check().count == verdict.count + 1


def test_nothing_of_the_old_tables_is_left(home: Path, store: Store) -> None:
    tables = {str(row[0]) for row in store._database.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")}
    assert not tables & {"steps", "node_images"}
    assert store._database.one("SELECT count(*) FROM meta WHERE name GLOB 'setting:*'") == (0,)
    assert store.damage() is None
    store.close()
    with Store.open(home) as again:  # and a second opening has nothing to bring forward
        assert again._database.one("PRAGMA user_version") == (SCHEMA_VERSION,)


def test_a_migration_that_fails_leaves_the_store_as_it_was(home: Path) -> None:
    with closing(sqlite3.connect(home / "store.sqlite3")) as database, database:
        database.execute("UPDATE meta SET value = 'no hex' WHERE name = 'setting:ca_point'")
    with pytest.raises(StoreFailure):
        Store.open(home)
    with closing(sqlite3.connect(home / "store.sqlite3")) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (1,)
        assert database.execute("SELECT count(*) FROM node_images").fetchone()[0] > 0


def test_an_image_that_no_version_wrote_is_left_out_and_the_rest_comes(home: Path, expected: dict[str, Any]) -> None:
    lost = next(iter(expected["images"]))
    with closing(sqlite3.connect(home / "store.sqlite3")) as database, database:
        database.execute("UPDATE node_images SET image = '{' WHERE uuid = ?", (bytes.fromhex(lost),))
    with Store.open(home) as store:
        kept = {record.uuid.hex() for record in store.nodes() if store.datasheet(record.uuid) is not None}
    assert kept == expected["images"].keys() - {lost}
