"""TEDS as nobody should write them: the node in C judges each as the reference does."""

from __future__ import annotations

import ctypes
import random
import struct
from collections.abc import Iterator

import pytest

from teds_provision.errors import BadDataError
from teds_provision.protocol.datasheet import own_values, passes_own_check
from teds_provision.teds.codec import security
from teds_provision.teds.codec.frame import frame, unframe
from tests.firmware import builds
from tests.firmware.bench import CBench
from tests.firmware.desk import CDesk
from tests.protocol.desk import META, NAME, NODE, UUID, Desk
from tests.protocol.operation.bench import MS, Bench, channel_teds
from tests.protocol.operation.test_refusals import channels, operate, subscribe

pytestmark = pytest.mark.system


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    CDesk.close_all()
    CBench.close_all()


# -- the Security TEDS -------------------------------------------------------------------------------------------------


def canonical(block: bytes) -> bool:
    """Return True if the reference takes this data block for that of a signed Security TEDS with its own values."""
    try:
        teds = security.decode_block(block)
    except BadDataError:
        return False
    signed = None not in (teds.signature, teds.station_key, teds.station_key_signature)
    return signed and own_values(teds)


def canonical_in_c(block: bytes) -> bool:
    """Return the same by ``teds_security_parse``."""
    library = ctypes.CDLL(str(builds.library()))
    library.teds_security_parse.restype = ctypes.c_bool
    nobody, found = ctypes.create_string_buffer(65536), ctypes.create_string_buffer(1024)  # whose key is asked later
    return bool(library.teds_security_parse(nobody, block, ctypes.c_size_t(len(block)), found))


def good_block(**changes: object) -> bytes:
    """Return the data block of a good one over two TEDS."""
    desk = Desk(blocks={(0, 1): META, (1, 12): NAME})
    return bytes(unframe(desk.signed({(0, 1): META, (1, 12): NAME}, **changes)))


def with_ca(block: bytes, text: bytes) -> bytes:
    """Return the same with this field 5."""
    at = block.index(b"\x05\x15peer:")
    return block[:at] + bytes((5, len(text))) + text + block[at + 2 + 0x15 :]


TEXTS = [
    b"", b"a", b"a" * 64, b"a" * 65, b"\x7f", b"\x80", b"\xbf", b"\xc1\x80", b"\xc2\x80", b"\xdf\xbf", b"\xc2",
    b"\xc2a", b"\xc2\xc0", b"\xe0\x9f\x80", b"\xe0\xa0\x80", b"\xe1\x80\x80", b"\xed\x9f\xbf", b"\xed\xa0\x80",
    b"\xef\xbf\xbf",
    b"\xe1\x80", b"\xe1\x80a", b"\xe1\x80\xc0", b"\xf0\x8f\x80\x80", b"\xf0\x90\x80\x80", b"\xf1\x80\x80\x80",
    b"\xf4\x8f\xbf\xbf", b"\xf4\x90\x80\x80", b"\xf5\x80\x80\x80", b"\xff", b"\xf1\x80\x80", b"\xf1\x80\x80\x7f",
    "Krän:0123456789abcdef".encode(), "起重机:0123456789abcdef".encode(), "\U0001f3d7:01".encode(),
]  # fmt: skip


@pytest.mark.parametrize("text", TEXTS, ids=bytes.hex)
def test_field_5_is_utf8_of_64_octets_at_most(text: bytes) -> None:
    block = with_ca(good_block(), text)
    assert canonical_in_c(block) == canonical(block)


def test_what_is_canonical_is_so_for_both() -> None:
    """A good one with an octet or a tuple changed, cut, doubled, moved."""
    dice = random.Random(5)
    good = good_block()
    assert canonical(good)
    assert canonical_in_c(good)
    places = [(start - 2, end) for _, start, end in security._places(good)]
    verdicts = set()
    for number in range(4000):
        block = bytearray(good)
        what = dice.randrange(6)
        start, end = dice.choice(places)
        if what == 0:
            block[dice.randrange(len(block))] = dice.choice((0, 1, 4, 0x2B, 0x2F, 0x3D, 0x80, 108, 111, 255))
        elif what == 1:
            del block[start:end]
        elif what == 2:
            block[end:end] = block[start:end]
        elif what == 3:
            kind = dice.choice((0, 5, 99, 105, 108, 110, 111, 200, 255))
            block[end:end] = bytes((kind, dice.randrange(4))) + bytes(3)
        elif what == 4:
            del block[dice.randrange(len(block)) :]
        else:
            value = bytes(dice.choice((b"AAAA", b"====", b"zz+/", b"----")))
            at = dice.randrange(start, end)
            block[at : at + 4] = value
        mine = canonical(bytes(block))
        assert canonical_in_c(bytes(block)) == mine, f"{number}: {block.hex()}"
        verdicts.add(mine)
    assert verdicts == {True, False}


@pytest.mark.parametrize(
    "block",
    [
        bytes.fromhex("0304000c0101040100"), bytes.fromhex("0304000c0101"), bytes.fromhex("0305000c0c01010401"),
        bytes.fromhex("030500000c0101"), bytes.fromhex("0306000c0101040100"), bytes.fromhex("0404000c0101040100"),
        bytes.fromhex("0304000d0101040100"), bytes.fromhex("0305000d0d01010401"), bytes.fromhex("030500000c01"),
        b"", b"\x03", bytes.fromhex("030400"),
    ],
    ids=bytes.hex,
)  # fmt: skip
def test_the_check_of_a_staged_teds(block: bytes) -> None:
    library = ctypes.CDLL(str(builds.library()))
    library.teds_own_check.restype = ctypes.c_bool
    whole = frame(block)
    for teds in (whole, whole[:-1] + bytes((whole[-1] ^ 1,)), whole + b"\0"):
        mine = passes_own_check((1, 12), teds)
        assert bool(library.teds_own_check(ctypes.c_uint8(12), teds, ctypes.c_size_t(len(teds)))) == mine


# -- the Meta-TEDS -----------------------------------------------------------------------------------------------------

_HEAD = bytes.fromhex("030400010101")
_OWN = b"\x04\x0a" + UUID
_WIDE = bytes.fromhex("0304000101")
METAS = {
    "good": META,
    "the UUID behind others": frame(_HEAD + b"\x0a\x04\0\0\0\0" + _OWN),
    "no UUID": frame(_HEAD + b"\x0a\x04\0\0\0\0"),
    "a UUID of 9 octets": frame(_HEAD + b"\x04\x09" + UUID[:9]),
    "another, then its own": frame(_HEAD + b"\x04\x0a" + bytes(10) + _OWN),
    "a tuple that runs past the end": frame(_HEAD + b"\x0a\xff\0\0"),
    "an octet too many": frame(_HEAD + _OWN + b"\x0a"),
    "an octet and no UUID": frame(_HEAD + b"\x0a\x01\0" + b"\x0a"),
    "lengths of 2 octets": frame(_WIDE + b"\x02" + b"\x04\0\x0a" + UUID),
    "lengths of 0 octets are of 1": frame(_WIDE + b"\0" + _OWN),
    "lengths of 4 octets": frame(_WIDE + b"\x04" + b"\x04\0\0\0\x0a" + UUID),
    "a length of 65536": frame(_WIDE + b"\x04" + b"\x0a\0\x01\0\0" + bytes(40)),
    "a length of 2^31": frame(_WIDE + b"\x04" + b"\x0a\x80\0\0\0" + bytes(40)),
    "lengths of 200 octets": frame(_WIDE + b"\xc8" + b"\x04" + bytes(199) + b"\x0a" + UUID),
    "the 2024 form": frame(bytes.fromhex("03050001010101") + b"\x04\x10" + bytes(16)),
    "the TEDSID alone": frame(_HEAD),
}


def _provisioned_with(desk: Desk, meta: bytes, *, stored: bool) -> tuple[bool, int | None]:
    """What a commit with this Meta-TEDS gets, as the second owner of a session; ``stored``: it lies there before."""
    if not stored:
        desk.agree().open()
        reply = desk.commit({(0, 1): meta})
        return reply.ok, reply.reason
    desk.agree().open()
    reply = desk.commit({}, desk.signed({(0, 1): meta}))
    return reply.ok, reply.reason


@pytest.mark.parametrize("stored", [False, True], ids=["staged", "stored"])
@pytest.mark.parametrize("what", METAS)
def test_the_uuid_of_a_meta_teds_is_looked_for_alike(what: str, stored: bool) -> None:
    blocks = {(0, 1): METAS[what]} if stored else {}
    mine = _provisioned_with(Desk(blocks=blocks), METAS[what], stored=stored)
    assert _provisioned_with(CDesk(blocks=blocks), METAS[what], stored=stored) == mine


# -- Channel TEDS ------------------------------------------------------------------------------------------------------

_CHANNEL = bytes.fromhex("030400030101")
_BODY = bytes.fromhex("0b0100" + "1209" + "280100" + "290102" + "2a0108")


def _period(seconds: float) -> bytes:
    return _BODY + b"\x17\x04" + struct.pack(">f", seconds)


CHANNEL_TEDS = {
    "good": frame(_CHANNEL + _BODY),
    "the 2024 form": frame(bytes.fromhex("030500ff030201") + _BODY),
    "lengths of 2 octets": frame(
        bytes.fromhex("030400030102" + "0b000100" + "12000c" + "28000100" + "29000102" + "2a000108")
    ),
    "lengths of 9 octets": frame(bytes.fromhex("030400030109") + _BODY),
    "lengths of 0 octets": frame(bytes.fromhex("030400030100") + _BODY),
    "too short": frame(_CHANNEL),
    "no kind": frame(_CHANNEL + _BODY[3:]),
    "a kind of 2 octets": frame(_CHANNEL + bytes.fromhex("0b020000") + _BODY[3:]),
    "a kind of 0 octets": frame(_CHANNEL + bytes.fromhex("0b00") + _BODY[3:]),
    "a kind of 4 octets": frame(_CHANNEL + bytes.fromhex("0b0400000000") + _BODY[3:]),
    "a kind of 256": frame(_CHANNEL + bytes.fromhex("0b020100") + _BODY[3:]),
    "a halt of 2 octets": frame(_CHANNEL + _BODY + bytes.fromhex("24020000")),
    "a halt, of a sensor": frame(_CHANNEL + _BODY + bytes.fromhex("240101")),
    "a model of 2 octets": frame(_CHANNEL + bytes.fromhex("0b0100" + "120a" + "28020000" + "290102" + "2a0108")),
    "a width of 2 octets": frame(_CHANNEL + bytes.fromhex("0b0100" + "120a" + "280100" + "29020002" + "2a0108")),
    "a part that runs past its end": frame(_CHANNEL + bytes.fromhex("0b0100" + "1209280100" + "290102" + "2a0908")),
    "one that runs past the end": frame(_CHANNEL + _BODY + b"\x17\x05\0\0\0\0"),
    "an octet too many": frame(_CHANNEL + _BODY + b"\x17"),
    "a period of 2 octets": frame(_CHANNEL + _BODY + b"\x17\x02\0\0"),
    "a period of 10 ms": frame(_CHANNEL + _period(0.01)),
    "a period of 1 ms": frame(_CHANNEL + _period(0.001)),
    "a period of 10^-30 s": frame(_CHANNEL + _period(1e-30)),
    "a period of 10^7 s": frame(_CHANNEL + _period(1e7)),
    "a period of 200 s": frame(_CHANNEL + _period(200.0)),
    "a period of 2^19 s": frame(_CHANNEL + _period(2.0**19)),
    "a period below 0": frame(_CHANNEL + _period(-1.0)),
    "a period of 0": frame(_CHANNEL + _period(0.0)),
    "no number": frame(_CHANNEL + _period(float("nan"))),
    "infinite": frame(_CHANNEL + _period(float("inf"))),
}


@pytest.mark.parametrize("what", CHANNEL_TEDS)
def test_a_channel_teds_fits_both_or_neither(what: str) -> None:
    answers = []
    for bench in (Bench(teds={(1, 3): CHANNEL_TEDS[what]}), CBench(teds={(1, 3): CHANNEL_TEDS[what]})):
        bench.open()
        reasons = [bench.reason(operate(1))]
        if reasons == [None]:
            reasons += [bench.reason(subscribe(period=period * MS)) for period in (9, 10, 11, 200_000, 524_289)]
        answers.append(reasons)
    assert answers[0] == answers[1]


def test_an_actuator_halts_as_its_teds_says() -> None:
    facts = channels()[4]
    for halt in (facts.halt, None, (facts.halt or 0) + 1):
        reasons = []
        for made in (Bench, CBench):
            bench = made(teds={(4, 3): channel_teds(facts, halt=halt)})
            bench.open()
            reasons.append(bench.reason(operate(4, dead_man=500)))
        assert reasons[0] == reasons[1]


def test_the_node_key_of_the_desk_is_the_one_that_is_signed() -> None:
    """Else every block above were refused for that alone."""
    assert NODE.point in security.decode_block(good_block()).node_key
