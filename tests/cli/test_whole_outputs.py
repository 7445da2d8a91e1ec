"""Whole outputs of commands that only show: each column, unit and mark counts."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.handover.pending import IMPORTED, OPEN, BundleNotes
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.station.station import Station
from teds_provision.station.store.records import (
    Group,
    Handover,
    Holder,
    KeyRecord,
    NodeRecord,
    RevocationRecord,
    Tombstone,
    TrustRecord,
    WhitelistEntry,
)
from tests.cli.shell import call

THUMB, LOST, OLD, NEW = (
    bytes.fromhex(digits)
    for digits in ("8d4d9da65281f7000000", "8d4e9da65281f7000001", "90009da65281f7000002", "ffff9da65281f7000003")
)
POINTS = {number: SoftwareKey(number).point for number in range(2, 10)}
DIGITS = {number: fingerprint(point) for number, point in POINTS.items()}
ELSEWHERE = "cd" * 32


@pytest.fixture
def berlin(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Have local times at +01:00."""
    monkeypatch.setenv("TZ", "CET-1")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.fixture
def station(home: Path, berlin: None) -> Path:
    """Four nodes: one in use, one given away and banned, one out of service, one only listed."""
    with Station.inspect(home) as store:
        store.nodes.restore(
            NodeRecord(
                THUMB,
                POINTS[2],
                name="thumb [b]",
                profile="tactile-finger-sensor",
                state=2,
                epoch=3,
                sequence=7,
                can_address=0x21,
                teds_sha256="ab" * 32,
                last_seen="2026-01-31T12:00:00Z",
                channels=4,
                due="2027-01-31",
                charging='{"text": "charging, 82 %", "at": "2026-01-31T11:59:00Z"}',
            )
        )
        store.nodes.restore(NodeRecord(LOST, POINTS[3], state=1, epoch=1))
        store.nodes.restore(
            NodeRecord(OLD, POINTS[4], "old cell", "load-cell", epoch=9, sequence=12, retired="decommissioned")
        )
        store.groups.put(Group("hand", (THUMB, OLD), "2026-01-30T08:00:00Z"))
        store.groups.put(Group("spare", (THUMB,), "2026-01-30T09:00:00Z"))
        store.pins.restore(
            [
                WhitelistEntry(THUMB, DIGITS[2], "2026-01-29T10:00:00Z", "tap", "thumb"),
                WhitelistEntry(NEW, None, "2026-01-29T10:01:00Z", "uuid", "to come"),
            ]
        )
        for epoch, source, second in ((3, "agreement", 1), (4, "import", 2), (5, "import", 3)):
            state = "active" if epoch == 3 else "pending"
            created = f"2026-01-29T10:00:0{second}Z"
            store.keys.add(KeyRecord(THUMB, epoch, f"{epoch}" * 16, state, second, b"w", source, created))  # type: ignore[arg-type]
        store.keys.put_holder(Holder(THUMB, ELSEWHERE, "2026-01-30T10:00:00Z"))
        store.policy.put_tombstone(Tombstone(LOST, ELSEWHERE, "an-id", "2026-01-30T11:00:00Z"))
        store.policy.deny(RevocationRecord(LOST, None, "lost in the field", "{}", "2026-01-30T12:00:00Z"))
        store.policy.restore_trust(TrustRecord("lab", "station", POINTS[7], DIGITS[7], "2026-01-28T10:00:00Z"))
        store.policy.restore_trust(TrustRecord("owner", "ca", POINTS[8], DIGITS[8], "2026-01-28T11:00:00Z"))
        notes = BundleNotes(
            (THUMB.hex(), LOST.hex()),
            "11" * 32,
            "22" * 65,
            "2026-02-28T10:00:00Z",
            ("33" * 32, "44" * 32),
            ((LOST.hex(), "it is revoked: lost"),),
        ).to_json()
        left, came = (f"{number}f0e0d0c-0b0a-4908-8706-050403020100" for number in (0, 1))
        times = "2026-01-30T10:00:00Z", "2026-01-30T10:00:05Z"
        store.handovers.put(Handover(left, "out", "move", (DIGITS[7],), OPEN, notes, "33" * 32, None, times[0]))
        store.handovers.put(
            Handover(came, "in", "copy", (DIGITS[9],), IMPORTED, notes, "33" * 32, "e30.e30.e30", times[1])
        )
    return home


TABLE = """\
UUID                  name       state        verdict         profile                epoch  sequence  due         key               remarks
90009da65281f7000002  old cell   factory      decommissioned  load-cell              9      12                    617e37f7a48d30a6  not whitelisted
8d4d9da65281f7000000  thumb [b]  provisioned                  tactile-finger-sensor  3      7         2027-01-31  a9f300eb5960e891  also held by cdcdcdcdcdcdcdcd; 2 keys pending
8d4e9da65281f7000001             keyed                                               1      0                     89896264c58fca55  revoked: lost in the field; moved to cdcdcdcdcdcdcdcd; not whitelisted
ffff9da65281f7000003  to come    unseen                                              0      0
"""  # noqa: E501
OUTPUTS = {
    "nodes": TABLE,
    "nodes|--state|unseen": """\
UUID                  name     state   verdict  profile  epoch  sequence  due  key  remarks
ffff9da65281f7000003  to come  unseen                    0      0
""",
    "nodes|thumb [b]": """\
UUID         8d4d9da65281f7000000
name         thumb [b]
profile      tactile-finger-sensor
state        provisioned
epoch        3, sequence 7
key          a9f300eb5960e89133af7362011a1e26
whitelist    yes, assurance tap
verdict      never verified
last seen    2026-01-31 13:00:00+01:00
calibration  due 2027-01-31
charging     charging, 82 % (reported by the node at 2026-01-31 12:59:00+01:00)
channels     4
CAN address  0x21
groups       hand, spare
link key     5555555555555555 pending, epoch 5, 2026-01-29 11:00:03+01:00
link key     4444444444444444 pending, epoch 4, 2026-01-29 11:00:02+01:00
link key     3333333333333333 active, epoch 3, 2026-01-29 11:00:01+01:00
remarks      also held by cdcdcdcdcdcdcdcd; 2 keys pending
""",
    "nodes|8d4e": """\
UUID         8d4e9da65281f7000001
state        keyed
epoch        1, sequence 0
key          89896264c58fca553508257b18703781
whitelist    no
verdict      never verified
last seen    never
channels     0
CAN address  none
link key     none
remarks      revoked: lost in the field; moved to cdcdcdcdcdcdcdcd; not whitelisted
""",
    "nodes|old cell": """\
UUID         90009da65281f7000002
name         old cell
profile      load-cell
state        factory
epoch        9, sequence 12
key          617e37f7a48d30a63de6efeaa44faa48
whitelist    no
verdict      decommissioned
last seen    never
channels     0
CAN address  none
groups       hand
link key     none
remarks      not whitelisted
""",
    "nodes|ffff": """\
UUID         ffff9da65281f7000003
name         to come
state        unseen
epoch        0, sequence 0
key          not pinned yet
whitelist    yes, assurance uuid
verdict      never verified
last seen    never
channels     0
CAN address  none
link key     none
""",
    "nodes|--format|csv": f"""\
uuid,name,profile,state,epoch,sequence,fingerprint,whitelisted,assurance,verdict,last_seen,due,channels,can_address,group,retired,remarks
8d4d9da65281f7000000,thumb [b],tactile-finger-sensor,provisioned,3,7,{DIGITS[2]},True,tap,,2026-01-31T12:00:00Z,2027-01-31,4,33,hand,,also held by cdcdcdcdcdcdcdcd; 2 keys pending
8d4e9da65281f7000001,,,keyed,1,0,{DIGITS[3]},False,,,,,0,0,,,revoked: lost in the field; moved to cdcdcdcdcdcdcdcd; not whitelisted
90009da65281f7000002,old cell,load-cell,factory,9,12,{DIGITS[4]},False,,,,,0,0,hand,decommissioned,not whitelisted
ffff9da65281f7000003,to come,,,0,0,,True,uuid,,,,0,0,,,
""",  # noqa: E501
    "whitelist|list": """\
UUID                  key               assurance  added                      name
8d4d9da65281f7000000  a9f300eb5960e891  tap        2026-01-29 11:00:00+01:00  thumb
ffff9da65281f7000003  not pinned yet    uuid       2026-01-29 11:01:00+01:00  to come
""",
    "whitelist|export|-": f"""\
<?xml version="1.0" encoding="UTF-8"?>
<whitelist>
  <transducer uuid="0x8d4d9da65281f7000000" fingerprint="{DIGITS[2]}" added="2026-01-29T10:00:00Z" assurance="tap" name="thumb"/>
  <transducer uuid="0xffff9da65281f7000003" added="2026-01-29T10:01:00Z" assurance="uuid" name="to come"/>
</whitelist>
""",  # noqa: E501
    "whitelist|export|-|--format|csv": f"""\
uuid,fingerprint,added,assurance,name
8d4d9da65281f7000000,{DIGITS[2]},2026-01-29T10:00:00Z,tap,thumb
ffff9da65281f7000003,,2026-01-29T10:01:00Z,uuid,to come
""",
    "group|list": "hand: 8d4d9da65281f7000000, 90009da65281f7000002\nspare: 8d4d9da65281f7000000\n",
    "handover|list": """\
0f0e0d0c-0b0a-4908-8706-050403020100  out move  open         2  lab  2026-01-30 11:00:00+01:00  expired
1f0e0d0c-0b0a-4908-8706-050403020100  in  copy  imported     2  7710e28392251c0b  2026-01-30 11:00:05+01:00
""",
    "draft|list": "There are no drafts.\n",
    "nodes|--fits|angle >= 360 deg": """\
UUID                  channel  result   why
8d4d9da65281f7000000           skipped  its datasheet is unknown here.
8d4e9da65281f7000001           skipped  its datasheet is unknown here.
90009da65281f7000002           skipped  its datasheet is unknown here.
ffff9da65281f7000003           skipped  its datasheet is unknown here.
""",
}


@pytest.mark.parametrize("words", OUTPUTS)
def test_what_a_command_prints_of_the_station(station: Path, words: str) -> None:
    outcome = call(station, *words.split("|"))
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out == OUTPUTS[words]


def test_the_json_of_a_node_has_every_member(station: Path) -> None:
    (node,) = call(station, "--json", "nodes", "8d4d").json["nodes"]
    assert node == {
        "uuid": "8d4d9da65281f7000000",
        "name": "thumb [b]",
        "profile": "tactile-finger-sensor",
        "state": "provisioned",
        "epoch": 3,
        "sequence": 7,
        "fingerprint": DIGITS[2],
        "whitelisted": True,
        "assurance": "tap",
        "verdict": None,
        "retired": None,
        "reading": None,
        "last_seen": "2026-01-31T12:00:00Z",
        "due": "2027-01-31",
        "charging": {"text": "charging, 82 %", "at": "2026-01-31T11:59:00Z"},
        "channels": 4,
        "can_address": 33,
        "group": "hand",
        "groups": ["hand", "spare"],
        "teds_sha256": "ab" * 32,
        "keys": [
            {
                "key_id": f"{epoch}" * 16,
                "epoch": epoch,
                "state": "active" if epoch == 3 else "pending",
                "source": source,
                "created": f"2026-01-29T10:00:0{epoch - 2}Z",
            }
            for epoch, source in ((5, "import"), (4, "import"), (3, "agreement"))
        ],
        "rotation_due": None,
        "moved_to": None,
        "holders": [{"fingerprint": ELSEWHERE, "mode": "copy", "since": "2026-01-30T10:00:00Z"}],
        "wrapped": None,
        "revoked": None,
        "firmware": None,
    }


def test_the_json_of_trust_and_handovers_has_every_member(station: Path) -> None:
    trusted = call(station, "--json", "trust", "list").json
    assert set(trusted) == {"trusted", "own"}
    assert set(trusted["own"]) == {"name", "fingerprint", "ca"}
    assert trusted["trusted"] == [
        {
            "name": "lab",
            "role": "station",
            "fingerprint": DIGITS[7],
            "added": "2026-01-28T10:00:00Z",
            "certified": False,
            "source": "added",
        },
        {"name": "owner", "role": "ca", "fingerprint": DIGITS[8], "added": "2026-01-28T11:00:00Z"},
    ]
    sent, came = call(station, "--json", "handover", "list").json["handovers"]
    assert sent == {
        "id": "0f0e0d0c-0b0a-4908-8706-050403020100",
        "direction": "out",
        "mode": "move",
        "state": "open",
        "peers": [DIGITS[7]],
        "names": ["lab"],
        "count": 2,
        "created": "2026-01-30T10:00:00Z",
        "expires": "2026-02-28T10:00:00Z",
        "expired": True,
    }
    assert came == sent | {
        "id": "1f0e0d0c-0b0a-4908-8706-050403020100",
        "direction": "in",
        "mode": "copy",
        "state": "imported",
        "peers": [DIGITS[9]],
        "names": [DIGITS[9][:16]],
        "created": "2026-01-30T10:00:05Z",
        "expired": False,
    }


def test_trust_is_listed_with_its_own_keys_first(station: Path) -> None:
    own, lab, owner = call(station, "trust", "list").out.splitlines()
    assert own.startswith("this station   bench  ")
    assert (lab, owner) == ("station        lab  b33e4d1c20df2789", "ca             owner  9d1524d355ca8bf4")
