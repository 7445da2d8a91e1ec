"""``group delete`` beside measurements that are kept for the group: never dropped without a word."""

from __future__ import annotations

from pathlib import Path

import pytest

from teds_provision.station.station import Station
from teds_provision.station.store.records import Group, KeptMeasurement
from tests.terminal import on_terminal

from .shell import call

ONE = bytes.fromhex("8d4d9da65281f7000000")


@pytest.fixture
def measured(home: Path) -> Path:
    """Return a group with a measurement that the page began, and another one without."""
    with Station.inspect(home) as store:
        store.groups.put(Group("crane", (ONE,)))
        store.groups.put(Group("spare", (ONE,)))
        store.measurements.keep(KeptMeasurement("1a2b3c4d", group="crane", owner="page"))
    return home


def test_a_group_that_does_not_exist_is_named_as_one_that_may_be_meant(measured: Path) -> None:
    outcome = call(measured, "--json", "measure", "arm", "--can", "udp_multicast:239.74.163.2")
    assert outcome.code == 3, outcome
    assert outcome.json["error"]["message"] == "No node or group is known as 'arm'."
    assert all(word in outcome.json["error"]["hint"] for word in ("crane", "spare", "group create arm UUID"))


def kept(home: Path) -> list[str]:
    with Station.inspect(home) as store:
        return [measurement.id for measurement in store.measurements.all()]


def test_a_kept_measurement_is_named_and_goes_only_with_a_word(measured: Path) -> None:
    refused = call(measured, "--json", "group", "delete", "crane")
    assert (refused.code, refused.json["error"]["code"]) == (6, "frozen")
    assert "1a2b3c4d" in refused.json["error"]["message"]
    assert "group delete crane --yes" in refused.json["error"]["hint"]
    plan = call(measured, "group", "delete", "crane", "--dry-run")
    assert (plan.code, "1a2b3c4d" in plan.err) == (0, True)
    no = on_terminal(measured, "group", "delete", "crane", answers=["n"])
    assert (no.code, "1a2b3c4d" in no.screen) == (6, True), no.screen
    assert kept(measured) == ["1a2b3c4d"]

    yes = on_terminal(measured, "group", "delete", "crane", answers=["y"])
    assert yes.code == 0, yes.screen
    assert kept(measured) == []
    entries = call(measured, "--json", "log").json["entries"]
    assert [entry["detail"] for entry in entries if entry["act"] == "group"] == [
        {"group": "crane", "measurements": ["1a2b3c4d"]}
    ]
    assert [entry["detail"]["id"] for entry in entries if entry["act"] == "measure"] == ["1a2b3c4d"]


def test_with_yes_it_is_reported_and_a_group_without_one_needs_none(measured: Path) -> None:
    done = call(measured, "--json", "group", "delete", "crane", "--yes")
    assert (done.code, done.json["ended"]) == (0, ["1a2b3c4d"])
    assert [group["name"] for group in done.json["groups"]] == ["spare"]
    plain = call(measured, "--json", "group", "delete", "spare")
    assert plain.json == {"groups": []}
    assert call(measured, "group", "delete", "spare").code == 0


def test_a_dry_run_shows_the_group_as_it_would_be_and_refuses_what_the_change_refuses(measured: Path) -> None:
    other = "91aa9da65281f7000000"
    assert call(measured, "whitelist", "add", ONE.hex(), "--fingerprint", "ab" * 32).code == 0
    assert call(measured, "whitelist", "add", other, "--fingerprint", "cd" * 32).code == 0
    for words, uuids in ((("add", "crane", other), [ONE.hex(), other]), (("remove", "crane", ONE.hex()), [])):
        plan = call(measured, "--json", "group", *words, "--dry-run")
        assert plan.json["groups"] == [{"name": "crane", "uuids": uuids}]
    assert call(measured, "--json", "group", "create", "arm", other, "--dry-run").json["groups"] == [
        {"name": "arm", "uuids": [other]}
    ]
    before = [{"name": "crane", "uuids": [ONE.hex()]}, {"name": "spare", "uuids": [ONE.hex()]}]
    assert call(measured, "--json", "group", "list").json["groups"] == before
    assert call(measured, "group", "create", "crane", other, "--dry-run").code == 2, "it has other members"
    with Station.inspect(measured) as store, store.groups.frozen("crane"):
        assert call(measured, "group", "add", "crane", other, "--dry-run").code == 6, "it is measured"


@pytest.mark.parametrize("option", [(), ("--dry-run",)])
def test_deleting_a_group_that_does_not_exist_says_so(measured: Path, option: tuple[str, ...]) -> None:
    done = call(measured, "group", "delete", "cranes", *option)
    assert done.code == 0, "every command can be repeated"
    assert "there is no group 'cranes'" in done.err


OTHER = bytes.fromhex("91aa9da65281f7000000")


def test_what_the_group_commands_print(measured: Path) -> None:
    for uuid in (ONE, OTHER):
        call(measured, "whitelist", "add", uuid.hex(), "--fingerprint", uuid.hex() + "00" * 22)
    with Station.inspect(measured) as store:
        store.measurements.keep(KeptMeasurement("5e6f7a8b", group="crane", owner="page"))
    both = "1a2b3c4d, 5e6f7a8b"
    one, other = ONE.hex(), OTHER.hex()
    for words, out, err in (
        ("list", f"crane: {one}\nspare: {one}\n", ""),
        (f"create arm {other} {one} {other}", f"arm: {one}, {other}\n", ""),
        ("create leg", "leg: no nodes yet\n", ""),
        (f"create foot {one} --dry-run", f"foot: {one}\n", "Plan, nothing is changed:\n"),
        (f"add leg {one} {other}", f"leg: {one}, {other}\n", ""),
        (f"add leg {one} --dry-run", f"leg: {one}, {other}\n", "Plan, nothing is changed:\n"),
        (f"remove leg {one}", f"leg: {other}\n", ""),
        ("delete leg --dry-run", f"arm: {one}, {other}\ncrane: {one}\nleg: {other}\nspare: {one}\n",
         "Would delete group leg.\n"),
        ("delete leg", f"arm: {one}, {other}\ncrane: {one}\nspare: {one}\n", ""),
        ("delete leg --dry-run", f"arm: {one}, {other}\ncrane: {one}\nspare: {one}\n",
         "Nothing to do: there is no group 'leg'.\n"),
        ("delete leg", f"arm: {one}, {other}\ncrane: {one}\nspare: {one}\n",
         "Nothing to do: there is no group 'leg'.\n"),
        ("delete crane --dry-run", f"arm: {one}, {other}\ncrane: {one}\nspare: {one}\n",
         f"Would delete group crane and its measurements {both}.\n"),
        ("delete crane --yes", f"arm: {one}, {other}\nspare: {one}\n", f"Also deleted: measurements {both}.\n"),
        ("delete arm --yes", f"spare: {one}\n", ""),
        ("delete spare", "There are no groups yet. To create one: teds-provision group create NAME UUID …\n", ""),
    ):  # fmt: skip
        done = call(measured, "group", *words.split())
        assert (done.code, done.out, " ".join(done.err.split())) == (0, out, err.strip()), words
    log = call(measured, "--json", "log").json["entries"]
    assert [entry["detail"] for entry in log if entry["act"] == "group" and entry["outcome"] == "deleted"] == [
        {"group": "leg", "measurements": []},
        {"group": "crane", "measurements": ["1a2b3c4d", "5e6f7a8b"]},
        {"group": "arm", "measurements": []},
        {"group": "spare", "measurements": []},
    ]
    assert [entry["detail"] for entry in log if entry["act"] == "measure" and entry["outcome"] == "ended"] == [
        {"id": "1a2b3c4d", "group": "crane"},
        {"id": "5e6f7a8b", "group": "crane"},
    ]


def test_a_plan_names_the_measurements_that_would_end(measured: Path) -> None:
    plan = call(measured, "--json", "group", "delete", "crane", "--dry-run").json
    assert (plan["ended"], [group["name"] for group in plan["groups"]]) == (["1a2b3c4d"], ["crane", "spare"])
    assert "ended" not in call(measured, "--json", "group", "delete", "spare", "--dry-run").json
    assert kept(measured) == ["1a2b3c4d"]


def test_one_measurement_of_a_group_is_one(measured: Path) -> None:
    plan = call(measured, "group", "delete", "crane", "--dry-run")
    assert plan.err == "Would delete group crane and its measurement 1a2b3c4d.\n"
    assert kept(measured) == ["1a2b3c4d"]
    assert "Also deleted: measurement 1a2b3c4d." in call(measured, "group", "delete", "crane", "--yes").err
