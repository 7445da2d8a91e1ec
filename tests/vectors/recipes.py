"""Key agreement and sessions: what the known-answer file leaves out (profile sections 3 and 4)."""

# ruff: noqa: E501 - one row per case, its note in words included
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from cryptography.hazmat.primitives.ciphers.aead import AESCCM

from teds_provision.protocol.messages.frames import Command, Function, read_teds, security_command, write_teds
from teds_provision.protocol.wire_agreement import RequestPayload, key_id

from .scene import K, Scene, credentials, key

IDENTIFY = security_command(Function.IDENTIFY)
CHALLENGE = bytes(range(32))
CAN = {"link": "can:f1", "tapped": False}


def rotation() -> Iterator[Scene]:
    """Key agreement beyond its first good run, and rotation."""
    scene = Scene(
        "rotation-by-tap",
        "A keyed node agrees anew with its own station, tapped: epoch 2, the old key is gone.",
        "keyed",
    )
    agreed = scene.request("A Request needs no session where it is tapped.", one_time="one_time_2")
    scene.exchange(agreed.confirm, "The Confirm replaces K in one transaction.")
    scene.open("old", "The old key is unknown now: 16.", held=K)
    scene.open("new", "The new key opens.", held=agreed.key)
    scene.sealed("new", IDENTIFY, "Identify in the session says epoch 2.")
    yield scene

    scene = Scene(
        "rotation-in-session",
        "Rotation over CAN, untapped, inside a session: Request and Confirm are inner commands.",
        "keyed",
    )
    scene.open("old", "Open under the old key.", **CAN)
    agreed = scene.request(
        "The inner Request; its reply is sealed under the old session.",
        one_time="one_time_2",
        session="old",
        tapped=False,
    )
    scene.sealed(
        "old", agreed.confirm, "The inner Confirm; its reply still leaves sealed under the old session.", tapped=False
    )
    scene.exchange(
        scene.sessions["old"][0].seal(IDENTIFY),
        "After that reply every session is over: the outer command gets 2.",
        **CAN,
    )
    scene.open("new", "Open under the new key.", held=agreed.key, **CAN)
    scene.sealed("new", IDENTIFY, "Epoch 2.", tapped=False)
    yield scene

    scene = Scene(
        "second-station-of-the-same-ca",
        "A second station, certified by the CA that the node keeps, agrees by tap.",
        "provisioned",
    )
    agreed = scene.request(
        "Field 104 of the second station verifies under the kept CA.",
        shown=credentials("second_station"),
        one_time="one_time_2",
    )
    scene.exchange(agreed.confirm, "P(station) and K are replaced, P(CA) stays, the datasheet stays.")
    scene.open("second", "The second station opens.", held=agreed.key)
    scene.sealed("second", IDENTIFY, "Still provisioned, epoch 2, sequence unchanged.")
    yield scene

    scene = Scene(
        "agreement-ends-every-session",
        "A tapped agreement ends the session and the half-open Open on the bus.",
        "keyed",
    )
    scene.open("bus", "A session on CAN.", **CAN)
    scene.sealed("bus", IDENTIFY, "It is in use.", tapped=False)
    agreed = scene.request("Request by tap.", one_time="one_time_2")
    scene.sealed("bus", IDENTIFY, "A Request alone ends nothing.", tapped=False)
    scene.exchange(agreed.confirm, "Confirm by tap.")
    scene.exchange(scene.sessions["bus"][0].seal(IDENTIFY), "The session on CAN is over: 2.", **CAN)
    yield scene

    scene = Scene("a-new-request-replaces", "A good Request replaces what the one before it left in RAM.")
    first = scene.request("First Request.")
    second = scene.request("Second Request: another one-time key and nonce.", one_time="one_time_2")
    scene.exchange(second.confirm, "The Confirm of the second is good.")
    scene.exchange(first.confirm, "Nothing is pending any more: 2.")
    yield scene

    scene = Scene("a-bad-request-replaces-nothing", "A Request that is refused leaves what a good one before it left.")
    agreed = scene.request("A good Request.")
    scene.exchange(changed_request(station_signature=bytes(64)), "A Request with a wrong field 104: 5.")
    scene.exchange(agreed.confirm, "The Confirm of the good one still counts.")
    yield scene

    scene = Scene("wrong-tag", "A Confirm with a wrong tag drops the pending agreement.")
    agreed = scene.request("A good Request.")
    wrong = bytes([agreed.confirm.payload[0] ^ 1]) + agreed.confirm.payload[1:]
    scene.exchange(replace(agreed.confirm, payload=wrong), "One bit of tagS is wrong: 12.")
    scene.exchange(agreed.confirm, "Too late, nothing is pending: 2.")
    yield scene

    scene = Scene(
        "confirm-length",
        "State goes before length: with nothing pending a Confirm of any length gets 2, with one pending a wrong length gets 4 and leaves it.",
    )
    scene.exchange(security_command(Function.CONFIRM, bytes(15)), "Nothing pending, wrong length: 2.")
    agreed = scene.request("A good Request.")
    scene.exchange(security_command(Function.CONFIRM, agreed.confirm.payload[:15]), "Pending, wrong length: 4.")
    scene.exchange(agreed.confirm, "It was left: good.")
    yield scene

    scene = Scene(
        "confirm-from-another-line",
        "A node without NFC, its bus counted as tapped in factory state: a Confirm comes by the line of its Request.",
    )
    agreed = scene.request("Request from station address F1.", link="can:f1", tapped=True)
    scene.exchange(agreed.confirm, "The Confirm from F2: 2, and it is left.", link="can:f2", tapped=True)
    scene.exchange(agreed.confirm, "From F1: good.", link="can:f1", tapped=True)
    scene.exchange(
        changed_request(), "The node is keyed now, its bus counts as untapped: 3.", link="can:f1", tapped=False
    )
    yield scene

    scene = Scene("confirm-outside-its-session", "The Request came in a session, so the Confirm must.", "keyed")
    scene.open("old", "Open by NFC.")
    agreed = scene.request("Inner Request.", one_time="one_time_2", session="old")
    scene.exchange(agreed.confirm, "A plain Confirm: 2, and it is left.")
    scene.sealed("old", agreed.confirm, "The inner one is good.")
    yield scene

    scene = Scene("confirm-too-late", "What a Request left lives 60 s.")
    agreed = scene.request("A good Request.")
    scene.later(60.0).exchange(agreed.confirm, "60 s later: 2.")
    yield scene

    scene = Scene("confirm-after-the-field-was-lost", "Loss of the link takes the pending agreement along.")
    agreed = scene.request("A good Request.")
    scene.event("link_lost", "The node leaves the field.", link="nfc")
    scene.exchange(agreed.confirm, "Back in the field: 2.")
    yield scene

    scene = Scene(
        "confirm-after-a-reset",
        "Reset ends a pending agreement, in factory state too, where it changes nothing stored.",
    )
    agreed = scene.request("A good Request.")
    scene.exchange(security_command(Function.RESET, CHALLENGE), "Reset: the proof, for epoch 0.")
    scene.exchange(agreed.confirm, "Nothing is pending: 2.")
    yield scene

    scene = Scene("confirm-after-a-restart", "The pending agreement lies in RAM only.")
    agreed = scene.request("A good Request.")
    scene.event("restart", "Power off and on.")
    scene.exchange(agreed.confirm, "2.")
    yield scene

    scene = Scene(
        "flash-fails-in-confirm", "The commit of a Confirm fails: the old state stands, and the Confirm can come again."
    )
    agreed = scene.request("A good Request.")
    scene.event("flash_fails", "The flash refuses to be written.")
    scene.exchange(agreed.confirm, "11.")
    scene.event("flash_works", "It works again.")
    scene.exchange(agreed.confirm, "Good. (Our node keeps the pending agreement here; the profile leaves that open.)")
    yield scene


def changed_request(**changes: bytes) -> Command:
    """Return a Request with parts replaced."""
    shown = credentials()
    parts = RequestPayload(shown.key.point, shown.station_signature, shown.ca, key("one_time").point)
    return security_command(Function.REQUEST, replace(parts, **changes).encode())


def sessions() -> Iterator[Scene]:
    """Open, Sealed, Close: counters, tags, lives and ends."""
    scene = Scene("close", "Close is an inner command; its reply is the last of the session.", "keyed")
    scene.open("a", "Open.")
    scene.sealed("a", IDENTIFY, "Counter 1.")
    scene.sealed("a", security_command(Function.CLOSE), "Close.")
    scene.exchange(scene.sessions["a"][0].seal(IDENTIFY), "Counter 3, after the end: outer 2.")
    yield scene

    yield _open_checks()

    scene = Scene("open-after-a-restart", "c is random at every start, so no Open from before is good again.", "keyed")
    scene.open("a", "Open.")
    before = bytes.fromhex(scene.steps[-1]["command"])
    scene.event("restart", "Power off and on.")
    scene.exchange(before, "The same Open: 12.", crafted=True)
    scene.open("b", "With the new c.")
    scene.sealed("b", IDENTIFY, "Good.")
    yield scene

    scene = Scene("half-open-is-replaced", "A new Open replaces the half-open one.", "keyed")
    scene.open("a", "First Open; nothing sealed under it yet.")
    scene.open("b", "Second Open.")
    scene.exchange(scene.sessions["a"][0].seal(IDENTIFY), "Sealed under the first: 12.")
    scene.sealed("b", IDENTIFY, "Sealed under the second: good.")
    yield scene

    scene = Scene(
        "half-open-replaces-the-session",
        "A session lives on beside a half-open Open until the first good Sealed frame under that.",
        "keyed",
    )
    scene.open("a", "Open.")
    scene.sealed("a", IDENTIFY, "The first session is in use.")
    scene.open("b", "A second Open on the same link.")
    scene.sealed("a", IDENTIFY, "The first session still serves.")
    scene.sealed("b", IDENTIFY, "First good frame under the second: it takes over.")
    scene.exchange(scene.sessions["a"][0].seal(IDENTIFY), "The first is gone: 12.")
    yield scene

    scene = Scene("half-open-dies-after-60-s", "A half-open Open lives 60 s.", "keyed")
    scene.open("a", "Open.")
    scene.later(59.0).open("b", "59 s later, another.")
    scene.later(59.0).sealed("b", IDENTIFY, "59 s after its Open: good.")
    scene.open("c", "A third Open beside the session.")
    scene.later(60.0).exchange(
        scene.sessions["c"][0].seal(IDENTIFY), "60 s later it is gone; the session is not its own: 12."
    )
    yield scene

    scene = Scene("idle-session-ends", "A session ends after 10 minutes without a good frame.", "keyed")
    scene.open("a", "Open.")
    scene.sealed("a", IDENTIFY, "Good.")
    scene.later(599.0).sealed("a", IDENTIFY, "599 s later: good.")
    scene.later(600.0).exchange(scene.sessions["a"][0].seal(IDENTIFY), "600 s later: no session, outer 2.")
    yield scene

    scene = Scene(
        "counters", "Each counter is greater than the last; gaps are allowed; a bad frame ends nothing.", "keyed"
    )
    scene.open("a", "Open.")
    scene.crafted("a", 0, IDENTIFY, "Counter 0 is never good: 13.")
    scene.crafted("a", 1, IDENTIFY, "Counter 1: good.")
    scene.crafted("a", 1, security_command(Function.LIST), "Counter 1 again, rightly sealed: 13.")
    scene.crafted("a", 7, IDENTIFY, "Counter 7: good.")
    scene.crafted("a", 6, IDENTIFY, "Counter 6: 13.")
    scene.crafted("a", 8, IDENTIFY, "Counter 8: good.")
    yield scene

    scene = Scene("last-counter", "Counter 2^32 - 1 is served, and the session ends with its reply.", "keyed")
    scene.open("a", "Open.")
    scene.crafted("a", 0xFFFFFFFF, IDENTIFY, "The last counter: good.")
    scene.crafted("a", 0xFFFFFFFF, IDENTIFY, "The session is over: outer 2.")
    yield scene

    yield _bad_frames()

    scene = Scene("two-lines", "Each line has its own session; losing one leaves the other.", "keyed")
    scene.open("nfc", "Open by NFC.")
    scene.open("bus", "Open by CAN from F1.", **CAN)
    scene.sealed("nfc", IDENTIFY, "Good.")
    scene.sealed("bus", IDENTIFY, "Good.", tapped=False)
    scene.event("link_lost", "The field goes.", link="nfc")
    scene.exchange(scene.sessions["nfc"][0].seal(IDENTIFY), "By NFC: outer 2.")
    scene.sealed("bus", IDENTIFY, "By CAN: good.", tapped=False)
    yield scene

    scene = Scene(
        "inner-refusals", "Failures of an inner command are inner replies, sealed, under outer status 1.", "keyed"
    )
    scene.open("a", "Open.")
    inner: list[tuple[Command, str]] = [
        (security_command(Function.OPEN, bytes(89)), "Open inside: 3."),
        (security_command(Function.OPEN), "Open without payload inside: 3."),
        (security_command(Function.SEALED, bytes(36)), "Sealed inside: 3."),
        (Command(0, 1, 5, b"\0"), "Class 1, function 5, which this node does not have: 1."),
        (Command(1, 3, 1, bytes(4)), "Class 3 on channel 1: 1."),
        (Command(0, 128, 6), "Class 128, function 6: 1."),
        (Command(1, 128, 7), "Class 128 on channel 1: 1."),
        (read_teds(1, 5, 0), "Read of an absent TEDS: 18."),
        (write_teds(0, 18, 0, b"x"), "Write of an access code that no node holds: 18."),
        (security_command(Function.CONFIRM, bytes(16)), "Confirm with nothing pending: 2."),
        (security_command(Function.SET_CAN_ADDRESS, b"\0"), "CAN address 0: 4."),
        (security_command(Function.SET_CAN_ADDRESS, b"\x21"), "CAN address 0x21: good, durable."),
        (security_command(Function.SET_CAN_ADDRESS, b"\x21"), "The same again: good, nothing is written."),
        (security_command(Function.SET_CAN_ADDRESS, b"\x22"), "Another within 10 s of that write: 17."),
        (security_command(Function.SET_CAN_ADDRESS, b"\xf0"), "CAN address 240: 4 goes before 17."),
        (Command(0, 128, 7, b"\0"), "Identify with a payload: 4."),
    ]
    for command, note in inner:
        scene.sealed("a", command, note)
    scene.later(10.0).sealed("a", security_command(Function.SET_CAN_ADDRESS, b"\x22"), "10 s after the write: good.")
    yield scene


def _open_checks() -> Scene:
    scene = Scene(
        "open-checks",
        "Open on a keyed node: length 4, keyId 16, mac 12, Es 15, in this order; c grows with each good mac.",
        "keyed",
    )
    off_curve = bytes([4]) + bytes(31) + b"\x01" + bytes(31) + b"\x01"
    empty, good = security_command(Function.OPEN), key("one_time_2").point
    scene.exchange(empty, "Without payload: c.")
    scene.exchange(empty, "Asking changes nothing: the same c.")
    for size in (1, 8, 24, 88, 90):
        scene.exchange(security_command(Function.OPEN, bytes(size)), f"{size} octets: 4.")
    scene.exchange(security_command(Function.OPEN, bytes(89)), "A keyId that is not the key's: 16.")
    scene.exchange(security_command(Function.OPEN, key_id(K) + good + bytes(16)), "A wrong mac: 12, and c stands.")
    scene.exchange(
        security_command(Function.OPEN, key_id(K) + off_curve + bytes(16)),
        "A wrong mac over no point: 12 goes before 15.",
    )
    scene.crafted_open("The mac of the c that comes next: 12.", ahead=1)
    scene.crafted_open("Es is not on the curve, under a good mac: 15. c is used up.", point=off_curve)
    scene.crafted_open("Es is 65 zero octets: 15.", point=bytes(65))
    scene.crafted_open("Es begins with 06 (hybrid form): 15.", point=b"\x06" + good[1:])
    scene.crafted_open("Es is the node's own point: 15.", point=key("node").point)
    scene.crafted_open("Es is the station's static key: 15, a one-time key is due.", point=key("station").point)
    scene.crafted_open("The mac of the c before: 12.", ahead=-1)
    scene.open("a", "A good Open.")
    again = bytes.fromhex(scene.steps[-1]["command"])
    scene.exchange(again, "The same Open again: 12; the half-open one stands.", crafted=True)
    scene.sealed("a", IDENTIFY, "Counter 1.")
    return scene


def _bad_frames() -> Scene:
    scene = Scene(
        "bad-frames", "What is not a good Sealed frame changes nothing; tag and padding go before the counter.", "keyed"
    )
    scene.open("a", "Open.")
    scene.sealed("a", IDENTIFY, "Counter 1: good.")
    _, derived, _ = scene.sessions["a"]

    def frame(counter: int, plain: bytes, bend: int = 0) -> Command:
        head = counter.to_bytes(4, "big")
        sealed = AESCCM(derived.to_node, tag_length=16).encrypt(bytes(9) + head, plain, None)
        return security_command(Function.SEALED, head + sealed[:-1] + bytes([sealed[-1] ^ bend]))

    padded = IDENTIFY.encode() + bytes([10] * 10)
    for command, note in [
        (security_command(Function.SEALED, b""), "No payload: 4."),
        (security_command(Function.SEALED, bytes(35)), "35 octets cannot hold counter, one block and tag: 4."),
        (security_command(Function.SEALED, bytes(36)), "36 zero octets: 12."),
        (security_command(Function.SEALED, bytes(37)), "37 octets: 12."),
        (frame(2, padded, bend=1), "Counter 2, last bit of the tag flipped: 12."),
        (frame(1, padded, bend=1), "Counter 1 and a wrong tag: 12, not 13."),
        (frame(2, IDENTIFY.encode() + bytes(9) + b"\x0b"), "Padding 0B that is not eleven times 0B: 12."),
        (frame(2, IDENTIFY.encode() + bytes(10)), "Padding 00: 12."),
        (frame(2, IDENTIFY.encode() + b"\x11" * 10), "Padding 11 (17): 12."),
        (
            frame(2, IDENTIFY.encode() + b"\x01" * 9),
            "15 octets, no whole block, though the last looks like padding: 4, too short.",
        ),
        (frame(2, padded + b"\x01" * 15), "31 octets: 12, not whole blocks."),
        (
            frame(2, b"\x10" * 16),
            "A block of padding alone: well sealed, an inner frame of no octets: inner 4. It uses up counter 2.",
        ),
    ]:
        scene.exchange(command, note, crafted=True)
    scene.crafted("a", 3, IDENTIFY, "Counter 3: the session was never harmed.")
    return scene


FILES = {"rotation": rotation, "sessions": sessions}
