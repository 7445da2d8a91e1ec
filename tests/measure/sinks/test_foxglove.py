"""``foxglove``: the live server, read by a client of another process that decodes every schema that it is sent.

The client speaks the protocol itself over ``websockets``; Foxglove's own application is not run here.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from teds_provision.errors import LinkError, UsageError
from teds_provision.measure.blocks import NodeReport
from teds_provision.measure.exposure import Exposure
from teds_provision.measure.running.measurement_job import whole_path
from teds_provision.measure.sinks import open_sink, without_scalars
from teds_provision.measure.sinks.foxglove import FoxgloveSink, foxglove_sink
from teds_provision.measure.sinks.foxglove_server import FoxgloveServer, address_of
from tests.places import self_signed

from .parts import ANGLE, ARM, STATION, block

pytest.importorskip("foxglove")
CLIENT = Path(__file__).parent / "foxglove_client.py"


def client(port: int, messages: int, channels: int) -> subprocess.Popen[str]:
    """Start a client that reads so many messages; its first line says that it has subscribed."""
    return subprocess.Popen(
        [sys.executable, str(CLIENT), str(port), str(messages), str(channels)],
        stdout=subprocess.PIPE,
        stdin=subprocess.PIPE,
        text=True,
    )


def received(sink: FoxgloveSink, items: list[Any], messages: int, channels: int) -> dict[str, Any]:
    sink.open((ANGLE,), STATION)
    sink.write(items[0])  # so that its channels exist when the client subscribes
    with client(sink.server.port, messages, channels) as reader:
        assert reader.stdout is not None
        assert json.loads(reader.stdout.readline())["subscribed"]
        for item in items[1:]:
            sink.report(item) if isinstance(item, NodeReport) else sink.write(item)
        try:
            found: dict[str, Any] = json.loads(reader.stdout.readline())
        finally:
            reader.kill()
    sink.close()
    assert sink.stats.error == ""
    return found


def test_a_client_of_another_process_decodes_streams_channels_reports_and_parameters() -> None:
    data = block([[10, 20], [11, 21]], valid=[[True, False], [True, True]], channels=(1, 2), index=5)
    report = NodeReport(ARM, "running", lost=3, time=1_795_000_001.0)
    found = received(foxglove_sink("foxglove:127.0.0.1:0"), [block(channels=(1, 2), raw=[[1, 2]]), data, report], 7, 5)
    streams = found["messages"]["/bench/arm/stream_0"]
    assert [message["index"] for message in streams] == [5, 6]
    assert [message["raw"] for message in streams] == [[10, 20], [11, 21]]
    assert [message["time"] / 1e9 for message in streams] == pytest.approx(data.time.tolist(), abs=1e-6)
    angles = found["messages"]["/bench/arm/angle"]
    np.testing.assert_array_equal([message["data"] for message in angles], data.value[:, 0])
    assert [message["time"] for message in angles] == [message["time"] for message in streams]
    assert np.isnan(found["messages"]["/bench/arm/ch2"][0]["data"])
    assert json.loads(found["messages"]["/bench/reports"][0]["data"])["lost"] == 3
    facts = json.loads(found["parameters"]["/bench/arm/angle"])
    assert (facts["unit"], facts["fingerprint"]) == ("rad", "ab" * 32)
    assert found["set"] == found["parameters"], "nothing can be set"
    assert json.loads(found["messages"]["/bench/arm/teds"][0]["data"])["uuid"] == ARM, (
        "a late subscriber gets the facts"
    )


def test_without_scalars_there_are_streams_alone() -> None:
    sink = foxglove_sink("foxglove:127.0.0.1:0", scalars=False)
    found = received(sink, [block([[1]]), block([[7]])], 1, 3)
    assert set(found["channels"]) == {"/bench/arm/stream_0", "/bench/arm/teds", "/bench/reports"}


def test_a_kept_sink_is_made_again_as_it_was_asked_for(tmp_path: Path) -> None:
    for spec in ("foxglove", "foxglove:127.0.0.1:9000", str(tmp_path / "run.mcap")):
        bare = without_scalars(spec)
        assert whole_path(bare) == bare == f"arrays:{spec}"
        assert type(open_sink(bare)) is type(open_sink(spec))
    assert without_scalars("ros2") == "ros2"
    assert without_scalars("run.csv") == "run.csv"


def test_only_this_machine_is_served_unless_a_name_is_allowed_and_tls_is_there(tmp_path: Path) -> None:
    tls = self_signed(tmp_path)
    alone, open_ = Exposure(), Exposure(("bench",), tls[1], tls[3])
    assert address_of("[::1]:9000", alone) == ("::1", 9000)
    assert address_of("localhost:9000", alone) == ("localhost", 9000)
    assert address_of("9000", alone) == ("127.0.0.1", 9000)
    for address in ("192.168.1.2:8765", "0.0.0.0:8765", "bench:8765"):
        assert address_of(address, open_)[1] == 8765
        for lacking in (alone, Exposure(("bench",)), Exposure((), tls[1], tls[3])):
            with pytest.raises(UsageError, match=address.partition(":")[0]):
                address_of(address, lacking)
    for address in ("127.0.0.1:x", "127.0.0.1:65536", "localhost"):
        with pytest.raises(UsageError, match="no address"):
            address_of(address, open_)


@pytest.mark.parametrize(
    ("allow", "host", "url"),
    [
        ((), "127.0.0.1", "ws://127.0.0.1:8765"),
        ((), "::1", "ws://[::1]:8765"),
        ((), "0.0.0.0", "ws://0.0.0.0:8765"),
        (("bench", "bench.local"), "0.0.0.0", "wss://bench:8765"),
        (("bench", "bench.local"), "::", "wss://bench:8765"),
        (("2001:db8::1",), "::", "wss://[2001:db8::1]:8765"),
        (("bench",), "192.168.1.2", "wss://192.168.1.2:8765"),
    ],
)
def test_an_address_for_people_is_one_that_a_client_can_use(allow: tuple[str, ...], host: str, url: str) -> None:
    certificate = Path("cert.pem") if allow else None
    assert Exposure(allow, certificate, certificate).url("ws", host, 8765) == url


def test_a_taken_port_is_reported() -> None:
    first = FoxgloveServer("127.0.0.1:0")
    first.start("bench")
    try:
        with pytest.raises(LinkError, match=str(first.port)):
            foxglove_sink(f"foxglove:127.0.0.1:{first.port}").open((ANGLE,), STATION)
    finally:
        first.stop()


class DeskServer:
    """The topics of one measurement, as the server keeps them; mock, no SDK is there. ``logged``: how often each."""

    def __init__(self) -> None:
        self.latest: dict[str, bytes] = {}
        self.parameters: dict[str, str] = {}
        self.logged: Counter[str] = Counter()

    def begin(self) -> DeskServer:
        """Return the topics."""
        return self

    def channel(self, topic: str, *_facts: Any) -> Any:
        """Return what counts the messages on a topic."""
        return SimpleNamespace(log=lambda _message, **_more: self.logged.update([topic]))


def test_a_node_that_another_ones_name_renames_has_datasheet_and_streams_under_its_new_name() -> None:
    """Its streams went on under the old name, beside values of its channels under the new one."""
    server, other, third = DeskServer(), "f" * 20, "e" * 20
    sink = FoxgloveSink(server, own=False)  # type: ignore[arg-type]
    sink._prepare((ANGLE, replace(ANGLE, uuid=third, node="boom")), replace(STATION, nodes={}))
    sink._process_item(block())
    assert set(server.latest) == {"/bench/arm/teds", "/bench/boom/teds"}
    before = server.logged.copy()
    sink._process_item((replace(ANGLE, uuid=other),))
    now = {uuid: f"/bench/arm_{uuid[:8]}" for uuid in (ARM, other)}
    assert set(server.latest) == {"/bench/boom/teds", *(f"{topic}/teds" for topic in now.values())}
    assert server.logged["/bench/boom/teds"] == before["/bench/boom/teds"], "nothing of it is new"
    assert set(server.parameters) == {"/bench/boom/angle", *(f"{topic}/angle" for topic in now.values())}
    sink._process_item(block())
    assert server.logged["/bench/arm/stream_0"] == before["/bench/arm/stream_0"] == 3
    assert server.logged[f"{now[ARM]}/stream_0"] == server.logged[f"{now[ARM]}/angle"] == 3
