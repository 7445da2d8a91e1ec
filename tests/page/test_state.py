"""What the page knows: messages in their order, answers that come late, a connection that ends and comes back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from .stage import ARM, HAND, NOW

if TYPE_CHECKING:
    from .stage import Stage

pytestmark = pytest.mark.system
NONE = None
HELD = "held"
ALL = ["status", "nodes", "groups", "measurements", "virtual", "profiles", "updates"]


def asked(stage: Stage) -> list[str]:
    """Return the paths that the page asked for since the last time."""
    return [entry["path"] for entry in stage.sent]


def take(stage: Stage, *messages: dict[str, Any]) -> list[str]:
    """Give the page messages of the station, one after the other, and return what it asks then."""
    stage.run("words.forEach((one) => hub.take(one))", *messages)
    stage.pass_time(100)
    return asked(stage)


def event(name: str, **more: Any) -> dict[str, Any]:
    return {"type": "event", "event": name, **more}


def values(**more: Any) -> dict[str, Any]:
    return {"type": "values", "channels": {}} | more


@pytest.mark.parametrize(
    ("message", "lists"),
    [
        ({"type": "hello"}, ALL),
        ({"type": "resync"}, ALL),
        (event("store"), ALL),
        ({"type": "beat"}, []),
        (event("log"), []),
        (event("unheard of"), []),
        (event("measurement"), ["measurements", "nodes", "status"]),
        (event("group"), ["groups", "nodes"]),
        (event("virtual"), ["virtual", "nodes"]),
        (event("names"), ["names"]),
        (event("detection"), ["status", "nodes"]),
        (event("sink"), ["status", "measurements"]),
        (event("link"), ["status", "nodes"]),
        (event("vault"), ["status", "nodes", "measurements"]),
        (event("node", uuid=ARM, state="came"), [f"nodes/{ARM}"]),
        *((event("node", uuid=ARM, state=state), ["status", f"nodes/{ARM}"])
          for state in ("running", "lost", "refused", "waiting", "ended", "idle")),
        (event("provision", uuid=ARM, state="running"), []),
        (event("provision", uuid=ARM, state="done"), [f"nodes/{ARM}"]),
        (event("update", id="u", state="running"), ["updates"]),
        (event("update", id="u", state="running", uuid=ARM, board={"result": "updated"}), ["updates", f"nodes/{ARM}"]),
    ],
)  # fmt: skip
def test_each_message_makes_the_page_ask_for_what_it_changes(
    stage: Stage, message: dict[str, Any], lists: list[str]
) -> None:
    assert take(stage, message) == lists


def test_views_are_called_once_for_many_changes_and_no_more_after_their_end(stage: Stage) -> None:
    script = """
      window.heard = [];
      window.off = hub.on("alpha beta", () => window.heard.push("both"));
      window.ends.push({ end: window.off }, { end: hub.on("beta", () => window.heard.push("beta")) });
      hub.changed("alpha"), hub.changed("beta", "alpha"), hub.changed("gamma");
    """
    stage.run(script)
    assert stage.run("return window.heard") == []
    stage.pass_time(20)
    assert stage.run("return window.heard") == ["both", "beta"]
    stage.run("window.off(); hub.changed('alpha', 'beta')")
    stage.pass_time(20)
    assert stage.run("return window.heard") == ["both", "beta", "beta"]
    stage.run("window.ends.push({ end: hub.on('provision', () => window.heard.push('provision')) })")
    take(stage, event("provision", uuid=ARM, state="running"))
    assert stage.run("return window.heard.at(-1)") == "provision"


def test_values_are_kept_with_their_time_and_a_gap_where_none_was_valid(stage: Stage) -> None:
    key = f"{ARM}/2"
    look = f"""
      const ring = state.rings.get("{key}");
      const held = (list) => [...list].slice(0, ring.held);
      return [held(ring.time), held(ring.value), state.values.get("{key}"), state.received];
    """
    take(stage, values(channels={key: [[10, 11], [1.5, 2]]}))
    assert stage.run(look) == [
        [10, 11], [1.5, 2], {"value": 2, "time": 11, "period": 0, "valid": True, "isRaw": False}, 2,
    ]  # fmt: skip
    take(stage, values(channels={key: [[12, 14], [3, NONE]]}), values(channels={key: [[], []]}))
    times, points, last, received = stage.run(look)
    assert (times, points[:3], points[3] != points[3], received) == ([10, 11, 12, 14], [1.5, 2, 3], True, 4)
    assert last == {"value": NONE, "time": 14, "period": 1.5, "valid": False, "isRaw": False}
    take(stage, values(raw={key: [[15], [2048]]}))  # it lost its calibration: these numbers mean something else
    times, points, last, _ = stage.run(look)
    assert (times, points) == ([15], [2048])
    assert (last["value"], last["raw"], last["valid"], last["isRaw"]) == (NONE, 2048, False, True)
    take(stage, values(raw={key: [[16], [2049]]}))
    assert stage.run(look)[1] == [2048, 2049]
    take(stage, values(channels={key: [[17], [4]]}))
    assert stage.run(look)[1] == [4]
    take(stage, {"type": "dropped", "messages": 3}, {"type": "dropped", "messages": 2})
    assert stage.run("return state.dropped") == 5


def test_points_of_the_400_newest_channels_are_kept(stage: Stage) -> None:
    script = """
      for (let number = 0; number < 401; number++) hub.ringOf("a", number);
      const same = hub.ringOf("a", 400) === hub.ringOf("a", 400);
      return [state.rings.size, state.rings.has("a/0"), state.rings.has("a/1"), same];
    """
    assert stage.run(script) == [400, False, True, True]


def test_a_value_is_stale_when_it_is_old_or_the_connection_is_lost(stage: Stage) -> None:
    now = stage.run("return hub.now()")
    cases = [
        (NONE, True), ({"time": now - 1.9}, False), ({"time": now - 2.1}, True),
        ({"time": now - 14, "period": 5}, False), ({"time": now - 16, "period": 5}, True),
    ]  # fmt: skip
    stage.table("hub.isStale(one)", cases)
    stage.run("state.connection = 'lost'")
    stage.table("hub.isStale(one)", [({"time": now}, True)])


def test_the_last_value_is_the_later_one_of_stream_and_description_in_the_shown_unit(stage: Stage) -> None:
    script = """
      const [arm, told] = words;
      const scale = { factor: 1000, offset: 0 };
      state.nodes.set(arm, { channels: [{ number: 1, scale }] });
      state.values.set(`${arm}/1`, { value: 0.05, time: 100 });
      state.values.set(`${arm}/2`, { value: 7, time: 100 });
      const values = told.map((last) => hub.lastOf(arm, { number: 1, last }).value);
      return [values, hub.lastOf(arm, { number: 9 }), hub.streamedOf(arm, 2).value];
    """
    told = [NONE, {"value": 1, "time": 99}, {"value": 1, "time": 100}, {"value": 1, "time": 101}]
    assert stage.run(script, ARM, told) == [[50, 50, 50, 1], NONE, 7]


def test_a_node_is_frozen_by_its_measurement_unless_that_failed(stage: Stage) -> None:
    script = """
      const [arm, measurements] = words;
      state.groups = [{ name: "crane", uuids: [arm] }];
      return measurements.map((one) => { state.measurements = [one]; return hub.frozenBy(arm); });
    """
    cases = [
        ({"state": "running", "uuids": [ARM]}, "This node is being measured. Stop the measurement first."),
        ({"state": "waiting", "uuids": [HAND, ARM]}, "This node is being measured. Stop the measurement first."),
        ({"state": "running", "group": "crane"},
         "This node is being measured in group crane. Stop the measurement first."),
        ({"state": "running", "group": "crane", "owner": "command", "process": {"id": 7}},
         "This node is being measured in group crane by the command measure (process 7). Stop the measurement first."),
        ({"state": "failed", "uuids": [ARM]}, ""),
        ({"state": "ended", "uuids": [ARM]}, ""),
        ({"state": "running", "uuids": [HAND]}, ""),
        ({"state": "running", "group": "other"}, ""),
        ({"state": "running", "group": "crane", "uuids": [HAND]}, ""),
    ]  # fmt: skip
    assert stage.run(script, ARM, [one for one, _ in cases]) == [words for _, words in cases]


def test_a_second_request_during_one_is_made_after_it_and_an_older_answer_replaces_nothing(stage: Stage) -> None:
    stage.answers(**{"GET groups": HELD})
    stage.run("window.done = []; for (const name of 'abc') hub.refresh('groups').then(() => window.done.push(name))")
    assert asked(stage) == ["groups"]
    stage.answers(**{"GET groups": {"groups": [{"name": "later"}]}})
    stage.run("window.held.shift()({ groups: [{ name: 'earlier' }] })")
    stage.pass_time(10)
    assert asked(stage) == ["groups"], "two came meanwhile: one more"
    assert stage.run("return state.groups.map((one) => one.name)") == ["later"]
    # The measurements that came with a status that was asked earlier
    stage.answers(**{"GET status": HELD, "GET measurements": {"measurements": [{"id": "new"}]}})
    stage.run("hub.refresh('status'); await hub.refresh('measurements')")
    stage.run("window.held.shift()({ measurements: [{ id: 'old' }], time: words[0] })", NOW + 1000)
    stage.pass_time(10)
    assert stage.run("return state.measurements.map((one) => one.id)") == ["new"]
    assert stage.run("return Math.round(hub.now())") == NOW + 1000, "the station's clock"


def test_an_older_list_of_nodes_brings_back_no_node_and_no_state(stage: Stage) -> None:
    stage.answers(**{"GET nodes": HELD, f"GET nodes/{ARM}": {"uuid": ARM, "name": "new"}})
    stage.answers(**{f"GET nodes/{HAND}": {"refused": 404}})
    stage.run("state.nodes.set(words[0], { uuid: words[0], name: 'hand' }); hub.refresh('nodes')", HAND)
    take(stage, event("node", uuid=ARM, state="came"), event("node", uuid=HAND, state="left"))
    look = "return [[...state.nodes.values()].map((one) => one.name), state.total]"
    assert stage.run(look) == [["new"], 0]
    late = [{"uuid": ARM, "name": "old"}, {"uuid": HAND, "name": "hand"}, {"uuid": "cc", "name": "third"}]
    stage.run("window.held.shift()({ nodes: words[0], total: 3 })", late)
    stage.pass_time(10)
    assert stage.run(look) == [["new", "third"], 3]
    stage.answers(**{"GET nodes": {"nodes": late}})
    stage.run("await hub.refresh('nodes')")
    assert stage.run(look) == [["old", "hand", "third"], 0], "this one was asked later"
    stage.answers(**{f"GET nodes/{ARM}": HELD})
    take(stage, event("node", uuid=ARM, state="came"))
    stage.answers(**{f"GET nodes/{ARM}": {"uuid": ARM, "name": "newest"}})
    take(stage, event("node", uuid=ARM, state="came"))
    stage.run("window.held.shift()({ uuid: words[0], name: 'before' })", ARM)
    stage.pass_time(10)
    assert stage.run(look)[0] == ["newest", "hand", "third"]
    stage.answers(**{f"GET nodes/{ARM}": {"refused": 503}})
    take(stage, event("node", uuid=ARM, state="came"))
    assert stage.run(look)[0] == ["newest", "hand", "third"], "a node that cannot be asked is not gone"


def test_a_burst_of_events_asks_for_each_node_once_and_for_all_of_many(stage: Stage) -> None:
    assert take(stage, *(event("node", uuid=uuid, state="came") for uuid in "aabcde")) == [
        f"nodes/{uuid}" for uuid in "abcde"
    ]
    assert take(stage, *(event("node", uuid=uuid, state="came") for uuid in "abcdef")) == ["nodes"]


def test_a_tap_is_noted_and_told(stage: Stage) -> None:
    stage.run("window.taps = 0; window.ends.push({ end: hub.on('tap', () => (window.taps += 1)) })")
    take(stage, event("node", uuid=ARM, state="came"))
    assert stage.run("return [state.tapped, window.taps]") == [NONE, 0]
    take(stage, event("node", uuid=ARM, state="tapped"))
    assert stage.run("return [state.tapped.uuid, window.taps]") == [ARM, 1]


def test_steps_of_a_provisioning_are_one_list_and_the_next_node_gets_its_name(stage: Stage) -> None:
    look = """
      const { state: word, steps, until } = state.runs.get(words[0]);
      return [word, steps.map((one) => [one.name, one.result, one.detail ?? ""]), until ?? 0];
    """
    stage.run("state.runs.set('next', { state: 'waiting', until: 9, steps: [] })")
    take(stage, event("provision", uuid=ARM, state="running", step="identify"))
    assert stage.run("return [...state.runs.keys()]") == [ARM]
    assert stage.run(look, ARM) == ["running", [["identify", "running", ""]], 9]
    take(
        stage,
        event("provision", uuid=ARM, state="running", step="identify", result="done", detail="seen"),
        event("provision", uuid=ARM, state="running", step="agree"),
        event("provision", uuid=ARM, state="done"),
    )
    assert stage.run(look, ARM) == ["done", [["identify", "done", "seen"], ["agree", "running", ""]], 9]
    take(stage, event("provision", uuid=ARM, state="waiting"))
    assert stage.run(look, ARM)[:2] == ["waiting", []], "another run"
    stage.run("state.runs.set('next', { state: 'done', steps: [] })")
    take(stage, event("provision", uuid=HAND, state="running", step="identify"))
    assert stage.run("return state.runs.has('next')"), "it did not wait"


def test_a_board_of_an_update_is_replaced_and_another_state_fetches_it(stage: Stage) -> None:
    update = {"id": "u", "state": "running", "boards": [{"uuid": ARM, "step": "upload"}, {"uuid": HAND, "step": ""}]}
    stage.run("state.updates = [words[0]]", update)
    board = {"uuid": ARM, "step": "restart"}
    assert take(stage, event("update", id="u", state="running", uuid=ARM, board=board)) == []
    assert stage.run("return state.updates[0].boards.map((one) => one.step)") == ["restart", ""]
    assert take(stage, event("update", id="u", state="done")) == ["updates"]
    stage.run("state.updates = [words[0]]", update)
    assert take(stage, event("update", id="v", state="running")) == ["updates"]


def test_a_set_point_from_elsewhere_is_shown_in_the_channels_unit(stage: Stage) -> None:
    scale = {"unit": "mm", "factor": 1000, "offset": 0, "si": "m"}
    stage.run(
        "state.nodes.set(words[0], { channels: [{ number: 1, scale: words[1] }, { number: 2, scale: words[1] }] })",
        ARM, scale,
    )  # fmt: skip
    take(stage, event("actuator", uuid=ARM, channel=2, value=0.04, unit="m", safe=False))
    take(stage, event("actuator", uuid=HAND, channel=2, value=0.04, unit="m", safe=False))
    assert stage.run("return state.nodes.get(words[0]).channels.map((one) => one.actuator ?? null)", ARM) == [
        NONE, {"value": 40, "safe": False},
    ]  # fmt: skip


@pytest.mark.parametrize(("unit", "problem", "kept"), [("m", NONE, 1), ("K", NONE, 0), ("m", "no calibration", 0)])
def test_points_of_another_quantity_are_forgotten(stage: Stage, unit: str, problem: str | None, kept: int) -> None:
    node = {"uuid": ARM, "channels": [{"number": 1, "unit": "m"}]}
    stage.run("state.nodes.set(words[0].uuid, shapes.node(words[0])); hub.ringOf(words[0].uuid, 1).push(5, 5)", node)
    stage.answers(**{f"GET nodes/{ARM}": {"uuid": ARM, "channels": [{"number": 1, "unit": unit, "problem": problem}]}})
    take(stage, event("node", uuid=ARM, state="verified"))
    assert stage.run("return hub.ringOf(words[0], 1).held", ARM) == kept
    # The same if the whole list comes.
    stage.run("state.nodes.set(words[0].uuid, shapes.node(words[0])); hub.ringOf(words[0].uuid, 1).push(6, 6)", node)
    channel = {"number": 1, "unit": unit, "problem": problem}
    stage.answers(**{"GET nodes": {"nodes": [{"uuid": ARM, "channels": [channel]}]}})
    stage.run("await hub.refresh('nodes')")
    assert stage.run("return hub.ringOf(words[0], 1).held", ARM) == (kept and 2)


def test_a_refused_list_is_told_but_not_a_lost_or_signed_out_station(stage: Stage) -> None:
    look = "return [...document.querySelectorAll('.toast')].map((one) => one.innerText)"
    for answer in ("cut", {"refused": 401, "message": "no"}):
        stage.answers(**{"GET groups": answer})
        stage.run("await hub.refresh('groups')")
        assert stage.run(look) == []
    stage.answers(**{"GET groups": {"refused": 503, "message": "Busy.", "hint": "Later."}})
    stage.run("await hub.refresh('groups')")
    assert stage.run(look) == ["Busy.\n\nLater."]


def connect(stage: Stage) -> None:
    """Open a connection of its own; ``window.seen`` has the states and events that it reports."""
    stage.run(
        """
        window.seen = [];
        const told = { state: (...words) => window.seen.push(words[0]), event: (one) => window.seen.push(one.event) };
        window.line = new live.Live(told);
        window.ends.push({ end: () => (window.line.look = window.line.again = () => {}) });
        """
    )


def seen(stage: Stage) -> Any:
    return stage.run("return window.seen.splice(0)")


def sockets(stage: Stage) -> Any:
    return stage.run("return window.sockets.length")


def test_a_silent_connection_is_lost_and_tried_again_ever_later(stage: Stage) -> None:
    connect(stage)
    stage.pass_time(1400)
    assert seen(stage) == []
    stage.run("window.sockets[0].tell({ event: 'beat' })")
    stage.pass_time(1400)
    assert seen(stage) == ["live", "beat"]
    stage.pass_time(200)
    assert (seen(stage), stage.run("return window.sockets[0].readyState")) == (["lost"], 3)
    stage.run("window.sockets[0].tell({ event: 'late' })")
    assert seen(stage) == [], "what an old connection still says counts no more"
    for number, wait in enumerate((300, 600, 1000, 2000, 3000, 3000), 1):
        stage.pass_time(wait - 20)
        assert sockets(stage) == number, wait
        stage.pass_time(40)
        assert sockets(stage) == number + 1, wait
        stage.run("window.sockets.at(-1).end(1006)")
        assert seen(stage) == ["lost"]
    assert set(asked(stage)) == {"status"}, "it looks whether it is still signed in"
    stage.pass_time(3020)
    stage.run("window.sockets.at(-1).tell({ event: 'hello' }); window.sockets.at(-1).end(1006)")
    assert seen(stage) == ["live", "hello", "lost"]
    stage.pass_time(320)
    assert sockets(stage) == 9, "soon again after one that worked"


@pytest.mark.parametrize("status", [401, 429])
def test_who_is_no_longer_signed_in_is_told_and_asks_no_more(stage: Stage, status: int) -> None:
    stage.answers(**{"GET status": {"refused": status}})
    connect(stage)
    stage.run("window.sockets[0].end(1006)")
    stage.pass_time(320)
    assert (seen(stage), sockets(stage)) == (["lost", "signed out"], 1)
    stage.pass_time(5000)
    assert (seen(stage), sockets(stage)) == ([], 1)


def test_a_token_that_is_removed_ends_the_connection_at_once_and_other_errors_do_not(stage: Stage) -> None:
    connect(stage)
    stage.run("window.sockets[0].end(1008)")
    stage.pass_time(5000)
    assert (seen(stage), sockets(stage), asked(stage)) == (["signed out"], 1, [])
    stage.answers(**{"GET status": {"refused": 503}})
    connect(stage)
    stage.run("window.sockets[1].end(1006)")
    stage.pass_time(320)
    assert (seen(stage), sockets(stage)) == (["lost"], 3)


def test_several_changes_of_one_frame_are_announced_once_to_each_listener(stage: Stage) -> None:
    script = """
      let [both, one, ended] = [0, 0, 0];
      const ends = [hub.on("status nodes", () => (both += 1)), hub.on("nodes", () => (one += 1))];
      hub.on("status nodes", () => (ended += 1))();
      window.count = () => [both, one, ended];
      window.ends.push({ end: () => ends.forEach((end) => end()) });
      hub.changed("status");
      hub.changed("status", "nodes");
      hub.changed("nodes");
      return window.count();
    """
    assert stage.run(script) == [0, 0, 0], "in the next frame"
    stage.pass_time(20)
    assert stage.run("return window.count()") == [1, 1, 0]
    stage.run("hub.changed('status')")
    stage.pass_time(20)
    assert stage.run("return window.count()") == [2, 1, 0]
