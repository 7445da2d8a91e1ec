"""What other programs read: metrics for Prometheus, the HTTP paths of IEEE 1451.0 clause 12; both off by default."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from teds_provision.ncap.web.metrics import text
from tests.e2e.desk import Desk
from tests.ncap.service import Answer, Service, virtual
from tests.pace import until

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def open_service(tmp_path_factory: pytest.TempPathFactory, prepared: Path) -> Iterator[Service]:
    desk = Desk(tmp_path_factory.mktemp("seen"), prepared)
    try:
        yield Service(desk, desk.station()).start("--metrics", "--http-1451")
    finally:
        desk.clear()


@pytest.fixture(scope="module")
def hand(open_service: Service) -> str:
    uuid = virtual(open_service)
    with open_service.client() as asked:
        asked.request("POST", "/measurements", {"uuids": [uuid], "rate": 20, "sinks": ["seen.csv", "seen.csv"]})
        until(lambda: (asked.node(uuid)["measuring"] or {}).get("samples"))
    return uuid


@pytest.fixture(scope="module")
def bearer(open_service: Service) -> dict[str, str | None]:
    return {"Authorization": f"Bearer {open_service.token('old', '--read-only')}"}


def test_both_are_off_unless_asked_for(service: Service) -> None:
    bearer: dict[str, str | None] = {"Authorization": f"Bearer {service.token('nobody')}"}
    for path in ("/metrics", "/1451/Discovery/TIMDiscovery"):
        assert service.raw("GET", path, bearer).status == 404


def test_both_want_a_token_and_our_own_host(open_service: Service, bearer: dict[str, str | None]) -> None:
    for path in ("/metrics", "/1451/Discovery/TIMDiscovery"):
        assert open_service.raw("GET", path).status == 401
        assert open_service.raw("GET", path, {**bearer, "Host": "evil.example"}).status == 421
        assert open_service.raw("POST", path, {**bearer, "Content-Type": "application/json"}, "{}").status == 403


def test_metrics_are_prometheus_text_with_what_counts(
    open_service: Service, hand: str, bearer: dict[str, str | None]
) -> None:
    answer = open_service.raw("GET", "/metrics", bearer)
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    line = re.compile(r'[a-z_]+(\{([a-z]+="(\\.|[^"\\])*",?)*\})? [-+0-9.eE]+\Z')
    values = [splitline for splitline in answer.text.splitlines() if not splitline.startswith("#")]
    assert not [value for value in values if not line.match(value)]
    samples = next(value for value in values if value.startswith("teds_samples_total"))
    assert hand in samples
    assert float(samples.rpartition(" ")[2]) > 0
    assert any(value.startswith("teds_sink_written_total") and 'sink="seen.csv"' in value for value in values), (
        "no folder"
    )
    names = [value.rpartition(" ")[0] for value in values]
    assert len(names) == len(set(names)), "Prometheus takes no two samples of one series"
    assert any(value.startswith("teds_link_up") and value.endswith(" 1") for value in values)


def test_a_counter_has_all_its_digits_and_a_series_one_line() -> None:
    report = {"uuid": "ab" * 10, "state": "running", "samples": 1_234_567_891, "clock_error": 0.00012345678}
    sink = {"name": "mqtt://lab", "measurement": "m", "written": 10**9 + 1, "dropped": 0, "state": "running"}
    status = {
        "version": "1", "station": {"name": "b"}, "links": [], "measurements": [{"id": "m", "nodes": [report]}],
        "sinks": [sink, sink], "budget": {"used": 0.5}, "clients": 0,
    }  # fmt: skip
    lines = text(status).splitlines()
    assert f'teds_samples_total{{node="{"ab" * 10}",measurement="m"}} 1234567891' in lines
    assert lines.count('teds_sink_written_total{sink="mqtt://lab",measurement="m"} 1000000001') == 1
    assert any(line.endswith("} 0.00012345678") for line in lines)
    assert 'teds_node_measuring{node="' + "ab" * 10 + '",measurement="m"} 1' in lines


def test_the_paths_of_clause_12(open_service: Service, hand: str, bearer: dict[str, str | None]) -> None:
    def ask(path: str) -> Answer:
        return open_service.raw("GET", f"/1451/{path}", bearer)

    def fields(answer: Answer) -> dict[str, Any]:
        return {element.tag: element.text for element in ElementTree.fromstring(answer.text)}

    found = ask("Discovery/TIMDiscovery")
    assert ElementTree.fromstring(found.text).tag == "TIMDiscoveryHTTPResponse"
    assert fields(found) == {"errorCode": "0", "timIds": "1", "uuids": hand}
    channels = fields(ask("Discovery/TransducerDiscovery.htm?timId=1&timeout=10&timtype=1&format=1"))
    assert channels["channelIds"] == "1,2,3"
    assert "opening" in channels["transducerNames"]
    read = ask("TransducerAccess/readdata?TIMID=1&ChannelId=2&timeout=10&SamplingMode=5&responseFormat=json").json
    assert -1e-12 < read["transducerData"] <= 0.11, "closed is 0 but for the last bit of a calibrated double"
    assert fields(ask(f"TransducerAccess/ReadData?timId={hand}&channelId=9"))["errorCode"] == "1"
    raw = fields(ask("TEDSManager/ReadRawTeds?timId=1&channelId=0&timeout=10&tedsType=1"))
    assert bytes.fromhex(hand) in base64.b64decode(raw["rawTEDS"])
    assert hand in fields(ask("TEDSManager/ReadTeds?timId=1&channelId=0&tedsType=1"))["teds"]
    text = ask("TEDSManager/ReadRawTeds?timId=1&channelId=0&tedsType=99&responseFormat=text").text
    assert text.splitlines()[0] == "1"
    assert fields(ask("TransducerAccess/ReadData?timId=1&channelId=y"))["errorCode"] == "3"
    assert ask("TEDSManager/WriteTeds?timId=1").status == 404, "read only"
