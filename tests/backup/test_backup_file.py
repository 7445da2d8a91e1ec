"""The file of a backup: private, whole, opened by passphrase or recovery key, and told apart from every damage."""

from __future__ import annotations

import base64
import errno
import hashlib
import io
import json
import shutil
import subprocess
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.kdf.argon2 import Argon2id

from teds_provision import __version__
from teds_provision.backup import sealed_file as backup_file
from teds_provision.backup.restore import open_present
from teds_provision.backup.sealed_file import SealedFile, Sealer
from teds_provision.errors import BadDataError, NotAuthenticError, NotFoundError, PolicyError, WrongPassphraseError
from teds_provision.protocol.keys import SoftwareKey, fingerprint, verify
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord
from tests.backup.backups import ONE, POINT, SEALED, TWO, back_up, copy_of, opened, opened_octets, restored_into


def test_the_file_is_private_whole_and_holds_no_secret(station: Station, tmp_path: Path) -> None:
    path = tmp_path / "station.backup"
    done = back_up(station, path)
    octets = path.read_bytes()
    assert (done.nodes, done.keys, done.sealed_to, done.warnings) == (2, 3, "passphrase", ())
    assert path.stat().st_mode & 0o777 == 0o600
    head = json.loads(octets.split(b"\n", 1)[0])
    assert set(head) == {"format", "store", "station", "created", "key", "sha256"}
    assert station.vault.secret_material().encode() not in octets
    assert ONE not in octets
    assert ONE.hex().encode() not in octets
    assert [left.name for left in tmp_path.iterdir() if left.name.startswith(".")] == []
    assert "material" not in repr(opened(path))


def test_a_backup_is_opened_by_its_description_alone(station: Station, tmp_path: Path) -> None:
    """By hashes, Argon2id and AES-GCM: a backup of today must open in every later version."""
    path = tmp_path / "station.backup"
    back_up(station, path)
    octets = path.read_bytes()
    line, _, chunks = octets.partition(b"\n")
    head = json.loads(line)
    assert list(head) == ["format", "store", "station", "created", "key", "sha256"]
    clear = {name: head[name] for name in ("format", "store", "station", "created")}
    assert (clear["format"], clear["store"], clear["station"]) == ("teds-backup/2", station.id, station.fingerprint)

    def canonical(members: dict[str, object]) -> bytes:
        return json.dumps(members, separators=(",", ":"), ensure_ascii=False).encode()

    rest = {name: head[name] for name in head if name != "sha256"}
    assert head["sha256"] == hashlib.sha256(canonical(rest)).hexdigest()
    sealed = head["key"]
    salt, nonce, ciphertext = (base64.b64decode(sealed[name]) for name in ("salt", "nonce", "ciphertext"))
    under = Argon2id(
        salt=salt, length=32, iterations=sealed["iterations"], lanes=sealed["lanes"], memory_cost=sealed["memory_kib"]
    ).derive(SEALED.encode())
    key = AESGCM(under).decrypt(nonce, ciphertext, b"teds-backup/2\0" + canonical(clear))
    assert len(key) == 32
    bound = hashlib.sha256(line + b"\n").digest()
    content = AESGCM(key).decrypt(bytes(11) + b"\1", chunks.removesuffix(b"teds-backup end\n"), bound)
    inner, _, rows = content.partition(b"\n")
    assert json.loads(inner) == {
        "format": "teds-backup/2", "store": station.id, "station": station.fingerprint, "point": station.point.hex(),
        "name": station.name, "created": clear["created"], "keystore": "file", "version": __version__,
        "material": station.vault.secret_material(),
    }  # fmt: skip
    signed, signature = content[:-64], content[-64:]
    assert verify(station.point, b"TEDS1 backup\0" + bound + hashlib.sha256(signed).digest(), signature)
    assert rows.startswith(b"".join(station.rows())[:40]), "then the rows (docs/store.md), of one moment"


def test_a_wrong_passphrase_and_every_kind_of_damage_are_distinguished(station: Station, tmp_path: Path) -> None:
    path = tmp_path / "station.backup"
    back_up(station, path)
    octets = path.read_bytes()
    with pytest.raises(WrongPassphraseError):
        opened_octets(tmp_path, octets, "other words here")
    step = max(1, len(octets) // 150)
    for place_ in range(0, len(octets) - 1, step):
        changed = bytearray(octets)
        changed[place_] ^= 1
        with pytest.raises((NotAuthenticError, BadDataError)):
            opened_octets(tmp_path, bytes(changed))
    with pytest.raises((BadDataError, NotAuthenticError)):
        opened_octets(tmp_path, octets + b"more")
    for length in (0, 1, 70, len(octets) // 2, len(octets) - 2):
        with pytest.raises(BadDataError):
            opened_octets(tmp_path, octets[:length])


def test_who_recomputes_the_digest_still_needs_the_passphrase(station: Station, tmp_path: Path) -> None:
    path = tmp_path / "station.backup"
    back_up(station, path)
    line, chunks = path.read_bytes().split(b"\n", 1)
    document = json.loads(line)
    document.pop("sha256")
    document["created"] = "2030-01-01T00:00:00Z"
    forged = backup_file.dump({**document, "sha256": backup_file.digest_of(document)})
    with pytest.raises(WrongPassphraseError):
        opened_octets(tmp_path, forged + b"\n" + chunks)


@pytest.mark.parametrize("octets", [b"", b"{}", b"[]", b"\0" * 1000, b'{"format": "teds-image/1"}', b"{" * 100_000])
def test_what_is_no_backup_is_bad_data(tmp_path: Path, octets: bytes) -> None:
    (tmp_path / "b").write_bytes(octets)
    with pytest.raises(BadDataError):
        SealedFile(tmp_path / "b")


def test_a_recovery_key_opens_it_and_no_other(station: Station, tmp_path: Path) -> None:
    recovery, path = SoftwareKey.generate(), tmp_path / "station.backup"
    back_up(station, path, recovery.point)
    sealed = SealedFile(path)
    assert sealed.is_for_key
    with sealed.open_with_key(recovery) as content:
        assert content.point == station.point
    with pytest.raises(PolicyError) as refused:
        sealed.open_with_key(SoftwareKey.generate())
    digits = fingerprint(recovery.point)[:32]
    assert refused.value.message == f"The backup is sealed to the recovery key {digits}, not to this one."
    path.write_bytes(path.read_bytes().replace(b'"tag":"', b'"tag":"A', 1))
    with pytest.raises((NotAuthenticError, BadDataError)):
        SealedFile(path).open_with_key(recovery)


def test_a_backup_to_a_key_of_the_station_itself_is_warned_of(station: Station, tmp_path: Path) -> None:
    """Neither its own key nor its CA key is there when the station is lost."""
    for number, point in enumerate((station.point, station.ca)):
        assert any(
            "if the station is lost" in text for text in back_up(station, tmp_path / f"{number}", point).warnings
        )
    assert back_up(station, tmp_path / "2", SoftwareKey.generate().point).warnings == ()


def test_a_backup_that_another_key_has_signed_is_not_the_stations(station: Station, tmp_path: Path) -> None:
    """Whoever has the public recovery key can seal something; it must not pass for this station."""
    recovery, path, forger = SoftwareKey.generate(), tmp_path / "station.backup", SoftwareKey.generate()
    back_up(station, path, recovery.point)
    sealer = Sealer(recovery=recovery.point)
    with SealedFile(path).open_with_key(recovery) as real, path.open("wb") as file:
        backup_file.write(file, real, real.copy.rows(), forger, sealer)
    with pytest.raises(NotAuthenticError, match="not signed"):
        SealedFile(path).open_with_key(recovery)
    with copy_of(station, tmp_path) as real, path.open("wb") as file:
        backup_file.write(file, replace(real, point=forger.point), real.copy.rows(), forger, sealer)
    forged = SealedFile(path).open_with_key(recovery)
    with pytest.raises(PolicyError, match=r"the store in .* is of station"):
        open_present(station.home, forged)
    with pytest.raises(NotAuthenticError):
        restored_into(tmp_path / "new", forged)
    assert not (tmp_path / "new" / "store.sqlite3").exists()


@pytest.mark.system
def test_the_jose_tool_opens_a_backup_with_the_recovery_key(station: Station, tmp_path: Path) -> None:
    if shutil.which("jose") is None:
        pytest.skip("the Debian package jose is not installed (scripts/install-test-packages)")
    from teds_provision.protocol.handover.jose import public_jwk
    from teds_provision.protocol.handover.strict_json import encode_base64url

    recovery = SoftwareKey.generate()
    back_up(station, tmp_path / "b", recovery.point)
    jwk = {**public_jwk(recovery.point), "d": encode_base64url(recovery.secret())}
    (tmp_path / "k.jwk").write_text(json.dumps(jwk))
    line = (tmp_path / "b").read_bytes().split(b"\n", 1)[0]
    (tmp_path / "key.jwe").write_text(json.dumps(json.loads(line)["key"]))
    words = ["jose", "jwe", "dec", "-i", str(tmp_path / "key.jwe"), "-k", str(tmp_path / "k.jwk")]
    own = subprocess.run(words, capture_output=True, check=True, timeout=60).stdout
    with SealedFile(tmp_path / "b").open_with_content_key(own) as content:
        assert content.store == station.id


def test_a_backup_taken_while_the_store_is_written_is_one_moment(station: Station, tmp_path: Path) -> None:
    stop, home = threading.Event(), station.home

    def write() -> None:
        with Station.inspect(home) as store:
            number = 10
            while not stop.is_set():
                number += 1
                with store.transaction():
                    for uuid in (ONE, TWO):
                        store.nodes.restore(NodeRecord(uuid, POINT, sequence=number))
                stop.wait(0.002)  # SQLite's writers wait their turn without a queue

    writer = threading.Thread(target=write)
    writer.start()
    try:
        for _ in range(20):
            with copy_of(station, tmp_path) as content:
                sequences = {record.sequence for record in content.copy.nodes.all()}
                assert len(sequences) == 1
                assert content.copy.audit_log.check().intact
    finally:
        stop.set()
        writer.join()


def test_a_disk_that_fails_while_a_backup_is_opened_is_named(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    back_up(station, tmp_path / "b")
    sealed = SealedFile(tmp_path / "b")

    class Failing(io.BytesIO):
        def seek(self, _place: int, _whence: int = 0, /) -> int:
            raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(backup_file, "open_to_read", lambda _path: Failing())
    with pytest.raises(NotFoundError) as failed:
        sealed.open_with_passphrase(SEALED)
    assert failed.value.message == f"{tmp_path / 'b'} cannot be read: Input/output error."
