"""The published transcripts, frame by frame, to the node in C: the same replies, and the same state at the end."""

from __future__ import annotations

import itertools

import pytest

from teds_provision.protocol.flash import Flash
from tests.firmware.memory_node import MemoryNode
from tests.protocol import vector_node as vn
from tests.protocol.vector_node import Entry
from tests.vectors.scene import flash, key, named_key, octets

pytestmark = pytest.mark.system


class Replay(vn.Replay):
    """The node in C under one entry."""

    def restart(self) -> None:
        if not hasattr(self, "node"):
            uuid = self.memory.state.uuid
            self.node = MemoryNode(self._draw, lambda: self.now, uuid=uuid, **self._limits)
            assert self.node.start() == 0
            self.node.put(self.memory.state)
            self.tim = self.node  # type: ignore[assignment]
        else:
            assert self.node.start() == 0

    def _draw(self, kind: str, size: int) -> bytes:
        if kind == "i":
            return self._key.secret()
        if kind == "o":
            return self._one_time().secret()
        return self._random(size)

    def run(self, step: Entry) -> bytes | None:
        if step.get("event") in ("flash_fails", "flash_works"):
            self.node.fails(step["event"] == "flash_fails")
            return None
        reply = super().run(step)
        if reply is not None:
            self.node.reply_sent(step["link"])
        return reply


@vn.cases("rotation", "sessions", "refusals", "commit", "reset")
def test_the_node_in_c_answers_as_published(document: Entry, entry: Entry) -> None:
    replay = Replay(document, entry)
    for step in entry["steps"]:
        reply = replay.run(step)
        if reply is not None:
            assert reply.hex() == step["reply"], step["note"]
    assert replay.node.identity().encode().hex() == entry["end"]["identify"]
    assert not replay.node.misused
    ended: Flash = vn.flash_of(document, entry["end"])
    assert replay.node.blocks() == {**ended.blocks, (0, 128): ended.security_teds()}
    replay.node.close()


@vn.cases("nfc_pieces")
def test_its_tag_shows_what_was_published(document: Entry, entry: Entry) -> None:
    counts = {"n": itertools.count(), "o": itertools.count()}

    def draw(kind: str, size: int) -> bytes:
        if kind == "i":
            return key("node").secret()
        if kind == "o":
            return named_key(entry["name"], next(counts["o"]), "En").secret()
        return (
            octets(entry["name"], "c")[:8] if size == 8 else octets(entry["name"], next(counts["n"]), "nonceN")[:size]
        )

    node = MemoryNode(draw, lambda: 0.0, uuid=bytes.fromhex(document["uuid"]), max_message=2048, max_teds=16384)
    node.has_nfc(wt_int=20, n_wait=15, max_ndef=entry["max_ndef"])
    assert node.start() == 0
    node.put(flash(entry["state"]))
    node.nfc_field(True)
    shown = node.nfc_message()
    for step in entry["steps"]:
        if step["by"] == "station":
            shown = node.nfc_write(bytes.fromhex(step["message"]))
        else:
            assert shown.hex() == step["message"], step["note"]
    node.close()
