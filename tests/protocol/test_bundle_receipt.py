"""Receipts and revocations: signed statements between stations."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from teds_provision.errors import BadDataError, NotAuthenticError
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.receipt import Receipt, RefusedNode, open_receipt, seal_receipt
from teds_provision.protocol.handover.revocation import open_revocation, seal_revocation
from teds_provision.protocol.handover.strict_json import decode_base64url, dump, load_object
from teds_provision.protocol.keys import fingerprint
from tests.protocol.handover_parts import NODE_KEY, NOW, RECEIVER, SENDER, STRANGER, trusts


def receipt(**changes) -> Receipt:
    made = Receipt(
        id="3d1a4d1c-52c4-4d0b-9d3c-0c8f4bd5a7f1",
        bundle_sha256="cd" * 32,
        sender=fingerprint(RECEIVER.point),
        to=fingerprint(SENDER.point),
        imported=(bytes(10), b"\1" * 10),
        refused=(RefusedNode(b"\2" * 10, "its key differs from the known one"),),
        created=NOW,
    )
    return replace(made, **changes)


def test_a_receipt_comes_out_as_it_went_in_and_an_editor_may_end_its_line():
    octets = seal_receipt(receipt(), RECEIVER)
    assert open_receipt(octets, trusts(RECEIVER)) == open_receipt(octets + b"\r\n", trusts(RECEIVER)) == receipt()


def test_the_same_receipt_is_the_same_octets():
    assert seal_receipt(receipt(), RECEIVER) == seal_receipt(receipt(), RECEIVER)


def test_a_receipt_of_a_stranger_is_refused():
    with pytest.raises(NotAuthenticError, match="not trusted here"):
        open_receipt(seal_receipt(receipt(sender=fingerprint(STRANGER.point)), STRANGER), trusts(RECEIVER))


def test_a_receipt_in_another_name_is_refused():
    with pytest.raises(BadDataError):
        seal_receipt(receipt(), STRANGER)
    members = load_object(
        jose.verify_compact(
            seal_receipt(receipt(), RECEIVER), trusts(RECEIVER), typ="teds-receipt+jws", max_octets=9999
        ).payload,
        "it",
    )
    forged = jose.sign_compact(dump(members), STRANGER, typ="teds-receipt+jws")
    with pytest.raises(NotAuthenticError, match="another sender"):
        open_receipt(forged, trusts(RECEIVER, STRANGER))


def test_a_node_is_imported_or_refused_not_both():
    both = receipt(refused=(RefusedNode(bytes(10), "late"),))
    with pytest.raises(BadDataError, match="twice"):
        open_receipt(seal_receipt(both, RECEIVER), trusts(RECEIVER))


@pytest.mark.parametrize("typ", ["teds-handover+jws", "teds-revocation+jws", ""])
def test_no_other_document_of_the_same_signer_is_a_receipt(typ):
    with pytest.raises(BadDataError):
        open_receipt(jose.sign_compact(b"{}", RECEIVER, typ=typ), trusts(RECEIVER))


def test_a_huge_receipt_is_refused_unread():
    with pytest.raises(BadDataError, match=r"at most [0-9]+ are read"):
        open_receipt(b" " * (65 << 20), trusts(RECEIVER))


def test_a_revocation_comes_out_as_it_went_in():
    made = seal_revocation(SENDER, uuid=b"\7" * 10, node=fingerprint(NODE_KEY), why="lost on the ferry", created=NOW)
    assert open_revocation(made.statement, trusts(SENDER)) == made
    assert (made.uuid, made.why, made.sender) == (b"\7" * 10, "lost on the ferry", fingerprint(SENDER.point))


def test_a_revocation_of_a_stranger_or_with_a_cut_end_counts_for_nothing():
    statement = seal_revocation(STRANGER, uuid=bytes(10), node=None, why="mischief", created=NOW).statement
    with pytest.raises(NotAuthenticError):
        open_revocation(statement, trusts(SENDER))
    for text in (statement[:-1], statement.rsplit(".", 1)[0], "", "é"):
        with pytest.raises((BadDataError, NotAuthenticError)):
            open_revocation(text, trusts(STRANGER))


@pytest.mark.parametrize("why", ["", "x" * 1025, "a\x07b"])
def test_the_reason_is_short_printable_text(why):
    if why == "":
        assert seal_revocation(SENDER, uuid=bytes(10), node=None, why=why, created=NOW).why == ""
        return
    with pytest.raises(BadDataError, match="printable"):
        seal_revocation(SENDER, uuid=bytes(10), node=None, why=why, created=NOW)


def test_a_revocation_has_the_members_of_the_contract_and_an_older_one_stays_readable() -> None:
    """plant.md names ``reason``; versions before it wrote ``why``, and read nothing else."""
    made = seal_revocation(SENDER, uuid=bytes(10), node=None, why="lost on the ferry", created=NOW)
    members = json.loads(decode_base64url(made.statement.split(".")[1], "The payload"))
    assert list(members) == ["format", "uuid", "fingerprint", "from", "reason", "created", "why"]
    assert members["reason"] == members["why"] == made.why
    for left_out in ("reason", "why"):
        kept = {name: value for name, value in members.items() if name != left_out}
        statement = jose.sign_compact(json.dumps(kept).encode(), SENDER, typ="teds-revocation+jws").decode()
        assert open_revocation(statement, trusts(SENDER)).why == "lost on the ferry"
