"""Small parts of sinks, each alone: which sink a string names, what a full or strange disk changes, names, lines."""

from __future__ import annotations

import errno
import io
import json
import struct
import threading
from collections import deque
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from teds_provision.errors import BadDataError, StoreError, UsageError
from teds_provision.measure import sinks
from teds_provision.measure.blocks import ChannelFacts, GroupRows, NodeReport, StationFacts
from teds_provision.measure.sinks import files, in_units, json_events, names, open_sink, vectors, without_scalars
from teds_provision.measure.sinks.base import ThreadedSink
from teds_provision.measure.sinks.files import Part
from teds_provision.measure.sinks.foxglove import FoxgloveSink
from teds_provision.measure.sinks.json_lines import JsonLinesSink
from teds_provision.measure.sinks.mcap import recording as of_mcap
from teds_provision.measure.sinks.mcap.recording import CHUNK_OCTETS, FLUSH, McapSink
from teds_provision.measure.sinks.mcap.recover import Damage, _Scan, recover
from teds_provision.measure.sinks.mqtt import MqttSink
from teds_provision.measure.sinks.names import Topics
from teds_provision.measure.sinks.ros import rclpy_child, ros1_child
from teds_provision.measure.sinks.ros.child import ChildSink
from teds_provision.measure.sinks.ros.ros2 import Ros2Sink
from teds_provision.measure.sinks.shown import ShownJsonLinesSink, ShownTextSink, ShownWideSink
from teds_provision.measure.sinks.text import TextSink
from teds_provision.measure.sinks.wide import WideSink
from teds_provision.teds.codec.model import Units
from tests.measure.recordings.test_records_of_mcap import record
from tests.measure.sinks.parts import ANGLE, ARM, HAND, block
from tests.measure.sinks.test_recovery import KIND, PLACE, channel, chunk, finished, index, message

NONE: Any = None


# -- which sink --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spec", "kind", "path"),
    [
        ("run.CSV", TextSink, "run.CSV"),
        ("run.Txt", TextSink, "run.Txt"),
        ("run.JSONL", JsonLinesSink, "run.JSONL"),
        ("run.MCAP", McapSink, "run.MCAP"),
        ("wide:run.CSV", WideSink, "run.CSV"),
        ("wide:run.txt", WideSink, "run.txt"),
        ("shown:run.CSV", ShownTextSink, "run.CSV"),
        ("shown:run.JsonL", ShownJsonLinesSink, "run.JsonL"),
        ("shown:wide:run.TXT", ShownWideSink, "run.TXT"),
        ("shown:run.mcap", McapSink, "run.mcap"),
        ("arrays:run.MCAP", McapSink, "run.MCAP"),
    ],
)
def test_the_end_of_a_files_name_is_its_form_in_whatever_letters(spec: str, kind: type, path: str) -> None:
    made: Any = open_sink(spec)
    assert (type(made), made._path) == (kind, Path(path))
    if isinstance(made, TextSink):
        assert made._comma == ("," if path.lower().endswith(".csv") else "\t")
    if spec.startswith("arrays:"):
        assert made._scalars is None


def test_another_form_is_refused_with_those_that_there_are() -> None:
    for spec in ("run.xlsx", "wide:run.xlsx", "run", "shown:run.xlsx"):
        with pytest.raises(UsageError) as refused:
            open_sink(spec)
        assert refused.value.message == f"Unsupported format: {spec.removeprefix('shown:')!r}."
        assert refused.value.hint == (
            "Name a file that ends in .csv, .txt, .jsonl, .mcap, or ros1, ros2, mqtt, mqtts, foxglove."
        )


@pytest.mark.parametrize(
    ("spec", "in_shown", "bare"),
    [
        ("run.CSV", "shown:run.CSV", "run.CSV"),
        ("wide:run.txt", "shown:wide:run.txt", "wide:run.txt"),
        ("shown:run.csv", "shown:run.csv", "shown:run.csv"),
        ("run.MCAP", "run.MCAP", "arrays:run.MCAP"),
        ("arrays:run.mcap", "arrays:run.mcap", "arrays:run.mcap"),
        ("foxglove:a.b:80", "foxglove:a.b:80", "arrays:foxglove:a.b:80"),
        ("mqtt://x.csv", "mqtt://x.csv", "mqtt://x.csv"),
        ("ros1:http://x.mcap", "ros1:http://x.mcap", "ros1:http://x.mcap"),
    ],
)
def test_units_and_single_channels_belong_to_some_sinks_alone(spec: str, in_shown: str, bare: str) -> None:
    assert (in_units(spec, "shown"), in_units(spec, "si"), without_scalars(spec)) == (in_shown, spec, bare)


def test_a_server_beyond_loopback_is_protected_with_and_without_single_channels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(sinks, "foxglove_sink", lambda *words, **more: asked.append((words, more)))
    exposure: Any = object()
    for spec in ("foxglove:0.0.0.0:8765", "arrays:foxglove:0.0.0.0:8765"):
        open_sink(spec, None, exposure)
    assert [words for words, _ in asked] == [("foxglove:0.0.0.0:8765",)] * 2
    assert [more["exposure"] for _, more in asked] == [exposure] * 2
    assert [more.get("scalars", True) for _, more in asked] == [True, False]
    assert FoxgloveSink(NONE, own=False)._with_scalars is True


# -- files -------------------------------------------------------------------------------------------------------------


def _part(monkeypatch: pytest.MonkeyPatch, written: int, *, cut: bool) -> tuple[Any, list[int]]:
    """Return a part on a disk that takes so many octets and then no more, and may not be cut back either."""
    lengths: list[int] = []

    def write(_file: int, octets: bytes) -> int:
        taken = min(len(octets), written - sum(done))
        done.append(taken)
        if taken == 0:
            raise OSError(errno.ENOSPC, "full")
        return taken

    def truncate(_file: int, length: int) -> None:
        lengths.append(length)
        if not cut:
            raise OSError(errno.EIO, "broken")

    done: list[int] = []
    monkeypatch.setattr(files, "os", SimpleNamespace(write=write, ftruncate=truncate))
    made: Any = SimpleNamespace(_file=7, _waiting=[], waiting_octets=0, size=100, lost=0, _flushed=0.0)
    return made, lengths


@pytest.mark.parametrize("cut", [True, False])
@pytest.mark.parametrize(("written", "whole", "lost"), [(0, 0, 15), (3, 0, 15), (4, 4, 14), (9, 9, 11), (10, 9, 11)])
def test_a_disk_that_fills_keeps_whole_pieces_and_its_own_error(
    monkeypatch: pytest.MonkeyPatch, cut: bool, written: int, whole: int, lost: int
) -> None:
    made, lengths = _part(monkeypatch, written, cut=cut)
    made._waiting = [(b"aaaa", 1), (b"bbbbb", 3), (b"cccccc", 11)]
    with pytest.raises(OSError, match="full"):
        Part.flush(made)
    assert (made.size, made.lost, lengths, made._waiting) == (100 + whole, lost, [100 + whole], [])


def test_a_part_without_a_whole_piece_is_removed_though_its_folder_may_refuse_that(tmp_path: Path) -> None:
    made = TextSink(tmp_path / "run.csv")
    assert made._abandon() == 0
    for size, there in ((0, False), (5, True)):
        for missing in (False, True):
            path = tmp_path / f"run.{size}.csv"
            path.write_text("x")
            if missing:
                path.unlink()
            made._part, made._parts = SimpleNamespace(abandon=lambda: 9, size=size, path=path), [path]  # type: ignore[assignment]
            assert made._abandon() == 9
            assert (made._parts, made._part) == ([path] if there else [], None)
            assert path.exists() is (there and not missing)


@pytest.mark.parametrize("gaps", [0, 1, 4])
def test_a_recording_with_gaps_ends_with_the_last_three_of_them(monkeypatch: pytest.MonkeyPatch, gaps: int) -> None:
    """Also if the disk is so full that its last part cannot be mended."""
    made = TextSink(Path("run.csv"))
    made._full, made._parts = (0.0, 0, "disk is full"), [Path("run.csv")]
    made._gaps = [f"gap {number}." for number in range(gaps)]
    mended: list[Path] = []

    def mend(path: Path) -> None:
        mended.append(path)
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(made, "_mend", mend)
    with pytest.raises(StoreError) as ended:
        made._finish()
    last = "The disk is full since 1970-01-01T00:00:00.000Z: 0 values are not recorded."
    shown = " ".join([*[f"gap {number}." for number in range(gaps)][-2:], last])
    assert ended.value.message == f"run.csv has {gaps + 1} {'gap' if gaps == 0 else 'gaps'}. {shown}"
    assert ended.value.hint == "Free some space before the next run; what was written is intact."
    assert mended == [Path("run.csv")]


def test_a_folder_without_locks_is_recorded_to_and_one_that_is_gone_leaves_nothing_open(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr(files, "lock", refuse)
    part = Part(tmp_path / "run.csv")
    part.add(b"x", 1)
    part.close()
    assert part.path.read_bytes() == b"x"
    monkeypatch.setattr(files, "sync_folder", refuse)
    with pytest.raises(OSError, match="no locks"):
        Part(tmp_path / "other.csv")
    assert not (tmp_path / "other.csv").exists()


def test_of_a_conversion_the_first_counts_of_a_node_are_those_of_before_and_its_end_closes_the_part(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    counted, processed, abandoned = list[str](), list[str](), list[int]()
    made = TextSink(Path("run.csv"))
    monkeypatch.setattr(made, "_prepare", lambda *_: None)
    monkeypatch.setattr(made, "_begin", lambda: None)
    monkeypatch.setattr(made, "_write_counts", lambda report: counted.append(report.why))
    monkeypatch.setattr(made, "_process_item", lambda item: processed.append(item.why))

    def report(uuid: str, samples: int, why: str) -> NodeReport:
        return NodeReport(uuid, "running", why, samples, 0, 0, 0, 0, time=0.0)

    reports = [report(ARM, 5, "a"), report(ARM, 9, "b"), report(HAND, 0, "c"), report(HAND, 3, "d")]
    assert made.copy(reports, (), StationFacts("bench")) == []
    assert (counted, processed) == (["a"], ["b", "c", "d"])
    assert {uuid: one.why for uuid, one in made.reports.items()} == {ARM: "b", HAND: "d"}

    def broken(_item: Any) -> None:
        raise BadDataError("damaged")

    made._part = SimpleNamespace(abandon=lambda: abandoned.append(1))  # type: ignore[assignment]
    monkeypatch.setattr(made, "_process_item", broken)
    with pytest.raises(BadDataError):
        made.copy([report("ff" * 10, 0, "e")], (), StationFacts("bench"))
    assert (abandoned, made._part) == ([1], None)


def test_a_recorder_that_falls_behind_ends_at_once_and_wakes_who_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    woken: list[int] = []

    class Lock:
        def __enter__(self) -> None: ...

        def __exit__(self, *_: object) -> None: ...

        def notify_all(self) -> None:
            woken.append(1)

    failed: list[tuple[str, str]] = []
    tally = SimpleNamespace(state="running", fail=lambda message, hint: failed.append((message, hint)))
    made: Any = SimpleNamespace(
        _lock=Lock(), _closing=False, _tally=tally, recorder=True, name="run.csv", _owed=5, _items=deque()
    )
    ThreadedSink._put(made, NONE, 10**12)
    assert failed == [
        (
            "The disk is too slow: run.csv owes 5 values. The recording has ended.",
            "Record to a faster disk, or fewer channels.",
        )
    ]
    assert (woken, len(made._items)) == ([1], 0)
    ThreadedSink._put(made, NONE, 1)
    assert (woken, len(made._items), made._owed) == ([1], 1, 6), "a recorder looks by itself"


def test_each_part_of_an_mcap_has_its_number_and_what_cannot_be_mended_is_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    written: list[tuple[str, dict[str, str]]] = []

    class Writer:
        def __init__(self, *_: Any, **__: Any) -> None: ...

        def schema(self, *_: Any) -> int:
            return 1

        def metadata(self, name: str, words: dict[str, str]) -> None:
            written.append((name, words))

    monkeypatch.setattr(of_mcap, "McapWriter", Writer)
    made = McapSink(tmp_path / "run.mcap")
    made.station = StationFacts("bench", group="hand", started=0.0, test_pattern=True)
    for number in (1, 2):
        made._parts.append(tmp_path / f"{number}.mcap")
        made._begin()
    assert [name for name, _ in written] == ["measurement"] * 2
    assert [words["part"] for _, words in written] == ["1", "2"]
    assert written[0][1] | {"clock": ""} == {
        "station": "bench", "group": "hand", "started": "1970-01-01T00:00:00.000Z", "clock": "", "test_pattern": "true",
        "part": "1",
    }  # fmt: skip

    def cannot(_path: Path) -> None:
        raise BadDataError("no MCAP")

    monkeypatch.setattr(of_mcap, "recover", cannot)
    made._mend(tmp_path / "run.mcap")


# -- recovery ----------------------------------------------------------------------------------------------------------


def test_an_index_that_is_not_of_whole_entries_is_damage(tmp_path: Path) -> None:
    torn = record(0x07, struct.pack("<HI", 1, 8) + bytes(8))
    path = finished(tmp_path / "run.mcap", KIND, channel(), chunk(message()), torn)
    damaged = recover(path).damaged
    assert [(damage.what, damage.offset) for damage in damaged] == [("record", PLACE + len(chunk(message())))]


def test_a_chunk_whose_writer_makes_no_index_is_whole(tmp_path: Path) -> None:
    path = finished(tmp_path / "run.mcap", KIND, channel(), chunk(message()), chunk(message(7), (7, 7)), index((7, 0)))
    done = recover(path)
    assert (done.damaged, done.messages) == ((), 2)


def test_a_chunk_without_messages_stays_octet_for_octet(tmp_path: Path) -> None:
    """Its header has whatever times its writer gave it; there are no messages from which they could be mended."""
    described = chunk(channel(3), (9, 11))
    path = finished(tmp_path / "run.mcap", KIND, channel(), described, b"\0" * 5, chunk(message()), index((5, 0)))
    done = recover(path)
    assert done.messages == 1
    assert done.output is not None
    assert described in done.output.read_bytes()


def test_damage_within_damage_is_counted_once() -> None:
    for given, due in (
        ([Damage("chunk", 10, 50), Damage("record", 20, 5)], [Damage("chunk", 10, 50)]),
        ([Damage("record", 60, 5), Damage("chunk", 10, 50)], [Damage("chunk", 10, 55)]),
        ([Damage("chunk", 10, 5), Damage("record", 16, 5)], [Damage("chunk", 10, 5), Damage("record", 16, 5)]),
    ):
        made: Any = SimpleNamespace(damaged=given)
        _Scan._join_damage(made)
        assert made.damaged == due


# -- names -------------------------------------------------------------------------------------------------------------


def test_a_chosen_name_has_no_slash_at_either_end() -> None:
    chosen = {(ARM, 0): "/arm/", (ARM, 1): "lab/joint/", (HAND, 0): "hand"}
    made = Topics(StationFacts("bench", names=chosen))
    assert (made.node(ARM), made.channel(ARM, 1), made.node(HAND)) == ("arm", "/lab/joint", "hand")
    assert not made._has_others(ARM, {0: "arm/", 1: "/lab/joint"})
    assert made._has_others(ARM, {0: "arm", 1: "lab/other"})
    with pytest.raises(UsageError, match="cannot be the name of a topic"):
        Topics(StationFacts("bench", names={(ARM, 1): "a b"}))


def test_an_unverified_node_keeps_its_name_when_its_namesake_is_renamed() -> None:
    made = Topics(StationFacts("bench"))
    made._name_unverified(ARM, "foot")
    made._name_unverified(HAND, "foot")
    assert made._unverified == {ARM: "foot", HAND: f"foot_{HAND[:8]}"}
    made._name_unverified(ARM, "leg")
    made._name_unverified(HAND, "foot")
    assert made._unverified == {ARM: "leg", HAND: f"foot_{HAND[:8]}"}
    made._name_unverified("ab" * 10, "")
    assert made._unverified["ab" * 10] == "nabababab"


def test_a_derived_name_is_not_that_of_the_set_points_of_a_chosen_one() -> None:
    """A channel that was chosen to be ``…/angle/cmd`` keeps ``angle`` free of another one's set points."""
    made = Topics(StationFacts("bench", names={(ARM, 5): "bench/arm/angle/cmd"}, nodes={ARM: "arm"}))
    made._channels[ARM] = {1: "angle", 2: "force", 5: "x"}
    assert made._make(ARM) == {1: "angle_1", 2: "force"}


@pytest.mark.parametrize(
    ("name", "own"),
    [
        ("arm_8d4d9da6", "arm_8d4d9da6_abababab"),
        (f"arm_{ARM}", f"arm_{ARM}_abababab"),
        ("arm_8d4d9da", "arm_8d4d9da"),
        ("arm_ffffffff", "arm_ffffffff"),
        ("arm_8D4D9DA6", "arm_8D4D9DA6"),
    ],
)
def test_a_name_that_ends_in_the_digits_of_another_node_gets_its_own_behind_it(name: str, own: str) -> None:
    made = Topics(StationFacts("bench", nodes={ARM: "arm"}))
    assert made._own_name("ab" * 10, name) == own


@pytest.mark.parametrize(
    ("given", "made"),
    [
        (" Grün-Öl ", "grun_ol"), ("__a__", "a"), ("a" * 59 + " b", "a" * 59), ("3 axes", "n_3_axes"), ("ß", "ss"),
        ("…", ""),
        ("_" + "a" * 70, "a" * 60), ("ℍand", "hand"),
    ],
)  # fmt: skip
def test_a_part_of_a_topic_begins_and_ends_with_a_letter_or_digit(given: str, made: str) -> None:
    assert names.slug(given) == made


@pytest.mark.parametrize("name", ["Relative Humidity", "relative_humidity", "air RELATIVE-humidity"])
def test_a_ratio_is_humidity_if_its_name_means_it_in_whatever_letters(name: str) -> None:
    facts = ChannelFacts(ARM, "arm", 1, name, "sensor", units=Units(interpretation=1))
    assert vectors.meaning_of(facts).type == "sensor_msgs/RelativeHumidity"


# -- lines -------------------------------------------------------------------------------------------------------------


def test_numbers_that_json_does_not_have_are_null() -> None:
    assert [json_events.plain(value) for value in (float("nan"), float("inf"), float("-inf"), 1.5, b"\xff", 3)] == [
        None, None, None, 1.5, "ff", 3
    ]  # fmt: skip
    (line,) = json_events.data_lines(block(((1,),), start=1.123456789, period=0.0), {ANGLE.key: ANGLE})
    assert (line["time"], line["age"]) == ([1.123457], 0.02)


def test_a_line_of_a_child_leaves_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its standard output is a pipe: what is not flushed waits for the next eight kilobytes."""
    for module in (rclpy_child, ros1_child):
        seen: list[str] = []

        class Out(io.StringIO):
            def flush(self, seen: list[str] = seen) -> None:
                seen.append(self.getvalue())

        monkeypatch.setattr(module.sys, "stdout", Out())
        module.send_line(event="ready", node="a")
        assert [json.loads(line) for line in seen] == [{"event": "ready", "node": "a"}]


def test_parameters_are_facts_from_the_first_moment_on(monkeypatch: pytest.MonkeyPatch) -> None:
    messages = SimpleNamespace(SetParametersResult=SimpleNamespace)
    monkeypatch.setattr(rclpy_child, "importlib", SimpleNamespace(import_module=lambda _name: messages))
    bridge = rclpy_child.Bridge(None, SimpleNamespace(add_on_set_parameters_callback=lambda _callback: None))
    answer = bridge._may_set([])
    assert (answer.successful, answer.reason) == (False, "a fact of a signed datasheet")


def test_the_time_of_a_message_is_rounded_to_whole_nanoseconds() -> None:
    made = SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(), frame_id=""))
    bridge: Any = SimpleNamespace(publishers={1: ("publisher", lambda: made)})
    _, filled = rclpy_child.Bridge.message(bridge, {"id": 1, "t": 1.9999999999, "frame": "arm"})
    assert (filled.header.stamp.sec, filled.header.stamp.nanosec, filled.header.frame_id) == (2, 0, "arm")


@pytest.mark.parametrize("error", [OSError("no master"), ValueError("odd"), RuntimeError("xmlrpc")])
def test_whatever_rospy_lets_through_at_a_parameter_ends_no_child(
    error: Exception, capsys: pytest.CaptureFixture[str]
) -> None:
    def put(_key: str, _value: object) -> None:
        raise error

    ros1_child.Bridge(SimpleNamespace(set_param=put), None).param({"key": "/gone", "value": 1})
    assert json.loads(capsys.readouterr().out) == {"event": "trouble", "what": f"parameter /gone: {error}"}


@pytest.mark.parametrize(
    ("impl", "sent"),
    [
        (None, True),
        (SimpleNamespace(), True),
        (SimpleNamespace(connections=[SimpleNamespace(_queue=[]), SimpleNamespace()]), True),
        (SimpleNamespace(connections=[SimpleNamespace(_queue=[]), SimpleNamespace(_queue=[b"x"])]), False),
    ],
)
def test_what_rospy_has_in_its_queues_was_not_sent_yet(impl: Any, sent: bool) -> None:
    outlet: Any = SimpleNamespace(publisher=SimpleNamespace(impl=impl))
    assert ros1_child.Outlet.sent(outlet) is sent


def test_a_compound_message_counts_with_its_values_and_not_with_its_fixed_texts() -> None:
    written: list[Any] = []
    made: Any = SimpleNamespace(
        _type=lambda _kind: lambda header: SimpleNamespace(header=header, point=SimpleNamespace(x=0.0)),
        _header=lambda stamp, frame: (stamp, frame),
        _writer=lambda topic, kind: (topic, kind),
        _write=lambda *words: written.append(words),
    )
    fields: Any = {"point.x": 1.0, "header.none": 2.0, "covariance": [0.0] * 9, "name": "x"}
    Ros2Sink._fields(made, "/a", "k/K", 1.5, "arm", {name: fields[name] for name in ("point.x", "covariance", "name")})
    (writer, filled, values) = written[0]
    assert (writer, filled.header, filled.point.x, values) == (("/a", "k/K"), (1.5, "arm"), 1.0, 1)


@pytest.mark.parametrize(("release", "octets"), [("humble", 24), ("jazzy", 16)])
def test_endpoints_are_shown_once_with_the_ids_of_their_release(release: str, octets: int) -> None:
    def plain(name: str) -> Any:
        return lambda **fields: SimpleNamespace(kind=name, **fields)

    names_of = ("HumbleGid", "HumbleNodeEntitiesInfo", "HumbleParticipantEntitiesInfo")
    plain_names = ("Gid", "NodeEntitiesInfo", "ParticipantEntitiesInfo")
    types = SimpleNamespace(**{name: plain(name) for name in (*names_of, *plain_names)})
    entity = SimpleNamespace(guid=SimpleNamespace(bytes=bytes(range(16))))
    written: list[Any] = []
    made: Any = SimpleNamespace(
        _unshown=True, _distribution=release, _types=types, _node="bench", _readers={"/a": (entity, ARM, 1)},
        _writers={"/b": entity, "/c": entity}, _graph="graph", _participant=entity,
        _write=lambda *words: written.append(words),
    )  # fmt: skip
    Ros2Sink._show_node(made)
    assert made._unshown is False
    ((graph, whole, values),) = written
    (node,) = whole.node_entities_info_seq
    assert (graph, values, node.node_name, node.node_namespace) == ("graph", 0, "bench", "/")
    assert [len(gid.data) for gid in (whole.gid, *node.reader_gid_seq, *node.writer_gid_seq)] == [octets] * 4
    assert whole.kind == (names_of if release == "humble" else plain_names)[2]


def test_a_child_that_is_given_up_while_it_is_told_everything_takes_no_values() -> None:
    child = SimpleNamespace(poll=lambda: None)
    made: Any = SimpleNamespace(
        _child=child, _ready=threading.Event(), _announced=False, _pause=8.0, _heard="", _set_state=lambda *_: None,
        _every_fact=list,
    )  # fmt: skip
    made._announce = lambda _facts: setattr(made, "_child", None)
    made._ready.set()
    assert ChildSink._up(made) is False
    made._child, made._announced, made._announce = child, False, lambda _facts: None
    assert ChildSink._up(made) is True
    assert (made._pause, made._announced) == (1.0, True)


# -- MQTT --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("url", "host"),
    [("mqtt://bench/", "mqtt://bench"), ("mqtts://Bench:8884", "mqtts://bench:8884"), ("mqtt://[::1]", "mqtt://[::1]")],
)
def test_the_url_of_a_broker_is_its_scheme_host_and_port(url: str, host: str) -> None:
    assert MqttSink(url).name == host


@pytest.mark.parametrize(
    "url", ["http://bench", "mqtt:", "mqtt://", "mqtt://bench/x", "mqtt://bench#x", "mqtt://bench:99999", "mqtt://b..h"]
)
def test_what_is_no_url_of_a_broker_is_refused(url: str) -> None:
    with pytest.raises(UsageError) as refused:
        MqttSink(url)
    assert refused.value.message == f"{url!r} is not an MQTT URL."
    assert refused.value.hint == "Use mqtt://HOST or mqtts://USER@HOST:8883."


@pytest.mark.parametrize("error", [ValueError("not queued"), RuntimeError("no connection"), None])
def test_the_farewell_that_a_broker_does_not_take_is_no_error(error: Exception | None) -> None:
    def wait(_seconds: float) -> None:
        if error is not None:
            raise error

    published = SimpleNamespace(rc=0, wait_for_publish=wait, is_published=lambda: True)
    made: Any = SimpleNamespace(_client=SimpleNamespace(publish=lambda *_, **__: published), _status="bench/status")
    assert MqttSink._publish_offline(made) is (error is None)


def test_a_connection_that_is_gone_already_is_cut_without_an_error() -> None:
    cut: list[int] = []

    def shutdown(how: int) -> None:
        cut.append(how)
        raise OSError(errno.ENOTCONN, "gone")

    for connection, times in ((SimpleNamespace(shutdown=shutdown), 1), (None, 0)):
        cut.clear()
        made: Any = SimpleNamespace(_client=SimpleNamespace(socket=lambda connection=connection: connection))
        MqttSink._cut(made)
        assert len(cut) == times


def test_the_time_of_a_value_has_microseconds() -> None:
    sent: list[Any] = []

    def publish(topic: str, words: Any) -> bool:
        sent.append((topic, words))
        return True

    made: Any = SimpleNamespace(
        _station=StationFacts("bench", scalar_rate=10.0), _newest={}, _due={}, _facts={ANGLE.key: ANGLE},
        _field=lambda facts: f"{facts.name}_{facts.number}", _shown=lambda _facts, value: value,
        _topics=SimpleNamespace(station="bench", node=lambda _uuid: "arm"), _connected=threading.Event(),
        _publish=publish, _count=lambda **_: None,
    )  # fmt: skip
    made._connected.set()
    MqttSink._block(made, block(np.array([[7]]), start=1.123456789, period=0.0))
    assert sent == [("bench/arm", {"time": 1.123457, "angle_1": 0.7})]


@pytest.mark.parametrize(
    ("octets", "seconds", "closed", "opened"),
    [
        (0, 50.0, 0, 100.0), (1, FLUSH, 1, 100.0), (1, FLUSH / 2, 0, None), (CHUNK_OCTETS, 0.0, 1, 100.0),
        (CHUNK_OCTETS - 1, 0.0, 0, None),
    ],
)  # fmt: skip
def test_a_chunk_is_closed_when_it_is_full_or_old_and_its_age_counts_from_its_first_message(
    octets: int, seconds: float, closed: int, opened: float | None
) -> None:
    done: list[int] = []
    out = SimpleNamespace(chunk_octets=octets, close_chunk=lambda: done.append(1))
    made: Any = SimpleNamespace(_out=out, _opened=0.0)
    McapSink._look(made, seconds)
    assert (len(done), made._opened) == (closed, 0.0 if opened is None else seconds)


def test_a_deviation_of_0_is_none_and_the_uncertainty_counts() -> None:
    facts = ChannelFacts(ARM, "arm", 1, "angle", "sensor", uncertainty=0.3, deviation=0.0)
    assert vectors.variance_of(facts) == pytest.approx(0.03)


def test_only_a_finite_value_of_a_row_is_valid() -> None:
    values = [1.0, float("inf"), float("nan")]
    rows = GroupRows("all", ((ARM, 1),), np.array([1.0, 2.0, 3.0]), np.array([values]).T, np.zeros((3, 1)))
    (line,) = json_events.row_lines(rows, {})
    assert (line["valid"], line["value"]) == ([True, False, False], [1.0, None, None])
