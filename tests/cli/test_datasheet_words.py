"""``build``, ``sign``, ``write``, ``read``, ``draft``, ``history``, ``trust``: what they print and pass on, whole."""

from __future__ import annotations

import hashlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision import provisioning
from teds_provision.cli.rendering import local_time
from teds_provision.cli.station import trust as trust_commands
from teds_provision.errors import NoNodeError
from teds_provision.handover.trust import Removal
from teds_provision.protocol.keys import SoftwareKey, fingerprint, to_pem
from teds_provision.provisioning.datasheet_history import RestoreOrder
from teds_provision.provisioning.write import WriteResult
from teds_provision.station.station import Station
from teds_provision.station.store.records import DatasheetRecord, Draft, TrustRecord
from teds_provision.teds.image import Image
from tests.bench import PASSPHRASE

from .shell import Outcome, call

UUID = bytes(range(10))
NODE = UUID.hex()
BLOCKS = {(0, 1): b"meta", (1, 3): b"channel!", (0, 128): b"security teds"}
IMAGE = Image(UUID, BLOCKS)
AT = "2026-01-31T12:00:00Z"
NFC = ("--nfc", "udp:localhost:9")


def known(home: Path) -> None:
    with Station.open(home, ask=lambda prompt, confirm: PASSPHRASE) as station, station.transaction():
        station.nodes.remember(UUID)


class Work:
    """Stands for the work below a command: notes what it was given."""

    def __init__(self, result: Any) -> None:
        self.result, self.given, self.named = result, list[Any](), dict[str, Any]()

    def __call__(self, *given: Any, **named: Any) -> Any:
        self.given, self.named = list(given), named
        return self.result


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Any:
    def put(room: Any, name: str, result: Any) -> Work:
        work = Work(result)
        monkeypatch.setattr(room, name, work)
        return work

    return put


def both(home: Path, *words: object) -> tuple[Outcome, Any]:
    """Return how a command ends for people, and its JSON."""
    return call(home, *words), call(home, "--json", *words).json


# -- build, sign, write, read ------------------------------------------------------------------------------------------


def test_what_build_prints_and_writes(home: Path, tmp_path: Path, stand_in: Any) -> None:
    known(home)
    built = SimpleNamespace(image=IMAGE, profile="gripper", warnings=("a warning",), calibrations={})
    work = stand_in(provisioning.build, "build", built)
    output = tmp_path / "node.json"
    words = ("build", NODE[:4], "-p", "gripper", "--name", "left", "-o", output, "--edition", "2024", "--retype")
    people, found = both(home, *words, "--dry-run")
    assert not output.exists()
    assert (work.named["edition"], work.named["keep_draft"], work.given[1]) == (2024, False, UUID)
    order = work.given[2]
    assert (order.profile, order.name, order.retype) == ("gripper", "left", True)
    assert people.out.splitlines() == [
        f"Built {NODE} as gripper:",
        "   1  channel 0       4 octets",
        " 128  channel 0      13 octets",
        "   3  channel 1       8 octets",
    ]
    assert "Warning: a warning" in people.err
    assert found == {
        "uuid": NODE,
        "profile": "gripper",
        "blocks": [
            {"access_code": code, "channel": channel, "octets": len(teds), "sha256": hashlib.sha256(teds).hexdigest()}
            for channel, code, teds in ((0, 1, b"meta"), (0, 128, b"security teds"), (1, 3, b"channel!"))
        ],
        "warnings": ["a warning"],
        "calibrations": [],
    }
    assert call(home, "build", NODE, "-o", output).code == 0
    assert (output.read_text(), work.named["keep_draft"], work.named["edition"]) == (IMAGE.to_json(), True, 2007)


@pytest.mark.parametrize("reused", [False, True])
def test_what_sign_prints_and_writes(home: Path, tmp_path: Path, stand_in: Any, reused: bool) -> None:
    known(home)
    signed = SimpleNamespace(image=IMAGE, sequence=7, signature=b"\xab" * 64, reused=reused)
    work = stand_in(provisioning.sign, "sign_at", SimpleNamespace(signed=signed, changes=("a change", "another")))
    output = tmp_path / "signed.json"
    words = ("sign", NODE, "--output", output, "--read-node", "--accept-calibration", "it is so", *NFC)
    people, found = both(home, *words, "--dry-run")
    assert (people.out, found) == ("  a change\n  another\n", {"uuid": NODE, "changes": ["a change", "another"]})
    assert not output.exists()
    assert work.named == {"read_node": True, "accept_calibration": "it is so", "dry_run": True, "output": output}
    people, found = both(home, *words)
    again = " (existing signature reused)" if reused else ""
    assert people.out == f"  a change\n  another\nSigned {NODE}, sequence 7{again}.\n"
    assert output.read_text() == IMAGE.to_json()
    with Station.inspect(home) as station:
        assert found == {"uuid": NODE, "sequence": 7, "signature": "ab" * 64, "signed_by": station.fingerprint,
                         "reused": reused, "changes": ["a change", "another"]}  # fmt: skip
    work.result = SimpleNamespace(signed=signed, changes=())
    assert call(home, "sign", NODE, *NFC).out.startswith("  no changes\nSigned ")
    assert work.named == {"read_node": False, "accept_calibration": None, "dry_run": False, "output": None}


def test_what_write_prints(home: Path, tmp_path: Path, stand_in: Any) -> None:
    known(home)
    file = tmp_path / "signed.json"
    file.write_text(IMAGE.to_json())
    plan = stand_in(provisioning.write, "plan_write", SimpleNamespace(image=IMAGE, written=None))
    people, found = both(home, "write", NODE, "--image", file, "--dry-run", *NFC)
    assert people.out == f"Plan: write 3 TEDS, 25 octets, to {NODE}.\n"
    assert found == {"uuid": NODE, "plan": "write", "blocks": 3, "octets": 25}
    assert plan.given[1:] == [NODE, file]
    done = stand_in(
        provisioning.write, "write_at", SimpleNamespace(image=IMAGE, written=WriteResult(21, 1.23456, IMAGE))
    )
    people, found = both(home, "write", NODE, "--image", file, "--retype", "--sequence-jump", "--yes", *NFC)
    assert people.out == f"Node {NODE}: 21 octets written and read back (1.23 s).\n"
    assert found == {"uuid": NODE, "octets_written": 21, "verified": True, "seconds": 1.235}
    assert (done.named["file"], done.named["jump"], done.named["retyped"]) == (file, True, True)
    done.result = SimpleNamespace(image=IMAGE, written=WriteResult(0, 0.5, IMAGE))
    nothing, found = both(home, "write", NODE, *NFC)
    assert nothing.out == f"Node {NODE}: nothing to do, it is already there (0.50 s).\n"
    assert found["octets_written"] == 0
    assert (done.named["file"], done.named["jump"], done.named["retyped"]) == (None, False, False)
    both_given = call(home, "--json", "write", NODE, "--from", "3", "--image", file, *NFC)
    assert (both_given.code, both_given.json["error"]["message"]) == (2, "--from and --image cannot be combined.")


def test_what_an_earlier_datasheet_prints(home: Path, stand_in: Any) -> None:
    known(home)
    changes = (SimpleNamespace(text="the name changes"),)
    restored = SimpleNamespace(
        uuid=UUID, sequence=9, changes=changes, written=WriteResult(21, 1.0, IMAGE), warnings=("a draft is kept",)
    )
    work = stand_in(provisioning.datasheet_history, "restore_datasheet", restored)
    people, found = both(home, "write", NODE, "--from", "3", *NFC)
    assert people.out == (
        f"Node {NODE}: datasheet 3 restored as sequence 9; 21 octets written and read back (1.00 s).\n"
        "  the name changes\n"
    )
    assert found == {"uuid": NODE, "octets_written": 21, "verified": True, "seconds": 1.0, "from": 3, "sequence": 9,
                     "changes": ["the name changes"]}  # fmt: skip
    assert "a draft is kept" in people.err
    assert work.given[2] == RestoreOrder(NODE, 3)
    call(home, "write", NODE, "--from", "3", "--retype", "--sequence-jump", "--yes", *NFC)
    assert work.given[2] == RestoreOrder(NODE, 3, retyped=True, jump=True)
    work.named["operator"].jump("--yes answers this")
    work.result = SimpleNamespace(uuid=UUID, sequence=9, changes=(), written=None, warnings=())
    people, found = both(home, "write", NODE, "--from", "3", "--dry-run", *NFC)
    assert people.out == f"Plan: restore the datasheet of sequence 3 on {NODE}.\n  no changes\n"
    assert found == {"uuid": NODE, "plan": "write", "from": 3, "changes": []}
    assert work.given[2] == RestoreOrder(NODE, 3, dry_run=True)


def test_what_read_prints_and_writes(home: Path, tmp_path: Path, stand_in: Any) -> None:
    known(home)
    work = stand_in(provisioning.read, "read_at", SimpleNamespace(image=IMAGE, error=None))
    people = call(home, "read", NODE, *NFC)
    assert people.out.strip() == IMAGE.to_json().strip()
    output = tmp_path / "read.json"
    people, found = both(home, "read", NODE, "-o", output, *NFC)
    assert people.out == f"3 TEDS, 25 octets read from {NODE} into {output}.\n"
    assert Image.from_json(output.read_text()) == IMAGE
    assert "verdict" not in found
    output.unlink()
    work.result = SimpleNamespace(image=IMAGE, error=NoNodeError("no session"))
    unproven = call(home, "--json", "read", NODE, "-o", output, *NFC)
    assert unproven.code == 5
    assert not output.exists(), "nothing unproven is kept"
    assert '"verdict": "unproven"' in unproven.out


def test_drafts_and_earlier_datasheets_are_listed(home: Path) -> None:
    known(home)
    assert call(home, "draft", "list").out == "There are no drafts.\n"
    assert call(home, "history", NODE).out == f"No datasheets are known for node {NODE}.\n"
    none, found = both(home, "draft", "drop", NODE)
    assert (none.out, found) == (f"Node {NODE} has no draft.\n", {"uuid": NODE, "dropped": False, "drafts": []})
    records = [
        DatasheetRecord(UUID, 1, 2, None, None, AT, "ab" * 32, IMAGE),
        DatasheetRecord(UUID, 12, 3, AT, "gripper", "2026-02-01T00:00:00Z", "cd" * 32, IMAGE),
    ]
    with Station.open(home, ask=lambda prompt, confirm: PASSPHRASE) as station, station.transaction():
        station.datasheets.keep_draft(Draft(UUID, IMAGE, "signed", "gripper", AT))
    people, found = both(home, "draft", "list")
    assert people.out == f"{NODE}  signed  {local_time(AT)}  gripper\n"
    assert found == {"drafts": [{"uuid": NODE, "profile": "gripper", "stage": "signed", "created": AT}]}
    plan, found = both(home, "draft", "drop", NODE, "--dry-run")
    assert (plan.out, found["dropped"]) == (f"Plan: drop the signed draft of node {NODE}.\n", False)
    assert call(home, "draft", "drop", NODE).out == f"Dropped the signed draft of node {NODE}.\n"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(provisioning.datasheet_history, "history_of", lambda *_: (UUID, records[::-1]))
        people, found = both(home, "history", NODE)
    assert people.out == f"    12  epoch 3  {local_time(AT):<25}  gripper\n     1  epoch 2  not signed\n"
    assert found == {
        "uuid": NODE,
        "history": [
            {"sequence": 12, "epoch": 3, "signed": AT, "profile": "gripper", "sha256": "cd" * 32,
             "seen": "2026-02-01T00:00:00Z"},
            {"sequence": 1, "epoch": 2, "signed": None, "profile": None, "sha256": "ab" * 32, "seen": AT},
        ],
    }  # fmt: skip


# -- trust -------------------------------------------------------------------------------------------------------------

LAB, OWNER = SoftwareKey(51), SoftwareKey(52)
DIGITS = fingerprint(LAB.point)
GROUPS = " ".join(DIGITS[at : at + 4] for at in range(0, 64, 4))


def test_keys_to_trust_are_shown_with_their_whole_fingerprint(home: Path, tmp_path: Path) -> None:
    (tmp_path / "lab.pem").write_text(to_pem(LAB.point))
    plan, found = both(home, "trust", "add", "lab", tmp_path / "lab.pem", "--role", "ca", "--dry-run")
    assert plan.out == f"ca lab  ({tmp_path}/lab.pem)\n  {GROUPS}\n"
    assert found == {"trusted": [{"name": "lab", "role": "ca", "fingerprint": DIGITS}], "added": 1, "plan": True}
    words = ("trust", "add", "lab", tmp_path / "lab.pem", "--fingerprint")
    wrong = call(home, "--json", *words, "0" * 32)
    assert wrong.json["error"]["message"] == f"{tmp_path}/lab.pem holds the key {DIGITS[:32]}, not {'0' * 32}."
    assert call(home, *words, DIGITS[:32]).out == "Now trusted: lab.\n", "nobody is asked"
    assert call(home, *words, DIGITS).out == "Nothing to do.\n"
    again, _ = both(home, "trust", "add", "lab", tmp_path / "lab.pem", "--dry-run")
    assert again.out == f"station lab  ({tmp_path}/lab.pem)  already trusted\n  {GROUPS}\n"
    listed, found = both(home, "trust", "list")
    with Station.inspect(home) as station:
        ca = fingerprint(station.ca)
        assert listed.out == (
            f"this station   {station.name}  {station.fingerprint[:16]}, CA {ca[:16]}\n"
            f"station        lab  {DIGITS[:16]}\n"
        )
        assert found["own"] == {"name": station.name, "fingerprint": station.fingerprint, "ca": ca}
    (one,) = found["trusted"]
    assert {name: one[name] for name in one if name != "added"} == {
        "name": "lab", "role": "station", "fingerprint": DIGITS, "certified": False, "source": "added"
    }  # fmt: skip


def test_what_ends_with_the_trust_is_listed_before_and_after(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lab.pem").write_text(to_pem(LAB.point))
    assert call(home, "trust", "add", "lab", tmp_path / "lab.pem", "--yes").code == 0
    shared = tuple(bytes([number] * 10) for number in range(21))
    plan = Removal(TrustRecord("lab", "station", LAB.point, DIGITS), shared, (OWNER.point,), 1, (UUID,), ("h-1",))
    monkeypatch.setattr(trust_commands, "plan_removal", lambda *_: plan)
    lines = [
        "  21 nodes whose key it holds: to be rotated at the next contact",
        *(f"    {uuid.hex()}" for uuid in shared[:20]),
        f"  the CA {fingerprint(OWNER.point)[:32]} is no longer trusted",
        "    1 node keeps it: reset and provision it again",
        f"  its ban of node {NODE} is lifted",
        "  handover h-1 to it is still open, so it may have these keys; see handover list",
    ]
    people, found = both(home, "trust", "remove", "lab", "--dry-run")
    assert people.out.splitlines() == [f"Plan: stop trusting the station lab, {DIGITS[:32]}.", *lines]
    assert found == {
        "trusted": [{"name": "lab", "role": "station", "fingerprint": DIGITS}],
        "removed": {"name": "lab", "role": "station", "fingerprint": DIGITS},
        "ends": {
            "rotations": [uuid.hex() for uuid in shared],
            "cas": [fingerprint(OWNER.point)],
            "nodes_under_them": 1,
            "bans": [NODE],
            "open_handovers": ["h-1"],
        },
        "fresh": True,
        "plan": True,
    }
    removed = call(home, "trust", "remove", "lab", "--yes")
    assert removed.out == f"No longer trusted: station lab, {DIGITS[:32]}.\n"
    assert removed.err.splitlines()[: 1 + len(lines)] == [f"Trusted as station lab, {DIGITS[:32]}", *lines]


def test_the_ca_key_is_shown_and_dropped_once(home: Path) -> None:
    with Station.inspect(home) as station:
        point = station.ca
    shown, found = both(home, "trust", "ca", "create")
    assert shown.out == f"CA key {fingerprint(point)[:16]}, in this vault\n\n{to_pem(point)}\n"
    assert found == {"fingerprint": fingerprint(point), "public_key": to_pem(point), "here": True}
    assert call(home, "trust", "ca", "drop").code == 6
    assert call(home, "trust", "ca", "create").code == 0
    assert call(home, "trust", "ca", "drop", "--yes").out == "The CA key was removed from this vault.\n"
    assert call(home, "trust", "ca", "drop", "--yes").out == "Nothing to do.\n"
