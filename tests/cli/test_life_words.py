"""``decommission`` and ``replace`` of nodes that are not there, refuse, or answer: what is recorded and printed."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision import provisioning
from teds_provision.cli.node import life
from teds_provision.errors import FrozenError, NodeRefusedError, NoNodeError, PolicyError
from teds_provision.protocol.messages.frames import Reason
from teds_provision.provisioning.agree import ResetReceipt
from teds_provision.station.measurements import HandedOn
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord
from tests.bench import PASSPHRASE
from tests.cli.shell import call

OLD, SPARE = "8d4d9da65281f70000aa", "8d4d9da65281f70000bb"
OR_FORCE = ", or add --force to record it as unconfirmed."
RECEIPT = ResetReceipt(3, bytes(range(32)), bytes(range(64)))


@pytest.fixture
def two(home: Path) -> Path:
    """Return the home of a station that knows a node, elbow, and a whitelisted spare."""
    call(home, "whitelist", "add", SPARE)
    with Station.open(home, ask=lambda _prompt, _confirm: PASSPHRASE) as station, station.transaction():
        station.nodes.put(NodeRecord(bytes.fromhex(OLD), name="elbow", profile="load-cell"))
    return home


def record(home: Path, uuid: str = OLD) -> NodeRecord:
    with Station.inspect(home) as station:
        found = station.nodes.get(bytes.fromhex(uuid))
    assert found is not None
    return found


@pytest.fixture
def meeting(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what becomes of the next reset: an error, or the receipt of the node; ``met`` counts the meetings."""
    fate: Any = SimpleNamespace(error=None, met=[])

    @contextmanager
    def meet(_station: Any, _links: Any, uuid: bytes, _reporter: Any) -> Any:
        fate.met.append(uuid.hex())
        if fate.error is not None:
            raise fate.error
        yield SimpleNamespace()

    monkeypatch.setattr(provisioning.meeting, "meet", meet)
    monkeypatch.setattr(provisioning.sign, "require_not_measured", lambda *_, **__: None)
    monkeypatch.setattr(provisioning.identify, "identify", lambda *_: None)
    monkeypatch.setattr(provisioning.agree, "reset_node", lambda *_: RECEIPT)
    return fate


@pytest.mark.parametrize(
    ("error", "hint"),
    [
        (NoNodeError("No node.", hint="Check it."), f"Bring the node within reach{OR_FORCE}"),
        (PolicyError("No key.", hint="Agree one."), f"Agree one{OR_FORCE}"),
        (PolicyError("No key."), "Add --force: unconfirmed."),
    ],
)  # fmt: skip
def test_a_node_that_cannot_be_reset_is_out_of_service_unconfirmed_with_force_alone(
    two: Path, meeting: Any, error: Any, hint: str
) -> None:
    meeting.error = error
    refused = call(two, "--json", "decommission", OLD, "--yes")
    assert (refused.code, refused.json["error"]["hint"]) == (error.exit_code, hint)
    assert record(two).retired is None
    done = call(two, "--json", "decommission", OLD, "--yes", "--force")
    assert (done.code, done.json["confirmed"], done.json["proof"], done.json["fresh"]) == (0, False, None, True)
    assert record(two).retired == "decommissioned, unconfirmed"
    meeting.error = None
    later = call(two, "decommission", OLD, "--yes")
    assert later.out == f"Node {OLD} is out of service and signed that it is in factory state.\n"
    again = call(two, "--json", "decommission", OLD, "--yes")
    assert (again.json["confirmed"], again.json["fresh"], len(meeting.met)) == (True, False, 3), "nothing is met again"


@pytest.mark.parametrize("error", [FrozenError("It is measured."), NodeRefusedError("Busy.", reason=Reason.BUSY)])
@pytest.mark.parametrize("force", [True, False])
def test_a_node_that_answers_and_is_busy_is_not_recorded_as_unconfirmed(
    two: Path, meeting: Any, error: Any, force: bool
) -> None:
    meeting.error = error
    refused = call(two, "--json", "decommission", OLD, "--yes", *(["--force"] if force else []))
    assert (refused.code, refused.json["error"]["message"]) == (error.exit_code, error.message)
    assert record(two).retired is None


@pytest.mark.parametrize(
    ("words", "error", "met", "confirmed"),
    [
        ((), None, 0, False),
        (("--can", "udp_multicast:239.74.163.2"), None, 1, True),
        (("--nfc", "udp:localhost:1"), None, 1, True),
        (("--via", "can"), None, 1, True),
        (("--nfc", "udp:localhost:1"), NoNodeError("No node."), 1, False),  # and nobody is asked
    ],
)
def test_a_replaced_node_is_reset_if_a_link_is_named_and_it_can_be_reached(
    two: Path, meeting: Any, words: tuple[str, ...], error: Any, met: int, confirmed: bool
) -> None:
    meeting.error = error
    done = call(two, "--json", "replace", OLD, SPARE, "--yes", *words)
    assert (done.code, done.json["confirmed"], meeting.met) == (0, confirmed, [OLD] * met)
    assert (done.json["name"], done.json["profile"], done.json["calibration_copied"]) == ("elbow", "load-cell", False)
    assert record(two).retired == f"replaced by {SPARE}" + ("" if confirmed else ", unconfirmed")
    assert (record(two, SPARE).name, record(two, SPARE).profile) == ("elbow", "load-cell")


def test_what_was_handed_on_is_listed() -> None:
    assert life._handed_on(HandedOn(), "Moved") == ""
    moved = HandedOn(("crane", "hand"), ("force",), ("a", "b"), ("c", "d"), ("One stays.", "Two stay."))
    assert life._handed_on(moved, "Removed from").splitlines() == [
        "", "Removed from groups: crane, hand", "Removed from topic names: force", "Removed from measurements: a, b",
        "Measurements that had no other node were deleted: c, d", "Not moved: One stays.", "Not moved: Two stay.",
    ]  # fmt: skip


@pytest.mark.parametrize("words", [[], ["--lift", "--why", "stolen"]])
def test_a_ban_is_issued_or_lifted(two: Path, words: list[str]) -> None:
    done = call(two, "--json", "revoke", OLD, *words)
    message = "Use --why TEXT to revoke, or --lift alone to lift a ban. (see: teds-provision revoke --help)"
    assert (done.code, done.json["error"]["message"]) == (2, message)


def test_what_a_takeover_drops_is_named_before_the_question_and_what_else_came_up_after_it(
    two: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert call(two, "build", SPARE, "--profile", "gripper").code == 0
    dropped, take_over = (
        f"The draft of node {SPARE} (built as gripper) was never written; it is dropped.",
        life.take_over,
    )
    planned = call(two, "--json", "replace", OLD, SPARE, "--dry-run")
    assert (planned.err, planned.json["warnings"], planned.json["plan"]) == (f"Warning: {dropped}\n", [dropped], True)
    monkeypatch.setattr(life, "take_over", lambda *given: ((dropped, "It has no key."), take_over(*given)[1]))
    done = call(two, "--json", "replace", OLD, SPARE, "--yes")
    assert (done.code, done.json["warnings"]) == (0, [dropped, "It has no key."])
    assert done.err == f"Warning: {dropped}\nWarning: It has no key.\n"
