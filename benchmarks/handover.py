"""Export and import of 10,000 node keys beside the floor of their parts (issue 13 row 9).

Run: ``python -m benchmarks.handover [COUNT]``. Ours is everything between the command and its end but the terminal:
reading and unwrapping keys, the bundle, the file, the store's transaction with its sync to disk, the receipt. The floor
is what no program that keeps the contract is spared, each by the quickest library at hand: JWS and JWE over the payload
with JSON (jwcrypto), AES-GCM over every key, HMAC over every row that is sealed, and the rows read or written by SQLite
with executemany. All in seconds of the processor, so that a busy machine spoils little. Aim: 1.6 times the floor.
"""

from __future__ import annotations

import hmac
import json
import os
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from jwcrypto import jwe, jwk, jws

from teds_provision.handover.incoming import ImportResult, import_bundle, plan_import
from teds_provision.handover.outgoing import ExportOrder, export_bundle, plan_export
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.bundle import TYPE, open_bundle, payload_of
from teds_provision.protocol.handover.strict_json import dump, load_object
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.wire_agreement import key_id
from teds_provision.station.station import Station, initialise
from teds_provision.station.store.records import NodeRecord, TrustRecord, WhitelistEntry
from teds_provision.vault import passphrase

ROUNDS = 3
AIM = 1.6


def make(home: Path, name: str) -> Station:
    def ask(prompt: str, confirm: bool) -> str:
        return "correct horse battery"

    return initialise(home, name=name, keystore="file", ask=ask, costs=passphrase.THROWAWAY)[0]


def fill(station: Station, count: int) -> None:
    """Fill a store with nodes that have a proven key each, as after provisioning."""
    with station.transaction():
        for number in range(count):
            uuid, key = number.to_bytes(10, "big"), number.to_bytes(16, "big")
            point = SoftwareKey(1 + number % 97).point
            identifier = key_id(key)
            station.keys.add_pending(uuid, key=key, key_id=identifier, epoch=3)
            station.keys.promote(uuid, identifier.hex())
            station.pins.put(WhitelistEntry(uuid, fingerprint(point)))
            name, profile = f"finger {number}", "tactile-finger-sensor"
            record = NodeRecord(uuid, point, name, profile, 2, 3, 7, teds_sha256="ab" * 32)
            station.nodes.put(record)
        station.groups.create("left hand", [number.to_bytes(10, "big") for number in range(count)])


def timed(work: Callable[[], object]) -> tuple[float, object]:
    begun = time.process_time()
    result = work()
    return time.process_time() - begun, result


def bare(payload: bytes, north: jwk.JWK, south: jwk.JWK) -> tuple[float, float]:
    """Return the seconds that jwcrypto takes to sign and seal, and to open and verify, JSON to JSON."""
    members = json.loads(payload)
    sealed = ""

    def seal() -> None:
        nonlocal sealed
        inner = jws.JWS(json.dumps(members, separators=(",", ":")))
        inner.add_signature(north, None, json.dumps({"alg": "ES256", "kid": "north", "typ": "teds-handover+jws"}))
        outer = jwe.JWE(
            inner.serialize(compact=True).encode(),
            json.dumps({"alg": "ECDH-ES+A256KW", "enc": "A256GCM", "cty": "JWS"}),
        )
        outer.add_recipient(south, json.dumps({"kid": "south"}))
        sealed = outer.serialize()

    def open_() -> None:
        outer = jwe.JWE()
        outer.deserialize(sealed, south)
        inner = jws.JWS()
        inner.deserialize(outer.payload.decode(), north)
        assert json.loads(inner.payload)["count"] == len(members["nodes"])

    return min(timed(seal)[0] for _ in range(ROUNDS)), min(timed(open_)[0] for _ in range(ROUNDS))


_TABLES = {
    "nodes": 1,
    "whitelist": 1,
    "keys": 0,
    "key_slots": 0,
    "holders": 0,
    "marks": 1,
    "groups": 0,
    "group_members": 0,
}
"""What an import writes, and how many seals a row of it has."""


def rest(south: Station, empty: Station, count: int) -> tuple[float, float]:
    """Return processor seconds of the other parts of an export and an import: AES-GCM, HMAC, SQLite."""
    rows = {table: south._store.execute(f"SELECT * FROM {table}") for table in _TABLES}
    cipher, context, key = AESGCM(bytes(32)), bytes(60), bytes(16)
    sealed = cipher.encrypt(bytes(12), key, context)

    def seals(number: int) -> None:
        for _ in range(number):
            hmac.digest(key, bytes(120), "sha256")

    def export() -> None:
        for table in ("nodes", "whitelist", "keys"):
            south._store.execute(f"SELECT * FROM {table}")
        for _ in range(count):
            cipher.decrypt(bytes(12), sealed, context)
        seals(2 * count)

    def take_in() -> None:
        for _ in range(count):
            cipher.encrypt(os.urandom(12), key, context)
        seals(sum(_TABLES[table] * len(row) for table, row in rows.items()))
        with empty.transaction():
            for table, row in rows.items():
                marks = ", ".join("?" * len(row[0])) if row else "NULL"
                empty._store.execute_many(f"INSERT OR REPLACE INTO {table} VALUES({marks})", row)

    return min(timed(export)[0] for _ in range(ROUNDS)), min(timed(take_in)[0] for _ in range(1))


def jose_layer(payload: bytes) -> tuple[float, float]:
    """Return the seconds that our own JOSE layer takes for the same, JSON to JSON."""
    members = json.loads(payload)
    north, south = SoftwareKey(1), SoftwareKey(2)
    sealed = b""

    def seal() -> None:
        nonlocal sealed
        sealed = jose.encrypt(jose.sign_compact(dump(members), north, typ=TYPE), [south.point], cty="JWS")

    def open_() -> None:
        signed = jose.decrypt(sealed, south, cty="JWS", max_octets=64 << 20)
        trusted = {fingerprint(north.point): north.point}.get
        verified = jose.verify_compact(signed, trusted, typ=TYPE, max_octets=64 << 20)
        assert load_object(verified.payload, "")["count"] == len(members["nodes"])

    return min(timed(seal)[0] for _ in range(ROUNDS)), min(timed(open_)[0] for _ in range(ROUNDS))


def main(count: int = 10_000) -> None:
    jwe.default_max_compressed_size = 64 << 20
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        north = make(place / "north", "north")
        fill(north, count)
        exports, imports = [], []
        for number in range(ROUNDS):
            south = make(place / f"south{number}", f"south {number}")
            for station, other in ((north, south), (south, north)):
                station.policy.trust(TrustRecord(other.name, "station", other.point, other.fingerprint))
            bundle = place / f"{number}.jwe"
            order = ExportOrder((south.name,), None, "copy")
            exports.append(timed(partial(_export, north, order, bundle))[0])

            def take(station: Station = south, path: Path = bundle) -> ImportResult:
                plan = plan_import(station, path.read_bytes())
                assert not isinstance(plan, ImportResult)
                return import_bundle(station, plan)

            seconds, done = timed(take)
            assert isinstance(done, ImportResult)
            assert len(done.uuids) == count
            imports.append(seconds)
        octets = bundle.read_bytes()
        opened = open_bundle(octets, south.vault.identity(), {north.fingerprint: north.point}.get, datetime.now(UTC))
        payload = payload_of(opened.bundle)
        keys = [jwk.JWK.generate(kty="EC", crv="P-256") for _ in range(2)]
        theirs = bare(payload, *keys)
        layer = jose_layer(payload)
        print(f"{count} keys, payload {len(payload) / 1e6:.1f} MB, bundle {len(octets) / 1e6:.1f} MB; best of {ROUNDS}")
        parts = rest(south, make(place / "empty", "empty"), count)
        for at, (name, elapsed) in enumerate((("export", min(exports)), ("import", min(imports)))):
            floor = theirs[at] + parts[at]
            met = "met" if elapsed < AIM * floor else "MISSED"
            parts_text = f"jwcrypto {theirs[at]:.2f} s, AES-GCM, HMAC and SQLite {parts[at]:.2f} s"
            print(f"  {name}: ours {elapsed:.2f} s; floor {parts_text}: {elapsed / floor:.2f} ×, aim {AIM} ×: {met}")
        for name, ours, bare_tool in (("sign and seal", layer[0], theirs[0]), ("open and verify", layer[1], theirs[1])):
            print(
                f"  JOSE alone, {name}: ours {ours:6.3f} s, jwcrypto {bare_tool:6.3f} s, ratio {ours / bare_tool:5.2f}"
            )
        memory(place, north, count)


def _export(station: Station, order: ExportOrder, bundle: Path) -> object:
    return export_bundle(station, plan_export(station, order), bundle)


def memory(place: Path, north: Station, count: int) -> None:
    """Print the peak of what Python allocates in one export and one import."""
    south = make(place / "memory", "memory")
    for station, other in ((north, south), (south, north)):
        station.policy.trust(TrustRecord(other.name, "station", other.point, other.fingerprint))
    bundle = place / "memory.jwe"
    for name, work in (
        ("export", lambda: export_bundle(north, plan_export(north, ExportOrder(("memory",), None, "copy")), bundle)),
        ("import", lambda: import_bundle(south, plan_import(south, bundle.read_bytes()))),  # type: ignore[arg-type]
    ):
        tracemalloc.start()
        work()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        print(f"  {name}: peak of {peak / 1e6:.0f} MB in Python, {peak / count / 1e3:.1f} kB per key")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
