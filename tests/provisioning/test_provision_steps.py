"""The steps of ``provision`` from the datasheet on, each by its clauses, without a board."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import NotWhitelistedError, PolicyError
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning import provision as module
from teds_provision.provisioning.adoption import FactoryDatasheet, NotAdoptedError
from teds_provision.provisioning.board_type import HardwareCheck
from teds_provision.provisioning.build import BuildOrder, PreparedOrder
from teds_provision.provisioning.calibration_guard import guard
from teds_provision.provisioning.operator import AcceptingOperator, Operator
from teds_provision.provisioning.progress import StepResult, Steps
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft
from teds_provision.teds import guard as guarding
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.profile import load_profile

from .test_provision import a_run

UUID = bytes(10)
WHO: Any = SimpleNamespace(uuid=UUID, point=b"point", key_signature=b"signature")
IMAGE = Image(UUID, {(0, 12): b"name", (0, 1): b"meta"})


def last(run: Any) -> tuple[str, str, str]:
    step: StepResult = run.steps.done[-1]
    return step.name, step.result, step.detail


def test_a_step_is_reported_when_it_begins_and_when_it_ended_well() -> None:
    course: list[Any] = []
    reporter: Any = SimpleNamespace(started=course.append, finished=course.append)
    steps = Steps(reporter)
    with steps.step("sign") as first:
        first.detail = "sequence 3"
        assert (steps.current, course) == ("sign", ["sign"])
    with pytest.raises(PolicyError), steps.step("write"):
        raise PolicyError("It is refused.")
    assert (steps.current, steps.done) == ("write", [first]), "the one that failed"
    with steps.deferred("agree") as later:
        pass
    assert course == ["sign", first, "write", "agree"]
    steps.finish(later)
    assert (course[-1], steps.done) == (later, [first, later])


@pytest.mark.parametrize(
    ("typed", "adopt", "state", "changes", "profile", "result", "detail", "course"),
    [
        (True, False, NodeState.KEYED, True, "gripper", "done", "gripper, 2 TEDS; fits", ["type", "propose", "image"]),
        (True, False, NodeState.FACTORY, True, None, "done", "2 TEDS; fits", ["type", "propose", "image"]),
        (False, False, NodeState.KEYED, True, None, "done", "2 TEDS; fits", ["propose", "image"]),
        (False, False, NodeState.PROVISIONED, False, None, "nothing to do", "2 TEDS; fits", ["propose", "image"]),
        (False, True, NodeState.KEYED, True, None, "done", "2 TEDS; fits", ["adopt", "image"]),
        (False, True, NodeState.PROVISIONED, True, None, "done", "2 TEDS; fits", ["propose", "image"]),
    ],
)
def test_a_datasheet_is_proposed_or_adopted_and_held_against_the_board(
    station: Station,
    monkeypatch: pytest.MonkeyPatch,
    typed: bool,
    adopt: bool,
    state: NodeState,
    changes: bool,
    profile: str | None,
    result: str,
    detail: str,
    course: list[str],
) -> None:
    did: list[Any] = []
    confirm = object()
    run = a_run(station, operator=SimpleNamespace(confirm=confirm))
    fitted: Any = {1: "fitted"} if state is NodeState.KEYED else None
    prepared = PreparedOrder(BuildOrder(adopt=adopt), load_profile("gripper") if typed else None, fitted)
    present: Any = SimpleNamespace(image=SimpleNamespace(blocks={}), identity=SimpleNamespace(state=state))
    proposal: Any = SimpleNamespace(
        image=IMAGE, changes=("one",) if changes else (), calibrations={1: "c"}, profile=profile,
        require_a_yes=lambda ask: did.append(ask is confirm),
    )  # fmt: skip

    def differences(_has: object, wanted: object, *calibrated: object) -> tuple[str, ...]:
        assert calibrated == (() if wanted is IMAGE else (fitted or (),))
        return ("image",) if wanted is IMAGE else ("type",)

    monkeypatch.setattr(module, "differences", differences)
    monkeypatch.setattr(module, "propose", lambda *_: (did.append("propose"), proposal)[1])
    monkeypatch.setattr(module, "sentence", lambda _calibration: "fits")
    run._adopted = lambda *_: (did.append("adopt"), proposal)[1]
    run._require_its_board = lambda _who, _prepared, found: did.append(found[0])
    assert run._build(WHO, prepared, present) is proposal
    assert did == [*course, True]
    assert last(run) == ("build", result, detail)


@pytest.mark.parametrize(("errors", "reason", "course"), [((), None, ["adopt"]), (("overdue",), "known", ["adopt"]),
                                                           (("overdue",), None, None)])  # fmt: skip
def test_what_a_board_brought_is_adopted_after_the_question_and_with_errors_for_a_reason(
    station: Station,
    monkeypatch: pytest.MonkeyPatch,
    errors: tuple[str, ...],
    reason: str | None,
    course: list[str] | None,
) -> None:
    did: list[str] = []
    brought = FactoryDatasheet(IMAGE, "finger", (), errors, ("old",))
    monkeypatch.setattr(
        module, "read_factory_datasheet", lambda _station, _image, *, name: (did.append(name), brought)[1]
    )
    run = a_run(station, operator=SimpleNamespace(adopt=lambda _brought: did.append("adopt")))
    prepared = PreparedOrder(BuildOrder(name="mine", accept_calibration=reason))
    present: Any = SimpleNamespace(image=IMAGE)
    if course is None:
        with pytest.raises(NotAdoptedError, match="is refused: overdue"):
            run._adopted(prepared, present)
        assert did == ["mine"], "nobody is asked about what is refused"
        return
    proposal = run._adopted(prepared, present)
    assert did == ["mine", *course]
    assert (proposal.image, proposal.changes, proposal.named, proposal.warnings, proposal.name) == (
        IMAGE, (), True, ("old",), "finger",
    )  # fmt: skip
    entries = {entry.act: entry for entry in station.audit_log.entries()}
    assert (entries["adopt"].outcome, entries["adopt"].detail) == (
        "accepted", {"teds": IMAGE.digest(), "name": "finger"},
    )  # fmt: skip
    accepted = {"why": "known", "findings": ["overdue"]} if errors else None
    assert (entries["accept-datasheet"].detail if "accept-datasheet" in entries else None) == accepted


@pytest.mark.parametrize("reused", [False, True])
@pytest.mark.parametrize(
    ("office", "stage", "intact", "state", "on_node", "earlier"),
    [
        (True, None, True, NodeState.KEYED, None, ()),
        (False, "signed", True, NodeState.PROVISIONED, b"on node", (b"drafted",)),
        (False, "built", True, NodeState.PROVISIONED, b"on node", ()),
        (False, None, True, NodeState.PROVISIONED, b"on node", ()),
        (False, None, False, NodeState.PROVISIONED, None, ()),
        (False, None, True, NodeState.KEYED, None, ()),
    ],
)
def test_a_datasheet_is_signed_by_the_office_or_here_unless_a_signature_still_holds(
    station: Station,
    monkeypatch: pytest.MonkeyPatch,
    office: bool,
    stage: Any,
    intact: bool,
    state: NodeState,
    on_node: bytes | None,
    earlier: tuple[bytes, ...],
    reused: bool,
) -> None:
    given: dict[str, Any] = {}
    signed = SimpleNamespace(sequence=7, reused=reused)
    run = a_run(station)
    run.unit = SimpleNamespace(sign=lambda *_: signed if office else None)
    run.released = True
    if stage is not None:
        station.datasheets.keep_draft(Draft(UUID, Image(UUID, {SECURITY: b"drafted"}), stage, None))
    proposal: Any = SimpleNamespace(image=IMAGE, profile="gripper")
    has = Image(UUID, {**(IMAGE.blocks if intact else {}), SECURITY: b"on node"})
    present: Any = SimpleNamespace(image=has, identity=SimpleNamespace(state=state, epoch=3, sequence=6))
    measured: list[Any] = []

    def sign(_station: Station, keys: Any, image: Image, **how: Any) -> Any:
        assert (keys.uuid, keys.key, keys.signature, image) == (UUID, b"point", b"signature", IMAGE)
        how.pop("before")()
        given.update(how)
        return signed

    monkeypatch.setattr(module, "sign", sign)
    monkeypatch.setattr(module, "require_not_measured", lambda *_, released: measured.append(released))
    assert run._sign(WHO, proposal, present) is signed
    result = "nothing to do" if reused else "done"
    assert last(run) == ("sign", result, "sequence 7, by the office" if office else "sequence 7")
    assert measured == ([] if office else [True])
    assert given == ({} if office else {
        "epoch": 3, "node_sequence": 6, "on_node": on_node, "earlier": earlier, "keep_draft": True,
        "profile": "gripper", "write_follows": True,
    })  # fmt: skip


@pytest.mark.parametrize(("octets", "result", "detail"), [(70, "done", "70 octets"), (0, "nothing to do", "")])
def test_what_is_written_goes_with_its_facts_and_its_progress(
    station: Station, monkeypatch: pytest.MonkeyPatch, octets: int, result: str, detail: str
) -> None:
    low = object()
    run = a_run(station, operator=SimpleNamespace(low_battery=low))
    given: list[Any] = []
    written = SimpleNamespace(octets=octets)
    monkeypatch.setattr(module, "write", lambda *words, **how: (given.append((words[2:], how)), written)[1])
    proposal: Any = SimpleNamespace(profile="gripper", name=None, profile_digest="ab")
    assert run._write(SimpleNamespace(image=IMAGE), proposal, "present") is written
    facts = {"profile": "gripper", "profile_digest": "ab"}
    how = {"present": "present", "progress": run.reporter.written, "facts": facts, "low": low}
    assert given == [((IMAGE,), how)]
    assert last(run) == ("write", result, detail)


@pytest.mark.parametrize("of_line", [False, True])
@pytest.mark.parametrize(("verdict", "result"), [("authentic", "done"), ("not authentic", "failed")])
def test_a_verdict_is_that_of_what_is_on_the_node(
    station: Station, monkeypatch: pytest.MonkeyPatch, verdict: str, result: str, of_line: bool
) -> None:
    run = a_run(station)
    run.unit = object() if of_line else None
    given: list[Any] = []
    judged = SimpleNamespace(verified=SimpleNamespace(verdict=verdict))
    monkeypatch.setattr(module, "judge_and_keep", lambda *words, **how: (given.append((words[2:], how)), judged)[1])
    assert run._verify(WHO, SimpleNamespace(on_node="on node")) is judged.verified
    assert given == [(("on node", b"point"), {"by": "provision", "more_follows": of_line})]
    assert last(run) == ("verify", result, verdict)


@pytest.mark.parametrize(
    ("verdict", "typed", "channels", "result", "detail"),
    [
        ("authentic", True, {1: True, 2: False, 3: None}, "done", "1 of 3 channels match the hardware"),
        ("authentic", False, {1: True}, "done", "1 of 1 channels match the hardware"),
        ("authentic", True, {1: None}, "skipped", "it does not measure"),
        ("not authentic", True, {1: True}, "skipped", ""),
    ],
)
def test_hardware_is_asked_about_an_authentic_datasheet_in_the_units_of_its_type(
    station: Station,
    monkeypatch: pytest.MonkeyPatch,
    verdict: str,
    typed: bool,
    channels: dict[int, bool | None],
    result: str,
    detail: str,
) -> None:
    run, asked = a_run(station), list[Any]()
    borne = HardwareCheck(channels)
    monkeypatch.setattr(module, "check_hardware", lambda _node, image, units: (asked.append((image, units)), borne)[1])
    monkeypatch.setattr(module, "shown_units", lambda *_: "units of the store")
    monkeypatch.setattr(module, "units_of", lambda _channels: "units of the type")
    prepared = PreparedOrder(BuildOrder(), load_profile("gripper") if typed else None)
    verified: Any = SimpleNamespace(verdict=verdict)
    found = run._check(prepared, cast(Any, SimpleNamespace(on_node="on node")), verified)
    units = "units of the type" if typed else "units of the store"
    assert (found, asked) == ((borne, [("on node", units)]) if verdict == "authentic" else (HardwareCheck({}), []))
    assert last(run) == ("check", result, detail)


@pytest.mark.parametrize(
    ("typed", "known", "demand"),
    [("a profile", "other", "its own"), ("a profile without", "other", None), (None, "other", "of other"),
     (None, None, "of None")],
)  # fmt: skip
def test_what_a_type_demands_of_the_firmware_is_that_of_the_ordered_one_else_of_the_nodes(
    station: Station, monkeypatch: pytest.MonkeyPatch, typed: str | None, known: str | None, demand: str | None
) -> None:
    run = a_run(station)
    if known is not None:
        station.nodes.remember(UUID, profile=known)
    profile = None if typed is None else SimpleNamespace(firmware="its own" if typed == "a profile" else None)
    demands = SimpleNamespace(demand_of=lambda name: f"of {name}")
    monkeypatch.setattr(module, "FirmwareDemands", lambda _home: demands)
    assert run._firmware_demand(WHO, SimpleNamespace(profile=profile)) == demand


@pytest.mark.parametrize(
    ("errors", "expected", "message"),
    [
        (1, (), "The calibration is refused: channel 1: it is harmful."),
        (3, ("harmful",), "The calibration is refused: channel 1: it is harmful (and 2 more)."),
    ],
)
def test_a_calibration_with_errors_needs_a_reason_and_its_errors_are_always_named(
    station: Station, monkeypatch: pytest.MonkeyPatch, errors: int, expected: tuple[str, ...], message: str
) -> None:
    def finding(channel: int, severity: str) -> Any:
        code = "harmful" if severity == "error" else "overdue"
        return SimpleNamespace(channel=channel, severity=severity, code=code, message=f"it is {code}.".rstrip("."))

    found = [finding(number + 1, "error") for number in range(errors)] + [finding(9, "warning")]
    monkeypatch.setattr(guarding, "check_calibration", lambda *_, **__: found)
    image = Image(UUID, {(1, 5): b"calibration"})
    with pytest.raises(PolicyError) as refused:
        guard(station, image, None, None, expected=expected)
    assert (refused.value.message, "--accept-calibration" in refused.value.hint) == (message, True)
    warned = guard(station, image, None, "a reason", expected=(*expected, "overdue"))
    numbers = ["Channel 1: it is harmful"] if errors == 1 else ["Channels 1 to 3: it is harmful"]
    assert [text.lower() for text in warned] == [text.lower() for text in numbers]
    (line,) = [entry for entry in station.audit_log.entries() if entry.act == "accept-calibration"]
    assert line.detail["why"] == "a reason"
    assert len(line.detail["findings"]) == errors
    guard(station, image, None, "a reason", record=False)
    assert len([entry for entry in station.audit_log.entries() if entry.act == "accept-calibration"]) == 1


def test_without_a_person_everything_that_needs_a_word_is_refused_with_what_to_do() -> None:
    nobody, refusal = Operator(), PolicyError("It has another station's key.")
    who: Any = SimpleNamespace(uuid=UUID, fingerprint="ab" * 32)
    for ask, error, message, hint in (
        (lambda: nobody.accept(who), NotWhitelistedError, f"Node {UUID.hex()} is not on the whitelist.",
         f"teds-provision whitelist add {UUID.hex()} --fingerprint {'ab' * 32}"),
        (lambda: nobody.take_over("Take it over?", refusal), PolicyError, refusal.message, refusal.hint),
        (lambda: nobody.jump("Write it?"), PolicyError, "This needs confirmation, but no person can be asked.",
         "Write it?"),
        (lambda: AcceptingOperator().jump("Write it?"), PolicyError,
         "This needs confirmation, but no person can be asked.", "Write it?"),
    ):  # fmt: skip
        with pytest.raises(error) as refused:
            ask()
        assert (refused.value.message, refused.value.hint) == (message, hint)
    for ask in (lambda: nobody.low_battery("Write it?"), lambda: AcceptingOperator().low_battery("Write it?")):
        with pytest.raises(PolicyError):
            ask()
    AcceptingOperator().accept(who)
