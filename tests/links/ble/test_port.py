"""The station's BLE: bleak's own BlueZ code over a private bus, nodes on a virtual radio in another process."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from teds_provision.errors import LinkError, NoNodeError, NoReaderError, UsageError
from teds_provision.links.ble import port as ble_port
from teds_provision.links.ble.port import BlePort, RememberedNodes, cache_file
from teds_provision.links.ble.spec import parse_spec
from teds_provision.links.ports import LISTEN_SECONDS, Contact, DeadlineLink, Notice
from teds_provision.node import node_template
from teds_provision.node.flash_file import FlashFile
from teds_provision.protocol.messages import ble
from teds_provision.protocol.messages.ble import piece_octets
from teds_provision.protocol.messages.frames import Command, Function, security_command, write_teds
from teds_provision.protocol.messages.identity import Identity, NodeState
from tests.node.measuring_station import SealedLine, keyed_node
from tests.pace import PATIENCE, until

from .conftest import ANGLE
from .radio import Radio, needs_dbus

pytestmark = [pytest.mark.link, needs_dbus]
Ports = Callable[..., BlePort]
Air = Callable[..., Radio]
IDENTIFY = security_command(Function.IDENTIFY).encode()


def anyone(_identity: Identity) -> bool:
    return True


def quiet(_notice: Notice) -> None:
    pass


def find(port: BlePort, wanted: Callable[[Identity], bool] = anyone, *, seconds: float = PATIENCE) -> Contact:
    return port.find(wanted, seconds=seconds, notice=quiet)


@pytest.mark.parametrize("mtu", [23, 247, 517])
def test_frames_of_every_length_travel_at_the_mtu_of_the_connection(air: Air, port: Ports, mtu: int) -> None:
    radio = air(manners={"mtu": mtu})
    contact = find(port())
    line = SealedLine(contact.link, contact.identity.uuid)
    before = radio.do("pieces", 0)
    room = piece_octets(mtu)
    overhead = 6 + 14 + 7 + 16  # what sealing adds does not matter to the count by one piece
    for octets in (room - overhead, room, 1800):
        written = bytes(range(256)) * 8
        line.send(write_teds(1, 3, 0, written[: max(1, octets)]))
    assert line.send(
        Command(1, 1, 2, b"\x03" + bytes(4))
    )  # Read of the Channel TEDS, which takes several notifications
    assert radio.do("pieces", 0) - before >= 1800 // room


def test_a_request_whose_connection_is_cut_is_repeated_over_a_new_one(air: Air, port: Ports) -> None:
    radio = air(manners={"mtu": 23})
    notices: list[Notice] = []
    contact = port().find(anyone, seconds=30, notice=notices.append)
    radio.do("cut", 0, 0)
    assert contact.link.exchange(IDENTIFY)
    assert [notice.kind for notice in notices if notice.kind != "waiting"] == ["retry"]
    assert radio.do("counts")["connects"] == 2


def test_an_order_whose_connection_is_cut_is_given_up(air: Air, port: Ports) -> None:
    """operation.md section 2, "No late orders": it is not sent again over another connection."""
    radio = air(manners={"mtu": 23})
    link = find(port()).link
    assert isinstance(link, DeadlineLink)
    assert link.exchange_within(IDENTIFY, 10.0)
    radio.do("cut", 0, 0)
    with pytest.raises(LinkError):
        link.exchange_within(IDENTIFY, 10.0)
    assert radio.do("counts")["connects"] == 1


def test_an_adapter_that_is_busy_after_a_cut_is_waited_for(air: Air, port: Ports) -> None:
    """As real bluetoothd is: after a connection ended it answers "busy" for seconds."""
    radio = air()
    contact = find(port())
    radio.do("manners", {"refusals": 4})
    radio.do("drop", 0)
    until(lambda: radio.do("lines", 0) == 0)
    assert contact.link.exchange(IDENTIFY)
    assert radio.do("manners", {})["refusals"] == 0


def test_a_session_does_not_outlive_its_connection(air: Air, port: Ports) -> None:
    radio = air()
    contact = find(port())
    line = SealedLine(contact.link, contact.identity.uuid)
    radio.do("drop", 0)
    until(lambda: radio.do("lines", 0) == 0)
    reply = contact.link.exchange(line.session.seal(security_command(Function.IDENTIFY)).encode())
    assert reply[0] == 0, "the node refuses what is sealed in a session that is gone"
    SealedLine(contact.link, contact.identity.uuid)


def test_twenty_nodes_are_asked_one_after_the_other(air: Air, port: Ports) -> None:
    radio = air(20)
    contacts = port().find_all(seconds=60, notice=quiet)
    assert len({contact.identity.uuid for contact in contacts}) == 20
    counts = radio.do("counts")
    assert counts["most_held"] == 1
    assert counts["pending_at_once"] == 1
    assert contacts[7].link.exchange(IDENTIFY), "and each is connected again when its turn comes"


def test_who_collects_listens_for_as_long_as_requested(air: Air, port: Ports, tmp_path: Path) -> None:
    """`identify --timeout 120` ended after 1.5 s of silence, with one node of two."""
    keyed_node(tmp_path / "keyed", profile=ANGLE)
    FlashFile.create(tmp_path / "new", uuid=bytes(range(10)))
    radio = air([tmp_path / "keyed", tmp_path / "new"])
    late = threading.Timer(5, lambda: radio.do("tap", 1))
    late.start()
    began = time.monotonic()
    contacts = port().find_all(seconds=60, notice=quiet, listen=12)
    assert len(contacts) == 2
    assert time.monotonic() - began >= 12
    late.join()


def test_who_says_no_time_listens_for_three_seconds_at_least(air: Air, port: Ports) -> None:
    air()
    began = time.monotonic()
    assert len(port().find_all(seconds=60, notice=quiet, listen=LISTEN_SECONDS)) == 1
    assert time.monotonic() - began >= LISTEN_SECONDS


@pytest.mark.parametrize(
    ("kind", "uuid", "error"),
    [("read", ble.WRITE, 0x02), ("read", ble.NOTIFY, 0x02), ("read", ble.DATA, 0x02), ("write", ble.NOTIFY, 0x03)],
)
def test_what_a_characteristic_does_not_offer_is_refused_at_once(air: Air, kind: str, uuid: str, error: int) -> None:
    """A read of the write characteristic was never answered: a phone's explorer hangs for 30 s, and disconnects."""
    assert air().do("access", 0, kind, uuid) == error


def test_one_connect_at_a_time(air: Air, port: Ports) -> None:
    radio = air(3, manners={"in_progress": True})
    bluetooth = port()
    contacts = bluetooth.find_all(seconds=30, notice=quiet)
    replies: list[bytes] = []
    threads = [
        threading.Thread(target=lambda item=contact: replies.append(item.link.exchange(IDENTIFY)))
        for contact in contacts
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(replies) == 3
    assert radio.do("counts")["pending_at_once"] == 1


def test_bleaks_own_retries_are_no_loss(air: Air, port: Ports) -> None:
    """BlueZ connects, and disconnects by itself, with le-connection-abort-by-local."""
    air(manners={"aborts": 2})
    notices: list[Notice] = []
    assert port().find(anyone, seconds=30, notice=notices.append).link.exchange(IDENTIFY)
    assert not [notice for notice in notices if notice.kind == "retry"]


def test_a_stale_cache_of_services_is_removed_once(air: Air, port: Ports) -> None:
    radio = air(manners={"stale": True})
    assert find(port()).identity
    assert radio.do("counts")["removed"] == 1


def test_a_device_that_never_has_the_service_is_reported(air: Air, port: Ports) -> None:
    radio = air(manners={"always_stale": True})
    notices: list[Notice] = []
    with pytest.raises(NoNodeError):
        port().find(anyone, seconds=2, notice=notices.append)
    assert any("does not offer it" in notice.text for notice in notices)
    assert radio.do("counts")["removed"] <= 2


def test_bluez_may_have_forgotten_the_node(air: Air, port: Ports) -> None:
    radio = air(manners={"forget": 0.5})
    contact = find(port())
    contact.link.close()
    until(lambda: radio.do("counts")["known"] == 0)
    assert contact.link.exchange(IDENTIFY)


def test_if_the_adapter_is_full_an_idle_connection_makes_room(air: Air, port: Ports) -> None:
    radio = air(3, manners={"limit": 2})
    contacts = port().find_all(seconds=30, notice=quiet)
    for contact in contacts:
        contact.link.exchange(IDENTIFY)
    assert radio.do("counts")["most_held"] == 2


def test_a_full_adapter_is_named_if_every_connection_is_needed(air: Air, port: Ports) -> None:
    air(3, manners={"limit": 2})
    contacts = port().find_all(seconds=30, notice=quiet)
    for contact in contacts[:2]:
        contact.link.exchange(IDENTIFY)
        contact.link.connection.streaming = True  # type: ignore[attr-defined]
    with pytest.raises(LinkError, match="holds 2 connections and takes no more") as failure:
        contacts[2].link.exchange(IDENTIFY)
    assert "add an adapter" in failure.value.hint


def test_the_address_may_be_named(air: Air, port: Ports) -> None:
    radio = air(2)
    contact = find(port(f"hci0?address={radio.addresses[1].lower()}"))
    assert radio.do("lines", 1) == 1
    assert radio.do("lines", 0) == 0
    assert contact.connection is not None


def test_a_node_that_was_met_before_is_asked_alone(air: Air, port: Ports) -> None:
    """Its address is kept from command to command, so that twenty others are left in peace."""
    radio = air(6)
    first = port()
    contacts = first.find_all(seconds=30, notice=quiet)
    first.close()
    before = radio.do("counts")["connects"]
    wanted = contacts[4].identity.uuid
    assert find(port(), lambda identity: identity.uuid == wanted).identity.uuid == wanted
    assert radio.do("counts")["connects"] == before + 1


def test_the_cache_keeps_the_nodes_that_were_met_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ble_port, "MOST", 2)
    known = RememberedNodes(tmp_path / "cache.json")
    for number in range(4):
        known.remember_node(f"C0:{number}", Identity(bytes([number] * 10), NodeState.KEYED, 1, 0, 1024, 0))
    known.save()
    assert [address for address, _ in RememberedNodes(tmp_path / "cache.json").items()] == ["C0:3", "C0:2"]


def test_a_connection_is_kept_for_its_node_while_a_stream_of_it_is_open(port: Ports) -> None:
    own = port()
    connections = [own._link(f"C0:00:00:00:00:0{number}", quiet).connection for number in (1, 2)]
    first = connections[0].number
    seen = []
    for change, stream in ((own.open_stream, 0), (own.open_stream, 1), (own.close_stream, 0), (own.close_stream, 1)):
        change(first, stream, *([20] if change == own.open_stream else []))
        seen.append([connection.streaming for connection in connections])
    assert seen == [[True, False], [True, False], [True, False], [False, False]]


def test_a_cache_that_is_damaged_or_stale_harms_nothing(air: Air, port: Ports) -> None:
    air(1)
    cache_file().parent.mkdir(parents=True)
    cache_file().write_text("{]")
    wanted = find(port()).identity
    cache_file().write_text(json.dumps({"C0:00:00:00:00:01": wanted.encode().hex()}))
    assert find(port(), lambda identity: identity.uuid == wanted.uuid).identity.uuid == wanted.uuid


def test_watching_gives_each_node_once(air: Air, port: Ports) -> None:
    air(2)
    stop, seen = threading.Event(), []
    for contact in port().watch(stop=stop, notice=quiet):
        seen.append(contact.identity.uuid)
        contact.link.close()
        if len(seen) == 2:
            stop.set()
    assert len(set(seen)) == 2


# -- what is wrong with Bluetooth ------------------------------------------------------------------------------------


def test_without_a_system_bus(port: Ports, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", f"unix:path={tmp_path}/nothing")
    with pytest.raises(NoReaderError, match="no D-Bus system bus"):
        find(port(), seconds=2)


@pytest.mark.parametrize(
    ("manners", "message"),
    [({"powered": False}, "switched off"), ({"central": False}, "LE central role is not supported")],
)
def test_an_adapter_that_cannot_be_used(air: Air, port: Ports, manners: dict[str, bool], message: str) -> None:
    air(manners=manners)
    with pytest.raises(NoReaderError, match=message):
        find(port(), seconds=2)


def test_an_adapter_that_is_not_there(air: Air, port: Ports) -> None:
    air()
    with pytest.raises(NoReaderError, match="no Bluetooth adapter hci7"):
        find(port("hci7"), seconds=2)


@pytest.mark.parametrize("text", ["hci0?address=11:22", "hci0?speed=9", "a b"])
def test_what_ble_may_not_send(text: str) -> None:
    with pytest.raises(UsageError):
        parse_spec(text)


# -- the node ---------------------------------------------------------------------------------------------------------


def test_a_stranger_neither_hides_the_node_nor_stays(air: Air, port: Ports) -> None:
    radio = air(stranger_seconds=1.0)
    radio.do("stranger", 0)
    assert find(port()).identity
    until(lambda: radio.do("strangers_held") == 0)


def test_who_has_a_session_stays(air: Air, port: Ports) -> None:
    stranger_seconds = 5.0  # it has so long to open a session; half a second was too little on a busy machine
    radio = air(stranger_seconds=stranger_seconds)
    contact = find(port())
    line = SealedLine(contact.link, contact.identity.uuid)
    line.send(security_command(Function.IDENTIFY))  # until then the Open is half open
    time.sleep(stranger_seconds + 0.5)
    assert line.send(security_command(Function.IDENTIFY))
    assert radio.do("counts")["connects"] == 1


def test_a_new_node_advertises_only_after_a_tap(air: Air, port: Ports, tmp_path: Path) -> None:
    node_template.create(tmp_path / "new", profile=ANGLE)
    radio = air([tmp_path / "new"])
    with pytest.raises(NoNodeError, match="The node did not answer"):
        find(port(), seconds=1.5)
    radio.do("tap", 0)
    assert find(port()).identity


def test_a_reset_gives_another_address_and_ends_the_advertising(air: Air, port: Ports) -> None:
    radio = air()
    assert find(port()).identity
    radio.do("reset", 0)
    until(lambda: radio.do("address", 0) != radio.addresses[0])
    with pytest.raises(NoNodeError):
        find(port(), seconds=1.5)
    radio.do("tap", 0)
    assert find(port(f"?address={radio.do('address', 0)}")).identity
