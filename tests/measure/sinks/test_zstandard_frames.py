"""Frames of Zstandard beside the library zstandard, cut, flipped and with a wrong length."""

from __future__ import annotations

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.measure.sinks.mcap.zstandard_frames import ZstdError, compress_frame, decompress_frame, zstd


@given(st.binary(max_size=5000))
def test_another_library_reads_our_frames_and_we_read_its(octets: bytes) -> None:
    frame = compress_frame(octets)
    assert zstandard.decompress(frame) == octets == decompress_frame(frame, len(octets))
    assert decompress_frame(zstandard.compress(octets, 3), len(octets)) == octets


@given(st.binary(min_size=200, max_size=400), st.data())
def test_a_flipped_bit_is_noticed(octets: bytes, data: st.DataObject) -> None:
    frame = bytearray(compress_frame(octets))
    bit = data.draw(st.integers(0, len(frame) * 8 - 1))
    frame[bit // 8] ^= 1 << bit % 8
    try:
        content = decompress_frame(bytes(frame), len(octets))
    except ZstdError:
        return
    assert content == octets  # a bit that is reserved, or unused in the header


def test_a_cut_frame_and_a_longer_content_are_refused() -> None:
    frame = compress_frame(b"values" * 1000)
    for cut in range(len(frame)):
        with pytest.raises(ZstdError):
            decompress_frame(frame[:cut], 6000)
    with pytest.raises(ZstdError):
        decompress_frame(frame, 5999)
    with pytest.raises(ZstdError):
        decompress_frame(zstd.compress(bytes(1 << 26), 19), 100)


def test_octets_behind_the_frame_are_ignored() -> None:
    assert decompress_frame(compress_frame(b"first") + compress_frame(b"second") + b"rest", 5) == b"first"


def test_an_empty_content_is_a_frame_too() -> None:
    assert decompress_frame(compress_frame(b""), 0) == b""
