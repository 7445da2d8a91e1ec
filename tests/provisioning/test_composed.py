"""Whose calibration and name a datasheet gets, and what of a node's present one stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError, NotFoundError
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
from teds_provision.teds.profile import load_profile

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


@pytest.mark.parametrize("record", [True, False])
def test_a_calibration_that_was_accepted_is_recorded_unless_it_is_a_dry_run(
    station: Station, monkeypatch: pytest.MonkeyPatch, record: bool
) -> None:
    has, image = Image(UUID, {(0, 1): b"old"}), Image(UUID, {(0, 1): b"new"})
    whole = Proposal(image, (), True, ("first",), "gripper", "hand", {}, "ab")
    calibrated = replace(whole, calibrations={1: "calibration"})  # type: ignore[dict-item]
    prepared: Any = SimpleNamespace(order=SimpleNamespace(accept_calibration="a reason"), profile="profile")
    given: list[Any] = []
    monkeypatch.setattr(step, "guard", lambda *words, **how: (given.append((words[1:], how)), ("guarded", "first"))[1])
    monkeypatch.setattr(step, "topic_warnings", lambda *words: (str(words[1:] == (has, image)),))
    for proposal, guarded in ((whole, (None, None)), (calibrated, ({1: "calibration"}, "profile"))):
        monkeypatch.setattr(step, "_proposal", lambda *_, proposal=proposal: proposal)
        found = step.propose(station, prepared, SimpleNamespace(image=has), record=record)  # type: ignore[arg-type]
        assert given.pop() == ((image, has, "a reason", *guarded), {"record": record})
        assert found == replace(proposal, changes=found.changes, warnings=("first", "guarded", "True"))
        assert len(found.changes) == 1


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


# -- what is brought back, and what stays ------------------------------------------------------------------------------

KEPT = [Image(UUID, {(0, 1): bytes([number]), SECURITY: b"old"}) for number in range(3)]


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({}, 2),  # an older one, if the node was signed for that
        ({"verdicts": ["not authentic"]}, None),
        ({"signed_for": b"unknown"}, None),
        ({"signed": False}, None),
        ({"security": None}, None),
        ({"security": b"cut"}, None),
        ({"order": BuildOrder(FINGER)}, None),
        ({"order": BuildOrder(name="a")}, None),
        ({"order": BuildOrder(drop_calibration=True)}, None),
    ],
)
def test_an_altered_node_gets_the_datasheet_back_that_it_was_signed_for(
    station: Station, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], found: int | None
) -> None:
    how = {"order": BuildOrder(), "security": b"now", "signed": True, "signed_for": bytes([2]),
           "verdicts": ["authentic"]} | change  # fmt: skip
    judged: list[Image] = []

    def decode(octets: bytes) -> Any:
        if octets == b"cut":
            raise BadDataError("It is cut.")
        return SimpleNamespace(signed=how["signed"], signed_blocks={(0, 1): how["signed_for"]})

    def verify_image(_station: Station, image: Image, *, floor: object) -> list[str]:
        assert floor == "floor of now"
        judged.append(image)
        return [how["verdicts"][0]]

    history = [SimpleNamespace(image=image) for image in KEPT]
    monkeypatch.setattr(type(station.datasheets), "history", lambda *_: history)
    monkeypatch.setattr(step.security, "decode", decode)
    monkeypatch.setattr(step.datasheet, "digests", dict)
    monkeypatch.setattr(step, "verify_image", verify_image)
    monkeypatch.setattr(step, "FreshnessFloor", lambda identity: f"floor of {identity}")
    monkeypatch.setattr(step, "Verification", lambda _uuid, checks: SimpleNamespace(verdict=checks[0]))
    blocks = {(0, 1): b"altered"} | ({SECURITY: how["security"]} if how["security"] else {})
    present: Any = SimpleNamespace(image=Image(UUID, blocks), identity="now")
    proposal = step._mended(station, PreparedOrder(how["order"]), present)
    if found is None:
        assert proposal is None
        return
    assert proposal == Proposal(Image(UUID, {(0, 1): bytes([found])}), (), named=True)
    assert judged == [Image(UUID, {(0, 1): bytes([found]), SECURITY: b"now"})], "under the signature that it has"


@pytest.mark.parametrize(
    ("drafted", "stays"), [(None, True), ({(0, 1): b"a", (1, 3): b"fixed"}, True), ({(0, 1): b"b"}, False)]
)
def test_what_was_built_and_never_written_is_no_part_of_what_stays_without_a_yes(
    station: Station, drafted: Any, stays: bool
) -> None:
    has = Image(UUID, {(0, 1): b"a", (1, 3): b"fixed", SECURITY: b"s"})
    wanted = Image(UUID, {(0, 1): b"a", (1, 3): b"fixed"})
    present: Any = SimpleNamespace(image=has, fixed_beside=lambda blocks: {(1, 3): b"fixed"})
    if drafted is not None:
        station.datasheets.keep_draft(Draft(UUID, Image(UUID, drafted), "built", "load-cell"))
    found = step._as_it_is(station, present)
    if stays:
        assert (found.image, found.named, found.profile) == (wanted, True, None)
        assert step.unwritten_draft(station, has, wanted) == ()
        return
    assert found.image == Image(UUID, {(0, 1): b"b", (1, 3): b"fixed"})
    assert (found.named, found.profile) == (False, "load-cell")
    (warning,) = step.unwritten_draft(station, has, wanted)
    assert warning.startswith(f"Node {UUID.hex()} has a draft (built as load-cell) that was never written; it is kept")


def test_a_draft_of_what_is_written_now_gives_no_warning_and_one_of_other_content_does(station: Station) -> None:
    has = Image(UUID, {(0, 1): b"a", SECURITY: b"s"})
    station.datasheets.keep_draft(Draft(UUID, Image(UUID, {(0, 1): b"b"}), "built", "load-cell"))
    for wanted, warned in ((b"b", False), (b"c", True), (b"a", True)):
        found = step.unwritten_draft(station, has, Image(UUID, {(0, 1): wanted}))
        assert bool(found) is warned, wanted
    station.datasheets.drop_draft(UUID)
    assert step.unwritten_draft(station, has, Image(UUID, {(0, 1): b"c"})) == ()


def test_of_a_datasheet_that_stays_those_teds_alone_change_that_are_named(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = {(0, 1): b"same", (0, 12): b"name", (1, 3): b"new", (1, 12): b"new", (2, 5): b"added"}
    unasked = {(0, 1): b"same", (0, 12): b"name", (1, 3): b"old", (1, 12): b"old", (1, 5): b"gone"}

    def compose(_station: Station, _uuid: bytes, prepared: PreparedOrder, *_: object, **more: Any) -> Any:
        assert more == {"name": None, "as_known": False}
        blocks = unasked if prepared.order == BuildOrder() else asked
        return SimpleNamespace(blocks=blocks, profile="p", warnings=("w",), wanted="p", name="n", calibrations={1: "c"})

    monkeypatch.setattr(step, "compose", compose)
    monkeypatch.setattr(step, "own_name", lambda *_: None)
    has = {(0, 1): b"own", (0, 12): b"own", (1, 3): b"own", (1, 5): b"own", (1, 12): b"fixed", (3, 3): b"own"}
    present: Any = SimpleNamespace(
        image=Image(UUID, {**has, SECURITY: b"s"}), is_read_only=lambda block: block == (1, 12)
    )
    for name in (None, "name"):
        found = step._only_what_is_named(station, PreparedOrder(BuildOrder(FINGER, name=name)), present)
        assert found.image.blocks == {
            (0, 1): b"own", (0, 12): b"name" if name else b"own", (1, 3): b"new", (1, 12): b"fixed",
            (2, 5): b"added", (3, 3): b"own",
        }  # fmt: skip
        assert (found.named, found.warnings, found.profile_digest) == (True, ("w",), None)


def test_a_node_keeps_the_number_that_it_has_though_another_one_has_it_too(station: Station) -> None:
    other, third = bytes(9) + b"\1", bytes(9) + b"\2"
    for uuid, name in ((UUID, "hand 1"), (other, "hand 1"), (third, "hand x")):
        station.nodes.remember(uuid, name=name)
    assert [step._numbered(station, uuid, "hand {n}") for uuid in (UUID, other, third)] == [
        "hand 1",
        "hand 1",
        "hand 2",
    ]
    station.nodes.remember(other, name="hand 7")
    assert step._numbered(station, other, "hand {n}") == "hand 7"
    assert step._numbered(station, other, "{n} hand") == "1 hand"


def test_what_an_order_names_is_read_within_bounds_and_records_nothing(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    profile, given = load_profile(FINGER), list[Any]()
    large = tmp_path / "large.pem"
    large.write_bytes(bytes((1 << 20) + 1))
    with pytest.raises(BadDataError, match="1048576 octets, which is too large for a cert"):
        step._from_file(replace(order(tmp_path), trusted=(large,)), profile)
    for missing in (tmp_path, tmp_path / "nowhere.csv"):
        with pytest.raises(NotFoundError) as refused:
            prepare(station, BuildOrder(FINGER, calibration=missing), UUID)
        assert refused.value.message == f"There is no calibration file {missing}."
    monkeypatch.setattr(step, "guard", lambda *words, **how: (given.append((words[2:4], how)), ("guarded",))[1])
    assert prepare(station, order(tmp_path, channel=1, accept_calibration="a reason"), UUID).warnings == ("guarded",)
    assert given == [((None, "a reason"), {"record": False})]
