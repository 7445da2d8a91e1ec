"""Bundles and receipts that were written once must open for ever (tests/vectors/handover).

Run this file as a program to write a new set, for a new format: ``python -m tests.protocol.test_bundle_vectors``. It
never overwrites one: what was once handed over is not changed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from teds_provision.protocol.handover.bundle import open_bundle, peek_bundle, seal_bundle
from teds_provision.protocol.handover.receipt import open_receipt, seal_receipt
from teds_provision.protocol.handover.revocation import open_revocation, seal_revocation
from teds_provision.protocol.keys import fingerprint
from tests.protocol.handover_parts import NOW, RECEIVER, SENDER, THIRD, bundle, node, trusts
from tests.protocol.test_bundle_receipt import receipt

FOLDER = Path(__file__).parent.parent / "vectors" / "handover"
BARE = node(2, profile=None, name="Größe 2", groups=(), teds_sha256=None)


def made():
    """The bundle of the vectors, without its deny list (an ECDSA signature is made anew in other versions)."""
    return replace(bundle(2, to=(RECEIVER, THIRD)), nodes=(node(1), BARE))


def test_the_bundle_of_version_1_opens():
    octets = (FOLDER / "bundle-1.json").read_bytes()
    for receiver in (RECEIVER, THIRD):
        found = open_bundle(octets, receiver, trusts(SENDER), NOW)
        assert replace(found.bundle, revoked=()) == made()
        assert [revocation.why for revocation in found.revocations] == ["lost"]
    assert peek_bundle(octets).recipients == (fingerprint(RECEIVER.point), fingerprint(THIRD.point))


def test_the_receipt_and_the_revocation_of_version_1_open():
    assert open_receipt((FOLDER / "receipt-1.jws").read_bytes(), trusts(RECEIVER)) == receipt()
    text = (FOLDER / "revocation-1.jws").read_text()
    assert open_revocation(text, trusts(SENDER)).uuid == bytes(10)


if __name__ == "__main__":
    denied = seal_revocation(SENDER, uuid=bytes(10), node=None, why="lost", created=NOW)
    whole = replace(made(), revoked=(denied.statement,))
    for name, octets in {
        "bundle-1.json": seal_bundle(whole, SENDER, [RECEIVER.point, THIRD.point]),
        "receipt-1.jws": seal_receipt(receipt(), RECEIVER),
        "revocation-1.jws": denied.statement.encode(),
    }.items():
        with (FOLDER / name).open("xb") as file:
            file.write(octets)
