"""The image file: one that holds nothing but an image is read sooner, and never otherwise than member by member."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from teds_provision.errors import BadDataError
from teds_provision.teds import image as image_file
from teds_provision.teds.image import Image

_PIECES = st.sampled_from(
    [
        "{", "}", "[", "]", ",", ":", '"format"', '"teds-image/1"', '"uuid"', '"00000000000000000001"', '"blocks"',
        '{"access_code": 1, "channel": 0, "teds": "00"}',
        '"teds": "0a"', '"teds"', '"te\\u003ads"', '"a:b"', '"channel"',
        "1", "300", "-0", "true", "1e0", "NaN", "null", " ",
    ]
)  # fmt: skip


@given(st.lists(st.tuples(st.integers(0, 400), st.integers(0, 30), _PIECES), max_size=3), st.booleans())
@example([(0, 0, "\ufeff")], False)
def test_an_image_is_read_plainly_only_as_it_is_read_member_by_member(
    changes: list[tuple[int, int, str]], as_text: bool
) -> None:
    text = Image(bytes(10), {(0, 1): b"one", (2, 3): b"two"}).to_json()
    for place, length, piece in changes:
        at = place % len(text)
        text = text[:at] + piece + text[at + length :]
    plain = image_file._plain_image(text if as_text else text.encode())
    if plain is not None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(image_file, "_plain_image", lambda _text: None)
            assert Image.from_json(text) == plain
            assert list(plain.blocks) == list(Image.from_json(text).blocks)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"blocks": [', '"uuid": "00000000000000000000", "blocks": ['),
        ('"teds": "6f6e65"', '"teds": "00", "teds": "6f6e65"'),
        ('"teds": "6f6e65"', '"teds": "6f6e65", "note": ":"'),
        ('"access_code": 1,', '"access_code": 1, "channel": 5,'),
        ('"format"', '"note": 1, "format"'),
    ],
)
def test_a_member_that_is_there_twice_or_unknown_is_never_read_plainly(old: str, new: str) -> None:
    text = Image(bytes(10), {(0, 1): b"one"}).to_json()
    assert image_file._plain_image(text) == Image.from_json(text)
    assert old in text
    assert image_file._plain_image(text.replace(old, new)) is None


def block(access_code: str = "1", channel: str = "0", teds: str = '"00"') -> str:
    return f'{{"access_code": {access_code}, "channel": {channel}, "teds": {teds}}}'


@pytest.mark.parametrize(
    ("uuid", "blocks", "message"),
    [
        ("", "", '"uuid" of the image has 0 octets, a UUID has 10.'),
        ("00" * 9, "", '"uuid" of the image has 9 octets, a UUID has 10.'),
        ("00" * 16, block(), '"uuid" of the image has 16 octets, a UUID has 10.'),
        ("0g" * 10, block(), '"uuid" is not a string of hex digits.'),
        (
            "00" * 10,
            f"{block()}, {block('1', '10')}, {block()}",
            "Block 2 of the image repeats access code 1 on channel 0.",
        ),
        ("00" * 10, f"{block()}, 1", "Block 1 of the image is not an object."),
        ("00" * 10, "[]", "Block 0 of the image is not an object."),
        *(
            ("00" * 10, block(code), '"access_code" of block 0 is not a number from 0 to 255.')
            for code in ("-1", "256", "true", "1.0", '"1"', "null")
        ),
        *(
            ("00" * 10, f"{block()}, {block('1', channel)}", '"channel" of block 1 is not a number from 0 to 65535.')
            for channel in ("-1", "65536", "false", "0.0", '"0"', "null")
        ),
        ("00" * 10, block(teds="0"), '"teds of block 0" is not a string of hex digits.'),
        ("00" * 10, block(teds='"0"'), '"teds of block 0" is not a string of hex digits.'),
    ],
)
def test_what_is_wrong_with_an_image_is_named(uuid: str, blocks: str, message: str) -> None:
    with pytest.raises(BadDataError) as refused:
        Image.from_json(f'{{"format": "teds-image/1", "uuid": "{uuid}", "blocks": [{blocks}]}}')
    assert refused.value.message == message


@pytest.mark.parametrize(
    "text", ["[]", "3", "{}", '{"format": "teds-image/2"}', '{"format": 1, "uuid": "", "blocks": []}']
)
def test_another_document_is_no_image(text: str) -> None:
    with pytest.raises(BadDataError) as refused:
        Image.from_json(text)
    assert refused.value.message == 'This is not a TEDS image: "format" is not "teds-image/1".'


@pytest.mark.parametrize("text", ["[" * 5000, '{"format": ' * 5000, b"[" * 5000])
def test_a_nest_without_end_is_no_image(text: str | bytes) -> None:
    with pytest.raises(BadDataError):
        Image.from_json(text)


@pytest.mark.parametrize("note", ["", '"note": 1, '], ids=["plain", "member by member"])
@pytest.mark.parametrize(("access_code", "channel"), [(0, 0), (255, 65535)])
def test_an_image_holds_every_access_code_and_channel(access_code: int, channel: int, note: str) -> None:
    blocks = block(str(access_code), str(channel), '"0a"')
    image = Image.from_json(f'{{{note}"format": "teds-image/1", "uuid": "{"00" * 10}", "blocks": [{blocks}]}}')
    assert image == Image(bytes(10), {(channel, access_code): b"\n"})


@pytest.mark.parametrize("blocks", ["{}", '""', "null"])
def test_blocks_that_are_no_list_make_no_image(blocks: str) -> None:
    with pytest.raises(BadDataError, match="not a list"):
        Image.from_json(f'{{"format": "teds-image/1", "uuid": "{"00" * 10}", "blocks": {blocks}}}')
