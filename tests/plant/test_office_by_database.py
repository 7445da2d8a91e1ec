"""A line's request and the office's answer through a real PostgreSQL."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.demo.cluster import Cluster
from teds_provision.errors import TedsProvisionError
from teds_provision.plant.asking import PostOffice, send_job
from teds_provision.plant.jobs import find_job, take_job
from teds_provision.plant.line import LineRun
from teds_provision.plant.office import answer_all
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY

from .owner import job_of
from .test_jobs import board, build
from .test_synced_by_database import Office

pytestmark = pytest.mark.system


@pytest.fixture
def plant(tmp_path: Path, cluster: Cluster) -> Iterator[Office]:
    made = Office(tmp_path, cluster)
    yield made
    made.plant.close()


def test_an_office_signs_through_the_registry(plant: Office) -> None:
    north, west = plant.north, plant.member("west", "line")
    north.unlock()
    west.unlock()
    told = {"registry": plant.plant.roster.registry, "sign": north.fingerprint, "stations": {west.fingerprint: 3}}
    job = take_job(north, job_of(north, **told))
    at_office, at_line = plant.post(north), plant.post(west)
    send_job(north, at_office, job)
    plant.sync(north, west)
    over, failed = threading.Event(), []

    def signer() -> None:
        try:
            while not over.wait(0.05):
                list(answer_all(north, at_office, [job.id]))
        except TedsProvisionError as error:
            failed.append(error)

    office = threading.Thread(target=signer)
    office.start()
    try:
        line = LineRun(west, find_job(west, job.id), office=PostOffice(west, at_line, 60))
        for number in (1, 2):
            done = build(line, board(number))
            assert done.verified.verdict == "authentic"
            assert security.decode(done.image.blocks[SECURITY]).station_key == north.point
    finally:
        over.set()
        office.join()
        at_office.close()
        at_line.close()
    assert failed == []
