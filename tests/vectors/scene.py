"""One node in memory and everything that is said to it, written down octet for octet.

A scene starts in a stated flash state, runs command frames through the reference node with a fixed clock and fixed
randomness, and gives the JSON entry that a firmware author replays. See docs/vectors.md for the form of an entry.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from teds_provision.protocol.datasheet import SignedNodeKey, digests, sign_datasheet, unsigned_datasheet
from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import (
    GROUP_ORDER,
    Credentials,
    SoftwareKey,
    fingerprint,
    node_key_message,
    station_key_message,
)
from teds_provision.protocol.messages.frames import Command, Function, Reply, decode_reply, security_command
from teds_provision.protocol.session import SessionKeys, StationSession, _seal, open_mac
from teds_provision.protocol.tim import Tim
from teds_provision.protocol.wire_agreement import AgreedKey, StationAgreement, key_id
from teds_provision.teds.image import SECURITY, BlockId
from tests.protocol.memory import RamFlash

FOLDER = Path(__file__).parent / "profile"
KAT: dict[str, Any] = json.loads((FOLDER / "kat.json").read_text())
UUID = bytes.fromhex(KAT["uuid"])
K = bytes.fromhex(KAT["agreement"]["K"])
CAN_ADDRESS: int = KAT["default_can_address"]
BLOCKS: dict[BlockId, bytes] = {
    (entry["channel"], entry["access_code"]): bytes.fromhex(entry["teds"]) for entry in KAT["datasheet"]["blocks"]
}
SIGNED: bytes = bytes.fromhex(KAT["datasheet"]["security_teds"])
NAMES = ("node", "station", "ca", "one_time", "one_time_node")
MORE_NAMES = ("second_station", "foreign_ca", "foreign_station", "one_time_2", "one_time_3", "other_node")


def key(name: str) -> SoftwareKey:
    """Return a key of the vectors by name: those of kat.json, and more that follow from their names."""
    if name in NAMES:
        return SoftwareKey(int(KAT[name]["d"], 16))
    return named_key(name)


def keys() -> dict[str, Any]:
    """Return all of them, as they are in every file."""
    return {
        name: {"d": key(name).secret().hex(), "P": key(name).point.hex(), "fingerprint": fingerprint(key(name).point)}
        for name in NAMES + MORE_NAMES
    }


def named_key(*label: object) -> SoftwareKey:
    """Return a one-time key in place of a random one: its scalar follows from a label."""
    digest = hashlib.sha256(b"TEDS1 vector key\0" + "/".join(map(str, label)).encode()).digest()
    return SoftwareKey(int.from_bytes(digest, "big") % (GROUP_ORDER - 1) + 1)


def octets(*label: object) -> bytes:
    """16 octets in place of random ones: SHA-256 of a label, cut."""
    return hashlib.sha256(b"TEDS1 vector octets\0" + "/".join(map(str, label)).encode()).digest()[:16]


def credentials(station: str = "station", ca: str = "ca") -> Credentials:
    """Return what a station of the vectors shows."""
    return Credentials(key(station), key(ca).sign(station_key_message(key(station).point)), key(ca).point)


def flash(state: str, **changes: Any) -> Flash:
    """Return the vectors' node in factory state, keyed (epoch 1, K of kat.json) or provisioned (sequence 1)."""
    node = key("node")
    made = Flash(UUID, node.point, node.sign(node_key_message(UUID, node.point)), can_address=CAN_ADDRESS)
    if state != "factory":
        made = replace(made, key=K, epoch=1, station=key("station").point, ca=key("ca").point)
    if state == "provisioned":
        made = replace(made, blocks={**BLOCKS, SECURITY: SIGNED}, sequence=1, provisioned=True)
    return replace(made, **changes)


def signed(
    listed: Mapping[BlockId, bytes] = BLOCKS, *, station: str = "station", ca: str = "ca", **values: Any
) -> bytes:
    """A signed Security TEDS over ``listed``; ``values`` are sequence, key_epoch, ca, last_modified or any field."""
    shown = credentials(station, ca)
    fixed = {"ca": "peer:a69bf70a91fc6b1f", "last_modified": bytes.fromhex("6955b90000000000")}
    node = key("node")
    own = SignedNodeKey(UUID, node.point, node.sign(node_key_message(UUID, node.point)))
    plain = {name: values.pop(name) for name in ("sequence", "key_epoch") if name in values}
    sheet = unsigned_datasheet(
        own,
        shown.key.point,
        shown.station_signature,
        digests(listed),
        **{"sequence": 1, "key_epoch": 1} | fixed | plain,
    )
    return sign_datasheet(replace(sheet, **values), UUID, shown)


def high(signature: bytes) -> bytes:
    """Return the same signature with s in the upper half of the group order."""
    return signature[:32] + (GROUP_ORDER - int.from_bytes(signature[32:], "big")).to_bytes(32, "big")


class Scene:
    """One entry: ``name``, a note in words, the node's state at the start, steps, and what is so at the end."""

    def __init__(
        self,
        name: str,
        note: str,
        state: str = "factory",
        *,
        max_message: int = 2048,
        max_teds: int = 16384,
        **changes: Any,
    ) -> None:
        self.name, self.note = name, note
        self.max_message, self.max_teds = max_message, max_teds
        self.memory = RamFlash(flash(state, **changes))
        self.start = self.memory.state
        self.now = 0.0
        self.steps: list[dict[str, Any]] = []
        self.sessions: dict[str, tuple[StationSession, SessionKeys, str]] = {}
        self._drawn: dict[str, str] = {}
        self._tim = self._new()
        self.first_c = self._drawn["c"]

    def _new(self) -> Tim:
        return Tim(
            key("node"),
            self.memory,
            lambda: self.now,
            max_message=self.max_message,
            max_teds=self.max_teds,
            random=self._draw,
            one_time=self._draw_key,
        )

    def _draw(self, size: int) -> bytes:
        what = "c" if size == 8 else "nonceN"
        made = octets(self.name, len(self.steps), what)[:size]
        self._drawn[what] = made.hex()
        return made

    def _draw_key(self) -> SoftwareKey:
        made = named_key(self.name, len(self.steps), "En")
        self._drawn["En"] = made.secret().hex()
        return made

    # -- what happens ----------------------------------------------------------------------------------------------

    def later(self, seconds: float) -> Self:
        """Let time pass."""
        self.now += seconds
        return self

    def event(self, event: str, note: str, **more: str) -> None:
        """Something other than a command: link_lost, restart, reset_by_hand, flash_fails, flash_works."""
        self.steps.append({"event": event, "note": note, "at": self.now, **more})
        match event:
            case "link_lost":
                self._tim.link_lost(more["link"])
            case "restart":
                self._tim = self._new()
                self.steps[-1]["c"] = self._drawn["c"]
            case "reset_by_hand":
                self._tim.reset_by_hand()
            case _:
                self.memory.fail = event == "flash_fails"

    def exchange(
        self, frame: Command | bytes, note: str, *, link: str = "nfc", tapped: bool | None = None, **more: Any
    ) -> Reply:
        """Run one command frame and write it down."""
        command = frame if isinstance(frame, bytes) else frame.encode()
        counts = link == "nfc" if tapped is None else tapped
        self._drawn = {}
        reply = self._tim.handle(command, link=link, tapped=counts)
        step = {"note": note, "at": self.now, "link": link, "tapped": counts, "command": command.hex(), **self._drawn}
        answer = decode_reply(reply)
        step |= {"reply": reply.hex()} | more
        if answer.reason is not None:
            step["reason"] = answer.reason
        self.steps.append(step)
        return answer

    # -- the station's acts ----------------------------------------------------------------------------------------

    def request(
        self,
        note: str,
        *,
        shown: Credentials | None = None,
        one_time: str = "one_time",
        session: str | None = None,
        **more: Any,
    ) -> AgreedKey:
        """A good Request, plain or in a session; gives what Confirm needs."""
        agreement = StationAgreement(shown or credentials(), UUID, one_time=key(one_time))
        station = {"agreement": {"one_time": one_time, "epoch_held": self.memory.state.epoch}}
        if session is None:
            reply = self.exchange(agreement.request(), note, **station, **more)
        else:
            reply = self.sealed(session, agreement.request(), note, **station, **more)
        held, pinned = self.memory.state, fingerprint(key("node").point)
        agreed = agreement.accept(reply.payload, held.security_teds(), pinned=pinned, epoch=held.epoch)
        self.steps[-1]["agreement"] |= {
            "teds": held.security_teds().hex(),
            "K": agreed.key.hex(),
            "epoch": agreed.epoch,
            "tagS": agreed.confirm.payload.hex(),
        }
        return agreed

    def open(self, label: str, note: str, *, held: bytes = K, **more: Any) -> Reply:
        """Open under a link key; ``label`` names the session for later steps."""
        one_time = named_key(self.name, len(self.steps), "Es")
        session = StationSession(held, UUID, one_time=one_time)
        counter = self.exchange(session.request_counter(), "Open without payload asks for c.", **more).payload
        record = {"session": label, "K": held.hex(), "Es": one_time.secret().hex(), "c": counter.hex()}
        reply = self.exchange(session.open(counter), note, open=record, **more)
        if reply.ok:
            session.accept(reply.payload)
            node = reply.payload[:65]
            derived = SessionKeys.derive(held, UUID, one_time.ecdh(node), one_time.point, node)
            link = self.steps[-1]["link"]
            self.sessions[label] = (session, derived, link)
            self.steps[-1]["open"] |= {
                "keyId": key_id(held).hex(), "k_sn": derived.to_node.hex(), "k_ns": derived.to_station.hex(),
                "k_m": derived.messages.hex(),
            }  # fmt: skip
        return reply

    def crafted_open(self, note: str, *, ahead: int = 0, point: bytes | None = None, held: bytes = K) -> Reply:
        """Send an Open whose mac is right for the node's c plus ``ahead``, with any point as Es."""
        counter = self.exchange(
            StationSession(held, UUID).request_counter(), "Open without payload asks for c."
        ).payload
        used = ((int.from_bytes(counter, "big") + ahead) % (1 << 64)).to_bytes(8, "big")
        station = named_key(self.name, len(self.steps), "Es").point if point is None else point
        payload = key_id(held) + station + open_mac(held, UUID, used, station)
        return self.exchange(security_command(Function.OPEN, payload), note, crafted=True)

    def sealed(self, label: str, command: Command, note: str, **more: Any) -> Reply:
        """Send one inner command under the session's next counter."""
        session, _, link = self.sessions[label]
        outer = self.exchange(session.seal(command), note, **{"link": link} | more)
        self.steps[-1]["inner"] = {"session": label, "command": command.encode().hex()}
        if not outer.ok:
            return outer
        reply = session.unseal(outer.payload)
        self.steps[-1]["inner"]["reply"] = reply.encode().hex()
        if reply.reason is not None:
            self.steps[-1]["inner"]["reason"] = reply.reason
        return reply

    def crafted(self, label: str, counter: int, command: Command, note: str) -> Reply:
        """Send a sealed frame under any counter, which no good station would send."""
        _, derived, link = self.sessions[label]
        payload = _seal(derived.to_node, counter, command.encode())
        return self.exchange(security_command(Function.SEALED, payload), note, link=link, crafted=True)

    # -- the entry -------------------------------------------------------------------------------------------------

    def entry(self) -> dict[str, Any]:
        """Return the JSON of it all."""
        return {
            "name": self.name,
            "note": self.note,
            "start": {
                **described(self.start),
                "max_message": self.max_message,
                "max_teds": self._tim.max_teds,
                "c": self.first_c,
            },
            "steps": self.steps,
            "end": {**described(self.memory.state), "identify": self._tim.identity().encode().hex()},
        }


def described(state: Flash) -> dict[str, Any]:
    """Return a flash state in JSON."""
    return {
        "state": state.state.name.lower(),
        "epoch": state.epoch,
        "sequence": state.sequence,
        "K": state.key.hex() if state.key else None,
        "station": state.station.hex() if state.station else None,
        "ca": state.ca.hex() if state.ca else None,
        "can_address": state.can_address,
        "blocks": [
            {
                "channel": channel,
                "access_code": code,
                "teds": teds.hex(),
                "read_only": (channel, code) in state.read_only,
            }
            for (channel, code), teds in sorted(state.blocks.items())
        ],
    }
