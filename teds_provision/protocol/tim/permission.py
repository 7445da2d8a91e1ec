"""Permission of commands: the table of profile.md, "Which command when", and the limits during claims (operation.md).

The first question that a node asks of a command; lengths and everything else come after it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from teds_provision.protocol.messages.frames import (
    COMMON,
    EITHER,
    SECURITY_CLASS,
    Command,
    CommandRefusedError,
    Function,
    Reason,
    TedsFunction,
)
from teds_provision.protocol.operation.commands import OPERATE_FUNCTION
from teds_provision.protocol.operation.hardware import SessionPort
from teds_provision.protocol.operation.role import OperationRole
from teds_provision.protocol.session import OPEN_OCTETS, NodeSession
from teds_provision.protocol.tim.manage import ManageFilter


@dataclass(frozen=True)
class Origin:
    """A command's link and port, whether it counts as tapped, and the session that it was sealed in (None: plain).

    ``received`` is the tick at which its last frame came.
    """

    link: str
    tapped: bool
    port: SessionPort
    received: int
    session: NodeSession | None = None


_FUNCTIONS: Final = frozenset(Function)
_TEDS_FUNCTIONS: Final = frozenset(TedsFunction)
_TAPPED: Final = frozenset({Function.REQUEST, Function.CONFIRM, Function.SET_CAN_ADDRESS})
_MEASURING: Final = frozenset(range(Function.SAMPLE, Function.DRIVE + 1))
_FIRMWARE: Final = frozenset({Function.ABOUT, Function.LOCATE, Function.MANAGE})
_SESSION_ALONE: Final = frozenset({Function.CLOSE, Function.MANAGE})
_IN_FACTORY: Final = frozenset({Function.RESET, Function.LOCATE})
"""Plain commands that only a node without a key runs."""
_HELD_BACK: Final = frozenset({Function.LIST, Function.ABOUT})
"""Plain commands of class 128 whose replies cost a stream's time."""
_PLAIN_ALONE: Final = frozenset({Function.OPEN, Function.SEALED})
_CHANGES: Final = frozenset(
    {(COMMON, TedsFunction.WRITE), (COMMON, TedsFunction.UPDATE), (SECURITY_CLASS, Function.SET_CAN_ADDRESS)}
)
_STORED: Final = _CHANGES | {
    (SECURITY_CLASS, function) for function in (Function.REQUEST, Function.CONFIRM, Function.RESET)
}
"""Commands that change what is stored: refused while the running image is on trial."""
_DURING_UPLOAD: Final = frozenset({(COMMON, TedsFunction.WRITE), (EITHER, OPERATE_FUNCTION)})
"""Commands that an upload of any session delays."""
_STRANGER_SECONDS: Final = 1.0
"""While a stream runs, plain Read, List and About are answered once in so many seconds."""


@dataclass
class Permission:
    """Refuses what the table forbids. ``in_factory`` and ``open_on`` (a link) return the node's state.

    ``quick_points``: the node's point arithmetic delays no Sealed frame by more than 5 ms. Without ``has_firmware`` it
    is a node from before 128.21 to 128.23.
    """

    in_factory: Callable[[], bool]
    open_on: Callable[[str], bool]
    clock: Callable[[], float]
    role: OperationRole | None
    quick_points: bool
    has_can: bool = True
    has_firmware: bool = True
    manage: ManageFilter | None = None
    _stranger_at: float | None = None

    def check(self, command: Command, origin: Origin) -> None:
        """Raise CommandRefusedError if the command may not be run now, or is not known."""
        if command.command_class == SECURITY_CLASS:
            # Class 128 must be addressed to channel 0; an unknown function gets 1 in every state.
            unknown = (
                command.function not in _FUNCTIONS
                or (command.function == Function.SET_CAN_ADDRESS and not self.has_can)
                or (command.function in _FIRMWARE and not self.has_firmware)
            )
            if command.channel != 0 or unknown:
                raise CommandRefusedError(Reason.UNKNOWN_COMMAND)
            if origin.session is None:
                self._plain_security(Function(command.function), command.payload, origin)
            else:
                # In a session, 1 for commands of operation.md that this node does not implement.
                if command.function in _PLAIN_ALONE:
                    raise CommandRefusedError(Reason.NOT_PERMITTED)
                if command.function in _MEASURING and not self._measures(command):
                    raise CommandRefusedError(Reason.UNKNOWN_COMMAND)
        elif origin.session is None:
            # Other classes outside a session: only Query and Read.
            if not of_teds(command) or command.function not in (TedsFunction.QUERY, TedsFunction.READ):
                raise CommandRefusedError(Reason.NOT_PERMITTED)
            if command.function == TedsFunction.READ:
                self._hold_strangers_back()
        elif not self._measures(command) and not of_teds(command):
            raise CommandRefusedError(Reason.UNKNOWN_COMMAND)
        self._spare_firmware(command)
        self._change(command, origin)

    def _plain_security(self, function: Function, payload: bytes, origin: Origin) -> None:
        """Check the columns "factory" and "keyed or provisioned"."""
        self._permitted_plain(function, origin)
        if function == Function.OPEN and self.in_factory():
            raise CommandRefusedError(Reason.WRONG_STATE)
        if function == Function.SEALED and not self.open_on(origin.link):
            raise CommandRefusedError(Reason.WRONG_STATE)
        if function == Function.PROVE or (function == Function.OPEN and len(payload) == OPEN_OCTETS):
            self._spare_actuators()
        if function in _HELD_BACK:
            self._hold_strangers_back()

    def _permitted_plain(self, function: Function, origin: Origin) -> None:
        if function in _TAPPED and not origin.tapped:
            raise CommandRefusedError(Reason.NOT_PERMITTED)
        if function in _SESSION_ALONE or function in _MEASURING:
            raise CommandRefusedError(Reason.NOT_PERMITTED)
        if function in _IN_FACTORY and not self.in_factory():
            raise CommandRefusedError(Reason.NOT_PERMITTED)
        if function == Function.ABOUT and origin.port.kind != "can" and not self.in_factory():
            # a stranger in radio range must not learn which firmware a robot runs
            raise CommandRefusedError(Reason.NOT_PERMITTED)

    def _measures(self, command: Command) -> bool:
        return self.role is not None and self.role.knows(command)

    def _spare_firmware(self, command: Command) -> None:
        """Keep what an image on trial was given, and the flash that an upload writes."""
        number = (command.command_class, command.function)
        if self.manage is None:
            return
        if (number in _STORED and self.manage.on_trial) or (number in _DURING_UPLOAD and self.manage.uploading):
            raise CommandRefusedError(Reason.BUSY)

    def _change(self, command: Command, origin: Origin) -> None:
        """Refuse changes of datasheet and address under a claim."""
        if self.role is None or (command.command_class, command.function) not in _CHANGES:
            return
        writes = (command.command_class, command.function) == (COMMON, TedsFunction.WRITE)
        self.role.demand_configuration(origin.session, writes_over_nfc=writes and origin.port.kind == "nfc")

    def _spare_actuators(self) -> None:
        """Refuse a stranger's point arithmetic with 17 if it could delay the values of a claimed actuator."""
        if self.role is not None and self.role.claims.actuators and not self.quick_points:
            raise CommandRefusedError(Reason.BUSY)

    def _hold_strangers_back(self) -> None:
        """Refuse plain Read, List and About beyond one a second with 17 while a stream runs, all links together."""
        if self.role is None or not self.role.streams.running:
            return
        now = self.clock()
        if self._stranger_at is not None and now - self._stranger_at < _STRANGER_SECONDS:
            raise CommandRefusedError(Reason.BUSY)
        self._stranger_at = now


def of_teds(command: Command) -> bool:
    """Return True if it is Query, Read, Write or Update."""
    return command.command_class == COMMON and command.function in _TEDS_FUNCTIONS
