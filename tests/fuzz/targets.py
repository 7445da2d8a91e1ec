"""Every parser of octets as a fuzz target: one input in, nothing but an error of ours out.

A target takes any octets. It raises nothing, or AssertionError, or whatever a parser should not have let out. Inputs to
begin with stand in ``seeds``; what fuzzing found stands in ``corpus/<target>``.
"""

from __future__ import annotations

import json
import logging
import struct
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import cache, partial
from io import BytesIO
from pathlib import Path

from teds_provision.errors import NodeSilentError, TedsProvisionError
from teds_provision.links.nfc.pieces import Piece, Requester, Responder
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.messages.frames import Command
from teds_provision.protocol.messages.smp import SmpPacket, decode_packet

CORPUS = Path(__file__).parent / "corpus"
NOW = datetime(2026, 11, 21, tzinfo=UTC)
VECTORS = Path(__file__).parents[1] / "vectors"


@dataclass(frozen=True)
class Target:
    """One parser: ``check`` reads an input, ``seeds`` are what to begin with, ``words`` what its texts are made of."""

    name: str
    check: Callable[[bytes], None]
    seeds: Callable[[], Iterable[bytes]]
    words: tuple[str, ...] = ()
    longest: int = 4096  # octets of an input: what is too short to hold another case only costs time

    def kept(self) -> list[bytes]:
        """Seeds, and every input that is kept in the repository."""
        folder = CORPUS / self.name
        return [*self.seeds(), *(path.read_bytes() for path in sorted(folder.glob("*")))]


def as_text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def reads(*readers: Callable[[], object]) -> None:
    """Call each; an error of ours is an answer."""
    for reader in readers:
        with suppress(TedsProvisionError):
            reader()


# -- TEDS --------------------------------------------------------------------------------------------------------------


def check_teds(data: bytes) -> None:
    """The decoder; even first octet: as it is, odd: a data block that gets Length and checksum first."""
    from teds_provision import teds
    from teds_provision.errors import BadDataError
    from teds_provision.teds.codec.frame import frame

    if not data:
        return
    octets = frame(data[1:]) if data[0] & 1 else data[1:]
    decoded = teds.decode(octets)
    assert teds.encode(decoded) == octets
    errors = [finding for finding in decoded.findings if finding.severity == "error"]
    assert bool(errors) == (decoded.verdict not in {"clean", "block-clean", "message"})
    try:
        teds.decode(octets, strict=True)
        assert not errors
    except BadDataError:
        assert errors
    try:
        again = teds.recompose(decoded)
    except BadDataError:
        assert decoded.verdict in {"malformed", "message"}
    else:
        assert again == octets or decoded.verdict not in {"clean", "block-clean"}
    for edition in (2007, 2024):
        try:
            other, findings = teds.convert(decoded, edition)
        except BadDataError:
            continue
        if decoded.verdict == "clean" and not findings:
            assert teds.decode(other).edition == edition
            assert teds.decode(other).verdict == "clean"
    for read_field in decoded.fields:
        teds.unpack_uuid(read_field.raw)
        teds.read_key(read_field.raw)


def check_sheet(data: bytes) -> None:
    """The typed datasheet, its interpreter and the guard: pieces of ``channel u8 ‖ code u8 ‖ length u16 ‖ block``."""
    from teds_provision.teds.calibration import ChannelInterpreter
    from teds_provision.teds.codec.frame import frame
    from teds_provision.teds.formats import TedsBlock
    from teds_provision.teds.guard import check_calibration
    from teds_provision.teds.image import Image
    from teds_provision.teds.sheet import Sheet
    from teds_provision.teds.show import describe

    blocks, at = {}, 0
    while at + 4 <= len(data):
        channel, code, length = struct.unpack_from(">BBH", data, at)
        blocks[channel, code] = frame(data[at + 4 : at + 4 + length])
        at += 4 + length
    sheet = Sheet.from_image(Image(bytes(10), blocks))
    for channel in sheet.channels:
        assert channel.value_problem == "" or channel.value_problem.endswith(".")
        channel.show(channel.low)
        with suppress(TedsProvisionError):
            interpreter = ChannelInterpreter(sheet, channel.number)
            known = {channel.number: channel.sample for channel in sheet.channels}
            other = {n: bytes(3 * form.octets) for n in interpreter.others if (form := known.get(n))}
            values = interpreter.decode(b"\x7f" * (3 * interpreter.octets), other)
            assert len(values.value) == 3
            interpreter.encode(1.0)
    check_calibration(blocks, now=NOW)
    for (number, code), octets in blocks.items():
        describe(TedsBlock(number, code, octets), blocks, now=NOW)


def sheet_seeds() -> Iterable[bytes]:
    from teds_provision.teds.calibration import fit
    from teds_provision.teds.codec.frame import unframe
    from teds_provision.teds.profile import load_profile

    line = fit([(0, 0.0), (100, 4.0), (60000, 9.0)], "table", channel=1)
    for name in ("magnetic-angular-position-sensor", "gripper"):
        built = load_profile(name).build(bytes(10), calibration={1: line}).blocks
        yield b"".join(
            struct.pack(">BBH", channel, code, len(teds) - 6) + unframe(teds)
            for (channel, code), teds in built.items()
            if channel < 3
        )


def check_security(data: bytes) -> None:
    """The canonical Security TEDS: what is read is written again octet for octet."""
    from teds_provision.teds.codec import security
    from teds_provision.teds.codec.frame import frame

    octets = frame(data)
    security.has_profile_version(octets)
    reads(lambda: security.tbs(bytes(10), octets))
    with suppress(TedsProvisionError):
        assert security.decode(octets).encode() == octets


def security_seeds() -> Iterable[bytes]:
    from teds_provision.teds.codec import security

    made = security.initial(b"\4" + bytes(64), bytes(64), sequence=1, key_epoch=2)
    yield made[4:-2]


# -- frames ------------------------------------------------------------------------------------------------------------


def check_frames(data: bytes) -> None:
    """Frames of commands and replies, and the payloads of the profile."""
    from teds_provision.protocol.messages import frames
    from teds_provision.protocol.messages.identity import Identity
    from teds_provision.protocol.messages.message import decode_message, looks_like_message

    looks_like_message(data)
    decode_message(data)
    reads(
        lambda: frames.decode_reply(data),
        lambda: frames.TedsStatus.decode(data),
        lambda: frames.decode_list(data),
        lambda: Identity.decode(data),
    )


def frame_seeds() -> Iterable[bytes]:
    from teds_provision.protocol.messages import frames
    from teds_provision.protocol.messages.identity import Identity, NodeState

    yield frames.read_teds(1, 3, 0).encode()
    yield frames.Reply(True, bytes(12)).encode()
    yield frames.TedsStatus(1, 60, 0xABCD, 4000).encode()
    yield Identity(bytes(10), NodeState.KEYED, 1, 2, 4094, 33).encode()
    for file in sorted(VECTORS.glob("*/m*.hex"))[:30]:
        with suppress(ValueError):
            yield bytes.fromhex(file.read_text().partition("#")[0])


def check_operation(data: bytes) -> None:
    """Payloads and data frames of measurement operation, as node and as station."""
    from teds_provision.protocol.messages.frames import CommandRefusedError
    from teds_provision.protocol.operation import can_frames, commands, datagram

    for read in (
        lambda: commands.OperateCommand.decode(1, data, actuator=True),
        lambda: commands.OperateCommand.decode(1, data, actuator=False),
        lambda: commands.OperationReply.decode(data),
        lambda: commands.SampleReply.decode(data, 4),
        lambda: commands.PowerReply.decode(data),
        lambda: commands.decode_data_set(data, 2),
        lambda: commands.channel_list(data, 16),
        lambda: datagram.DatagramSealer(bytes(16)).open(data),
    ):
        with suppress(TedsProvisionError, CommandRefusedError):
            read()
    can_frames.read_ble_frame(data)
    assembly = can_frames.StreamAssembly(63, fd=bool(data[:1] and data[0] & 1))
    for at in range(1, len(data), 9):
        found = assembly.add_segment(data[at] & 7, data[at + 1 : at + 9])
        assert found is None or len(found) == 63


def check_nfc(data: bytes) -> None:
    """NDEF messages, the pieces in them and TNEP; both halves of a transaction."""
    from teds_provision.links.nfc import message, pieces, tnep

    records: tuple[message.NdefRecord, ...] = ()
    with suppress(TedsProvisionError):
        records = message.decode(data)
        assert message.decode(message.encode(records)) == records
    tnep.our_service(records)
    reads(lambda: tnep.selection(records), lambda: tnep.status_of(records), lambda: tnep.ServiceParameters.decode(data))
    requester = pieces.Requester(data[0] if data else 0, b"command" * 20, 30)
    responder = pieces.Responder(lambda _transaction, frame: frame[::-1])
    for record in [*(record.payload for record in records), data]:
        with suppress(TedsProvisionError):
            piece = pieces.Piece.decode(record)
            reads(partial(requester.handle_piece, piece), partial(responder.answer, piece, 20))
    _pieces_without_checksum(data, requester, responder)


def _pieces_without_checksum(data: bytes, requester: Requester, responder: Responder) -> None:
    """The rest as pieces ``transaction u8 ‖ total u8 ‖ offset u8 ‖ flags u8 ‖ length u8 ‖ body``, checksums right."""
    at = 0
    while at + 5 <= len(data):
        transaction, total, offset, flags, length = data[at : at + 5]
        body = data[at + 5 : at + 5 + length]
        at += 5 + length
        piece = Piece(transaction, total, offset, body, bool(flags & 1), bool(flags & 2))
        with suppress(TedsProvisionError):
            read = Piece.decode(piece.encode())
            reads(partial(requester.handle_piece, read), partial(responder.answer, read, 20))
    requester.next()


def nfc_seeds() -> Iterable[bytes]:
    from teds_provision.links.nfc import message, pieces, tnep

    first = pieces.Piece(1, 20, 0, b"twenty octets of it!", answer=True)
    yield message.encode([tnep.status(0), tnep.payload_record(first.encode())])
    yield message.encode([tnep.ServiceParameters(b"urn:nfc:sn:x", 20, 3, 500).record(), tnep.id_record(bytes(23))])
    yield message.encode([tnep.select(b"urn:nfc:sn:x")])
    yield first.encode()


def check_can(data: bytes) -> None:
    """ISO-TP as a stranger drives it: pieces ``kind u8 ‖ length u8 ‖ data``, to a gathering and to a pair."""
    from teds_provision.links.can import isotp
    from teds_provision.links.can.bus import Frame
    from teds_provision.links.can.bus_multiplexer import BroadcastReplies

    logging.getLogger("isotp").setLevel(logging.CRITICAL)
    gathering, sent = BroadcastReplies(0xF1, 7), []
    pair = isotp.Pair(0xF1, 0x21, sent.append)
    at = 0
    while at + 2 <= len(data):
        kind, length = data[at], data[at + 1] % 65
        octets = data[at + 2 : at + 2 + length]
        at += 2 + length
        node = 0x21 + (kind >> 1 & 3)
        frame = Frame(isotp.physical_id(0xF1, node), octets, bool(kind & 1))
        gathering.add_frame(frame)
        pair.handle_frame(frame)
        pair.received()
    isotp.read_single(data)


def check_smp(data: bytes) -> None:
    """SMP packets: the body as CBOR, and the virtual node's filter before its manager.

    The input is a packet, and pieces ``command u8 ‖ length u8 ‖ body`` that get a right header, of two sessions.
    """
    from teds_provision.protocol.messages.frames import CommandRefusedError
    from teds_provision.protocol.messages.smp import LISTED, decode_map
    from teds_provision.protocol.tim.manage import ManageFilter

    with suppress(ValueError):
        decode_map(data)
    manager = _NotingManager(on_trial=bool(data and data[-1] & 1))
    now = 0.0
    filtered = ManageFilter(manager, lambda: now, 2048, claimed=lambda: False, staged_elsewhere=lambda session: None)

    def run(packet: bytes, session: object) -> None:
        with suppress(CommandRefusedError):
            decode_packet(filtered.run(packet, session, "can:f1"))  # type: ignore[arg-type]

    run(data, None)
    listed, sessions, at = sorted(LISTED), ("one", "other"), 0
    while at + 2 <= len(data):
        kind, length = data[at : at + 2]
        run(
            SmpPacket(listed[kind & 7], 7, data[at + 2 : at + 2 + length], whole=True).encode(), sessions[kind >> 3 & 1]
        )
        now += kind >> 4
        at += 2 + length
    for got in manager.got:
        assert got.command in LISTED
        decode_map(got.body)


@dataclass
class _NotingManager:
    """A board's manager that notes what reached it, and answers with the body of the request."""

    on_trial: bool
    offered: bool = True
    pending: bool = False
    buffer: int = 1024
    got: list[SmpPacket] = field(default_factory=list)

    def manage(self, packet: bytes) -> bytes:
        """Note a packet."""
        self.got.append(decode_packet(packet))
        return self.got[-1].reply(self.got[-1].body).encode()

    def restart(self) -> None:
        """Nothing restarts: no reply leaves."""


def smp_seeds() -> list[bytes]:
    """Return a packet of each listed command."""
    bodies = ("a0", "a16764", "a167636f6e6669726df5", "a4636f66660063646174614178636c656e0963736861410a")
    heads = ("0800000100000706", "0a00000100000700", "0a00000b00010700", "0a00001800010701")
    upload = bytes.fromhex(bodies[-1])
    pieces = (b"\x07", b"\x0f", b"\xf7")  # uploads of one session, of the other, of the first much later
    return [
        *(bytes.fromhex(head + body) for head, body in zip(heads, bodies, strict=True)),
        b"".join(piece + bytes([len(upload)]) + upload for piece in pieces),
    ]


def check_update(data: bytes) -> None:
    """A board that answers the station's update: ``request u8`` (which call; bits 6, 7: how a header is bent), then
    replies ``length u8 ‖ body``, the last one again and again. The upload ends, whatever comes."""
    from teds_provision.links.ports import Contact
    from teds_provision.protocol.messages.identity import Identity, NodeState
    from teds_provision.provisioning.conversation import Conversation
    from teds_provision.provisioning.image_manager import ImageManager

    if not data:
        return
    board = _AnsweringBoard(data)
    identity = Identity(bytes(10), NodeState.KEYED, 1, 2, 1024, 33)
    node = Conversation(Contact(identity, board), notice=lambda notice: None)
    node.request = board.reply  # type: ignore[method-assign, assignment]
    images = ImageManager(node)
    calls = (
        images.images,
        images.confirm,
        lambda: images.start_next(bytes(32)),
        lambda: images.upload(bytes(3000), lambda done, whole: None),
    )
    reads(calls[data[0] & 3])
    assert board.requests < 3000


class _AnsweringBoard:
    """A board behind an open session; also the link to it, which carries nothing else."""

    def __init__(self, data: bytes) -> None:
        from teds_provision.links.ports import CAN

        self.via, self.capabilities = "can", CAN
        self.requests, self._bent, self._bodies, at = 0, data[0] >> 6, list[bytes](), 1
        while at < len(data):
            self._bodies.append(data[at + 1 : at + 1 + data[at]])
            at += 1 + data[at]

    def reply(self, command: Command, doing: str) -> bytes:
        """Answer a packet with the next body, under the header that it is due."""
        del doing
        self.requests += 1
        body = self._bodies.pop(0) if len(self._bodies) > 1 else (self._bodies or [b""])[0]
        if self._bent == 1:
            return body
        packet = decode_packet(command.payload)
        due = packet.reply(body)._replace(sequence=packet.sequence ^ (self._bent == 2)).encode()
        return due + b"\0" if self._bent == 3 else due

    def exchange(self, frame: bytes) -> bytes:
        """Carry nothing: the link is lost."""
        raise NodeSilentError(f"No reply to {len(frame)} octets.")

    def close(self) -> None:
        """Nothing is left behind."""


def update_seeds() -> list[bytes]:
    """Replies of an image manager: buffer size and upload; images; an error of either form."""
    from teds_provision.protocol.messages.smp import encode_map

    image = {"slot": 0, "version": "1.0.0", "hash": bytes(32), "bootable": True, "active": True, "confirmed": True}
    size, state = {"buf_size": 600, "buf_count": 1}, {"images": [image], "splitStatus": 0}
    uploaded = [{"off": off} for off in (547, 1094, 1641, 2188, 2735)]
    good = (
        (3, size, *uploaded, {"off": 3000, "match": True}),
        (3, size, {"off": 0}),
        (0, state),
        (1, state),
        (2, state),
    )
    bad = ((0, {"rc": 3}), (2, {"err": {"group": 1, "rc": 8}}), (3, size, {"rc": 0, "off": 9}))
    return [
        bytes([call]) + b"".join(bytes([len(body)]) + body for body in map(encode_map, bodies))
        for call, *bodies in (*good, *bad)
    ]


def check_about(data: bytes) -> None:
    """Replies to About and Locate, and what the station keeps and shows of one."""
    from teds_provision.protocol.messages.firmware import FirmwareReport
    from teds_provision.provisioning.update import version_of

    with suppress(TedsProvisionError):
        report = FirmwareReport.decode(data)
        assert FirmwareReport.decode(report.encode()) == report
        assert len(report.text) <= 48
        version_of(report)


def about_seeds() -> list[bytes]:
    """Return two reports: with an image and without."""
    from teds_provision.protocol.messages.firmware import FirmwareFlag, FirmwareReport

    full = FirmwareReport("nrf52840dk/nrf52840/loadcell", (3, 2, 1), 7, bytes(range(32)), FirmwareFlag.LOCATE)
    return [full.encode(), FirmwareReport().encode()]


def check_firmware(data: bytes) -> None:
    """A firmware image file."""
    from teds_provision.firmware_image import read_firmware_image

    reads(lambda: read_firmware_image(data))


def firmware_seeds() -> list[bytes]:
    """Return an image without signature: header, payload, digest."""
    import hashlib

    head = struct.pack("<IIHHIIBBHII", 0x96F3B83D, 0, 32, 0, 8, 0, 1, 2, 3, 4, 0) + bytes(8)
    return [head + struct.pack("<HHHH", 0x6907, 40, 0x10, 32) + hashlib.sha256(head).digest()]


def can_seeds() -> Iterable[bytes]:
    yield b"\0\x08\x06\7hello\0"
    yield b"\0\x08\x10\x14\7abcde" + b"\0\x08\x21abcdefg" + b"\0\x08\x22abcdefg"
    yield b"\1\x40\x10\x60\7" + bytes(61) + b"\1\x40\x21" + bytes(63)
    yield b"\0\x08\x30\0\0\0\0\0\0\0"


# -- signed and sealed documents ------------------------------------------------------------------------------------


@cache
def _key(number: int) -> SoftwareKey:
    return SoftwareKey.from_secret(number.to_bytes(32, "big"))


def _trusted(kid: str) -> bytes | None:
    from teds_provision.protocol.keys import fingerprint

    points = [_key(n).point for n in (1, 2)]
    return next((point for point in points if fingerprint(point) == kid), None)


def check_bundle(data: bytes) -> None:
    """A bundle from outside in; even first octet: the sealed file, odd: what stands inside, under a right signature."""
    from teds_provision.protocol.handover import bundle, jose

    if not data:
        return
    body = data[1:]
    if data[0] & 1:
        reads(lambda: bundle.from_json(bytearray(body)))
    else:
        reads(
            lambda: bundle.peek_bundle(body),
            lambda: bundle.open_bundle(body, _key(1), _trusted, NOW),
            lambda: jose.verify_compact(body, _trusted, typ=bundle.TYPE, max_octets=1 << 16),
        )


def bundle_seeds() -> Iterable[bytes]:
    from teds_provision.protocol.handover import bundle
    from teds_provision.protocol.keys import fingerprint

    first, other = _key(1), _key(2)
    whole = bundle.Bundle(
        id="A" * 22,
        sender=fingerprint(first.point),
        to=(fingerprint(other.point),),
        created=NOW,
        expires=NOW + timedelta(days=1),
        mode="copy",
        ca=first.point,
        nodes=(bundle.BundledNode(bytes(10), first.point, bytes(16), 1, 5, name="x", teds_sha256="0" * 64),),
    )
    yield b"\0" + bundle.seal_bundle(whole, first, [other.point])
    yield b"\1" + bundle.payload_of(whole)


def check_receipt(data: bytes) -> None:
    """Receipts and revocations; even first octet: the signed text, odd: the members under a right signature."""
    from teds_provision.protocol.handover import jose, receipt, revocation

    if not data:
        return
    body = data[1:]
    for module, open_it in (
        (receipt, lambda octets: receipt.open_receipt(octets, _trusted)),
        (revocation, lambda octets: revocation.open_revocation(octets.decode("latin-1"), _trusted)),
    ):
        if data[0] & 1:
            signed = jose.sign_compact(body, _key(1), typ=module.TYPE)
            reads(lambda open_it=open_it, signed=signed: open_it(signed))  # type: ignore[misc]
        else:
            reads(lambda open_it=open_it: open_it(body))  # type: ignore[misc]


def receipt_seeds() -> Iterable[bytes]:
    from teds_provision.protocol.handover import receipt, revocation
    from teds_provision.protocol.handover.strict_json import dump
    from teds_provision.protocol.keys import fingerprint

    key = _key(1)
    sender = fingerprint(key.point)
    statement = revocation.seal_revocation(key, uuid=bytes(10), node=None, why="lost", created=NOW)
    yield b"\0" + statement.statement.encode()
    members = {"format": receipt.FORMAT, "id": "0" * 32, "bundle_sha256": "0" * 64, "from": sender, "to": sender}
    members |= {
        "imported": ["00" * 10],
        "refused": [{"uuid": "11" * 10, "why": "no"}],
        "created": "2026-11-21T00:00:00Z",
    }  # type: ignore[dict-item]
    yield b"\1" + dump(members)


def check_backup(data: bytes) -> None:
    """A backup: its sealed chunks, its head, and the dump of rows behind right seals."""
    from teds_provision.backup import chunks, content, sealed_file
    from teds_provision.station.store.dump import load

    if not data:
        return
    kind, body = data[0] % 3, data[1:]
    if kind == 0:
        reader = chunks.ChunkReader(BytesIO(body), bytes(32), b"")
        reads(lambda: reader.read(len(body)), reader.require_end)
    elif kind == 1:
        reads(lambda: content.BackupHead.read(body, sealed_file.FORMAT))
    else:
        out = BytesIO()
        writer = chunks.ChunkWriter(out, bytes(32), b"")
        writer.write(body)
        writer.end()
        with suppress(TedsProvisionError):
            load(chunks.ChunkReader(BytesIO(out.getvalue()), bytes(32), b"")).close()


def backup_seeds() -> Iterable[bytes]:
    from teds_provision.backup import sealed_file
    from teds_provision.backup.content import BackupHead
    from teds_provision.station.store.schema import SCHEMA_VERSION

    head = BackupHead("0" * 32, _key(1).point, "x", "2026-11-21T00:00:00Z", "file", "{}")
    yield b"\1" + head.line(sealed_file.FORMAT)
    tables = {"whitelist": ["uuid", "fingerprint"], "setting": ["name", "value"]}
    row = struct.pack(">BI", 0, 20) + b"\3" + struct.pack(">I", 10) + bytes(10) + b"\0"
    yield b"\3" + json.dumps({"schema": SCHEMA_VERSION, "tables": tables}).encode() + b"\n" + row + b"\xff" + bytes(4)
    yield b"\3" + json.dumps({"schema": SCHEMA_VERSION, "tables": {}}).encode() + b"\n\xff" + bytes(4)


# -- files -------------------------------------------------------------------------------------------------------------


def check_whitelist(data: bytes) -> None:
    """Whitelists that other people write: XML, CSV, JSON by the first octet."""
    from teds_provision.provisioning import whitelist

    if not data:
        return
    readers = (whitelist._read_xml, whitelist._read_csv, whitelist._read_json)
    reads(lambda: readers[data[0] % 3](as_text(data[1:]), whitelist._WhitelistReader("list")))


def whitelist_seeds() -> Iterable[bytes]:
    uuid, pin = "0x00112233445566778899", "ab" * 32
    yield f'\0<whitelist><transducer uuid="{uuid}" fingerprint="{pin}" name="a"/></whitelist>'.encode()
    yield f"\0<list><uuid>{uuid}</uuid><node><uuid>{uuid}</uuid><name>b</name></node></list>".encode()
    yield f"\1uuid;fingerprint;name\n{uuid};{pin};a\n".encode()
    yield f'\2{{"whitelist": [{{"uuid": "{uuid}", "fingerprint": "{pin}"}}, "{uuid}"]}}'.encode()


@cache
def _profile() -> object:
    from teds_provision.teds.profile import load_profile

    return load_profile("tactile-finger-sensor")


def check_calibration(data: bytes) -> None:
    """Files of calibrations: CSV, TOML, JSON by the first octet."""
    from teds_provision.teds.calibration import read_calibrations

    if not data:
        return
    name = ("c.csv", "c.toml", "c.json")[data[0] % 3]
    reads(lambda: read_calibrations(as_text(data[1:]), name, _profile()))  # type: ignore[arg-type]


def calibration_seeds() -> Iterable[bytes]:
    yield b"\0# channel: 1\n# method: table\n# unit: N\nraw, value\n0, 0\n100, 1.5\n65535, 10\n"
    yield b"\0channel;from;to;offset;c0;c1\n1;0;512;0;0,5;0,001\n1;512;1024;512;1;0,002\n"
    yield b"\1channel = 1\nmethod = 'polynomial'\ndegree = 2\ndate = 2026-01-01\npoints = [[0, 0], [1, 1], [3, 9]]\n"
    yield b"\1channel='all'\ncoefficients=[1,2]\n[[inputs]]\nchannel=1\ndegree=1\nboundaries=[0,9]\noffsets=[0]\n"
    yield b'\2{"channel": "1-3", "slope": 0.001, "intercept": 0, "interval": "1 year", "uncertainty": "5 mN"}'


def check_certificate(data: bytes) -> None:
    """Calibration certificates: read, their signature checked, a calibration made of the first item that fits."""
    from teds_provision.teds.calibration.files import read_certified
    from teds_provision.teds.certificate import CertificateChoice
    from teds_provision.teds.dcc.shown import ShownCertificate
    from teds_provision.teds.dcc.signature import read_checked
    from teds_provision.teds.profile import load_profile

    choice = CertificateChoice(choose=lambda _, items: items[0][0])
    with suppress(TedsProvisionError):
        shown = ShownCertificate.from_certificate(read_checked(data, "c.xml", (), NOW))
        json.dumps(shown.to_json(), allow_nan=False)
        list(shown.lines())
        made = read_certified(data, "c.xml", load_profile("magnetic-angular-position-sensor"), choice)[1]
        assert made.certificate is not None
        assert made.certificate.signature == "not checked", "nobody is trusted here"
        assert len(made.certificate.encode()) < 300


def certificate_seeds() -> Iterable[bytes]:
    folder = Path(__file__).parents[2] / "examples" / "dcc"
    for name in ("angle.xml", "temperature.xml"):
        text = (folder / name).read_text()
        small = "".join(line.strip() for line in text.splitlines() if "<!--" not in line)
        yield small.encode()
        yield small.replace("dcc:", "").replace("xmlns:dcc", "xmlns").encode()


def check_profile(data: bytes) -> None:
    """Profiles, and the sheets of ``--require``."""
    from teds_provision.teds.fits import parse_require
    from teds_provision.teds.formats.profileform import read_profile

    text = as_text(data)
    reads(lambda: read_profile(text), lambda: parse_require(text, "task.toml"))


def profile_seeds() -> Iterable[bytes]:
    for path in sorted((Path(__file__).parents[2] / "profiles").glob("*.toml"))[:4]:
        yield path.read_bytes()
    yield b"[angle]\nrange = '>= 360 deg'\nuncertainty = '1 deg'\nrate = '1 kHz'\n"


def check_image(data: bytes) -> None:
    """Every file of TEDS that is told apart by its content: image, JSON, XML, hex, Intel HEX, binary."""
    from teds_provision.teds.formats import detect, read_blocks, write_blocks
    from teds_provision.teds.image import Image
    from teds_provision.teds.sheet import Sheet

    with suppress(TedsProvisionError):
        Sheet.from_image(Image.from_json(data))
    with suppress(TedsProvisionError):
        kind = detect(data)
        blocks = read_blocks(data, kind)
        if kind in ("hex", "json", "xml") and blocks:
            written = write_blocks(blocks, "hex")
            assert isinstance(written, str)
            assert read_blocks(written.encode(), "hex") == blocks


def image_seeds() -> Iterable[bytes]:
    from teds_provision.teds.formats import TedsBlock, write_blocks
    from teds_provision.teds.profile import load_profile

    built = load_profile("magnetic-angular-position-sensor").build(bytes(10)).blocks
    blocks = [TedsBlock(channel, code, teds) for (channel, code), teds in built.items() if code in (1, 12)]
    for form in ("image", "json", "xml", "hex", "ihex", "binary"):
        written = write_blocks(blocks, form)  # type: ignore[arg-type]
        yield written if isinstance(written, bytes) else written.encode()


def check_units(data: bytes) -> None:
    """Units, times and ``--fits`` expressions."""
    from teds_provision.teds.fits import parse_fits
    from teds_provision.teds.units import parse_seconds, parse_unit

    text = as_text(data)
    reads(lambda: parse_unit(text), lambda: parse_seconds(text), lambda: parse_fits(text))


def unit_seeds() -> Iterable[bytes]:
    for text in ("m/s²", "kg*m^2/s^2", "mV/V", "degC", "100 us", "10 kHz", "V/(m*K)", "1/s"):
        yield text.encode()
    yield b"angle >= 360 deg, uncertainty <= 1 deg, rate >= 1 kHz"


def check_evidence(data: bytes) -> None:
    """Evidence; first octet odd: a statement, which gets its envelope first, so that what is inside is reached."""
    import base64

    from teds_provision.protocol.plant import evidence

    if not data:
        return
    octets = data[1:]
    if data[0] & 1:
        signature = {"keyid": "0" * 64, "sig": "MAA="}
        whole = {"payload": base64.b64encode(octets).decode(), "payloadType": evidence.PAYLOAD_TYPE}
        octets = json.dumps({**whole, "signatures": [signature]}).encode()
    with suppress(TedsProvisionError):
        read = evidence.read(octets)
        assert evidence.faults(read, SoftwareKey(3).point), "nobody signed this"


def evidence_seeds() -> Iterable[bytes]:
    from base64 import b64decode

    kept = (VECTORS / "profile" / "plant_kat.json").read_bytes()
    file = json.loads(kept)["evidence"]["file"]
    statement = json.loads(b64decode(json.loads(file)["payload"]))
    statement["predicate"]["node"]["teds"] = "00" * 20
    yield b"\0" + file.encode()
    yield b"\1" + json.dumps(statement, separators=(",", ":")).encode()


def check_plant(data: bytes) -> None:
    """Rosters, pages and requests: the first octet says which; a payload, which a key signs first. Then the fold."""
    from teds_provision.protocol.handover import jose
    from teds_provision.protocol.plant import claim, document, event, merged_claims, page, roster

    if not data:
        return
    key = SoftwareKey(3)
    kinds = (document.ROSTER, document.PAGE, document.MEMBER_REQUEST)
    kind = kinds[data[0] % 3]
    octets = jose.sign_compact(data[1:], key, typ=kind.typ) if data[0] & 0x80 else data[1:]
    with suppress(TedsProvisionError):
        if kind is document.ROSTER:
            read = roster.open_roster(octets, key.point)
            assert roster.taking(read, None, read.registry)[0] == "taken"
            assert merged_claims.merge_claims(read, {}, merged_claims.LocalState("f" * 64)).key_it
        elif kind is document.PAGE:
            opened = page.open_page(octets, "6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29", lambda kid: key.point)
            gathered = claim.Claim()
            for stated in map(event.read, opened.events):
                if isinstance(stated, event.Event):
                    gathered.apply_event(stated)
            assert claim.Claim.from_json(gathered.to_json()) == gathered
        else:
            document.open_request(octets)


def plant_seeds() -> Iterable[bytes]:
    from base64 import urlsafe_b64decode

    kept = json.loads((VECTORS / "profile" / "plant_kat.json").read_bytes())["documents"]
    for name, first in (("roster 2", 0), ("west 1", 1), ("north 1", 1), ("west 2", 1), ("member-request", 2)):
        text = kept[name]["jws"].split(".")[1]
        payload = urlsafe_b64decode(text + "=" * (-len(text) % 4))
        yield bytes([first]) + kept[name]["jws"].encode()
        record = json.loads(payload)
        if "station" in record:
            record["station"] = fingerprint(SoftwareKey(3).point)
        if "point" in record:
            record["point"] = SoftwareKey(3).point.hex()
        if "members" in record:
            record["members"], record["share"] = [], []
            record["removed"][0]["point"] = SoftwareKey(4).point.hex()
        yield bytes([_signed(first)]) + json.dumps(record, separators=(",", ":")).encode()


def _signed(kind: int) -> int:
    """Return the first octet that asks for this kind, signed."""
    return next(first for first in range(0x80, 0x84) if first % 3 == kind)


def check_line(data: bytes) -> None:
    """Jobs, sign requests and answers: the first octet says which; a payload, which a key signs first."""
    from teds_provision.protocol.handover import jose
    from teds_provision.protocol.plant import document, job, signing

    if not data:
        return
    kinds = (document.JOB, job.open_job), (document.SIGN_REQUEST, signing.open_request)
    kind, reader = (*kinds, (document.SIGNED, signing.open_answer))[data[0] % 3]
    key = SoftwareKey(3)
    octets = jose.sign_compact(data[1:], key, typ=kind.typ) if data[0] & 0x80 else data[1:]
    with suppress(TedsProvisionError):
        read = reader(octets, lambda kid: key.point)
        if isinstance(read, job.Job):
            assert job.open_job(job.seal_job(read, key), lambda kid: key.point).unsigned() == read.unsigned()
        elif isinstance(read, signing.SignRequest):
            again = signing.open_request(signing.seal_request(read, key), lambda kid: key.point)
            assert again.unsigned() == read.unsigned()
        else:
            assert isinstance(read, signing.Answer)
            assert signing.open_answer(signing.seal_answer(read, key), lambda kid: key.point) == read


def line_seeds() -> Iterable[bytes]:
    from base64 import urlsafe_b64decode

    documents = json.loads((VECTORS / "profile" / "plant_kat.json").read_bytes())["documents"]
    for number, name in enumerate(("job", "sign-request", "signed")):
        text = documents[name]["jws"].encode()
        first = number + 3 * ((0x80 - number + 2) // 3)
        yield bytes([number]) + text
        yield bytes([first]) + urlsafe_b64decode(text.split(b".")[1] + b"==")


_JSON = ("{", "}", "[", "]", '"', ":", ",", "null", "true", "1e9")
_TOML = ("[[", "]]", "[channel.1]", " = ", '"""', "'", "extends", "unit", "points", "calibration", "inf", "nan")
_XML = ("<", "/>", "</", "<!DOCTYPE", "<![CDATA[", "&#0;", "uuid=", "<teds", "<field", "xmlns=")
_DCC = ("dcc:list", "dcc:quantity", "si:hybrid", "si:realListXMLList", "\\one", "\\tothe{2}", "URI=''", "ds:Signature")

TARGETS = {
    target.name: target
    for target in (
        Target("teds", check_teds, lambda: [b"\1\3\4\0\1\1\1"], longest=1024),
        Target("sheet", check_sheet, sheet_seeds, longest=1024),
        Target("security", check_security, security_seeds),
        Target("frames", check_frames, frame_seeds),
        Target("operation", check_operation, lambda: [bytes(8), bytes(20), b"\0" + bytes(26)]),
        Target("nfc", check_nfc, nfc_seeds, ("Tp", "Ts", "Te", "urn:nfc:sn:")),
        Target("can", check_can, can_seeds, longest=1024),
        Target("smp", check_smp, smp_seeds, ("off", "len", "sha", "data", "hash", "confirm"), longest=1024),
        Target("update", check_update, update_seeds, ("off", "rc", "err", "images", "buf_size", "match"), longest=1024),
        Target("about", check_about, about_seeds, longest=128),
        Target("firmware", check_firmware, firmware_seeds, longest=512),
        Target("bundle", check_bundle, bundle_seeds, (*_JSON, "protected", "recipients", "nodes", "alg", "kid")),
        Target("receipt", check_receipt, receipt_seeds, (*_JSON, "imported", "refused", "format", ".")),
        Target("backup", check_backup, backup_seeds, (*_JSON, "schema", "tables")),
        Target("whitelist", check_whitelist, whitelist_seeds, (*_JSON, *_XML, "whitelist", "fingerprint", ";", "\t")),
        Target("calibration", check_calibration, calibration_seeds, (*_JSON, *_TOML, "# unit:", "method", "all")),
        Target("certificate", check_certificate, certificate_seeds, (*_XML, *_DCC), longest=8192),
        Target("profile", check_profile, profile_seeds, _TOML, longest=2048),
        Target("image", check_image, image_seeds, (*_JSON, *_XML, ":00000001FF", "# channel 1 access code 3")),
        Target("evidence", check_evidence, evidence_seeds, (*_JSON, "facts", "steps", "blocks", "subject", "teds:")),
        Target(
            "plant", check_plant, plant_seeds, (*_JSON, "members", "roles", "events", "act", "heads", "share", "last")
        ),
        Target("line", check_line, line_seeds, (*_JSON, "nodes", "list", "rule", "image", "refused", "stations")),
        Target("units", check_units, unit_seeds, ("**", "^", "·", "/", "deg", "count", ">=", "<=", "rate", "²")),
    )
}
