"""``whitelist``: what it says, asks, refuses, and what repeating it does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from teds_provision.protocol.keys import SoftwareKey
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord, WhitelistEntry
from teds_provision.vault.selection import forget_vaults
from tests.bench import PASSPHRASE, make_station

from .shell import call

ONE, TWO = "8d4d9da65281f7000000", "8d4d9da65281f7000001"
KEY, OTHER = "ab" * 32, "cd" * 32


def test_adding_again_is_nothing_to_do_and_another_key_is_refused(home: Path) -> None:
    added = call(home, "--json", "whitelist", "add", "0x" + ONE.upper(), "--fingerprint", KEY, "--name", "finger")
    assert added.code == 0
    (entry,) = added.json["whitelist"]
    assert (entry["uuid"], entry["fingerprint"], entry["name"]) == (ONE, KEY, "finger")
    again = call(home, "whitelist", "add", "finger", "--fingerprint", KEY)
    assert (again.code, "nothing to do" in again.out) == (0, True)
    other = call(home, "--json", "whitelist", "add", ONE, "--fingerprint", OTHER)
    assert (other.code, other.json["error"]["code"]) == (6, "other-key")
    assert f"whitelist remove {ONE}" in other.json["error"]["hint"]


def test_a_name_that_is_given_is_written_and_one_in_a_file_replaces_none(home: Path, tmp_path: Path) -> None:
    """`add` ended with "nothing to do" here, and the old name stayed."""
    call(home, "whitelist", "add", ONE, "--name", "finger")
    for name, changed in (("thumb", 1), ("thumb", 0)):
        for dry in (["--dry-run"], []):
            given = call(home, "--json", "whitelist", "add", ONE, "--name", name, *dry).json
            assert (given["added"], given["changed"], given["unchanged"]) == (0, changed, 1 - changed), (name, dry)
    (entry,) = call(home, "--json", "whitelist", "list").json["whitelist"]
    assert (entry["name"], entry["fingerprint"], entry["assurance"]) == ("thumb", None, "uuid")
    (tmp_path / "list.csv").write_text(f"uuid,fingerprint,name\n{ONE},{KEY},palm\n")
    taken = call(home, "--json", "whitelist", "import", tmp_path / "list.csv").json
    assert [(entry["name"], entry["fingerprint"]) for entry in taken["whitelist"]] == [("thumb", KEY)]
    assert call(home, "--json", "whitelist", "add", ONE).json["unchanged"] == 1


def test_the_nodes_own_name_is_not_written_twice(home: Path) -> None:
    call(home, "whitelist", "add", ONE)
    with Station.open(home, ask=lambda _prompt, _confirm: PASSPHRASE) as station, station.transaction():
        station.nodes.remember(bytes.fromhex(ONE), name="thumb")
    assert call(home, "--json", "whitelist", "add", ONE, "--name", "thumb").json["unchanged"] == 1
    assert call(home, "--json", "whitelist", "add", ONE, "--name", "palm").json["changed"] == 1
    again = call(home, "--json", "whitelist", "add", ONE, "--name", "thumb").json
    assert (again["changed"], again["whitelist"][0]["name"]) == (1, "thumb")


def test_removing_asks_and_then_another_key_may_come(home: Path) -> None:
    call(home, "whitelist", "add", ONE, "--fingerprint", KEY)
    assert call(home, "whitelist", "remove", ONE).code == 6
    plan = call(home, "--json", "whitelist", "remove", ONE, "--dry-run")
    assert [entry["uuid"] for entry in plan.json["whitelist"]] == [ONE]
    removed = call(home, "--json", "whitelist", "remove", "8d4d", "--yes")
    assert (removed.code, removed.json["whitelist"], removed.json["removed"]) == (0, [], True)
    assert call(home, "whitelist", "remove", ONE, "--yes").code == 0
    assert call(home, "whitelist", "add", ONE, "--fingerprint", OTHER).code == 0


@pytest.mark.parametrize("form", ["xml", "csv", "json"])
def test_export_and_import_go_round(home: Path, tmp_path: Path, form: str) -> None:
    for uuid in (TWO, ONE):
        call(home, "whitelist", "add", uuid, "--fingerprint", KEY)
    path = tmp_path / f"list.{form}"
    exported = call(home, "--json", "whitelist", "export", path)
    assert [entry["uuid"] for entry in exported.json["whitelist"]] == [ONE, TWO]
    for uuid in (ONE, TWO):
        call(home, "whitelist", "remove", uuid, "--yes")
    assert call(home, "--json", "whitelist", "import", path, "--dry-run").json["whitelist"] == []
    imported = call(home, "--json", "whitelist", "import", path)
    assert [(entry["uuid"], entry["assurance"]) for entry in imported.json["whitelist"]] == [
        (ONE, "import"),
        (TWO, "import"),
    ]
    again = call(home, "--json", "whitelist", "import", path)
    assert (again.code, again.json["added"], again.json["changed"], again.json["unchanged"]) == (0, 0, 0, 2)


@pytest.mark.parametrize("form", ["xml", "csv", "json"])
def test_an_export_has_the_names_of_nodes_and_import_keeps_them(home: Path, tmp_path: Path, form: str) -> None:
    """Provisioning gives the name to the node, not to its whitelist entry; other readers find an attribute."""
    call(home, "whitelist", "add", ONE, "--fingerprint", KEY)
    with Station.inspect(home) as station:
        station.nodes.restore(NodeRecord(bytes.fromhex(ONE), name='left "hand" <2>'))
    path = tmp_path / f"list.{form}"
    exported = call(home, "whitelist", "export", path)
    assert exported.out == f"Wrote 1 entry as {form} to {path}.\n"
    own = call(home, "whitelist", "import", path)
    assert own.out == "Whitelist: 0 new, 0 changed, 1 unchanged (nothing to do).\n", (
        "what it shows already is no change"
    )
    other = tmp_path / "other"
    make_station(other).close()
    taken = call(other, "--json", "whitelist", "import", path)
    assert [entry["name"] for entry in taken.json["whitelist"]] == ['left "hand" <2>']
    if form == "xml":
        (element,) = ElementTree.parse(path).getroot()
        assert (element.get("uuid"), element.get("name")) == (f"0x{ONE}", 'left "hand" <2>')


def test_nothing_is_imported_by_half(home: Path, tmp_path: Path) -> None:
    path = tmp_path / "bad.xml"
    path.write_text(f'<whitelist>\n<transducer uuid="{ONE}"/>\n<transducer uuid="8d4d"/></whitelist>')
    refused = call(home, "--json", "whitelist", "import", path)
    assert refused.code == 8
    assert "bad.xml:3: uuid" in refused.json["error"]["message"]
    assert call(home, "--json", "whitelist", "list").json == {"whitelist": []}


def test_an_export_that_cannot_be_written_leaves_nothing(home: Path, tmp_path: Path) -> None:
    assert call(home, "whitelist", "export", tmp_path / "none" / "list.xml").code == 3
    assert call(home, "whitelist", "export", tmp_path / "list.dat").code == 2
    assert not (tmp_path / "list.dat").exists()


def test_the_list_shows_keys_short_and_names_as_they_are(home: Path) -> None:
    call(home, "whitelist", "add", ONE, "--fingerprint", KEY, "--name", "[red]x[/]")
    call(home, "whitelist", "add", TWO)
    shown = call(home, "whitelist", "list").out
    assert KEY[:16] in shown
    assert KEY not in shown
    assert "[red]x[/]" in shown
    assert "not pinned yet" in shown
    assert json.loads(call(home, "--json", "whitelist", "list").out)["whitelist"][1]["fingerprint"] is None


def test_a_name_that_no_terminal_and_no_xml_can_hold_is_refused_or_made_harmless(home: Path, tmp_path: Path) -> None:
    assert call(home, "whitelist", "add", ONE, "--name", "a\x1b[31m").code == 8
    station = Station.open(home, ask=lambda prompt, confirm: PASSPHRASE)
    station.pins.put(WhitelistEntry(bytes.fromhex(ONE), name="a\x1b[31m\x01"))
    station.close()
    assert "\x1b" not in call(home, "whitelist", "list").out
    call(home, "whitelist", "export", tmp_path / "list.xml")
    assert call(home, "whitelist", "import", tmp_path / "list.xml").code == 0
    assert "\x01" not in (tmp_path / "list.xml").read_text()


def test_a_fingerprint_that_is_none_is_usage(home: Path) -> None:
    assert call(home, "whitelist", "add", ONE, "--fingerprint", "12").code == 2
    assert call(home, "whitelist", "add", "8d4d").code == 3


def test_changing_a_pin_needs_the_vault_and_a_list_does_not(home: Path) -> None:
    assert call(home, "whitelist", "add", ONE, passphrase=None).code == 7
    assert call(home, "whitelist", "add", ONE).code == 0
    forget_vaults()
    assert call(home, "whitelist", "add", ONE, passphrase=None).code == 0  # nothing to do
    assert call(home, "whitelist", "remove", ONE, "--yes", passphrase=None).code == 7
    listed = call(home, "--json", "whitelist", "list", passphrase=None).json["whitelist"]
    assert [entry["uuid"] for entry in listed] == [ONE]


@pytest.mark.parametrize("form", ["csv", "json", "xml"])
def test_a_dash_is_stdout_and_no_file_of_that_name(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert call(home, "whitelist", "add", "8d4d9da65281f7000000", "--fingerprint", "ab" * 32).code == 0
    printed = call(home, "whitelist", "export", "-", "--format", form)
    assert call(home, "whitelist", "export", tmp_path / "list", "--format", form).code == 0
    assert printed.out == (tmp_path / "list").read_text()
    assert not (tmp_path / "-").exists()
    assert call(home, "--json", "whitelist", "export", "-").code == 2


def test_what_each_change_of_the_list_says(home: Path, tmp_path: Path) -> None:
    """Each step with what stands on stdout and, with JSON, in `removed`; an entry's key is shown by 32 digits."""
    file, none = tmp_path / "list.csv", tmp_path / "none.csv"
    for words, text in (
        (["list"], "The whitelist is empty."),
        (["add", ONE, "--name", "elbow", "--dry-run"], "Plan: 1 new, 0 changed, 0 unchanged."),
        (["add", ONE, "--name", "elbow"], "Whitelist: 1 new, 0 changed, 0 unchanged."),
        (["add", ONE], "Whitelist: 0 new, 0 changed, 1 unchanged (nothing to do)."),
        (["export", none, "--dry-run"], f"Would write 1 entry as csv to {none}."),
        (["export", file], f"Wrote 1 entry as csv to {file}."),
        (["import", file, "--dry-run"], "Plan: 0 new, 0 changed, 1 unchanged."),
        (["import", file], "Whitelist: 0 new, 0 changed, 1 unchanged (nothing to do)."),
        (["export", "-", "--format", "csv", "--dry-run"], "Would write 1 entry as csv to -."),
        (
            ["remove", ONE, "--dry-run"],
            f"Plan: remove {ONE} (elbow) from the whitelist and forget its key as last seen.",
        ),
        (["remove", ONE, "--yes"], f"{ONE} (elbow) is no longer on the whitelist."),
        (["remove", ONE, "--yes"], f"{ONE} is not on the whitelist (nothing to do)."),
        (["add", TWO, "--fingerprint", KEY], "Whitelist: 1 new, 0 changed, 0 unchanged."),
        (["remove", TWO, "--dry-run"], f"Plan: remove {TWO} from the whitelist and forget its key {KEY[:32]}."),
    ):
        outcome = call(home, "whitelist", *words)
        assert (outcome.code, outcome.out) == (0, f"{text}\n"), words
    assert not none.exists()
    for words, removed in ((["--dry-run"], False), (["--yes"], True), (["--yes"], False), (["--dry-run"], False)):
        assert call(home, "--json", "whitelist", "remove", TWO, *words).json["removed"] is removed
    with Station.open(home, ask=lambda _prompt, _confirm: PASSPHRASE) as station, station.transaction():
        station.nodes.remember(bytes.fromhex(ONE), point=SoftwareKey(9).point)
    assert call(home, "--json", "whitelist", "remove", ONE, "--dry-run").json["removed"] is False
    assert call(home, "whitelist", "remove", ONE, "--yes").out == (
        f"{ONE} is not on the whitelist; its key is forgotten.\n"
    )


def test_the_list_unlocks_the_vault_before_it_takes_the_store(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A passphrase is typed while no other command waits."""
    done: list[str] = []
    unlock, lock = Station.unlock, Station.lock

    def noted_unlock(station: Station, *of: Any) -> None:
        done.append("unlock")
        unlock(station, *of)

    def noted_lock(station: Station, *of: Any, **more: Any) -> Any:
        done.append("lock")
        return lock(station, *of, **more)

    monkeypatch.setattr(Station, "unlock", noted_unlock)
    monkeypatch.setattr(Station, "lock", noted_lock)
    for words in (["add", ONE], ["remove", ONE, "--yes"]):
        done.clear()
        assert call(home, "whitelist", *words).code == 0
        assert done[:2] == ["unlock", "lock"], words


def test_an_eui_64_is_a_uuid_unless_a_known_node_begins_with_it(home: Path) -> None:
    eui = "00:12:4b:00:14:b5:d9:99"
    assert call(home, "--json", "whitelist", "add", eui).code == 0
    listed = call(home, "--json", "whitelist", "list").json["whitelist"]
    assert [node["uuid"] for node in listed] == ["fffe00124b0014b5d999"]
    known = "00124b0014b5d9990000"
    assert call(home, "whitelist", "add", known).code == 0
    assert call(home, "whitelist", "add", eui.replace(":", ""), "--name", "first").code == 0
    named = call(home, "--json", "whitelist", "list").json["whitelist"]
    assert {node["uuid"]: node["name"] for node in named} == {"fffe00124b0014b5d999": None, known: "first"}
    unknown = call(home, "--json", "whitelist", "add", "nobody")
    assert (unknown.code, "nobody" in unknown.json["error"]["message"]) == (3, True)


def test_what_another_command_adds_meanwhile_is_not_written_over(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plan is made again under the lock: the other one may have pinned another key."""
    lock = Station.lock
    others: list[list[str]] = []

    def after_another(station: Station, command: str, *of: Any, **more: Any) -> Any:
        if others:
            call(home, *others.pop())
        return lock(station, command, *of, **more)

    monkeypatch.setattr(Station, "lock", after_another)
    others.append(["whitelist", "add", ONE, "--fingerprint", OTHER])
    refused = call(home, "--json", "whitelist", "add", ONE, "--fingerprint", KEY)
    assert (refused.code, refused.json["error"]["code"]) == (6, "other-key")
    (entry,) = call(home, "--json", "whitelist", "list").json["whitelist"]
    assert entry["fingerprint"] == OTHER
    others.append(["whitelist", "add", TWO, "--fingerprint", KEY, "--name", "palm"])
    same = call(home, "--json", "whitelist", "add", TWO, "--fingerprint", KEY, "--name", "palm").json
    assert (same["added"], same["changed"], same["unchanged"]) == (0, 0, 1)


@pytest.mark.parametrize("words", [[], ["--dry-run"], ["--format", "csv"]])
def test_a_list_on_stdout_is_no_result_in_json_neither_is_its_plan(home: Path, words: list[str]) -> None:
    refused = call(home, "--json", "whitelist", "export", "-", *words)
    assert (refused.code, refused.json["error"]) == (
        2,
        {"code": "usage", "message": "--json prints the whitelist itself.", "hint": "Omit --json, or name a file."},
    )
