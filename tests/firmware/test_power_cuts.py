"""The power fails at every step of flash of every transaction, clean and torn: the old state or the new one, whole."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from teds_provision.protocol.agreement import StationAgreement
from teds_provision.protocol.keys import fingerprint
from teds_provision.protocol.messages.frames import Command, Function, Reply, decode_reply, security_command
from teds_provision.teds.image import SECURITY
from tests.firmware.desk import CDesk
from tests.protocol.desk import CREDENTIALS, META, NAME, NODE, UUID

pytestmark = pytest.mark.system

TORN_IDENTITY = -4
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
    """Everything from Open to Update, as far as the node answers."""
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
    desk.node.reply_left("nfc")
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
def test_at_the_very_first_start_there_is_one_identity_or_none(torn: bool) -> None:
    """A torn identity is told, never replaced by a second key; a blank one is made."""
    desk = CDesk()
    blank = bytes([0xFF]) * len(desk.node.image)
    seen = []
    for step in range(1, 60):
        desk.node.image = blank
        desk.node.start_cut(step, torn=torn)
        cut = desk.node.dead
        again = desk.node.start()
        seen.append(again)
        assert again in (0, TORN_IDENTITY)
        assert again == TORN_IDENTITY or desk.node.identity().uuid == UUID
        if not cut:
            break
    assert seen[-1] == 0
    assert TORN_IDENTITY in seen
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
