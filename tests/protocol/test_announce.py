"""Announce and the claim of addresses: octets, each rule, and whole buses of random nodes that sort themselves out."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.protocol.announce import AddressClaim, Announce, default_can_address, is_announce, uuid_crc


def soon(low: float, high: float) -> float:
    return low


def test_an_announce_has_the_octets_of_the_page() -> None:
    announce = Announce(0x21, 2, uuid_crc(b"123456789"))
    assert announce.identifier == 0x1CFF0021
    assert announce.encode().hex() == "0102cbf439260000"  # the check value of CRC-32 of IEEE 802.3


@given(st.integers(1, 239), st.integers(0, 2), st.integers(0, 2**32 - 1), st.booleans())
def test_what_is_encoded_is_decoded(address: int, state: int, crc: int, pressed: bool) -> None:
    announce = Announce(address, state, crc, pressed)
    assert Announce.decode(announce.identifier, announce.encode()) == announce


@given(st.integers(0, 2**29 - 1), st.binary(max_size=64))
def test_no_frame_is_taken_for_an_announce_that_is_none(identifier: int, data: bytes) -> None:
    announce = Announce.decode(identifier, data)
    assert announce is None or (announce.identifier == identifier and announce.encode()[:6] == data[:6])


@pytest.mark.parametrize(
    ("identifier", "data"),
    [
        (0x1CFF0000, "0100000000010000"),  # the address of no station
        (0x1CFF00F0, "0100000000010000"),  # a station's address
        (0x1CFF2021, "0100000000010000"),  # a data frame
        (0x1CFF0021, "0200000000010000"),  # another version
        (0x1CFF0021, "0103000000010000"),  # no such state
        (0x1CFF0021, "01000000000100"),
    ],
)
def test_other_frames_are_none(identifier: int, data: str) -> None:
    assert Announce.decode(identifier, bytes.fromhex(data)) is None


def test_the_default_address_of_a_node_follows_from_its_uuid() -> None:
    assert [default_can_address(uuid) for uuid in (b"123456789", bytes(10))] == [55, 21]


@pytest.mark.parametrize(
    ("identifier", "is_one"),
    [(0x1CFF0021, True), (0x1CFF00FF, True), (0x1CFF2021, False), (0x1CFE0021, False), (0x18DA21F1, False)],
)
def test_an_announce_is_known_by_its_identifier(identifier: int, is_one: bool) -> None:
    assert is_announce(identifier) is is_one


def test_the_first_announce_waits_up_to_half_a_second_and_leaves_once() -> None:
    claim = AddressClaim(5, uniform=lambda low, high: high)
    claim.start(10.0)
    assert claim.due(10.0) == 10.5
    claim.announced(10.5)
    assert claim.due(10.5) is None


def test_the_smaller_crc_stays_and_announces_again() -> None:
    claim = AddressClaim(5, uniform=lambda low, high: high)
    assert claim.handle_announce(Announce(33, 0, 6), 33, 1.0) == 33
    assert claim.due(1.0) == 1.05


def test_the_greater_crc_moves_to_the_next_address_that_it_has_not_heard() -> None:
    claim = AddressClaim(6, uniform=soon)
    for source in (239, 1, 3):
        claim.hear(source)
    assert claim.handle_announce(Announce(238, 0, 5), 238, 1.0) == 2
    assert claim.due(1.0) == 1.0


def test_239_is_an_address_like_another_and_followed_by_1() -> None:
    claim = AddressClaim(6, uniform=soon)
    assert claim.handle_announce(Announce(238, 0, 5), 238, 1.0) == 239
    assert claim.handle_announce(Announce(239, 0, 5), 239, 1.0) == 1


def test_with_an_actuator_claimed_it_stays_and_announces() -> None:
    claim = AddressClaim(6, uniform=soon)
    assert claim.handle_announce(Announce(33, 0, 5), 33, 1.0, pinned=True) == 33
    assert claim.due(1.0) == 1.0


def test_other_addresses_and_equal_crcs_move_no_node() -> None:
    claim = AddressClaim(6, uniform=soon)
    assert claim.handle_announce(Announce(34, 0, 5), 33, 1.0) == 33
    assert not claim.conflict
    assert claim.handle_announce(Announce(33, 0, 6), 33, 1.0) == 33
    assert claim.conflict
    assert claim.due(1.0) is None


def test_an_address_from_which_an_announce_came_is_taken() -> None:
    claim = AddressClaim(6, uniform=soon)
    claim.handle_announce(Announce(34, 0, 5), 33, 1.0)
    assert claim.handle_announce(Announce(33, 0, 5), 33, 1.0) == 35


def test_a_pressed_button_claims_no_address() -> None:
    claim = AddressClaim(6, uniform=soon)
    for crc in (5, 6, 7):
        assert claim.handle_announce(Announce(33, 0, crc, pressed=True), 33, 1.0) == 33
    assert (claim.due(1.0), claim.conflict) == (None, False)


def test_at_most_twenty_announces_a_minute() -> None:
    claim, left = AddressClaim(5, uniform=soon), 0
    for attempt in range(100):
        claim.handle_announce(Announce(33, 0, 6), 33, attempt * 0.1)
        if claim.due(attempt * 0.1) is not None:
            claim.announced(attempt * 0.1)
            left += 1
    assert left == 20
    claim.handle_announce(Announce(33, 0, 6), 33, 60.05)
    assert claim.due(60.05) == 60.05


def forge(claim: AddressClaim, own: int, now: float) -> int:
    """Return the address after an Announce of a smaller CRC from the node's own address."""
    return claim.handle_announce(Announce(own, 0, 1), own, now)


def test_forged_announces_move_a_node_less_and_less() -> None:
    """Each move ends the sessions there, and an Announce proves nothing."""
    claim, own, now = AddressClaim(6, uniform=soon), 33, 0.0
    for moves in range(1, 4):
        own = forge(claim, own, now)
        assert (own, claim.move_due) == (33 + moves, None)
    for wait in (1, 2, 4, 8, 16, 32, 60, 60):
        claim.due(now)
        claim.announced(now)
        assert forge(claim, own, now) == own
        assert forge(claim, own, now + 0.5) == own
        assert claim.due(now) is None, "it leaves the address to the other one, and announces where it goes"
        assert claim.move_due == now + wait
        now += wait
        moved = claim.move(own, now)
        assert moved == own + 1
        assert claim.due(now) == now
        own = moved
    now += 600.0
    for move in range(4):
        moved = forge(claim, own, now)
        assert (moved != own) is (move < 3), "ten minutes without a conflict"
        own = moved
    for conflict in (Announce(own, 1, 7), Announce(own, 1, 5)):  # one that the node wins is a conflict as well
        now += 599.0
        assert claim.handle_announce(conflict, own, now) == own


@pytest.mark.parametrize(("quiet", "moves"), [(599.9, False), (600.0, True)])
def test_ten_minutes_without_a_conflict_forget_the_moves(quiet: float, moves: bool) -> None:
    claim, own = AddressClaim(6, uniform=soon), 33
    for _ in range(3):
        own = forge(claim, own, 7.0)
    assert (forge(claim, own, 7.0 + quiet) != own) is moves


@pytest.mark.parametrize(("after", "leaves"), [(59.9, False), (60.0, True)])
def test_a_place_among_the_twenty_is_free_again_after_a_minute(after: float, leaves: bool) -> None:
    claim = AddressClaim(5, uniform=soon)
    for second in range(20):
        claim.handle_announce(Announce(33, 0, 6), 33, float(second))
        assert claim.due(float(second)) == second
        claim.announced(float(second))
    claim.handle_announce(Announce(33, 0, 6), 33, after)
    assert (claim.due(after) == after) is leaves


def test_a_move_that_waits_is_none_with_an_actuator_claimed_or_once_the_address_was_set() -> None:
    claim = AddressClaim(6, uniform=soon)
    for _ in range(4):
        forge(claim, 33, 0.0)
    assert claim.move(33, 1.0, pinned=True) == 33
    assert (claim.due(1.0), claim.move_due) == (1.0, None)
    forge(claim, 33, 2.0)
    claim.relocated()
    assert claim.move_due is None


def bus_of(nodes: int, seed: int, addresses: int = 239) -> list[int]:
    """Addresses of ``nodes`` on one bus once nobody announces any more."""
    dice = random.Random(seed)
    crcs = dice.sample(range(2**32), nodes)
    claims = [AddressClaim(crc, uniform=dice.uniform) for crc in crcs]
    at = [1 + crc % addresses for crc in crcs]
    for claim in claims:
        claim.start(0.0)
    for _ in range(100 * nodes):
        pending = [(due, True, index) for index, claim in enumerate(claims) if (due := claim.due(0.0)) is not None]
        pending += [(due, False, index) for index, claim in enumerate(claims) if (due := claim.move_due) is not None]
        if not pending:
            break
        now, speaks, speaker = min(pending)
        if not speaks:
            at[speaker] = claims[speaker].move(at[speaker], now)
            continue
        claims[speaker].announced(now)
        announce = Announce(at[speaker], 0, crcs[speaker])
        for index, claim in enumerate(claims):
            if index != speaker:
                at[index] = claim.handle_announce(announce, at[index], now)
    return at


@settings(deadline=None, max_examples=60)
@given(st.integers(2, 60), st.integers(0, 2**32))
def test_nodes_with_random_addresses_sort_themselves_out(nodes: int, seed: int) -> None:
    at = bus_of(nodes, seed)
    assert len(set(at)) == nodes
    assert all(1 <= address <= 239 for address in at)


@pytest.mark.parametrize("seed", range(5))
def test_even_200_nodes_and_16_on_one_address_sort_themselves_out(seed: int) -> None:
    assert len(set(bus_of(200, seed))) == 200
    assert len(set(bus_of(16, seed, addresses=1))) == 16
