"""From tap to verified datasheet: done once, repeated, interrupted anywhere, cut anywhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import (
    LinkError,
    NodeRefusedError,
    NodeSilentError,
    NotAuthenticError,
    NotWhitelistedError,
    PolicyError,
    StoreError,
    TedsProvisionError,
)
from teds_provision.protocol.messages.frames import Command, Function, Reason, Reply, TedsFunction
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning import provision as provision_module
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.board_type import HardwareCheck, WrongBoardError
from teds_provision.provisioning.build import BuildOrder, PreparedOrder
from teds_provision.provisioning.calibration_guard import merged
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.provisioning.identify import IdentifiedNode
from teds_provision.provisioning.progress import SilentReporter, StepResult
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.provisioning.write import write
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord
from teds_provision.teds.codec import security
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.profile import load_profile
from tests.answers import Answers
from tests.bench import Board, MemoryLink, copied_station, make_station, talk

ANGLE = BuildOrder(profile="magnetic-angular-position-sensor")


def accept(who: IdentifiedNode) -> None:
    """Whoever lies on the reader."""


def run(
    station: Station,
    board: Board,
    link: MemoryLink | None = None,
    order: BuildOrder = ANGLE,
    accept: Callable[[IdentifiedNode], None] = accept,
) -> ProvisionResult:
    with talk(board, link) as node:
        return provision(station, node, order, operator=Answers(accept=accept), reporter=SilentReporter())


def results(done: ProvisionResult) -> dict[str, str]:
    return {step.name: step.result for step in done.steps}


def test_a_new_node_ends_authentic(station: Station, board: Board) -> None:
    done = run(station, board)
    assert done.verified.verdict == "authentic"
    assert list(results(done)) == ["identify", "whitelist", "agree", "build", "sign", "write", "verify", "check"]
    assert set(results(done).values()) == {"done", "skipped"}, "this board does not measure: nobody asks its hardware"
    assert board.state.state == NodeState.PROVISIONED
    record = station.nodes.get(board.uuid)
    assert record is not None
    assert (record.sequence, record.epoch) == (1, 1)


def test_a_finished_node_has_nothing_to_do(station: Station, board: Board) -> None:
    run(station, board)
    before = board.state
    again = run(station, board)
    expected = {"identify": "done", "verify": "done", "check": "skipped"}
    assert results(again) == {name: expected.get(name, "nothing to do") for name in results(again)}
    assert board.state == before


def test_a_small_node_takes_its_datasheet_in_many_segments(station: Station) -> None:
    board = Board(max_message=1024)
    link = MemoryLink(board)
    assert run(station, board, link).verified.verdict == "authentic"
    assert max(map(len, link.frames)) <= 1024


def test_without_a_yes_an_unknown_node_is_left_alone(station: Station, board: Board) -> None:
    def no(who: IdentifiedNode) -> None:
        raise NotWhitelistedError("no")

    with pytest.raises(NotWhitelistedError):
        run(station, board, accept=no)
    assert board.state.state == NodeState.FACTORY
    assert station.pins.whitelist() == []


def test_over_the_bus_of_a_node_without_nfc(station: Station, board: Board) -> None:
    assert run(station, board, MemoryLink(board, via="can", tapped=True)).verified.verdict == "authentic"
    entry = station.pins.entry(board.uuid)
    assert entry is not None
    assert entry.assurance == "bus"


def test_an_identified_node_may_be_written_over_the_other_link(station: Station, board: Board) -> None:
    run(station, board)
    renamed = replace(ANGLE, name="crane slew")
    done = run(station, board, MemoryLink(board, via="can", tapped=False), renamed)
    assert (results(done)["agree"], results(done)["write"]) == ("nothing to do", "done")
    assert board.state.sequence == 2


@pytest.mark.parametrize("lost", [True, False], ids=["a TEDS is gone", "a TEDS is another one"])
def test_a_board_whose_teds_are_not_those_of_its_signature_gets_a_newer_sequence(
    station: Station, board: Board, lost: bool
) -> None:
    """Its Security TEDS is the signed one still; it takes the same content only under a newer sequence."""
    first = run(station, board)
    blocks = dict(board.state.blocks)
    place = next(place for place in blocks if place[1] == 3)
    if lost:
        del blocks[place]
    else:
        blocks[place] = blocks[place][:-2] + b"xx"
    board.flash.state = replace(board.state, blocks=blocks)
    board.power_on()
    again = run(station, board, order=BuildOrder(profile="magnetic-angular-position-sensor"))
    assert again.verified.verdict == "authentic"
    assert again.image.unsigned_blocks() == first.image.unsigned_blocks()
    assert board.state.sequence == 2


def exchanges_of_a_whole_run(tmp_path: Path) -> int:
    link = MemoryLink(Board())
    run(copied_station(tmp_path / "count"), link.board, link)
    return link.count - 1  # the last one closes the session


@pytest.mark.parametrize("half", ["lose_request", "lose_reply"])
def test_cut_at_every_message_the_same_command_carries_on(tmp_path: Path, half: str) -> None:
    for lost in range(1, exchanges_of_a_whole_run(tmp_path) + 1):
        station, board = copied_station(tmp_path / f"{half}{lost}"), Board()
        with pytest.raises(NodeSilentError):
            run(station, board, MemoryLink(board, **{half: lost}))  # type: ignore[arg-type]
        assert run(station, board).verified.verdict == "authentic", f"{half} {lost}"
        assert [record.state for record in station.keys.keys_of(board.uuid)] == ["active"]
        station.close()


@pytest.mark.parametrize("when", ["die_before", "die_after"])
@pytest.mark.parametrize("commit", [1, 2])
def test_power_cut_at_every_flash_commit(station: Station, board: Board, when: str, commit: int) -> None:
    if commit == 2:  # the first is the key, the second the datasheet
        run(station, board, accept=accept)
        board.flash.state = replace(board.flash.state, provisioned=False)
        board.power_on()
    setattr(board.flash, when, True)
    with pytest.raises(NodeSilentError):
        run(station, board, order=replace(ANGLE, name="another") if commit == 2 else ANGLE)
    assert run(station, board).verified.verdict == "authentic"


def test_a_session_lost_in_the_middle_starts_the_staging_over(station: Station, board: Board) -> None:
    class ForgetfulLink(MemoryLink):
        def exchange(self, frame: bytes) -> bytes:
            if self.count == 14:
                board.tim.link_lost(self.via)
            return super().exchange(frame)

    assert run(station, board, ForgetfulLink(board)).verified.verdict == "authentic"


def test_a_node_that_is_always_busy_ends_with_the_link(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("teds_provision.provisioning.conversation.BUSY_SECONDS", 0.3)
    monkeypatch.setattr("teds_provision.provisioning.conversation.BUSY_PAUSE", 0.05)
    busy = bytes([0, 0, 1, Reason.BUSY])
    with pytest.raises(TedsProvisionError):
        run(station, board, MemoryLink(board, tamper=lambda n, reply: busy))
    assert run(station, board).verified.verdict == "authentic"


@pytest.mark.parametrize("garbage", [b"", b"\x01", b"\x01\x00\x05abc", b"\x01\x00\x00", bytes(400)])
def test_garbage_is_an_error_of_ours_and_changes_nothing(station: Station, board: Board, garbage: bytes) -> None:
    def garbage_from(count: int) -> Callable[[int, bytes], bytes]:
        return lambda n, reply: garbage if n >= count else reply

    for count in range(1, 12):
        with pytest.raises(TedsProvisionError):
            run(station, board, MemoryLink(board, tamper=garbage_from(count)))
    assert run(station, board).verified.verdict == "authentic"


def test_read_only_teds_are_signed_as_they_are(station: Station, board: Board) -> None:
    phy = frame(bytes.fromhex("0304050d01010a01010b0400000001"))
    board.flash.state = replace(board.state, blocks={(0, 13): phy}, read_only=frozenset({(0, 13)}))
    board.power_on()
    assert run(station, board).verified.verdict == "authentic"
    assert (0, 13) in security.decode(board.state.blocks[SECURITY]).signed_blocks


def test_a_sequence_far_behind_is_caught_up_in_steps_once_a_person_says_so(station: Station, board: Board) -> None:
    run(station, board)
    station.nodes.remember(board.uuid, sequence=200_000)
    with pytest.raises(PolicyError, match="far ahead"):
        run(station, board, order=replace(ANGLE, name="far ahead"))
    draft = station.datasheets.draft(board.uuid)
    assert draft is not None
    with talk(board) as node:
        require_session(station, node)
        write(station, node, draft.image, jump=True)
    assert board.state.sequence == 200_001
    assert station.datasheets.draft(board.uuid) is None


def test_a_node_reset_by_hand_is_provisioned_again(station: Station, board: Board) -> None:
    run(station, board)
    board.tim.reset_by_hand()
    done = run(station, board)
    assert done.verified.verdict == "authentic"
    assert (board.state.epoch, board.state.sequence) == (2, 2)


def test_a_revoked_node_is_refused(station: Station, board: Board) -> None:
    from teds_provision.station.store.records import RevocationRecord

    run(station, board)
    station.policy.deny(RevocationRecord(board.uuid, None, "stolen", ""))
    with pytest.raises(PolicyError, match="stolen"):
        run(station, board)


def _must_not_be_asked(question: str, _refusal: PolicyError) -> None:
    raise AssertionError(question)


def test_another_owners_station_is_refused(station: Station, board: Board, tmp_path: Path) -> None:
    run(station, board)
    before, stranger = board.state, make_station(tmp_path / "stranger")
    with pytest.raises(PolicyError, match="belongs to another owner's CA"):
        run(stranger, board)
    with talk(board) as node, pytest.raises(PolicyError, match="belongs to another owner's CA"):
        provision(stranger, node, ANGLE, operator=Answers(take_over=_must_not_be_asked), reporter=SilentReporter())
    assert stranger.pins.entry(board.uuid) is None
    assert board.state == before


def test_a_broken_flash_is_reported(station: Station, board: Board) -> None:
    board.flash.fail = True
    with pytest.raises(NodeRefusedError) as refused:
        run(station, board)
    assert refused.value.reason == Reason.FLASH_FAILURE


def test_a_read_back_that_differs_is_not_believed(station: Station, board: Board) -> None:
    run(station, board)
    commit = board.flash.commit

    def corrupting(state):  # type: ignore[no-untyped-def]
        commit(state)
        state.blocks[0, 12] = state.blocks[0, 12][:-3] + b"\0" + state.blocks[0, 12][-2:]

    board.flash.commit = corrupting  # type: ignore[method-assign]
    with pytest.raises(NotAuthenticError, match="reads back differently"):
        run(station, board, order=replace(ANGLE, name="renamed"))


def test_the_link_error_is_a_link_error() -> None:
    assert issubclass(NodeSilentError, LinkError)


@pytest.mark.parametrize("orders", ["no such profile", "no profile", "broken calibration", "no calibration file"])
def test_a_wrong_order_changes_nothing(station: Station, board: Board, tmp_path: Path, orders: str) -> None:
    broken = tmp_path / "angle.csv"
    broken.write_text("raw,value\n1,one\n")
    order = {
        "no such profile": replace(ANGLE, profile="no-such-sensor"),
        "no profile": BuildOrder(),
        "broken calibration": replace(ANGLE, calibration=broken),
        "no calibration file": replace(ANGLE, calibration=tmp_path / "none.csv"),
    }[orders]
    with pytest.raises(TedsProvisionError) as wrong:
        run(station, board, order=order)
    assert wrong.value.exit_code in (2, 3, 8)
    assert board.state.state == NodeState.FACTORY
    assert station.pins.entry(board.uuid) is None


def test_a_run_writes_as_little_as_its_promises_need(station: Station, board: Board) -> None:
    """At most 8 durable commits for a whole provisioning; an idle one writes at most 4 rows and commits twice."""
    statements: list[str] = []
    changes, rows = ("INSERT", "UPDATE", "DELETE", "REPLACE"), set[str]()

    def note_statement(statement: str) -> None:  # the trace repeats a statement that returns rows
        if not (statements and statements[-1] == statement):
            statements.append(statement)

    def commits() -> int:
        made, dirty = 0, False
        for statement in statements:
            dirty = dirty or statement.startswith(changes)
            if statement.startswith("COMMIT"):
                made, dirty = made + dirty, False
        return made

    station._store._connection.set_trace_callback(note_statement)
    run(station, board)
    assert 0 < commits() <= 8
    statements.clear()
    run(station, board, order=BuildOrder())
    rows = {statement for statement in statements if statement.startswith(changes)}
    assert commits() <= 2
    assert 0 < len(rows) <= 4, rows


def test_nothing_is_read_twice_that_says_nothing_new(station: Station, board: Board) -> None:
    """Identify is asked once in the session; the Security TEDS is read once before it and once after the commit.

    Of a node that was read in a session before, it is read in the session alone.
    """
    asked: list[tuple[int, int, bytes]] = []
    handle = board.tim._dispatch

    def counted(command: Command, origin: Any) -> Reply:
        asked.append((command.command_class, command.function, command.payload[:1]))
        return handle(command, origin)

    board.tim._dispatch = counted  # type: ignore[method-assign]
    assert run(station, board).verified.verdict == "authentic"
    assert asked.count((128, Function.IDENTIFY, b"")) == 1, asked
    assert asked.count((1, TedsFunction.READ, bytes([128]))) == 2, asked
    asked.clear()
    run(station, board, order=BuildOrder())
    assert asked.count((128, Function.IDENTIFY, b"")) == 1, asked
    assert asked.count((1, TedsFunction.READ, bytes([128]))) == 1, asked


def test_what_is_reported_of_several_channels_is_one_sentence() -> None:
    messages = [f"Channel {number} has no calibration: raw values cannot be turned into N." for number in (1, 2, 3)]
    assert merged(messages) == ("Channels 1 to 3 have no calibration: raw values cannot be turned into N.",)
    assert merged(messages[::2]) == ("Channels 1, 3 have no calibration: raw values cannot be turned into N.",)
    assert merged([*messages[:2], "another", messages[0], "another"]) == (
        "Channels 1 to 2 have no calibration: raw values cannot be turned into N.", "another",
    )  # fmt: skip


@dataclass
class OneUnit:
    """Mock line that assigns one unit and keeps the reports about it."""

    prepared: PreparedOrder
    course: list[Any] = field(default_factory=list)

    def order(self, who: IdentifiedNode) -> PreparedOrder:
        self.course.append("order")
        return self.prepared

    def allot_unit(self, _node: Any, who: IdentifiedNode, prepared: PreparedOrder, taken: None) -> Any:
        assert (prepared, taken) == (self.prepared, None)
        self.course.append("allot")
        return self

    def ended(self, _node: Any, done: ProvisionResult) -> None:
        self.course.append(done)

    def failed(self, _node: Any, who: IdentifiedNode, steps: list[Any], step: str, error: TedsProvisionError) -> None:
        self.course.append((who.uuid, [one.name for one in steps], step, error))


@pytest.mark.parametrize(
    ("verdict", "sealed", "profile", "measures", "found", "failure"),
    [
        ("authentic", True, True, True, ["done", "done", "done"], None),
        ("authentic", True, True, False, ["done", "done", "skipped"], None),
        ("authentic", False, True, True, ["done", "done", "skipped"], None),
        ("not authentic", True, True, True, ["done", "failed", "skipped"], None),
        ("authentic", True, False, True, ["done", "done", "done"], None),
        ("authentic", True, True, True, ["identify"], "another type"),
        ("authentic", True, True, True, ["identify", "verify"], "lost"),
    ],
)
def test_a_board_that_is_only_verified_is_judged_checked_and_reported_to_its_line(
    station: Station,
    board: Board,
    monkeypatch: pytest.MonkeyPatch,
    verdict: str,
    sealed: bool,
    profile: bool,
    measures: bool,
    found: list[str],
    failure: str | None,
) -> None:
    gripper, image = load_profile("gripper"), Image(board.uuid, {})
    line = OneUnit(PreparedOrder(BuildOrder(), gripper if profile else None))
    cause = NodeSilentError("It is silent.")
    verified: Any = SimpleNamespace(verdict=verdict)
    borne = HardwareCheck({1: True} if measures else {}, ({"channel": 1},), ("It is low.",))

    def firmware(_node: Any) -> str:
        if failure == "lost":
            raise SessionLostError(cause)
        return "firmware"

    module = provision_module
    monkeypatch.setattr(module, "verify_at_node", lambda *_: SimpleNamespace(verified=verified, image=image))
    monkeypatch.setattr(module, "differences", lambda *_: ("in N",) if failure == "another type" else ())
    monkeypatch.setattr(module, "read_firmware", firmware)
    monkeypatch.setattr(module, "check_hardware", lambda _node, _image: borne)
    locked: list[Any] = []

    @contextmanager
    def lock(_own: Station, uuid: bytes, what: str = "") -> Iterator[Any]:
        locked.append((uuid, what))
        yield

    monkeypatch.setattr(type(station), "node_lock", lock)
    station.released = lambda uuid, what: lock(station, uuid, what)
    with talk(board) as node:
        monkeypatch.setattr(type(node), "sealed", property(lambda _node: sealed))
        if failure is not None:
            error = WrongBoardError if failure == "another type" else SessionLostError
            with pytest.raises(error):
                module.verify_only(station, node, cast(Any, line), SilentReporter())
        else:
            done = module.verify_only(station, node, cast(Any, line), SilentReporter())
    assert locked == [(board.uuid, ""), (board.uuid, "provision")]
    *before, last = line.course
    assert before == ["order", "allot"]
    if failure is None:
        hardware = borne if verdict == "authentic" and sealed else HardwareCheck({})
        assert [(step.name, step.result) for step in done.steps] == list(
            zip(["identify", "verify", "check"], found, strict=True)
        )
        assert done.steps[0].detail == f"{board.uuid.hex()}, key {done.who.fingerprint[:16]}"
        assert (last, done.image, done.verified, done.firmware) == (done, image, verified, "firmware")
        assert (done.warnings, done.samples) == (hardware.warnings, hardware.samples)
        return
    step = "verify" if failure == "another type" else "check"
    assert last[:3] == (board.uuid, found, step)
    assert last[3] is cause if failure == "lost" else isinstance(last[3], WrongBoardError)
    logged = [entry for entry in station.audit_log.entries() if entry.act == "provision"]
    if failure == "another type":
        [entry] = logged
        assert (entry.uuid, entry.outcome, entry.detail["step"]) == (board.uuid, "wrong-board", "verify")
        assert entry.detail["why"] == last[3].message


# -- the order of the steps, without a board ---------------------------------------------------------------------------


def a_run(station: Station, *, line: Any = None, onward: Any = None, operator: Any = None) -> Any:
    """Return a run with a node that is no more than a name."""
    node: Any = SimpleNamespace(uuid=bytes(10), leave=lambda: None)
    accepting = operator or Answers(accept=accept)
    return provision_module._Run(station, node, BuildOrder(), accepting, SilentReporter(), line=line, onward=onward)


@pytest.mark.parametrize(
    ("state", "with_line", "typed", "demanded", "recalled", "begins"),
    [
        (NodeState.FACTORY, False, True, False, False, ["its board"]),
        (NodeState.PROVISIONED, False, True, False, False, []),
        (NodeState.PROVISIONED, True, True, False, False, ["its board"]),
        (NodeState.FACTORY, False, False, False, True, []),
        (NodeState.PROVISIONED, False, True, True, True, ["firmware plain"]),
        (NodeState.FACTORY, True, True, True, False, ["its board", "firmware plain"]),
    ],
)
def test_what_is_looked_at_before_a_board_is_keyed_and_what_a_run_returns(
    station: Station,
    monkeypatch: pytest.MonkeyPatch,
    state: NodeState,
    with_line: bool,
    typed: bool,
    demanded: bool,
    recalled: bool,
    begins: list[str],
) -> None:
    course: list[Any] = []
    fitted: Any = {"fitted": None}
    prepared = PreparedOrder(BuildOrder(), load_profile("gripper") if typed else None, fitted)
    of_unit = replace(prepared, warnings=("of the unit",))
    unit: Any = SimpleNamespace(prepared=of_unit)
    line = SimpleNamespace(allot_unit=lambda *_: (course.append("unit"), unit)[1]) if with_line else None
    run = a_run(station, line=line, onward=lambda _node: course.append("onward"))
    who: Any = SimpleNamespace(uuid=bytes(10), state=state, recalled=recalled, security_teds=b"shown")
    present = SimpleNamespace(image=SimpleNamespace(blocks={"old": 1}))
    proposal = SimpleNamespace(warnings=("proposed",), image="new", calibrations="calibrations")
    borne = HardwareCheck({1: True}, ({"channel": 1},), ("hardware",))
    module = provision_module
    readings = iter(["plain", "sealed"] if demanded else ["sealed"])
    demand: Any = "demand" if demanded else None
    monkeypatch.setattr(module, "shown_by", lambda _node, numbers: sorted(numbers))
    monkeypatch.setattr(module, "differences", lambda shown, _type, calibrated: (*map(str, shown), *calibrated))
    monkeypatch.setattr(module, "read_firmware", lambda _node: next(readings))
    monkeypatch.setattr(
        module, "require_firmware", lambda _uuid, wanted, found: course.append(f"firmware {found}" if wanted else "any")
    )
    monkeypatch.setattr(module, "take_snapshot", lambda _node, *, initial: (course.append(initial), present)[1])
    monkeypatch.setattr(module, "further", lambda has, _image: (f"further {list(has)}",))
    monkeypatch.setattr(module, "certificate_brought", lambda calibrations: f"of {calibrations}")
    run._prepared = lambda _who: prepared
    run._firmware_demand = lambda *_: demand
    run._require_its_board = lambda _who, _prepared, changes: (
        course.append("its board") if changes == ("1", "2", "3", "fitted") else course.append(changes)
    )
    run._whitelist = lambda _who: (course.append("whitelist"), "entry")[1]
    run._agree = lambda _who, entry: course.append(f"agree {entry}")
    run._build = lambda _who, order, _present: (course.append(("build", order.warnings)), proposal)[1]
    run._sign = lambda *_: "signed"
    run._write = lambda signed, *_: SimpleNamespace(on_node=f"{signed} and written")
    run._verify = lambda _who, written: f"verified {written.on_node}"
    run._check = lambda order, *_: (course.append(("check", order.warnings)), borne)[1]
    done = run.run(who)
    order = ("of the unit",) if with_line else ()
    assert course == [
        *begins,
        "whitelist",
        *(["unit"] if with_line else []),
        "agree entry",
        "onward",
        "firmware sealed" if demanded else "any",
        None if recalled else b"shown",
        ("build", order),
        ("check", order),
    ]
    assert done.warnings == ("proposed", "further ['old']", "hardware")
    assert (done.image, done.verified) == ("signed and written", "verified signed and written")
    assert (done.samples, done.certificate, done.firmware) == (({"channel": 1},), "of calibrations", "sealed")


@pytest.mark.parametrize(
    ("changes", "retype", "remembered", "asked"),
    [
        ((), False, False, 0),
        (("in N",), True, False, 0),
        (("in N",), False, True, 0),
        (("in N",), False, False, 1),
    ],
)
def test_a_board_of_another_type_is_asked_about_once(
    station: Station,
    monkeypatch: pytest.MonkeyPatch,
    changes: tuple[str, ...],
    retype: bool,
    remembered: bool,
    asked: int,
) -> None:
    questions: list[Any] = []
    operator: Any = SimpleNamespace(retype=lambda uuid, differences: questions.append((uuid, differences)))
    states: list[bool] = []

    def known(_station: Station, _uuid: bytes, wanted: str | None, *, factory: bool) -> bool:
        assert wanted == "gripper"
        states.append(factory)
        return remembered

    monkeypatch.setattr(provision_module, "is_remembered", known)
    run = a_run(station, operator=operator)
    prepared = PreparedOrder(BuildOrder(profile="gripper", retype=retype))
    for state in (NodeState.FACTORY, NodeState.PROVISIONED):
        run._require_its_board(SimpleNamespace(uuid=bytes(10), state=state), prepared, changes)
    assert questions == [(bytes(10), changes)] * asked
    assert states == ([True] if asked else [True, False] if remembered else [])


def test_the_firmware_of_a_board_is_that_which_its_new_or_known_type_demands(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, who = a_run(station), cast(Any, SimpleNamespace(uuid=bytes(10)))
    monkeypatch.setattr(
        provision_module, "FirmwareDemands", lambda _home: SimpleNamespace(demand_of=lambda profile: f"of {profile}")
    )
    typed: Any = SimpleNamespace(profile=SimpleNamespace(firmware="of the new type"))
    assert run._firmware_demand(who, typed) == "of the new type"
    untyped = PreparedOrder(BuildOrder())
    assert run._firmware_demand(who, untyped) == "of None"
    with station.transaction():
        station.nodes.put(NodeRecord(bytes(10), profile="gripper"))
    assert run._firmware_demand(who, untyped) == "of gripper"


@pytest.mark.parametrize("outcome", ["good", "refused", "lost"])
@pytest.mark.parametrize("with_unit", [True, False])
def test_a_unit_gets_the_proof_or_the_cause_and_only_a_good_run_leaves_the_node(
    station: Station, outcome: str, with_unit: bool
) -> None:
    course: list[Any] = []
    cause = NodeSilentError("It is silent.")
    errors = {"refused": PolicyError("No."), "lost": SessionLostError(cause), "good": None}
    run = a_run(station)
    who: Any = SimpleNamespace(uuid=bytes(10))
    run.node.leave = lambda: course.append("leave")
    run.unit = SimpleNamespace(
        ended=lambda _node, done: course.append(done),
        failed=lambda _node, one, _done, step, error: course.append((one, step, error)),
    ) if with_unit else None  # fmt: skip

    def work(_who: Any) -> str:
        if (error := errors[outcome]) is not None:
            raise error
        return "done"

    run._identify, run.run = lambda: who, work
    if outcome == "good":
        assert run.proven() == "done"
        assert course == [*(["done"] if with_unit else []), "leave"]
        return
    with pytest.raises((PolicyError, SessionLostError)):
        run.proven()
    reason = cause if outcome == "lost" else errors["refused"]
    assert course == ([(who, run.steps.current, reason)] if with_unit else [])


@pytest.mark.parametrize("full", [False, True])
def test_a_failure_is_in_the_log_with_its_step_unless_the_disk_is_full(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch, full: bool
) -> None:
    seen: list[bool] = []

    @contextmanager
    def released(_uuid: bytes, what: str) -> Iterator[str]:
        assert what == "provision"
        yield "let go"

    def proven(run: Any) -> Any:
        seen.append(run.released)
        run.steps.current = "sign"
        raise PolicyError("It may not.")

    def audit(*_: Any, **__: Any) -> None:
        raise StoreError("The disk is full.")

    station.released = released
    monkeypatch.setattr(provision_module._Run, "proven", proven)
    if full:
        monkeypatch.setattr(type(station), "audit", audit)
    with pytest.raises(PolicyError, match="It may not"):
        run(station, board)
    assert seen == [True]
    if not full:
        [entry] = [entry for entry in station.audit_log.entries() if entry.act == "provision"]
        assert (entry.outcome, entry.detail) == ("refused", {"step": "sign", "why": "It may not."})


@pytest.mark.parametrize("with_line", [False, True])
def test_a_line_hears_of_a_board_what_it_sent_now_and_who_it_is(
    station: Station, monkeypatch: pytest.MonkeyPatch, with_line: bool
) -> None:
    who: Any = SimpleNamespace(uuid=bytes(10), fingerprint="ab" * 32)
    asked: list[Any] = []
    monkeypatch.setattr(
        provision_module,
        "identify",
        lambda _station, _node, *, expect, recall: (asked.append((expect, recall)), who)[1],
    )
    run = a_run(station, line=SimpleNamespace() if with_line else None)
    assert run._identify() is who
    assert asked == [(run._choose, not with_line)], "the evidence of a line recalls nothing"
    [step] = run.steps.done
    assert (step.name, step.result, step.detail) == ("identify", "done", f"{bytes(10).hex()}, key abababababababab")


CELL = PreparedOrder(BuildOrder(), load_profile("gripper"))


@pytest.mark.parametrize(
    ("order", "state", "known", "prepared_for", "found"),
    [
        (BuildOrder(profile="gripper"), NodeState.FACTORY, None, ["gripper"], CELL),
        (CELL, NodeState.FACTORY, None, [], CELL),
        (PreparedOrder(BuildOrder(calibration=Path("a.csv"))), NodeState.PROVISIONED, None, [None], CELL),
        (PreparedOrder(BuildOrder()), NodeState.PROVISIONED, None, [], PreparedOrder(BuildOrder())),
        (PreparedOrder(BuildOrder()), NodeState.FACTORY, "gripper", [], PreparedOrder(BuildOrder())),
        (PreparedOrder(BuildOrder(adopt=True)), NodeState.FACTORY, None, [], PreparedOrder(BuildOrder(adopt=True))),
        (PreparedOrder(BuildOrder()), NodeState.FACTORY, None, [], None),
        (PreparedOrder(BuildOrder()), NodeState.KEYED, "", [], None),
    ],
)
def test_an_order_is_prepared_for_its_very_board_once_and_a_new_board_needs_a_type(
    station: Station,
    monkeypatch: pytest.MonkeyPatch,
    order: Any,
    state: NodeState,
    known: str | None,
    prepared_for: list[str | None],
    found: PreparedOrder | None,
) -> None:
    asked, named = list[Any](), list[Any]()

    def prepare(_station: Station, one: BuildOrder, uuid: bytes) -> PreparedOrder:
        asked.append(one.profile)
        return CELL

    def named_for(_station: Station, uuid: bytes, one: PreparedOrder, *, keep: bool) -> PreparedOrder:
        named.append((uuid, keep))
        return one

    monkeypatch.setattr(provision_module, "prepare", prepare)
    monkeypatch.setattr(provision_module, "named_for", named_for)
    if known is not None:
        with station.transaction():
            station.nodes.put(NodeRecord(bytes(10), profile=known or None))
    run = a_run(station)
    run.order = order
    who: Any = SimpleNamespace(uuid=bytes(10), state=state)
    if found is None:
        with pytest.raises(TedsProvisionError, match=bytes(10).hex()):
            run._prepared(who)
        return
    assert run._prepared(who) == found
    assert (asked, named) == (prepared_for, [(bytes(10), True)])


@pytest.mark.parametrize(
    ("listed", "named", "course"),
    [(True, False, []), (False, False, ["own CA", "entry", "accept"]), (False, True, ["own CA", "entry"])],
)
def test_a_stranger_is_accepted_by_a_person_or_by_its_sheet_if_it_has_no_other_owner(
    station: Station, monkeypatch: pytest.MonkeyPatch, listed: bool, named: bool, course: list[str]
) -> None:
    did: list[str] = []
    who: Any = SimpleNamespace(
        uuid=bytes(10), whitelisted="entry" if listed else None, state=NodeState.KEYED, security_teds=b"shown"
    )
    given: list[Any] = []
    monkeypatch.setattr(provision_module, "require_own_ca", lambda *words: (did.append("own CA"), given.append(words)))
    monkeypatch.setattr(provision_module, "new_whitelist_entry", lambda *_: (did.append("entry"), "new entry")[1])
    run = a_run(station, operator=SimpleNamespace(accept=lambda _who: did.append("accept")))
    run.named = lambda _who: named
    assert run._whitelist(who) == (None if listed else "new entry")
    assert did == course
    assert given == ([] if listed else [(station, bytes(10), NodeState.KEYED, b"shown")])
    done = [(step.name, step.result) for step in run.steps.done]
    assert done == ([("whitelist", "nothing to do")] if listed else []), "it is done once the entry is kept"


@pytest.mark.parametrize(("fresh", "listed", "pinned", "whole"), [(True, True, False, True), (False, False, True, True),
                                                                  (True, False, False, False)])  # fmt: skip
def test_a_newcomer_is_reported_as_whitelisted_once_its_entry_is_kept(
    station: Station, monkeypatch: pytest.MonkeyPatch, fresh: bool, listed: bool, pinned: bool, whole: bool
) -> None:
    who: Any = SimpleNamespace(uuid=bytes(10))
    agreed = SimpleNamespace(epoch=3, key_id="0123", fresh=fresh, listed=listed)
    given: list[Any] = []
    monkeypatch.setattr(provision_module, "agree", lambda *words, **how: (given.append(how), agreed)[1])
    monkeypatch.setattr(type(station.pins), "entry", lambda *_: object() if pinned else None)
    run = a_run(station)
    run._enlisting = StepResult("whitelist")
    assert run._agree(who, "entry") is agreed
    assert given == [{"newcomer": "entry", "take_over": run.operator.take_over}]
    *before, step = run.steps.done
    assert [one.name for one in before] == (["whitelist"] if whole else [])
    assert (step.name, step.result) == ("agree", "done" if fresh else "nothing to do")
    assert step.detail == "key epoch 3, key 0123"
