"""The live channel: what a page can draw, in order, and no client that costs the others anything."""

from __future__ import annotations

import asyncio
import json
import math
import socket
import time
from contextlib import ExitStack, suppress
from dataclasses import replace
from itertools import count, pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.sync.client import connect

from teds_provision.measure.blocks import Block, ChannelFacts
from teds_provision.ncap.live import BEAT, POINTS, Live, LiveClient, thinned
from teds_provision.teds.units import parse_unit
from tests.ncap.service import Service, virtual
from tests.pace import PATIENCE, best_of, succeeds, until

numbers = st.one_of(st.floats(-1e6, 1e6), st.just(float("nan")))


@given(st.lists(numbers, max_size=300), st.integers(0, 40))
def test_thinning_keeps_measured_points_in_order_and_the_extremes(values: list[float], most: int) -> None:
    times, given_values = np.arange(len(values), dtype=float), np.array(values, dtype=float)
    kept_times, kept = thinned(times, given_values, most)
    assert len(kept_times) == len(kept) <= max(most, 0)
    assert list(kept_times) == sorted(set(kept_times))
    for moment, value in zip(kept_times, kept, strict=True):
        assert value == given_values[int(moment)] or np.isnan(value)
    finite = given_values[~np.isnan(given_values)]
    if most >= 2 and len(finite):
        assert np.nanmax(kept) == finite.max()
        assert np.nanmin(kept) == finite.min()


@given(st.lists(st.floats(0, 3) | st.just(float("nan")), max_size=300), st.integers(0, 40), st.floats(0, 6.28))
def test_no_line_crosses_the_wrap_of_a_full_turn(steps: list[float], most: int, before: float) -> None:
    times = np.arange(len(steps), dtype=float)
    angles = np.mod(np.cumsum(np.nan_to_num(np.array(steps))), 2 * np.pi)
    angles[np.isnan(np.array(steps))] = np.nan
    kept_times, kept = thinned(times, angles, most, before=before)
    assert len(kept_times) == len(kept) <= max(most, 0)
    assert list(kept_times) == sorted(kept_times)
    with_before = [before, *kept]
    assert all(np.isnan([item, other]).any() or abs(item - other) <= np.pi for item, other in pairwise(with_before))
    if most >= 4 and len(steps):
        assert len(kept)
    for moment, value in zip(kept_times, kept, strict=True):
        assert np.isnan(value) or value == angles[int(moment)]


def test_what_is_known_of_a_channel_decides_whether_its_line_wraps() -> None:
    angle = ChannelFacts("ab" * 10, "", 1, "angle", units=parse_unit("rad").units, low=0.0, high=2 * math.pi)
    live = Live()
    live.join()
    live.learn([angle])

    def given_out() -> list[float | None]:
        live._put_aside([])
        return live._gather(1.0)[f"{angle.uuid}/1"][1]

    values = np.array([[6.0], [6.2], [0.1], [0.3]])
    live.block(replace(block(0, 4, 0.01), value=values, raw=values))
    assert given_out() == [6.0, 6.2, None, 0.1, 0.3]
    live.block(replace(block(4, 4, 0.01), value=values, raw=values))
    assert given_out()[:2] == [None, 6.0], "the one before was 0.3"
    live.learn([replace(angle, high=6.0)])
    live.block(replace(block(8, 4, 0.01), value=values, raw=values))
    assert given_out() == [6.0, 6.2, 0.1, 0.3]


def test_a_channel_has_raw_numbers_only_as_long_as_it_has_no_calibration() -> None:
    angle, force = (ChannelFacts("ab" * 10, "", number, "") for number in (1, 2))
    live = Live()
    live.join()

    def given_out() -> list[list[float | None]]:
        two = replace(block(0, 1, 0.01, 2), value=np.array([[1.5, 2.5]]), raw=np.array([[7, 8]]))
        live.block(two)
        return [numbers for _, numbers in live._gather(1.0).values()]

    live.learn([angle, force], {angle.key, force.key})
    assert given_out() == [[7.0], [8.0]]
    live.learn([angle])
    assert given_out() == [[1.5], [8.0]], "calibrated meanwhile; of the other channel nothing is new"
    live.learn([angle], {force.key})
    assert given_out() == [[1.5], [8.0]]


def test_after_a_silence_no_more_points_come_at_once_than_in_a_fifth_of_a_second() -> None:
    live = Live()
    live.join()
    live.block(block(0, 1, 0.001))
    live._gather(0.05)
    assert live._gather(3600.0) == {}
    live.block(block(1, 200, 0.001))
    [(times, _)] = live._gather(0.05).values()
    assert 10 <= len(times) <= POINTS / 5


def test_a_test_pattern_and_a_block_without_samples_are_no_values() -> None:
    live = Live()
    live.join()
    live.block(replace(block(0, 4, 0.01), test_pattern=True))
    live.block(block(0, 0, 0.01))
    assert live._gather(1.0) == {}
    assert live.last("ab" * 10, 1) is None
    assert not live.history._waiting
    live.block(block(0, 4, 0.01))
    assert len(live._gather(1.0)["ab" * 10 + "/1"][0]) == 4
    assert live.last("ab" * 10, 1) is not None


def block(first: int, count: int, period: float, channels: int = 1) -> Block:
    rows = np.arange(first, first + count)
    values = np.repeat(np.sin(rows * 0.1)[:, None], channels, axis=1)
    return Block(
        uuid="ab" * 10, stream=0, channels=tuple(range(1, channels + 1)), index=first, time=1e9 + rows * period,
        tick=rows.astype(np.uint64), raw=values, value=values, valid=np.ones_like(values, dtype=bool),
    )  # fmt: skip


async def fed(live: Live, rate: float, seconds: float, channels: int = 1) -> None:
    """Blocks as a node at this rate would give them, 20 ms each."""
    began, given_rows = time.monotonic(), 0
    while (past := time.monotonic() - began) < seconds:
        due = int(past * rate) - given_rows
        if due > 0:
            live.block(block(given_rows, due, 1 / rate, channels))
            given_rows += due
        await asyncio.sleep(0.02)


async def heard(listener: LiveClient, feeding: asyncio.Task[None]) -> list[dict[str, Any]]:
    """Return what comes until nothing is fed any more, and the last of that has come."""
    found: list[dict[str, Any]] = []
    while not feeding.done():
        with suppress(TimeoutError):
            found += [json.loads(text) for text in await asyncio.wait_for(listener.wait(), 4 * BEAT)]
    await asyncio.sleep(4 * BEAT)
    found += [json.loads(text) for text in await listener.wait()]
    return found


@pytest.mark.parametrize(("rate", "least"), [(50.0, 50.0), (100.0, 95.0), (10_000.0, 60.0)])
def test_at_most_a_hundred_points_a_second_and_slow_channels_whole(rate: float, least: float) -> None:
    async def run() -> list[dict[str, Any]]:
        live = Live()
        listener, fan = live.join(), asyncio.create_task(live.run())
        found = await heard(listener, asyncio.create_task(fed(live, rate, 2.0)))
        fan.cancel()
        return found

    def too_few() -> float:
        """Points a second that are missing: a loop that stands still gives a burst, of which some are left out."""
        messages = asyncio.run(run())
        times = [
            t for message in messages if message["type"] == "values" for t in message["channels"]["ab" * 10 + "/1"][0]
        ]
        assert times == sorted(times)
        span = (times[-1] - times[0]) or 1.0
        assert len(times) / span <= POINTS * 1.15, len(times) / span
        assert any(message["type"] == "beat" for message in messages)
        return least - len(times) / span

    best_of(5, least * 0.1, too_few, because="two seconds in which the loop must run each 10 ms")


def test_a_client_that_does_not_read_costs_one_slot_and_is_told_what_it_missed() -> None:
    async def run() -> tuple[list[dict[str, Any]], list[dict[str, Any]], int]:
        live = Live()
        quick, slow, fan = live.join(), live.join(), asyncio.create_task(live.run())
        found = await heard(quick, asyncio.create_task(fed(live, 100.0, 1.0)))
        for number in range(5):
            live.event("node", uuid="x", state=str(number))
        await asyncio.sleep(0.1)  # they go through the loop, in their order
        late = [json.loads(text) for text in await slow.wait()]
        fan.cancel()
        return found, late, slow.dropped

    found, late, dropped = asyncio.run(run())
    sent = sum(entry["type"] == "values" for entry in found)
    assert dropped == sent - 1, "newest wins"
    assert [message["messages"] for message in late if message["type"] == "dropped"] == [dropped]
    assert sum(message["type"] == "values" for message in late) == 1
    assert [message["state"] for message in late if message["type"] == "event"] == list("01234"), (
        "events are never thinned"
    )


def test_a_client_that_leaves_too_many_events_is_told_to_ask_again() -> None:
    async def run() -> list[dict[str, Any]]:
        live = Live()
        listener, fan = live.join(), asyncio.create_task(live.run())
        await asyncio.sleep(0)
        for number in range(300):
            live.event("node", uuid="x", state=str(number))
        await asyncio.sleep(0.05)
        fan.cancel()
        return [json.loads(text) for text in await listener.wait()]

    messages = asyncio.run(run())
    assert messages[0] == {"type": "resync"}
    assert messages[-1]["state"] == "299"
    assert len(messages) < 60


def test_the_last_value_can_be_shown_for_every_raw_value() -> None:
    live = Live()
    for raw, expected in (
        (np.array([[2**70]], dtype=object), 2**70),
        (np.array([[np.nan]]), None),
        (np.array([[7]]), 7),
    ):
        measured = replace(block(0, 1, 0.01), raw=raw, value=np.array([[np.nan]]), valid=np.array([[False]]))
        live._put_aside([measured])
        last = live.last("ab" * 10, 1)
        assert last is not None
        assert (last.value, last.raw) == (None, expected)
        json.dumps([last.value, last.raw], allow_nan=False)


@pytest.mark.link
def test_fifty_clients_of_which_ten_never_read(service: Service) -> None:
    uuid = virtual(service)
    asked = service.client()
    asked.request("POST", "/measurements", {"uuids": [uuid], "rate": 100})
    until(lambda: asked.node(uuid)["channels"][1]["last"])
    token = service.token("many")
    with ExitStack() as stack:
        for _ in range(10):
            deaf = stack.enter_context(socket.create_connection(("127.0.0.1", service.port)))
            deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            deaf.sendall(
                b"GET /api/v1/live HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
                b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
                b"Authorization: Bearer %s\r\n\r\n" % (service.port, token.encode())
            )
        quick = [
            stack.enter_context(
                connect(
                    f"ws://127.0.0.1:{service.port}/api/v1/live",
                    additional_headers={"Authorization": f"Bearer {token}"},
                    compression=None,
                    open_timeout=PATIENCE,
                    proxy=None,
                )
            )
            for _ in range(40)
        ]
        until(lambda: asked.status()["clients"] == 50)

        def measured() -> Any:
            return asked.request("GET", "/measurements")["measurements"][0]["nodes"][0]

        def lost() -> int:
            """Samples that were lost while everybody got values: nobody costs the measurement anything."""
            before, counts = measured(), [0] * len(quick)
            end = time.monotonic() + PATIENCE
            began = time.monotonic()
            while min(counts) == 0 or time.monotonic() < began + 2.0:
                assert time.monotonic() < end, counts
                for number, client_connection in enumerate(quick):
                    with suppress(TimeoutError):
                        counts[number] += json.loads(client_connection.recv(0.001))["type"] == "values"
            after = measured()
            assert after["samples"] > before["samples"]
            return int(after["lost"] - before["lost"])

        succeeds(5, lost, because="a hundred samples a second beside fifty listeners")
    until(lambda: asked.status()["clients"] == 0)
    asked.request("DELETE", f"/measurements/{asked.request('GET', '/measurements')['measurements'][0]['id']}")


def test_what_a_client_missed_is_told_once() -> None:
    async def run() -> list[list[dict[str, Any]]]:
        client, found = LiveClient(), []
        for several in (3, 1, 2):
            for number in range(several):
                client.values(json.dumps({"type": "values", "number": number}))
            found.append([json.loads(text) for text in await client.wait()])
        assert client.dropped == 3, "in all"
        return found

    first, second, third = asyncio.run(run())
    assert first == [{"type": "dropped", "messages": 2}, {"type": "values", "number": 2}]
    assert second == [{"type": "values", "number": 0}]
    assert third == [{"type": "dropped", "messages": 1}, {"type": "values", "number": 1}]


def test_a_block_that_cannot_be_shown_ends_the_live_channel_of_no_client(monkeypatch: pytest.MonkeyPatch) -> None:
    """The task that serves all clients ended with it, and no page changed any more until the next start."""
    monkeypatch.setattr("teds_provision.ncap.live.BEAT", 0.001)
    gather, tries = Live._gather, list[float]()

    def fails_once(live: Live, seconds: float) -> dict[str, list[list[float | None]]]:
        tries.append(seconds)
        if len(tries) == 1:
            raise OverflowError("int too large to convert to float")
        return gather(live, seconds) or {"ab/1": [[1.0], [2.0]]}

    monkeypatch.setattr(Live, "_gather", fails_once)

    async def first_values() -> str:
        live = Live()
        client = live.join()
        fan = asyncio.create_task(live.run())
        try:
            return (await asyncio.wait_for(client.wait(), PATIENCE))[-1]
        finally:
            fan.cancel()

    assert json.loads(asyncio.run(first_values()))["channels"] == {"ab/1": [[1.0], [2.0]]}


def test_of_blocks_that_nobody_fetches_the_latest_512_are_kept_and_the_others_counted() -> None:
    live = Live()
    live.join()
    for index in range(515):
        live.block(replace(block(index, 1, 0.01), value=np.array([[float(index)]])))
    assert live.overrun == 3
    assert [waiting.index for waiting in live._waiting] == list(range(3, 515))
    live._gather(0.05)
    last = live.last("ab" * 10, 1)
    assert last is not None
    assert (last.value, last.time) == (514.0, 1e9 + 5.14)


def test_the_last_value_is_the_newest_of_each_channel_and_none_if_that_is_not_valid() -> None:
    live, valid = Live(), np.array([[True, True], [True, False]])
    live._put_aside([replace(block(0, 2, 0.5, 2), value=np.array([[1.0, 2.0], [3.0, 4.0]]), valid=valid)])
    found = [live.last("ab" * 10, number) for number in (1, 2, 3)]
    assert [one and (one.value, one.time) for one in found] == [(3.0, 1e9 + 0.5), (None, 1e9 + 0.5), None]


def test_nothing_is_thinned_for_nobody_and_what_came_meanwhile_is_not_sent_late() -> None:
    live = Live()
    live.block(block(0, 4, 0.01))
    assert live._gather(0.05) == {}
    client = live.join()
    assert live.listeners == 1
    live.block(block(4, 2, 0.01))
    [(times, values)] = live._gather(0.05).values()
    assert (len(times), len(values), live.values) == (2, 2, 2)
    live.remove_client(client)
    live.remove_client(client)
    assert live.listeners == 0


def test_an_angle_that_jumps_at_each_sample_and_has_no_room_is_left_out() -> None:
    times, angles = np.arange(8.0), np.array([0.1, 6.2] * 4)
    kept_times, kept = thinned(times, angles, 2, before=0.1)
    assert (list(kept_times), list(kept)) == ([], [])


def test_an_event_is_a_line_of_the_service_and_a_message_of_each_client_by_its_rights() -> None:
    lines = list[dict[str, Any]]()

    async def run() -> list[list[dict[str, Any]]]:
        live = Live()
        live.on_event = lines.append
        live.event("link", state="early")  # no client yet, and no loop
        clients, fan = [live.join(), live.join(reader=True)], asyncio.create_task(live.run())
        await asyncio.sleep(0)
        live.event("measurement", state="left", why="Cannot write /home/arm/recordings/run.csv.")
        found = [[json.loads(text) for text in await client.wait()] for client in clients]
        fan.cancel()
        return found

    (own,), (reader,) = asyncio.run(run())
    assert [line["state"] for line in lines] == ["early", "left"]
    assert own == {"type": "event", **lines[1]}
    assert lines[1]["event"] == "measurement"
    assert "/home/arm/" in own["why"]
    assert "/home/arm" not in reader["why"]
    assert {name: own[name] for name in own if name != "why"} == {
        name: reader[name] for name in reader if name != "why"
    }


def test_a_beat_gives_out_what_came_since_the_one_before_and_a_sign_of_life_now_and_then(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The share of points of a channel follows from the time; a failed beat counts, and nothing of it is kept."""
    live, spans, kept, sent = Live(), list[float](), list[int](), list[tuple[int, str]]()
    clock = SimpleNamespace(monotonic=count(100.0, 0.5).__next__, time=lambda: 7.25)

    def gather(seconds: float) -> dict[str, Any]:
        spans.append(seconds)
        if len(spans) == 1:
            live._channels["ab", 1] = object()  # type: ignore[assignment]
            raise OverflowError("int too large to convert to float")
        kept.append(len(live._channels))
        if len(spans) == 9:
            raise asyncio.CancelledError
        return {}

    def broadcast(text: str, for_readers: str) -> None:
        assert text == for_readers
        sent.append((len(spans), text))

    monkeypatch.setattr("teds_provision.ncap.live.BEAT", 0.0)
    monkeypatch.setattr("teds_provision.ncap.live._TOLD", 1.5)
    monkeypatch.setattr("teds_provision.ncap.live.time", clock)
    monkeypatch.setattr(live, "_gather", gather)
    monkeypatch.setattr(live, "_broadcast", broadcast)
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(live.run())
    assert (spans, kept) == ([0.5] * 9, [0] * 8)
    assert [beats for beats, _ in sent] == [3, 6]
    assert json.loads(sent[0][1]) == {"type": "beat", "time": 7.25}
