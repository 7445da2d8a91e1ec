"""What the API shows of a node: from the store, from its link, and by its own unproven word, each in its place."""

from __future__ import annotations

import asyncio
import json
import math
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NotFoundError
from teds_provision.ncap.live import Live, LiveClient
from teds_provision.ncap.nodes import directory as of_nodes
from teds_provision.ncap.nodes.directory import NodeDirectory
from teds_provision.shapes.node import KnownNode
from tests.pace import PATIENCE

NODE = "ab" * 10
CHANNEL: dict[str, Any] = {"number": 1, "name": "angle", "problem": None}


class Shown(NodeDirectory):
    """A directory without a store, of one node with one channel."""

    def __init__(self) -> None:
        nothing: Any = None
        self.values: dict[int, Any] = {}
        live: Any = SimpleNamespace(event=lambda *_words, **_facts: None, last=lambda _uuid, n: self.values.get(n))
        super().__init__(nothing, live)
        self.sheet: list[dict[str, Any]] = [CHANNEL]

    def _sheet(self, uuid: str) -> list[dict[str, Any]]:
        return self.sheet

    def judge(self, origin: str, verdict: str) -> None:
        shown = {"verdict": verdict, "from": origin}
        judged: Any = SimpleNamespace(origin=origin, to_json=lambda: shown)
        self._judged[NODE] = judged


def test_a_node_is_known_by_its_link_or_by_the_store() -> None:
    directory, kept = Shown(), "cd" * 10
    assert not directory.known(NODE)
    directory.note(NODE, present=False)
    directory._rows[kept] = KnownNode(bytes.fromhex(kept))
    assert [directory.known(uuid) for uuid in (NODE, kept, "ef" * 10)] == [True, True, False]


def test_a_node_that_is_only_on_a_link_is_what_it_says_of_itself() -> None:
    directory = Shown()
    heard = {"verdict": "unsigned", "from": "plain"}
    directory.note(
        NODE, "came", place="can:bus", address=7, present=True, seen=1795341600.0, tapped=0.0, says="factory",
        heard=heard, looked=1795341601.0, firmware={"version": "1.2"}, power={"battery": 80}, busy="it is looked at",
    )  # fmt: skip
    node = directory.node(NODE)
    assert node == {
        "uuid": NODE, "name": None, "profile": None, "link": "can:bus", "via": "can", "address": 7, "present": True,
        "last_seen": "2026-11-22T10:00:00Z", "tapped": None, "state": "factory", "mode": "idle", "whitelisted": False,
        "virtual": False, "wrapped": None, "unverified": True, "fingerprint": None, "epoch": 0, "sequence": 0,
        "due": None, "verdict": heard, "heard": None, "verified": "2026-11-22T10:00:01Z", "retired": None,
        "problem": None, "busy": "it is looked at", "group": None, "groups": (), "measurement": None,
        "measuring": None, "power": {"battery": 80}, "firmware": {"version": "1.2"},
        "channels": [{**CHANNEL, "topic": None, "last": None, "actuator": None}],
    }  # fmt: skip


def test_what_the_store_has_goes_before_what_a_node_says() -> None:
    directory = Shown()
    directory._rows[NODE] = KnownNode(
        NODE, name="hand", profile="gripper", state="provisioned", whitelisted=True, last_seen="2026-11-01T00:00:00Z",
        firmware={"version": "2.0"}, wrapped={"maker": "x"},
    )  # fmt: skip
    directory.judge("session", "authentic")
    node = directory.node(NODE)
    assert (node["present"], node["mode"], node["link"], node["via"]) == (False, None, None, None)
    assert (node["last_seen"], node["verified"], node["busy"]) == ("2026-11-01T00:00:00Z", None, None)
    heard = {"verdict": "not authentic", "from": "plain"}
    directory.note(NODE, says="factory", heard=heard, seen=1795341600.0, firmware={"version": "9"}, measurement="m1")
    node = directory.node(NODE)
    assert (node["name"], node["state"], node["mode"]) == ("hand", "provisioned", "measuring")
    assert (node["firmware"], node["wrapped"]) == ({"version": "2.0"}, {"maker": "x"})
    assert (node["last_seen"], node["unverified"]) == ("2026-11-22T10:00:00Z", False)
    assert node["verdict"] == {"verdict": "authentic", "from": "session"}
    assert node["heard"] == heard, "what it sent outside a session stands beside its reading"
    directory._origins[NODE] = {"maker": "of its datasheet"}
    assert directory.node(NODE)["wrapped"] == {"maker": "of its datasheet"}


@pytest.mark.parametrize(
    ("origin", "stored", "heard", "verdict", "beside"),
    [
        (None, None, None, None, None),
        (None, None, "not authentic", "not authentic", None),
        ("plain", "unsigned", None, "unsigned", None),
        ("plain", "unsigned", "not authentic", "not authentic", None),
        ("kept", "authentic", "unsigned", "authentic", "unsigned"),
        ("session", "authentic", None, "authentic", None),
    ],
)
def test_a_verdict_of_a_session_is_replaced_by_nothing_that_came_without_one(
    origin: str | None, stored: str | None, heard: str | None, verdict: str | None, beside: str | None
) -> None:
    directory = Shown()
    if origin is not None and stored is not None:
        directory.judge(origin, stored)
    directory.note(NODE, heard=heard and {"verdict": heard})
    node = directory.node(NODE)
    assert (node["verdict"] and node["verdict"]["verdict"], node["heard"] and node["heard"]["verdict"]) == (
        verdict, beside,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("stored", "judged", "channels", "published", "shown"),
    [
        ("hand", "authentic", True, ("hand", False), "hand"),
        (None, "authentic", True, ("", False), None),
        ("hand", "unsigned", True, ("own name", True), "hand"),
        (None, "unsigned", True, ("own name", True), "own name"),
        (None, "unsigned", False, ("", False), None),
        (None, None, True, ("", False), None),
    ],
)
def test_an_unsigned_name_is_published_as_unverified_and_replaces_no_name_of_the_station(
    stored: str | None, judged: str | None, channels: bool, published: tuple[str, bool], shown: str | None
) -> None:
    directory = Shown()
    directory._rows[NODE] = KnownNode(NODE, name=stored)
    directory._own_names[NODE] = "own name"
    directory.sheet = [CHANNEL] if channels else []
    if judged is not None:
        directory.judge("session", judged)
    assert directory.published_name(NODE) == published
    node = directory.node(NODE)
    assert (node["name"], node["unverified"]) == (shown, published[1])


def test_a_channel_has_its_topic_its_last_value_with_its_age_and_its_set_point(monkeypatch: pytest.MonkeyPatch) -> None:
    directory = Shown()
    directory.topic = lambda _uuid, number: f"/bench/hand/{number}"
    directory.actuator = lambda _uuid, number: {"value": 0.5, "safe": False} if number == 2 else None
    names = ("angle", "opening", "force", "mass")
    directory.sheet = [
        {"number": number, "name": name, "problem": "no calibration" if number == 3 else None}
        for number, name in enumerate(names, 1)
    ]
    monkeypatch.setattr("teds_provision.ncap.nodes.directory.time", SimpleNamespace(time=lambda: 1000.0))
    directory.values = {
        1: SimpleNamespace(value=2.5, raw=7, time=999.9876),
        2: SimpleNamespace(value=None, raw=8, time=1000.5),
        3: SimpleNamespace(value=math.inf, raw=9, time=990.0),
    }
    last = [directory.channel(NODE, number)["last"] for number in (1, 2, 3, 4)]
    assert last == [
        {"value": 2.5, "raw": 7, "valid": True, "time": 999.9876, "age": 0.012},
        {"value": None, "raw": 8, "valid": False, "time": 1000.5, "age": 0.0},
        {"value": None, "raw": 9, "valid": False, "time": 990.0, "age": 10.0},
        None,
    ]
    assert [directory.channel(NODE, number)["actuator"] for number in (1, 2)] == [None, {"value": 0.5, "safe": False}]
    assert directory.channel(NODE, 4)["topic"] == "/bench/hand/4"
    assert directory.raw_only(NODE) == [3]
    with pytest.raises(NotFoundError, match=f"Node {NODE} has no channel 5"):
        directory.channel(NODE, 5)


def test_a_live_channel_has_raw_numbers_apart_a_sign_of_life_and_for_readers_no_folder(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("teds_provision.ncap.live.BEAT", 0.001)
    monkeypatch.setattr("teds_provision.ncap.live._TOLD", 0.002)
    changed = [{"ab/1": [[1.0], [2.0]], "cd/2": [[1.0], [7.0]]}]
    monkeypatch.setattr(Live, "_gather", lambda _live, _seconds: changed.pop() if changed else {})

    async def messages(client: LiveClient) -> dict[str, Any]:
        """Return one message of each type."""
        found: dict[str, Any] = {}
        while not {"values", "beat", "event"} <= found.keys():
            for text in await asyncio.wait_for(client.wait(), PATIENCE):
                message = json.loads(text)
                found.setdefault(message["type"], message)
        return found

    async def run() -> list[dict[str, Any]]:
        live = Live()
        live._raw = frozenset({("cd", 2)})
        own, reader = live.join(), live.join(reader=True)
        assert live.listeners == 2
        fan = asyncio.create_task(live.run())
        try:
            await asyncio.sleep(0)  # it has its loop
            live.event("sink", state="failed", name="/home/ann/run.csv")
            found = [await messages(client) for client in (own, reader)]
            changed.append({"ab/1": [[3.0], [4.0]]})
            texts: list[str] = []
            while not any('"values"' in text for text in texts):
                texts = await asyncio.wait_for(own.wait(), PATIENCE)
            assert not any('"raw"' in text for text in texts), "it is missing if there is none"
        finally:
            fan.cancel()
        live.remove_client(own)
        assert live.listeners == 1
        return found

    for found, name in zip(asyncio.run(run()), ("/home/ann/run.csv", "run.csv"), strict=True):
        assert (found["values"]["channels"], found["values"]["raw"]) == (
            {"ab/1": [[1.0], [2.0]]}, {"cd/2": [[1.0], [7.0]]},
        )  # fmt: skip
        assert (found["event"]["event"], found["event"]["state"], found["event"]["name"]) == ("sink", "failed", name)


def test_a_datasheet_is_decoded_once_for_each_that_is_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that was read just now goes before what is stored, until that is followed."""
    images: list[bytes] = []
    stored: list[Any] = [None, None]  # its digest, and the datasheet itself

    def datasheet(uuid: bytes) -> Any:
        images.append(uuid)
        return stored[1]

    nothing: Any = None
    directory = NodeDirectory(nothing, nothing)
    monkeypatch.setattr(directory, "_station", SimpleNamespace(datasheets=SimpleNamespace(datasheet=datasheet)))
    monkeypatch.setattr(directory, "_stored", lambda _uuid: SimpleNamespace(teds_sha256=stored[0]))

    def sheet_of(image: str) -> Any:
        def shown_in(shown: Any) -> Any:
            return SimpleNamespace(channels=[f"{image} in {shown[1]}"], meta=SimpleNamespace(name=f"own {image}"))

        return SimpleNamespace(shown_in=shown_in)

    monkeypatch.setattr(of_nodes, "Sheet", SimpleNamespace(from_image=sheet_of))
    monkeypatch.setattr(
        of_nodes, "shown_units", lambda _station, uuid: {1: "mm"} if uuid == bytes.fromhex(NODE) else {}
    )
    monkeypatch.setattr(of_nodes, "channel_facts", lambda channel: {"is": channel})
    monkeypatch.setattr(of_nodes, "_origin", lambda sheet: sheet and {"of": sheet.meta.name})
    for digest, image, shown, name in (
        (None, None, [], ""),
        ("d1", "x", ["x in mm"], "own x"),
        ("d2", "y", ["y in mm"], "own y"),
    ):
        stored[:] = digest, image
        before, changes = len(images), directory.changes
        for _ in range(2):
            assert NodeDirectory._sheet(directory, NODE) == [{"is": channel} for channel in shown]
        assert (len(images) - before, directory.changes - changes) == (1, 1)
        assert (directory._own_names[NODE], directory._origins[NODE]) == (name, {"of": name} if name else None)
        assert directory._shown_in[NODE] == {1: "mm"}
    directory._channels[NODE] = "read now", [{"is": "read"}]
    assert directory._sheet(NODE) == [{"is": "read"}]
    assert images == [bytes.fromhex(NODE)] * 3


def test_the_event_of_a_node_has_its_problem_its_place_its_work_and_its_verdict_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    events: list[tuple[str, dict[str, Any]]] = []
    nothing: Any = None
    live: Any = SimpleNamespace(event=lambda kind, **facts: events.append((kind, facts)))
    directory = NodeDirectory(nothing, live)
    directory.note(
        NODE, "came", place="can:x", present=True, seen=5.0, busy="it is looked at", problem=None, verdict="authentic"
    )
    directory.note(NODE, problem={"code": "link"})
    directory.note(NODE, "verified", looked=1.0)
    shown = {"place": "can:x", "busy": "it is looked at", "problem": None, "verdict": "authentic"}
    assert events == [
        ("node", {"uuid": NODE, "state": "came", **shown}),
        ("node", {"uuid": NODE, "state": "verified"}),
    ]
    seen = directory.seen(NODE)
    assert (seen.version, seen.problem, seen.looked, hasattr(seen, "verdict")) == (3, {"code": "link"}, 1.0, False)
    monkeypatch.setattr(of_nodes, "MOST_GONE", 1)
    kept, first, last = "01" * 10, "02" * 10, "03" * 10
    directory._rows[kept] = KnownNode(kept)
    for uuid in (kept, first, last):
        directory.note(uuid, "came", present=True)
    for uuid in (kept, first, last):
        directory.note(uuid, present=False)
    directory.note(last, "left")
    assert sorted(directory._seen) == [kept, last, NODE], "one of the store and one that is there stay"
