"""The Security TEDS in canonical form and out of it, the commit and its refusals, reset (profile sections 1, 4, 5)."""

# ruff: noqa: E501 - one row per case, its note in words included
from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from teds_provision.protocol.messages.frames import (
    Function,
    query_teds,
    read_teds,
    security_command,
    update_teds,
    write_teds,
)
from teds_provision.teds.codec import security
from teds_provision.teds.codec.frame import frame, raw_tuple, tuples, unframe
from teds_provision.teds.image import SECURITY, BlockId

from .recipes import CHALLENGE, IDENTIFY
from .scene import BLOCKS, UUID, Scene, credentials, high, key, octets, signed

OTHER_NAME = frame(bytes.fromhex("0304000c0101040100050c") + b"boom pitch 2")
PHY = frame(bytes.fromhex("0304050d01010a0101"))
Parts = list[tuple[int, bytes]]


def parts_of(teds: bytes) -> Parts:
    """Return the tuples of a TEDS, TEDSID first."""
    return [(part.type, part.value) for part in tuples(unframe(teds))]


def joined(parts: Parts) -> bytes:
    """Tuples back to a framed TEDS."""
    return frame(b"".join(raw_tuple(kind, value) for kind, value in parts))


def resigned(parts: Parts) -> bytes:
    """Return the same tuples with field 100 made anew over them as they are, so that only their form can be refused."""
    unsigned = joined([(kind, value) for kind, value in parts if kind != 100])
    made = base64.b64encode(key("station").sign(security.tbs(UUID, unsigned)))
    return joined([(kind, made if kind == 100 and len(value) == 88 else value) for kind, value in parts])


def changed(number: int, value: bytes | None, *, before: int | None = None) -> bytes:
    """One field of the good TEDS replaced, left out (None), or moved before field ``before``; signed again."""
    parts = [(kind, old if kind != number or at == 0 else value) for at, (kind, old) in enumerate(parts_of(signed()))]
    kept: Parts = [(kind, held) for kind, held in parts if held is not None]
    if before is not None:
        moving = next(part for part in kept[1:] if part[0] == number)
        kept.remove(moving)
        at = next(i for i, part in enumerate(kept) if i and part[0] == before)
        kept.insert(at, moving)
    return resigned(kept)


def added(number: int, value: bytes, after: int) -> bytes:
    """A tuple put in behind the last one of type ``after``; signed again."""
    parts = parts_of(signed())
    at = max(i for i, part in enumerate(parts) if part[0] == after)
    return resigned([*parts[: at + 1], (number, value), *parts[at + 1 :]])


def spare_bits(number: int) -> bytes:
    """Return a base64 field of the good TEDS whose unused last bits are not zero; decodes to the same octets."""
    value = dict(parts_of(signed())[1:])[number].decode()
    body = value.rstrip("=")
    alphabet = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
    bent = body[:-1] + alphabet[alphabet.index(body[-1]) | 1] + "=" * (len(value) - len(body))
    if number != 100:
        return changed(number, bent.encode())
    return joined([(kind, bent.encode() if kind == 100 else old) for kind, old in parts_of(signed())])


def canonical() -> Iterator[dict[str, Any]]:
    """Security TEDS that are canonical and that are not; staged with the blocks of kat.json on its keyed node.

    ``reason`` is what Update of 128 answers: null where the commit is good. All that are refused with 4 are rightly
    framed, and signed over their broken form, unless the note says otherwise.
    """
    digest = bytes(32)
    last = max(BLOCKS)
    repeated = last[0].to_bytes(2, "big") + bytes([last[1]]) + digest
    whole = signed()
    yield from _teds_entries(
        ("good", "The form that this profile writes.", whole, None),
        ("extra-fields", "Types 111 and 255 are skipped and covered by the signature; they may be empty.", resigned([*parts_of(whole), (111, b"ours"), (255, b"")]), None),
        ("ca-of-64-octets", "Field 5 at its longest.", changed(5, b"n" * 47 + b":" + b"0" * 16), None),
        ("ca-empty", "Field 5 may be empty.", changed(5, b""), None),
        ("tedsid-2024", "TEDSID of the 2024 edition.", frame(bytes.fromhex("030500ff800201") + unframe(whole)[6:]), 4),
        ("tedsid-version", "TEDSID with version 2.", frame(bytes.fromhex("030400800201") + unframe(whole)[6:]), 4),
        ("tedsid-tuple-length", "TEDSID with tuple length 2, all tuples written so.", _wide(whole), 4),
        ("tedsid-class", "TEDSID of class 129: the TEDS' own check fails.", frame(bytes.fromhex("030400810101") + unframe(whole)[6:]), 4),
        ("no-tedsid", "The TEDSID is missing.", frame(unframe(whole)[6:]), 4),
        ("descending", "Field 2 stands before field 1.", changed(2, b"\x02", before=1), 4),
        ("twice", "Field 109 stands twice.", added(109, b"\x02", 109), 4),
        ("used-enc-alg-missing", "Field 3 (UsedEncAlg) is missing; the TEDSID is not it.", changed(3, None), 4),
        ("unknown-field-7", "A type that is neither in the table nor 111 to 255.", added(7, b"\x00", 6), 4),
        ("unknown-field-99", "The same, 99.", added(99, b"", 6), 4),
        ("field-0", "A tuple of type 0 behind the TEDSID.", resigned([*parts_of(whole)[:1], (0, b""), *parts_of(whole)[1:]]), 4),
        *((f"missing-{number}", f"Field {number} is missing.", changed(number, None), 4) for number in (1, 2, 4, 5, 6, 101, 102, 103, 104, 105, 106, 107, 109, 110)),
        ("missing-100", "Field 100 is missing: nobody signed it.", changed(100, None), 4),
        ("short-u8", "Field 4 with no octets.", changed(4, b""), 4),
        ("long-u8", "Field 110 with two octets.", changed(110, b"\x00\x01"), 4),
        ("time-of-10-octets", "Field 6 as the 2024 edition writes a TimeInstance.", changed(6, bytes(10)), 4),
        ("sequence-of-2-octets", "Field 106 with two octets.", changed(106, b"\x00\x01"), 4),
        ("ca-of-65-octets", "Field 5 is too long.", changed(5, b"n" * 48 + b":" + b"0" * 16), 4),
        ("ca-not-utf-8", "Field 5 is no UTF-8.", changed(5, b"\xff\xfe"), 4),
        ("block-of-34-octets", "A SignedBlock with 34 octets.", added(108, repeated[:-1], 108), 4),
        ("block-twice", "A channel and access code stand twice in 108.", added(108, repeated, 108), 4),
        ("blocks-descending", "The tuples of 108 do not ascend.", _swapped_blocks(whole), 4),
        ("blocks-and-109", "A tuple of 108 stands behind 109.", added(108, b"\x00\x02\x03" + digest, 109), 4),
        ("lists-itself", "108 lists channel 0, access code 128.", _listing_itself(), 4),
        ("lists-128-of-channel-1", "128 on channel 1 is a TEDS like any other: listed, and neither staged nor stored: 6.", added(108, b"\x00\x01\x80" + digest, 108), 6),
        ("spare-bits-100", "Field 100: spare bits of the base64 are not zero. The signature itself is right.", spare_bits(100), 4),
        ("spare-bits-101", "Field 101: the same (2 spare bits).", spare_bits(101), 4),
        ("base64-line-break", "Field 104 with a line break, 89 octets.", changed(104, _value(104)[:64] + b"\n" + _value(104)[64:]), 4),
        ("base64-unpadded", "Field 104 without its padding, 86 octets.", changed(104, _value(104).rstrip(b"=")), 4),
        ("base64-url", "Field 101 in the URL alphabet.", changed(101, _value(101).translate(bytes.maketrans(b"+/", b"-_"))), 4),
        ("pem-key", "Field 101 as the base64 of a DER SubjectPublicKeyInfo.", changed(101, base64.b64encode(bytes.fromhex("3059301306072a8648ce3d020106082a8648ce3d030107034200") + key("node").point)), 4),
        ("trailing-octet", "One octet behind the last tuple.", frame(unframe(whole) + b"\x00"), 4),
        ("trailing-checksum", "The checksum is wrong by one.", whole[:-1] + bytes([whole[-1] ^ 1]), 4),
        ("length-off-by-one", "Length is one too large, the checksum fits to it.", _length(whole), 4),
        ("profile-version-2", "Field 105 is 2.", changed(105, b"\x02"), 4),
        ("weak-hash", "Field 4 is 0 (MD5).", changed(4, b"\x00"), 4),
        ("weak-encryption", "Field 3 is 3 (DES).", changed(3, b"\x03"), 4),
        ("older-suite", "Field 109 is 1, the suite without one-time keys.", changed(109, b"\x01"), 4),
        ("other-suite", "Field 109 is 3.", changed(109, b"\x03"), 4),
    )  # fmt: skip


def _teds_entries(*rows: tuple[str, str, bytes, int | None]) -> Iterator[dict[str, Any]]:
    for name, note, teds, reason in rows:
        yield {"name": name, "note": note, "teds": teds.hex(), "reason": reason}


def _value(number: int) -> bytes:
    return dict(parts_of(signed())[1:])[number]


def _wide(teds: bytes) -> bytes:
    rest = b"".join(raw_tuple(kind, value, width=2) for kind, value in parts_of(teds)[1:])
    return frame(bytes.fromhex("030400800102") + rest)


def _length(teds: bytes) -> bytes:
    body = (int.from_bytes(teds[:4], "big") + 1).to_bytes(4, "big") + teds[4:-2]
    return body + (0xFFFF - (sum(body) & 0xFFFF)).to_bytes(2, "big")


def _swapped_blocks(teds: bytes) -> bytes:
    parts = parts_of(teds)
    at = [i for i, part in enumerate(parts) if part[0] == 108]
    parts[at[0]], parts[at[1]] = parts[at[1]], parts[at[0]]
    return resigned(parts)


def _listing_itself() -> bytes:
    parts = parts_of(signed())
    at = [i for i, part in enumerate(parts) if part[0] == 108][1]
    return resigned([*parts[:at], (108, b"\x00\x00\x80" + bytes(32)), *parts[at:]])


def _staged(scene: Scene, blocks: Mapping[BlockId, bytes], teds: bytes) -> None:
    """Write blocks and a Security TEDS in a session."""
    for (channel, code), block in blocks.items():
        scene.sealed("a", write_teds(channel, code, 0, block), f"Write TEDS {code} of channel {channel}.")
    scene.sealed("a", write_teds(*SECURITY, 0, teds), "Write the Security TEDS.")


def _commit(
    name: str, note: str, teds: bytes, why: str, blocks: Mapping[BlockId, bytes] = BLOCKS, **start: Any
) -> Scene:
    """A keyed node, a session, the writes, the commit."""
    scene = Scene(name, note, **{"state": "keyed"} | start)
    scene.open("a", "Open.")
    _staged(scene, blocks, teds)
    scene.sealed("a", update_teds(*SECURITY), why)
    return scene


def commit() -> Iterator[Scene]:
    """Writing to flash: staging, the commit, and each of its refusals with the frames that provoke it."""
    scene = _commit(
        "good", "The datasheet of kat.json is written and read back.", signed(), "Commit: answers like Query of 128."
    )
    scene.sealed("a", IDENTIFY, "Provisioned, sequence 1.")
    scene.sealed("a", read_teds(1, 12, 0), "Read back.")
    scene.sealed("a", update_teds(*SECURITY), "Update again with nothing staged: harmless, answers like Query.")
    yield scene
    yield from _staging()
    other_key = replace(security.decode(signed()), node_key=key("other_node").point)
    foreign_meta = {**BLOCKS, (0, 1): BLOCKS[0, 1][:4] + BLOCKS[0, 1][4:12] + bytes(10) + BLOCKS[0, 1][22:-2]}
    foreign_meta[0, 1] = frame(foreign_meta[0, 1][4:])
    meta_2024 = {(0, 1): frame(bytes.fromhex("030500ff0102010410") + bytes(16))}
    no_uuid = {(0, 1): frame(bytes.fromhex("0304000101010a043f8000000c043f0000000d020001"))}
    rows: list[tuple[str, str, bytes, str, Mapping[BlockId, bytes]]] = [
        ("damaged-block", "A staged block with a wrong checksum, never updated on its own.", signed(), "4: the first check.", {**BLOCKS, (1, 12): BLOCKS[1, 12][:-1] + b"\0"}),
        ("initial", "The initial Security TEDS is staged: canonical, but not signed.", bytes.fromhex(_initial()), "4.", BLOCKS),
        ("other-node-key", "Field 101 is another node's, rightly signed otherwise.", _signed_again(other_key), "5.", BLOCKS),
        ("other-node-signature", "Field 102 is not the node's own.", _signed_again(replace(security.decode(signed()), node_key_signature=bytes(64))), "5.", BLOCKS),
        ("uncertified-station", "Field 104 is made by a CA that the node does not keep.", signed(station="foreign_station", ca="foreign_ca"), "5.", BLOCKS),
        ("station-signature-high-s", "Field 104 with a high s.", _signed_again(replace(security.decode(signed()), station_key_signature=high(security.decode(signed()).station_key_signature or b""))), "5.", BLOCKS),
        ("station-key-off-curve", "Field 103 is no point.", signed(station_key=b"\x04" + bytes(64)), "5: our node has no reason of its own for this.", BLOCKS),
        ("bad-signature", "Field 100 is over something else.", security.decode(signed()).with_signature(key("station").sign(b"something else")).encode(), "5.", BLOCKS),
        ("signature-high-s", "Field 100 with a high s, otherwise right.", security.decode(signed()).with_signature(high(security.decode(signed()).signature or b"")).encode(), "5.", BLOCKS),
        ("signature-of-another-node", "Field 100 is right for another UUID.", _for_another_uuid(), "5.", BLOCKS),
        ("digest", "A block other than the one that was signed.", signed(), "6.", {**BLOCKS, (1, 12): OTHER_NAME}),
        ("listed-and-absent", "108 lists a block that is neither staged nor stored.", signed(), "6.", {block: teds for block, teds in BLOCKS.items() if block != (1, 12)}),
        ("staged-and-not-listed", "A staged block that 108 does not list.", signed({block: teds for block, teds in BLOCKS.items() if block != (1, 12)}), "6.", BLOCKS),
        ("meta-of-another-node", "Field 4 of the Meta-TEDS (2007 form) is another UUID.", signed(foreign_meta), "9.", foreign_meta),
        ("meta-without-uuid", "A Meta-TEDS of the 2007 form without field 4.", signed(no_uuid), "9: our node takes an absent UUID for a wrong one.", no_uuid),
        ("sequence-same", "Sequence is not greater than the stored one.", signed(sequence=0), "7.", BLOCKS),
        ("sequence-too-far", "Sequence is greater by 65537.", signed(sequence=65537), "7.", BLOCKS),
        ("epoch-behind", "KeyEpoch 0, the node is at 1.", signed(key_epoch=0), "8.", BLOCKS),
        ("epoch-ahead", "KeyEpoch 2, the node is at 1.", signed(key_epoch=2), "8.", BLOCKS),
        ("sequence-and-epoch", "Both are wrong: the sequence is looked at first.", signed(sequence=0, key_epoch=2), "7.", BLOCKS),
        ("sequence-at-the-edge", "Sequence is greater by 65536: the most in one step.", signed(sequence=65536), "Good.", BLOCKS),
        ("second-station", "A datasheet signed by another station of the same CA.", signed(station="second_station"), "Good: any certified station may write.", BLOCKS),
        ("meta-of-2024", "A Meta-TEDS of the 2024 form: its UUID of 16 octets is not compared.", signed(meta_2024), "Good.", meta_2024),
    ]  # fmt: skip
    for name, note, teds, why, blocks in rows:
        yield _commit(name, note, teds, why, blocks)
    yield from _over_an_old_one()


def _initial() -> str:
    node = key("node")
    teds = security.decode(signed())
    return security.initial(node.point, teds.node_key_signature, sequence=0, key_epoch=1).hex()


def _signed_again(teds: security.SecurityTeds) -> bytes:
    return teds.with_signature(key("station").sign(security.tbs(UUID, teds.encode()))).encode()


def _for_another_uuid() -> bytes:
    teds = security.decode(signed())
    return teds.with_signature(key("station").sign(security.tbs(bytes(10), teds.encode()))).encode()


def _staging() -> Iterator[Scene]:
    name = BLOCKS[1, 12]
    scene = Scene(
        "staging", "Write replaces the staged image from its offset on; nothing counts before the commit.", "keyed"
    )
    scene.open("a", "Open.")
    steps: list[tuple[Any, str]] = [
        (write_teds(1, 12, 0, name[:10] + b"junk"), "Ten good octets and four that will go."),
        (write_teds(1, 12, 10, name[10:]), "From offset 10: what lay behind is dropped."),
        (update_teds(1, 12), "Its own check passes; the answer is for the staged image."),
        (read_teds(1, 12, 0), "Read knows nothing of it: 18."),
        (write_teds(1, 12, len(name) + 1, b"x"), "A gap: 4, and no staging is changed."),
        (update_teds(1, 12), "Still good."),
        (update_teds(*SECURITY), "Update of 128, others staged and it not: 2."),
        (write_teds(1, 12, 0, b""), "An empty Write at 0 stages an empty image,"),
        (update_teds(1, 12), "which fails its own check: 4."),
        (write_teds(1, 12, 0, BLOCKS[0, 1]), "A Meta-TEDS as access code 12:"),
        (update_teds(1, 12), "the class of its TEDSID is another: 4."),
        (update_teds(1, 5), "Update of what is not staged answers like Query."),
        (write_teds(0, 200, 0, b"x"), "Access code 200: 18."),
    ]
    for command, note in steps:
        scene.sealed("a", command, note)
    yield scene

    scene = Scene(
        "too-large",
        "maxMessage 512, the least: a Write carries at most 459 octets, a Read 466; a TEDS has at most 900 here.",
        "provisioned",
        max_message=512,
        max_teds=900,
    )
    scene.open("a", "Open.")
    scene.sealed("a", query_teds(*SECURITY), "MaxTEDSSize says it.")
    scene.sealed("a", read_teds(*SECURITY, 0), "466 octets.")
    scene.sealed("a", write_teds(*SECURITY, 0, bytes(459)), "459 octets: taken; the sealed frame has 506.")
    scene.sealed("a", write_teds(*SECURITY, 459, bytes(441)), "900 octets in all: taken.")
    scene.sealed("a", write_teds(*SECURITY, 900, b"x"), "One more: 10, and the staged ones stay.")
    scene.exchange(write_teds(*SECURITY, 0, bytes(502)).encode(), "A frame of 513 octets, plain: 10 goes before 3.")
    yield scene

    scene = Scene(
        "one-staging-area",
        "What one session has staged keeps the others out, for 60 s after it last touched it.",
        "keyed",
    )
    scene.open("a", "Open by tap.")
    scene.open("b", "Open over CAN.", link="can:f1")
    scene.sealed("b", security_command(Function.LIST), "Its first good frame.")
    scene.sealed("a", write_teds(1, 12, 0, name), "Write by tap.")
    scene.sealed(
        "b", write_teds(1, 12, 1, name[:1]), "Over CAN from an offset beyond its own staging: 4 goes before 17."
    )
    scene.sealed("b", write_teds(0, 18, 0, b"x"), "Access code 18: 18 goes before 17.")
    scene.sealed("b", write_teds(1, 12, 0, name), "Write over CAN: 17.")
    scene.sealed("b", update_teds(*SECURITY), "Update over CAN: 17.")
    scene.later(30.0).sealed("a", update_teds(1, 12), "Update by tap: the staged one's size; it touches the staging.")
    scene.later(59.9).sealed("b", write_teds(1, 12, 0, name), "59.9 s later, over CAN: 17.")
    scene.later(0.1).sealed("b", write_teds(1, 12, 0, name), "60 s later: taken, what was staged by tap is gone.")
    scene.sealed("a", update_teds(1, 12), "By tap: 17 now.")
    scene.sealed("b", security_command(Function.CLOSE), "The session over CAN closes: its staging goes.")
    scene.sealed("a", write_teds(1, 12, 0, name), "Write by tap: taken.")
    yield scene

    scene = Scene(
        "read-only",
        "A read-only TEDS cannot be written; it survives a commit that does not list it, as unsigned.",
        "keyed",
        blocks={(0, 13): PHY},
        read_only=frozenset({(0, 13)}),
    )
    scene.open("a", "Open.")
    scene.sealed("a", query_teds(0, 13), "ReadOnly (bit 0).")
    scene.sealed("a", write_teds(0, 13, 0, b"x"), "3.")
    _staged(scene, BLOCKS, signed())
    scene.sealed("a", update_teds(*SECURITY), "Good.")
    scene.sealed("a", security_command(Function.LIST), "(0, 13) is still there.")
    yield scene

    scene = Scene(
        "read-only-listed",
        "A station may list a read-only TEDS that it found; then it is signed.",
        "keyed",
        blocks={(0, 13): PHY},
        read_only=frozenset({(0, 13)}),
    )
    scene.open("a", "Open.")
    _staged(scene, BLOCKS, signed({**BLOCKS, (0, 13): PHY}))
    scene.sealed("a", update_teds(*SECURITY), "Good: the stored block has that digest.")
    yield scene

    scene = Scene("staging-goes-with-the-session", "A new session starts with nothing staged.", "keyed")
    scene.open("a", "Open.")
    scene.sealed("a", write_teds(1, 12, 0, name), "Write.")
    scene.open("b", "Open again.")
    scene.sealed("b", write_teds(1, 12, len(name), b"x"), "Going on where the other stopped: 4.")
    scene.sealed("b", update_teds(*SECURITY), "Nothing is staged: answers like Query.")
    yield scene

    scene = Scene("flash-fails-in-the-commit", "The transaction fails: the old set stands, the staging too.", "keyed")
    scene.open("a", "Open.")
    _staged(scene, BLOCKS, signed())
    scene.event("flash_fails", "The flash refuses to be written.")
    scene.sealed("a", update_teds(*SECURITY), "11.")
    scene.event("flash_works", "It works again.")
    scene.sealed("a", update_teds(*SECURITY), "The same Update again: good.")
    yield scene


def _over_an_old_one() -> Iterator[Scene]:
    fewer = {block: teds for block, teds in BLOCKS.items() if block != (1, 12)}
    teds = signed(fewer, sequence=2)
    scene = _commit(
        "removes-what-is-not-listed",
        "A stored block that is neither listed nor read-only goes with the commit.",
        teds,
        "Good; (1, 3) counts as stored.",
        {(0, 1): BLOCKS[0, 1]},
        state="provisioned",
    )
    scene.sealed("a", security_command(Function.LIST), "(1, 12) is gone.")
    yield scene
    changed_name = {**BLOCKS, (1, 12): OTHER_NAME}
    yield _commit(
        "one-block-changed",
        "Only what changed is written; the rest is stored with the digest that 108 says.",
        signed(changed_name, sequence=2),
        "Good.",
        {(1, 12): OTHER_NAME},
        state="provisioned",
    )
    yield _commit(
        "staged-counts-alone",
        "A staged image counts alone: the stored one of that digest does not help.",
        signed(sequence=2),
        "6.",
        {(1, 12): OTHER_NAME},
        state="provisioned",
    )
    yield _commit(
        "replay-of-the-old",
        "The datasheet that is there already, with its old sequence.",
        signed(),
        "7.",
        {},
        state="provisioned",
    )


def reset() -> Iterator[Scene]:
    """Reset, its proofs, and the initial Security TEDS after it."""
    fresh = octets("reset", "challenge") * 2
    scene = Scene("in-session", "Reset in a session, and its proof fetched again in factory state.", "provisioned")
    scene.open("a", "Open.")
    scene.sealed(
        "a",
        security_command(Function.RESET, CHALLENGE),
        "The proof; K, CA, station and staging are erased before it leaves.",
    )
    scene.exchange(scene.sessions["a"][0].seal(IDENTIFY), "Every session is over: outer 2.")
    scene.exchange(IDENTIFY, "Factory; epoch and sequence stay.")
    scene.exchange(
        security_command(Function.RESET, CHALLENGE),
        "The lost receipt, fetched again: a proof of the same statement (the same octets where the node signs deterministically).",
        link="can:f1",
    )
    scene.exchange(security_command(Function.RESET, fresh), "Another challenge, another proof; nothing changes.")
    scene.exchange(security_command(Function.LIST), "The other TEDS stay, unsigned.")
    scene.exchange(read_teds(*SECURITY, 0), "The initial Security TEDS again, with sequence 1 and epoch 1.")
    yield scene

    scene = Scene(
        "and-agree-again",
        "After a reset any owner may take the node by tap; epoch and sequence go on from where they were.",
        "provisioned",
    )
    scene.event("reset_by_hand", "Button held 5 s.")
    scene.exchange(IDENTIFY, "Factory.")
    agreed = scene.request(
        "A station of another CA.", shown=credentials("foreign_station", "foreign_ca"), one_time="one_time_3"
    )
    scene.exchange(agreed.confirm, "Epoch 2; the node keeps the other CA now.")
    scene.open("a", "Open under the new key.", held=agreed.key)
    scene.sealed("a", read_teds(*SECURITY, 0), "Still the initial Security TEDS, now with epoch 2.")
    teds = signed(station="foreign_station", ca="foreign_ca", sequence=2, key_epoch=2)
    scene.sealed("a", write_teds(*SECURITY, 0, teds), "A datasheet of the new owner over the blocks that stayed.")
    scene.sealed("a", update_teds(*SECURITY), "Good.")
    yield scene

    scene = Scene("plain-on-a-keyed-node", "Outside a session only a node in factory state gives a proof.", "keyed")
    scene.exchange(security_command(Function.RESET, CHALLENGE), "3, tapped or not.")
    yield scene

    scene = Scene("flash-fails", "A reset whose transaction fails gives no proof.", "keyed")
    scene.open("a", "Open.")
    scene.event("flash_fails", "The flash refuses to be written.")
    scene.sealed("a", security_command(Function.RESET, CHALLENGE), "11; the session lives on.")
    scene.sealed("a", IDENTIFY, "Still keyed.")
    yield scene


FILES = {"canonical": canonical, "commit": commit, "reset": reset}
