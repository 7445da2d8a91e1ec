"""The octets of the profile on NFC: NDEF framing, TNEP records, payload records and their pieces."""

from __future__ import annotations

import contextlib
import zlib

import ndef
import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import GarbledError
from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc.message import EXTERNAL, WELL_KNOWN, NdefRecord
from teds_provision.links.nfc.pieces import Piece, Requester, Responder, room

U16 = st.integers(0, 0xFFFF)
records = st.lists(
    st.builds(
        NdefRecord,
        st.sampled_from([1, 2, 3, 4]),
        st.binary(min_size=1, max_size=40),
        st.binary(max_size=400),
        st.binary(max_size=9),
    ),
    max_size=5,
).map(tuple)


@given(records)
def test_ndef_messages_come_back_as_they_were(given_records: tuple[NdefRecord, ...]) -> None:
    assert message.decode(message.encode(given_records)) == given_records


@given(st.binary(max_size=300))
def test_ndef_framing_never_raises_anything_but_garbled(octets: bytes) -> None:
    with contextlib.suppress(GarbledError):
        message.decode(octets)


@given(records, st.data())
def test_a_mutated_ndef_message_never_raises_anything_but_garbled(
    given: tuple[NdefRecord, ...], data: st.DataObject
) -> None:
    octets = bytearray(message.encode(given) or b"\xd0\x00\x00")
    octets[data.draw(st.integers(0, len(octets) - 1))] ^= data.draw(st.integers(1, 255))
    with contextlib.suppress(GarbledError):
        message.decode(bytes(octets))


@given(st.binary(max_size=700), st.binary(max_size=30))
def test_ndeflib_reads_what_we_write(payload: bytes, uri: bytes) -> None:
    octets = message.encode([tnep.payload_record(payload), tnep.status(0), tnep.select(uri)])
    theirs = list(ndef.message_decoder(octets, errors="strict"))
    assert [record.type for record in theirs] == ["urn:nfc:ext:teds-provision:tim", "urn:nfc:wkt:Te", "urn:nfc:wkt:Ts"]
    assert theirs[0].data == payload


def test_we_read_what_ndeflib_writes() -> None:
    octets = b"".join(ndef.message_encoder([ndef.UriRecord("https://example.org"), ndef.TextRecord("hello")]))
    assert [record.name for record in message.decode(octets)] == ["urn:nfc:wkt:U", "urn:nfc:wkt:T"]


def test_chunks_are_put_together() -> None:
    octets = bytes.fromhex("B1 01 02 54 AABB") + bytes.fromhex("36 00 01 CC") + bytes.fromhex("56 00 01 DD")
    assert message.decode(octets) == (NdefRecord(WELL_KNOWN, b"T", b"\xaa\xbb\xcc\xdd"),)


@pytest.mark.parametrize(
    "octets", ["51010054", "91010054", "D101", "D10105540000", "D10100540000", "B1010054", "F601005400"]
)
def test_broken_framing_is_named(octets: str) -> None:
    with pytest.raises(GarbledError):
        message.decode(bytes.fromhex(octets))


def test_tnep_records_have_the_published_layout() -> None:
    lock = bytes.fromhex("1013") + b"urn:nfc:sn:handover" + bytes.fromhex("002C020400")  # as a real door lock sends it
    parameters = tnep.ServiceParameters.decode(lock)
    assert parameters == tnep.ServiceParameters(b"urn:nfc:sn:handover", 44, 2, 0x400)
    assert parameters.record().payload == lock
    assert parameters.t_wait == pytest.approx(1.024)
    assert tnep.ServiceParameters(b"", 20, 15, 100).t_wait == pytest.approx(0.016)
    assert message.encode([tnep.select(b"")]) == bytes.fromhex("D10201547300")
    assert message.encode([tnep.status(0)]) == bytes.fromhex("D10201546500")


@given(st.binary(max_size=60))
def test_tnep_records_never_raise_anything_but_garbled(payload: bytes) -> None:
    for kind in (b"Tp", b"Ts", b"Te"):
        found = [NdefRecord(WELL_KNOWN, kind, payload), NdefRecord(EXTERNAL, tnep.TIM_TYPE, payload)]
        tnep.our_service(found)
        tnep.status_of(found)
        with contextlib.suppress(GarbledError):
            tnep.selection(found)


def test_our_service_is_found_among_others_and_is_of_tnep_1_in_single_response_mode() -> None:
    def tp(head: str, uri: bytes, tail: str) -> NdefRecord:
        return NdefRecord(WELL_KNOWN, b"Tp", bytes.fromhex(head) + bytes([len(uri)]) + uri + bytes.fromhex(tail))

    own = b"urn:nfc:xsn:teds-provision:tim"
    good = tp("10", own, "00 04 0f 0200")
    found = tnep.ServiceParameters(own, wt_int=4, n_wait=15, max_ndef=512)
    assert tnep.our_service([good]) == found
    assert found.t_wait == 0.001
    broken, other = NdefRecord(WELL_KNOWN, b"Tp", b"\x10\x05abc"), tp("10", b"urn:nfc:sn:handover", "00 04 0f 0200")
    assert tnep.our_service([NdefRecord(WELL_KNOWN, b"T", b""), broken, other, good]) == found
    newer = tnep.our_service([tp("1f", own, "00 04 ff 0200")])
    assert newer is not None
    assert (newer.version, newer.n_wait) == (0x1F, 15), "no more than TNEP has"
    for no_service in (tp("20", own, "00 04 0f 0200"), tp("10", own, "01 04 0f 0200"), broken, other):
        assert tnep.our_service([no_service]) is None


def test_a_payload_record_has_the_layout_of_the_profile() -> None:
    octets = Piece(0x1234, 0x0102, 0x0100, b"\xaa\xbb", answer=True).encode()
    head = bytes.fromhex("01 01 1234 0102 0100")
    assert octets == head + zlib.crc32(head + b"\xaa\xbb").to_bytes(4, "big") + b"\xaa\xbb"
    assert Piece(0, 9, 0, b"", more=True).encode()[1] == 2


@pytest.mark.parametrize("version", [0, 2, 255])
def test_a_payload_record_of_another_version_is_garbled_though_its_crc_is_right(version: int) -> None:
    head = bytes([version]) + bytes.fromhex("00000700040000")
    with pytest.raises(GarbledError, match=f"of version {version}"):
        Piece.decode(head + zlib.crc32(head + b"abcd").to_bytes(4, "big") + b"abcd")


@given(
    st.builds(
        Piece, U16, st.just(0xFFFF), st.integers(0, 0x8000), st.binary(max_size=600), st.booleans(), st.booleans()
    )
)
def test_a_payload_record_comes_back_as_it_was(piece: Piece) -> None:
    assert Piece.decode(piece.encode()) == piece


@given(st.binary(max_size=60), st.data())
def test_every_flipped_octet_of_a_payload_record_is_noticed(body: bytes, data: st.DataObject) -> None:
    octets = bytearray(Piece(7, len(body), 0, body).encode())
    octets[data.draw(st.integers(0, len(octets) - 1))] ^= data.draw(st.integers(1, 255))
    with pytest.raises(GarbledError):
        Piece.decode(bytes(octets))


@given(st.integers(40, 1200), st.integers(0, 40))
def test_a_piece_fills_its_message_and_never_more(max_ndef: int, others: int) -> None:
    octets = room(max_ndef, others)
    if octets < 1:
        return
    whole = len(message.encode([tnep.payload_record(Piece(1, 0xFFFF, 0, bytes(octets)).encode())])) + others
    assert max_ndef - 3 <= whole <= max_ndef


@pytest.mark.parametrize("others", [0, 7])
def test_no_octet_more_fits_beside_a_piece(others: int) -> None:
    """Beyond 255 octets the length of a record takes three octets more."""

    def whole(octets: int) -> int:
        return len(message.encode([tnep.payload_record(Piece(1, 0xFFFF, 0, bytes(octets)).encode())])) + others

    for max_ndef in range(280, 330):
        octets = room(max_ndef, others)
        assert whole(octets) <= max_ndef < whole(octets + 1)


def run(requester: Requester, responder: Responder, node_room: int) -> bytes:
    for _ in range(requester.steps_allowed + 70_000):
        asked = Piece.decode(requester.next().encode())
        assert requester.handle_piece(Piece.decode(responder.answer(asked, node_room).encode()))
        if requester.reply is not None:
            return requester.reply
    raise AssertionError("no end")


@given(
    st.binary(min_size=1, max_size=2000), st.binary(min_size=1, max_size=2000), st.integers(1, 500), st.integers(8, 500)
)
def test_any_frame_goes_over_in_any_pieces(frame: bytes, reply: bytes, room_up: int, room_down: int) -> None:
    seen: list[tuple[int, bytes]] = []

    def serve(transaction: int, whole: bytes) -> bytes:
        seen.append((transaction, whole))
        return reply

    requester = Requester(77, frame, room_up)
    assert run(requester, Responder(serve), room_down) == reply
    assert seen == [(77, frame)]
    assert requester.steps_allowed >= len(reply) // room_down


@given(st.binary(min_size=30, max_size=200), st.integers(5, 20), st.lists(st.booleans(), max_size=40))
def test_pieces_that_are_asked_twice_do_no_harm(frame: bytes, size: int, twice: list[bool]) -> None:
    responder, requester = Responder(lambda transaction, whole: whole[::-1]), Requester(1, frame, size)
    for again in [*twice, *[False] * 200]:
        asked = requester.next()
        answers = [responder.answer(asked, size) for _ in range(2 if again else 1)]
        assert requester.handle_piece(answers[-1])
        if requester.reply is not None:
            break
    assert requester.reply == frame[::-1]


def test_a_node_that_lost_the_first_pieces_gets_them_again() -> None:
    responder, requester = Responder(lambda transaction, whole: whole), Requester(5, bytes(range(90)), 30)
    requester.handle_piece(responder.answer(requester.next(), 50))
    responder.forget()
    assert requester.next().offset == 30
    requester.handle_piece(responder.answer(requester.next(), 50))
    assert requester.next().offset == 0
    assert run(requester, responder, 50) == bytes(range(90))


def test_a_reply_of_another_transaction_is_dropped() -> None:
    requester = Requester(5, b"abcd", 30)
    assert not requester.handle_piece(Piece(6, 2, 0, b"xy", answer=True))
    assert not requester.handle_piece(Piece(5, 4, 0, b"abcd"))  # our own request, read back
    assert requester.reply is None
    assert requester.handle_piece(Piece(5, 2, 0, b"ok", answer=True))
    assert requester.reply == b"ok"


def test_a_piece_of_a_reply_that_comes_again_is_taken_once() -> None:
    requester = Requester(5, b"abcd", 30)
    for _ in range(2):
        requester.handle_piece(Piece(5, 5, 0, b"xyz", answer=True, more=True))
    requester.handle_piece(Piece(5, 5, 3, b"uv", answer=True))
    assert requester.reply == b"xyzuv"


def test_a_request_for_more_repeats_transaction_and_offset_with_an_empty_body() -> None:
    requester = Requester(5, b"abcd", 30)
    requester.handle_piece(Piece(5, 5, 0, b"xyz", answer=True, more=True))
    assert requester.next() == Piece(5, 5, 3, b"")


def test_the_answer_to_a_piece_of_a_request_says_what_is_held() -> None:
    responder = Responder(lambda transaction, whole: whole)
    assert responder.answer(Piece(9, 6, 0, b"abc", more=True), 50) == Piece(9, 6, 3, b"", answer=True)
    assert responder.answer(Piece(9, 6, 5, b"f"), 50) == Piece(9, 6, 3, b"", answer=True)  # a gap
    for transaction, total, held in ((8, 6, 0), (9, 7, 0), (9, 6, 3)):
        asked = Piece(transaction, total, 0, b"")
        assert responder.answer(asked, 50) == Piece(transaction, total, held, b"", answer=True)
    assert responder.answer(Piece(9, 6, 3, b"def"), 50) == Piece(9, 6, 0, b"abcdef", answer=True)


def test_a_request_that_begins_again_is_put_together_anew_and_run_again() -> None:
    """Whether it was the same is for whom the whole frame goes to."""
    seen: list[bytes] = []

    def serve(_transaction: int, whole: bytes) -> bytes:
        seen.append(whole)
        return b"ok"

    responder = Responder(serve)
    for first, last in ((b"abc", b"def"), (b"uvw", b"xyz")):
        assert responder.answer(Piece(9, 6, 0, first, more=True), 50) == Piece(9, 6, 3, b"", answer=True)
        for _ in range(2):
            assert responder.answer(Piece(9, 6, 3, last), 50) == Piece(9, 2, 0, b"ok", answer=True)
    assert seen == [b"abcdef", b"abcdef", b"uvwxyz", b"uvwxyz"]


@pytest.mark.parametrize(
    "piece",
    [
        Piece(5, 9, 9, b"", answer=True),  # holds more than was sent
        Piece(5, 9, 4, b"x", answer=True),  # a reply that begins in the middle
    ],
)
def test_pieces_that_do_not_fit_are_garbled(piece: Piece) -> None:
    with pytest.raises(GarbledError):
        Requester(5, b"abcd", 30).handle_piece(piece)


@pytest.mark.parametrize("total", [8, 10])
def test_a_reply_that_changes_its_length_is_garbled(total: int) -> None:
    requester = Requester(5, b"abcd", 30)
    requester.handle_piece(Piece(5, 9, 0, b"x", answer=True, more=True))
    with pytest.raises(GarbledError):
        requester.handle_piece(Piece(5, total, 1, b"y", answer=True))


pieces = st.builds(
    Piece,
    st.integers(0, 2),
    st.integers(0, 40),
    st.integers(0, 40),
    st.binary(max_size=20),
    st.booleans(),
    st.booleans(),
)


@given(st.lists(pieces, max_size=30))
def test_no_sequence_of_pieces_upsets_either_side(sequence: list[Piece]) -> None:
    requester, responder = Requester(1, bytes(25), 10), Responder(lambda transaction, whole: whole)
    for piece in sequence:
        for take in (lambda p=piece: responder.answer(p, 10), lambda p=piece: requester.handle_piece(p)):
            with contextlib.suppress(GarbledError):
                take()
        assert requester.next().total <= 0xFFFF
