"""An `ncap` without a link reports that it cannot find a board, and how to add a link."""

from __future__ import annotations

import signal

import pytest

from tests.cli.shell import call
from tests.e2e.desk import Desk
from tests.ncap.service import Service

pytestmark = pytest.mark.link


def test_without_a_link_ready_and_status_name_the_option(desk: Desk) -> None:
    station = desk.station()
    process = station.start("ncap", "run")
    process.wait_for("Ready on")
    process.wait_for("No link is configured")
    assert "--can socketcan:can0" in call(station.home, "ncap", "status").out
    process.signal(signal.SIGTERM)
    assert process.end().code == 0


def test_with_a_link_they_do_not(desk: Desk) -> None:
    service = Service(desk, desk.station()).start()
    assert "No link" not in call(service.station.home, "ncap", "status").out
    service.end()
