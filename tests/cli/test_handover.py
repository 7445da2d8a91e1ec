"""``export-keys``, ``import-keys``, ``handover`` as typed: results, exit codes, and every kind of bad input."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

from teds_provision.cli.station import handover
from teds_provision.errors import BadDataError, NotAuthenticError, PolicyError
from teds_provision.handover.incoming import NodeProof, NodeProofFailure
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.bundle import TYPE, Bundle, BundledNode, payload_of, seal_bundle
from teds_provision.protocol.handover.strict_json import base64url, decode_base64url, dump
from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message, to_pem
from teds_provision.vault.selection import forget_vaults
from tests.bench import PASSPHRASE
from tests.handover.desk import Pair, everything, session
from tests.handover.victim import open_station

from .shell import Outcome, call, spawn

UUIDS = ["8d4d9da65281f7000001", "8d4d9da65281f7000002"]


class Homes:
    """North with two keyed nodes, south without; commands run in this process, unlocked by a passphrase."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.north, self.south = folder, folder / "north", folder / "south"

    def run(self, home: Path, *words: object) -> Outcome:
        read, write = os.pipe()
        os.write(write, PASSPHRASE.encode() + b"\n")
        os.close(write)
        forget_vaults()
        try:
            return call(home, "--json", "--passphrase-fd", read, *words)
        finally:
            os.close(read)

    def export(self, *words: object, name: str = "keys.jwe") -> Path:
        done = self.run(self.north, "export-keys", "--to", "south", "--yes", "--output", self.folder / name, *words)
        assert done.code == 0, done
        return self.folder / name

    def refused(self, code: int, *words: object, home: Path | None = None) -> dict[str, Any]:
        """Return a command that fails with one clear cause and changes nothing."""
        home = home or self.south
        before = self.state(home)
        done = self.run(home, *words)
        assert done.code == code, done
        assert self.state(home) == before
        error: dict[str, Any] = done.json["error"]
        assert error["message"].count("\n") == 0
        return error

    def state(self, home: Path) -> object:
        station = open_station(home)
        try:
            return everything(station)
        finally:
            station.close()


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pair")
    Pair.make(folder, 2).close()
    return folder


@pytest.fixture
def homes(prepared: Path, tmp_path: Path) -> Iterator[Homes]:
    shutil.copytree(prepared, tmp_path / "pair")
    yield Homes(tmp_path / "pair")
    forget_vaults()


# -- the way it goes --------------------------------------------------------------------------------------------------


def test_a_copy_there(homes: Homes) -> None:
    output = homes.folder / "keys.jwe"
    done = homes.run(homes.north, "export-keys", "--to", "south", "--all", "--output", output, "--yes").json
    assert (done["bundle"], done["mode"], done["count"], done["nodes"]) == (str(output), "copy", 2, UUIDS)
    assert [to["name"] for to in done["to"]] == ["south"]
    assert output.stat().st_mode & 0o777 == 0o600
    taken = homes.run(homes.south, "import-keys", output, "--yes").json
    assert (taken["id"], taken["count"], taken["imported"], taken["refused"]) == (done["id"], 2, UUIDS, [])
    assert taken["from"] == done["from"]
    assert Path(taken["receipt"]).read_bytes().count(b".") == 2
    assert (taken["proven"], taken["pending"]) == ([], UUIDS)
    again = homes.run(homes.south, "import-keys", output, "--yes").json
    assert (again["fresh"], again["imported"]) == (False, UUIDS)
    closed = homes.run(homes.north, "handover", "receipt", taken["receipt"]).json
    assert (closed["state"], closed["imported"], closed["fresh"]) == ("closed", UUIDS, True)


def test_a_move_and_its_receipt_lost_and_found(homes: Homes) -> None:
    path = homes.export("--all", "--mode", "move")
    taken = homes.run(homes.south, "import-keys", path, "--yes").json
    receipt = Path(taken["receipt"])
    first = receipt.read_bytes()
    receipt.unlink()
    assert homes.run(homes.south, "import-keys", path, "--yes").code == 0
    assert receipt.read_bytes() == first
    (row,) = homes.run(homes.north, "handover", "list").json["handovers"]
    assert (row["state"], row["mode"], row["names"]) == ("open", "move", ["south"])
    before = homes.state(homes.north)
    plan = homes.run(homes.north, "handover", "receipt", receipt, "--dry-run").json
    assert (plan["plan"], plan["state"], plan["fresh"], plan["imported"]) == (True, "closed", True, UUIDS)
    shown = call(homes.north, "handover", "receipt", receipt, "--dry-run").out
    assert shown == "Plan, nothing is changed:\nStation south imported 2 nodes; their keys would be deleted here.\n"
    assert homes.state(homes.north) == before
    for fresh in (True, False):
        assert homes.run(homes.north, "handover", "receipt", receipt).json["fresh"] is fresh
    (row,) = homes.run(homes.north, "handover", "list").json["handovers"]
    assert row["state"] == "closed"


def test_a_folder_of_receipts_completes_every_move_and_names_what_is_none(homes: Homes) -> None:
    folder = homes.folder / "receipts"
    folder.mkdir()
    for name, uuid in zip("ac", UUIDS, strict=True):
        path = homes.export(uuid, "--mode", "move", name=f"{name}.jwe")
        taken = homes.run(homes.south, "import-keys", path, "--yes", "--receipt", folder / f"{name}.receipt")
        assert taken.code == 0
    (folder / "b.receipt").write_text("none")
    (folder / "d.receipt.old").write_text("none")
    done = homes.run(homes.north, "handover", "receipt", folder)
    assert done.code == 8
    assert done.json["error"]["code"] == "bad-data"
    assert [closed["imported"] for closed in done.json["receipts"]] == [[uuid] for uuid in UUIDS]
    assert {row["state"] for row in homes.run(homes.north, "handover", "list").json["handovers"]} == {"closed"}
    homes.refused(3, "handover", "receipt", homes.folder / "north" / "batches", home=homes.north)
    (folder / "b.receipt").unlink()
    again = homes.run(homes.north, "handover", "receipt", folder)
    assert (again.code, [closed["fresh"] for closed in again.json["receipts"]]) == (0, [False, False])


@pytest.mark.parametrize(
    ("words", "contacted", "code"),
    [
        ((), 0, 0),
        (("--prove",), 1, 5),  # one of the two was not reached
        (("--can", "udp_multicast:239.74.163.2"), 1, 0),
        (("--can", "udp_multicast:239.74.163.2", "--no-prove"), 0, 0),
    ],
)
def test_each_node_of_a_bundle_is_contacted_if_a_link_is_named_and_only_prove_needs_them_all(
    homes: Homes, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], contacted: int, code: int
) -> None:
    asked: list[list[str]] = []

    def prove_nodes(_station: Any, _links: Any, uuids: Any, _reporter: Any, *, hold: Any) -> list[Any]:
        asked.append([uuid.hex() for uuid in uuids])
        return [NodeProof(uuids[0], 1, rotated=False), NodeProofFailure(uuids[1], "No node answered.")]

    monkeypatch.setattr(handover, "prove_nodes", prove_nodes)
    done = homes.run(homes.south, "import-keys", homes.export("--all"), "--yes", *words)
    assert (done.code, asked) == (code, [UUIDS] * contacted)
    assert done.json["not_proven"] == ({UUIDS[1]: "No node answered."} if contacted else {})


def test_the_plan_of_a_receipt_whose_move_was_undone_is_refused_and_leaves_no_entry(homes: Homes) -> None:
    path = homes.export("--all", "--mode", "move")
    receipt = Path(homes.run(homes.south, "import-keys", path, "--yes").json["receipt"])
    (row,) = homes.run(homes.north, "handover", "list").json["handovers"]
    assert homes.run(homes.north, "handover", "undo", row["id"], "--yes").code == 0
    error = homes.refused(6, "handover", "receipt", receipt, "--dry-run", home=homes.north)
    assert error["message"].startswith("This move was undone here, but station south took 2 keys in all the same.")


def test_an_export_again_finds_nothing_to_do(homes: Homes) -> None:
    path = homes.export("--all", "--mode", "move")
    octets, before = path.read_bytes(), homes.state(homes.north)
    homes.export("--all", "--mode", "move")
    assert (path.read_bytes(), homes.state(homes.north)) == (octets, before)


def test_a_dry_run_reports_and_changes_nothing(homes: Homes) -> None:
    before = homes.state(homes.north), homes.state(homes.south)
    output = homes.folder / "keys.jwe"
    plan = homes.run(homes.north, "export-keys", "--to", "south", "--all", "--mode", "move", "--output", output,
                     "--dry-run").json  # fmt: skip
    assert (plan["plan"], plan["count"], plan["id"]) == (True, 2, None)
    assert not output.exists()
    assert homes.state(homes.north) == before[0]
    homes.export("--all")
    plan = homes.run(homes.south, "import-keys", output, "--dry-run").json
    assert (plan["plan"], plan["imported"], plan["receipt"]) == (True, UUIDS, None)
    assert set(plan["decisions"].values()) == {"new"}
    assert homes.state(homes.south) == before[1]
    assert not (homes.folder / "keys.jwe.receipt").exists()


def test_people_are_shown_both_fingerprints_in_fours_and_what_it_means(homes: Homes) -> None:
    from teds_provision.handover.trust import spoken

    station = open_station(homes.north)
    both = [spoken(station.fingerprint), *(spoken(record.fingerprint) for record in station.policy.trusted())]
    station.close()
    screens = {}
    for mode in ("copy", "move"):
        words = ["export-keys", "--to", "south", "--all", "--mode", mode, "--output", homes.folder / f"{mode}.jwe"]
        done = spawn("--home", homes.north, *words, "--yes", passphrase=PASSPHRASE)
        assert done.code == 0
        assert all(digits in done.err for digits in both)
        screens[mode] = done.err
    assert "can impersonate a node to the other" in screens["copy"]
    assert "when the other station has rotated them" in screens["move"]
    done = spawn("--home", homes.south, "import-keys", homes.folder / "move.jwe", "--yes", passphrase=PASSPHRASE)
    assert all(digits in done.err for digits in both)
    assert "will be trusted for these nodes only" in done.err


def test_a_move_lists_who_else_holds_a_copy(homes: Homes) -> None:
    from teds_provision.station.store.records import TrustRecord

    north = open_station(homes.north)
    west = SoftwareKey(61)
    north.policy.trust(TrustRecord("west", "station", west.point, fingerprint(west.point)))
    north.close()
    words = ["export-keys", "--all", "--yes", "--output"]
    assert homes.run(homes.north, *words, homes.folder / "copy.jwe", "--to", "west").code == 0
    move = [*words, homes.folder / "move.jwe", "--to", "south", "--mode", "move"]
    assert homes.run(homes.north, *move, "--dry-run").json["also_held_by"] == [fingerprint(west.point)]
    outcome = spawn("--home", homes.north, *move, passphrase=PASSPHRASE)
    assert "also held by west from an earlier copy" in outcome.err


def test_it_asks_and_gets_no_answer(homes: Homes) -> None:
    output = homes.folder / "keys.jwe"
    homes.refused(6, "export-keys", "--to", "south", "--all", "--output", output, home=homes.north)
    assert not output.exists()
    homes.export("--all")
    homes.refused(6, "import-keys", output)


@pytest.mark.parametrize("way", ["export", "import"])
def test_what_another_command_changes_while_a_plan_is_made_is_not_overlooked(
    homes: Homes, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    from teds_provision.cli.station import handover as command
    from teds_provision.handover.life import revoke

    path = homes.export("--all") if way == "import" else homes.folder / "keys.jwe"
    home = homes.south if way == "import" else homes.north
    name = "plan_import" if way == "import" else "plan_exports"
    plan, planned = getattr(command, name), []

    def and_another_revokes(station: object, *what: object, **more: object) -> object:
        planned.append(plan(station, *what, **more))
        if len(planned) == 1:
            other = open_station(home)
            revoke(other, bytes.fromhex(UUIDS[0]), "stolen")
            other.close()
        return planned[-1]

    monkeypatch.setattr(command, name, and_another_revokes)
    words = ["import-keys", path] if way == "import" else ["export-keys", "--to", "south", "--all", "--output", path]
    done = homes.run(home, *words, "--yes")
    assert (done.code, len(planned)) == (6, 2)
    assert "Another command changed the plan" in done.json["error"]["message"]
    assert path.exists() == (way == "import")


def test_undo_by_the_first_digits_of_the_id(homes: Homes) -> None:
    homes.export(UUIDS[0], "--mode", "move")
    (row,) = homes.run(homes.north, "handover", "list").json["handovers"]
    assert homes.run(homes.north, "handover", "undo", row["id"][:8], "--dry-run").json["plan"] == "undo"
    undone = homes.run(homes.north, "handover", "undo", row["id"][:8], "--yes").json
    assert (undone["state"], undone["nodes"]) == ("undone", [UUIDS[0]])
    error = homes.refused(6, "export-keys", "--to", "south", UUIDS[0], "--output", homes.folder / "x", "--yes",
                          home=homes.north)  # fmt: skip
    assert "must be rotated first" in error["message"]


# -- what a user gets wrong -------------------------------------------------------------------------------------------


def test_a_receiver_that_is_none(homes: Homes) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    files = {
        "private.pem": (key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()), 8, "private key"),
        "rsa.pem": (_public(rsa.generate_private_key(65537, 2048)), 8, "not a P-256 key"),
        "p384.pem": (_public(ec.generate_private_key(ec.SECP384R1())), 8, "not a P-256 key"),
        "stranger.pem": (_public(key), 6, "is not trusted here"),
    }
    output = homes.folder / "keys.jwe"
    for name, (octets, code, message) in files.items():
        (homes.folder / name).write_bytes(octets)
        words = ["export-keys", "--to", homes.folder / name, "--all", "--output", output, "--yes"]
        assert message in homes.refused(code, *words, home=homes.north)["message"]
    homes.refused(3, "export-keys", "--to", "nobody", "--all", "--output", output, "--yes", home=homes.north)
    assert not output.exists()


def _public(key: Any) -> bytes:
    return bytes(key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))


def test_an_output_that_cannot_be(homes: Homes) -> None:
    occupied = homes.folder / "occupied"
    occupied.write_text("a letter")
    for output, code in ((occupied, 2), (homes.folder / "none" / "keys.jwe", 3)):
        words = ["export-keys", "--to", "south", "--all", "--mode", "move", "--output", output, "--yes"]
        homes.refused(code, *words, home=homes.north)
    assert occupied.read_text() == "a letter"


def test_a_receipts_place_that_is_taken_is_found_before_anything_changes(homes: Homes) -> None:
    path = homes.export("--all")
    (homes.folder / "keys.jwe.receipt").write_text("a letter")
    homes.refused(2, "import-keys", path, "--yes")
    other = homes.folder / "other.receipt"
    assert homes.run(homes.south, "import-keys", path, "--yes", "--receipt", other).json["receipt"] == str(other)


# -- bad bundles ------------------------------------------------------------------------------------------------------


class Forger:
    """Makes bundles from north to south that break one rule each."""

    def __init__(self, homes: Homes) -> None:
        north, south = open_station(homes.north), open_station(homes.south)
        self.sender, self.ca = north.vault.identity(), north.vault.ca()
        self.receiver = south.point
        self.stations = north, south
        self.folder = homes.folder
        assert self.ca is not None
        now = datetime.now(UTC).replace(microsecond=0)
        digits = fingerprint(self.receiver)
        self.good = Bundle(
            id="3d1a4d1c-52c4-4d0b-9d3c-0c8f4bd5a7f1",
            sender=north.fingerprint,
            to=(digits,),
            created=now,
            expires=now + timedelta(days=7),
            mode="copy",
            ca=north.ca,
            nodes=(self.node(1), self.node(2)),
            station_signatures={digits: self.ca.sign(station_key_message(self.receiver))},
        )

    @staticmethod
    def node(number: int) -> BundledNode:
        return BundledNode(bytes(9) + bytes([number]), SoftwareKey(number + 90).point, bytes([number]) * 16, 3)

    def close(self) -> None:
        for station in self.stations:
            station.close()

    def file(self, octets: bytes) -> Path:
        path = self.folder / "bad.jwe"
        path.write_bytes(octets)
        return path

    def sealed(self, **changes: Any) -> bytes:
        return seal_bundle(replace(self.good, **changes), self.sender, [self.receiver])

    def members(self, **changes: Any) -> bytes:
        """Return a payload with members that the sender's own code would not write."""
        payload = json.loads(payload_of(self.good)) | changes
        return self.signed(dump(payload))

    def signed(self, payload: bytes, **header: Any) -> bytes:
        named = {"alg": "ES256", "kid": fingerprint(self.sender.point), "typ": TYPE} | header
        text = base64url(dump(named)) + b"." + base64url(payload)
        return jose.encrypt(text + b"." + base64url(self.sender.sign(text)), [self.receiver], cty="JWS")

    def protected(self, **changes: Any) -> bytes:
        document = json.loads(self.sealed())
        header = json.loads(decode_base64url(document["protected"], "")) | changes
        return dump(document | {"protected": base64url(dump(header)).decode()})

    def flipped(self, member: str) -> bytes:
        document = json.loads(self.sealed())
        text = document[member]
        return dump(document | {member: ("B" if text[0] == "A" else "A") + text[1:]})


@pytest.fixture
def forger(homes: Homes) -> Iterator[Forger]:
    made = Forger(homes)
    yield made
    made.close()


def _expired(forger: Forger) -> bytes:
    past = datetime.now(UTC) - timedelta(days=9)
    return forger.sealed(created=past, expires=past + timedelta(days=7))


def _with_duplicate(forger: Forger) -> bytes:
    nodes = json.loads(payload_of(forger.good))["nodes"]
    return forger.members(nodes=[nodes[0], nodes[0]])


def _other_recipient(forger: Forger) -> bytes:
    other = SoftwareKey(41)
    signatures = {fingerprint(other.point): forger.ca.sign(station_key_message(other.point))}  # type: ignore[union-attr]
    bundle = replace(forger.good, to=tuple(signatures), station_signatures=signatures)
    return seal_bundle(bundle, forger.sender, [other.point])


def _stranger(forger: Forger) -> bytes:
    stranger = SoftwareKey(42)
    return seal_bundle(replace(forger.good, sender=fingerprint(stranger.point)), stranger, [forger.receiver])


def _bomb(forger: Forger) -> bytes:
    return b'{"protected":' + b"[" * 200_000 + b"]" * 200_000 + b"}"


BAD: dict[str, tuple[Callable[[Forger], bytes], int, str]] = {
    "wrong recipient": (_other_recipient, 6, "not sealed for this station"),
    "unknown sender": (_stranger, 4, "not trusted here"),
    "header changed": (lambda f: f.protected(cty="JWS", x="y"), 4, ""),
    "iv changed": (lambda f: f.flipped("iv"), 4, "was changed"),
    "payload changed": (lambda f: f.flipped("ciphertext"), 4, "was changed"),
    "tag changed": (lambda f: f.flipped("tag"), 4, "was changed"),
    "expired": (_expired, 6, "expired"),
    "made in the future": (
        lambda f: f.sealed(created=f.good.created + timedelta(days=1)), 6, "in the future"),
    "truncated": (lambda f: f.sealed()[:-200], 8, ""),
    "cut to nothing": (lambda f: b"", 8, ""),
    "count wrong": (lambda f: f.members(count=3), 8, "says that it holds 3 nodes, and holds 2"),
    "a UUID twice": (_with_duplicate, 8, "names an UUID twice"),
    "alg none inside": (lambda f: f.signed(b"{}", alg="none"), 6, "'none' is not accepted"),
    "alg HS256 inside": (lambda f: f.signed(b"{}", alg="HS256"), 6, "is not accepted"),
    "alg dir outside": (lambda f: f.protected(alg="dir"), 6, "is not accepted"),
    "alg RSA-OAEP outside": (lambda f: f.protected(alg="RSA-OAEP"), 6, "is not accepted"),
    "enc A128CBC-HS256": (lambda f: f.protected(enc="A128CBC-HS256"), 6, "is not accepted"),
    "crit outside": (lambda f: f.protected(crit=["exp"]), 6, "crit is not accepted"),
    "crit inside": (lambda f: f.signed(b"{}", crit=["exp"]), 6, "crit is not accepted"),
    "zip": (lambda f: f.protected(zip="DEF"), 6, "zip is not accepted"),
    "another format": (lambda f: f.members(format="teds-handover/9"), 8, "format is not"),
    "a receipt in its place": (lambda f: f.signed(b"{}", typ="teds-receipt+jws"), 8, "not teds-handover"),
    "a private key": (lambda f: to_pem(f.receiver).encode().replace(b"PUBLIC", b"PRIVATE"), 8, ""),
    "nested JSON": (_bomb, 8, ""),
    "a move to two": (lambda f: f.members(mode="move", to=[*f.good.to, "ab" * 32]), 6, "exactly one receiver"),
    "no signature by CA": (lambda f: f.sealed(station_signatures={}), 6, "has no signature by CA"),
    "a wrong signature of the CA": (
        lambda f: f.members(station_signatures={f.good.to[0]: base64url(f.sender.sign(b"no")).decode()}), 4,
        "does not verify"),
}  # fmt: skip


@pytest.mark.parametrize("name", list(BAD))
def test_a_bad_bundle(homes: Homes, forger: Forger, name: str) -> None:
    make, code, message = BAD[name]
    error = homes.refused(code, "import-keys", forger.file(make(forger)), "--yes")
    assert message in error["message"]
    assert not (homes.folder / "bad.jwe.receipt").exists()


def test_the_forgers_good_bundle_is_taken(homes: Homes, forger: Forger) -> None:
    assert homes.run(homes.south, "import-keys", forger.file(forger.sealed()), "--yes").code == 0


def test_a_replayed_id(homes: Homes, forger: Forger) -> None:
    homes.run(homes.south, "import-keys", forger.file(forger.sealed()), "--yes")
    (homes.folder / "bad.jwe.receipt").unlink()
    path = forger.file(forger.sealed(nodes=(forger.node(3),)))
    assert "a replay or a forgery" in homes.refused(6, "import-keys", path, "--yes")["message"]


def test_an_older_epoch(homes: Homes, forger: Forger) -> None:
    homes.run(homes.south, "import-keys", forger.file(forger.sealed()), "--yes")
    (homes.folder / "bad.jwe.receipt").unlink()
    older = replace(forger.node(1), epoch=2, key=bytes(16))
    path = forger.file(forger.sealed(id="3d1a4d1c-52c4-4d0b-9d3c-0c8f4bd5a7f2", nodes=(older,)))
    assert "epoch 2 is older than 3" in homes.refused(6, "import-keys", path, "--yes")["message"]


def test_a_sender_that_is_trusted_no_more(homes: Homes) -> None:
    path = homes.export("--all")
    assert homes.run(homes.south, "trust", "remove", "north", "--yes").code == 0
    assert "not trusted here" in homes.refused(4, "import-keys", path, "--yes")["message"]


def test_100_mb_of_junk_are_refused_without_being_read(homes: Homes, tmp_path: Path) -> None:
    path = tmp_path / "junk"
    with path.open("wb") as file:
        file.truncate(100_000_000)
    assert "larger than" in homes.refused(8, "import-keys", path, "--yes")["message"]
    path.write_bytes(b'{"protected":"' + b"A" * 30_000_000)
    homes.refused(8, "import-keys", path, "--yes")


def test_no_file(homes: Homes) -> None:
    homes.refused(3, "import-keys", homes.folder / "none", "--yes")
    homes.refused(3, "handover", "receipt", homes.folder / "none")
    homes.refused(3, "handover", "undo", "12345678", "--yes")


def test_bad_receipts(homes: Homes) -> None:
    path = homes.export("--all", "--mode", "move")
    receipt = Path(homes.run(homes.south, "import-keys", path, "--yes").json["receipt"])
    octets = receipt.read_bytes().strip()
    for bad, code in ((octets[:-5] + b"AAAAA", 4), (octets[:40], 8), (b"", 8), (path.read_bytes(), 8)):
        receipt.write_bytes(bad)
        homes.refused(code, "handover", "receipt", receipt, home=homes.north)
    receipt.write_bytes(octets)
    homes.refused(4, "handover", "receipt", receipt)


def test_a_node_that_was_moved_says_where_it_went(homes: Homes) -> None:
    homes.export("--all", "--mode", "move")
    error = homes.refused(6, "agree", UUIDS[0], "--timeout", "1", home=homes.north)
    assert "was moved to station" in error["message"]
    station = open_station(homes.north)
    with pytest.raises(Exception, match="was moved"):
        session(station, Pair.make(homes.folder / "more", 1).board)
    station.close()


def test_a_bundle_that_was_taken_before_is_shown_as_such(homes: Homes) -> None:
    bundle = homes.export("--all")
    assert homes.run(homes.south, "import-keys", bundle, "--yes").code == 0
    forget_vaults()
    again = call(homes.south, "import-keys", bundle, "--dry-run")
    [row] = homes.run(homes.south, "handover", "list").json["handovers"]
    assert again.out == f"This bundle was imported on {row['created']}; there is nothing to do.\n"
    plan = homes.run(homes.south, "import-keys", bundle, "--dry-run").json
    assert ([node["uuid"] for node in plan["same"]] if "same" in plan else plan) != []


@pytest.mark.parametrize(
    ("mode", "fresh", "dry_run", "text"),
    [
        ("move", True, False, "imported 2 nodes; their keys are deleted here."),
        ("move", True, True, "imported 2 nodes; their keys would be deleted here."),
        ("copy", True, False, "imported 2 nodes."),
        ("move", False, False, "imported 2 nodes (already known)."),
        ("copy", False, True, "imported 2 nodes (already known)."),
    ],
)
def test_what_a_receipt_completes_is_said_and_what_was_refused_comes_back(
    monkeypatch: pytest.MonkeyPatch, mode: str, fresh: bool, dry_run: bool, text: str
) -> None:
    monkeypatch.setattr(handover, "peer_name", lambda _station, sender: f"south {sender}")
    refused: list[Any] = [SimpleNamespace(uuid=bytes.fromhex(UUIDS[0]), why="revoked")]
    for nodes in ([], refused):
        receipt = SimpleNamespace(imported=[1, 2], refused=nodes, sender="5e")
        done: Any = SimpleNamespace(receipt=receipt, row=SimpleNamespace(mode=mode), fresh=fresh)
        lines = handover._closed_text(cast(Any, None), done, dry_run=dry_run).splitlines()
        verb = "would belong" if dry_run else "belong"
        again = f"The refused nodes {verb} to this station again; their keys are rotated at the next contact."
        assert lines == [
            f"Station south 5e {text}",
            *([f"  refused {UUIDS[0]}: revoked"] if nodes else []),
            *([again] if nodes and mode == "move" else []),
        ]


@pytest.mark.parametrize("words", [[], ["--all", UUIDS[0]]])
def test_nodes_to_hand_over_are_named_or_all_of_them(homes: Homes, words: list[str]) -> None:
    done = homes.run(homes.north, "export-keys", "--to", "south", "--yes", "--output", homes.folder / "k", *words)
    assert (done.code, done.json["error"]["message"]) == (
        2,
        "Name the nodes, or use --all. (see: teds-provision export-keys --help)",
    )


@pytest.mark.parametrize(("bundles", "held"), [(1, True), (2, False), (3, True)])
def test_the_plan_of_an_export_names_nodes_holders_and_keys_to_compare(
    monkeypatch: pytest.MonkeyPatch, bundles: int, held: bool
) -> None:
    monkeypatch.setattr(handover, "peer_name", lambda _station, digits: f"lab {digits}")
    monkeypatch.setattr(handover, "spoken", lambda digits: f"spoken {digits}")
    uuids = [bytes([number]) * 10 for number in range(1, 25)]
    names = {uuid: SimpleNamespace(name="thumb" if uuid == uuids[0] else None) for uuid in uuids}
    station: Any = SimpleNamespace(
        nodes=SimpleNamespace(get_many=lambda some: {uuid: names[uuid] for uuid in some}),
        name="north",
        fingerprint="aa",
    )
    share = len(uuids) // bundles
    plans: list[Any] = [
        SimpleNamespace(
            mode="move",
            nodes=[SimpleNamespace(uuid=uuid, epoch=3) for uuid in uuids[at : at + share]],
            expires=datetime(2026, 11, 30, tzinfo=UTC),
            skipped=[(bytes(10), "revoked")] if at == 0 else [],
            also_held_by=(["7f", "5e"] if at else ["5e"]) if held else [],
            receivers=[SimpleNamespace(name="south", fingerprint="bb")],
            id="7",
        )
        for at in range(0, len(uuids), share)
    ]
    holders = "lab 5e, lab 7f" if bundles > 1 else "lab 5e"
    head, *lines = handover._plan_text(plans, station).splitlines()
    assert head.startswith("Move 24 nodes, to be imported by 2026-11-")
    if bundles > 1:
        assert lines.pop(0) == f"  in {bundles} bundles"
    assert lines[:20] == [
        f"  {uuids[0].hex()}  epoch 3  thumb",
        *(f"  {uuid.hex()}  epoch 3" for uuid in uuids[1:20]),
    ]
    assert "4 more" in lines[20]
    assert lines[21:] == [
        f"  not {bytes(10).hex()}: revoked",
        *([f"  also held by {holders} from an earlier copy, until the keys are rotated"] if held else []),
        "Compare by voice:",
        "  to   south",
        "       spoken bb",
        "  from north",
        "       spoken aa",
        "A move: this station stops using the keys at once. It is only certain to be locked out when the other station"
        " has rotated them at its first contact.",
    ]


@pytest.mark.parametrize(("mode", "known"), [("copy", True), ("move", False)])
def test_the_plan_of_an_import_names_what_it_does_with_each_node_and_ban(
    monkeypatch: pytest.MonkeyPatch, mode: str, known: bool
) -> None:
    monkeypatch.setattr(handover, "peer_name", lambda _station, digits: f"lab {digits}")
    monkeypatch.setattr(handover, "spoken", lambda digits: f"spoken {digits}")
    monkeypatch.setattr(handover, "fingerprint", lambda ca: ca * 64)
    uuids = [bytes([number]) * 10 for number in range(1, 44)]
    nodes = [SimpleNamespace(node=SimpleNamespace(uuid=uuid), decision="import", why="", notes=()) for uuid in uuids]
    nodes[0].decision, nodes[0].why = "refused", "it is given away"
    nodes[1].notes = ("Its name is taken.", "It has no pin.")
    nodes[42].notes = ("The last one too.",)
    ban = SimpleNamespace(uuid=bytes(10), why="stolen")
    bundle = SimpleNamespace(mode=mode, sender="5e", ca="c")
    plan: Any = SimpleNamespace(
        opened=SimpleNamespace(bundle=bundle), nodes=nodes, denied=[ban], passed_over=[(ban, "it was lifted")],
        ca_is_known=known,
    )  # fmt: skip
    head, *lines = handover.import_text(cast(Any, SimpleNamespace(fingerprint="aa")), plan).splitlines()
    assert head == f"A {mode} of 43 nodes from lab 5e"
    assert lines[:2] == [f"  refused  {uuids[0].hex()}  it is given away", f"  import   {uuids[1].hex()}"]
    assert len([line for line in lines if line.startswith(("  import ", "  refused "))]) == 40
    assert "3 more" in lines[40]
    means = {
        "copy": "A copy: the sender keeps the same keys, and either station can impersonate a node to the other.",
        "move": "A move: each key is rotated at the first contact; until then, the sender can still use it.",
    }
    assert lines[41:] == [
        f"  {uuids[1].hex()}: Its name is taken.",
        f"  {uuids[1].hex()}: It has no pin.",
        f"  {uuids[42].hex()}: The last one too.",
        f"  revoked  {bytes(10).hex()}  stolen",
        f"  its ban of {bytes(10).hex()} is ignored: it was lifted",
        "Compare by voice:",
        "  from spoken 5e",
        "  to   spoken aa",
        *([] if known else [f"The CA {'c' * 32} will be trusted for these nodes only."]),
        means[mode],
    ]


@pytest.mark.parametrize(
    ("fresh", "mode", "again", "step"),
    [
        ((True, False), "move", "",
         "\nTo complete the move with its receipt: teds-provision handover receipt FILE.receipt"),
        ((False, False), "copy", " (nothing to do: it already exists)", ""),
        ((False, True), "copy", "", ""),
    ],
)  # fmt: skip
def test_an_export_in_several_files_is_new_if_one_of_them_is(
    fresh: tuple[bool, bool], mode: str, again: str, step: str
) -> None:
    said: list[tuple[dict[str, Any], str]] = []
    app: Any = SimpleNamespace(emit=lambda result, text: said.append((result, text)))
    plans: list[Any] = [SimpleNamespace(mode=mode, id=f"id{number}", nodes=[1] * number) for number in (1, 2)]
    done: list[Any] = [
        SimpleNamespace(sha256=f"sha{number}", octets=100 * number, fresh=new)
        for number, new in zip((1, 2), fresh, strict=True)
    ]
    result: dict[str, Any] = {"bundles": [{"bundle": "k"}, {"bundle": "k.2"}]}
    handover._print_export(app, plans, [Path("k"), Path("k.2")], result, done)
    assert said == [(result, f"3 nodes in k, k.2, handover id1{again}.{step}")]
    assert (result["sha256"], result["octets"], result["fresh"]) == ("sha1", 300, any(fresh))
    assert result["bundles"] == [
        {"bundle": "k", "sha256": "sha1", "octets": 100, "fresh": fresh[0]},
        {"bundle": "k.2", "sha256": "sha2", "octets": 200, "fresh": fresh[1]},
    ]


@pytest.mark.parametrize("proven", [(), (0,), (0, 1)])
def test_nodes_that_are_proven_already_are_not_waited_for(
    proven: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    uuids = [bytes.fromhex(uuid) for uuid in UUIDS[:2]]
    met: list[Any] = []
    known = {uuids[number] for number in proven}

    def prove(_station: Any, links: Any, waiting: list[bytes], _reporter: Any, *, hold: Any) -> list[Any]:
        met.append((links, list(waiting), hold()))
        return [NodeProof(waiting[0], 4, True), *(NodeProofFailure(uuid, "it is silent") for uuid in waiting[1:])]

    monkeypatch.setattr(handover, "proven_of", lambda _station, some: {uuid for uuid in some if uuid in known})
    monkeypatch.setattr(handover, "prove_nodes", prove)
    monkeypatch.setattr(handover, "reporter_for", lambda _app: None)
    said: list[tuple[dict[str, Any], str]] = []
    app: Any = SimpleNamespace(note="note", emit=lambda result, text: said.append((result, text)))
    station: Any = SimpleNamespace(lock=lambda command, note: (command, note))
    notes = SimpleNamespace(uuids=[uuid.hex() for uuid in uuids], refused=[])
    done: Any = SimpleNamespace(uuids=uuids, notes=notes, fresh=True)
    outcomes = handover._prove(app, station, done, cast(Any, "links"))
    waiting = [uuid for uuid in uuids if uuid not in known]
    assert met == ([("links", waiting, ("import-keys", "note"))] if waiting else [])
    wanted = [(True, ""), (False, "it is silent")][: len(waiting)]
    assert [(outcome["rotated"], outcome["why"]) for outcome in outcomes] == wanted
    assert [outcome["uuid"] for outcome in outcomes] == [uuid.hex() for uuid in waiting]
    result: dict[str, Any] = {"imported": [uuid.hex() for uuid in uuids]}
    handover._print_import(app, station, done, Path("r"), result, outcomes)
    shown = said[0][0]
    assert shown["proven"] == [uuid.hex() for uuid in uuids if uuid in known]
    assert shown["pending"] == [uuid.hex() for uuid in waiting]
    assert shown["not_proven"] == ({UUIDS[1]: "it is silent"} if len(waiting) == 2 else {})
    assert (shown["receipt"], shown["fresh"]) == ("r", True)


@pytest.mark.parametrize(
    ("octets", "sealed"),
    [
        (b'{"recipients": [], "ciphertext": "x"}', True),
        (b' \r\n\t{"ciphertext": "x"}', True),
        (b"x" + b'{"ciphertext": "x"}', False),
        (b'{"recipients": []}', False),
        *((b"{" + b" " * blanks + b'"ciphertext": "x"}', True) for blanks in range(1, 34)),
        (b"{" + b" " * 40 + b'"ciphertex"}', False),
        (b"", False),
    ],
)
def test_a_sealed_bundle_is_known_wherever_its_ciphertext_begins(
    monkeypatch: pytest.MonkeyPatch, octets: bytes, sealed: bool
) -> None:
    """It is read piece by piece, and the word may lie across the end of one."""
    monkeypatch.setattr(handover, "_PIECE", 16)
    assert handover._is_sealed(BytesIO(octets)) is sealed


@pytest.mark.parametrize(("octets", "refused"), [(40, False), (41, True)])
def test_a_bundle_is_as_large_as_one_may_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, octets: int, refused: bool
) -> None:
    monkeypatch.setattr(handover, "MAX_BUNDLE_OCTETS", 40)
    file = tmp_path / "a.jwe"
    file.write_bytes(b'{"ciphertext": "x"}'.ljust(octets))
    if refused:
        why = r"is larger than 40 octets and cannot be a bundle\.$"
        with pytest.raises(BadDataError, match=why), handover._bundle_file(file):
            pass
    else:
        with handover._bundle_file(file) as bundle:
            bundle.seek(0)
            assert len(bundle.read()) == octets
    file.write_bytes(b"{}")
    with pytest.raises(BadDataError) as error, handover._bundle_file(file):
        pass
    assert (error.value.message, error.value.hint) == (
        f"{file} is not a handover bundle.",
        "Use the file that export-keys wrote.",
    )


def test_of_a_bundle_that_was_imported_before_the_refused_nodes_stay_refused() -> None:
    first, second, third = (f"{number:020x}" for number in (1, 2, 3))
    notes = SimpleNamespace(uuids=[first, second, third], refused=[(second, "it is given away")])
    row = SimpleNamespace(peers=("5e",), mode="move", id="7")
    done: Any = SimpleNamespace(notes=notes, row=row, refused_uuids={second})
    found = handover._taken_before(done)
    assert found["decisions"] == {first: "same", third: "same", second: "refused"}
    assert (found["imported"], found["count"]) == ([first, third], 3)
    assert found["refused"] == [{"uuid": second, "why": "it is given away"}]
    assert (found["from"], found["id"], found["mode"], found["revoked"]) == ("5e", "7", "move", [])


def test_of_the_nodes_with_notes_forty_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("peer_name", "spoken", "fingerprint"):
        monkeypatch.setattr(handover, name, lambda *words: "x" * 32)
    nodes = [
        SimpleNamespace(node=SimpleNamespace(uuid=bytes([number]) * 10), decision="import", why="", notes=("Odd.",))
        for number in range(45)
    ]
    bundle = SimpleNamespace(mode="copy", sender="5e", ca="c")
    plan: Any = SimpleNamespace(
        opened=SimpleNamespace(bundle=bundle), nodes=nodes, denied=[], passed_over=[], ca_is_known=True
    )
    lines = handover.import_text(cast(Any, SimpleNamespace(fingerprint="aa")), plan).splitlines()
    assert sum(line.endswith(": Odd.") for line in lines) == 40
    plan.nodes = nodes[:40]
    lines = handover.import_text(cast(Any, SimpleNamespace(fingerprint="aa")), plan).splitlines()
    assert (sum(line.endswith(": Odd.") for line in lines), [line for line in lines if "more" in line]) == (40, [])


@pytest.mark.parametrize("go_on", [True, False])
def test_of_several_receipts_that_fail_the_first_decides_how_the_command_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, go_on: bool
) -> None:
    errors = {"b": NotAuthenticError("It is forged."), "c": PolicyError("It was undone.")}

    def close(_station: Any, octets: bytes, *, dry_run: bool) -> str:
        name = octets.decode()
        if name in errors:
            raise errors[name]
        return f"{name} {dry_run}"

    monkeypatch.setattr(handover, "close", close)
    files = [tmp_path / name for name in "abcd"]
    for file in files:
        file.write_text(file.name)
    warned: list[str] = []
    app: Any = SimpleNamespace(warn=warned.append)
    none: Any = None
    if not go_on:
        with pytest.raises(NotAuthenticError):
            handover._close_all(app, none, files, go_on=False, dry_run=True)
        assert warned == []
        return
    closed, failed = handover._close_all(app, none, files, go_on=True, dry_run=True)
    assert (closed, failed) == (["a True", "d True"], errors["b"])  # type: ignore[comparison-overlap]
    assert warned == ["b: It is forged.", "c: It was undone."]


def test_a_move_is_undone_as_it_is_once_the_store_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A receipt may have come while the person was asked."""
    course: list[Any] = []
    rows = [SimpleNamespace(id="7", mode="move", state="open"), SimpleNamespace(id="7", mode="move", state="closed")]

    @contextmanager
    def lock(command: str, _note: Any) -> Iterator[None]:
        course.append(command)
        yield
        course.append("free")

    station: Any = SimpleNamespace(lock=lock)
    monkeypatch.setattr(handover, "find_handover", lambda _station, id_: rows.pop(0))
    monkeypatch.setattr(
        handover.handover_pending,
        "undo",
        lambda _station, row: course.append(row.state) or SimpleNamespace(uuids=[bytes(10)], fresh=True),
    )
    app: Any = SimpleNamespace(
        station=lambda: station,
        note=None,
        confirm=lambda question, *, yes: course.append((question, yes)),
        emit=lambda result, text: course.append((result, text)),
    )
    callback: Any = handover.undo.callback
    callback.__wrapped__(app, "7", True, False)
    assert course == [
        ("Undo this move? The receiver may still have the keys until they are rotated.", True),
        "handover undo",
        "closed",
        "free",
        (
            {"id": "7", "state": "undone", "nodes": [bytes(10).hex()], "fresh": True},
            "1 node back on this station; each key is rotated at the next contact.",
        ),
    ]


def test_an_import_is_made_as_it_was_shown_or_was_made_before() -> None:
    def planned(*nodes: str) -> Any:
        return SimpleNamespace(nodes=list(nodes))

    before = handover.ImportResult.__new__(handover.ImportResult)
    for plan, shown, fine in (
        (planned("a"), planned("a"), True),
        (planned("a"), planned("b"), False),
        (planned("a"), planned("a", "b"), False),
        (before, planned("a"), True),
        (before, before, True),
        (planned("a"), before, False),
    ):
        if fine:
            handover.require_as_shown(plan, shown)
        else:
            with pytest.raises(PolicyError, match="Another command changed the plan"):
                handover.require_as_shown(plan, shown)
