"""What verification catches: every octet, every trust rule, every known way to be wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.errors import NotWhitelistedError, PolicyError
from teds_provision.protocol import datasheet
from teds_provision.protocol.datasheet import sign_datasheet
from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message
from teds_provision.protocol.messages.identity import Identity
from teds_provision.provisioning.agree import agree, require_session
from teds_provision.provisioning.build import build
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.sign import SignOrder, known_node_keys, sign, sign_image
from teds_provision.provisioning.teds_read import read_image
from teds_provision.provisioning.verify import FreshnessFloor, freshness_floor_of, verify_image
from teds_provision.provisioning.verify_node import judge_and_keep
from teds_provision.provisioning.write import write
from teds_provision.shapes.verdict import Verification
from teds_provision.station.station import Station
from teds_provision.station.store.records import TrustRecord
from teds_provision.teds.codec import security
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.image import SECURITY, Image
from tests.bench import Board, make_station, talk

from .test_provision import ANGLE, run


@pytest.fixture
def image(station: Station, board: Board) -> Image:
    return run(station, board).image


def verdict(station: Station, image: Image) -> str:
    return Verification(image.uuid, tuple(verify_image(station, image)), scope="image").verdict


def failed(station: Station, image: Image, identity: Identity | None = None) -> list[str]:
    floor = FreshnessFloor(identity) if identity is not None else None
    return [check.name for check in verify_image(station, image, floor=floor) if check.result == "failed"]


def test_a_good_image_is_authentic(station: Station, image: Image) -> None:
    assert verdict(station, image) == "authentic"


def test_every_flipped_octet_is_caught(station: Station, image: Image) -> None:
    for block in image:
        teds = image.blocks[block]
        for at in range(len(teds)):
            flipped = teds[:at] + bytes([teds[at] ^ 0x01]) + teds[at + 1 :]
            assert verdict(station, image.with_block(block, flipped)) == "not authentic", (block, at)


def test_every_flipped_octet_with_a_mended_checksum_is_caught(station: Station, image: Image) -> None:
    for block in image:
        teds = image.blocks[block]
        for at in range(4, len(teds) - 2):
            body = bytearray(teds[4:-2])
            body[at - 4] ^= 0x20
            assert verdict(station, image.with_block(block, frame(bytes(body)))) == "not authentic", (block, at)


def test_another_uuid_is_caught(station: Station, image: Image) -> None:
    assert verdict(station, Image(bytes(10), image.blocks)) == "not authentic"


def test_a_missing_block_is_caught(station: Station, image: Image) -> None:
    for block in image.unsigned_blocks():
        without = Image(image.uuid, {key: teds for key, teds in image.blocks.items() if key != block})
        assert failed(station, without) == ["signed TEDS"]


def test_an_unlisted_block_is_reported_as_unsigned(station: Station, image: Image) -> None:
    more = image.with_block((1, 15), frame(bytes.fromhex("0304000f0101")))
    assert (verdict(station, more), failed(station, more)) == ("unsigned", ["every TEDS is signed"])


def test_the_initial_datasheet_is_unsigned(station: Station, board: Board) -> None:
    initial = Image(board.uuid, {SECURITY: board.state.security_teds()})
    assert verdict(station, initial) == "unsigned"


def test_weak_algorithms_are_never_authentic(station: Station, image: Image) -> None:
    shown = security.decode(image.blocks[SECURITY])
    weak = replace(shown, values={**shown.values, 4: 0})
    signed = weak.with_signature(station.credentials().key.sign(security.tbs(image.uuid, weak.encode()))).encode()
    assert failed(station, image.with_block(SECURITY, signed)) == ["algorithms"]


@pytest.mark.parametrize(("field", "name"), [(109, "SessionSuite 1"), (110, "KeyAgreement 1")])
def test_a_datasheet_of_another_wire_is_named_and_never_authentic(
    station: Station, image: Image, field: int, name: str
) -> None:
    shown = security.decode(image.blocks[SECURITY])
    older = replace(shown, values={**shown.values, field: 1})
    signed = older.with_signature(station.credentials().key.sign(security.tbs(image.uuid, older.encode()))).encode()
    old = image.with_block(SECURITY, signed)
    assert (verdict(station, old), failed(station, old)) == ("not authentic", ["algorithms"])
    assert any(f"names {name}; 2 is spoken" in check.why for check in verify_image(station, old))


def test_a_foreign_security_teds_is_shown_and_never_trusted(station: Station, image: Image) -> None:
    foreign = frame(security.TEDSID_TUPLE + b"\x01\x01\x04\x02\x01\x02")
    assert verdict(station, image.with_block(SECURITY, foreign)) == "not authentic"


# -- trust: nothing in a TEDS is an anchor -----------------------------------------------------------------------------


def test_a_stranger_trusts_nothing_until_told(station: Station, image: Image, tmp_path: Path) -> None:
    stranger = make_station(tmp_path / "stranger")
    assert "signing station" in failed(stranger, image)
    stranger.policy.trust(TrustRecord("peer", "station", station.point, fingerprint(station.point)))
    assert verdict(stranger, image) == "authentic"
    stranger.policy.distrust("peer")
    stranger.policy.trust(TrustRecord("owner", "ca", station.ca, fingerprint(station.ca)))
    assert verdict(stranger, image) == "authentic"


def test_a_datasheet_that_brings_its_own_ca_is_not_authentic(station: Station, image: Image) -> None:
    forger, forged_ca = SoftwareKey.generate(), SoftwareKey.generate()
    shown = replace(
        security.decode(image.blocks[SECURITY]),
        station_key=forger.point,
        station_key_signature=forged_ca.sign(station_key_message(forger.point)),
    )
    signed = shown.with_signature(forger.sign(security.tbs(image.uuid, shown.encode()))).encode()
    assert failed(station, image.with_block(SECURITY, signed)) == ["signing station", "station certificate"]


def test_a_node_key_other_than_the_pinned_one_is_not_authentic(station: Station, image: Image, board: Board) -> None:
    other = Board(uuid=board.uuid)
    shown = replace(
        security.decode(image.blocks[SECURITY]),
        node_key=other.key.point,
        node_key_signature=other.state.node_key_signature,
    )
    key = station.credentials().key
    signed = shown.with_signature(key.sign(security.tbs(image.uuid, shown.encode()))).encode()
    assert failed(station, image.with_block(SECURITY, signed)) == ["node key"]


def test_a_key_that_its_node_did_not_sign_for_this_uuid_is_not_authentic(station: Station, image: Image) -> None:
    """Field 102 alone is wrong, and signed as it is by the station itself: nothing else gives it away."""
    shown = security.decode(image.blocks[SECURITY])
    wrong = replace(shown, node_key_signature=Board(uuid=bytes(10)).state.node_key_signature)
    signed = wrong.with_signature(station.credentials().key.sign(security.tbs(image.uuid, wrong.encode()))).encode()
    assert failed(station, image.with_block(SECURITY, signed)) == ["node key"]
    assert verdict(station, image.with_block(SECURITY, signed)) == "not authentic"


def test_a_file_is_judged_alone(station: Station, board: Board, image: Image) -> None:
    """An older datasheet from an archive is as authentic as on its first day; what does not apply does no harm."""
    run(station, board, order=replace(ANGLE, name="renamed"))
    assert verdict(station, image) == "authentic"
    skipped = {check.name for check in verify_image(station, image) if check.result == "skipped"}
    assert skipped == {"key epoch", "sequence"}


# -- on the node -------------------------------------------------------------------------------------------------------


def on_node(station: Station, board: Board) -> Verification:
    with talk(board) as node:
        who = identify(station, node)
        require_session(station, node)
        return judge_and_keep(station, node, read_image(node), who.point).verified


def test_a_provisioned_node_is_authentic(station: Station, board: Board, image: Image) -> None:
    verified = on_node(station, board)
    assert verified.verdict == "authentic"
    assert [check.result for check in verified.checks if check.name == "possession"] == ["passed"]


def test_a_teds_changed_on_the_node_is_caught(station: Station, board: Board, image: Image) -> None:
    board.flash.state = replace(
        board.state, blocks={**board.state.blocks, (0, 12): frame(bytes.fromhex("0304000c0101040100050161"))}
    )
    board.power_on()
    assert on_node(station, board).verdict == "not authentic"


def test_an_old_datasheet_put_back_is_caught(station: Station, board: Board, image: Image) -> None:
    identity = replace(board.tim.identity(), sequence=2)
    assert failed(station, image, identity) == ["sequence"]


def test_a_datasheet_of_a_later_epoch_is_caught(station: Station, board: Board, image: Image) -> None:
    identity = replace(board.tim.identity(), epoch=0)
    assert failed(station, image, identity) == ["key epoch"]


def test_an_epoch_older_than_one_that_was_seen_is_caught_without_a_session_too(station: Station, board: Board) -> None:
    """The node is at hand through somebody's recording: its sequence alone could be the newest."""
    old = run(station, board).image
    with talk(board) as node:
        agree(station, node, identify(station, node), rotate=True)
    new = run(station, board).image
    floor = freshness_floor_of(station, board.uuid, None)
    assert (floor.identity, floor.sequence, floor.key_epoch) == (None, 2, 2)
    for image, expected in ((old, "failed"), (new, "passed")):
        checks = {check.name: check for check in verify_image(station, image, floor=replace(floor, sequence=1))}
        assert (checks["key epoch"].result, checks["sequence"].result) == (expected, "passed")
    (check,) = [check for check in verify_image(station, old, floor=floor) if check.name == "key epoch"]
    assert check.why == "signed for epoch 1, older than the 2 that this station saw"


def test_what_a_stranger_signed_is_no_floor_for_sequence_and_epoch(
    station: Station, board: Board, tmp_path: Path
) -> None:
    image = run(station, board).image
    stranger = make_station(tmp_path / "stranger")
    ours = security.decode(image.blocks[SECURITY])
    theirs = replace(
        ours,
        signature=None,
        sequence=900,
        key_epoch=900,
        station_key=stranger.point,
        station_key_signature=stranger.credentials().station_signature,
    )
    signed = sign_datasheet(theirs, board.uuid, stranger.credentials())
    station.datasheets.keep_datasheet(image.with_block(SECURITY, signed))
    assert freshness_floor_of(station, board.uuid, None) == FreshnessFloor()
    broken = replace(ours, sequence=900, key_epoch=900).encode()
    station.datasheets.keep_datasheet(image.with_block(SECURITY, broken))
    assert freshness_floor_of(station, board.uuid, None) == FreshnessFloor(), "field 100 is not over these numbers"


def test_what_is_not_whitelisted_cannot_be_signed(station: Station, board: Board, image: Image) -> None:
    station.pins.remove(board.uuid)
    with pytest.raises(NotWhitelistedError):
        sign_image(station, SignOrder(board.uuid, image), None)


def test_the_same_build_signed_as_draft_and_as_file_has_one_signature(station: Station, board: Board) -> None:
    from .test_agree import whitelist

    whitelist(station, board)
    with talk(board) as node:
        agree(station, node, identify(station, node))
    built = build(station, board.uuid, ANGLE)
    first = sign_image(station, SignOrder(board.uuid), None).signed
    second = sign_image(station, SignOrder(board.uuid, built.image), None).signed
    assert (second.signature, second.sequence, second.reused) == (first.signature, 1, True)
    again = sign_image(station, SignOrder(board.uuid), None).signed
    assert (again.signature, again.reused) == (first.signature, True)


def test_a_draft_that_is_not_above_the_nodes_sequence_is_signed_again(station: Station, board: Board) -> None:
    """Another station has written meanwhile: the signature says the same, and the node would not take it."""
    run(station, board)
    built = build(station, board.uuid, replace(ANGLE, name="renamed")).image
    draft = sign_image(station, SignOrder(board.uuid), None).signed
    keys = known_node_keys(station, board.uuid, draft.image)
    earlier = [draft.image.blocks[SECURITY]]
    above = sign(station, keys, built, epoch=1, node_sequence=draft.sequence - 1, earlier=earlier)
    assert (above.sequence, above.reused) == (draft.sequence, True)
    anew = sign(station, keys, built, epoch=1, node_sequence=draft.sequence, earlier=earlier)
    assert (anew.sequence, anew.reused) == (draft.sequence + 1, False)


def test_a_datasheet_signed_before_a_rotation_is_refused_before_anything_is_staged(
    station: Station, board: Board
) -> None:
    run(station, board)
    build(station, board.uuid, replace(ANGLE, name="renamed"))
    draft = sign_image(station, SignOrder(board.uuid), None).signed
    with talk(board) as node:
        agree(station, node, identify(station, node), rotate=True)
        with pytest.raises(PolicyError, match="epoch") as refused:
            write(station, node, draft.image)
    assert refused.type is PolicyError, "said here, not by the node after its flash was written"


@pytest.mark.parametrize(
    ("fields", "holds"),
    [
        (b"\x04\x0a" + b"u" * 10 + b"\x0a\x00", True),
        (b"\x0a\x00\x04\x0a" + b"u" * 10, True),
        (b"\x04\x0a" + b"v" * 10, False),
        (b"\x04\x0a" + b"v" * 10 + b"\x04\x0a" + b"u" * 10, True),
        (b"\x04\x0b" + b"u" * 11, False),
        (b"\x0a\x0a" + b"u" * 10, False),
        (b"\x04\x0a" + b"u" * 9, False),
    ],
)
def test_a_meta_teds_names_its_node_in_whichever_place_the_field_is(fields: bytes, holds: bool) -> None:
    meta = frame(b"\x03\x04\x00\x01\x01\x01" + fields)
    assert datasheet.meta_names(meta, b"u" * 10) is holds
    assert not datasheet.meta_names(meta[:-1] + bytes([meta[-1] ^ 1]), b"u" * 10), "the checksum is wrong"
