"""The whole transcript of operation_kat.json, played against the reference node: every reply and every frame."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.operation.can_frames import drive_address
from teds_provision.protocol.operation.hardware import SessionPort
from teds_provision.protocol.session import StationSession

from .bench import MS, Bench, K
from .kat import KAT, MESSAGE_KEY, UUID, can_frame

STEP = 1_400_000  # ns between two commands of the transcript
FIRST = 62_300_000
SOON = 30 * MS


def times() -> dict[int, int]:
    """When each command of the transcript came: told by Clock and Subscribe, else a step before or after another."""
    commands, known = {c["counter"]: c for c in KAT["commands"]}, {1: FIRST}
    known |= {c["counter"]: 730 * MS for c in KAT["commands"] if c["name"].startswith("Stop 0: self-test")}
    for counter, entry in commands.items():
        reply = bytes.fromhex(entry["inner_reply"])[3:]
        if entry["inner"].startswith("00008010"):
            known[counter] = int.from_bytes(reply[:8], "big")
        elif entry["inner"].startswith("0000800e") and reply[4:] != b"\xff" * 8:
            known[counter] = int.from_bytes(reply[4:12], "big") - SOON
    for counter, entry in commands.items():
        if counter not in known:
            after = entry["name"].startswith("Stop") and counter + 1 in known
            known[counter] = known[counter + 1] - STEP if after else known[counter - 1] + STEP
    return known


def load_dice(bench: Bench, opens: int, one_time: SoftwareKey) -> None:
    """What the node draws."""
    drawn = iter([one_time])
    bench.tim._sessions._opens = opens
    bench.tim._sessions._one_time = lambda: next(drawn)


def message_key(bench: Bench) -> bytes:
    """Return what it derived."""
    session = bench.tim._sessions.on("can:f1")
    assert session is not None
    return session.message_key


@pytest.mark.parametrize("fd", [False, True], ids=["classic", "FD"])
def test_the_node_answers_and_streams_as_published(fd: bool) -> None:
    bench, known = Bench(), KAT["open"]
    load_dice(bench, int(known["c"], 16), SoftwareKey(int(known["En"]["d"], 16)))
    bench.ports["can:f1"] = SessionPort("can", "can", 0xF1, fd=fd)
    session = StationSession(K, UUID, one_time=SoftwareKey(int(known["Es"]["d"], 16)))
    opened = bench.tim.handle(bytes.fromhex(known["open_frame"]), link="can:f1", tapped=False)
    assert opened.hex() == known["open_reply"]
    assert session.request_counter().encode().hex() == known["c_frame"]

    events = iter(range(0, 2000 * MS, 50 * MS))
    upcoming = next(events)
    due = times()
    for entry in KAT["commands"]:
        at = due[entry["counter"]]
        if entry["name"] == "Clock with the mark":
            bench.until(KAT["trigger"]["mark"])
            bench.tim.trigger("can:f1", bytes.fromhex(KAT["trigger"]["T"]), KAT["trigger"]["mark"])
        if entry["name"] == "Stop 2: waits for the trigger":
            at = due[entry["counter"]] = KAT["trigger"]["start"] + 10 * MS
        if entry["counter"] > 35:
            at = max(at, bench.hardware.tick + 1)
        while upcoming <= at:
            if upcoming >= bench.hardware.tick:
                bench.until(upcoming)
                bench.tim.event(5, upcoming, bench.hardware.value(5, upcoming))
            upcoming = next(events)
        bench.until(at)
        drive(bench, entry["name"], fd=fd)
        frame = bytes.fromhex(entry["frame"])
        reply = bench.tim.handle(frame, link="can:f1", tapped=False, port=bench.ports["can:f1"])
        bench.tim.reply_sent("can:f1")
        if entry["name"].startswith("Stop 0: self-test"):
            bench.hardware.tests.clear()
        assert reply.hex() == entry["reply"], entry["name"]
    assert message_key(bench) == MESSAGE_KEY

    form = "can_fd" if fd else "can"
    published = [can_frame(text) for stream in KAT["streams"] for m in stream["messages"] for text in m[form]]
    sent = [(sent.identifier, sent.data) for _, sent in bench.frames]
    more = 1 if fd else 3  # the second message of the last stream, which the vectors count (stop 2) and do not list
    assert (sent[: len(published)], len(sent)) == (published, len(published) + more)
    assert {sent.fd for _, sent in bench.frames} == {fd}


def drive(bench: Bench, name: str, *, fd: bool) -> None:
    """The Drive messages that come before the commands which look at what they did."""
    for number, message in zip(("0", "7"), KAT["drive"]["messages"], strict=True):
        if name == f"Read set point of 4 after Drive {number}":
            for identifier, data in frames(message, fd=fd):
                assert drive_address(identifier) is not None
                bench.tim.drive("can:f1", data)
            assert bench.hardware.log[-1] == ("apply", dict(zip((4, 6), message["values"], strict=True)))


def frames(message: dict, *, fd: bool) -> Iterator[tuple[int, bytes]]:
    yield from (can_frame(text) for text in message["can_fd" if fd else "can"])
