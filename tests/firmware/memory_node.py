"""The node in C in this process, over flash in memory: clock, randomness and power are the test's."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from teds_provision.protocol.flash import Flash
from teds_provision.protocol.messages.identity import Identity
from teds_provision.protocol.operation.hardware import SessionPort
from tests.firmware import builds

NANOSECONDS: Final = 10**9
_KINDS: Final = {"can": 1, "nfc": 2, "ble": 3}
_RANDOM: Final = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_char, ctypes.POINTER(ctypes.c_uint8), ctypes.c_size_t)
_ANSWER: Final = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t
)
_HOOK: Final = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_char, ctypes.c_uint8, ctypes.c_uint64, ctypes.c_void_p, ctypes.c_size_t
)
_FIRMWARE: Final = ctypes.CFUNCTYPE(
    ctypes.c_size_t, ctypes.c_char, ctypes.c_uint, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_size_t
)
FirmwareHook = Callable[[str, int, bytes], bytes]
"""Asked with ``a`` about (flags, version, image and text come back), ``l`` locate (seconds), ``m`` manage (a packet
comes, one goes back) or ``r`` restart."""
Hook = Callable[[str, int, int, bytes], int | tuple[bytes, int]]
"""Asked with a word of memory.h, a channel, an argument and octets: what it says, or octets to put there and that."""
_KEYED, _PROVISIONED = 1, 2
Draw = Callable[[str, int], bytes]
"""Octets for: ``n`` a nonce, counter or wait; ``i`` the scalar of the identity key; ``o`` that of a one-time key."""


@functools.cache
def _library(path: Path) -> Any:
    library = ctypes.CDLL(str(path))
    library.memory_new.restype = ctypes.c_void_p
    library.memory_handle.restype = library.memory_flash.restype = ctypes.c_size_t
    library.memory_steps.restype = library.memory_chip_calls.restype = library.memory_reads.restype = ctypes.c_long
    library.memory_poll.restype = library.memory_missed.restype = ctypes.c_uint64
    library.memory_image_flash.restype = ctypes.c_size_t
    library.memory_restarts.restype = library.memory_images.restype = ctypes.c_bool
    library.memory_written.restype, library.memory_spare_slot_fails.restype = ctypes.c_long, ctypes.c_bool
    library.memory_dead.restype = library.memory_misused.restype = library.memory_nfc_written.restype = ctypes.c_bool
    library.memory_ble_advertises.restype = library.memory_ble_drops.restype = ctypes.c_bool
    library.memory_in_session.restype = library.memory_acts.restype = library.memory_streams.restype = ctypes.c_bool
    library.memory_ble_notify.restype = library.memory_ble_data.restype = ctypes.c_size_t
    library.memory_nfc_message.restype = library.memory_nfc_frame.restype = ctypes.c_size_t
    return library


def link_number(link: str) -> tuple[int, int]:
    """A link's name (``nfc``, ``can:f1``) as the C node has it: its number and kind."""
    kind, _, source = link.partition(":")
    return (int(source, 16) if source else 1), _KINDS[kind]


class MemoryNode:
    """One node. What a Tim is asked is asked of it in the same words, so that a test of either takes both.

    ``draw`` gives its randomness; ``clock`` is seconds, read before each call.
    """

    def __init__(
        self,
        draw: Draw,
        clock: Callable[[], float],
        *,
        uuid: bytes,
        max_message: int = 1024,
        max_teds: int = 4092,
        unit: int = 8,
        erased: int = 0xFF,
        library: Path | None = None,
        sizes: Mapping[str, int] | None = None,
    ) -> None:
        self._library = _library(library or builds.library(max_message, max_teds + 4, **(sizes or {})))
        self._clock, self.max_message = clock, max_message
        self.room = max_message
        self._draw = draw
        self._callback = _RANDOM(self._random)  # kept: the library calls it as long as the node is there
        self._fixed: list[Any] = []
        self._board = ctypes.c_void_p(
            self._library.memory_new(uuid, ctypes.c_uint8(unit), ctypes.c_uint8(erased), self._callback)
        )

    def hook_up(self, hook: Hook) -> None:
        """Have its channels in the test's hands; before the start."""

        def ask(what: bytes, channel: int, argument: int, octets: Any, length: int) -> int:
            given = ctypes.string_at(octets, length) if octets else b""
            outcome = hook(what.decode(), channel, argument, given)
            if isinstance(outcome, tuple):
                ctypes.memmove(octets, outcome[0], length)
                return int(outcome[1])
            return int(outcome)

        self._hook = _HOOK(ask)  # kept, too
        self._library.memory_hook_up(self._board, self._hook)

    def has_firmware(self, hook: FirmwareHook, most: int = 0) -> None:
        """Have its firmware in the test's hands, with packets of at most ``most`` octets; before the start."""

        def ask(what: bytes, argument: int, octets: Any, length: int, room: int) -> int:
            outcome = hook(what.decode(), argument, ctypes.string_at(octets, length) if octets else b"")
            if octets:
                ctypes.memmove(octets, outcome, min(len(outcome), room))
            return len(outcome)

        self._firmware = _FIRMWARE(ask)  # kept, too
        self._library.memory_firmware(self._board, self._firmware, ctypes.c_uint16(most))

    def has_images(self, owner: bytes, image: bytes, *, counter: bool = False) -> None:
        """Have two slots, a boot loader of this owner and an SMP server; ``image`` runs first. Before the start."""
        assert self._library.memory_images(self._board, owner, ctypes.c_size_t(len(owner)), ctypes.c_bool(counter))
        self.images = image + self.images[len(image) :]

    @property
    def images(self) -> bytes:
        """Every octet of both slots and of the boot loader's records; may be put back before a start."""
        octets = ctypes.create_string_buffer(self._library.memory_image_flash(self._board, None))
        self._library.memory_image_flash(self._board, octets)
        return octets.raw

    @images.setter
    def images(self, octets: bytes) -> None:
        self._library.memory_put_image_flash(self._board, octets)

    def restart_if_asked(self) -> int | None:
        """Restart if the node asked for it, steps of flash counting on; what the start gives, None: it did not ask."""
        self._now()
        return int(self._library.memory_restart(self._board)) if self._library.memory_restarts(self._board) else None

    def bus_off(self) -> None:
        """Its controller went off the bus, and is back."""
        self._now()
        self._library.memory_bus_off(self._board)

    def press(self) -> None:
        """A button is released that was held for a short time."""
        self._now()
        self._library.memory_pressed(self._board)

    def without(self, what: str) -> None:
        """A board that has none of this: a word of memory.h."""
        self._library.memory_without(self._board, ctypes.c_char(what.encode()))

    def close(self) -> None:
        """Give its memory back; once, whoever else closes it."""
        board, self._board = self._board, ctypes.c_void_p()
        self._library.memory_free(board)

    def _random(self, kind: bytes, out: Any, length: int) -> int:
        octets = self._draw(kind.decode(), length)
        assert len(octets) == length
        ctypes.memmove(out, octets, length)
        return 0

    def _now(self) -> None:
        self._library.memory_at(self._board, ctypes.c_uint64(round(self._clock() * NANOSECONDS)))

    # -- power and flash -------------------------------------------------------------------------------------------

    def start(self) -> int:
        """Power comes (back); what teds_node_init gives."""
        self._now()
        return int(self._library.memory_start(self._board))

    def joins_bus(self) -> None:
        """Its CAN controller is on the bus, after a start: it announces itself soon."""
        self._now()
        self._library.memory_can_start(self._board)

    def start_cut(self, step: int, *, torn: bool) -> int:
        """Power comes, and fails at this step of flash."""
        self._now()
        return int(self._library.memory_start_cut(self._board, ctypes.c_long(step), ctypes.c_bool(torn)))

    def put(self, state: Flash) -> None:
        """Have it hold this state as if it had come to it by itself; key and UUID are its own."""
        for (channel, code), teds in sorted(state.blocks.items()):
            if (channel, code) in state.read_only:
                kept = ctypes.create_string_buffer(teds, len(teds))
                self._fixed.append(kept)
                self._library.memory_fixed(self._board, channel, code, kept, ctypes.c_uint16(len(teds)))
        stored = {block: teds for block, teds in state.blocks.items() if block not in state.read_only}
        image = b"".join(
            (channel << 8 | code).to_bytes(2, "big") + len(teds).to_bytes(2, "big") + teds
            for (channel, code), teds in stored.items()
        )
        flags = (_KEYED if state.key is not None else 0) | (_PROVISIONED if state.provisioned else 0)
        failed = self._library.memory_put(
            self._board,
            ctypes.c_uint8(flags),
            ctypes.c_uint8(state.can_address),
            ctypes.c_uint32(state.epoch),
            ctypes.c_uint32(state.sequence),
            state.key or bytes(16),
            state.station or bytes(65),
            state.ca or bytes(65),
            image,
            ctypes.c_size_t(len(image)),
        )
        assert failed == 0

    @property
    def image(self) -> bytes:
        """Every octet of its flash; may be put back before a start."""
        octets = ctypes.create_string_buffer(self._library.memory_flash(self._board, None))
        self._library.memory_flash(self._board, octets)
        return octets.raw

    @image.setter
    def image(self, octets: bytes) -> None:
        self._library.memory_put_flash(self._board, octets)

    def cut(self, step: int, *, torn: bool) -> None:
        """Have the power fail at this step of flash from now on (an erase, or a unit written); 0: not."""
        self._library.memory_cut(self._board, ctypes.c_long(step), ctypes.c_bool(torn))

    def fails(self, fails: bool) -> None:
        """Flash that refuses to be written, and works again."""
        self._library.memory_fails(self._board, ctypes.c_bool(fails))

    def chip_fails(self, call: int) -> None:
        """Have this call of its random source or cryptography fail, it alone, counted from now; 0: none."""
        self._library.memory_chip_fails(self._board, ctypes.c_long(call))

    def read_fails(self, read: int) -> None:
        """Have this read of its flash fail, it alone, counted from now; 0: none."""
        self._library.memory_read_fails(self._board, ctypes.c_long(read))

    def garble(self, unit: int) -> None:
        """Have its flash take this unit, counted from now, and read back something else; 0: none."""
        self._library.memory_garble(self._board, ctypes.c_long(unit))

    @property
    def written(self) -> int:
        """Units written since :meth:`garble`."""
        return int(self._library.memory_written(self._board))

    @property
    def spare_slot_fails(self) -> bool:
        """Whether its spare slot could not be erased."""
        return bool(self._library.memory_spare_slot_fails(self._board))

    def has_slots_of(self, octets: int) -> None:
        """Have slots of so many octets; before the start."""
        self._library.memory_slot_octets(self._board, ctypes.c_uint32(octets))

    @property
    def missed(self) -> int:
        """Data messages that it could not send, since its start."""
        return int(self._library.memory_missed(self._board))

    @property
    def reads(self) -> int:
        """Reads of flash since :meth:`read_fails`."""
        return int(self._library.memory_reads(self._board))

    @property
    def chip_calls(self) -> int:
        """Calls since :meth:`chip_fails`."""
        return int(self._library.memory_chip_calls(self._board))

    @property
    def steps(self) -> int:
        """Steps of flash since :meth:`cut`."""
        return int(self._library.memory_steps(self._board))

    @property
    def dead(self) -> bool:
        """Whether its power failed."""
        return bool(self._library.memory_dead(self._board))

    @property
    def misused(self) -> bool:
        """Whether it wrote flash as flash cannot be written."""
        return bool(self._library.memory_misused(self._board))

    # -- what a Tim is asked -----------------------------------------------------------------------------------------

    def handle(
        self, frame: bytes, *, link: str, tapped: bool, port: SessionPort | None = None, received: int | None = None
    ) -> bytes:
        """Answer one command frame with one reply frame."""
        self._now()
        number, kind = link_number(link)
        reply = ctypes.create_string_buffer(self.room)
        length = self._library.memory_handle(
            self._board, ctypes.c_uint8(number), ctypes.c_uint8(kind), ctypes.c_bool(tapped), frame,
            ctypes.c_size_t(len(frame)), reply,
        )  # fmt: skip
        assert length <= self.room
        return reply.raw[:length]

    def identity(self) -> Identity:
        """Return what Identify says."""
        return Identity.decode(self.handle(bytes.fromhex("000080070000"), link="can:f7", tapped=False)[3:])

    @property
    def can_address(self) -> int:
        """The present CAN address."""
        return self.identity().can_address

    def link_lost(self, link: str) -> None:
        """Loss of the field or link."""
        self._now()
        self._library.memory_lost(self._board, ctypes.c_uint8(link_number(link)[0]))

    def take_can_address(self, address: int) -> None:
        """Move because another node claimed this address."""
        self._library.memory_move(self._board, ctypes.c_uint8(address))

    def reset_by_hand(self) -> None:
        """Button, pad or magnet."""
        self._now()
        assert self._library.memory_by_hand(self._board) == 0

    def reply_sent(self, link: str) -> None:
        """The last reply of this link has left."""
        self._now()
        self._library.memory_reply_left(self._board, ctypes.c_uint8(link_number(link)[0]))

    def poll(self) -> int:
        """Do what is due; the tick at which something is due again."""
        self._now()
        return int(self._library.memory_poll(self._board))

    # -- NFC ---------------------------------------------------------------------------------------------------------

    def has_nfc(self, *, wt_int: int = 4, n_wait: int = 15, max_ndef: int = 4160) -> None:
        """It has an antenna; before the start."""
        self._library.memory_nfc(self._board, ctypes.c_uint8(wt_int), ctypes.c_uint8(n_wait), ctypes.c_uint16(max_ndef))

    def has_nfc_service(self, name: bytes, answer: Callable[[bytes, int], bytes | None]) -> None:
        """Its application has a service on the tag; before the start.

        ``answer`` gets the reader's message and the room; it returns the records behind the status, None: garbled.
        """

        def called(user: int, message: int, length: int, out: int, space: int) -> int:
            records = answer(ctypes.string_at(message, length), space)
            if records is None:
                return -1
            ctypes.memmove(out, records, min(len(records), space))
            return len(records)

        kept = (_ANSWER(called), ctypes.create_string_buffer(name))
        self._fixed.append(kept)
        self._library.memory_nfc_service(self._board, kept[1], kept[0])

    def has_battery(self, flags: int, level: int) -> None:
        """It has a battery; before the start."""
        self._library.memory_battery(self._board, ctypes.c_uint8(flags), ctypes.c_uint8(level))

    def is_in_the_air(self, address: bytes) -> None:
        """It has BLE, and this address; before the start."""
        self._library.memory_in_the_air(self._board, address)

    def nfc_field(self, present: bool) -> None:
        """A reader activates its tag, or the field is gone."""
        self._now()
        self._library.memory_nfc_field(self._board, ctypes.c_bool(present))

    def nfc_write(self, message: bytes) -> bytes:
        """A reader writes a whole NDEF message; what the tag shows once it was served."""
        self._now()
        assert self._library.memory_nfc_written(self._board, message, ctypes.c_size_t(len(message)))
        assert self.nfc_message() == b""
        self.poll()
        return self.nfc_message()

    def nfc_message(self) -> bytes:
        """Return what the tag shows now."""
        out = ctypes.create_string_buffer(4162)
        length = self._library.memory_nfc_message(self._board, out)
        return out.raw[:length]

    def nfc_frame(self, frame: bytes) -> bytes | None:
        """One frame of a reader (RATS, an ISO-DEP block) to the tag's answer; None: silence."""
        self._now()
        out = ctypes.create_string_buffer(256)
        length = self._library.memory_nfc_frame(self._board, frame, ctypes.c_size_t(len(frame)), out)
        return out.raw[:length] or None

    # -- BLE ---------------------------------------------------------------------------------------------------------

    def ble_connected(self, connection: int, mtu: int) -> None:
        """Somebody connects."""
        self._now()
        self._library.memory_ble_connected(self._board, ctypes.c_uint8(connection), ctypes.c_uint16(mtu))

    def ble_mtu(self, connection: int, mtu: int) -> None:
        """Both sides have agreed on another MTU."""
        self._library.memory_ble_mtu(self._board, ctypes.c_uint8(connection), ctypes.c_uint16(mtu))

    def ble_disconnected(self, connection: int) -> None:
        """The connection is gone."""
        self._now()
        self._library.memory_ble_disconnected(self._board, ctypes.c_uint8(connection))

    def ble_written(self, connection: int, value: bytes) -> list[bytes]:
        """A station writes a piece of a command; the notifications that follow."""
        self.ble_write(connection, value)
        return self.ble_notified(connection)

    def ble_write(self, connection: int, value: bytes) -> None:
        """A station writes a piece of a command, and the chip takes no notification yet."""
        self._now()
        self._library.memory_ble_written(self._board, ctypes.c_uint8(connection), value, ctypes.c_size_t(len(value)))

    def ble_notified(self, connection: int) -> list[bytes]:
        """Return the notifications that the chip takes now."""
        self._now()
        out, notified = ctypes.create_string_buffer(512), []
        while length := self._library.memory_ble_notify(self._board, ctypes.c_uint8(connection), out):
            notified.append(out.raw[:length])
        self.poll()
        return notified

    def ble_hears(self, connection: int, hears: bool) -> None:
        """A station enables data messages, or disables them."""
        self._now()
        self._library.memory_ble_hears(self._board, ctypes.c_uint8(connection), ctypes.c_bool(hears))

    def ble_data(self) -> tuple[int, bytes] | None:
        """Return the next data message that may leave now: its connection and the notification."""
        self._now()
        connection, out = ctypes.c_uint8(), ctypes.create_string_buffer(241)
        length = self._library.memory_ble_data(self._board, ctypes.byref(connection), out)
        return (connection.value, out.raw[:length]) if length else None

    def ble_driven(self, connection: int, value: bytes) -> None:
        """A station writes a Drive message."""
        self._now()
        self._library.memory_ble_driven(self._board, ctypes.c_uint8(connection), value, ctypes.c_size_t(len(value)))

    def ble_advertises(self) -> bool:
        """Return True if it is to be found now."""
        self._now()
        return bool(self._library.memory_ble_advertises(self._board))

    def ble_drops(self, connection: int) -> bool:
        """Return True if it wants to be rid of a connection."""
        self._now()
        return bool(self._library.memory_ble_drops(self._board, ctypes.c_uint8(connection)))

    def in_session(self, link: int) -> bool:
        """Return True if a session is open on this link."""
        return bool(self._library.memory_in_session(self._board, ctypes.c_uint8(link)))

    # -- CAN ---------------------------------------------------------------------------------------------------------

    def take_frame(self, identifier: int, data: bytes, *, fd: bool = False) -> None:
        """A CAN frame came."""
        self._now()
        self._library.memory_can_rx(
            self._board, ctypes.c_uint32(identifier), data, ctypes.c_uint8(len(data)), ctypes.c_bool(fd)
        )

    def next_frame(self) -> tuple[int, bytes, bool] | None:
        """Return the next CAN frame that may leave now: identifier, data, whether it is FD."""
        self._now()
        identifier, fd, data = ctypes.c_uint32(), ctypes.c_bool(), ctypes.create_string_buffer(64)
        length = self._library.memory_can_tx(self._board, ctypes.byref(identifier), data, ctypes.byref(fd))
        return None if length < 0 else (identifier.value, data.raw[:length], fd.value)

    def event(self, channel: int, tick: int, octets: bytes, *, valid: bool = True) -> None:
        """An event sensor has seen something, and the loop takes it up."""
        self.interrupt(channel, tick, octets, valid=valid)
        self.poll()

    def interrupt(self, channel: int, tick: int, octets: bytes, *, valid: bool = True) -> None:
        """An event sensor has seen something; the loop is held up."""
        self._library.memory_event(
            self._board, ctypes.c_uint8(channel), ctypes.c_uint64(tick), octets, ctypes.c_bool(valid)
        )

    def set_point(self, channel: int, octets: int) -> bytes:
        """Return what an actuator does."""
        out = ctypes.create_string_buffer(octets)
        self._library.memory_set_point(self._board, ctypes.c_uint8(channel), out)
        return out.raw

    def add_channel(self, number: int, kind: int, octets: int, *, model: int = 0, shortest: int = 1) -> None:
        """One more channel, before the start."""
        self._library.memory_channel(
            self._board, ctypes.c_uint8(number), ctypes.c_uint8(kind), ctypes.c_uint8(model), ctypes.c_uint8(octets),
            ctypes.c_uint32(shortest),
        )  # fmt: skip

    def halts(self, number: int, halt: int) -> None:
        """How an actuator reaches its safe state (ActHalt), before the start."""
        self._library.memory_halt(self._board, ctypes.c_uint8(number), ctypes.c_uint8(halt))

    def blocks(self) -> dict[tuple[int, int], bytes]:
        """Return every TEDS that it lists, the initial Security TEDS too; read as a station does."""
        listed = self.handle(bytes.fromhex("0000800b0000"), link="can:f7", tapped=False)[3:]
        return {
            (int.from_bytes(listed[at : at + 2], "big"), listed[at + 2]): self._read(listed[at : at + 3])
            for at in range(0, len(listed), 3)
        }

    def _read(self, block: bytes) -> bytes:
        teds = b""
        while True:
            frame = block[:2] + b"\x01\x02\x00\x05" + block[2:] + len(teds).to_bytes(4, "big")
            piece = self.handle(frame, link="can:f7", tapped=False)[7:]
            if not piece:
                return teds
            teds += piece
