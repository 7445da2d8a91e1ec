"""Provisioning on a bus that loses frames (issue 7, row R7); the whole figures are in docs/hardware.md."""

from __future__ import annotations

import sys

import pytest

from .desk import ANGLE, Desk, Station

pytestmark = pytest.mark.link
LOSSY = (sys.executable, "-m", "tests.links.can.lossy")


def test_a_node_is_provisioned_if_one_frame_in_a_hundred_is_lost(desk: Desk, station: Station) -> None:
    """Nine of ten first tries succeed: here one node, and a second try where it is the tenth."""
    node = desk.node()
    node.start(nfc=False, can=True)
    bus = desk.links.can.replace("udp_multicast:", "lossy:", 1) + "&loss=0.01&seed="
    verdicts = []
    for seed in (1, 2):
        words = ["--json", "provision", "--yes", "--profile", ANGLE, "--via", "can", "--can", f"{bus}{seed}"]
        outcome = station.start(*words, program=LOSSY).end(80)
        verdicts.append(outcome.json.get("verdict"))
        if verdicts[-1] == "authentic":
            break
    assert verdicts[-1] == "authentic", outcome
