"""What a person can do about an error of the protocol or of a trace: each hint that another test does not read."""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import TedsProvisionError
from teds_provision.protocol import session
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.bundle import check_times, from_json
from teds_provision.protocol.keys import SoftwareKey, fingerprint, other_key
from teds_provision.protocol.operation.subscription import require_new_run
from teds_provision.trace.recorder import read_trace
from tests.protocol.handover_parts import NOW, bundle

KEY, OTHER = SoftwareKey(77), SoftwareKey(78)


def raised(error: Exception) -> Callable[[], object]:
    def call() -> object:
        raise error

    return call


def padding() -> object:
    opened = session.StationSession(bytes(16), bytes(10))
    opened._keys, opened._counter = cast("Any", SimpleNamespace(to_station=bytes(16))), 1
    return opened.unseal(session._seal_padded(bytes(16), 1, bytes(16)))


def trace() -> object:
    return list(read_trace(Path(__file__)))


@pytest.mark.parametrize(
    ("call", "message", "hint"),
    [
        (lambda: from_json(bytearray(b'{"format":"teds-handover/9","nodes":[]}')), "The bundle's format is not ",
         "A newer teds-provision may read it."),
        (lambda: check_times(bundle(created=NOW, expires=NOW + timedelta(days=1)), NOW - timedelta(days=9)),
         "The bundle was made in the future (", "Compare both stations' clocks."),
        (lambda: check_times(bundle(created=NOW, expires=NOW + timedelta(days=1)), NOW + timedelta(days=1)),
         "The bundle expired at ", "Ask the sender to export it again."),
        (lambda: jose.verify_compact(jose.sign_compact(b"{}", KEY, typ="x"), lambda kid: None, typ="x", max_octets=999),
         f"The key '{fingerprint(KEY.point)[:16]}' that signed this is not trusted here.",
         "Compare the fingerprint with its owner by voice, then: teds-provision trust add NAME FILE."),
        (lambda: jose.decrypt(jose.encrypt(b"{}", [KEY.point], cty="x"), OTHER, cty="x", max_octets=4096),
         f"This was not sealed for this station ({fingerprint(OTHER.point)[:16]}).",
         "Ask the sender to export it for this station; teds-provision show FILE names the recipients."),
        (raised(other_key("ab" * 32, KEY.point)),
         f"This UUID is known with key {'ab' * 8}, the node shows {fingerprint(KEY.point)[:16]}.",
         "It may be a clone. If the board was replaced on purpose: whitelist remove UUID, then whitelist add UUID."),
        (lambda: require_new_run(3, 3), "The node names run 3 after run 3.",
         "Its firmware does not keep to the profile."),
        (lambda: require_new_run(0, 0), "The node names run 0; runs begin at 1.",
         "Its firmware does not keep to the profile."),
        (padding, "The padding of a sealed reply is wrong; its tag is right.",
         "The node's firmware is at fault, not its key: PKCS #7 adds 1 to 16 octets, a whole block where"
         " the reply is a multiple of 16. Run: teds-provision node check"),
        (trace, "is not a trace.", "Supported: files written by --trace, or pcapng with CAN frames."),
    ],
)  # fmt: skip
def test_an_error_says_what_to_do(call: Callable[[], object], message: str, hint: str) -> None:
    with pytest.raises(TedsProvisionError) as no:
        call()
    assert message in no.value.message
    assert no.value.hint == hint
