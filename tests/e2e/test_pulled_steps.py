"""A board pulled at the start of every step, and in the middle of the write: another one is done first, then it itself.

In this process, so that the board is gone exactly when the step begins; over nfcpy's udp driver, and over its PN53x
driver above a simulated chip.
"""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path

import pytest

from teds_provision.errors import LinkError, NoReaderError
from teds_provision.links import LinkSettings
from teds_provision.links.nfc import port
from teds_provision.provisioning.batch import BatchRun, ProvisionRequest
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.inventory import inventory
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.station.station import Station as BaseStation
from tests.bench import PASSPHRASE
from tests.links.nfc.field import Field

from .desk import ANGLE, Station
from .test_pulled import boards, field, serial

__all__ = ["boards", "field", "serial"]  # fixtures of the other half
pytestmark = pytest.mark.link
POINTS = ("agree", "build", "write", "half written", "verify")


class PullingReporter(SilentReporter):
    """Lifts the board off when the step that is named begins, once."""

    def __init__(self, field: Field) -> None:
        self._field = field
        self.at = ""

    def started(self, step: str) -> None:
        if step == self.at:
            self._lift()

    def written(self, octets: int, total: int) -> None:
        if self.at == "half written" and octets * 2 >= total:
            self._lift()

    def _lift(self) -> None:
        self.at = ""
        self._field.lift()


def pull_at_each(home: Path, field: Field, path: str, lying: list[tuple[str, str]]) -> None:
    station = BaseStation.open(home, ask=lambda prompt, confirm: PASSPHRASE)
    pulling = PullingReporter(field)
    request = ProvisionRequest(order=BuildOrder(ANGLE), watch=True)
    run = BatchRun(station, LinkSettings("nfc", path, timeout=30.0), request, pulling)
    came = run.many(AcceptingOperator())
    (other, other_path), *others = lying
    try:
        for (uuid, board), point in zip(others, POINTS, strict=True):
            pulling.at = point
            field.put(board)
            pulled = next(came)
            assert (pulled.uuid.hex(), pulled.result) == (uuid, "failed"), (point, pulled)
            assert isinstance(pulled.failure, LinkError), (point, pulled.failure)
            for next_uuid, next_path in ((other, other_path), (uuid, board)):
                field.put(next_path)
                done = next(came)
                if isinstance(done.failure, NoReaderError):  # the simulated reader's process had no time to answer
                    field.lift()
                    time.sleep(2 * port.RETURN_WITHIN)  # put back sooner, it is the same visit, which is over
                    field.put(next_path)
                    done = next(came)
                assert (done.uuid.hex(), done.result) == (next_uuid, "passed"), (point, done, done.failure)
                field.lift()
        known = {node.uuid: node.verdict for node in inventory(station, [node.uuid for node in station.nodes.all()])}
        assert known == dict.fromkeys(dict(lying), "authentic")
    finally:
        run.stop.set()
        came.close()  # type: ignore[attr-defined]
        station.close()


def test_above_the_udp_driver(
    station: Station, field: Field, boards: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(port, "RETURN_WITHIN", 0.5)
    pull_at_each(station.home, field, field.path, boards)


@pytest.mark.nightly(
    "tests/e2e/test_pulled_steps.py::test_above_the_udp_driver; pulls below that driver are held by "
    "tests/links/nfc/test_nfc_pulled.py::test_pulled_at_every_frame_below_a_usb_reader"
)
def test_above_the_pn53x_driver(
    station: Station,
    field: Field,
    boards: list[tuple[str, str]],
    serial: tuple[str, subprocess.Popen[str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(port, "RETURN_WITHIN", 0.5)
    pull_at_each(station.home, field, serial[0], boards)


def test_under_identify_another_one_comes_first(station: Station, field: Field, boards: list[tuple[str, str]]) -> None:
    watch = station.start("--json", "identify", "--watch", "--nfc", field.path)
    (first, first_path), (second, second_path), (third, third_path), *_ = boards
    field.put(first_path)
    assert watch.wait_for_lines(1)[-1]["uuid"] == first
    frames = field.frames
    field.put(second_path, lift_after=int(frames * 0.6))
    line = watch.wait_for_lines(2)[-1]
    for number, (uuid, path) in enumerate(((third, third_path), (second, second_path)), 3):
        field.put(path)
        line = watch.wait_for_lines(number)[-1]
        assert line.get("uuid") == uuid, line
        assert "fingerprint" in line, line
    watch.signal(signal.SIGTERM)
    assert watch.end().code == 0
