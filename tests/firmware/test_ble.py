"""The C node in the air: its frames beside the reference's; commands of the station under the stand-in for bluetoothd.

The GATT server and the radio are bumble's, as on a board they are the chip's: what is of the library is every frame.
"""

from __future__ import annotations

import json
import random
import signal
from collections.abc import Callable
from dataclasses import replace

import pytest

from teds_provision.protocol.messages import ble
from teds_provision.protocol.messages.frames import Command, Function, security_command
from teds_provision.protocol.operation.can_frames import ble_frame
from teds_provision.protocol.operation.hardware import SessionPort, port_of
from teds_provision.protocol.repetition import Repetition
from tests.bench import make_station
from tests.e2e.desk import ANGLE, Desk, Station
from tests.firmware.test_beside_python import Station as Beside
from tests.firmware.test_beside_python import Twins
from tests.links.ble.conftest import air  # noqa: F401 - a fixture
from tests.links.ble.radio import Radio, needs_dbus
from tests.links.ble.test_whole_runs import tapped_once
from tests.pace import until

pytestmark = pytest.mark.system
SECONDS = 10**9


class Line:
    """One connection as the reference's peripheral has it."""

    def __init__(self, twins: Twins, number: int, mtu: int) -> None:
        self.twins, self.number, self.mtu = twins, number, mtu
        self.assembly, self.repetition = ble.BleAssembly(0xFFFF), Repetition()
        twins.c.ble_connected(number, mtu)

    def write(self, value: bytes) -> list[bytes]:
        """Both take a piece, and notify the same."""
        received, due = self.assembly.add_frame(value), []
        if received is not None:
            name = f"ble:{self.number + 2:x}"
            reply = self.repetition.answer(
                received.transaction,
                received.message,
                lambda frame: self.twins.py.handle(frame, link=name, tapped=False),
                now=self.twins.now(),
            )
            due = list(ble.cut(received.transaction, reply, self.mtu))
            self.repetition.reply_sent(self.twins.now())
        assert self.twins.c.ble_written(self.number, value) == due, value.hex()
        return due

    def end(self) -> None:
        """The connection is gone."""
        self.twins.py.link_lost(f"ble:{self.number + 2:x}")
        self.twins.c.ble_disconnected(self.number)


def frames(dice: random.Random, transaction: int, mtu: int) -> list[bytes]:
    """Pieces of a command, mostly in order."""
    message = dice.choice(
        (
            lambda: security_command(Function.IDENTIFY).encode(),
            lambda: security_command(Function.PROVE, dice.randbytes(32)).encode(),
            lambda: security_command(Function.LIST).encode(),
            lambda: Command(0, 1, 2, b"\x80" + bytes(4)).encode(),
            lambda: Command(1, 1, 2, b"\x0c" + bytes(4)).encode(),
            lambda: security_command(Function.RESET, bytes(32)).encode(),
            lambda: dice.randbytes(dice.choice((0, 5, 300, 1024, 1025, 5000))),
        )
    )()
    pieces = list(ble.cut(transaction, message, mtu))
    what = dice.random()
    if what < 0.08:
        pieces.pop(dice.randrange(len(pieces)))
    elif what < 0.16:
        pieces.insert(dice.randrange(len(pieces) + 1), dice.choice(pieces))
    elif what < 0.2:
        pieces[-1] += b"more"
    elif what < 0.24:
        pieces.insert(1, pieces[0][:4] + len(pieces[0][6:]).to_bytes(2, "big"))
    elif what < 0.28:
        pieces.insert(dice.randrange(len(pieces) + 1), dice.randbytes(dice.randrange(10)))
    return pieces


@pytest.mark.parametrize("mtu", [23, 247, 517])
def test_both_nodes_notify_the_same(mtu: int) -> None:
    dice, twins = random.Random(mtu), Twins(mtu)
    twins.memory.state = replace(twins.flash, blocks={(1, 12): dice.randbytes(900)})  # more than a value holds
    twins.c.put(twins.flash)
    twins.restart()
    lines = {number: Line(twins, number, mtu) for number in (0, 1)}
    notified, transaction = 0, 0
    for _ in range(150):
        twins.hardware.tick += dice.choice((MS_1, MS_1, SECONDS, 21 * SECONDS))
        line = lines[dice.randrange(2)]
        transaction += dice.random() < 0.8
        for piece in frames(dice, transaction & 0xFFFF, mtu):
            notified += len(line.write(piece))
        if dice.random() < 0.05:
            line.end()
            lines[line.number] = Line(twins, line.number, mtu)
    assert notified > 100
    twins.c.close()


MS_1 = 10**6


class InTheAir(Twins):
    """Both nodes with two connections beside the bus; data messages over either."""

    def __init__(self, seed: int, mtu: int) -> None:
        self.mtu, self.hears, self.notified = mtu, {"ble:2": False, "ble:3": False}, 0
        super().__init__(seed)

    def restart(self) -> None:
        super().restart()
        for link in self.hears:
            self.connect(link)

    def connect(self, link: str) -> None:
        self.hears[link] = False
        self.c.ble_connected(int(link[4:]) - 2, self.mtu)

    def enable(self, link: str, hears: bool) -> None:
        """A station enables data messages, or disables them."""
        self.hears[link] = hears
        if not hears:
            self.py.unheard(link)
        self.c.ble_hears(int(link[4:]) - 2, hears)

    def port(self, link: str) -> SessionPort:
        return port_of(link)._replace(mtu=self.mtu, hears=self.hears.get(link, True))

    def lost(self, link: str) -> None:
        if link not in self.hears:
            super().lost(link)
            return
        self.py.link_lost(link)
        self.c.ble_disconnected(int(link[4:]) - 2)
        self.connect(link)

    def frames(self) -> None:
        super().frames()
        while True:
            mine, theirs = self.py.next_frame("ble"), self.c.ble_data()
            assert (None if mine is None else (mine.link_source - 2, mine.data)) == theirs
            if mine is None:
                return
            self.notified += 1

    def drive(self, link: str, data: bytes, *, fd: bool = False) -> None:
        if link not in self.hears:
            super().drive(link, data, fd=fd)
            return
        self.py.drive(link, data)
        self.c.ble_driven(int(link[4:]) - 2, ble_frame(0, data))
        self.hold()


class Roamer(Beside):
    """A station that talks over the air, and over the bus now and then."""

    drivers = ("ble:2", "ble:3", "can:f1")
    air: InTheAir

    def link(self) -> str:
        return self.dice.choice(("nfc", "ble:2", "ble:2", "ble:3", "can:f1"))

    def hand_over(self, link: str, message: bytes) -> None:
        if link not in self.air.hears:
            super().hand_over(link, message)
            return
        if self.dice.random() < 0.2:
            message = self.dice.choice((message[:-1], message + b"\0", b"", message[:3]))
        self.air.drive(link, message)

    def disturb(self) -> None:
        link = self.dice.choice(list(self.air.hears))
        if self.dice.random() < 0.5:
            self.air.enable(link, self.dice.random() < 0.8)
        else:
            super().disturb()


@pytest.mark.parametrize(("seed", "mtu"), [(0, 247), (1, 247), (2, 64), (3, 23)])
def test_both_nodes_stream_and_are_driven_the_same(seed: int, mtu: int) -> None:
    twins = InTheAir(seed, mtu)
    station = Roamer(twins, 2000 + seed)
    station.air = twins
    twins.enable("ble:2", True)
    station.begin_measuring("ble:2")
    station.measure(subscribe(stream=0, start=0), "ble:2")
    twins.pass_time(100 * MS_1)
    for _ in range(150):
        station.move()
    assert twins.notified > 20
    assert not twins.c.misused
    twins.c.close()


def subscribe(*, stream: int, start: int, n: int = 2, gap: int = 100) -> Command:
    """Subscribe of channel 1, a value each millisecond."""
    asked = bytes([stream, 0, n]) + gap.to_bytes(2, "big") + MS_1.to_bytes(8, "big") + start.to_bytes(8, "big")
    return security_command(Function.SUBSCRIBE, asked + b"\x01")


def test_data_messages_go_over_the_connection_that_enabled_them() -> None:
    twins = InTheAir(5, 24)
    station = Roamer(twins, 5)
    station.air = twins
    station.begin_measuring("ble:2")
    assert station.sealed(subscribe(stream=1, start=0), "ble:2") == (False, b"\x02")  # not enabled
    twins.enable("ble:2", True)
    assert station.sealed(subscribe(stream=1, start=0, n=4), "ble:2") == (False, b"\x0a")  # 21 octets, MTU 24
    assert station.sealed(subscribe(stream=1, start=2**64 - 1), "ble:2") == (False, b"\x15")  # no trigger in the air
    assert station.sealed(subscribe(stream=1, start=0, gap=2001), "ble:2") == (False, b"\x15")  # one message in 2 ms
    assert station.sealed(subscribe(stream=1, start=0, gap=2000), "ble:2")[0]
    twins.pass_time(1000 * MS_1)
    assert twins.notified == pytest.approx(485, abs=1)
    assert station.sealed(subscribe(stream=1, start=0, gap=900), "ble:2")[0]
    assert station.sealed(subscribe(stream=2, start=0, gap=900), "ble:2")[0]
    twins.pass_time(100 * MS_1)  # two are full at once: the second leaves a gap later
    twins.enable("ble:3", False)
    assert twins.py.streaming
    twins.enable("ble:2", False)
    before = twins.notified
    twins.pass_time(100 * MS_1)
    assert not twins.py.streaming
    assert twins.notified == before
    assert station.sealed(Command(1, 3, 1, bytes(4)), "ble:2")[0]  # the claim stands
    twins.c.close()


def test_a_drive_message_is_one_whole_write_under_0() -> None:
    twins = InTheAir(6, 247)
    station = Roamer(twins, 6)
    station.air = twins
    station.begin_measuring("ble:2")
    _layout, sealer = station.driven["ble:2"]
    until = (twins.hardware.tick // 1000 + 10_000).to_bytes(4, "big")
    message = sealer.seal(0, until + b"\x11\x22" + bytes(5))
    for spoilt in (message + b"\0", message[:-1]):
        twins.drive("ble:2", spoilt)
    twins.c.ble_driven(0, ble_frame(1, message))
    twins.c.ble_driven(0, b"")
    assert twins.c.set_point(7, 2) == bytes(2)
    twins.drive("ble:2", message)
    assert twins.c.set_point(7, 2) == b"\x11\x22"
    twins.c.close()


def test_it_advertises_after_a_tap_and_drops_stations_without_a_session() -> None:
    twins = Twins(1)
    node = twins.c
    node.has_nfc()
    assert node.start() == 0
    assert not node.ble_advertises()
    node.nfc_field(True)
    assert node.ble_advertises()
    twins.hardware.tick += 59 * SECONDS
    for connection in (0, 1, 2):
        assert node.ble_advertises()
        node.ble_connected(connection, 23)
    assert not node.ble_advertises()  # there is no room for another one
    node.ble_disconnected(1)
    assert node.ble_advertises()
    twins.hardware.tick += SECONDS
    assert not node.ble_advertises()  # a minute after the tap
    twins.hardware.tick += 8 * SECONDS
    assert not node.ble_drops(0)
    twins.hardware.tick += SECONDS
    assert node.ble_drops(0)
    node.close()


def test_a_station_with_a_session_is_not_dropped_and_ten_seconds_after_its_end_it_is() -> None:
    twins = InTheAir(7, 247)
    station = Roamer(twins, 7)
    station.air = twins
    station.begin_measuring("ble:2")
    for _ in range(3):
        twins.hardware.tick += 60 * SECONDS
        assert not twins.c.ble_drops(0)
        assert twins.c.ble_drops(1), "the other connection has none"
    assert station.sealed(security_command(Function.CLOSE), "ble:2")[0]
    twins.hardware.tick += 9 * SECONDS
    assert not twins.c.ble_drops(0)
    twins.hardware.tick += SECONDS
    assert twins.c.ble_drops(0)
    twins.c.close()


@needs_dbus
@pytest.mark.link
def test_it_is_checked_written_verified_and_measured_over_the_air(
    tmp_path_factory: pytest.TempPathFactory,
    air: Callable[..., Radio],  # noqa: F811
) -> None:
    folder = tmp_path_factory.mktemp("c-air")
    desk = Desk(folder, folder)
    try:
        station = make_station(folder / "home")
        tapped_once(station, folder / "node")
        station.close()
        radio = air([folder / "node"], in_c=True)
        bench = Station(desk, folder / "home")
        done = bench.ask("node", "check", "--via", "ble")
        assert done["failed"] == 0, [check for check in done["checks"] if check["result"] == "failed"]
        passed = {check["rule"] for check in done["checks"] if check["result"] == "passed"}
        assert {"repetition", "sealed-counter", "open-once"} <= passed
        radio.do("manners", {"mtu": 23})
        written = bench.ask("provision", "--profile", ANGLE, "--name", "by air", "--yes", "--via", "ble")
        assert (written["verdict"], written["name"]) == ("authentic", "by air")
        radio.do("manners", {"mtu": 517})
        assert bench.ask("verify", done["uuid"], "--via", "ble")["verdict"] == "authentic"
        assert radio.do("pieces", 0) > 20
        running = bench.start("--json", "measure", done["uuid"], "--ble", "auto", "--rate", "100")
        until(lambda: (running.read(0.1), running.out.count('"event":"data"') > 30)[1])
        running.signal(signal.SIGTERM)
        measured = running.end()
        assert measured.code == 0, measured
        (node,) = json.loads(measured.out.splitlines()[-1])["nodes"]
        assert all(stream["samples"] > 30 and stream["bad"] == 0 for stream in node["streams"])
    finally:
        desk.clear()
