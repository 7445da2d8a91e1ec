"""``node check`` finds each faulty node of the table by the rule that is meant, with words that name the fault."""

from __future__ import annotations

import pytest

from teds_provision.check.rule import RULES
from teds_provision.check.run import CheckReport
from teds_provision.station.station import Station

from .faults import FAULTS, FaultyNode
from .nodes import checked, failed

OF_FRAMES = {"can-flow-control", "can-form", "nfc-wait-time", "nfc-wtx", "identify-found"}
"""Rules that hear frames, which a link in memory has none of: ``test_link_rules`` finds faults by them."""


def run(station: Station, patch: pytest.MonkeyPatch, faulty: FaultyNode) -> CheckReport:
    if faulty.bend is not None:
        faulty.bend(patch)
    return checked(station, patch, over=faulty.over, fault=faulty.fault, **faulty.link)


@pytest.mark.parametrize("name", FAULTS)
def test_a_faulty_node_is_found_by_its_rule(station: Station, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    fault = FAULTS[name]
    report = run(station, monkeypatch, fault)
    found = failed(report)
    assert fault.rule in found, (found, [result for result in report.checks if result.result == "skipped"])
    assert fault.words in found[fault.rule].detail
    assert found[fault.rule].slip == fault.slip
    if "*" not in fault.also:
        assert set(found) <= {fault.rule, *fault.also}, {rule: check.detail for rule, check in found.items()}


def test_the_table_leaves_out_only_rules_that_another_fault_breaks_first() -> None:
    found, every = {faulty.rule for faulty in FAULTS.values()}, {rule.name for rule in RULES}
    assert len(FAULTS) >= 40
    assert found <= every
    assert every - found == OF_FRAMES | SISTERS


SISTERS = {
    "identify", "close-needs-session", "operation-needs-session", "never-held", "query-length", "read-absent",
    "security-state", "factory-open", "confirm-without-request", "keyed-reset", "sealed-tag", "sealed-only-sealed",
    "sealed-command-residues", "repetition-two", "address-back", "write-checks", "update-checks", "commit-form",
    "commit-digests", "about-in-session", "locate-in-session",
}  # fmt: skip
"""Rules whose fault is that of a rule in the table, looked at from another side."""
