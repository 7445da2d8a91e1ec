"""The person at the terminal, who answers what provisioning asks."""

from __future__ import annotations

import threading
from typing import Final

from teds_provision.cli.context import App
from teds_provision.errors import NotWhitelistedError, PolicyError
from teds_provision.provisioning.adoption import FactoryDatasheet
from teds_provision.provisioning.batch_sheet import DeclinedError
from teds_provision.provisioning.identify import IdentifiedNode
from teds_provision.provisioning.operator import Operator
from teds_provision.teds.diff import Change

_CHANGES_SHOWN: Final = 20


class TerminalOperator(Operator):
    """Asks one question at a time, however many readers there are.

    ``yes`` is --yes; ``strangers`` False: it does not add nodes that were not named. ``several``: more than one board
    may be meant, so none becomes one of another type.
    """

    def __init__(self, app: App, *, yes: bool, strangers: bool = True, several: bool = False) -> None:
        self._app, self._yes, self._strangers, self._several = app, yes, strangers, several
        # Accepted boards. A board is whitelisted once it has its key; if it is lost before that, do not ask again.
        self._accepted: set[tuple[bytes, str]] = set()
        self._turn = threading.Lock()

    def accept(self, who: IdentifiedNode) -> None:
        """Ask for a yes, or for the key's digits."""
        if (self._yes and self._strangers) or (who.uuid, who.fingerprint) in self._accepted:
            return
        if not self._app.interactive:
            raise NotWhitelistedError(
                f"Node {who.uuid.hex()} is not on the whitelist, and there is no terminal to ask on.",
                hint=f"Add --yes, or: teds-provision whitelist add {who.uuid.hex()} --fingerprint {who.fingerprint}",
            )
        with self._turn:
            if not self._app.ask_for_key(
                f"Node {who.uuid.hex()}, key {who.fingerprint[:32]}\nTrust this board and add it to the whitelist?",
                who.fingerprint,
            ):
                raise DeclinedError(f"Cancelled. Node {who.uuid.hex()} was not whitelisted; nothing was changed.")
        self._accepted.add((who.uuid, who.fingerprint))

    def take_over(self, question: str, refusal: PolicyError) -> None:
        """Ask regardless of --yes: it locks another station out, and no option of the command names that."""
        if not self._app.interactive:
            raise refusal
        with self._turn:
            if not self._app.ask_yes_no(question):
                raise DeclinedError("Cancelled. The node keeps its key; nothing was changed.")

    def retype(self, uuid: bytes, differences: tuple[str, ...]) -> None:
        """Show the differences and ask, unless --yes answered already: it does not name this."""
        if not self._app.interactive or self._yes or self._several:
            super().retype(uuid, differences)
        self._app.note(f"Board {uuid.hex()} reports a different type from the one it would be given:")
        for text in differences:
            self._app.note(f"  {text}")
        if not self._app.ask_yes_no("Change it to the new type?"):
            raise PolicyError(f"Cancelled. Board {uuid.hex()} keeps its type; nothing was written.")

    def confirm(self, uuid: bytes, changes: tuple[Change, ...]) -> None:
        """Show the changes and ask."""
        if not self._app.interactive:
            super().confirm(uuid, changes)
        with self._turn:
            self._app.note(
                f"Node {uuid.hex()} has a different datasheet. This would also change, although you did not name it:"
            )
            for change in changes[:_CHANGES_SHOWN]:
                self._app.note(f"  {change.text}")
            if len(changes) > _CHANGES_SHOWN:
                self._app.note(f"  and {len(changes) - _CHANGES_SHOWN} more")
            if not self._app.ask_yes_no("Write it?"):
                raise DeclinedError(f"Cancelled. Node {uuid.hex()} keeps its datasheet.")

    def low_battery(self, question: str) -> None:
        """Ask, unless --yes answered already."""
        with self._turn:
            self._app.confirm(question, yes=self._yes)

    def jump(self, question: str) -> None:
        """Ask, unless --yes answered already."""
        with self._turn:
            self._app.confirm(question, yes=self._yes)

    def adopt(self, brought: FactoryDatasheet) -> None:
        """Show the datasheet, and ask, unless --yes answered already."""
        with self._turn:
            if not self._yes and not self._app.interactive:
                super().adopt(brought)
            show_brought(self._app, brought)
            if self._yes:
                return
            if not self._app.ask_yes_no("Sign this datasheet, and put the node in service?"):
                raise DeclinedError("Cancelled. The board's datasheet was not signed.")


def show_brought(app: App, brought: FactoryDatasheet) -> None:
    """Show a board's own datasheet, a line for each channel, and its findings."""
    app.note(f"Node {brought.image.uuid.hex()} brought its own datasheet: {brought.name or '(no name)'}")
    for channel in brought.channels[:_CHANGES_SHOWN]:
        kind = channel.kind.word if channel.kind is not None else "of unknown kind"
        limits = f"{channel.show(channel.low)} to {channel.show(channel.high)}"
        exact = (
            f", ± {channel.show(channel.stated_uncertainty, difference=True)}" if channel.stated_uncertainty > 0 else ""
        )
        made = f", calibrated {channel.calibrated_at:%Y-%m-%d}" if channel.calibrated_at else ""
        app.note(f"  channel {channel.number}: {channel.name or '(no name)'}, {kind}, {limits}{exact}{made}")
    if len(brought.channels) > _CHANGES_SHOWN:
        app.note(f"  and {len(brought.channels) - _CHANGES_SHOWN} more channels")
    for finding in brought.findings[:_CHANGES_SHOWN]:
        app.note(f"  {finding['severity']}: {finding['message']}")
