"""Command frames between two processes, a station's reader and a node's emulated tag, on loopback NFC frames."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Iterator

import pytest

from teds_provision.errors import GarbledError, NodeSilentError, NoNodeError, NoReaderError, UsageError
from teds_provision.links import Contact, LinkSettings, Notice, Port, open_port
from teds_provision.links.nfc import message
from teds_provision.links.nfc import port as port_module
from teds_provision.links.nfc.message import EXTERNAL, WELL_KNOWN, NdefRecord
from teds_provision.links.nfc.tnep import ID_TYPE, SERVICE, ServiceParameters
from teds_provision.protocol.messages.identity import NodeState
from tests.pace import PATIENCE, best_of

from .conftest import UUID, StartNode

pytestmark = pytest.mark.link
OTHER = "FFEEDDCCBBAA99887766"


@pytest.fixture
def port(path: str) -> Iterator[Port]:
    port = open_port(LinkSettings(nfc=path))
    yield port
    port.close()


@pytest.fixture
def notices() -> list[Notice]:
    return []


def find(port: Port, notices: list[Notice], uuid: str = UUID, seconds: float = PATIENCE) -> Contact:
    return port.find(lambda identity: identity.uuid.hex().upper() == uuid, seconds=seconds, notice=notices.append)


def waited_past(port: Port, notices: list[Notice], uuid: str = UUID, kind: str = "foreign-tag") -> list[Notice]:
    """What is told of what lies there instead, within the first of some times in which anything is told of it."""
    for seconds in (1.5, 6, 24):
        notices.clear()
        with pytest.raises(NoNodeError):
            find(port, notices, uuid, seconds=seconds)
        if reported := [notice for notice in notices if notice.kind == kind]:
            break
    return reported


def echo(contact: Contact, size: int) -> None:
    frame = os.urandom(size)
    assert contact.link.exchange(frame) == b"\x01" + frame[::-1]


@pytest.mark.parametrize("tag", ["4", "2"])
def test_frames_of_every_size_come_back_whole(start_node: StartNode, port: Port, notices: list, tag: str) -> None:
    start_node(tag=tag)
    contact = find(port, notices)
    assert contact.link.via == port.via == "nfc"
    for size in (4, 10, 100, 203, 204, 205, 418, 419, 420, 1024, 4093):
        echo(contact, size)
    contact.link.close()


@pytest.mark.parametrize("tag", ["4", "2"])
@pytest.mark.parametrize("max_ndef", [60, 100, 300])
def test_a_node_with_little_memory_gets_everything_in_pieces(
    start_node: StartNode, port: Port, notices: list, tag: str, max_ndef: int
) -> None:
    start_node(tag=tag, max_ndef=max_ndef, wt_int=0)
    contact = find(port, notices)
    for size in (10, max_ndef, 1024):
        echo(contact, size)


@pytest.mark.parametrize(
    ("tag", "uid"),
    [("4", "08A1B2C3"), ("4", "04112233445566"), ("4", "04112233445566778899"), ("2", "04A1B2C3D4E5F6")],
)
def test_the_tap_says_who_the_node_is(start_node: StartNode, port: Port, notices: list, tag: str, uid: str) -> None:
    start_node(tag=tag, uid=uid)
    contact = find(port, notices)
    assert contact.tag_uid == bytes.fromhex(uid)
    assert contact.identity.uuid.hex().upper() == UUID
    assert contact.identity.state is NodeState.KEYED
    assert contact.identity.max_message == 4094


@pytest.mark.parametrize("tag", ["4", "2"])
def test_the_id_record_is_renewed_when_identify_changes(
    start_node: StartNode, port: Port, notices: list, tag: str
) -> None:
    start_node(tag=tag)
    contact = find(port, notices)
    echo(contact, 10)
    echo(contact, 20)
    contact.link.close()
    assert find(port, notices).identity.epoch == 2


@pytest.mark.parametrize("tag", ["4", "2"])
def test_a_slow_node_is_waited_for_past_what_it_announced(
    start_node: StartNode, port: Port, notices: list, tag: str
) -> None:
    node = start_node(tag=tag, delay=2.0, wt_int=8, n_wait=0)
    contact = find(port, notices)
    began = time.monotonic()
    echo(contact, 300)
    assert time.monotonic() - began > 1.9
    node.wait_for("request 1")
    assert not notices or notices[-1].kind != "retry"


def test_a_node_that_takes_longer_than_5_s_is_asked_again_and_runs_it_once(
    start_node: StartNode, port: Port, notices: list
) -> None:
    node = start_node(delay=6.0)
    contact = find(port, notices)
    echo(contact, 30)
    assert [notice.kind for notice in notices].count("retry") == 1
    contact.link.close()
    assert find(port, notices).identity.epoch == 1
    node.end()


def test_a_torn_answer_is_read_again_and_the_frame_repeated(start_node: StartNode, port: Port, notices: list) -> None:
    start_node(torn=1)
    contact = find(port, notices)
    echo(contact, 100)
    assert "retry" in [notice.kind for notice in notices]


def test_answers_that_stay_torn_are_garbled_at_last(start_node: StartNode, port: Port, notices: list) -> None:
    start_node(torn=1000)
    contact = find(port, notices)
    with pytest.raises(GarbledError, match="CRC-32"):
        contact.link.exchange(b"\0\0\x80\x0b\0\0")


def foreign_message() -> str:
    other_service = ServiceParameters(b"urn:nfc:sn:handover", 20, 4, 300).record()
    return message.encode([NdefRecord(WELL_KNOWN, b"U", b"\x04example.org"), other_service]).hex()


@pytest.mark.parametrize("tag", ["4", "2"])
def test_a_foreign_tag_is_named_once_and_waited_past(
    start_node: StartNode, port: Port, notices: list, tag: str
) -> None:
    start_node(tag=tag, uid="02112233445566", initial=foreign_message())
    reported = waited_past(port, notices)
    assert len(reported) == 1
    for part in ("02112233445566", f"Type {tag}", "urn:nfc:wkt:U", "urn:nfc:wkt:Tp"):
        assert part in reported[0].text


def test_a_node_put_down_after_a_foreign_tag_is_found(start_node: StartNode, port: Port, notices: list) -> None:
    stranger = start_node(initial=foreign_message())
    start_node(ready=False, tag="2")
    waited_past(port, notices)
    stranger.end()
    assert find(port, notices).identity.uuid.hex().upper() == UUID


@pytest.mark.parametrize(
    ("initial", "cause"),
    [
        ("D1010354", "unreadable"),
        ("", "empty NDEF message"),
        (message.encode([ServiceParameters(SERVICE, 20, 15, 500).record()]).hex(), "no id record"),
        (
            message.encode(
                [ServiceParameters(SERVICE, 20, 15, 500).record(), NdefRecord(EXTERNAL, ID_TYPE, b"\x02" * 23)]
            ).hex(),
            "version 2",
        ),
    ],
)
def test_a_tag_that_says_nonsense_is_a_foreign_tag(
    start_node: StartNode, port: Port, notices: list, initial: str, cause: str
) -> None:
    start_node(initial=initial)
    text = waited_past(port, notices)[0].text
    assert cause in text or (cause == "unreadable" and "NDEF message" in text)


def test_other_records_and_services_beside_ours_do_not_matter(start_node: StartNode, port: Port, notices: list) -> None:
    from teds_provision.protocol.messages.identity import Identity

    identity = Identity(bytes.fromhex(OTHER), NodeState.FACTORY, 0, 0, 1024, 0).encode()
    records = [
        NdefRecord(WELL_KNOWN, b"T", b"\xff\xff not even text"),
        NdefRecord(WELL_KNOWN, b"Tp", b"\x10\xf0short"),
        ServiceParameters(b"urn:nfc:sn:handover", 20, 4, 300).record(),
        NdefRecord(EXTERNAL, b"Teds-Provision:ID", identity),
        NdefRecord(2, b"text/plain", b"x" * 300, b"id"),
        ServiceParameters(SERVICE, 12, 15, 120).record(),
    ]
    start_node(initial=message.encode(records).hex(), max_ndef=700)
    contact = find(port, notices, OTHER)
    echo(contact, 600)


def test_another_node_is_waited_past_and_named(start_node: StartNode, port: Port, notices: list) -> None:
    start_node()
    (reported,) = waited_past(port, notices, OTHER, "waiting")
    assert UUID.lower() in reported.text
    assert {notice.kind for notice in notices} <= {"waiting", "retry"}  # a busy machine tries again


def test_an_empty_reader_gives_no_node_in_time(port: Port, notices: list) -> None:
    def looked() -> float:
        notices.clear()
        began = time.monotonic()
        with pytest.raises(NoNodeError) as caught:
            find(port, notices, seconds=0.6)
        assert caught.value.exit_code == 5
        assert [notice.kind for notice in notices] == ["waiting"]
        return time.monotonic() - began

    best_of(5, 2.5, looked, because="a try is 0.6 s of waiting, by a reader in another process")


@pytest.mark.parametrize("tag", ["4", "2"])
def test_a_node_taken_away_in_the_middle_of_a_transfer_is_silent(
    start_node: StartNode, port: Port, notices: list, tag: str
) -> None:
    node = start_node(tag=tag, delay=1.0)
    contact = find(port, notices)
    timer = threading.Timer(0.4, node.kill)
    timer.start()
    with pytest.raises(NodeSilentError, match="removed from the reader"):
        contact.link.exchange(bytes(900))
    timer.join()
    contact.link.close()


def test_a_node_swapped_for_another_gets_nothing_of_the_transfer(
    start_node: StartNode, port: Port, notices: list, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(port_module, "RETURN_WITHIN", PATIENCE)  # until it is there, however busy the machine is
    first = start_node(delay=1.0)
    second = start_node(uuid=OTHER, ready=False)
    contact = find(port, notices)
    timer = threading.Timer(0.4, first.kill)
    timer.start()
    with pytest.raises(NodeSilentError, match=OTHER.lower()):
        contact.link.exchange(bytes(900))
    timer.join()
    assert find(port, notices, OTHER).identity.epoch == 0  # it ran no frame
    second.end()


@pytest.mark.parametrize("tag", ["4", "2"])
def test_a_node_that_slipped_off_for_a_moment_goes_on(
    start_node: StartNode, port: Port, notices: list, tag: str
) -> None:
    first = start_node(tag=tag)
    again = start_node(tag=tag, ready=False)  # queues for the reader
    contact = find(port, notices)
    echo(contact, 50)
    first.kill()
    again.wait_for("ready")
    echo(contact, 500)
    again.wait_for("request 1")
    assert "retry" in [notice.kind for notice in notices]


def test_a_node_forgets_with_the_field(start_node: StartNode, port: Port, notices: list) -> None:
    node = start_node()
    echo(find(port, notices), 10)
    node.wait_for("request 1")
    find(port, notices)  # the field goes off and on
    node.wait_for("lost")


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "example.org", "127.0.0.2"])
def test_a_simulated_reader_is_refused_outside_loopback(host: str) -> None:
    with pytest.raises(UsageError, match="loopback"):
        open_port(LinkSettings(nfc=f"udp:{host}:5000"))


@pytest.mark.parametrize(
    "bad", ["udp:localhost:0", "udp:localhost:99999", "udp:localhost:x", "udp:a:b:c", "bluetooth", "usb:", "tty", ""]
)
def test_what_is_no_reader_path_is_a_usage_error(bad: str) -> None:
    from teds_provision.links.nfc.port import NfcPort

    with pytest.raises(UsageError):
        NfcPort(bad)


def test_no_serial_reader_says_so() -> None:
    with pytest.raises(NoReaderError) as caught:
        open_port(LinkSettings(nfc="tty:NOSUCH9:pn532"))
    assert caught.value.hint


def test_a_port_with_another_name_is_a_port(monkeypatch: pytest.MonkeyPatch) -> None:
    """10000 stands as webmin in /etc/services; nfcpy took the name for the number."""
    import socket as sockets

    monkeypatch.setattr(sockets, "getnameinfo", lambda address, flags: ("127.0.0.1", "webmin"))
    port = open_port(LinkSettings(nfc="udp:localhost:10000"))
    port.close()


@pytest.mark.parametrize("level", [logging.DEBUG, logging.CRITICAL])
def test_frames_are_formatted_for_the_log_only_with_debug(
    start_node: StartNode,
    port: Port,
    notices: list[Notice],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    level: int,
) -> None:
    """nfcpy formats each frame for its log; with --debug it stands there, without it is not even formatted."""
    from teds_provision.links.nfc.nfcpy import nfc

    formatted: list[bytes] = []
    plain = nfc.clf.print_data
    monkeypatch.setattr(nfc.clf, "print_data", lambda data: (formatted.append(data), plain(data))[1])
    start_node()
    with caplog.at_level(level, logger="nfc"):
        contact = find(port, notices)
        caplog.clear()
        formatted.clear()
        echo(contact, 30)
        contact.link.close()
    logged = {record.name for record in caplog.records if record.name.startswith("nfc.")}
    if level == logging.DEBUG:
        assert formatted
        assert {"nfc.clf", "nfc.tag.tt4"} <= logged
    else:
        assert (formatted, logged) == ([], set())
