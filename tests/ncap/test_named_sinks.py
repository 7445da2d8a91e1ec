"""Where values may go by a request: to names that the daemon's owner gave, never to a host or file of the request."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.cli.config_file import brokers_of
from teds_provision.client import ApiError
from teds_provision.errors import BadDataError, StoreError, TedsProvisionError, UsageError
from teds_provision.measure.sinks.foxglove import FoxgloveSink
from teds_provision.ncap.sinks import DaemonSinks, for_readers, sink_json
from teds_provision.station.store.records import KeptMeasurement
from tests.e2e.desk import Desk
from tests.ncap.service import Service, virtual
from tests.places import free_tcp_port

LAB = "mqtts://arm@broker.lab?password-file=/home/arm/secret"


def test_a_request_names_a_sink_and_never_says_where_it_is(tmp_path: Path) -> None:
    sinks = DaemonSinks(tmp_path, ("ros2", "mqtt://own"), actuators=True, brokers={"lab": LAB})
    assert [sinks.whole(name) for name in ("ros1", "ros2", "mqtt", "lab")] == ["ros1", "ros2", "mqtt", "lab"]
    assert sinks.whole("run.csv") == str(tmp_path / "recordings" / "run.csv")
    for spec in (
        "mqtt://evil@host?password-file=/etc/shadow",
        "mqtt://own",
        LAB,
        "ros1:http://evil:11311",
        "ros2:7",
        "other",
        "lab?password-file=/etc/shadow",
        "/tmp/x.csv",
        "../x.csv",
        "a/b.csv",
        ".csv",
        "x.csv\n",
    ):
        with pytest.raises(UsageError):
            sinks.whole(spec)


def test_a_name_is_replaced_by_its_url_at_the_start_and_reported_if_it_is_gone(tmp_path: Path) -> None:
    sinks = DaemonSinks(tmp_path, ("mqtt://own",), actuators=True, brokers={"lab": LAB})
    assert (sinks.open("lab").name, sinks.open("mqtt").name) == ("mqtts://broker.lab", "mqtt://own")
    kept = KeptMeasurement("m", sinks=("mqtt",))
    assert sinks.extra_sinks(kept, None) == [], "the daemon's own broker is not served twice"
    assert [sink.name for sink in sinks.extra_sinks(KeptMeasurement("m", sinks=("lab",)), None)] == ["mqtt://own"]
    with pytest.raises(UsageError, match="'lab' is no longer configured"):
        DaemonSinks(tmp_path, actuators=True).open("lab")


def test_a_folder_of_recordings_is_where_the_service_was_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is kept with the measurement, and the next start may be from elsewhere."""
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    sinks = DaemonSinks(tmp_path / "home", record=Path("rec"), actuators=False)
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert sinks.whole("run.csv") == str(tmp_path / "rec" / "run.csv")
    [own] = sinks.extra_sinks(KeptMeasurement("m", group="arm  1/ 2"), None)
    assert own.name.startswith(str(tmp_path / "rec" / "arm_1_2-"))
    assert own.name.endswith(".csv")
    assert not (tmp_path / "home" / "recordings").exists()
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize(
    ("name", "url"),
    [("mqtt", LAB), ("ros1", LAB), ("a/b", LAB), ("", LAB), ("lab", "/etc/passwd.csv"), ("lab", "mqtts://x?cafile=/y")],
)
def test_a_broker_that_is_none_is_refused_at_the_start(tmp_path: Path, name: str, url: str) -> None:
    with pytest.raises(TedsProvisionError):
        DaemonSinks(tmp_path, actuators=True, brokers={name: url})


def test_brokers_stand_in_config_toml(tmp_path: Path) -> None:
    file = tmp_path / "config.toml"
    assert brokers_of(file) == {}
    file.write_text(f'[ncap.run]\nmetrics = true\n[ncap.brokers]\nlab = "{LAB}"\n')
    assert brokers_of(file) == {"lab": LAB}
    file.write_text("[ncap.brokers]\nlab = 5\n")
    with pytest.raises(BadDataError, match="line 2"):
        brokers_of(file)


def test_readers_see_names_of_files_and_no_users() -> None:
    facts = {
        "name": "/home/me/records/run.csv",
        "error": "/home/me/records/run.csv cannot be written: the disk is full.",
        "sinks": ["mqtts://arm@broker.lab:8883?password-file=/home/arm/secret", "ros1"],
        "rate": 50,
        "unit": "m/s",
        "topic": "/bench/hand/opening",
    }
    assert for_readers(facts) | {"topic": None} == {
        "name": "run.csv",
        "error": "run.csv cannot be written: the disk is full.",
        "sinks": ["mqtts://broker.lab:8883", "ros1"],
        "rate": 50,
        "unit": "m/s",
        "topic": None,
    }


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--can", "udp_multicast:239.74.163.2?prot=1"), "'prot'"),
        (("--ble", "hci0?adress=x"), "'adress'"),
        (("--mqtt", "mqtts://host?cafile=/x"), "'cafile'"),
    ],
)
def test_unknown_words_of_a_link_or_sink_end_the_start(desk: Desk, words: tuple[str, str], message: str) -> None:
    done = desk.station().start("--json", "ncap", "run", *words).end()
    assert (done.code, message in done.out) == (2, True), done


@pytest.mark.link
def test_a_running_daemon_takes_the_names_of_its_owner(desk: Desk) -> None:
    station = desk.station()
    port = free_tcp_port()
    (station.home / "config.toml").write_text(f'[ncap.brokers]\nlab = "mqtt://arm@127.0.0.1:{port}"\n')
    service = Service(desk, station).start()
    hand = virtual(service)
    with service.client(service.token("writer")) as asked, service.client(service.token("eye", "--read-only")) as eye:
        for sinks in (["mqtt://evil@127.0.0.1?password-file=/etc/passwd"], [f"mqtt://127.0.0.1:{port}"], ["mqtt"]):
            with pytest.raises(ApiError) as refusal:
                asked.request("POST", "/measurements", {"uuids": [hand], "sinks": sinks})
            assert (refusal.value.status, refusal.value.code) == (422, "usage")
        noted = asked.request("GET", "/log?act=api")["entries"]
        assert {(item["actor"], item["outcome"], item["failed"]) for item in noted} == {("writer", "usage", True)}
        assert noted[0]["facts"]["sinks"] == ["mqtt://evil@127.0.0.1?password-file=/etc/passwd"]
        made = asked.request("POST", "/measurements", {"uuids": [hand], "sinks": ["lab", "run.csv"]})
        assert made["sinks"][0] == "lab"
        assert made["sinks"][1].startswith("/")
        [seen] = eye.request("GET", "/measurements")["measurements"]
        assert seen["sinks"] == ["lab", "run.csv"]
        assert str(station.home) not in str(eye.request("GET", "/status"))
        asked.end_measurement(made["id"])
    service.end()


def test_a_folder_of_recordings_that_cannot_be_made_is_reported_as_any_failure_of_a_disk(tmp_path: Path) -> None:
    """A full disk refused the folder with an error that ended the measurement for good."""
    (tmp_path / "recordings").write_text("")
    with pytest.raises(StoreError, match="recordings cannot be written: File exists"):
        DaemonSinks(tmp_path, actuators=True).whole("run.csv")


@pytest.mark.parametrize(
    ("kept", "name"),
    [
        (KeptMeasurement("7", group="left arm/2"), "left_arm_2"),
        (KeptMeasurement("7", group="Arm-1_b"), "Arm-1_b"),
        (KeptMeasurement("7", match="all"), "7"),
        (KeptMeasurement("7", group="a" * 80), "a" * 60),
        (KeptMeasurement(""), "measurement"),
    ],
)
def test_each_measurement_is_recorded_under_its_name_and_its_time(
    tmp_path: Path, kept: KeptMeasurement, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("teds_provision.ncap.sinks.time", SimpleNamespace(strftime=lambda form: f"now {form}"))
    sinks = DaemonSinks(tmp_path, ("ros2",), tmp_path / "kept", actuators=True)
    ros, file = sinks.extra_sinks(kept, None)
    assert (ros.name, Path(file.name).name) == ("ROS 2", f"{name}-now %Y%m%d-%H%M%S.csv")
    assert (tmp_path / "kept").is_dir()
    assert not (tmp_path / "recordings").exists()
    assert sinks.whole("run.mcap") == str(tmp_path / "kept" / "run.mcap")


@pytest.mark.parametrize(
    ("daemon", "actuators", "kept", "named", "allowed", "takes", "publishes"),
    [
        (("ros2",), True, True, (), True, True, True),
        (("ros1",), True, True, ("run.csv",), True, True, True),
        (("mqtt://own",), True, True, (), False, False, True),
        (("mqtt://own",), True, True, ("ros1",), True, False, True),
        ((), True, True, ("ros2",), True, False, False),
        (("ros2",), False, True, (), False, False, True),
        (("ros2",), True, False, (), False, True, True),
    ],
)
def test_set_points_come_by_a_topic_of_ros_if_daemon_and_measurement_let_them(
    tmp_path: Path, daemon: tuple[str, ...], actuators: bool, kept: bool, named: tuple[str, ...],
    allowed: bool, takes: bool, publishes: bool,
) -> None:  # fmt: skip
    sinks = DaemonSinks(tmp_path, daemon, actuators=actuators)
    assert sinks.allows_set_points(KeptMeasurement("m", sinks=named, actuators=kept)) is allowed
    assert (sinks.take_set_points, sinks.publish) == (takes, publishes)


def test_a_sink_is_shown_with_all_of_its_counters() -> None:
    stats = SimpleNamespace(
        state="failed", detail="5 messages/s", error="The disk is full.", hint="Free some space.", written=7, dropped=2,
        octets=99, messages=3,
    )  # fmt: skip
    sink: Any = SimpleNamespace(name="run.csv", stats=stats, recorder=True, files=(Path("/r/run.csv"),))
    assert sink_json("m1", sink) == {
        "measurement": "m1", "name": "run.csv", "state": "failed", "detail": "5 messages/s",
        "error": "The disk is full.", "hint": "Free some space.", "written": 7, "dropped": 2, "octets": 99,
        "messages": 3, "recorder": True, "files": ["/r/run.csv"],
    }  # fmt: skip


@pytest.mark.parametrize(
    ("units", "scalars", "opened"),
    [
        ("si", True, ["/r/run.csv", "/r/run.mcap", "ros2"]),
        ("shown", True, ["shown:/r/run.csv", "/r/run.mcap", "ros2"]),
        ("si", False, ["/r/run.csv", "arrays:/r/run.mcap", "ros2"]),
    ],
)
def test_files_of_the_service_have_its_units_and_its_topics(
    units: Any, scalars: bool, opened: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    specs: list[str] = []
    monkeypatch.setattr("teds_provision.ncap.sinks.open_sink", lambda spec, _take=None: specs.append(spec))
    made = DaemonSinks(tmp_path, actuators=True, units=units, scalars=scalars)
    for spec in ("/r/run.csv", "/r/run.mcap", "ros2"):
        made.open(spec)
    assert specs == opened


def test_what_a_request_may_name_is_in_the_refusal_and_an_extension_may_be_in_capitals(tmp_path: Path) -> None:
    sinks = DaemonSinks(tmp_path, ("mqtt://first", "mqtts://second"), actuators=True, brokers={"lab": LAB})
    with pytest.raises(UsageError) as caught:
        sinks.whole("other")
    assert caught.value.hint == (
        "Use lab, mqtt, ros1, ros2, or a file name in .csv, .txt, .jsonl, .mcap. Brokers: config.toml, [ncap.brokers]"
    )
    assert sinks.whole("RUN.CSV") == str(tmp_path / "recordings" / "RUN.CSV")
    assert sinks.whole("a" * 77 + ".csv").endswith("a.csv")
    with pytest.raises(UsageError):
        sinks.whole("a" * 78 + ".csv")
    assert sinks.open("mqtt").name == "mqtt://first", "the first of several"
    own = sinks.extra_sinks(KeptMeasurement("m", sinks=("mqtt",)), None)
    assert [sink.name for sink in own] == ["mqtts://second"]


@pytest.mark.parametrize("spec", ["mqtt://user:secret@own", "mqtt://", "run.xyz"])
def test_a_malformed_sink_ends_the_start_and_not_the_first_measurement(tmp_path: Path, spec: str) -> None:
    with pytest.raises(UsageError):
        DaemonSinks(tmp_path, (spec,), actuators=True)


@pytest.mark.parametrize("scalars", [True, False])
def test_the_services_foxglove_publishes_each_measurement_and_ends_with_none(tmp_path: Path, scalars: bool) -> None:
    server: Any = SimpleNamespace()
    sinks = DaemonSinks(tmp_path, actuators=True, foxglove=server, scalars=scalars)
    [sink] = sinks.extra_sinks(KeptMeasurement("m"), None)
    assert isinstance(sink, FoxgloveSink)
    assert (sink.server, sink._own, sink._with_scalars) == (server, False, scalars)


def test_set_points_of_each_sink_come_to_the_measurement(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[tuple[str, Any]] = []
    monkeypatch.setattr("teds_provision.ncap.sinks.open_sink", lambda spec, take=None: given.append((spec, take)))
    sinks = DaemonSinks(tmp_path, ("ros2",), actuators=True)
    given.clear()
    take: Any = object()
    sinks.open("ros1", take)
    sinks.extra_sinks(KeptMeasurement("m"), take)
    assert given == [("ros1", take), ("ros2", take)]


def test_readers_see_no_folder_user_or_file_of_a_broker_however_deep_it_stands() -> None:
    found = for_readers(
        {"a": [{"b": ("mqtts://lab?ca=/etc/ca.pem", "mqtt://arm@lab"), "c": None, "d": 5}], "e": "at /home/me/run.csv."}
    )
    assert found == {"a": [{"b": ["mqtts://lab", "mqtt://lab"], "c": None, "d": 5}], "e": "at run.csv."}
