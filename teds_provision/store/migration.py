"""From schema 1 to 2: what stood as settings by name, and images as JSON, moved into tables of their own.

Nothing is lost that version 1 kept but the journal of steps, which nothing read. Rows that carry a MAC since have none
yet: the station takes them over, once and listed, when its vault opens (``teds_provision.station.seals``).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from teds_provision.errors import BadData
from teds_provision.lazy import late
from teds_provision.store.packing import datasheet_row, packed
from teds_provision.store.records import utc_now
from teds_provision.teds.image import Image

if TYPE_CHECKING:
    import sqlite3
else:  # loaded with the first store: --help does not wait for it
    sqlite3 = late("sqlite3")


_FACTS = ("station_name", "keystore", "keystore_why", "requested_point", "station_point", "ca_point")
_PAGE = 200


@contextmanager
def carry(connection: sqlite3.Connection, step: int) -> Iterator[None]:
    """Set aside what ``step`` would drop, let the statements of that step run, and put it into the new tables."""
    if step != 2:
        yield
        return
    for name, statement in (
        ("old_settings", "SELECT substr(name, 9) AS name, value FROM meta WHERE name GLOB 'setting:*'"),
        ("old_images", "SELECT uuid, image, seen FROM node_images"),
        ("old_drafts", "SELECT uuid, image, stage, profile, created FROM drafts"),
    ):
        connection.execute(f"CREATE TEMP TABLE {name} AS {statement}")
    yield
    settings = dict(connection.execute("SELECT name, value FROM old_settings"))
    _station(connection, settings)
    _certificates(connection, settings)
    _marks(connection, settings)
    _datasheets(connection)
    _drafts(connection)
    for name in ("old_settings", "old_images", "old_drafts"):
        connection.execute(f"DROP TABLE {name}")


def _station(connection: sqlite3.Connection, settings: dict[str, str]) -> None:
    if "keystore" not in settings:
        return  # an init that was cut off before it had made anything
    name, keystore, why, *points = (settings.get(fact) for fact in _FACTS)
    signature = settings.get("station_signature")
    requested, point, ca = (bytes.fromhex(value) if value else None for value in points)
    connection.execute(
        "INSERT INTO station(one, name, keystore, keystore_why, requested, point, ca, signature)"
        " VALUES(1, ?, ?, ?, ?, ?, ?, ?)",
        (name or "station", keystore, why or "", requested, point, ca, bytes.fromhex(signature) if signature else None),
    )


def _certificates(connection: sqlite3.Connection, settings: dict[str, str]) -> None:
    rows = ((*name.split(":")[1:], bytes.fromhex(value)) for name, value in _named(settings, "certificate:") if value)
    connection.executemany("INSERT INTO certificates VALUES(?, ?, ?)", rows)


def _marks(connection: sqlite3.Connection, settings: dict[str, str]) -> None:
    marks: dict[bytes, dict[str, Any]] = {}
    for prefix in ("ca-of:", "next-ca:", "rotate:", "former-identity:"):
        for name, value in _named(settings, prefix):
            if not value:  # how version 1 wrote "no more"
                continue
            mark = marks.setdefault(bytes.fromhex(name.partition(":")[2]), {})
            if prefix == "ca-of:":
                mark["ca"] = bytes.fromhex(value)
            elif prefix == "next-ca:":
                mark["next_key_id"], _, ca = value.partition(":")
                mark["next_ca"] = bytes.fromhex(ca)
            else:
                mark["rotation" if prefix == "rotate:" else "former"] = value
    columns = ("ca", "next_key_id", "next_ca", "rotation", "former")
    connection.executemany(
        f"INSERT INTO marks(uuid, {', '.join(columns)}) VALUES(?, ?, ?, ?, ?, ?)",
        ((uuid, *(mark.get(column) for column in columns)) for uuid, mark in marks.items()),
    )


def _named(settings: dict[str, str], prefix: str) -> Iterator[tuple[str, str]]:
    return ((name, value) for name, value in settings.items() if name.startswith(prefix))


def _datasheets(connection: sqlite3.Connection) -> None:
    for uuid, text, seen in _paged(connection, "old_images", "uuid, image, seen"):
        image = _image(text, uuid)
        if image is not None:
            connection.execute(
                "INSERT INTO datasheets(uuid, sequence, epoch, signed, profile, seen, digest, blocks)"
                " VALUES(?, ?, ?, ?, ?, ?, ?, ?)",
                datasheet_row(image, None, str(seen)),
            )


def _drafts(connection: sqlite3.Connection) -> None:
    for uuid, text, stage, profile, created in _paged(connection, "old_drafts", "uuid, image, stage, profile, created"):
        image = _image(text, uuid)
        if image is not None:
            row = (uuid, packed(image), stage, profile, created or utc_now())
            connection.execute("INSERT INTO drafts VALUES(?, ?, ?, ?, ?)", row)


def _paged(connection: sqlite3.Connection, table: str, columns: str) -> Iterator[tuple[Any, ...]]:
    """Rows of a temporary table a page at a time: a store of 100,000 nodes has a gigabyte of images."""
    statement = f"SELECT rowid, {columns} FROM {table} WHERE rowid > ? ORDER BY rowid LIMIT {_PAGE}"
    last = 0
    while rows := connection.execute(statement, (last,)).fetchall():
        yield from (tuple(row[1:]) for row in rows)
        last = rows[-1][0]


def _image(text: object, uuid: bytes) -> Image | None:
    """An image of version 1; one that no version wrote (a damaged row) is left out, as reading it failed before."""
    try:
        image = Image.from_json(str(text))
    except BadData:
        return None
    return image if image.uuid == uuid else None
