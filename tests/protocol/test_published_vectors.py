"""The published vectors: our generator, node and station keep to them, and plain primitives agree."""

from __future__ import annotations

import hashlib
import json
from datetime import datetime
from typing import Any

import pytest

from teds_provision.errors import TedsProvisionError
from teds_provision.protocol.handover.bundle import open_bundle
from teds_provision.protocol.handover.receipt import open_receipt
from teds_provision.protocol.keys import Credentials, SoftwareKey, fingerprint, station_key_message
from teds_provision.protocol.messages.frames import Command, decode_reply
from teds_provision.protocol.repetition import Repetition
from teds_provision.protocol.session import StationSession
from teds_provision.protocol.wire_agreement import StationAgreement
from teds_provision.teds.codec import security
from tests.vectors import generate
from tests.vectors.scene import BLOCKS

from . import vector_node as vn
from .vector_node import Entry

TRANSCRIPTS = ("rotation", "sessions", "refusals", "commit", "reset")


@pytest.mark.parametrize("name", generate.FILES)
def test_generating_the_vectors_again_changes_nothing(name: str) -> None:
    path = generate.FOLDER / f"{name}.json"
    assert path.read_text(encoding="utf-8") == generate.document(name)


# -- transcripts: the node ---------------------------------------------------------------------------------------------


@vn.cases(*TRANSCRIPTS)
def test_the_node_answers_as_published(document: Entry, entry: Entry) -> None:
    replay = vn.Replay(document, entry)
    for step in entry["steps"]:
        reply = replay.run(step)
        if reply is not None:
            assert reply.hex() == step["reply"], step["note"]
    assert replay.tim.identity().encode().hex() == entry["end"]["identify"]
    assert replay.memory.state == vn.flash_of(document, entry["end"])


def test_every_reason_that_the_node_gives_is_in_the_vectors() -> None:
    given: set[int] = set()
    for _, _, entry in vn.entries(*TRANSCRIPTS):
        for step in entry["steps"]:
            given |= {step.get("reason", 0), step.get("inner", {}).get("reason", 0)}
    assert given >= set(range(1, 19)) - {17}, "17 (busy) is for nodes that can serve one station at a time"


# -- transcripts: the station ------------------------------------------------------------------------------------------


def command_of(frame: str) -> Command:
    octets = bytes.fromhex(frame)
    return Command(int.from_bytes(octets[:2], "big"), octets[2], octets[3], octets[6:])


def credentials_in(document: Entry, request: bytes) -> Credentials:
    """Who sends this Request: found by its point."""
    names = {bytes.fromhex(key["P"]): name for name, key in document["keys"].items()}
    station, ca = (document["keys"][names[part]] for part in (request[:65], request[129:194]))
    signer = SoftwareKey(int(ca["d"], 16))
    key = SoftwareKey(int(station["d"], 16))
    return Credentials(key, signer.sign(station_key_message(key.point)), signer.point)


@vn.cases(*TRANSCRIPTS)
def test_the_station_sends_and_takes_what_is_published(document: Entry, entry: Entry) -> None:
    uuid = bytes.fromhex(document["uuid"])
    sessions: dict[str, StationSession] = {}
    for step in entry["steps"]:
        inner = step.get("inner")
        if "open" in step:
            opened = step["open"]
            session = StationSession(bytes.fromhex(opened["K"]), uuid, one_time=SoftwareKey(int(opened["Es"], 16)))
            assert session.open(bytes.fromhex(opened["c"])).encode().hex() == step["command"]
            if "reason" not in step:
                session.accept(decode_reply(bytes.fromhex(step["reply"])).payload)
                sessions[opened["session"]] = session
        if inner is not None:
            session = sessions[inner["session"]]
            assert session.seal(command_of(inner["command"])).encode().hex() == step["command"], step["note"]
            if "reply" in inner:
                found = session.unseal(decode_reply(bytes.fromhex(step["reply"])).payload)
                assert found.encode().hex() == inner["reply"], step["note"]
        if "agreement" in step:
            member = step["agreement"]
            command = command_of(inner["command"] if inner else step["command"])
            reply = decode_reply(bytes.fromhex(inner["reply"] if inner else step["reply"]))
            one_time = SoftwareKey(int(document["keys"][member["one_time"]]["d"], 16))
            agreement = StationAgreement(credentials_in(document, command.payload), uuid, one_time=one_time)
            assert agreement.request() == command
            pinned, teds = document["keys"]["node"]["fingerprint"], bytes.fromhex(member["teds"])
            agreed = agreement.accept(reply.payload, teds, pinned=pinned, epoch=member["epoch_held"])
            assert (agreed.key.hex(), agreed.epoch) == (member["K"], member["epoch"])
            assert agreed.confirm.payload.hex() == member["tagS"]


# -- transcripts: plain primitives -----------------------------------------------------------------------------------


@vn.cases(*TRANSCRIPTS)
def test_plain_primitives_give_the_same_keys_tags_and_frames(document: Entry, entry: Entry) -> None:
    uuid = bytes.fromhex(document["uuid"])
    keys: dict[str, tuple[bytes, bytes]] = {}
    for step in entry["steps"]:
        if "open" in step and "reason" not in step:
            keys[step["open"]["session"]] = check_open(uuid, step)
        if "inner" in step:
            to_node, to_station = keys[step["inner"]["session"]]
            sent = vn.unseal(to_node, bytes.fromhex(step["command"])[6:])
            assert sent == vn.padded(bytes.fromhex(step["inner"]["command"]))
            if "reply" in step["inner"]:
                payload = bytes.fromhex(step["reply"])[3:]
                assert payload[:4] == bytes.fromhex(step["command"])[6:10], "the counter of the command"
                assert vn.unseal(to_station, payload) == vn.padded(bytes.fromhex(step["inner"]["reply"]))
        if "agreement" in step:
            check_agreement(document, uuid, step)


def check_open(uuid: bytes, step: Entry) -> tuple[bytes, bytes]:
    opened, command, reply = step["open"], bytes.fromhex(step["command"]), bytes.fromhex(step["reply"])
    link_key, station, node = bytes.fromhex(opened["K"]), command[14:79], reply[3:68]
    assert command[:6].hex() == "000080030059"
    assert command[6:14] == hashlib.sha256(b"TEDS1 key id\0" + link_key).digest()[:8]
    assert command[79:] == vn.mac(link_key, b"station open" + uuid + bytes.fromhex(opened["c"]) + station)
    shared = vn.ecdh(opened["Es"], node)
    assert shared == vn.ecdh(step["En"], station)
    okm = vn.hkdf(shared, link_key, b"TEDS1 session\0" + uuid + station + node, 96)
    assert (okm[:16].hex(), okm[16:32].hex(), okm[64:].hex()) == (opened["k_sn"], opened["k_ns"], opened["k_m"])
    assert reply[68:] == vn.mac(okm[32:64], b"node open" + command[6:14] + station + node)
    return okm[:16], okm[16:32]


def check_agreement(document: Entry, uuid: bytes, step: Entry) -> None:
    agreement, frames = step["agreement"], step.get("inner", step)
    request, reply = bytes.fromhex(frames["command"])[6:], bytes.fromhex(frames["reply"])[3:]
    station, signature, ca, one_time = request[:65], request[65:129], request[129:194], request[194:]
    vn.check_signature(ca, b"TEDS1 station key\0" + station, signature)
    assert len(reply) == 165
    nonce, epoch, own, tag, proof = reply[:16], reply[16:20], reply[20:85], reply[85:101], reply[101:]
    node = bytes.fromhex(document["keys"]["node"]["P"])
    secret = next(key["d"] for key in document["keys"].values() if key["P"] == station.hex())
    assert document["keys"][agreement["one_time"]]["P"] == one_time.hex()
    shared = vn.ecdh(document["keys"][agreement["one_time"]]["d"], own) + vn.ecdh(secret, own)
    assert shared == vn.ecdh(step["En"], one_time) + vn.ecdh(step["En"], station)
    teds = hashlib.sha256(bytes.fromhex(agreement["teds"])).digest()
    script = hashlib.sha256(b"TEDS1 transcript\0" + request + nonce + epoch + own + uuid + node + teds).digest()
    vn.check_signature(node, b"TEDS1 agree\0" + script, proof)
    okm = vn.hkdf(shared, nonce, b"TEDS1 link key\0" + script, 48)
    assert okm[:16].hex() == agreement["K"]
    assert tag == vn.mac(okm[16:], b"node" + script)
    assert agreement["tagS"] == vn.mac(okm[16:], b"station" + script).hex()


def test_proofs_of_reset_verify() -> None:
    document = vn.load("reset")
    node, uuid = bytes.fromhex(document["keys"]["node"]["P"]), bytes.fromhex(document["uuid"])
    proofs = 0
    for entry in document["entries"]:
        for step in entry["steps"]:
            frames = step.get("inner", step)
            if frames.get("command", "")[4:8] == "8009" and "reason" not in frames:
                epoch = entry["start"]["epoch"].to_bytes(4, "big")
                challenge, proof = bytes.fromhex(frames["command"])[6:], bytes.fromhex(frames["reply"])[3:]
                vn.check_signature(node, b"TEDS1 reset\0" + uuid + epoch + challenge, proof)
                proofs += 1
    assert proofs == 3


# -- repetition --------------------------------------------------------------------------------------------------------


@vn.cases("repetition")
def test_repetitions_are_answered_as_published(document: Entry, entry: Entry) -> None:
    replay, kept = vn.Replay(document, entry), Repetition()
    for step in entry["steps"]:
        if "event" in step:
            kept.forget()
            replay.run(step)
            continue
        ran: list[bytes] = []

        def run(frame: bytes, step: Entry = step, ran: list[bytes] = ran) -> bytes:
            ran.append(frame)
            reply = replay.run({**step, "link": "nfc", "tapped": True})
            assert reply is not None
            return reply

        frame = bytes.fromhex(step["command"])
        reply = run(frame) if step["functional"] else kept.answer(step["transaction"], frame, run, now=step["at"])
        assert (reply.hex(), bool(ran)) == (step["reply"], step["run"]), step["note"]
    assert replay.tim.identity().encode().hex() == entry["end"]["identify"]


# -- the page ----------------------------------------------------------------------------------------------------------


def test_the_page_of_the_vectors_names_every_file_and_its_entries() -> None:
    page = (generate.FOLDER.parents[2] / "docs" / "vectors.md").read_text(encoding="utf-8")
    for name in generate.FILES:
        assert f"| `{name}.json` | {len(vn.load(name)['entries'])} |" in page


# -- canonical form ----------------------------------------------------------------------------------------------------


@vn.cases("canonical")
def test_canonical_form_as_published(document: Entry, entry: Entry) -> None:
    teds = bytes.fromhex(entry["teds"])
    try:
        shown = security.decode(teds)
        form_good = shown.signed and shown.values == security.OUR_VALUES
    except security.NotCanonicalError:
        form_good = False
    assert form_good == (entry["reason"] != 4), entry["note"]
    if form_good:
        assert security.decode(teds).encode() == teds, "what is read is written the same"


def test_the_node_gives_the_published_reason_at_the_commit() -> None:
    document = vn.load("canonical")
    from .desk import Desk  # its node has other keys; the session only carries the writes

    for entry in document["entries"]:
        desk = Desk()
        start = next(e for e in vn.load("commit")["entries"] if e["name"] == "good")["start"]
        desk.memory.state = vn.flash_of(document, start)
        desk.key = bytes.fromhex(start["K"])
        desk.restart()
        desk.open()
        reply = desk.commit(dict(BLOCKS), bytes.fromhex(entry["teds"]))
        assert reply.reason == entry["reason"], entry["name"]


# -- handover ----------------------------------------------------------------------------------------------------------


def trust_store(document: Entry, names: list[str]) -> dict[str, bytes]:
    points = [bytes.fromhex(document["keys"][name]["P"]) for name in names]
    return {fingerprint(point): point for point in points}


@vn.cases("handover")
def test_bundles_open_or_are_refused_as_published(document: Entry, entry: Entry) -> None:
    recipient = SoftwareKey(int(document["keys"][entry["recipient"]]["d"], 16))
    now = datetime.fromisoformat(entry["now"])
    outcome: Any = "opened"
    try:
        opened = open_bundle(entry["bundle"].encode(), recipient, trust_store(document, entry["trusted"]).get, now)
    except TedsProvisionError as error:
        outcome = error.exit_code
    assert outcome == entry["outcome"], entry["note"]
    if outcome != "opened":
        return
    payload = entry["payload"]
    assert (opened.bundle.id, opened.bundle.mode) == (payload["id"], payload["mode"])
    assert [bundled_node.uuid.hex() for bundled_node in opened.bundle.nodes] == [
        node["uuid"] for node in payload["nodes"]
    ]
    assert opened.bundle.nodes[0].key.hex() == "346dc7ba01b285e9fedeb955a14398b8"
    assert opened.station_signature is not None
    receipt = open_receipt(entry["receipt_jws"].encode(), trust_store(document, [entry["recipient"]]).get)
    assert (receipt.id, receipt.bundle_sha256) == (payload["id"], opened.sha256)


@vn.cases("handover")
def test_another_jose_opens_every_good_bundle(document: Entry, entry: Entry) -> None:
    if entry["outcome"] != "opened":
        return
    from jwcrypto import jwe, jwk, jws

    def key(name: str, *, private: bool) -> Any:
        held = SoftwareKey(int(document["keys"][name]["d"], 16))
        from teds_provision.protocol.handover.jose import public_jwk
        from teds_provision.protocol.handover.strict_json import encode_base64url

        members = public_jwk(held.point) | ({"d": encode_base64url(held.secret())} if private else {})
        return jwk.JWK(**members)

    token = jwe.JWE()
    token.deserialize(entry["bundle"], key(entry["recipient"], private=True))
    assert token.payload.decode() == entry["jws"]
    signed = jws.JWS()
    signed.deserialize(entry["jws"], key("station", private=False))
    assert json.loads(signed.payload) == entry["payload"]


# -- measurement operation ---------------------------------------------------------------------------------------------


@vn.cases("operation")
def test_data_frames_open_by_plain_primitives(document: Entry, entry: Entry) -> None:
    """Frames into messages by segment, keys from Z, CCM with 8 octets of tag: from the standards and the page alone."""
    uuid = bytes.fromhex(document["uuid"])
    keys: dict[str, list[bytes]] = {}
    for session in entry["sessions"]:
        station, node = SoftwareKey(int(session["Es"], 16)), SoftwareKey(int(session["En"], 16))
        shared = vn.ecdh(session["Es"], node.point)
        info = b"TEDS1 session\0" + uuid + station.point + node.point
        okm = vn.hkdf(shared, bytes.fromhex(session["K"]), info, 96)
        assert okm[64:].hex() == session["k_m"]
        keys.setdefault(session["link"], []).append(okm[64:])
    held: dict[str, bytes] = {}
    for frame in (frame for step in entry["steps"] for frame in step.get("sent", ())):
        s, node_address = int(frame["id"][4:6], 16), int(frame["id"][6:], 16)
        assert (frame["id"][:4], node_address) == ("1cff", 192)
        link, stream, segment = f"can:f{s >> 5}", s >> 3 & 3, s & 7
        before = b"" if segment == 0 else held[f"{link}/{stream}"]
        message = held[f"{link}/{stream}"] = before + bytes.fromhex(frame["data"])
        if len(frame["data"]) < 16:  # in these entries the last frame of every message is a short one
            runs = range(1, 4)
            opened = [vn.open_message(k_m, run, message) for k_m in keys[link] for run in runs]
            (plain,) = [item for item in opened if item is not None]
            assert plain[0] == 0
