"""Edges of NFC tags and chips: frame limits, ends of an exchange, a tag that was replaced. Chip and air are mocks."""

from __future__ import annotations

import errno
import time
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.links.nfc import nfcpy, tag
from teds_provision.links.nfc.nfcpy import Frontend, _LeanExchange, nfc
from teds_provision.links.nfc.tag import FieldLostError, ReaderLostError, ReaderTag, translated
from teds_provision.links.nfc.udp import NodeDevice


class Chip:
    """A front end whose exchanges do what the list has."""

    def __init__(self, *answers: Any, receives: int = 256, sends: int = 256) -> None:
        self.answers, self.sent = list(answers), list[tuple[str, float]]()
        self.max_recv_data_size, self.max_send_data_size = receives, sends
        self.target: Any = None

    def exchange(self, octets: bytes, timeout: float) -> Any:
        self.sent.append((bytes(octets).hex(), timeout))
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


TARGET: Any = SimpleNamespace(sdd_res=b"\1\2\3\4")
UNIT = 4096 / 13.56e6


@pytest.mark.parametrize(
    ("ats", "receives", "asked", "units"),
    [
        ("0578807002", 256, "e080", 2**7),
        ("0578807002", 255, "e070", 2**7),
        ("057880f002", 256, "e080", 2**4),
        ("057880e002", 256, "e080", 2**14),
        ("0578800002", 256, "e080", 1),
    ],
)
def test_a_type_4_tag_has_the_waiting_time_that_it_asks_for(ats: str, receives: int, asked: str, units: int) -> None:
    """ISO/IEC 14443-4 clause 5.2.5: FWI 15 is reserved and counts as 4."""
    chip = Chip(bytearray.fromhex(ats), receives=receives)
    made = tag._Type4Tag(chip, TARGET)
    assert chip.sent == [(asked, 0.03)]
    assert made._dep.fwt == pytest.approx(UNIT * units)
    assert bytes(made._nfcid) == b"\1\2\3\4"


def test_a_type_4_tag_that_does_not_answer_is_gone() -> None:
    chip = Chip(bytearray.fromhex("0578807002"), bytearray(b"\xa3"), nfc.clf.TimeoutError())
    made = tag._Type4Tag(chip, TARGET)
    assert [made._is_present(), made._is_present()] == [True, False]
    assert [octets for octets, _ in chip.sent[1:]] == ["b2", "b2"]


def test_a_tag_that_asks_for_more_and_more_time_gets_until_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(tag, "time", SimpleNamespace(monotonic=lambda: now[0]))
    chip = Chip(b"a", b"b")
    front = tag._BufferedFrontend(chip)
    front.until = 101.0
    assert front.exchange(b"\1", 0.5) == b"a"
    assert front.exchange(b"\1", 5.0) == b"b"
    assert [timeout for _, timeout in chip.sent] == [0.5, 1.0]
    now[0] = 101.0
    with pytest.raises(nfc.tag.tt4.Type4TagCommandError):
        front.exchange(b"\1", 0.5)


@pytest.mark.parametrize(
    ("skipped", "begin", "capacity", "simple"),
    [
        ((), 16, 100, True), ((15, 120), 16, 100, True), ((16,), 16, 100, False), ((119,), 16, 100, False),
        ((), 18, 100, True), ((), 19, 100, False), ((), 16, 1004, True), ((), 16, 1005, False),
    ],
)  # fmt: skip
def test_a_message_in_one_piece_is_read_without_looking_for_it_again(
    monkeypatch: pytest.MonkeyPatch, skipped: tuple[int, ...], begin: int, capacity: int, simple: bool
) -> None:
    """Lock or reserved octets within it, a head over two pages, or a second sector: nfcpy's own way is kept."""
    monkeypatch.setattr(tag._Type2Ndef.__mro__[1], "_read_ndef_data", lambda self: bytearray(b"m"))
    made: Any = tag._Type2Ndef.__new__(tag._Type2Ndef)
    made._ndef_tlv_offset, made._capacity, made._skip_bytes = begin, capacity, set(skipped)
    assert made._read_ndef_data() == b"m"
    assert made._simple is simple


def test_a_tag_is_not_used_once_the_reader_has_looked_for_another() -> None:
    target, other = object(), object()
    for own, present, lost in (
        (target, target, False),
        (None, None, True),
        (target, other, True),
        (target, None, True),
    ):
        used: Any = SimpleNamespace(identifier=b"\1", target=own, clf=SimpleNamespace(target=present), is_present=True)
        made = ReaderTag(used, "Type 4")
        assert made.is_present is not lost
        if lost:
            with pytest.raises(FieldLostError), made._talking():
                pass


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (OSError(errno.ENODEV, "No such device"), ReaderLostError, "The reader no longer answers (No such device)."),
        (OSError("odd"), ReaderLostError, "The reader no longer answers (odd)."),
        (ValueError("x"), FieldLostError, ""),
        (nfc.clf.TransmissionError("crc"), FieldLostError, ""),
    ],
)
def test_what_nfcpy_raises_is_a_lost_reader_or_a_lost_field(
    error: Exception, kind: type[Exception], words: str
) -> None:
    with pytest.raises(kind) as no, translated():
        raise error
    if words:
        assert cast("Any", no.value).message == words
        assert cast("Any", no.value).hint == "Plug it in again."


# -- chips -------------------------------------------------------------------------------------------------------------


def test_a_front_end_does_not_answer_for_a_target_that_is_gone() -> None:
    frames: list[Any] = []
    front: Any = Frontend.__new__(Frontend)
    front.target, front.device = None, object()
    with pytest.raises(nfc.clf.TimeoutError):
        front.exchange(b"\1", 0.1)
    front.target, front._carried = object(), lambda data, timeout: bytearray(b"\2") if timeout else None
    front.trace = SimpleNamespace(frame=lambda *given: frames.append(given))
    assert front.exchange(b"\1", 0.1) == b"\2"
    assert front.exchange(b"\3", 0.0) is None
    assert frames == [("nfc", "out", b"\1"), ("nfc", "in", b"\2"), ("nfc", "out", b"\3")]


class ChipError(Exception):
    def __init__(self, number: int) -> None:
        super().__init__(f"chip error {number}")
        self.errno = number


def _lean() -> tuple[Any, Any, list[Any]]:
    settings: list[Any] = []
    device: Any = SimpleNamespace(
        send_cmd_recv_rsp=lambda target, data, timeout: b"whole",
        chipset=SimpleNamespace(rf_configuration=lambda item, octets: settings.append((item, bytes(octets)))),
    )
    lean: Any = _LeanExchange(device, SimpleNamespace(Chipset=SimpleNamespace(Error=ChipError)))
    target = SimpleNamespace(brty_send="106A", brty_recv="106A")
    return lean, target, settings


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (ChipError(1), nfc.clf.TimeoutError),
        (ChipError(2), nfc.clf.TransmissionError),
        (OSError(errno.ETIMEDOUT, "x"), nfc.clf.TimeoutError),
        (OSError(errno.ENODEV, "x"), OSError),
    ],
)
def test_after_a_fault_a_chip_gets_all_its_settings_again(error: Exception, kind: type[Exception]) -> None:
    lean, target, _ = _lean()
    assert lean.exchange(target, b"a", 0.1) == b"whole"
    lean._send = lambda target, data, timeout: b"lean"
    assert lean.exchange(target, b"a", 0.1) == b"lean"

    def fail(*_: Any) -> None:
        raise error

    lean._send = fail
    with pytest.raises(kind) as no:
        lean.exchange(target, b"a", 0.1)
    if kind is nfc.clf.TransmissionError:
        assert str(no.value) == "chip error 2"
    assert lean.exchange(target, b"a", 0.1) == b"whole"


def test_a_chip_is_set_anew_for_another_target_another_rate_and_another_time() -> None:
    lean, target, settings = _lean()
    waits: list[float] = []

    def send(_target: Any, _data: bytes, timeout: float) -> bytes:
        waits.append(round(timeout - nfcpy._LATE, 6))
        return b"lean"

    lean._send = send
    assert lean.exchange(target, b"a", 0.0001) == b"whole"
    for seconds in (0.0001, 0.0002, 0.0001, 0.0004):
        assert lean.exchange(target, b"a", seconds) == b"lean"
    assert waits == [0.0001, 0.0002, 0.0001, 0.0004]
    assert settings == [(2, b"\x0a\x0b\2"), (2, b"\x0a\x0b\1"), (2, b"\x0a\x0b\3")]
    target.brty_recv = "212A"
    assert lean.exchange(target, b"a", 0.0004) == b"whole"
    again = SimpleNamespace(brty_send="106A", brty_recv="212A")
    assert lean.exchange(again, b"a", 0.0004) == b"whole"


# -- a node on a simulated reader --------------------------------------------------------------------------------------


def test_a_node_keeps_its_place_on_the_reader_while_it_is_bound() -> None:
    muted: list[str] = []

    def bind(address: Any) -> None:
        if address in (5, 6):
            raise OSError(errno.EADDRINUSE if address == 5 else errno.EACCES, "x")

    made: Any = NodeDevice("localhost", 5)
    made._create_socket = lambda: setattr(
        made, "socket", SimpleNamespace(bind=bind, close=lambda: muted.append("closed"))
    )
    made.addr = 5
    assert (made.bind(), made.bound) == (False, False)
    made.addr = 6
    with pytest.raises(PermissionError):
        made.bind()
    made.addr = 7
    assert (made.bind(), made.bound, made.bind()) == (True, True, True)
    made.mute()
    assert muted == []
    made.close()
    assert (made.socket, made.bound, muted) == (None, False, ["closed"])


def activated(uid: bytes, *steps: bytes | Exception) -> tuple[Any, list[str]]:
    """Return what a node with this UID is activated by, or None, and its answers to the frames of a reader."""
    answers, waiting = list[str](), list(steps)
    device: Any = object.__new__(NodeDevice)

    def receive(_wait: float, _brty: str) -> tuple[str, bytearray, str]:
        step = waiting.pop(0) if waiting else nfc.clf.TimeoutError()
        if isinstance(step, Exception):
            raise step
        return "106A", bytearray(step), "reader"

    device._recv_data = receive
    device._send_data = lambda _brty, data, _addr: answers.append(bytes(data).hex())
    target = nfc.clf.LocalTarget("106A", sens_res=b"\x44\x03", sdd_res=uid, sel_res=b"\x20")
    return device._listen_tta(target, time.time() + 60), answers


def test_a_node_is_selected_level_by_level_and_from_the_start_after_a_torn_frame() -> None:
    """A reader that asked for the second level after its field was off would select a node that is not there."""
    uid, torn = bytes(range(1, 8)), nfc.clf.TransmissionError("torn")
    first, second = bytes.fromhex("8801020388"), bytes.fromhex("0405060700")
    for asked in (b"\x26", b"\x52"):
        found, answers = activated(
            uid, asked, b"\x93\x20", b"\x93\x70" + first, b"\x95\x20", b"\x95\x70" + second, b"\xe0\x80"
        )
        assert answers == ["4403", first.hex(), "04", second.hex(), "20"]
        assert bytes(found.tt4_cmd) == b"\xe0\x80"
    found, answers = activated(uid, b"\x26", b"\x93\x70" + first, torn, b"\x95\x20", b"\x93\x20")
    assert (found, answers) == (None, ["4403", "04", first.hex()])
    found, answers = activated(uid, b"\x26", b"\x93\x70" + first, b"\x52", b"\x95\x20", b"\x93\x20")
    assert (found, answers) == (None, ["4403", "04", "4403", first.hex()])
    found, answers = activated(uid, b"\x26", b"\x93\x70" + first[::-1], b"\x95\x20")
    assert (found, answers) == (None, ["4403"]), "another node is selected"
