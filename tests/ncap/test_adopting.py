"""Factory nodes on the bus of a running base station: keyed, shown, and by a yes signed as they describe themselves."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from teds_provision.client import ApiError
from teds_provision.ncap.membership import AGAIN
from teds_provision.node.flash_file import FlashFile
from teds_provision.teds.image import BlockId
from tests.e2e.desk import Desk, Node
from tests.ncap.service import Service, verdict
from tests.pace import until
from tests.provisioning.test_adopting import factory, named

pytestmark = pytest.mark.link


@pytest.fixture
def desk(tmp_path: Path, prepared: Path) -> Iterator[Desk]:
    made = Desk(tmp_path, prepared)
    yield made
    made.clear()


def brings(desk: Desk, name: str = "joint", blocks: Mapping[BlockId, bytes] | None = None, *, can: str = "") -> Node:
    """Return a factory sensor with a datasheet of its own, powered, on the desk's bus."""
    uuid = desk.new_uuid()
    folder = desk.folder / uuid.hex()
    FlashFile.create(folder, uuid=uuid, name="", max_message=2048, blocks=blocks or factory(uuid, name)).release()
    words = ["--source", "ramp:2", "--can", can or desk.links.can]
    return Node(desk, folder, uuid.hex()).start(*words, nfc=False)


def adopting(desk: Desk, *words: object) -> Service:
    return Service(desk, desk.station()).start("--detection", "transparent", "--adopt", *words)


def events(service: Service, kind: str, uuid: str) -> list[dict[str, Any]]:
    process = service.process
    assert process is not None
    while process.read(0.1):
        pass
    lines = [json.loads(line) for line in process.out[: process.out.rfind("\n") + 1].splitlines()]
    return [line for line in lines if line.get("event") == kind and line.get("uuid") == uuid]


def test_with_yes_a_good_one_is_signed_and_measured_without_another_word(desk: Desk) -> None:
    node = brings(desk)
    service = adopting(desk, "--yes", "--measure", "all", "--rate", 20)
    with service.client() as asked:
        until(lambda: verdict(asked.node(node.uuid)) == "authentic" if known(service, node) else False)
        until(lambda: asked.node(node.uuid)["measurement"] is not None)
        assert asked.node(node.uuid)["name"] == "joint"
    assert node.datasheet[1, 3] == factory(bytes.fromhex(node.uuid))[1, 3]
    service.end()


def known(service: Service, node: Node) -> bool:
    with service.client() as asked:
        return any(known_node["uuid"] == node.uuid for known_node in asked.nodes())


def test_without_it_a_yes_by_the_api_or_a_command_beside_it_signs(desk: Desk) -> None:
    first, second = brings(desk), brings(desk, "elbow")
    service = adopting(desk)
    with service.client() as asked:
        for node in (first, second):
            until(lambda node=node: known(service, node) and verdict(asked.node(node.uuid)) == "unsigned")
        assert asked.node(first.uuid)["state"] == "keyed"
        assert [channel["name"] for channel in asked.node(first.uuid)["channels"]] == ["angle"]
        asked.provision(first.uuid, adopt=True)
        until(lambda: verdict(asked.node(first.uuid)) == "authentic")
    done = service.station.ask("provision", second.uuid, "--adopt", "--yes", *desk.links.over("can"))
    assert (done["verdict"], done["name"]) == ("authentic", "elbow")
    service.end()


def test_a_hostile_one_is_refused_once_and_reported(desk: Desk) -> None:
    node = brings(desk, blocks=named(factory(b"\0" * 10), 1, "angle\x1b[2J"))
    service = adopting(desk, "--yes")
    until(lambda: any(event["state"] == "not adopted" for event in events(service, "node", node.uuid)))
    with service.client() as asked:
        asked.discover()
        until(lambda: verdict(asked.node(node.uuid)) == "unsigned")
        assert "\x1b" not in json.dumps(asked.node(node.uuid)["channels"])
        asked.provision(node.uuid, adopt=True)
        until(lambda: asked.request("GET", f"/nodes/{node.uuid}/provision", None)["state"] == "failed")
    assert [event["state"] for event in events(service, "node", node.uuid)].count("not adopted") == 1
    refused = service.station.refuses("provision", node.uuid, "--adopt", "--yes", *desk.links.over("can"), code=8)
    assert "unprintable" in refused["message"]
    service.end()


def test_one_with_very_many_channels_gets_no_key_and_delays_no_other(desk: Desk) -> None:
    own = factory(b"\0" * 10)
    many = {**own, **{(n, code): own[1, code] for n in range(2, 151) for code in (3, 5)}}
    hostile, good = brings(desk, blocks=many), brings(desk)
    service = adopting(desk, "--yes")
    with service.client() as asked:
        until(lambda: known(service, good) and verdict(asked.node(good.uuid)) == "authentic")
        problem = until(lambda: known(service, hostile) and asked.node(hostile.uuid)["problem"])
        assert "is not adopted" in problem["message"]
        assert asked.node(hostile.uuid)["epoch"] == 0
    service.end()


def test_a_node_without_a_key_is_not_measured_and_the_reason_is_that(desk: Desk) -> None:
    node = brings(desk)
    service = Service(desk, desk.station()).start("--detection", "transparent")
    with service.client() as asked:
        until(lambda: known(service, node) and verdict(asked.node(node.uuid)) is not None)
        with pytest.raises(ApiError) as refused:
            asked.request("POST", "/measurements", {"uuids": [node.uuid]})
        assert "holds no key of node" in str(refused.value)
    service.end()


def test_yes_belongs_to_adopt(desk: Desk) -> None:
    assert "--adopt" in desk.station().refuses("ncap", "run", "--yes", code=2)["message"]


def test_unverified_ones_are_measured_calibrated_and_everything_says_so(desk: Desk, tmp_path: Path) -> None:
    node = brings(desk)
    record = tmp_path / "record"
    service = adopting(desk, "--unverified", "--rate", 20, "--record", record)
    with service.client() as asked:
        until(lambda: known(service, node) and asked.node(node.uuid)["measurement"] == "unverified")
        found = until(lambda: flowing(asked.node(node.uuid)), "no value comes")
        assert (found["name"], found["unverified"], found["verdict"]["verdict"]) == ("joint", True, "unsigned")
        [channel] = found["channels"]
        assert 0 <= channel["last"]["value"] < 6.3
        assert channel["topic"] == "/bench/unverified/joint/angle"
        assert [
            row["topic"]
            for row in asked.request("GET", "/names")["names"]
            if row["uuid"] == node.uuid and row["channel"]
        ] == [channel["topic"]]
        listed = desk.station().ask("names", "list")["names"]
        assert [row["topic"] for row in listed if row["uuid"] == node.uuid] == [channel["topic"]]
        joined = [event for event in events(service, "measurement", node.uuid) if event["state"] == "joined"]
        assert [entry["id"] for entry in joined] == ["unverified"]

        asked.provision(node.uuid, adopt=True)  # by the page: it is signed while it is measured
        until(lambda: verdict(asked.node(node.uuid)) == "authentic")
        until(lambda: ("adopted", "joined") in events_of(service, node), "it is not measured on")
        after = until(lambda: flowing(asked.node(node.uuid)))
        assert after["channels"][0]["topic"] == "/bench/joint/angle"
        assert not after["unverified"]
        assert after["problem"] is None
        sizes = lambda: {run["id"]: len(run["nodes"]) for run in asked.measurements()}  # noqa: E731
        until(lambda: sizes() == {"unverified": 0, "adopted": 1}, lambda: (sizes(), events_of(service, node)))
    assert events_of(service, node) == [("unverified", "joined"), ("unverified", "left"), ("adopted", "joined")]
    service.end()
    texts = {file.name.split("-")[0]: file.read_text() for file in record.glob("*.csv")}
    lines = [line for line in texts["unverified"].splitlines() if node.uuid in line and not line.startswith("#")]
    assert lines
    assert all(",unverified datasheet," in line for line in lines)
    assert '"unverified": true' in texts["unverified"]
    assert "unverified" not in texts["adopted"]


def flowing(node: dict[str, Any]) -> dict[str, Any] | None:
    last = node["channels"][0]["last"] if node["channels"] else None
    return node if last and last["age"] < 1 and last["value"] is not None else None


def events_of(service: Service, node: Node) -> list[tuple[str, str]]:
    return [(event["id"], event["state"]) for event in events(service, "measurement", node.uuid)]


def test_one_that_is_adopted_by_a_command_beside_goes_on_as_what_is_trusted(desk: Desk) -> None:
    node = brings(desk)
    service = adopting(desk, "--unverified", "--measure", "all", "--rate", 20)
    with service.client() as asked:
        until(lambda: known(service, node) and asked.node(node.uuid)["measurement"] == "unverified")
        service.station.ask("provision", node.uuid, "--adopt", "--yes", *desk.links.over("can"))
        until(lambda: asked.node(node.uuid)["measurement"] in ("run", "adopted"), seconds=AGAIN)
        until(lambda: flowing(asked.node(node.uuid)))
        of_unverified = lambda: next(run for run in asked.measurements() if run["id"] == "unverified")  # noqa: E731
        until(lambda: of_unverified()["nodes"] == [], of_unverified)
        until(lambda: asked.node(node.uuid)["problem"] is None)
    left = [event for event in events(service, "measurement", node.uuid) if event["state"] == "left"]
    assert left[0]["id"] == "unverified"
    service.end()


def test_one_that_is_reset_while_it_is_measured_is_taken_up_again(desk: Desk) -> None:
    node = brings(desk)
    service = adopting(desk, "--unverified", "--rate", 20)
    with service.client() as asked:
        until(lambda: known(service, node) and asked.node(node.uuid)["measurement"] == "unverified")
        node.press()
        asked.discover()
        seen = functools.partial(events, service, "node", node.uuid)
        why = lambda: (seen(), service.process and service.process.err)  # noqa: E731
        until(lambda: asked.node(node.uuid)["epoch"] == 2, why, seconds=AGAIN)
        until(lambda: asked.node(node.uuid)["measurement"] == "unverified", why, seconds=AGAIN)
        until(lambda: flowing(asked.node(node.uuid)))
    service.end()


def test_two_of_one_name_and_one_that_is_trusted_have_topics_of_their_own(desk: Desk) -> None:
    first, second = brings(desk, "joint"), brings(desk, "Joint")
    service = adopting(desk, "--unverified", "--rate", 20)
    with service.client() as asked:
        for node in (first, second):
            until(lambda node=node: known(service, node) and flowing(asked.node(node.uuid)))
        topics = {asked.node(node.uuid)["channels"][0]["topic"] for node in (first, second)}
        assert len(topics) == 2
        assert all(topic.startswith("/bench/unverified/joint") for topic in topics)
    service.end()


def test_unverified_belongs_to_adopt(desk: Desk) -> None:
    assert "--adopt" in desk.station().refuses("ncap", "run", "--unverified", code=2)["message"]
