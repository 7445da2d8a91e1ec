"""The station's half of TNEP against other people's nodes: slow, torn, wrong, mute."""

from __future__ import annotations

import pytest

from teds_provision.errors import GarbledError, NodeSilentError
from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc.pieces import Piece
from teds_provision.links.nfc.poller import Poller
from tests.node.tag_talk import answer, request, select


class Script:
    """Someone else's node: what stands in its mailbox at each read, the last of it for ever."""

    def __init__(self, *reads: bytes) -> None:
        self.reads = list(reads)
        self.written: list[bytes] = []
        self.read_at: list[float] = []
        self.now = 0.0

    def read(self) -> bytes:
        self.read_at.append(self.now)
        return self.reads.pop(0) if len(self.reads) > 1 else self.reads[0]

    def write(self, octets: bytes) -> None:
        self.written.append(octets)

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def transact(self, *, wt_int: int = 20, n_wait: int = 15, max_ndef: int = 300, frame: bytes = b"abcd") -> bytes:
        service = tnep.ServiceParameters(tnep.SERVICE, wt_int, n_wait, max_ndef)
        return Poller(self, service, clock=lambda: self.now, sleep=self.sleep).transact(3, frame)


OK = message.encode([tnep.status(0)])


GOOD = answer(Piece(3, 2, 0, b"ok", answer=True))


@pytest.mark.parametrize(
    "reads",
    [
        [b"", b"", OK, b"", GOOD],
        [select(), OK, request(Piece(3, 4, 0, b"abcd")), GOOD],  # our own message still there
        [*[select()] * 9, OK, *[request(Piece(3, 4, 0, b"abcd"))] * 9, GOOD],  # and still there at each read
        [OK, b"\xd1torn", GOOD],
        [OK, GOOD[:-3], GOOD],
        [OK, answer(Piece(2, 2, 0, b"no", answer=True)), GOOD],  # another transaction
        [OK, answer(Piece(3, 2, 0, b"o", answer=True, more=True)), answer(Piece(3, 2, 1, b"k", answer=True))],
        [OK, *[b""] * 100, GOOD],  # far past N_wait, within 5 s at an interval of 32 ms
    ],
)
def test_a_station_bears_with_other_peoples_nodes(reads: list[bytes]) -> None:
    script = Script(*reads)
    assert script.transact(n_wait=0) == b"ok"


@pytest.mark.parametrize("wt_int", [4, 20, 36, 44])
def test_a_station_waits_before_its_first_read_too(wt_int: int) -> None:
    """TNEP: the node's minimum waiting time runs from the write; a tag that is read sooner may be busy with it."""
    script = Script(OK, b"", GOOD)
    script.transact(wt_int=wt_int)
    assert script.read_at == pytest.approx([2 ** (wt_int / 4 - 1) / 1000 * reads for reads in (1, 2, 3)])


@pytest.mark.parametrize(
    ("wt_int", "n_wait", "milliseconds"),
    [
        (4, 2, [1, 2, 3, 5, 9, 17, 33, 65, 97, 129]),  # from the third read on twice as long, up to 32 ms
        (4, 0, [1, 3, 7, 15, 31, 63, 95, 127, 159, 191]),
        (32, 0, [128 * reads for reads in range(1, 11)]),  # never shorter than the node's own
    ],
)
def test_past_n_wait_a_station_reads_less_and_less_often(wt_int: int, n_wait: int, milliseconds: list[int]) -> None:
    script = Script(b"")
    with pytest.raises(NodeSilentError):
        script.transact(wt_int=wt_int, n_wait=n_wait)
    assert [round(1000 * at) for at in script.read_at[:10]] == milliseconds


def test_a_message_is_as_long_as_the_tag_takes_and_no_longer() -> None:
    for max_ndef in (60, 200, 288, 289, 300):
        script = Script(OK, *[answer(Piece(3, 1000, at, b"", answer=True)) for at in range(0, 30000, 40)])
        with pytest.raises((GarbledError, NodeSilentError)):
            script.transact(wt_int=4, max_ndef=max_ndef, frame=bytes(1000))
        assert max(map(len, script.written)) == max_ndef


@pytest.mark.parametrize("wt_int", [0, 4, 20, 36, 44])
def test_a_station_gives_up_after_its_own_5_s(wt_int: int) -> None:
    script = Script(b"")
    with pytest.raises(NodeSilentError):
        script.transact(wt_int=wt_int, n_wait=0)
    assert 5.0 <= script.now < 5.1


def test_a_node_that_announces_more_time_than_5_s_gets_it_up_to_15_s() -> None:
    for wt_int, n_wait, seconds in ((40, 15, 8.2), (60, 15, 15.0)):
        script = Script(b"")
        with pytest.raises(NodeSilentError):
            script.transact(wt_int=wt_int, n_wait=n_wait)
        assert script.now == pytest.approx(seconds, abs=0.1)


@pytest.mark.parametrize(
    "reads",
    [
        [message.encode([tnep.status(1)])],
        [OK, message.encode([tnep.status(0x81)])],
        [OK, OK],
        [OK, message.encode([tnep.payload_record(Piece(3, 2, 0, b"ok", answer=True).encode())])],
        [OK, answer(Piece(3, 9, 0, b"", answer=True))],  # never holds anything
        [OK, b"\xd1torn"],
    ],
)
def test_what_breaks_the_wire_format_is_garbled(reads: list[bytes]) -> None:
    with pytest.raises(GarbledError):
        Script(*reads).transact()


def test_a_node_that_takes_too_little_is_named() -> None:
    with pytest.raises(GarbledError, match="at most 30 octets"):
        Script(OK).transact(max_ndef=30)


@pytest.mark.parametrize("max_ndef", [39, 33, 0])
def test_a_node_whose_messages_hold_no_octet_of_an_answer_is_refused_unasked(max_ndef: int) -> None:
    """profile.md: room for maxNdef - 33 octets in a request and 6 fewer in an answer."""
    script = Script(OK, GOOD)
    with pytest.raises(GarbledError, match=f"NDEF messages of at most {max_ndef} octets, too short"):
        script.transact(max_ndef=max_ndef)
    assert not script.written
    assert Script(OK, GOOD).transact(max_ndef=40, frame=b"abcd"[:1]) == b"ok"


def test_the_service_is_selected_once_for_all_transactions() -> None:
    script = Script(OK, GOOD, answer(Piece(4, 2, 0, b"on", answer=True)))
    service = tnep.ServiceParameters(tnep.SERVICE, 4, 15, 300)
    poller = Poller(script, service, clock=lambda: script.now, sleep=script.sleep)
    assert (poller.transact(3, b"abcd"), poller.transact(4, b"efgh")) == (b"ok", b"on")
    assert script.written.count(select()) == 1
