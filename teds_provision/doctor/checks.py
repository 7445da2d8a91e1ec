"""``doctor``: named checks of this machine, its links and the station, each with its cause and the cure.

A check is a function from a :class:`System` to findings, registered under a name. It opens no reader and no bus unless
the user named one, changes nothing, and reads the system's files only below ``System.root``, so that tests can
simulate a machine with any hardware.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Final, Literal

from teds_provision.errors import TedsProvisionError
from teds_provision.optional_rooms import Hook
from teds_provision.station.store.row_sample import RowSample

Result = Literal["ok", "warning", "failed", "skipped"]
Room = Literal["machine", "link", "store"]


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's report; ``fix`` is a command or one sentence, "" if nothing is wrong."""

    name: str
    result: Result
    why: str
    fix: str = ""
    sampled: bool = False
    """True if a large table or log was checked in part only: the newest, and some at random."""


@dataclass(frozen=True)
class System:
    """The system to check: the station's home, the root of the file system, environment, and requested links."""

    home: Path
    nfc: str | None = None
    can: str | None = None
    ble: str | None = None
    full: bool = False
    """True if every row and every entry of the log is checked, however many there are."""
    workspace: Path = field(default_factory=Path.cwd)
    root: Path = Path("/")
    environment: Mapping[str, str] = field(default_factory=lambda: os.environ)
    bad_names: Callable[[dict[str, Any], str], Iterable[str]] = lambda _values, _text: ()
    """Returns what is wrong with the names of config.toml (its values and text), each with its line."""
    bad_value: Callable[[Mapping[str, Any]], str] = lambda _: ""
    """Returns which value of config.toml no command takes, and why; "" if all are good."""
    ask: Callable[[str, bool], str] | None = None
    """Returns the passphrase without a prompt, None if it was not given."""

    def at(self, path: str) -> Path:
        """Return a path of the system, below the checked root."""
        return self.root / path.lstrip("/")


Look = Callable[[System], Iterator[Finding]]
CHECKS: Final[dict[str, tuple[Room, Look]]] = {}
_MODULES: Final = ("machine", "links", "station", "fleet")
_OF_ROOMS: Final[Hook[Look]] = Hook("doctor.checks")
"""Checks of optional rooms, each registered with :func:`check`."""


def check(name: str, room: Room) -> Callable[[Look], Look]:
    """Register a check under its name; ``room`` decides the exit code if it fails."""

    def register(look: Look) -> Look:
        CHECKS[name] = (room, look)
        return look

    return register


def examine(system: System) -> Iterator[tuple[Room, Finding]]:
    """Run every check in turn; one that fails in an unforeseen way is itself a finding, and the next one runs."""
    for module in _MODULES:
        import_module(f"teds_provision.doctor.{module}")  # fills the registry
    _OF_ROOMS.parts()  # registers the checks of optional rooms
    for name, (room, look) in CHECKS.items():
        try:
            for finding in look(system):
                yield room, finding
        except TedsProvisionError as error:
            yield room, Finding(name, "failed", error.message, error.hint)
        except Exception as error:  # noqa: BLE001  libraries and systems that are broken raise anything
            yield (
                room,
                Finding(name, "failed", f"the check itself failed: {type(error).__name__}: {error}.", "Report this."),
            )


def intact(name: str, whole: str, part: str, sample: RowSample) -> Finding:
    """Return that a check found nothing: in the whole of what it looks at, or in the ``part`` that was sampled."""
    if sample.sampled:
        return Finding(name, "ok", f"{part} (doctor --full checks all).", sampled=True)
    return Finding(name, "ok", f"{whole}.")


def exit_code(found: list[tuple[Room, Finding]]) -> int:
    """Return 0 unless a check failed; else 7 for store or vault, 5 for a link that was asked for, 1 for the machine."""
    rooms = {room for room, finding in found if finding.result == "failed"}
    return 7 if "store" in rooms else 5 if "link" in rooms else 1 if rooms else 0
