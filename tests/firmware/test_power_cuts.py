"""The power fails at every step of flash of every transaction, clean and torn: the old state or the new one, whole."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from teds_provision.protocol.keys import fingerprint
from teds_provision.protocol.messages.frames import Command, Function, Reason, Reply, decode_reply, security_command
from teds_provision.protocol.wire_agreement import StationAgreement
from teds_provision.teds.image import SECURITY
from tests.firmware.desk import CDesk
from tests.protocol.desk import CREDENTIALS, META, NAME, NODE, UUID

pytestmark = pytest.mark.system

FLASH, TORN_IDENTITY = -2, -4
IDENTITY = 256
Act = Callable[[CDesk], Reply]


def confirm(desk: CDesk) -> Reply:
    """Request and Confirm at the reader; what Confirm got."""
    agreement = StationAgreement(CREDENTIALS, UUID)
    reply = desk.plain(agreement.request())
    flash = desk.flash
    agreed = agreement.accept(reply.payload, flash.security_teds(), pinned=fingerprint(NODE.point), epoch=flash.epoch)
    done = desk.plain(agreed.confirm)
    if done.ok:
        desk.key = agreed.key
    return done


def commit(desk: CDesk) -> Reply:
    """Do everything from Open to Update, as far as the node answers."""
    desk.open()
    blocks = {(0, 1): META, (1, 12): NAME}
    security = desk.signed(blocks)
    for block, teds in {**blocks, SECURITY: security}.items():
        staged = desk.stage(block, teds)
        if not staged.ok:
            return staged
    return desk.sealed(Command(0, 1, 4, b"\x80"))


def reset(desk: CDesk) -> Reply:
    desk.open()
    return desk.sealed(security_command(Function.RESET, bytes(32)))


def address(desk: CDesk) -> Reply:
    desk.now += 11
    done = desk.plain(security_command(Function.SET_CAN_ADDRESS, bytes([desk.flash.can_address % 239 + 1])))
    desk.node.reply_sent("nfc")
    return done


def by_hand(desk: CDesk) -> Reply:
    failed = desk.node._library.memory_by_hand(desk.node._board)
    return Reply(failed == 0)


def keyed(desk: CDesk) -> None:
    assert confirm(desk).ok


def provisioned(desk: CDesk) -> None:
    keyed(desk)
    assert commit(desk).ok


BEFORE: dict[str, Callable[[CDesk], None]] = {
    "a first key": lambda desk: None,
    "a rotation": provisioned,
    "a first datasheet": keyed,
    "another datasheet": provisioned,
    "a reset": provisioned,
    "a reset by hand": provisioned,
    "an address": provisioned,
}
ACTS: dict[str, Act] = {
    "a first key": confirm,
    "a rotation": confirm,
    "a first datasheet": commit,
    "another datasheet": commit,
    "a reset": reset,
    "a reset by hand": by_hand,
    "an address": address,
}


@pytest.mark.parametrize("torn", [False, True], ids=["clean", "torn"])
@pytest.mark.parametrize("what", list(ACTS))
@pytest.mark.parametrize(("unit", "erased"), [(32, 0xFF)], ids=["units of 32"])
def test_there_is_the_old_state_or_the_new_one(what: str, torn: bool, unit: int, erased: int) -> None:
    desk = CDesk(unit=unit, erased=erased)
    BEFORE[what](desk)
    desk.node.poll()
    desk.restart()
    image, key, old, old_key = desk.node.image, desk.key, desk.shown(), desk.key
    ACTS[what](desk)
    new, new_key = desk.shown(), desk.key
    desk.node.poll()
    outcomes = []
    for step in range(1, 400):
        desk.node.image, desk.key = image, key
        desk.restart()
        desk.node.cut(step, torn=torn)
        try:
            done = ACTS[what](desk)
        except AssertionError:
            done = Reply(False)
        desk.node.poll()  # the old slot is erased when the reply has left
        cut = desk.node.dead
        if cut:
            desk.node.cut(0, torn=False)
            desk.restart()
        now = desk.shown()
        assert now in (old, new), f"step {step}"
        is_new = now != old
        assert is_new or not done.ok, f"step {step}: a good reply, and the old state"
        if old_key and is_new and what in ("a rotation", "a reset", "a reset by hand"):
            assert old_key not in desk.node.image, f"step {step}: the old key lies in flash"
        assert not desk.node.misused
        outcomes.append(is_new)
        if not cut:
            break
    else:
        pytest.fail("it never came to its end")
    assert outcomes == sorted(outcomes), "once it is the new one it stays"
    assert outcomes[-1] is True
    assert False in outcomes
    assert new_key == key or what in ("a first key", "a rotation")
    desk.node.close()


@pytest.mark.parametrize("torn", [False, True], ids=["clean", "torn"])
@pytest.mark.parametrize("unit", [4, 32])
def test_the_very_first_start_may_be_cut_anywhere(unit: int, torn: bool) -> None:
    """No identity was shown yet: the next start begins again, cut as often as the power likes."""
    desk = CDesk(unit=unit)
    blank = bytes([0xFF]) * len(desk.node.image)
    for step in range(1, 200):
        desk.node.image = blank
        desk.node.start_cut(step, torn=torn)
        cut = desk.node.dead
        desk.node.start_cut(step // 2 + 1, torn=torn)
        assert desk.node.start() == 0, f"step {step}"
        assert desk.node.identity().uuid == UUID
        assert not desk.node.misused
        identity = desk.node.image[:IDENTITY]
        assert desk.node.start() == 0
        assert desk.node.image[:IDENTITY] == identity
        if not cut:
            break
    else:
        pytest.fail("it never came to its end")
    desk.node.close()


@pytest.mark.parametrize("octet", [0, 20, 60, 191])
def test_an_identity_that_was_shown_is_never_replaced(octet: int) -> None:
    """A factory node's too: what it has shown may be pinned somewhere."""
    desk = CDesk()
    assert desk.node.start() == 0
    desk.node.image = _with(desk.node.image, octet, desk.node.image[octet] ^ 1)
    assert desk.node.start() == TORN_IDENTITY
    desk.node.close()


def _with(image: bytes, at: int, octet: int) -> bytes:
    return image[:at] + bytes([octet]) + image[at + 1 :]


def test_a_spare_slot_that_cannot_be_erased_stops_no_good_node() -> None:
    """It answers, and refuses each change of its state with 11; when erasing works again, all works."""
    desk = CDesk()
    provisioned(desk)
    desk.node.poll()
    before = desk.shown()
    spare = next(at for at in (IDENTITY, (IDENTITY + len(desk.node.image)) // 2) if desk.node.image[at] == 0xFF)
    desk.node.image = _with(desk.node.image, spare + 100, 0)
    desk.node.fails(True)
    for _ in range(2):
        assert desk.node.start() == 0
        assert desk.node.spare_slot_fails
        assert desk.shown() == before
    desk.open()
    assert desk.stage((1, 12), NAME).reason == Reason.FLASH_FAILURE
    assert desk.sealed(security_command(Function.RESET, bytes(32))).reason == Reason.FLASH_FAILURE
    desk.now += 11
    assert desk.sealed(security_command(Function.SET_CAN_ADDRESS, b"\x21")).reason == Reason.FLASH_FAILURE
    assert desk.shown() == before
    desk.node.fails(False)
    assert desk.stage((1, 12), NAME).ok
    assert not desk.node.spare_slot_fails
    assert desk.sealed(security_command(Function.RESET, bytes(32))).ok
    desk.node.close()


def test_without_a_whole_slot_a_spare_that_cannot_be_erased_stops_the_node() -> None:
    desk = CDesk()
    size = len(desk.node.image)
    desk.node.image = b"".join((desk.node.image[:IDENTITY], b"\0" * (size - IDENTITY)))
    desk.node.fails(True)
    assert desk.node.start() == FLASH
    desk.node.close()


@pytest.mark.parametrize("act", ["a first key", "another datasheet", "a reset", "an address"])
def test_what_flash_took_and_reads_back_as_something_else_does_not_count(act: str) -> None:
    """It accepts each unit, and one bit of one of them is another: 11, and the old state, after a restart, too."""
    desk = CDesk()
    BEFORE[act](desk)
    desk.node.poll()
    desk.restart()
    image, key, old = desk.node.image, desk.key, desk.shown()
    desk.node.garble(0)
    assert ACTS[act](desk).ok
    units = desk.node.written
    assert units > 20
    for unit in {1, 2, units // 3, units // 2, units - 1, units}:
        desk.node.image, desk.key = image, key
        desk.restart()
        desk.now += 60
        desk.node.garble(unit)
        assert ACTS[act](desk).reason == Reason.FLASH_FAILURE, f"unit {unit}"
        assert desk.shown() == old
        desk.node.garble(0)
        desk.restart()
        assert desk.shown() == old, f"unit {unit}: after a restart"
    desk.node.close()


@pytest.mark.parametrize(("unit", "erased"), [(4, 0xFF), (8, 0x00), (16, 0xFF), (32, 0x00)])
def test_flash_of_every_kind_is_written_as_it_can_be(unit: int, erased: int) -> None:
    desk = CDesk(unit=unit, erased=erased)
    desk.provision()
    before = desk.shown()
    desk.restart()
    assert desk.shown() == before
    assert not desk.node.misused
    assert decode_reply(desk.node.handle(b"\0\0\x80\x07\0\0", link="nfc", tapped=True)).ok
    desk.node.close()


def test_flash_that_fails_is_refused_with_11_and_changes_nothing() -> None:
    desk = CDesk()
    provisioned(desk)
    desk.node.poll()
    before = desk.shown()
    desk.open()
    desk.node.fails(True)
    assert desk.sealed(security_command(Function.RESET, bytes(32))).reason == 11
    desk.node.fails(False)
    assert desk.shown() == before
    assert desk.sealed(security_command(Function.RESET, bytes(32))).ok
    assert desk.node.identity().state == 0
    desk.node.close()
