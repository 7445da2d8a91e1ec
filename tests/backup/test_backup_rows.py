"""What is in a backup: chunks of any length, other versions, rows from anybody."""

from __future__ import annotations

import io
import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.backup.chunks import CHUNK_OCTETS, ChunkReader, ChunkWriter
from teds_provision.backup.content import BackupHead
from teds_provision.backup.sealed_file import SealedFile, Sealer, write
from teds_provision.errors import BadDataError, NotAuthenticError, StoreError
from teds_provision.station.station import Station
from teds_provision.station.store import dump as rows
from teds_provision.station.store.records import Draft
from teds_provision.station.store.schema import SCHEMA_VERSION
from teds_provision.station.store.store import Store
from teds_provision.teds.image import Image
from teds_provision.vault.passphrase import THROWAWAY
from tests.backup.backups import back_up, opened, opened_octets
from tests.bench import PASSPHRASE


def test_a_store_of_several_chunks_goes_out_and_comes_back(station: Station, tmp_path: Path) -> None:
    filler = {(0, 1): os.urandom(100_000)}
    with station.transaction():
        for number in range(40):
            station.datasheets.keep_draft(Draft(uuid := number.to_bytes(10, "big"), Image(uuid, filler)))
    done = back_up(station, tmp_path / "b")
    assert done.octets > 3 * CHUNK_OCTETS
    octets = (tmp_path / "b").read_bytes()
    with opened(tmp_path / "b") as content:
        assert list(content.copy.rows())[1:] != []
        draft = content.copy.datasheets.draft((39).to_bytes(10, "big"))
        assert draft is not None
        assert draft.image.blocks == filler
    head = octets.index(b"\n") + 1
    full = CHUNK_OCTETS + 16
    first, second = octets[head : head + full], octets[head + full : head + 2 * full]
    assert len(first) == len(second) == full
    swapped = octets[:head] + second + first + octets[head + 2 * full :]
    dropped = octets[:head] + first + octets[head + 2 * full :]
    doubled = octets[:head] + first + first + octets[head + full :]
    cut_at_a_chunk = octets[: head + 2 * full]
    ended_early = cut_at_a_chunk + b"teds-backup end\n"
    for changed in (swapped, dropped, doubled, cut_at_a_chunk, ended_early):
        with pytest.raises((NotAuthenticError, BadDataError)):
            opened_octets(tmp_path, changed)


def test_a_chunk_of_another_backup_of_the_same_station_does_not_fit(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "a")
    back_up(station, tmp_path / "b")
    (head, _), (_, chunks) = ((tmp_path / name).read_bytes().split(b"\n", 1) for name in "ab")
    with pytest.raises(NotAuthenticError):
        opened_octets(tmp_path, head + b"\n" + chunks)


def test_the_chunks_are_those_of_stream_and_the_last_one_alone_is_marked() -> None:
    """By AES-GCM alone, as the construction is published: a file cut off at any chunk must not end well."""
    key, context, out = bytes(range(32)), b"context", io.BytesIO()
    writer = ChunkWriter(out, key, context)
    clear = b"".join(number.to_bytes(1, "big") * CHUNK_OCTETS for number in range(3)) + b"the rest"
    writer.write(clear)
    writer.end()
    octets, full = out.getvalue(), CHUNK_OCTETS + 16
    chunks = [octets[start : start + full] for start in range(0, 4 * full, full)]
    assert chunks[-1].endswith(b"teds-backup end\n")
    chunks[-1] = chunks[-1].removesuffix(b"teds-backup end\n")
    nonces = [number.to_bytes(11, "big") + (b"\1" if number == 3 else b"\0") for number in range(4)]
    opened = [AESGCM(key).decrypt(nonce, chunk, context) for nonce, chunk in zip(nonces, chunks, strict=True)]
    assert b"".join(opened) == clear
    with pytest.raises(BadDataError, match="cut off: its end is missing") as cut:
        ChunkReader(io.BytesIO(b"".join(chunks)), key, context).read(len(clear))
    assert cut.value.hint == "Use another copy."
    for left in range(1, 4):
        reader = ChunkReader(io.BytesIO(b"".join(chunks[:left]) + b"teds-backup end\n"), key, context)
        with pytest.raises(NotAuthenticError):
            reader.read(left * CHUNK_OCTETS)


@pytest.mark.parametrize("length", [0, 1, CHUNK_OCTETS - 1, CHUNK_OCTETS, CHUNK_OCTETS + 1, 2 * CHUNK_OCTETS])
def test_any_length_goes_through_the_chunks(length: int) -> None:
    key, context, out = os.urandom(32), b"context", io.BytesIO()
    writer = ChunkWriter(out, key, context)
    writer.write(b"x" * length)
    writer.end()
    reader = ChunkReader(io.BytesIO(out.getvalue()), key, context)
    assert reader.read(length) == b"x" * length
    reader.require_end()
    assert reader.digest.digest() == writer.digest.digest()
    with pytest.raises(BadDataError):
        reader.read(1)
    with pytest.raises(NotAuthenticError):
        ChunkReader(io.BytesIO(out.getvalue()), key, b"other").require_end()


@pytest.mark.parametrize(("octets", "good"), [(100, True), (101, False)])
def test_a_header_ends_within_its_bound(octets: int, good: bool) -> None:
    key, out = os.urandom(32), io.BytesIO()
    writer = ChunkWriter(out, key, b"context")
    writer.write(b"x" * octets + b"\nrest")
    writer.end()
    reader = ChunkReader(io.BytesIO(out.getvalue()), key, b"context")
    if good:
        assert (reader.read_line(100), reader.read(4)) == (b"x" * octets, b"rest")
    else:
        with pytest.raises(BadDataError, match=r"^The content of the backup has no header\.$"):
            reader.read_line(100)


@pytest.mark.parametrize(
    "line", ['{"format":"teds-backup/1","store":"…"}', '{"protected":"e30","recipients":[],"ciphertext":"","tag":""}']
)
def test_backups_of_version_1_are_refused_by_name(tmp_path: Path, line: str) -> None:
    file = tmp_path / "old.backup"
    file.write_text(line)
    with pytest.raises(StoreError, match="before KeyAgreement 2"):
        SealedFile(file)


class Octets:
    """Octets as a dump is read from."""

    def __init__(self, octets: bytes) -> None:
        self._octets = io.BytesIO(octets)

    def read(self, size: int) -> bytes:
        octets = self._octets.read(size)
        if len(octets) < size:
            raise BadDataError("too early")
        return octets

    def read_line(self, limit: int) -> bytes:
        return self._octets.readline(limit).rstrip(b"\n")


def test_a_dump_comes_back_row_for_row(station: Station) -> None:
    first = b"".join(station.rows())
    with Station.of_backup(Octets(first)) as copy:
        assert b"".join(copy.rows()) == first


def test_a_store_that_is_damaged_in_its_backup_is_refused(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Store, "damage", lambda _store: "row 3 missing from index sightings_by_time")
    with pytest.raises(BadDataError, match="The store in the backup is damaged"):
        Station.of_backup(Octets(b"".join(station.rows())))


def head(tables: dict[str, list[str]], schema: object = SCHEMA_VERSION) -> bytes:
    return json.dumps({"schema": schema, "tables": tables}).encode() + b"\n"


@pytest.mark.parametrize(
    "octets",
    [
        b"",
        b"[]\n",
        b'{"schema": 1}\n',
        b'{"schema": true, "tables": {}}\n',
        head({"sqlite_schema": ["name"]}) + b"\xff\0\0\0\0",
        head({"x; DROP TABLE keys": ["a"]}) + b"\xff\0\0\0\0",
        head({"meta": ["name", "value", "more"]}) + b"\xff\0\0\0\0",
        head({"meta": ["name", "value"]}),
        head({"meta": ["name", "value"]}) + b"\0\xff\xff\xff\xff",
        head({"meta": ["name", "value"]}) + b"\7\0\0\0\0",
        head({"meta": ["name", "value"]}) + b"\0\0\0\0\2\0\0\xff\0\0\0\0",  # NULL where none may be
        head({"meta": ["name", "value"]}) + b"\0\0\0\0\1\0\xff\0\0\0\0",  # a value too few
        head({"meta": ["name", "value"]}) + b"\0\0\0\0\5\2\0\0\1\0\xff\0\0\0\0",  # a text longer than its row
        head({"meta": ["name", "value"]}) + b"\xff\0\0\0\0",  # no identifier
    ],
)
def test_rows_that_are_none_are_bad_data(octets: bytes) -> None:
    with pytest.raises((BadDataError, StoreError)):
        rows.load(Octets(octets))


@given(st.binary(max_size=200))
def test_no_octets_make_a_dump_raise_anything_foreign(octets: bytes) -> None:
    with pytest.raises((BadDataError, StoreError)):
        rows.load(Octets(head({"meta": ["name", "value"], "nodes": []}) + octets))
    with pytest.raises((BadDataError, StoreError)):
        rows.load(Octets(head({"meta": ["name", "value"]}) + octets))


def test_a_newer_schema_is_not_guessed_at() -> None:
    with pytest.raises(StoreError, match="knows up to"):
        rows.load(Octets(head({}, SCHEMA_VERSION + 1) + b"\xff\0\0\0\0"))


class _OtherTime(BackupHead):
    """A head that is not the one in the clear."""

    def line(self, form: str) -> bytes:
        return replace(BackupHead(**vars(self)), created="2030-01-01T00:00:00Z").line(form)


def test_the_head_in_the_clear_is_that_of_the_content(station: Station, tmp_path: Path) -> None:
    head = _OtherTime(station.id, station.point, "north", "2026-01-01T00:00:00Z", "file", "")
    sealer = Sealer(passphrase=PASSPHRASE, costs=THROWAWAY)
    with (tmp_path / "b").open("wb") as file:
        key = write(file, head, (), station.vault.identity(), sealer)
    with pytest.raises(NotAuthenticError, match="different station"):
        SealedFile(tmp_path / "b").open_with_content_key(key)


def test_nothing_follows_the_end_in_the_last_chunk_either() -> None:
    out = io.BytesIO()
    chunks = ChunkWriter(out, bytes(32), b"context")
    chunks.write(b"the end, and more")
    chunks.end()
    reader = ChunkReader(io.BytesIO(out.getvalue()), bytes(32), b"context")
    assert reader.read(7) == b"the end"
    with pytest.raises(BadDataError, match="data after its end"):
        reader.require_end()
