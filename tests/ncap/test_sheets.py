"""Datasheets for the API, without nodes: which one is given, and what is shown after one was written."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from teds_provision.errors import BadDataError, NotFoundError, UsageError
from teds_provision.ncap.nodes import sheets
from teds_provision.ncap.nodes.sheets import Sheets, curves, parsed, within_a_turn
from teds_provision.shapes.verdict import NodeVerdict, Verification
from teds_provision.teds.channel import TURN
from teds_provision.teds.image import Image

NODE = "ab" * 10
KEPT, HELD, READ = (Image(bytes.fromhex(NODE), {(0, code): b"teds"}) for code in (1, 2, 3))


class Desk:
    """A directory, a store with one datasheet, and a node that is on a bus or not."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.course: list[Any] = []
        self.kept: Image | None = KEPT
        self.held: Image | None = None
        self.on_bus = False
        judged = NodeVerdict(Verification(bytes(10), ()), "session", "2026-11-25T10:00:00Z", "ncap")
        monkeypatch.setattr(sheets, "verdict_of", lambda _station, _uuid: judged if self.kept is not None else None)
        monkeypatch.setattr(sheets, "read_anew", lambda _station, _node: (READ, judged))
        station = SimpleNamespace(datasheets=SimpleNamespace(datasheet=lambda _uuid: self.kept))
        directory = SimpleNamespace(
            refresh=lambda uuids: self.course.append(("refreshed", *uuids)),
            show_sheet=lambda uuid, sheet: self.course.append(("shown", uuid, sheet)),
            note=lambda uuid, state, **facts: self.course.append((state, uuid, facts)),
        )
        jobs = SimpleNamespace(on_a_bus=lambda _uuid: self.on_bus, with_node=self.with_node)
        words: Any = (station, directory, jobs, lambda _uuid: self.held)
        self.sheets = Sheets(*words)

    def with_node(self, _uuid: str, what: str, work: Callable[[Any], Any]) -> Any:
        self.course.append(what)
        return work(SimpleNamespace(uuid=bytes.fromhex(NODE)))


@pytest.fixture
def desk(monkeypatch: pytest.MonkeyPatch) -> Desk:
    return Desk(monkeypatch)


def test_a_measured_nodes_datasheet_is_that_of_its_session_one_on_a_bus_is_read_and_any_other_is_kept(
    desk: Desk,
) -> None:
    found = desk.sheets.read(NODE)
    assert (found.image, found.now, desk.course) == (KEPT, False, [])
    desk.on_bus = True
    found = desk.sheets.read(NODE)
    assert (found.image, found.now) == (READ, True)
    assert desk.course == ["its datasheet is read", ("refreshed", NODE)]
    desk.held = HELD
    found = desk.sheets.read(NODE)
    assert (found.image, found.now, len(desk.course)) == (HELD, True, 2), "what is measured is not read beside it"
    desk.held, desk.on_bus, desk.kept = None, False, None
    with pytest.raises(NotFoundError, match="never been read"):
        desk.sheets.read(NODE)


@pytest.mark.parametrize(("keyed", "why"), [(True, "it opens no session under our key"), (False, "")])
def test_a_node_that_opens_no_session_is_read_and_judged_by_what_it_sends_plainly(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, keyed: bool, why: str
) -> None:
    identified, checked = list[bytes](), list[tuple[str, str]]()

    def check(*words: str) -> str:
        checked.append(words)  # type: ignore[arg-type]
        return "session"

    desk.on_bus = True
    monkeypatch.setattr(sheets, "read_anew", lambda _station, _node: None)
    monkeypatch.setattr(sheets, "identify", lambda _station, node: identified.append(node.uuid))
    monkeypatch.setattr(sheets, "read_image", lambda _node: READ)
    monkeypatch.setattr(sheets, "is_keyed", lambda _station, _uuid: keyed)
    monkeypatch.setattr(sheets, "freshness_floor_of", lambda _station, _uuid, identity: ("floor", identity))
    monkeypatch.setattr(sheets, "verify_image", lambda _station, image, floor: (image, floor))
    monkeypatch.setattr(sheets, "session_check", check)
    found = desk.sheets.read(NODE)
    assert identified == [bytes.fromhex(NODE)], "it proves its key, which is held against the pin"
    assert (found.image, found.now, found.judged.origin, found.judged.by) == (READ, True, "plain", "ncap")
    assert found.judged.verified.checks == (READ, ("floor", None), "session")
    assert checked == [("", why)]


def test_what_the_guard_says_of_a_datasheet_is_shown_as_a_warning_or_if_it_refuses_as_an_error(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def guard(_station: Any, image: Image, *_words: Any, record: bool) -> list[str]:
        assert not record
        if image is HELD:
            raise BadDataError("It falls.", hint="Turn it round.")
        return ["It is old."]

    monkeypatch.setattr(sheets, "guard", guard)
    assert desk.sheets._guarded(KEPT) == [{"severity": "warning", "message": "It is old.", "hint": ""}]
    assert desk.sheets._guarded(HELD) == [{"severity": "error", "message": "It falls.", "hint": "Turn it round."}]


def test_a_plan_has_each_change_and_the_tag_of_the_datasheet_that_it_would_change(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    facts = {"channel": 1, "access_code": 3, "field": "UpLimit", "before": "1", "after": "2", "text": "1 -> 2"}
    plan = SimpleNamespace(
        changes=[SimpleNamespace(**facts)], warnings=["It is wide."], present=SimpleNamespace(image=READ)
    )
    asked: list[Any] = []

    def planned(_station: Any, _node: Any, blocks: Any, **words: Any) -> Any:
        asked.append((blocks, words))
        return plan

    monkeypatch.setattr(sheets, "plan_sheet", planned)
    monkeypatch.setattr(sheets, "parsed", lambda content: {"parsed": content})
    words = {"accept": "new cell", "retype": True, "expected": frozenset({"aa"})}
    assert desk.sheets.plan(NODE, "<teds/>", **cast(Any, words)) == (
        {
            "uuid": NODE, "dry_run": True, "changes": [facts], "steps": [], "verdict": None,
            "guard": [{"severity": "warning", "message": "It is wide.", "hint": ""}],
        },
        READ.digest(),
    )  # fmt: skip
    given = {"accept_calibration": "new cell", "retype": True, "expected": frozenset({"aa"})}
    assert asked == [({"parsed": "<teds/>"}, given)]
    assert desk.course == ["a datasheet is compared"], "nothing is shown anew"


def test_after_a_write_the_new_datasheet_is_shown_and_the_problem_is_over(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The channels that were read before, of a node that was not stored then, would be shown until the next look."""
    step = SimpleNamespace(name="write", result="done", seconds=0.1, detail="")
    plan = SimpleNamespace(changes=[], warnings=["w"])
    done = SimpleNamespace(steps=[step], plan=plan, verified=SimpleNamespace(verdict="authentic"))
    words: dict[str, Any] = {}

    def write_sheet(_station: Any, _node: Any, blocks: Any, _reporter: Any, **more: Any) -> Any:
        words.update(more, blocks=blocks)
        return done

    monkeypatch.setattr(sheets, "write_sheet", write_sheet)
    monkeypatch.setattr(sheets, "parsed", lambda content: {"parsed": content})

    class Lock:
        def __enter__(self) -> None:
            desk.course.append("node locked")

        def __exit__(self, *_: object) -> None:
            desk.course.append("node free")

    cast(Any, desk.sheets._station).node_lock = lambda _uuid: Lock()
    shown = desk.sheets.write(NODE, "<teds/>", accept="new cell", retype=True, expected=frozenset({"aa"}))
    assert words == {
        "blocks": {"parsed": "<teds/>"}, "accept_calibration": "new cell", "retype": True, "expected": {"aa"},
    }  # fmt: skip
    assert (shown["uuid"], shown["dry_run"], shown["verdict"], shown["guard"][0]["message"]) == (
        NODE, False, "authentic", "w",
    )  # fmt: skip
    assert desk.course == [
        "a datasheet is written", "node locked", "node free", ("shown", NODE, None), ("refreshed", NODE),
        ("written", NODE, {"verdict": "authentic", "problem": None}),
    ]  # fmt: skip


def test_a_document_is_in_a_known_format_and_not_empty(desk: Desk) -> None:
    with pytest.raises(UsageError, match="Unsupported datasheet format: 'pdf'"):
        desk.sheets.document(NODE, "pdf")
    with pytest.raises(BadDataError, match="empty"):
        parsed(" \n")


def test_a_curve_is_drawn_to_its_last_point(monkeypatch: pytest.MonkeyPatch) -> None:
    unit = SimpleNamespace(text="mm", from_si=lambda value: 1000 * value)
    channel = SimpleNamespace(calibration=object(), actuator=False, name="opening", unit=unit)
    calibration = SimpleNamespace(inputs=[1])
    sheet = SimpleNamespace(calibrations={7: calibration}, channel=lambda _number: channel)
    monkeypatch.setattr(sheets, "Sheet", SimpleNamespace(from_blocks=lambda _blocks: sheet))
    monkeypatch.setattr(sheets, "is_finite", lambda _calibration: True)
    raws = np.arange(1000.0)
    result = np.where(raws == 5.0, math.nan, raws / 1000)
    own = SimpleNamespace(full_turn=False, low=0.0, high=1.0)
    guard = SimpleNamespace(
        channel_of=lambda *_words: own, curve_of=lambda *_words: SimpleNamespace(axes=[raws], result=result)
    )
    monkeypatch.setattr(sheets, "curves_of_guard", guard)
    [curve] = curves({})
    points = curve["points"]
    assert (curve["channel"], curve["y_unit"]) == (7, "mm")
    assert (points[0], points[1], points[-1]) == ([0.0, 0.0], [10.0, 10.0], [999.0, 999.0]), "5 has no value"
    assert len(points) == 200
    calibration.inputs = [1, 2]
    assert curves({}) == [], "of two inputs"
    calibration.inputs, channel.calibration = [1], None
    assert curves({}) == [], "the channel gives it without one"
    channel.calibration, channel.actuator = object(), True
    assert curves({}) == [], "of an actuator"
    channel.actuator, sheet.channel = False, lambda _number: None
    assert curves({}) == [], "of no channel"
    sheet.channel = lambda _number: channel
    assert len(curves({})) == 1
    monkeypatch.setattr(sheets, "is_finite", lambda _calibration: False)
    assert curves({}) == []


def test_a_line_over_an_end_of_the_turn_goes_on_at_the_other_whichever_way_and_however_far() -> None:
    up = within_a_turn([(0.0, 6.0), (10.0, 6.0 + TURN)], 0.0)
    assert up[0] == (0.0, 6.0)
    assert [y for _, y in up[1:4]] == [pytest.approx(TURN), None, pytest.approx(0.0)]
    assert up[-1] == pytest.approx((10.0, 6.0))
    down = within_a_turn([(0.0, 1.0), (10.0, -1.0)], 0.0)
    assert [y for _, y in down[1:4]] == [pytest.approx(0.0), None, pytest.approx(TURN)]
    assert down[1][0] == pytest.approx(5.0)
    twice = within_a_turn([(0.0, 1.0), (1.0, 1.0 + 2 * TURN)], 0.0)
    assert [y for _, y in twice].count(None) == 2
    assert within_a_turn([(0.0, 1.0), (1.0, 1.0 + 1000 * TURN)], 0.0) == [(0.0, 1.0), (1.0, pytest.approx(1.0))]
