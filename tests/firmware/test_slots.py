"""Slots of the node in C: what fits one, which one is torn, and when the old one is erased (firmware.md, section 6)."""

from __future__ import annotations

import zlib
from collections.abc import Iterator

import pytest

from teds_provision.links.can.isotp import physical_id
from teds_provision.protocol.flash import Flash
from tests.firmware.desk import ADDRESS, CDesk
from tests.firmware.test_power_cuts import FLASH, IDENTITY, TORN_IDENTITY, confirm, keyed, provisioned
from tests.protocol.desk import NODE, UUID

pytestmark = pytest.mark.system

ASKS_WHO_IT_IS = bytes.fromhex("07 0000 0080 070000")
STRANGER = 0xF3


@pytest.fixture
def desk() -> Iterator[CDesk]:
    yield CDesk()
    CDesk.close_all()


def rotated(desk: CDesk) -> bytes:
    """Give the node another key; return the one before it, which is still in the old slot."""
    keyed(desk)
    desk.node.poll()
    desk.restart()
    key = desk.key
    assert confirm(desk).ok
    assert key in desk.node.image
    return key


# -- the old slot ------------------------------------------------------------------------------------------------------


def test_the_old_key_is_erased_as_soon_as_no_reply_waits(desk: CDesk) -> None:
    key = rotated(desk)
    desk.node.poll()
    assert key not in desk.node.image


def test_a_reply_that_waits_keeps_the_old_key_15_seconds_and_no_longer(desk: CDesk) -> None:
    """A stranger asks again and again, and never takes the reply."""
    key = rotated(desk)
    began = desk.now

    def ask(seconds: float) -> int:
        desk.now = began + seconds
        transaction = round(seconds * 10) & 0xFF
        desk.node.take_frame(
            physical_id(ADDRESS, STRANGER), ASKS_WHO_IT_IS[:1] + bytes([transaction]) + ASKS_WHO_IT_IS[2:]
        )
        while desk.node.next_frame() is not None:
            pass
        return desk.node.poll()

    for tenth in range(0, 150, 5):
        assert ask(tenth / 10) <= round((began + 15) * 10**9)
        assert key in desk.node.image
    ask(14.999)
    assert key in desk.node.image
    ask(15)
    assert key not in desk.node.image


def test_an_answer_to_everyone_that_waits_keeps_no_old_key(desk: CDesk) -> None:
    """Any stranger could have one wait at any time."""
    keyed(desk)
    desk.node.take_frame(0x18DBFF00 | STRANGER, ASKS_WHO_IT_IS)
    desk.now += 0.05
    desk.node.poll()
    sent = desk.node.next_frame()
    assert sent is not None
    assert sent[1][0] >> 4 == 1, "a first frame, that waits for flow control"
    key = desk.key
    assert confirm(desk).ok
    assert key in desk.node.image
    desk.node.poll()
    assert key not in desk.node.image


def test_flash_is_left_alone_where_nothing_is_to_be_erased(desk: CDesk) -> None:
    """After the very first start, and once the old slot is blank."""
    desk.node.image = bytes([0xFF]) * len(desk.node.image)
    desk.restart()
    assert desk.node.can_address == 192, "1 + CRC-32(UUID) mod 239"
    for _ in range(2):
        desk.node.cut(0, torn=False)
        desk.node.poll()
        assert desk.node.steps == 0
        keyed(desk)
        desk.node.poll()


# -- what fits, and what is torn ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("octets", "fits"), [(4352, True), (4353, False)])
def test_a_slot_may_be_full_to_its_last_octet(desk: CDesk, octets: int, fits: bool) -> None:
    """192 octets of head, 8 and the TEDS for each record, 4 of CRC, in whole units (8 here)."""
    spare = 192 + 4 + 129 * (8 + 24) + 8
    blocks = {(0, 1): bytes(octets - spare), **{(channel, 12): bytes(24) for channel in range(1, 130)}}
    desk.node.has_slots_of(4352)
    desk.restart()
    flash = Flash(UUID, NODE.point, b"", blocks=blocks, can_address=ADDRESS)
    if not fits:
        with pytest.raises(AssertionError):
            desk.node.put(flash)
        return
    desk.node.put(flash)
    assert set(desk.node.blocks()) == {*blocks, (0, 128)}
    desk.restart()
    assert desk.node.blocks()[0, 1] == blocks[0, 1]


def in_use(image: bytes) -> tuple[int, int]:
    """Return where the slot that counts begins, and the other one."""
    slots = IDENTITY, IDENTITY + (len(image) - IDENTITY) // 2
    first = image[slots[0] : slots[0] + 4] == b"TSLT"
    return slots if first else slots[::-1]


def test_a_torn_slot_of_any_form_is_erased_and_a_torn_identity_of_any_form_stops_the_start(desk: CDesk) -> None:
    """A form counts only under a good CRC."""
    provisioned(desk)
    desk.node.poll()
    image = desk.node.image
    at, spare = in_use(image)
    octets = int.from_bytes(image[at + 12 : at + 16], "big")
    torn = image[at : at + 4] + b"\2" + image[at + 5 : at + octets]
    desk.node.image = image[:spare] + torn + image[spare + octets :]
    desk.restart()
    assert desk.node.image == image
    desk.node.image = wrong = image[:4] + b"\2" + image[5:]
    assert desk.node.start() == TORN_IDENTITY
    assert desk.node.image == wrong
    blank = b"\xff" * ((len(image) - IDENTITY) // 2)
    slot = image[at : at + len(blank)]
    for slots in (slot + blank, blank + slot):
        desk.node.image = wrong[:IDENTITY] + slots
        assert desk.node.start() == TORN_IDENTITY, "it was shown, so it is never made again"


@pytest.mark.parametrize("total", [0, 3, 31, 195, 8193, 1 << 31])
def test_a_slot_whose_length_cannot_be_is_torn(desk: CDesk, total: int) -> None:
    provisioned(desk)
    desk.node.poll()
    image = desk.node.image
    at, spare = in_use(image)
    octets = int.from_bytes(image[at + 12 : at + 16], "big")
    head = image[at : at + 8] + b"\xff" * 4 + total.to_bytes(4, "big") + image[at + 16 : at + octets]
    desk.node.image = image[:spare] + head + image[spare + octets :]
    desk.restart()
    assert desk.node.image == image


def test_records_that_would_be_longer_than_their_slot_are_torn_under_a_good_crc(desk: CDesk) -> None:
    provisioned(desk)
    desk.node.poll()
    image = desk.node.image
    at, spare = in_use(image)
    octets = int.from_bytes(image[at + 12 : at + 16], "big")
    for length, records, good in ((octets, octets - 196, True), (octets, octets - 195, False), (188, 0, False)):
        body = image[at : at + 8] + b"\x7f" * 4 + length.to_bytes(4, "big") + records.to_bytes(4, "big")
        body += image[at + 20 : at + length - 4]
        slot = body + zlib.crc32(body).to_bytes(4, "big")
        desk.node.image = image[:spare] + slot + image[spare + octets :]
        desk.restart()
        assert in_use(desk.node.image)[0] == (spare if good else at)


def test_of_two_whole_slots_the_higher_counter_counts_and_the_other_one_is_erased(desk: CDesk) -> None:
    provisioned(desk)
    desk.node.poll()
    image = desk.node.image
    at, spare = in_use(image)
    octets = int.from_bytes(image[at + 12 : at + 16], "big")
    counter = int.from_bytes(image[at + 8 : at + 12], "big")
    for other, counts in ((counter - 1, at), (counter + 1, spare)):
        body = image[at : at + 8] + other.to_bytes(4, "big") + image[at + 12 : at + octets - 4]
        slot = body + zlib.crc32(body).to_bytes(4, "big")
        desk.node.image = image[:spare] + slot + image[spare + octets :]
        desk.restart()
        left = desk.node.image
        assert in_use(left) == (counts, at + spare - counts)
        gone = at + spare - counts
        assert left[gone : gone + octets] == b"\xff" * octets


def test_flash_that_takes_an_identity_otherwise_than_it_was_written_is_an_error(desk: CDesk) -> None:
    blank = bytes([0xFF]) * len(desk.node.image)
    for unit in (1, 12, 24):  # the magic, the key, the CRC
        desk.node.image = blank
        desk.node.garble(unit)
        assert desk.node.start() == FLASH
        assert desk.node.image[IDENTITY:] == blank[IDENTITY:], "nothing that would show it was written"
