"""A line's request and the office's answer through a real PostgreSQL."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from teds_provision.errors import RegistryError, TedsProvisionError
from teds_provision.plant.demo.cluster import Cluster
from teds_provision.plant.jobs import find_job, take_job
from teds_provision.plant.line import LineRun
from teds_provision.plant.office import answer_all
from teds_provision.plant.postgres import PostgresTransport
from teds_provision.plant.sign_requests import Inbox, OfficeSilentError, RemoteOffice, send_job
from teds_provision.plant.sync import sync
from teds_provision.plant.transport import Parcel
from teds_provision.plant.yield_stats import attempts_of
from teds_provision.protocol.handover.strict_json import time_text
from teds_provision.protocol.plant.document import SIGN_REQUEST
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY
from tests.places import free_tcp_port

from .owner import job_of
from .test_jobs import build, make_board
from .test_office import LocalOffice
from .test_synced_by_database import Office

pytestmark = pytest.mark.system


@pytest.fixture
def plant(tmp_path: Path, cluster: Cluster) -> Iterator[Office]:
    made = Office(tmp_path, cluster)
    yield made
    made.plant.close()


def test_an_office_signs_through_the_registry_for_all_readers_of_a_line(plant: Office) -> None:
    """Eight readers ask at once over one login, which has four connections; the office answers in its own order."""
    north, west = plant.north, plant.member("west", "line")
    north.unlock()
    west.unlock()
    members = {"registry": plant.plant.roster.registry, "sign": north.fingerprint, "stations": {west.fingerprint: 8}}
    job = take_job(north, job_of(north, **members, count=8))
    at_office, at_line = plant.transport(north), plant.transport(west)
    send_job(north, at_office, job)
    plant.sync(north, west)
    over, failed = threading.Event(), []

    def signer() -> None:
        inbox = Inbox(north, at_office, SIGN_REQUEST)
        try:
            while not over.is_set():
                list(answer_all(north, at_office, inbox, [job.id]))
                inbox.wait(1.0, 0.05)
        except TedsProvisionError as error:
            failed.append(error)

    office = threading.Thread(target=signer)
    office.start()
    asks = RemoteOffice(west, at_line, 60)
    line = LineRun(west, find_job(west, job.id), office=asks)
    try:
        with ThreadPoolExecutor(8) as readers:
            built = list(readers.map(lambda number: build(line, make_board(number)), range(1, 9)))
    finally:
        over.set()
        office.join()
        at_office.close()
        asks.close()
    assert failed == []
    assert {done.verified.verdict for done in built} == {"authentic"}
    assert {security.decode(done.image.blocks[SECURITY]).station_key for done in built} == {north.point}
    units = [west.plant.line.unit(job.id, done.who.uuid) for done in built]
    assert sorted(row.unit for row in units if row is not None) == list(range(1, 9))


def test_a_request_that_its_office_took_away_is_there_again_when_it_is_asked_again(plant: Office) -> None:
    """What lay there when the line began was taken for lying there still: who asked again waited for nothing."""
    north, west = plant.north, plant.member("west", "line")
    plant.sync(north, west)
    at_office, at_line = plant.transport(north), plant.transport(west)
    parcel = Parcel(str(uuid.uuid4()), north.fingerprint, b"{}" * 100, time_text(datetime.now(UTC) + timedelta(days=1)))
    at_line.send(parcel)
    at_line.registry()
    at_office.drop(parcel.id, north.fingerprint)
    at_line.send(parcel)
    assert [parcel.id for parcel in at_office.new_parcels(north.fingerprint, ())] == [parcel.id]
    at_line.send(parcel)
    assert [parcel.id for parcel in at_office.new_parcels(north.fingerprint, ())] == [parcel.id]
    at_office.close()
    at_line.close()


def test_a_request_whose_answer_did_not_leave_is_answered_after_the_registry_is_back(plant: Office) -> None:
    """An office that goes on had taken the request for given already: the line waited until the next start."""
    north, west = plant.north, plant.member("west", "line")
    north.unlock()
    west.unlock()
    members = {"registry": plant.plant.roster.registry, "sign": north.fingerprint, "stations": {west.fingerprint: 1}}
    job = take_job(north, job_of(north, **members, count=1))
    at_office, at_line = plant.transport(north), plant.transport(west)
    send_job(north, at_office, job)
    plant.sync(north, west)
    asks = RemoteOffice(west, at_line, 0)
    with pytest.raises(OfficeSilentError):
        build(LineRun(west, find_job(west, job.id), office=asks), make_board(1))
    inbox = Inbox(north, at_office, SIGN_REQUEST)
    lost = SendlessTransport(at_office)
    with pytest.raises(RegistryError):
        list(answer_all(north, lost, inbox, [job.id]))  # type: ignore[arg-type]
    inbox.start_over()
    assert [answered.answer.refused for answered in answer_all(north, at_office, inbox, [job.id])] == [""]
    assert list(answer_all(north, at_office, inbox, [job.id])) == []
    asks.close()
    inbox.close()
    at_office.close()


@dataclass
class SendlessTransport:
    """A transport whose connection is lost when an answer is to leave."""

    transport: PostgresTransport

    def send(self, parcel: Parcel) -> None:
        raise RegistryError("Cannot use the registry: the connection was closed.")


def test_a_registry_that_was_away_hears_everything_once(plant: Office) -> None:
    """Its office answers by hand meanwhile; no unit is lost, none given twice, and no attempt told twice."""
    north, west = plant.north, plant.member("west", "line")
    north.unlock()
    west.unlock()
    members = {"registry": plant.plant.roster.registry, "sign": north.fingerprint, "stations": {west.fingerprint: 3}}
    job = take_job(north, job_of(north, **members))
    send_job(north, plant.transport(north), job)
    plant.sync(north, west)
    away = RemoteOffice(west, plant.transport(west, port=free_tcp_port()), 1)
    line = LineRun(west, find_job(west, job.id), office=away)
    first, second = make_board(1), make_board(2)
    with pytest.raises(RegistryError):
        build(line, first)
    line.office = LocalOffice(north)
    assert build(line, first).verified.verdict == build(line, second).verified.verdict == "authentic"
    with pytest.raises(RegistryError):
        sync(west, away.transport)
    for _ in range(2):
        plant.sync(west, north)
    attempts = attempts_of(north, job.id)
    assert [(attempt.uuid, attempt.unit, attempt.attempt, attempt.code) for attempt in attempts] == [
        (first.uuid, 1, 1, "registry"),
        (first.uuid, 1, 2, None),
        (second.uuid, 2, 1, None),
    ]
    assert west.plant.unsent() == 0
    away.close()
