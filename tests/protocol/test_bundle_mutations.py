"""Whatever is done to a bundle: one of our errors, or exactly the content that was sealed."""

from __future__ import annotations

import functools
import json
from contextlib import suppress

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from teds_provision.errors import BadDataError, NotAuthenticError, PolicyError
from teds_provision.protocol.handover.bundle import BundleHeader, open_bundle, peek_bundle, seal_bundle
from teds_provision.protocol.handover.receipt import open_receipt, seal_receipt
from tests.protocol.handover_parts import NOW, RECEIVER, SENDER, THIRD, bundle, members_of, sealed, trusts
from tests.protocol.test_bundle_receipt import receipt

LEAVES = (BadDataError, NotAuthenticError, PolicyError)
MADE = bundle(2, to=(RECEIVER, THIRD))
SEALED = seal_bundle(MADE, SENDER, [RECEIVER.point, THIRD.point])
RECEIPT = seal_receipt(receipt(), RECEIVER)


def content_or_leaf(octets):
    try:
        found = open_bundle(octets, RECEIVER, trusts(SENDER), NOW)
    except LEAVES:
        return
    assert found.bundle == MADE


@pytest.mark.slow
def test_every_single_octet():
    for at in range(len(SEALED)):
        for flip in (0x01, 0x20, 0x80):
            content_or_leaf(SEALED[:at] + bytes([SEALED[at] ^ flip]) + SEALED[at + 1 :])


@settings(deadline=None)
@given(st.integers(0, len(SEALED)), st.integers(0, 40), st.binary(max_size=40))
def test_any_octets_cut_out_and_put_in(at, length, octets):
    content_or_leaf(SEALED[:at] + octets + SEALED[at + length :])


@settings(deadline=None)
@given(st.integers(0, len(SEALED)), st.integers(0, len(SEALED)), st.integers(0, len(SEALED)))
@example(0, 0, len(SEALED))
def test_pieces_in_another_order(first, second, third):
    here, two, three = sorted((first, second, third))
    content_or_leaf(SEALED[:here] + SEALED[two:three] + SEALED[here:two] + SEALED[three:])


@settings(deadline=None)
@given(st.sampled_from(["iv", "tag", "ciphertext", "protected", "recipients"]))
def test_parts_of_two_bundles_do_not_mix(name):
    other = json.loads(seal_bundle(bundle(1, to=(RECEIVER, THIRD)), SENDER, [RECEIVER.point, THIRD.point]))
    mixed = json.dumps(json.loads(SEALED) | {name: other[name]}).encode()
    if name == "protected":  # the same in every bundle
        content_or_leaf(mixed)
        return
    try:
        open_bundle(mixed, RECEIVER, trusts(SENDER), NOW)
    except LEAVES:
        return
    raise AssertionError(f"{name} of another bundle was accepted")


def paths(value, path=()):
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, inner in items:
        yield from paths(inner, (*path, name))


PATHS = [path for path in paths(members_of(bundle(2))) if path]
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=70),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(PATHS), VALUES)
def test_a_trusted_sender_that_writes_anything_into_any_member(path, value):
    """The signature is good, so the content may differ; but only a leaf, or a bundle that holds to every rule."""
    members = members_of(bundle(2))
    place = functools.reduce(lambda inner, name: inner[name], path[:-1], members)
    place[path[-1]] = value
    try:
        found = open_bundle(sealed(json.dumps(members).encode()), RECEIVER, trusts(SENDER), NOW).bundle
    except LEAVES:
        return
    assert len({node.uuid for node in found.nodes}) == len(found.nodes) == 2
    assert all(len(node.key) == 16 and len(node.node_key) == 65 and node.epoch > 0 for node in found.nodes)
    assert found.expires > NOW


@settings(deadline=None)
@given(st.integers(0, len(SEALED)), st.integers(0, 40), st.binary(max_size=40))
def test_looking_at_a_bundle_never_fails_otherwise(at, length, octets):
    with suppress(BadDataError):
        assert isinstance(peek_bundle(SEALED[:at] + octets + SEALED[at + length :]), BundleHeader)


def test_every_single_octet_of_a_receipt():
    for at in range(len(RECEIPT)):
        for flip in (0x01, 0x20, 0x80):
            try:
                found = open_receipt(RECEIPT[:at] + bytes([RECEIPT[at] ^ flip]) + RECEIPT[at + 1 :], trusts(RECEIVER))
            except LEAVES:
                continue
            assert found == receipt()
