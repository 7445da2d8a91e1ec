"""What is written is read back, per class and edition; reading and writing again changes no octet."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.errors import BadDataError
from teds_provision.teds.codec.frame import checksum, frame
from tests.teds.strategies import some_fields
from tests.teds.vectors import ALL, TEDS, octets_of

CLASSES = [*range(1, 18), 128, 129, 200]
SLOW = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))


def read_back(fields: tuple[teds.Field, ...]) -> list[tuple[str, Any]]:
    back = []
    for field in fields:
        if field.name == "TEDSID":
            continue
        nested = bool(field.children) or (field.value is None and not field.raw)
        value = field.value if isinstance(field.value, teds.Units) or not nested else read_back(field.children)
        back.append((field.name or str(field.type), field.raw if not field.name else value))
    return back


def order(pairs: Any) -> Any:
    if isinstance(pairs, list):
        return sorted(((name, order(value)) for name, value in pairs), key=lambda pair: pair[0])
    return pairs


@pytest.mark.parametrize("edition", [2007, 2024])
@pytest.mark.parametrize("access_code", CLASSES)
@given(data=st.data())
@SLOW
def test_a_composed_teds_reads_back(access_code: int, edition: int, data: st.DataObject) -> None:
    pairs = data.draw(some_fields(access_code, edition))
    width = data.draw(st.sampled_from([None, 2, 3, 4]))
    octets = teds.compose(access_code, pairs, edition=edition, width=width)
    decoded = teds.decode(octets, strict=True)
    assert decoded.verdict == "clean"
    assert (decoded.edition, decoded.access_code, decoded.framed) == (edition, access_code, True)
    assert teds.encode(decoded) == octets
    assert teds.recompose(decoded) == octets
    if pairs and pairs[0][0] == "Text":
        assert decoded.text == tuple(value["Text"] for _, value in pairs)
    else:
        assert order(read_back(decoded.fields)) == order(pairs)


@pytest.mark.parametrize("access_code", [1, 3, 5, 12, 13])
@given(data=st.data())
@SLOW
def test_a_bare_block_reads_back_as_the_framed_teds_does(access_code: int, data: st.DataObject) -> None:
    octets = teds.compose(access_code, data.draw(some_fields(access_code, 2007)))
    framed, bare = teds.decode(octets), teds.decode(octets[4:-2])
    assert bare.verdict == "block-clean"
    assert not bare.framed
    assert [(f.name, f.value, f.raw) for f in bare.fields] == [(f.name, f.value, f.raw) for f in framed.fields]
    assert frame(teds.recompose(bare)) == octets


@pytest.mark.parametrize("name", TEDS)
def test_encode_gives_back_the_octets(name: str) -> None:
    assert teds.encode(teds.decode(octets_of(name))) == octets_of(name)


@pytest.mark.parametrize("name", [name for name in TEDS if not ALL[name]["verdict"].startswith(("frame", "malformed"))])
def test_recompose_gives_back_every_vector_whose_frame_is_right(name: str) -> None:
    decoded = teds.decode(octets_of(name))
    assert teds.recompose(decoded) == octets_of(name)


def test_recompose_mends_a_wrong_frame() -> None:
    decoded = teds.decode(octets_of("n07_bad_length"))
    assert teds.recompose(decoded) == octets_of("x07_name")


@pytest.mark.parametrize("name", ["n07_overrun", "m07_reset_cmd"])
def test_recompose_refuses_what_has_no_fields(name: str) -> None:
    with pytest.raises(BadDataError):
        teds.recompose(teds.decode(octets_of(name)))


@given(octets=st.binary(max_size=400))
@settings(max_examples=400, deadline=None)
def test_any_octets_decode(octets: bytes) -> None:
    decoded = teds.decode(octets)
    assert decoded.octets == octets
    assert decoded.verdict in set(teds.Conformity)


@given(access_code=st.integers(0, 255), content=st.binary(max_size=300), long=st.booleans(), width=st.integers(0, 5))
@settings(max_examples=400, deadline=None)
def test_any_content_in_a_right_frame_decodes(access_code: int, content: bytes, long: bool, width: int) -> None:
    head = bytes([3, 5, 0, 255, access_code, 2, width] if long else [3, 4, 0, access_code, 1, width])
    octets = frame(head + content)
    decoded = teds.decode(octets)
    assert decoded.framed
    assert decoded.access_code == access_code
    assert not any(finding.code.startswith("frame") for finding in decoded.findings)
    if decoded.verdict == "clean":
        assert teds.recompose(decoded) == octets


@given(data=st.data())
@settings(max_examples=200, deadline=None)
def test_damaged_vectors_decode(data: st.DataObject) -> None:
    octets = bytearray(octets_of(data.draw(st.sampled_from(TEDS))))
    for _ in range(data.draw(st.integers(1, 6))):
        octets[data.draw(st.integers(0, len(octets) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(octets)))
    teds.decode(bytes(octets))
    teds.decode(bytes(octets[:cut]))


@given(octets=st.binary(max_size=1100) | st.integers(0, 70_000).map(lambda size: b"\xff" * size))
@settings(max_examples=300, deadline=None)
def test_the_checksum_is_the_plain_sum_at_any_length(octets: bytes) -> None:
    """It is made from Adler-32, whose modulus is not 65536."""
    assert checksum(octets) == 0xFFFF - (sum(octets) & 0xFFFF)
