"""Every reason of the contract has its words: a refusal that nobody can read helps nobody."""

from __future__ import annotations

from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.messages.tables import REASONS
from teds_provision.provisioning.conversation import refused


def test_every_reason_has_words() -> None:
    for reason in Reason:
        error = refused(reason, "to do it")
        assert f"(reason {int(reason)})" in error.message
        assert reason in REASONS
    assert "without a known reason (99)" in refused(99, "to do it").message
