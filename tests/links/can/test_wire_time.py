"""How long a CAN frame takes on the wire, by a model that writes out its bits; and which request is worth a try."""

from __future__ import annotations

import random
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.links.can import link as link_module
from teds_provision.links.can.link import _Exchange
from teds_provision.links.can.pacing import Wire, classic_bits, fd_seconds

LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
IDENTIFIERS = (0, 0x1FFFFFFF, 0x18DA21F1, 0x1CFF0021, 0x15555555)


def _bits(value: int, width: int) -> str:
    return f"{value:0{width}b}"


def _stuffed(bits: str) -> list[int]:
    """Return the places behind which ISO 11898-1 puts a stuff bit: after five equal bits, stuff bits among them."""
    places, last, run = [], "", 0
    for place, bit in enumerate(bits):
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            places.append(place)
            last, run = ("0" if bit == "1" else "1"), 1
    return places


def _crc15(bits: str) -> int:
    crc = 0
    for bit in bits:
        crc = (crc << 1 ^ (0x4599 if (crc >> 14 & 1) != int(bit) else 0)) & 0x7FFF
    return crc


def _classic(identifier: int, data: bytes) -> int:
    """SOF, 11 bits, SRR, IDE, 18 bits, RTR, r1, r0, DLC, data, CRC; then 3 delimiters and ACK, EOF, intermission."""
    head = "0" + _bits(identifier >> 18, 11) + "11" + _bits(identifier & 0x3FFFF, 18) + "000" + _bits(len(data), 4)
    body = head + "".join(_bits(octet, 8) for octet in data)
    body += _bits(_crc15(body), 15)
    return len(body) + len(_stuffed(body)) + 3 + 7 + 3


def _fd(identifier: int, data: bytes, bitrate: int, data_bitrate: int) -> float:
    """Up to BRS slow, from ESI to the CRC fast; CRC of 17 bits up to 16 octets, 21 beyond, with fixed stuff bits."""
    length = min(size for size in LENGTHS if size >= len(data))
    slow = "0" + _bits(identifier >> 18, 11) + "11" + _bits(identifier & 0x3FFFF, 18) + "0101"
    fast = "0" + _bits(LENGTHS.index(length), 4) + "".join(_bits(octet, 8) for octet in data.ljust(length, b"\xcc"))
    stuff = _stuffed(slow + fast)
    in_slow = len([place for place in stuff if place < len(slow)])
    crc = 4 + (17 if length <= 16 else 21)  # with the stuff count and its parity
    slow_bits = len(slow) + in_slow + 3 + 7 + 3
    return slow_bits / bitrate + (len(fast) + len(stuff) - in_slow + crc + 1 + crc // 4) / data_bitrate


def _datas(lengths: range) -> list[bytes]:
    dice = random.Random(4)
    return [bytes(n) for n in lengths] + [b"\xff" * n for n in lengths] + [dice.randbytes(n) for n in lengths]


@pytest.mark.parametrize("identifier", IDENTIFIERS)
def test_a_classic_frame_takes_its_bits_with_stuff_bits(identifier: int) -> None:
    for data in _datas(range(9)):
        assert classic_bits(identifier, data) == _classic(identifier, data), data.hex()


@pytest.mark.parametrize("identifier", IDENTIFIERS)
def test_an_fd_frame_is_slow_at_its_ends_and_fast_between(identifier: int) -> None:
    for data in _datas(range(0, 65, 3)) + _datas(range(8, 21)):
        assert fd_seconds(identifier, data, 500_000, 2_000_000) == pytest.approx(
            _fd(identifier, data, 500_000, 2_000_000), abs=1e-12
        ), data.hex()
    assert fd_seconds(identifier, b"", 1, 10**9) > 40
    assert fd_seconds(identifier, bytes(64), 10**9, 1) > 550


@pytest.mark.parametrize(
    ("begun", "prompt", "tries", "refused", "passed", "worth"),
    [
        (True, False, 1, 0, 9.9, True), (True, False, 3, 9, 9.9, True), (True, False, 3, 0, 10.0, False),
        (False, True, 1, 9, 9.9, True), (False, True, 3, 0, 10.0, False),
        (False, False, 3, 2, 99.0, True), (False, False, 3, 3, 1.9, True), (False, False, 3, 3, 2.0, False),
        (False, False, 1, 0, 0.0, False), (False, False, 2, 1, 99.0, True), (False, False, 2, 2, 99.0, False),
    ],
)  # fmt: skip
def test_a_request_that_never_went_out_whole_is_worth_another_try(
    monkeypatch: pytest.MonkeyPatch, begun: bool, prompt: bool, tries: int, refused: int, passed: float, worth: bool
) -> None:
    """Once it has begun, or in a prompt exchange, while it may take longer; else by its tries or first seconds."""
    monkeypatch.setattr(link_module, "time", SimpleNamespace(monotonic=lambda: 100.0 + passed))
    rig: Any = SimpleNamespace(_prompt=prompt, _longest=10.0, _tries=tries, _seconds=2.0)
    assert _Exchange._worth_another(cast("Any", rig), 100.0, refused, begun=begun) is worth


def test_each_bus_has_a_wire_of_its_own_that_all_its_senders_share_until_the_last_has_gone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("teds_provision.links.can.pacing.tempfile.gettempdir", lambda: str(tmp_path))
    one, again, other = Wire("239.0.0.1:5"), Wire("239.0.0.1:5"), Wire("239.0.0.2:5")
    assert len(list(tmp_path.iterdir())) == 2
    assert {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()} == {0o600}
    assert one.occupy(100.0, 0.5) == 100.5
    assert again.occupy(100.25, 0.5) == 101.0, "as soon as it is free"
    assert other.occupy(100.25, 0.5) == 100.75
    assert one.occupy(200.0, 0.25) == 200.25
    assert (one.busy_seconds, again.busy_seconds, other.busy_seconds) == (1.25, 1.25, 0.5)
    one.close()
    other.close()
    other.close()
    assert len(list(tmp_path.iterdir())) == 1
    assert again.occupy(200.0, 1.0) == 201.25
    again.close()
    assert list(tmp_path.iterdir()) == []
    new = Wire("239.0.0.1:5")
    assert (new.busy_seconds, new.occupy(1.0, 0.5)) == (0.0, 1.5), "nothing is left of those before"
    assert new.occupy(100.0, 0.5) == 100.5
    assert new.occupy(90.25, 0.5) == 90.75, "of before a restart of the clock: so long is no queue"
    assert new.occupy(81.0, 0.5) == 91.25
    new.close()
