"""A PC/SC reader whose card or service fails at each step; the client library is a mock."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.links.nfc import pcsc, pcsc_readers
from teds_provision.links.nfc.nfcpy import nfc
from teds_provision.links.nfc.pcsc import PcscReader, _Card, _PcscType2
from teds_provision.links.nfc.pcsclite import PcscError
from teds_provision.links.nfc.tag import FieldLostError, ReaderLostError

REMOVED, NO_CARD = 0x80100069, 0x8010000C
GONE = (0x80100003, 0x80100009, 0x80100013, 0x80100017, 0x8010001D, 0x8010001E)
"""Invalid handle, unknown reader, communication error, reader unavailable, no service, service stopped (pcsclite.h)."""


class Library:
    """Each function does, in turn, what its list has: a value, or a code that it fails with."""

    def __init__(self, **steps: list[Any]) -> None:
        self.steps, self.log = steps, list[tuple[Any, ...]]()

    def _step(self, name: str, *given: Any, otherwise: Any = None) -> Any:
        self.log.append((name, *given))
        step = self.steps[name].pop(0) if self.steps.get(name) else otherwise
        if isinstance(step, int) and step > 0x80000000:
            raise PcscError(step, f"error {step:08X}")
        return step

    def establish(self) -> Any:
        return self._step("establish", otherwise=7)

    def release(self, context: int) -> None:
        self._step("release", context)

    def readers(self, context: int) -> Any:
        return self._step("readers", context, otherwise=["ACR122U PICC"])

    def connect(self, context: int, name: str) -> Any:
        return self._step("connect", context, name, otherwise=(11, 2))

    def disconnect(self, handle: int) -> None:
        self._step("disconnect", handle)

    def atr(self, handle: int) -> Any:
        return self._step("atr", handle, otherwise=bytes.fromhex("3b8080 0101"))

    def transmit(self, handle: int, protocol: int, apdu: bytes) -> Any:
        return self._step("transmit", handle, protocol, apdu.hex(), otherwise=b"\4\1\2\3\x90\0")


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Callable[[Library], PcscReader]:
    def reader(library: Library) -> PcscReader:
        for module in (pcsc, pcsc_readers):
            monkeypatch.setattr(module, "load", lambda: library)
        return PcscReader("pcsc")

    return reader


def test_the_tag_of_a_card_has_its_uid_and_each_look_switches_the_field(
    opened: Callable[[Library], PcscReader],
) -> None:
    library = Library()
    reader = opened(library)
    assert (reader.name, reader.again) == ("ACR122U PICC", "pcsc:ACR122U PICC")
    library.log.clear()
    first = reader.sense()
    assert first is not None
    assert library.log == [("connect", 7, "ACR122U PICC"), ("atr", 11), ("transmit", 11, 2, "ffca000000")]
    library.log.clear()
    assert reader.sense() is not None
    assert library.log[0] == ("disconnect", 11)
    library.log.clear()
    reader.close()
    assert library.log == [("disconnect", 11), ("release", 7)]
    reader.close()
    assert len(library.log) == 2


@pytest.mark.parametrize(
    ("code", "words"),
    [(0x8010000B, "another program holds it"), *((code, f"error {code:08X}") for code in GONE)],
)
def test_a_reader_that_is_held_or_gone_is_lost(opened: Callable[[Library], PcscReader], code: int, words: str) -> None:
    reader = opened(Library(connect=[code]))
    with pytest.raises(ReaderLostError, match=words):
        reader.sense()


@pytest.mark.parametrize(
    "steps", [{"connect": [NO_CARD]}, {"atr": [REMOVED]}, {"transmit": [REMOVED]}, {"transmit": [b"\x90"]}]
)
def test_a_card_that_is_not_there_or_leaves_at_once_is_no_tag(
    opened: Callable[[Library], PcscReader], steps: dict[str, list[Any]]
) -> None:
    assert opened(Library(**steps)).sense() is None


def test_a_service_that_fails_at_the_end_ends_all_the_same(opened: Callable[[Library], PcscReader]) -> None:
    reader = opened(Library(disconnect=[REMOVED], release=[0x8010001D]))
    reader.sense()
    reader.close()


def test_a_list_of_readers_that_fails_is_empty_and_gives_its_context_back(monkeypatch: pytest.MonkeyPatch) -> None:
    library = Library(readers=[0x8010001D], release=[0x8010001D])
    monkeypatch.setattr(pcsc_readers, "load", lambda: library)
    assert pcsc_readers.names() == []
    assert library.log == [("establish",), ("readers", 7), ("release", 7)]


def _card(library: Library, trace: Any = None) -> _Card:
    return _Card(cast("Any", library), 11, 2, trace)


@pytest.mark.parametrize("code", [*GONE, REMOVED, NO_CARD])
def test_an_exchange_that_fails_lost_the_reader_or_the_field(code: int) -> None:
    with pytest.raises(ReaderLostError if code in GONE else FieldLostError):
        _card(Library(transmit=[code])).transmit(b"\0")


def test_each_apdu_is_traced_with_its_answer() -> None:
    frames: list[Any] = []
    trace = SimpleNamespace(frame=lambda *given: frames.append(given))
    card = _card(Library(transmit=[b"a\x90\0", REMOVED]), trace)
    assert card.transmit(b"\0\xb0") == b"a\x90\0"
    with pytest.raises(FieldLostError):
        card.transmit(b"\0\xb1")
    assert frames == [("pcsc", "out", b"\0\xb0"), ("pcsc", "in", b"a\x90\0"), ("pcsc", "out", b"\0\xb1")]


def test_read_and_write_of_a_type_2_tag_are_pseudo_apdus() -> None:
    """PC/SC part 3: READ BINARY of 16 octets, UPDATE BINARY of 4; another command is answered without the card."""
    library = Library(
        transmit=[bytes(16) + b"\x90\0", b"\x90\0", bytes(4) + b"\x90\0", bytes(16) + b"\x63\0", b"\x63\0"]
    )
    tag: Any = _PcscType2.__new__(_PcscType2)
    tag._clf = _card(library)
    assert tag.transceive(b"\x30\x04") == bytes(16)
    assert tag.transceive(b"\xa2\x05abcd") == b"\x0a"
    assert tag.transceive(b"\xc2\xff") == b"\0"
    for command in (b"\x30\x04", b"\x30\x04", b"\xa2\x05abcd"):
        with pytest.raises(nfc.tag.tt2.Type2TagCommandError):
            tag.transceive(command)
    assert [apdu for *_, apdu in library.log] == [
        "ffb0000410",
        "ffd600050461626364",
        "ffb0000410",
        "ffb0000410",
        "ffd600050461626364",
    ]


@pytest.mark.parametrize(
    ("atr", "answer", "kind", "uid"),
    [
        ("3b8080 0101", b"\4\1\2\3\x90\0", "Type 4", b"\4\1\2\3"),
        ("3b8f8001804f0ca000000306030003", b"\4\1\2\3\4\5\6\x90\0", "Type 2", b"\4\1\2\3\4\5\6"),
        ("3b8f8001804f0ca000000306030003", b"\4\1\x63\0", "Type 2", b""),
    ],
)
def test_a_card_without_a_processor_is_a_type_2_tag_and_has_its_uid_if_it_gives_one(
    opened: Callable[[Library], PcscReader], atr: str, answer: bytes, kind: str, uid: bytes
) -> None:
    reader = opened(Library(atr=[bytes.fromhex(atr)], transmit=[answer]))
    tag = reader.sense()
    assert tag is not None
    assert (tag.kind, tag.uid) == (kind, uid)
    assert reader._card is not None
    assert reader._card.target is not None
    assert reader._card.target.uid == uid
