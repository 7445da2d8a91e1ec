"""Rules of boards with channels (operation.md): claims, values, streams, Drive and trigger, in sessions.

A channel can be claimed only while a Channel TEDS that fits it is stored. A board that has none is given one for this
stage if TEDS may be written: the usual formats are tried in turn. :func:`restore` commits the former TEDS again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from teds_provision.check import slips
from teds_provision.check.probe import NotApplicableError, Probe, RuleBrokenError, demand, holds
from teds_provision.check.rule import OPERATION_PAGE, Stage, rule
from teds_provision.check.write_rules import commit_blocks, stored_blocks
from teds_provision.errors import BadDataError, GarbledError
from teds_provision.links.ports import BusFrames
from teds_provision.protocol.messages.frames import Function as SecurityFunction
from teds_provision.protocol.messages.frames import (
    Reason,
    Reply,
    security_command,
    update_teds,
    write_teds,
)
from teds_provision.protocol.messages.tables import describe_command, describe_reply
from teds_provision.protocol.operation.can_frames import (
    DriveAddress,
    StreamAssembly,
    cut,
    data_address,
    trigger_identifier,
)
from teds_provision.protocol.operation.commands import (
    DIGEST_OCTETS,
    OPERATION,
    TEST_PATTERN,
    ChannelState,
    OperateCommand,
    OperationReply,
    decode_data_set,
    idle,
    read_data_set,
    sample,
)
from teds_provision.protocol.operation.datagram import (
    DatagramSealer,
    DriveValues,
    drive_key,
    drive_length,
    pattern,
    stream_key,
)
from teds_provision.protocol.operation.stream_commands import (
    CLOCK,
    NONE,
    SOON,
    Action,
    ClockReply,
    DriveReply,
    StreamKind,
    SubscribeCommand,
    SubscribeReply,
    decode_stopped,
    drive,
    message_length,
    stop,
)
from teds_provision.protocol.operation.timing import TriggerToken
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.image import SECURITY
from teds_provision.teds.sheet import ChannelKind, channel_from

_FORMATS: Final = ((0, 2), (0, 4), (0, 1), (0, 3), (1, 4), (2, 8), (0, 8))
"""DatModel and ModLenth that most channels have, in the order in which they are tried."""
_PERIODS: Final = (50, 500, 5000)
"""ms; the first that the firmware takes."""
_MESSAGES: Final = 3
_LEASE: Final = 30
_SHORT_LEASES: Final = (1, 4, 12)
"""Seconds of leases that are left to expire; the first that is longer than an exchange takes."""
_AFTER_LEASE: Final = 0.4
_DEAD_MAN: Final = 2000
"""ms; a replayed value is sent after 0.6 of it, and looked for after 1.3."""
_MOST_LATE: Final = 100


def channel_teds(kind: ChannelKind, model: int, octets: int) -> bytes:
    """Return the smallest Channel TEDS that allows a claim: ChanType, DatModel, ModLenth, SigBits."""
    block = bytes([3, 4, 0, AccessCode.CHANNEL, 1, 1, 11, 1, int(kind)])
    return frame(block + bytes([18, 9, 40, 1, model, 41, 1, octets, 42, 1, min(255, 8 * octets)]))


# -- channels that can be claimed --------------------------------------------------------------------------------------


def _operation(probe: Probe) -> OperationReply:
    try:
        return OperationReply.decode(probe.sealed_good(OPERATION))
    except GarbledError as error:
        raise RuleBrokenError(f"Operation (128.19): {error.message}") from None


def _digest(probe: Probe) -> bytes:
    return hashlib.sha256(probe.teds(SECURITY)).digest()[:DIGEST_OCTETS]


def _operate(probe: Probe, channel: int, lease: int, dead_man: int = _DEAD_MAN, digest: bytes = b"") -> Reply:
    acting = channel and probe.channels.get(channel, (ChannelKind.SENSOR, 0))[0] is ChannelKind.ACTUATOR
    asked = OperateCommand(channel, digest or _digest(probe), lease, dead_man if acting else None)
    return probe.sealed(asked.command())


def _kind(state: ChannelState) -> ChannelKind:
    if state & ChannelState.ACTUATOR:
        return ChannelKind.ACTUATOR
    return ChannelKind.EVENT_SENSOR if state & ChannelState.EVENT_SENSOR else ChannelKind.SENSOR


def _fits(probe: Probe, channel: int, kind: ChannelKind, digest: bytes) -> bool:
    """Send Operate with a lease of 0, checked after the TEDS and before any claim: 6 on a mismatch, else 19."""
    acting = kind is ChannelKind.ACTUATOR
    reply = probe.sealed(OperateCommand(channel, digest, 0, 0 if acting else None).command())
    if reply.ok:  # the rule operate-lease reports this
        probe.sealed_good(idle())
    return reply.reason != Reason.DIGEST_MISMATCH


def channels(probe: Probe) -> dict[int, tuple[ChannelKind, int]]:
    """Return kind and ModLenth of each channel that can be claimed; raises NotApplicableError if there is none.

    A board without Channel TEDS gets one if TEDS may be written: :func:`restore` removes it again.
    """
    if probe.channels:
        return probe.channels
    if probe.no_channels:
        raise NotApplicableError(probe.no_channels)
    if probe.sealed(OPERATION).reason == Reason.UNKNOWN_COMMAND:
        probe.no_channels = "The board does not measure (Operation gets 1): build its firmware with a channel."
        raise NotApplicableError(probe.no_channels)
    kinds = {channel: _kind(state) for channel, (state, _) in _operation(probe).channels.items()}
    try:
        probe.channels = _fitting(probe, kinds)
    except RuleBrokenError as broken:
        probe.no_channels = f"No channel can be claimed: {broken}"
        raise
    if not probe.channels:
        probe.no_channels = f"No Channel TEDS fits any of its {len(kinds)} channels. {_cure(probe)}"
        raise NotApplicableError(probe.no_channels)
    return probe.channels


def _cure(probe: Probe) -> str:
    if probe.keep is None:
        return "Provision the board with its datasheet, or let the check write one: --factory"
    return "None of the usual formats fits either: provision the board with its datasheet, and leave --factory out."


def _fitting(probe: Probe, kinds: dict[int, ChannelKind]) -> dict[int, tuple[ChannelKind, int]]:
    listed = set(probe.listed())
    found, open_ones = {}, {}
    digest = _digest(probe)
    for channel, kind in kinds.items():
        block = (channel, int(AccessCode.CHANNEL))
        if block not in listed:
            open_ones[channel] = kind
        elif _fits(probe, channel, kind, digest):
            found[channel] = (kind, _octets(probe.teds(block)))
    if probe.keep is None or not open_ones:
        return found
    probe.own_blocks = stored_blocks(probe)
    blocks = dict(probe.own_blocks)
    for model, octets in _FORMATS:
        new = {
            (channel, int(AccessCode.CHANNEL)): channel_teds(kind, model, octets) for channel, kind in open_ones.items()
        }
        commit_blocks(probe, blocks | new, write=new)
        digest = _digest(probe)
        for channel, kind in list(open_ones.items()):
            if _fits(probe, channel, kind, digest):
                del open_ones[channel]
                found[channel] = (kind, octets)
                blocks |= {block: teds for block, teds in new.items() if block[0] == channel}
        if not open_ones:
            break
    return found


def _octets(teds: bytes) -> int:
    try:
        said = channel_from(decode(teds)).sample
    except BadDataError:
        return 0
    return said.octets if said is not None else 0


def restore(probe: Probe) -> None:
    """Commit the board's own TEDS again, if this stage has written others."""
    own, probe.own_blocks = probe.own_blocks, None
    probe.channels, probe.no_channels = {}, ""
    if own is not None:
        probe.close()
        commit_blocks(probe, own, write={})
        probe.close()


def _sensor(probe: Probe) -> int:
    """Return a sensor that can be claimed: one that samples by period if there is one, else an event sensor."""
    sensors = [channel for channel, (kind, _) in channels(probe).items() if kind is ChannelKind.SENSOR]
    events = [channel for channel, (kind, _) in channels(probe).items() if kind is ChannelKind.EVENT_SENSOR]
    if not sensors + events:
        raise NotApplicableError("No sensor can be claimed: build its firmware with one, whose Channel TEDS fits.")
    return (sensors + events)[0]


def _actuator(probe: Probe) -> tuple[int, int]:
    """Return an actuator that can be claimed, and its ModLenth."""
    acting = [(channel, octets) for channel, (kind, octets) in channels(probe).items() if kind is ChannelKind.ACTUATOR]
    if probe.keep is None:
        raise NotApplicableError("Claims an actuator: ask for it with --factory.")
    if not acting:
        raise NotApplicableError("No actuator can be claimed: build its firmware with one, whose Channel TEDS fits.")
    return acting[0]


@contextmanager
def _claimed(probe: Probe, channel: int, lease: int = _LEASE, dead_man: int = _DEAD_MAN) -> Iterator[None]:
    """Hold a claim on this channel; afterwards the session is closed, and with it every claim and stream."""
    reply = _operate(probe, channel, lease, dead_man)
    holds(reply.ok, f"Operate (4.1) of channel {channel}, sealed, lease {lease}: {describe_reply(reply)} came.")
    try:
        yield
    finally:
        probe.close()


# -- claims ------------------------------------------------------------------------------------------------------------


@rule("operate-lease", "1. A channel is claimed or idle", Stage.MEASURING, page=OPERATION_PAGE)
def operate_lease(probe: Probe) -> str:
    """Operate takes a lease of 1 to 60 s: 0, 61 and 255 get 19, with the digest of the datasheet that is there now."""
    channel = _sensor(probe)
    for lease in (0, 61, 255):
        answer = _operate(probe, channel, lease)
        if answer.ok:
            probe.sealed_good(idle())
        demand(answer, Reason.OUT_OF_RANGE, f"Operate (4.1) of channel {channel}, sealed, lease {lease}")
    probe.close()
    return "19 for a lease of 0, 61 and 255 s"


@rule("operate-digest", "1. A channel is claimed or idle", Stage.MEASURING, page=OPERATION_PAGE)
def operate_digest(probe: Probe) -> str:
    """Check that a claim proves that the datasheet was read: any digest but the present Security TEDS's gets 6."""
    channel, digest = _sensor(probe), _digest(probe)
    for at in (0, DIGEST_OCTETS - 1):
        wrong = digest[:at] + bytes([digest[at] ^ 1]) + digest[at + 1 :]
        reply = _operate(probe, channel, _LEASE, digest=wrong)
        if reply.ok:
            probe.sealed_good(idle())
        seen = demand(reply, Reason.DIGEST_MISMATCH, f"Operate (4.1), sealed, octet {at} of the digest changed")
    probe.close()
    return seen


@rule("operate-configuration", "1. A channel is claimed or idle", Stage.MEASURING, page=OPERATION_PAGE)
def operate_configuration(probe: Probe) -> str:
    """Check that a claim locks the datasheet: Write, Update and Set CAN address get 2 in the session that claims."""
    channel = _sensor(probe)
    block = (channel, int(AccessCode.CHANNEL))
    asked = [write_teds(*block, 0, b"\0"), update_teds(*block)]
    if address := probe.identity().can_address:
        asked.append(security_command(SecurityFunction.SET_CAN_ADDRESS, bytes([address])))
    with _claimed(probe, channel):
        for command in asked:
            seen = probe.sealed_refused(command, Reason.WRONG_STATE, f"channel {channel} claimed")
    return seen


@rule("operate-values", "2. One value at a time", Stage.MEASURING, page=OPERATION_PAGE)
def operate_values(probe: Probe) -> str:
    """Check that a channel that this session has not claimed gives no value: 2.

    A list with 0 or a channel twice gets 4.
    """
    channel = _sensor(probe)
    for command in (sample([channel]), read_data_set(channel)):
        probe.sealed_refused(command, Reason.WRONG_STATE, f"channel {channel} not claimed")
    with _claimed(probe, channel):
        for wrong in ([0], [channel, channel], []):
            probe.sealed_refused(sample(wrong), Reason.BAD_FORM, f"channels {wrong}")
        octets = channels(probe)[channel][1]
        came = probe.sealed_good(sample([channel]))
        holds(
            len(came) == 9 + octets, f"Sample (128.12) of channel {channel}: {len(came)} octets, {9 + octets} are due."
        )
        probe.sealed_good(idle(channel))
        return probe.sealed_refused(sample([channel]), Reason.WRONG_STATE, "after Idle")


@rule("operate-expires", "1. A channel is claimed or idle", Stage.MEASURING, page=OPERATION_PAGE)
def operate_expires(probe: Probe) -> str:
    """Check that a session without a good Sealed frame for its lease loses its claims, but remains open."""
    channel = _sensor(probe)
    for lease in _SHORT_LEASES:
        began = probe.now()
        with _claimed(probe, channel, lease=lease):
            state = _operation(probe).channels[channel][0]
            if not state & ChannelState.CLAIMED_HERE and probe.now() - began >= lease:
                continue  # the link took longer than the lease
            text = f"Operation (128.19): channel {channel} is not claimed here."
            holds(bool(state & ChannelState.CLAIMED_HERE), text)
            waited = lease + _AFTER_LEASE
            probe.pause(waited)
            after = _operation(probe)
            text = (
                f"Operation (128.19): channel {channel} is still claimed {waited:g} s after the last frame, with a"
                f" lease of {lease} s."
            )
            holds(not after.channels[channel][0] & ChannelState.CLAIMED_HERE, text)
            holds(not after.measuring, "Operation (128.19): the node measures, and no channel is claimed.")
        return f"a lease of {lease} s ends the claim"
    raise NotApplicableError(f"An exchange took longer than {_SHORT_LEASES[-1]} s.")


# -- streams -----------------------------------------------------------------------------------------------------------


def _subscribed(probe: Probe, channel: int, octets: int) -> tuple[SubscribeCommand, SubscribeReply]:
    """Have the test pattern of a channel sent, at the first period that its firmware takes."""
    event = channels(probe)[channel][0] is ChannelKind.EVENT_SENSOR
    kind = StreamKind.EVENT if event else StreamKind.PERIODIC
    for period in _PERIODS:
        asked = SubscribeCommand(0, kind, 1, 0, period * 10**6, SOON, (channel,), test_pattern=True)
        reply = probe.sealed(asked.command())
        if reply.reason != Reason.OUT_OF_RANGE:
            break
    what = describe_command(asked.command())
    holds(reply.ok, f"{what}, sealed: success is due, {describe_reply(reply)} came.")
    try:
        reply_members = SubscribeReply.decode(reply.payload)
    except GarbledError as error:
        raise RuleBrokenError(f"{what}: {error.message}") from None
    due = message_length(kind, 1, octets)
    holds(
        reply_members.length == due, f"{what}: messages of {reply_members.length} octets are announced; {due} are due."
    )
    return asked, reply_members


def _messages(
    probe: Probe,
    frames: BusFrames,
    asked: SubscribeCommand,
    length: int,
    count: int,
    seconds: float,
    *,
    stale: DatagramSealer | None = None,
) -> list[bytes]:
    """Return whole data messages of this session's stream in order of arrival; fewer after ``seconds``."""
    assembly, came = StreamAssembly(length, fd=frames.fd), list[bytes]()
    until = probe.now() + seconds
    while len(came) < count and (left := until - probe.now()) > 0:
        heard = frames.next(left)
        if heard is None:
            break
        address = data_address(heard.identifier)
        if address is None or address.node != probe.contact.address or address.stream != asked.stream:
            continue
        message = assembly.add_segment(address.segment, heard.octets) if address.station == frames.own else None
        if message is not None and (stale is None or stale.open(message) is None):  # skips messages of the run before
            came.append(message)
    return came


@rule("stream-messages", "3. Stream keys and data messages", Stage.MEASURING, page=OPERATION_PAGE)
def stream_messages(probe: Probe) -> str:
    """Check that each data message opens under the key of its run, with its counter in the nonce.

    Counters grow, runs begin at 1; nothing leaves after the reply to Stop.
    """
    channel = _sensor(probe)
    octets = channels(probe)[channel][1]
    with probe.framed.single_frames() as frames, _claimed(probe, channel):
        session = probe.session
        assert session is not None
        for run in (1, 2):
            asked, subscribed = _subscribed(probe, channel, octets)
            holds(
                subscribed.run == run,
                f"Subscribe (128.14): run {subscribed.run}; {run} is due, each once in a session.",
            )
            seconds = 1.5 + 2 * _MESSAGES * asked.period / 1e9
            before = DatagramSealer(stream_key(session.message_key, run - 1))
            came = _messages(probe, frames, asked, subscribed.length, _MESSAGES, seconds, stale=before)
            text = (
                f"Subscribe (128.14), run {run}: {len(came)} data messages within {seconds:g} s, {_MESSAGES} are due."
            )
            holds(len(came) == _MESSAGES, text)
            last = -1
            for message in came:  # a dropped message uses up its counter, so gaps are allowed
                counter = int.from_bytes(message[:4], "big")
                text = (
                    f"Subscribe (128.14), run {run}: a data message with counter {counter} came after one with {last}."
                )
                holds(counter > last, text)
                _right_message(session.message_key, run, message, asked, octets)
                last = counter
        stopped = decode_stopped(probe.sealed_good(stop(asked.stream)))
        rest = _messages(probe, frames, asked, subscribed.length, _MOST_LATE, 3 * asked.period / 1e9)
        late = [
            message for message in rest if int.from_bytes(message[:4], "big") >= stopped
        ]  # lower counters left before the Stop
        holds(not late, f"Stop (128.15): a data message left after its reply; counter {stopped} was the next.")
    return f"{_MESSAGES} messages each of runs 1 and 2, at a period of {asked.period // 10**6} ms"


def _right_message(key: bytes, run: int, message: bytes, asked: SubscribeCommand, octets: int) -> None:
    counter = int.from_bytes(message[:4], "big")
    what = f"Data message {counter} of run {run}"
    plain = DatagramSealer(stream_key(key, run)).open(message)
    if plain is None:
        raise RuleBrokenError(f"{what}: its tag is wrong.", slips.of_data_message(key, run, counter, message))
    holds(bool(plain[0] & TEST_PATTERN), f"{what}: flags {plain[0]:02x}; the test pattern sets bit 7.")
    due = pattern(asked.channels[0], octets, counter)
    holds(plain[-octets:] == due, f"{what}: {plain[-octets:].hex()}; the test pattern has {due.hex()}.")


# -- Drive and trigger -------------------------------------------------------------------------------------------------


def _clock(probe: Probe) -> ClockReply:
    try:
        return ClockReply.decode(probe.sealed_good(CLOCK))
    except GarbledError as error:
        raise RuleBrokenError(f"Clock (128.16): {error.message}") from None


@rule("drive-replay", "4. Streams", Stage.MEASURING, page=OPERATION_PAGE)
def drive_replay(probe: Probe) -> str:
    """Check that a Drive message counts once, and none counts after a later one; the actuator keeps its last value."""
    channel, octets = _actuator(probe)
    with probe.framed.single_frames() as frames, _claimed(probe, channel):
        session, node = probe.session, probe.contact.address
        assert session is not None
        assert node is not None
        value = decode_data_set(probe.sealed_good(read_data_set(channel)), octets)
        reply = DriveReply.decode(probe.sealed_good(drive([channel])))
        holds(reply.run == 1, f"Drive (128.20): run {reply.run}; 1 is due.")
        due = drive_length(octets)
        holds(reply.length == due, f"Drive (128.20): messages of {reply.length} octets are announced; {due} are due.")
        key, address = drive_key(session.message_key, reply.run), DriveAddress(node, frames.own)

        def made(counter: int) -> bytes:
            until = (_clock(probe).sent // 1000 + 900 * _DEAD_MAN) % (1 << 32)
            return DatagramSealer(key).seal(counter, DriveValues(until, value).encode())

        def sent(message: bytes) -> int:
            for piece in cut(message, fd=frames.fd, drive=True):
                frames.send(address.identifier, piece.data, fd=frames.fd)
            return _clock(probe).last

        earlier, later = made(4), made(7)
        last = sent(later)
        holds(last != NONE, "Drive: a message with counter 7 was sent; by Clock (128.16) none had a good tag.")
        holds(last == 7, f"Drive: after a message with counter 7 Clock (128.16) says {last}.")
        last = sent(earlier)
        holds(last == 7, f"Drive: a message with counter 4 was taken after counter 7; Clock (128.16) says {last}.")
        probe.pause(0.6 * _DEAD_MAN / 1000)
        sent(later)
        probe.pause(0.7 * _DEAD_MAN / 1000)
        state = _operation(probe).channels[channel][0]
        text = (
            f"Drive: a message sent again {0.6 * _DEAD_MAN:g} ms into a dead-man of {_DEAD_MAN} ms "
            "started it again: the actuator is still claimed."
        )
        holds(not state & ChannelState.CLAIMED_HERE, text)
        holds(bool(state & ChannelState.STOPPED), "Operation (128.19): its dead-man ran out, and bit 5 is not set.")
    return "a message counts once; its replay does not keep the dead-man from running out"


@rule("trigger-token", "5. Clock, trigger, groups", Stage.MEASURING, page=OPERATION_PAGE)
def trigger_token(probe: Probe) -> str:
    """Check that only T marks what C armed, once: another T, and T after its first use, change nothing."""
    channel = _sensor(probe)
    with probe.framed.single_frames() as frames, _claimed(probe, channel):
        token, other = TriggerToken.draw(), TriggerToken.draw()
        probe.sealed_good(token.arm(Action.MARK, 30).command())
        trigger = trigger_identifier(frames.own)

        def mark_after(octets: bytes) -> int:
            frames.send(trigger, octets)
            return _clock(probe).mark

        mark = mark_after(other.octets)
        holds(mark == 0, f"Trigger with another T than the armed one: Clock (128.16) gives the mark {mark}.")
        mark = mark_after(token.octets)
        holds(mark != 0, "Trigger with the armed T: Clock (128.16) gives no mark.")
        again = mark_after(token.octets)
        holds(again == mark, f"Trigger with a T that was used: the mark went from {mark} to {again}.")
    return "the armed T marks once, another one does not"
