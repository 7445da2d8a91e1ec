"""A measurement belongs to whoever began it: `ncap run` beside `measure GROUP`, with ends and cuts of both."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from teds_provision.client import ApiError
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeptMeasurement
from tests.e2e.desk import Running
from tests.measure.rig import Rig, killed
from tests.ncap.service import Service
from tests.pace import until

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    made = Rig(tmp_path_factory.mktemp("owners"), {"g": "gripper"})
    try:
        made.nodes["g"].start()
        made.station.ask("group", "create", "arm", made.nodes["g"].uuid)
        yield made
    finally:
        made.close()


@pytest.fixture(autouse=True)
def tidy(rig: Rig) -> Iterator[None]:
    """Each test ends all that it began, and leaves no measurement in the store."""
    yield
    rig.desk.clear(but=[node.process for node in rig.nodes.values()])
    with closing(Station.inspect(rig.station.home)) as store:
        for kept in store.measurements._rows():
            store.measurements.forget(kept.id)


def rows(rig: Rig) -> list[KeptMeasurement]:
    """Return the rows as they are stored: this reader removes none."""
    with closing(Station.inspect(rig.station.home)) as store:
        return store.measurements._rows()


def began(rig: Rig, *words: object) -> Running:
    """`measure arm`, once its first value came."""
    command = rig.begin("arm", "--rate", 20, *words)
    command.wait_for('"event":"data"')
    return command


def ncap(rig: Rig) -> Service:
    return Service(rig.desk, rig.station).start()


def listed(service: Service) -> list[dict[str, Any]]:
    with service.client() as asked:
        return [dict(measurement) for measurement in asked.measurements()]


def test_ncap_shows_the_measurement_of_a_command_and_never_takes_it_over(rig: Rig) -> None:
    command = began(rig, "--to", rig.folder / "own.csv")
    [row] = rows(rig)
    assert (row.owner, row.pid) == ("command", command.process.pid)
    assert row.started
    service = ncap(rig)
    [shown] = listed(service)
    assert (shown["owner"], shown["state"], shown["group"]) == ("command", "running", "arm")
    assert shown["process"] == {"id": command.process.pid, "started": row.started}
    assert rig.station.ask("ncap", "status")["measurements"][0]["owner"] == "command"
    with service.client() as asked, pytest.raises(ApiError, match="belongs to the command measure"):
        asked.request("DELETE", f"/measurements/{shown['id']}")
    command.signal(signal.SIGINT)
    assert command.end().code == 0
    assert listed(service) == []
    assert rows(rig) == []
    assert not any(json.loads(line).get("event") == "measurement" for line in service.process.out.splitlines())
    service.kill()
    assert listed(ncap(rig)) == [], "and a restart finds nothing to carry on"


@pytest.mark.parametrize("reader", ["status", "start", "measure"])
def test_the_next_reader_removes_the_row_of_a_killed_command(rig: Rig, reader: str) -> None:
    service = ncap(rig) if reader == "status" else None
    killed(began(rig))
    assert len(rows(rig)) == 1
    if service is not None:
        assert listed(service) == []
    elif reader == "start":
        assert listed(ncap(rig)) == []
    else:
        command = began(rig)  # other options: it is no continuation
        assert [row.pid for row in rows(rig)] == [command.process.pid]
        command.signal(signal.SIGINT)
        assert command.end().code == 0
    assert rows(rig) == []


def test_a_process_that_got_the_process_id_of_a_killed_command_does_not_own_its_row(rig: Rig) -> None:
    with closing(Station.inspect(rig.station.home)) as store:
        store.measurements.keep(KeptMeasurement("dead", group="arm", owner="command", pid=os.getpid(), started=1))
    assert listed(ncap(rig)) == []
    assert rows(rig) == []


def test_what_the_socket_the_page_and_a_token_begin_is_carried_on_by_ncap(rig: Rig) -> None:
    service = ncap(rig)
    token = service.token("plotter")
    with service.client() as asked:
        mine = asked.request("POST", "/measurements", {"match": "name:none"})
    with service.client(token) as asked:
        theirs = asked.request("POST", "/measurements", {"match": "name:nothing", "scalar_rate": 3})
    assert (mine["owner"], mine["process"]) == ("ncap", None)
    assert (theirs["owner"], theirs["scalar_rate"]) == ("api:plotter", 3)
    service.kill()
    assert {entry["owner"] for entry in listed(ncap(rig))} == {"ncap", "api:plotter"}


def test_ncap_waits_for_the_group_that_a_command_measures_and_gets_it_afterwards(rig: Rig, tmp_path: Path) -> None:
    service = ncap(rig)
    command = began(rig, "--to", tmp_path / "own.csv")
    with service.client() as asked:
        asked.request("POST", "/measurements", {"group": "arm", "rate": 20})
    killed(command)
    until(lambda: [entry["state"] for entry in listed(service)] == ["running"], "its own measurement begins")
    assert [row.owner for row in rows(rig)] == ["ncap"]


def test_the_log_has_what_is_measured_and_who_requested_it(rig: Rig) -> None:
    service = ncap(rig)
    uuid, token = rig.nodes["g"].uuid, service.token("script")
    with service.client(token) as asked:
        made = asked.request("POST", "/measurements", {"uuids": [uuid], "rate": 20})["id"]

    def entries(asked: Any, node: str = "") -> list[dict[str, Any]]:
        found = asked.request("GET", f"/log?act=measure&limit=50{f'&uuid={node}' if node else ''}")["entries"]
        return [entry for entry in found if entry["facts"].get("id") == made]

    with service.client() as asked:
        until(lambda: entries(asked, uuid), "its first value is in the history of the node")
        [joined] = entries(asked, uuid)
    assert (joined["outcome"], joined["facts"]["owner"]) == ("joined", "api:script")
    service.end()
    service = ncap(rig)
    with service.client() as asked:
        until(lambda: len(entries(asked, uuid)) == 2, "and that of the next run")
        until(lambda: asked.measurements()[0]["nodes"][0]["samples"])
        asked.request("DELETE", f"/measurements/{made}")
        entries_found = [(entry["outcome"], entry["actor"]) for entry in entries(asked) if entry["uuid"] is None]
        last = entries(asked)[-1]
    assert [outcome for outcome, _ in entries_found] == ["begun", "paused", "continued", "ended"]
    assert entries_found[0][1] == "script"
    assert entries_found[-1][1] != "script", "whoever ended it is another one"
    assert {entry["facts"]["owner"] for entry in [last]} == {"api:script"}
    assert last["facts"]["samples"] > 0
    assert last["facts"]["rate"] == 20


def test_a_measurement_whose_time_is_over_holds_its_nodes_no_longer(rig: Rig) -> None:
    """It was listed as ended, and its nodes as measured, until somebody deleted it."""
    for seconds in (5, 20, 60):  # a busy machine takes longer than the first to start
        with closing(Station.inspect(rig.station.home)) as store:
            store.measurements.keep(KeptMeasurement("brief", group="arm", rate=20.0, ends=time.time() + seconds))
        service = ncap(rig)
        shown = listed(service)
        if shown:
            break
        service.kill()
    assert [(entry["id"], entry["group"]) for entry in shown] == [("brief", "arm")]
    until(lambda: not listed(service), "its time is over")
    with service.client() as asked:
        again = asked.request("POST", "/measurements", {"group": "arm", "rate": 20})
        until(lambda: [entry["state"] for entry in listed(service)] == ["running"], "the group is free")
        asked.request("DELETE", f"/measurements/{again['id']}")
