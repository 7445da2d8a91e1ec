"""Commands over BLE: frames both ways, and whatever else arrives (profile: wire, "BLE")."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.protocol.messages.ble import BleAssembly, ReceivedMessage, cut, piece_octets


@pytest.mark.parametrize(("mtu", "octets"), [(23, 14), (247, 238), (515, 506), (517, 506), (1000, 506), (5, 14)])
def test_a_piece_has_at_most_what_an_attribute_value_holds(mtu: int, octets: int) -> None:
    assert piece_octets(mtu) == octets


@given(st.integers(0, 0xFFFF), st.binary(max_size=4094), st.integers(23, 517))
def test_messages_are_cut_and_put_together(transaction: int, message: bytes, mtu: int) -> None:
    frames, assembly = list(cut(transaction, message, mtu)), BleAssembly(4094)
    assert [assembly.add_frame(frame) for frame in frames] == [None] * (len(frames) - 1) + [
        ReceivedMessage(transaction, message)
    ]
    assert all(len(frame) <= min(mtu - 3, 512) for frame in frames)


def test_frames_as_they_stand_on_the_air() -> None:
    frames = list(cut(0x1234, bytes(range(20)), 23))
    assert [frame.hex() for frame in frames] == [
        "123400140000" + bytes(range(14)).hex(),
        "12340014000e" + bytes(range(14, 20)).hex(),
    ]


@pytest.mark.parametrize(
    "fault", ["missing", "doubled", "swapped", "other transaction", "other total", "too much", "too short"]
)
def test_a_frame_that_does_not_continue_drops_its_message_and_no_other(fault: str) -> None:
    message = bytes(range(60))
    frames, assembly = list(cut(7, message, 23)), BleAssembly(1024)
    hurt = list(frames)
    match fault:
        case "missing":
            del hurt[2]
        case "doubled":
            hurt.insert(2, hurt[2])
        case "swapped":
            hurt[2], hurt[3] = hurt[3], hurt[2]
        case "other transaction":
            hurt[2] = bytes([0, 8]) + hurt[2][2:]
        case "other total":
            hurt[2] = hurt[2][:3] + bytes([61]) + hurt[2][4:]
        case "too short":
            hurt.insert(2, hurt[2][:5])
        case _:
            hurt[-1] += bytes(9)
    assert not [found for frame in hurt if (found := assembly.add_frame(frame)) is not None]
    assert [assembly.add_frame(frame) for frame in frames][-1] == ReceivedMessage(7, message)


def test_a_message_too_long_is_never_begun() -> None:
    assembly = BleAssembly(1024)
    assert not [found for frame in cut(1, bytes(1025), 247) if (found := assembly.add_frame(frame)) is not None]
    assert [assembly.add_frame(frame) for frame in cut(2, bytes(1024), 247)][-1] == ReceivedMessage(2, bytes(1024))


@given(st.lists(st.binary(max_size=40), max_size=20))
def test_junk_makes_no_message_of_another_length(frames: list[bytes]) -> None:
    assembly = BleAssembly(100)
    for frame in frames:
        found = assembly.add_frame(frame)
        assert found is None or len(found.message) == int.from_bytes(frame[2:4], "big")
