"""Nodes that come to a station which measures all: how soon they are on a topic, and what they cost those that are in.

Run: ``python -m benchmarks.newcomers [--joins 20] [--many 200] [--seconds 60] [--only one|twenty|many]``

Virtual nodes in two processes on a paced bus (500 kbit/s, and FD 500k/2M for the many), `ncap run --measure all --mqtt`
as a user starts it, a mosquitto on loopback, and a listener that hears every frame: a node's Announce begins its time,
its first value on an MQTT topic ends it. Nodes are immediate and known (their datasheets are kept), and their addresses
do not meet. The computed row is what the frames of that many joinings occupy of the wire, taken from the frames of one;
lost messages are printed beside those that the nodes' own process could not send in time.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.commands import PASSPHRASE, Rows, started
from benchmarks.machine import line as machine
from benchmarks.measure_time import CALIBRATION, TYPE
from benchmarks.ncap import memory
from teds_provision import client
from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.pacing import classic_bits, fd_seconds
from teds_provision.links.can.spec import parse_spec
from teds_provision.links.ports import free_port
from teds_provision.node.can.endpoint import CanEndpoint
from teds_provision.node.can.server import CanServer
from teds_provision.node.hardware.board import Board
from teds_provision.node.node_template import create
from teds_provision.node.realtime_loop import RealtimeLoop
from teds_provision.node.virtual import VirtualNode
from teds_provision.protocol.announce import LAST_ADDRESS, default_can_address, is_announce
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.station.station import Station, initialise
from teds_provision.teds.image import Image
from teds_provision.teds.sheet import Sheet
from teds_provision.vault import passphrase
from teds_provision.vault.selection import forget_vaults
from tests.bench import on_reader

BASE = 20
FIRST, TOGETHER, CLOCK_SHARE = 1.0, 5.0, 10.0  # aims: s (p95), s, % of a bus with 200 nodes
MEMORY, MEMORY_OF_A_NODE = 100.0, 0.15  # aims, MB
PATIENCE = 120.0
BITRATE, DATA_BITRATE = 500_000, 2_000_000
MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/bin:/usr/local/sbin")


# -- the nodes' process: "on NAME …" hangs nodes on the bus together, "off NAME …" cuts their power -------------------


class AnnouncingServer(CanServer):
    """A bus that remembers when its first node announced itself (monotonic)."""

    first = math.inf

    def _out(self, seat: CanEndpoint, frame: Frame) -> None:
        if is_announce(frame.identifier):
            self.first = min(self.first, time.monotonic())
        super()._out(seat, frame)


class Power:
    """The nodes of a folder, each by its name."""

    def __init__(self, link: str, folder: Path) -> None:
        self._link, self._folder, self._pulse = link, folder, RealtimeLoop()
        self._on: dict[str, tuple[AnnouncingServer, VirtualNode]] = {}
        self._missed = 0
        self._pulse.start()

    def on(self, names: Sequence[str]) -> None:
        """Hang them on the bus, as a board that gets power does."""
        server = AnnouncingServer(self._link)
        for name in names:
            node = VirtualNode(
                self._folder / name,
                board=lambda file: Board(Sheet.from_image(Image(file.load().uuid, file.hardware)), source="ramp:2"),
                pulse=self._pulse,
            )
            server.add(node, measuring_handler=node)
            node.streams_over(partial(_send, server, node))
            assert node.board is not None
            node.board.start()
            self._on[name] = server, node
        server.start()

    def off(self, names: Sequence[str]) -> None:
        """Cut their power; all that came together go together."""
        for server in {self._on[name][0] for name in names}:
            server.stop()
        for name in names:
            node = self._on.pop(name)[1]
            assert node.board is not None
            node.board.stop()

    def announced(self, names: Sequence[str]) -> float:
        """Return when the first of these announced itself."""
        return min(self._on[name][0].first for name in names)

    def missed(self, names: Sequence[str]) -> int:
        """Return the messages that these could not send in time."""
        return sum(self._on[name][1].tim.missed for name in names)


def _send(server: CanServer, node: VirtualNode, frame: Any) -> None:
    server.send_data(node, frame.identifier, frame.data, fd=frame.fd)


def serve(link: str, folder: Path) -> None:
    power = Power(link, folder)
    for line in sys.stdin:
        word, *names = line.split()
        print(getattr(power, word)(names), flush=True)


# -- the bus, heard -------------------------------------------------------------------------------------------------


@dataclass
class Wire:
    """Every frame of the bus with its time (monotonic), until :meth:`close`."""

    link: str
    frames: list[tuple[float, Frame]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._bus, self._stop = Bus(parse_spec(self.link.replace("&pace=1", ""))), threading.Event()
        self._thread = threading.Thread(target=self._hear, daemon=True)
        self._thread.start()

    def _hear(self) -> None:
        while not self._stop.is_set():
            frame = self._bus.receive(0.2)
            if frame is not None:
                self.frames.append((time.monotonic(), frame))

    def seconds(self, since: float, until: float, *, address: int | None = None) -> tuple[float, float]:
        """Return the wire time of commands and replies, and of data; of one node, or of all."""
        talk = data = 0.0
        for at, frame in self._after(since):
            sender, to = frame.identifier & 0xFF, frame.identifier >> 8 & 0xFF
            if at > until or (address is not None and address not in (sender, to)):
                continue
            wire_time = (
                fd_seconds(frame.identifier, frame.data, BITRATE, DATA_BITRATE)
                if frame.fd
                else classic_bits(frame.identifier, frame.data) / BITRATE
            )
            if frame.identifier >> 16 == 0x1CFF:
                data += wire_time
            else:
                talk += wire_time
        return talk, data

    def _after(self, since: float) -> list[tuple[float, Frame]]:
        frames, at = self.frames, len(self.frames)
        while at and frames[at - 1][0] > since:
            at -= 1
        return frames[at:]

    def close(self) -> None:
        """Hear no more."""
        self._stop.set()
        self._thread.join(2)
        self._bus.close()


class Topics:
    """Times at which the first value of each node came on a topic since :meth:`reset`."""

    def __init__(self, port: int) -> None:
        import paho.mqtt.client as paho
        from paho.mqtt.enums import CallbackAPIVersion

        self.first: dict[str, float] = {}
        self._client = paho.Client(CallbackAPIVersion.VERSION2)
        self._client.on_connect = self._subscribe
        self._client.on_message = self._came
        until(lambda: self._connects(port))
        self._client.loop_start()

    def _connects(self, port: int) -> bool:
        try:
            self._client.connect("127.0.0.1", port)
        except OSError:
            return False
        return True

    def _subscribe(self, *_: Any) -> None:
        self._client.subscribe("bench/#")

    def _came(self, _client: Any, _data: Any, message: Any) -> None:
        parts = message.topic.split("/")
        if not message.retain and len(parts) == 2:
            self.first.setdefault(parts[1], time.monotonic())

    def reset(self) -> None:
        """Count from now on."""
        self.first = {}

    def close(self) -> None:
        """Hear no more."""
        self._client.disconnect()
        self._client.loop_stop()


# -- a scene --------------------------------------------------------------------------------------------------------


def until(found: Callable[[], Any], seconds: float = PATIENCE, why: str = "It did not come about.") -> None:
    """Wait until it is so."""
    end = time.monotonic() + seconds
    while not found():
        if time.monotonic() > end:
            raise SystemExit(why)
        time.sleep(0.01)


@contextmanager
def temporary() -> Iterator[Path]:
    """Yield a folder on the disk of the benches."""
    with tempfile.TemporaryDirectory(dir=os.environ.get("BENCH_DISK")) as folder:
        yield Path(folder)


def made(station: Station, folder: Path, count: int) -> dict[str, bytes]:
    """Make ``count`` provisioned nodes, by name; no two have one address."""
    (folder / "calibration.csv").write_text(CALIBRATION)
    found: dict[str, bytes] = {}
    for number, address in zip(range(count), range(1, LAST_ADDRESS + 1), strict=False):
        name, tail = f"n{number}", 0
        while default_can_address(uuid := bytes([2, *number.to_bytes(2, "big"), *tail.to_bytes(7, "big")])) != address:
            tail += 1
        create(folder / name, name=name, profile=TYPE, uuid=uuid).release()
        node = VirtualNode(folder / name)
        order = BuildOrder(TYPE, calibration=folder / "calibration.csv", name=name)
        with Conversation(on_reader(node), notice=lambda _notice: None) as talk:
            provision(station, talk, order, operator=AcceptingOperator(), reporter=SilentReporter())
        found[name] = uuid
    return found


@dataclass
class Scene:
    """A station that measures all, a broker, the nodes' process, and who listens."""

    rows: Rows
    wire: Wire
    topics: Topics
    boards: list[subprocess.Popen[str]]
    here: client.Client
    uuids: dict[str, bytes]
    ncap: subprocess.Popen[str]

    def power(self, word: str, *names: str) -> list[str]:
        """Tell the processes of these nodes, the first twenty's or the others'; what they answer."""
        first = {f"n{number}" for number in range(BASE)}
        parts = [[name for name in names if (name in first) == is_first] for is_first in (True, False)]
        asked = [(process, part) for process, part in zip(self.boards, parts, strict=True) if part]
        for process, part in asked:
            assert process.stdin is not None
            process.stdin.write(" ".join((word, *part)) + "\n")
            process.stdin.flush()
        return [process.stdout.readline().strip() for process, _ in asked if process.stdout is not None]

    def joins(self, names: Sequence[str]) -> tuple[float, float, float]:
        """Switch them on; when the first of them announced itself, when the last had a value, and since when it was."""
        self.topics.reset()
        began = time.monotonic()
        self.power("on", *names)
        until(lambda: self.topics.first.keys() >= set(names), why=f"{len(names)} nodes: {len(self.topics.first)} came")
        return began, min(map(float, self.power("announced", *names))), max(self.topics.first[name] for name in names)

    def leaves(self, *names: str) -> None:
        """Cut their power, and wait until the station has seen it."""
        self.power("off", *names)
        until(lambda: not self.measured() & {self.uuids[name].hex() for name in names})

    def measured(self) -> set[str]:
        """Return the UUIDs of the measured nodes."""
        return set(self.here.measurements()[0]["uuids"])

    def lost_until_now(self, names: Sequence[str]) -> tuple[int, int]:
        """Return messages of these that were lost, late or bad, and those that their own process left out."""
        time.sleep(1.5)  # reports come once a second
        mine = {self.uuids[name].hex() for name in names}
        nodes = [report for report in self.here.measurements()[0]["nodes"] if report["uuid"] in mine]
        lost = sum(report["lost"] + report["late"] + report["bad"] for report in nodes)
        return lost, sum(map(int, self.power("missed", *names)))


@contextmanager
def scene(rows: Rows, folder: Path, count: int, rate: float, *, fd: bool) -> Iterator[Scene]:
    """Yield station, broker and nodes, which are off."""
    if MOSQUITTO is None:
        raise SystemExit("mosquitto is not installed: apt-get install mosquitto")
    link = f"udp_multicast:239.74.163.12?port={free_port()}{'&fd=1' if fd else ''}&bitrate={BITRATE}&pace=1"
    home, port = folder / "home", free_port()
    station, _ = initialise(home, name="bench", keystore="file", ask=lambda *_: PASSPHRASE, costs=passphrase.THROWAWAY)
    uuids = made(station, folder, count)
    station.close()
    forget_vaults()
    (folder / "broker.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    with ExitStack() as stack:

        def process(process: subprocess.Popen[str]) -> subprocess.Popen[str]:
            stack.callback(process.wait, 30)
            stack.callback(process.terminate)
            return process

        process(subprocess.Popen([MOSQUITTO, "-c", str(folder / "broker.conf")], stderr=subprocess.DEVNULL, text=True))
        command = [sys.executable, "-m", "benchmarks.newcomers", "serve", link, str(folder)]
        boards = [
            process(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
            for _ in range(2)
        ]
        words = ("ncap", "run", "--measure", "all", "--rate", str(rate), "--mqtt", f"mqtt://127.0.0.1:{port}")
        ncap = process(started(home, *words, "--can", link))
        assert ncap.stdout is not None
        assert ncap.stderr is not None
        ncap.stdout.readline()
        for stream in (ncap.stdout, ncap.stderr):
            threading.Thread(target=stream.read, daemon=True).start()
        wire, topics = Wire(link), Topics(port)
        stack.callback(wire.close)
        stack.callback(topics.close)
        here = stack.enter_context(client.connect(home=home))
        yield Scene(rows, wire, topics, boards, here, uuids, ncap)


def one_after_the_other(on: Scene, joins: int) -> None:
    """Measure one node that joins twenty, again and again."""
    base, joiner = [f"n{number}" for number in range(BASE)], f"n{BASE}"
    before = on.lost_until_now(base)
    address, taken, wired = default_can_address(on.uuids[joiner]), [], []
    for _ in range(joins):
        _, announced, came = on.joins([joiner])
        taken.append(came - announced)
        wired.append(on.wire.seconds(announced, came, address=address)[0])
        on.leaves(joiner)
        time.sleep(1.0)  # as if a person took it off and put it back: it is asked for meanwhile
    taken.sort()
    on.rows.add(f"one joins {BASE}, first value after its Announce, p50", median(taken) * 1e3, "ms")
    p95 = taken[-max(1, round(0.05 * joins))]
    on.rows.add("  p95", p95 * 1e3, "ms", aim=FIRST * 1e3)
    on.rows.add("  of it its commands and replies on the wire", median(wired) * 1e3, "ms")
    _tell_losses(on, base, before, f"lost by the {BASE} in {joins} joinings and leavings")


def together(on: Scene) -> None:
    """Measure twenty that join twenty."""
    base = [f"n{number}" for number in range(BASE)]
    more = [f"n{number}" for number in range(BASE, 2 * BASE)]
    before = on.lost_until_now(base)
    _, announced, came = on.joins(more)
    on.rows.add(f"{BASE} join {BASE} together, last one's first value", came - announced, "s", aim=TOGETHER)
    on.leaves(*more)
    _tell_losses(on, base, before, f"lost by the {BASE} meanwhile")


def _tell_losses(on: Scene, names: Sequence[str], before: tuple[int, int], what: str) -> None:
    lost, own = (now - then for now, then in zip(on.lost_until_now(names), before, strict=True))
    on.rows.add(f"{what}, beside {own} that their process left out", max(0, lost - own), "", aim=0)


def many(on: Scene, count: int, seconds: float, kind: str) -> None:
    """Measure ``count`` that are switched on together; then the bus time of all their clocks."""
    names = [f"n{number}" for number in range(count)]
    began, announced, came = on.joins(names)
    talk, data = on.wire.seconds(began, came)
    elapsed = came - announced
    seconds_of_one = median(
        on.wire.seconds(began, on.topics.first[name], address=default_can_address(on.uuids[name]))[0]
        for name in names[:BASE]
    )
    on.rows.add(
        f"{count} switched on together, {kind}: computed, {count} × {seconds_of_one * 1e3:.1f} ms",
        count * seconds_of_one,
        "s",
    )
    on.rows.add("  measured until the last one's first value", elapsed, "s")
    on.rows.add("  of it the wire was taken by commands and replies", 100 * talk / elapsed, "%")
    on.rows.add("  and by data of those that were in", 100 * data / elapsed, "%")
    time.sleep(5.0)  # that it runs is reported after its first values if all begin at once
    states = [report["state"] for report in on.here.measurements()[0]["nodes"]]
    on.rows.add(f"  measured of {count}", states.count("running"), "", aim=count, least=True)
    on.rows.add("  memory of the station", memory(on.ncap), "MB", aim=MEMORY + MEMORY_OF_A_NODE * count)

    def read_whole(uuid: bytes) -> bool:
        verdict = on.here.node(uuid.hex())["verdict"]
        return verdict is not None and verdict["from"] == "session"

    until(lambda: all(map(read_whole, on.uuids.values())), 900)
    on.rows.add("  read whole in the background after", time.monotonic() - announced, "s")
    before, since = on.lost_until_now(names), time.monotonic()
    time.sleep(seconds)
    talk, data = on.wire.seconds(since, since + seconds)
    on.rows.add(f"clocks of {count} nodes, {kind}", 100 * talk / seconds, "%", aim=CLOCK_SHARE)
    on.rows.add("  beside their data", 100 * data / seconds, "%")
    _tell_losses(on, names, before, "  lost meanwhile")


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--joins", type=int, default=20)
    parser.add_argument("--many", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--only", choices=["one", "twenty", "many"])
    options = parser.parse_args(words)
    rows = Rows()
    print(machine())
    with temporary() as folder, scene(rows, folder, 2 * BASE, 20.0, fd=False) as on:
        if options.only != "many":
            on.joins([f"n{number}" for number in range(BASE)])
        if options.only in (None, "one"):
            one_after_the_other(on, options.joins)
        if options.only in (None, "twenty"):
            together(on)
    for fd, kind in ((False, "500 kbit/s"), (True, "FD 500k/2M")):
        if options.only in (None, "many"):
            with temporary() as folder, scene(rows, folder, options.many, 1.0, fd=fd) as on:
                many(on, options.many, options.seconds, kind)


if __name__ == "__main__":
    if sys.argv[1:2] == ["serve"]:
        serve(sys.argv[2], Path(sys.argv[3]))
    else:
        main()
