"""Whose calibration and name a datasheet gets, and what of a node's present one stays."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.provisioning import build as step
from teds_provision.provisioning.build import (
    BuildOrder,
    ComposedTeds,
    PreparedOrder,
    Proposal,
    UnrequestedChangeError,
    certificate_brought,
    compose,
    no_confirmation,
    own_name,
    pending_image,
    prepare,
)
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft
from teds_provision.teds.image import SECURITY, Image

UUID = bytes.fromhex("8d4d9da65281f7000000")
FINGER = "tactile-finger-sensor"


def order(folder: Path, *, high: int = 10, **more: Any) -> BuildOrder:
    file = folder / f"force-{high}.csv"
    file.write_text(f"raw,value [N]\n0,0\n65535,{high}\n")
    return BuildOrder(FINGER, calibration=file, **more)


def composed(station: Station, ordered: BuildOrder, has: Image | None = None, **more: Any) -> ComposedTeds:
    return compose(station, UUID, prepare(station, ordered, UUID), has, **more)


def test_a_calibration_of_one_channel_leaves_those_of_the_others(station: Station, tmp_path: Path) -> None:
    first = composed(station, order(tmp_path, channel=1))
    assert list(first.calibrations) == [1]
    has = Image(UUID, dict(first.blocks))
    keeps = "Channel 1 keeps its calibration."
    both = composed(station, order(tmp_path, channel=2), has)
    assert list(both.calibrations) == [1, 2]
    assert (keeps in both.warnings, both.blocks[1, 5]) == (True, has.blocks[1, 5])
    other = composed(station, order(tmp_path, high=8, channel=1), has)
    assert (list(other.calibrations), keeps in other.warnings) == ([1], False)
    assert other.blocks[1, 5] != has.blocks[1, 5]
    named = composed(station, BuildOrder(FINGER, name="a"), has)
    assert (list(named.calibrations), keeps in named.warnings) == ([1], True)
    two = composed(station, BuildOrder(FINGER), Image(UUID, dict(both.blocks)))
    assert "Channels 1, 2 keep their calibrations." in two.warnings
    for dropped in (BuildOrder(FINGER, drop_calibration=True), BuildOrder(FINGER)):
        bare = composed(station, dropped, has if dropped.drop_calibration else None)
        assert (dict(bare.calibrations), keeps in bare.warnings) == ({}, False)


@pytest.mark.parametrize(
    ("ordered", "name", "known", "as_known", "kept"),
    [
        ("ordered", "own", "known", True, "ordered"),
        (None, "own", "known", True, "own"),
        (None, None, "known", True, "known"),
        (None, None, "known", False, None),
        (None, None, None, True, None),
    ],
)
def test_the_name_is_the_ordered_one_else_the_boards_own_else_the_stations(
    station: Station, ordered: str | None, name: str | None, known: str | None, as_known: bool, kept: str | None
) -> None:
    if known is not None:
        station.nodes.remember(UUID, name=known)
    found = composed(station, BuildOrder(FINGER, name=ordered), name=name, as_known=as_known)
    assert found.name == kept


def test_a_profile_that_changed_is_told_unless_it_is_named(station: Station) -> None:
    station.nodes.remember(UUID, profile=FINGER, profile_digest="00" * 32)
    changed = f"Profile {FINGER} has changed since this node's datasheet was built."
    for ordered, told in ((BuildOrder(name="a"), True), (BuildOrder(FINGER), False)):
        found = composed(station, ordered)
        assert (found.changed, changed in found.warnings) == (told, told)
    station.nodes.remember(UUID, profile_digest=composed(station, BuildOrder(FINGER)).digest)
    assert not composed(station, BuildOrder(name="a")).changed


def test_a_name_that_the_type_gives_to_all_is_no_nodes_own(station: Station) -> None:
    common = Image(UUID, dict(composed(station, BuildOrder(FINGER)).blocks))
    own = Image(UUID, dict(composed(station, BuildOrder(FINGER, name="left")).blocks))
    assert (own_name(station, common, FINGER), own_name(station, own, FINGER)) == (None, "left")
    assert own_name(station, common, None) is not None, "which type it had is not known"
    assert own_name(station, common, "no-such-type") is not None
    assert own_name(station, Image(UUID, {}), FINGER) is None


@pytest.mark.parametrize(
    ("stage", "drafted", "on_node", "pending"),
    [
        ("built", 1, 5, True),
        ("signed", 6, 5, True),
        ("signed", 5, 5, False),  # it was written
        ("signed", 4, 5, False),
        ("signed", 1, None, True),
    ],
)
def test_a_draft_is_pending_until_the_node_has_a_datasheet_as_new(
    station: Station, monkeypatch: pytest.MonkeyPatch, stage: Any, drafted: int, on_node: int | None, pending: bool
) -> None:
    monkeypatch.setattr(step.security, "decode", lambda octets: SimpleNamespace(sequence=octets[0]))
    image = Image(UUID, {SECURITY: bytes([drafted])})
    assert pending_image(station, UUID, None) is None
    monkeypatch.setattr(type(station.datasheets), "draft", lambda *_: Draft(UUID, image, stage, None))
    has = None if on_node is None else Image(UUID, {SECURITY: bytes([on_node])})
    assert pending_image(station, UUID, has) is (image if pending else None)


def test_only_a_change_that_was_not_named_needs_a_yes() -> None:
    changes: Any = tuple(SimpleNamespace(text=f"change {number}.") for number in range(4))
    asked: list[Any] = []
    for number, named, asks in ((4, False, True), (4, True, False), (0, False, False), (0, True, False)):
        asked.clear()
        Proposal(Image(UUID, {}), changes[:number], named).require_a_yes(lambda *question: asked.append(question))
        assert asked == ([(UUID, changes)] if asks else [])
    for number, text in ((3, "change 0. change 1. change 2."), (4, "change 0. change 1. change 2. And 1 more.")):
        with pytest.raises(UnrequestedChangeError) as refused:
            no_confirmation(UUID, changes[:number])
        assert refused.value.message == (
            f"Node {UUID.hex()} has a different datasheet, and this command does not name what would change: {text}"
        )
        assert (refused.value.changes, refused.value.code, refused.value.exit_code) == (
            changes[:number], "not-named", 6,
        )  # fmt: skip


def test_the_certificate_of_a_run_is_one_that_was_read_now() -> None:
    read, kept = SimpleNamespace(signature="good"), SimpleNamespace(signature=None)
    none, old, new = (SimpleNamespace(certificate=certificate) for certificate in (None, kept, read))
    for calibrations, found in (((none, old, new), read), ((old,), None), ((), None)):
        assert certificate_brought(dict(enumerate(calibrations))) is found  # type: ignore[arg-type]


def test_an_order_that_was_prepared_for_no_type_is_composed_by_the_one_of_the_node(station: Station) -> None:
    station.nodes.remember(UUID, profile="load-cell")
    assert compose(station, UUID, PreparedOrder(BuildOrder()), None).profile.name == "load-cell"


NAMED, CALIBRATED = BuildOrder(name="a"), BuildOrder(drop_calibration=True)


@pytest.mark.parametrize(
    ("ordered", "intact", "fixed", "mends", "way"),
    [
        # nothing is named: what a node has stays
        (BuildOrder(), True, False, False, "as it is"),
        (BuildOrder(), True, True, False, "as it is"),
        # a type: all of it, and no calibration of a run that was cut
        (BuildOrder(FINGER), True, False, False, "composed, named, anew"),
        (BuildOrder(FINGER, name="a"), True, True, False, "composed, named, anew"),
        # anything else: that alone
        (NAMED, True, False, False, "what is named"),
        (CALIBRATED, True, False, False, "what is named"),
        # what is not authentic is mended, else composed; of a type that was not named that needs a yes
        (BuildOrder(), False, False, True, "mended"),
        (BuildOrder(), False, False, False, "composed, resumed"),
        (NAMED, False, False, False, "composed, resumed"),
        (BuildOrder(FINGER), False, False, False, "composed, named, resumed"),
        # fixed TEDS of the factory are no datasheet that is lost
        (BuildOrder(), False, True, True, "composed, named, resumed"),
        (NAMED, False, True, True, "composed, named, resumed"),
        (BuildOrder(FINGER), False, True, False, "composed, named, resumed"),
        (BuildOrder(adopt=True), False, True, False, "composed, named, resumed"),
        # its own datasheet
        (BuildOrder(adopt=True), False, False, False, "as it is"),
        (BuildOrder(adopt=True), True, True, False, "as it is"),
        (BuildOrder(adopt=True, name="a"), False, False, False, "brought"),
        (BuildOrder(adopt=True, name="a"), True, True, False, "brought"),
    ],
)
def test_what_a_node_gets_by_what_it_has_and_what_is_named(
    monkeypatch: pytest.MonkeyPatch, ordered: BuildOrder, intact: bool, fixed: bool, mends: bool, way: str
) -> None:
    def composed_of(*_: object, named: bool, resume: bool = True) -> str:
        return f"composed, {'named, ' if named else ''}{'resumed' if resume else 'anew'}"

    brought = SimpleNamespace(image=Image(UUID, {(0, 12): b"x"}), name="a")
    monkeypatch.setattr(step, "_intact", lambda *_: intact)
    monkeypatch.setattr(step, "_composed", composed_of)
    monkeypatch.setattr(step, "_as_it_is", lambda *_: "as it is")
    monkeypatch.setattr(step, "_mended", lambda *_: "mended" if mends else None)
    monkeypatch.setattr(step, "_only_what_is_named", lambda *_: "what is named")
    monkeypatch.setattr(step, "read_factory_datasheet", lambda *_, **__: brought)
    present: Any = SimpleNamespace(is_fixed=fixed, image=Image(UUID, {}))
    found = step._proposal(None, PreparedOrder(ordered), present)  # type: ignore[arg-type]
    if way == "brought":
        assert (found.image, found.named, found.name) == (brought.image, True, "a")
    else:
        assert found == way


@pytest.mark.parametrize(("has", "keeps"), [("nothing", True), ("a key alone", True), ("a datasheet", False)])
def test_a_trial_build_changes_no_facts_of_a_node_that_has_a_datasheet(
    station: Station, monkeypatch: pytest.MonkeyPatch, has: str, keeps: bool
) -> None:
    blocks = dict(composed(station, BuildOrder(FINGER)).blocks)
    known = {"nothing": None, "a key alone": Image(UUID, {SECURITY: b"x"}), "a datasheet": Image(UUID, blocks)}[has]
    monkeypatch.setattr(type(station.datasheets), "datasheet", lambda *_: known)
    monkeypatch.setattr(step, "known_node_keys", lambda *_: None)
    monkeypatch.setattr(step, "unsigned_security", lambda *_: b"unsigned")
    step.build(station, UUID, BuildOrder(FINGER, name="trial"), keep_draft=False)
    assert station.nodes.get(UUID) is None
    assert station.datasheets.draft(UUID) is None
    step.build(station, UUID, BuildOrder(FINGER, name="trial"))
    record = station.nodes.get(UUID)
    kept = (record.profile, record.name) if record is not None else (None, None)
    assert kept == ((FINGER, "trial") if keeps else (None, None))
    draft = station.datasheets.draft(UUID)
    assert draft is not None
    assert (draft.stage, draft.profile, draft.image.security) == ("built", FINGER, b"unsigned")
