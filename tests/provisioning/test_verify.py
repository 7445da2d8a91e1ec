"""What verification catches: every octet, every trust rule, every known way to be wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.errors import (
    BadDatasheetError,
    NodeSilentError,
    NotAuthenticError,
    NotWhitelistedError,
    PolicyError,
    TedsProvisionError,
    UnprovenError,
)
from teds_provision.protocol import datasheet
from teds_provision.protocol.datasheet import sign_datasheet
from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message
from teds_provision.protocol.messages.identity import Identity
from teds_provision.provisioning.agree import agree, require_session
from teds_provision.provisioning.build import build
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.sign import SignOrder, known_node_keys, sign, sign_image
from teds_provision.provisioning.teds_read import read_image
from teds_provision.provisioning.verify import (
    FreshnessFloor,
    _meta,
    freshness_floor_of,
    possession_check,
    require_authentic,
    session_check,
    snapshot_trust,
    verify_image,
)
from teds_provision.provisioning.verify_node import judge_and_keep
from teds_provision.provisioning.write import write
from teds_provision.shapes.verdict import Check, Verification
from teds_provision.station.station import Station
from teds_provision.station.store.records import RevocationRecord, TrustRecord
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


# -- in whole words ----------------------------------------------------------------------------------------------------


def words(station: Station, image: Image, floor: FreshnessFloor | None = None) -> dict[str, tuple[str, str]]:
    """Return result and reason of each check, in their order; the keys' digits by their owners."""
    shown = {
        fingerprint(station.point)[:16]: "STATION",
        fingerprint(station.ca)[:16]: "CA",
        fingerprint(security.decode(station_image_key(image)).node_key)[:16]: "NODE",
    }
    found = {}
    for check in verify_image(station, image, floor=floor):
        why = check.why
        for digits, owner in shown.items():
            why = why.replace(digits, owner)
        found[check.name] = (check.result, why)
    return found


def station_image_key(image: Image) -> bytes:
    return image.blocks[SECURITY]


GOOD = {
    "form": ("passed", "4 TEDS"),
    "canonical form": ("passed", ""),
    "algorithms": ("passed", "ECDSA P-256, SHA-256, AES-128"),
    "node key": ("passed", "NODE, pinned"),
    "key epoch": ("skipped", "a file does not show the node's current state"),
    "sequence": ("skipped", "a file does not show the node's current state"),
    "not revoked": ("passed", ""),
    "signed": ("passed", ""),
    "signing station": ("passed", "STATION"),
    "station certificate": ("passed", "CA CA"),
    "signature": ("passed", ""),
    "signed TEDS": ("passed", "3 digests"),
    "every TEDS is signed": ("passed", ""),
    "UUID": ("passed", ""),
}


def test_every_check_of_a_good_image_in_its_order(station: Station, image: Image, board: Board) -> None:
    small = {block: octets for block, octets in image.blocks.items() if block[0] == 0}
    assert len(small) == 3, "Meta-TEDS, name and Security TEDS"
    checks = words(station, image)
    expected = GOOD | {
        "form": ("passed", f"{len(image.blocks)} TEDS"),
        "signed TEDS": ("passed", f"{len(image.blocks) - 1} digests"),
    }
    assert checks == expected
    assert list(checks) == list(expected)
    now = FreshnessFloor(board.tim.identity(), 1, 1)
    assert words(station, image, now) == expected | {"key epoch": ("passed", "1"), "sequence": ("passed", "1")}
    station.pins.remove(image.uuid)
    assert words(station, image)["node key"] == ("passed", "NODE, not pinned here")


@pytest.mark.parametrize(
    ("floor", "name", "why"),
    [
        (FreshnessFloor(None, 2, 1), "sequence", "sequence 1 is older than the 2 that this station saw on the node"),
        (FreshnessFloor(None, 1, 2), "key epoch", "signed for epoch 1, older than the 2 that this station saw"),
    ],
)
def test_what_is_older_than_what_was_seen_says_so(
    station: Station, image: Image, floor: FreshnessFloor, name: str, why: str
) -> None:
    assert words(station, image, floor)[name] == ("failed", why)
    assert [check for check, (result, _) in words(station, image, floor).items() if result == "failed"] == [name]


def test_what_is_older_than_the_nodes_own_values_says_so_first(station: Station, image: Image, board: Board) -> None:
    """Which of two such faults the error named was another from run to run."""
    newer = replace(board.tim.identity(), sequence=2, epoch=0)
    checks = words(station, image, FreshnessFloor(newer, 9, 9))
    assert checks["sequence"] == ("failed", "sequence 1 is older than the node's own 2: an old datasheet was restored")
    assert checks["key epoch"] == ("failed", "signed for epoch 1, but the node is at 0")
    with pytest.raises(
        BadDatasheetError, match=r"^The datasheet is not authentic: signed for epoch 1, but the node is at 0\.$"
    ):
        require_authentic(Verification(image.uuid, tuple(verify_image(station, image, floor=FreshnessFloor(newer)))))


def failures(station: Station, image: Image) -> dict[str, str]:
    return {check.name: check.why for check in verify_image(station, image) if check.result == "failed"}


def test_what_is_wrong_with_an_image_in_whole_words(station: Station, image: Image, board: Board) -> None:
    shown = security.decode(image.blocks[SECURITY])
    name = image.blocks[0, 12]
    initial = Image(board.uuid, {SECURITY: replace(shown, signature=None).encode()})
    assert failures(station, Image(board.uuid, {})) == {"signed": "the image has no Security TEDS"}
    foreign = image.with_block(SECURITY, frame(security.TEDSID_TUPLE + b"\x01\x01\x04"))
    assert failures(station, foreign) == {
        "canonical form": "the Security TEDS does not follow this profile: shown, never trusted"
    }
    ours = image.with_block(SECURITY, frame(security.TEDSID_TUPLE + bytes([105, 1, 1])))
    assert failures(station, ours) == {"canonical form": "The Security TEDS lacks field 1."}
    assert initial.security is not None
    broken = name[:-1] + bytes([name[-1] ^ 1])
    assert failures(station, image.with_block((0, 12), broken)) == {
        "form": "length, checksum or class is wrong: TEDS 12 of channel 0",
        "signed TEDS": "TEDS 12 of channel 0 is missing or changed",
    }
    without = Image(
        board.uuid, {place: octets for place, octets in image.blocks.items() if place not in ((0, 1), (0, 12))}
    )
    assert failures(station, without) == {
        "signed TEDS": "TEDS 1 of channel 0 is missing or changed, TEDS 12 of channel 0 is missing or changed"
    }
    more = (
        image.with_block((2, 12), name)
        .with_block((1, 12), name)
        .with_block((1, 7), frame(bytes.fromhex("030400070101")))
    )
    assert failures(station, more)["every TEDS is signed"].endswith("TEDS 12 of channel 2 is unsigned")
    assert failures(station, more)["every TEDS is signed"].startswith("TEDS 7 of channel 1 is unsigned, ")
    other = Image(bytes(9) + b"\1", image.blocks)
    assert failures(station, other) == {
        "node key": "field 102 does not sign this key for this UUID",
        "signature": "field 100 does not verify: the datasheet was changed or belongs to another node",
        "UUID": "the Meta-TEDS names another",
    }
    weak = replace(shown, values={**shown.values, 2: 0, 4: 0}).encode()
    assert (
        failures(station, image.with_block(SECURITY, weak))["algorithms"] == "weak or unknown algorithm in field 2, 4"
    )
    station.policy.deny(RevocationRecord(board.uuid, None, "stolen", "{}"))
    assert failures(station, image) == {"not revoked": "revoked: stolen"}


def test_a_station_that_is_trusted_by_itself_needs_no_ca(station: Station, image: Image, tmp_path: Path) -> None:
    other = make_station(tmp_path / "other")
    digits = fingerprint(station.point)[:16]
    assert failures(other, image) == {
        "signing station": f"station {digits} is neither trusted here nor certified by a trusted CA",
        "station certificate": "field 104 matches no trusted CA",
    }
    other.policy.trust(TrustRecord("bench", "station", station.point, fingerprint(station.point)))
    checks = {check.name: check for check in verify_image(other, image)}
    assert checks["signing station"] == Check("signing station", "passed", digits)
    assert checks["station certificate"] == Check(
        "station certificate", "skipped", "the station itself is trusted; its CA is not known here"
    )


def test_a_stations_own_key_needs_its_ca_and_an_entry_alone_pins_no_key(station: Station, image: Image) -> None:
    known = snapshot_trust(station)
    (entry,) = known.pins.entries.values()
    alone = replace(
        known,
        pins=replace(known.pins, entries={entry.uuid: replace(entry, fingerprint=None)}),
        policy=replace(known.policy, cas=(), cas_of_nodes={}, stations=(station.point,)),
    )
    checks = {check.name: check for check in verify_image(alone, image)}
    assert checks["signing station"].result == "passed"
    assert checks["station certificate"] == Check("station certificate", "failed", "field 104 matches no trusted CA")
    assert checks["node key"].why.endswith(", not pinned here")


def test_which_failure_of_a_datasheet_its_error_names() -> None:
    def raised(*checks: Check) -> tuple[type[Exception], str]:
        with pytest.raises(TedsProvisionError) as refused:
            require_authentic(Verification(bytes(10), checks))
        return type(refused.value), refused.value.message

    good = Check("signature", "passed", "")
    require_authentic(Verification(bytes(10), (good, Check("session", "passed", ""))))
    assert raised(Check("form", "failed", "first"), Check("UUID", "failed", "second")) == (
        BadDatasheetError,
        "The datasheet is not authentic: first.",
    )
    assert raised(Check("form", "failed", "first"), Check("sequence", "failed", "old")) == (
        BadDatasheetError,
        "The datasheet is not authentic: old.",
    )
    assert raised(Check("form", "failed", "")) == (BadDatasheetError, "The datasheet is not authentic: form.")
    assert raised(good, Check("session", "failed", "it is mute")) == (
        UnprovenError,
        f"Nothing could be proven about node {'00' * 10}: it is mute.",
    )


@pytest.mark.parametrize(
    ("opened", "why", "result", "text"),
    [
        ("opened", "no", "passed", "opened"),
        ("", "no", "failed", "no"),
        ("", "", "skipped", "this station holds no key of this node"),
    ],
)
def test_what_a_session_proves(opened: str, why: str, result: str, text: str) -> None:
    assert session_check(opened, why) == Check("session", result, text)  # type: ignore[arg-type]


def test_a_challenge_is_a_check_and_a_lost_link_is_none() -> None:
    def fail(error: TedsProvisionError) -> None:
        raise error

    assert possession_check(lambda: None) == Check("possession", "passed", "the node signed a fresh challenge")
    assert possession_check(lambda: fail(NotAuthenticError("It cannot."))) == Check(
        "possession", "failed", "It cannot."
    )
    with pytest.raises(NodeSilentError):
        possession_check(lambda: fail(NodeSilentError("gone")))


def test_every_meta_teds_names_the_node_on_whatever_channel() -> None:
    uuid = bytes.fromhex("8d4d9da65281f7000000")
    own, other = (
        frame(bytes.fromhex("030400010101040a") + named + bytes.fromhex("0a043f800000")) for named in (uuid, bytes(10))
    )
    for blocks, result in (
        ({(0, 1): own}, "passed"),
        ({(0, 1): own, (1, 1): other}, "failed"),
        ({(0, 1): other, (1, 1): own}, "failed"),
        ({(1, 12): other}, "passed"),
    ):
        checks = {check.name: check.result for check in [_meta(Image(uuid, blocks))]}
        assert checks == {"UUID": result}
