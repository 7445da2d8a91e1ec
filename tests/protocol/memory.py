"""A flash in RAM that can lose power: before or after any commit."""

from __future__ import annotations

from dataclasses import replace

from teds_provision.protocol.flash import Flash, FlashError


class PowerCutError(Exception):
    """The node died; what it had in RAM is gone."""


class RamFlash:
    """Keeps the last committed state; ``die_before``/``die_after`` cut power at a commit, ``fail`` refuses one.

    ``garbles``: it takes one and has something else.
    """

    def __init__(self, state: Flash) -> None:
        self.state = state
        self.die_before = self.die_after = self.fail = self.garbles = False

    def load(self) -> Flash:
        return replace(self.state, sequence=self.state.sequence ^ 1) if self.garbles else self.state

    def commit(self, state: Flash) -> None:
        if self.fail:
            raise FlashError
        if self.die_before:
            raise PowerCutError
        if self.garbles:
            return
        self.state = state
        if self.die_after:
            raise PowerCutError
