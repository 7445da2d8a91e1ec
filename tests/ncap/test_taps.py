"""Taps: a provisioning that waits for one and is followed live; a tap that nobody asked for; a reader that is lent."""

from __future__ import annotations

import errno
import shutil
import threading
from typing import Any

import pytest

from teds_provision.client import ApiError
from teds_provision.ncap.nodes.node_jobs import NodeJob
from tests.cli.shell import clean_environment
from tests.e2e.desk import ANGLE, Desk
from tests.ncap.service import Service, verdict
from tests.pace import until
from tests.teds.certificates import ANGLE as CERTIFICATE
from tests.teds.certificates import TEMPERATURE, signer

pytestmark = pytest.mark.link
CURVE = "# date: 2026-10-01\nraw,value [degree]\n0,0\n65535,359.9\n"


def test_a_provisioning_waits_for_the_tap_and_every_step_is_reported(desk: Desk) -> None:
    service = Service(desk, desk.station()).start("--nfc", desk.links.nfc)
    node = desk.node("board", called="board")
    events: list[dict[str, Any]] = []
    with service.client() as asked:
        until(lambda: [link["state"] for link in asked.status()["links"]] == ["up", "up"])
        listening = service.client()

        def follow() -> None:
            for message in listening.live():
                events.append(message)
                if message.get("event") == "provision" and message["state"] in ("done", "failed"):
                    return

        following = threading.Thread(target=follow, daemon=True)
        following.start()
        until(lambda: events)
        asked_for = asked.request("POST", f"/nodes/{node.uuid}/provision", {"profile": ANGLE, "name": "crane"})
        assert (asked_for["state"], asked_for["waits_for"]) == ("waiting", "tap")
        node.start()
        following.join(60)
        steps = [event for event in events if event.get("event") == "provision"]
        assert steps[0]["state"] == "waiting"
        done = [entry["step"] for entry in steps if entry.get("result") in ("done", "nothing to do", "skipped")]
        assert done == ["identify", "whitelist", "agree", "build", "sign", "write", "verify", "check"]
        assert steps[-1]["state"] == "done", steps[-1]
        tapped = next(event for event in events if event.get("event") == "node" and event["state"] == "tapped")
        assert tapped["uuid"] == node.uuid
        found = asked.node(node.uuid)
        assert (found["name"], verdict(found), found["via"]) == ("crane", "authentic", "nfc")
        node.stop()
        until(lambda: not asked.node(node.uuid)["present"])
        node.start()  # a tap without a request: it is looked at
        until(lambda: asked.node(node.uuid)["present"])
    service.end()


def test_a_request_that_could_not_begin_is_none_that_runs(desk: Desk) -> None:
    """Where no temporary file could be written, the node was "already being provisioned" until the next start."""
    temporary = desk.folder / "tmp"
    temporary.mkdir()
    service = Service(desk, desk.station()).start(environment=clean_environment(TMPDIR=str(temporary)))
    with service.client() as asked:
        begin = ("POST", "/nodes/next/provision")
        asked.request(*begin, {"profile": ANGLE})
        asked.request(*begin, {"cancel": True})
        shutil.rmtree(temporary)
        with pytest.raises(ApiError, match="No temporary file can be written: No such file") as refused:
            asked.request(*begin, {"profile": ANGLE})
        assert (refused.value.status, refused.value.code) == (503, "store")
        assert asked.request("GET", "/nodes/next/provision")["state"] == "cancelled"
        temporary.mkdir()
        assert asked.request(*begin, {"profile": ANGLE})["state"] == "waiting"
    service.end()


def test_a_request_whose_work_the_system_refuses_has_failed(desk: Desk) -> None:
    """It was "running" until the next start, and every further request for the node was refused."""
    temporary = desk.folder / "tmp"
    temporary.mkdir()
    service = Service(desk, desk.station()).start(
        "--nfc", desk.links.nfc, environment=clean_environment(TMPDIR=str(temporary))
    )
    node = desk.node("angle")
    order = {"profile": ANGLE, "calibration": CURVE, "calibration_name": "angle.csv"}
    with service.client() as asked:
        path = f"/nodes/{node.uuid}/provision"
        assert asked.request("POST", path, order)["state"] == "waiting"
        for folder in temporary.iterdir():  # a cleaner of old temporary files came by
            shutil.rmtree(folder)
        node.start()
        run = until(lambda: (found := asked.request("GET", path))["state"] in ("failed", "done") and found)
        assert run["state"] == "failed"
        node.stop()
        until(lambda: not asked.node(node.uuid)["present"])
        assert asked.request("POST", path, order)["state"] == "waiting"
        node.start()
        assert (
            until(lambda: (found := asked.request("GET", path))["state"] in ("failed", "done") and found)["verdict"]
            == "authentic"
        )
    service.end()


@pytest.mark.parametrize(
    ("error", "code"), [(OSError(errno.EIO, "Input/output error"), "store"), (ZeroDivisionError(), "bug")]
)
def test_a_thread_that_waits_for_an_errand_gets_any_failure(error: Exception, code: str) -> None:
    node: Any = None

    def work(_node: Any) -> None:
        raise error

    errand = NodeJob("ab" * 10, "provision", work, 0.0)
    with pytest.raises(type(error)):
        errand.run(node)
    assert errand.done.is_set()
    assert errand.error is not None
    assert errand.error.code == code


def test_the_next_board_that_is_tapped_is_provisioned_whichever_it_is(desk: Desk) -> None:
    service = Service(desk, desk.station()).start("--nfc", desk.links.nfc)
    with service.client() as asked:
        asked.request("POST", "/nodes/next/provision", {"profile": ANGLE, "name": "next one"})
        node = desk.node("board").start()
        run = until(lambda: service_run(asked, node.uuid))
        assert (run["state"], run["verdict"]) == ("done", "authentic"), run
    service.end()


def test_a_certificate_calibrates_the_next_board_if_the_service_trusts_who_signed_it(desk: Desk) -> None:
    lab = signer()
    pem = desk.folder / "lab.pem"
    pem.write_bytes(lab.certificate)
    service = Service(desk, desk.station()).start("--nfc", desk.links.nfc, "--trust-dcc", pem)
    with service.client() as asked:
        order = {"profile": ANGLE, "calibration_name": "angle.xml", "calibration_channel": 1}
        for text, code in ((CERTIFICATE, "not-authentic"), (lab.sign(TEMPERATURE), "bad-data")):
            with pytest.raises(ApiError) as refused:
                asked.request("POST", "/nodes/next/provision", {**order, "calibration": text.decode()})
            assert refused.value.code == code
        both = {**order, "profile": "temperature-sensor", "calibration": lab.sign(TEMPERATURE).decode()}
        with pytest.raises(ApiError, match="as-found") as unclear:
            asked.request("POST", "/nodes/next/provision", both)
        assert unclear.value.code == "unclear-item"
        asked.request("POST", "/nodes/next/provision", {**order, "calibration": lab.sign(CERTIFICATE).decode()})
        node = desk.node("board").start()
        run = until(lambda: service_run(asked, node.uuid))
        assert (run["state"], run["verdict"]) == ("done", "authentic"), run
        codes = [block["access_code"] for block in asked.request("GET", f"/nodes/{node.uuid}/teds")["teds"]]
        assert 131 in codes
    service.end()


def service_run(asked: Any, uuid: str) -> Any:
    found = next((node for node in asked.nodes() if node["uuid"] == uuid), None)
    if found is None or verdict(found) != "authentic":
        return None
    run = asked.request("GET", f"/nodes/{uuid}/provision")
    return run if run["state"] in ("done", "failed") else None


def test_a_command_borrows_the_reader_and_gives_it_back(desk: Desk) -> None:
    service = Service(desk, desk.station()).start("--nfc", desk.links.nfc)
    node = desk.node("board").start()
    with service.client() as asked:
        until(lambda: asked.status()["links"][1]["state"] == "up")
        done = service.station.provision("nfc", "--profile", ANGLE)
        assert (done["uuid"], done["verdict"]) == (node.uuid, "authentic")
        until(lambda: asked.status()["links"][1]["state"] == "up")
        until(lambda: asked.node(node.uuid)["verified"])
        assert verdict(asked.node(node.uuid)) == "authentic"
    service.end()
