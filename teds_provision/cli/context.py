"""The context of every command: the global options, the output of results, and the station's store and vault."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import TYPE_CHECKING, Any, ClassVar, Final, TextIO

import click

from teds_provision.cli.config_file import home_of
from teds_provision.errors import (
    LinkError,
    NoPassphraseError,
    PolicyError,
    StoreError,
    TedsProvisionError,
    UsageError,
    WrongPassphraseError,
)
from teds_provision.lazy import late
from teds_provision.sanitize import sanitize, sanitize_json

if TYPE_CHECKING:
    import json
    from pathlib import Path

    from rich.console import Console, RenderableType

    from teds_provision import client
    from teds_provision.cli import console
    from teds_provision.client import Client
    from teds_provision.protocol import fingerprints
    from teds_provision.shapes import problem
    from teds_provision.station import label as labels
    from teds_provision.station import station as stations
    from teds_provision.station.station import Station
    from teds_provision.teds.certificate import ChooseItem
    from teds_provision.vault import hardening
else:
    # Not needed for --help and usage errors, which open no station.
    fingerprints, labels = late("teds_provision.protocol.fingerprints"), late("teds_provision.station.label")
    stations, hardening = late("teds_provision.station.station"), late("teds_provision.vault.hardening")
    client = late("teds_provision.client")  # HTTP: only if a base station is running
    json = late("json")
    console = late("teds_provision.cli.console")  # imports rich
    problem = late("teds_provision.shapes.problem")  # the form of an error as JSON
    Console = RenderableType = Station = object  # used only in annotations, which are never evaluated

__all__ = ["App", "Console", "RenderableType", "Station", "pass_app"]

_BEHIND = " [y/N]: "
_PRINTING = threading.Lock()
SOCKET: Final = "ncap.sock"
"""``client.SOCKET``; that module is loaded only if the socket exists."""
_SERVICE_SECONDS: Final = 5.0


class App:
    """One run of the command line. Results go to stdout, everything else to stderr."""

    current: ClassVar[App | None] = None

    def __init__(
        self,
        *,
        home: Path | None = None,
        as_json: bool = False,
        verbose: int = 0,
        quiet: bool = False,
        debug: bool = False,
        no_input: bool = False,
        passphrase_fd: int | None = None,
    ) -> None:
        self.home = home_of(home)
        self.json, self.verbose, self.quiet, self.debug = as_json, verbose, quiet, debug
        self.no_input = no_input or as_json
        self._passphrase_fd = passphrase_fd
        self._passphrase: str | None = None
        self._closers: list[Callable[[], None]] = []
        self.live_line: Callable[[], None] = lambda: None
        """Removes a live progress line; called before any other output or question."""
        if verbose or debug:
            _log_to_stderr(logging_level=10 if debug or verbose > 1 else 20, libraries=debug)
        App.current = self

    # -- output ----------------------------------------------------------------------------------------------------

    def emit(self, result: dict[str, Any], human: Callable[[Console], None] | RenderableType | None = None) -> None:
        """Print a command's result: one JSON object on one line with --json, else ``human`` on stdout.

        ``human`` is a rich renderable (or a str), or a function that is given the console.
        """
        self.live_line()
        with self._answering():
            if self.json:
                print(to_json(result), flush=True)
            elif human is not None:
                self._print(human)
                sys.stdout.flush()

    def lines(self, lines: Sequence[str]) -> None:
        """Print a part of a result that has many lines, each of them unchanged."""
        self.live_line()
        with self._answering():
            print("\n".join(lines), flush=True)

    @contextmanager
    def _answering(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            raise
        # the work is done and stored; with --json the caller must learn that the result was not printed
        except OSError as error:
            discard_output(sys.stdout)
            text = f"Cannot write the result to stdout: {error.strerror}."
            if self.json:
                raise StoreError(text, hint="The work itself is done. Free some space before the next run.") from error
            self.note(text)

    def _print(self, human: Callable[[Console], None] | RenderableType) -> None:
        if isinstance(human, str) and not sys.stdout.isatty():  # plain text needs no rich
            print(sanitize(human))
            return
        console = self.console()
        if callable(human):
            human(console)
        elif isinstance(human, str):
            console.print(sanitize(human), markup=False)
        else:
            console.print(human)

    def conclude(
        self,
        result: dict[str, Any],
        human: Callable[[Console], None] | RenderableType | None,
        error: TedsProvisionError | None,
    ) -> None:
        """Print a result and the error that it ends with, if any: with --json both in the one object."""
        if error is None or not self.json:
            self.emit(result, human)
            if error is not None:
                raise error
            return
        self.emit({**result, "error": problem.problem_of(error)})
        raise click.exceptions.Exit(error.exit_code)

    def console(self, *, stderr: bool = False) -> Console:
        """Return a rich console; colour yields to NO_COLOR and to a pipe, long lines are not broken in a pipe."""
        stream = sys.stderr if stderr else sys.stdout
        return console.CleanConsole(stderr=stderr, highlight=False, soft_wrap=not stream.isatty())

    def note(self, text: str, *, level: int = 0) -> None:
        """Print a note on stderr, unless --quiet (or fewer ``-v`` than ``level``); not with --json."""
        if not self.quiet and not self.json and self.verbose >= level:
            self.live_line()
            print_message(text)

    def warn(self, text: str) -> None:
        """Warn on stderr, also with --json; only --quiet silences it."""
        self.live_line()
        if not self.quiet:
            print_message(f"Warning: {text}")

    def fail_line(self, error: TedsProvisionError, **of: object) -> None:
        """Print an error that does not end the command (``--watch``): one JSON object, or a line on stderr.

        ``of`` has its context: uuid, time, row of a sheet; None is left out.
        """
        self.live_line()
        known = {name: value for name, value in of.items() if value is not None}
        if self.json:
            print(to_json({**known, "error": problem.problem_of(error)}), flush=True)
        else:
            where = ", ".join(f"row {value}" if name == "row" else str(value) for name, value in known.items())
            at = f" ({where})" if where else ""
            lines = f"Error{at}: {error.message}" + (f"\n  → {error.hint}" if error.hint else "")
            print_message(lines)

    # -- prompts ---------------------------------------------------------------------------------------------------

    @property
    def interactive(self) -> bool:
        """True if the user can be asked: a terminal, and neither --no-input nor --json."""
        return not self.no_input and sys.stdin.isatty()

    def confirm(self, question: str, *, yes: bool, named: str = "") -> None:
        """Ask before something that cannot be undone; ``yes`` is the command's --yes.

        ``named`` is the option that must be given with it. Raises PolicyError if the answer is no, or there is no
        terminal.
        """
        if yes:
            return
        if not self.interactive:
            raise PolicyError(
                f"This needs confirmation, but there is no terminal to ask on. {question}"
                if named
                else "This needs confirmation, but there is no terminal to ask on.",
                hint=f"Add {named} --yes." if named else "Add --yes, or --dry-run to see the plan.",
            )
        if not self.ask_yes_no(question):
            raise PolicyError("Cancelled. Nothing was changed.")

    def ask_yes_no(self, question: str) -> bool:
        """Ask a person, yes or no; nothing that a node or a file brought steers the terminal."""
        self.live_line()
        return click.confirm(_as_question(question), err=True)

    def ask_text(self, question: str, default: str) -> str:
        """Ask for a text on the terminal; an empty answer is ``default``."""
        self.live_line()
        asked = _as_question(f"{question} [{default}]" if default else question)
        return str(click.prompt(asked, default=default, err=True, show_default=False)).strip()

    def chooses_item(self) -> ChooseItem | None:
        """Return who is asked which result of a certificate is meant: a person at a terminal."""
        answers: dict[str, str] = {}  # the same file is read again when its board arrives

        def ask(question: str, items: Sequence[tuple[str, str]]) -> str:
            if question in answers:
                return answers[question]
            self.note(f"{question}:")
            for known, title in items:
                self.note(f"  {known}: {title}")
            self.live_line()
            choices = click.Choice([known for known, _ in items])
            answers[question] = click.prompt(_as_question("Which one"), type=choices, err=True)
            return answers[question]

        return ask if self.interactive else None

    def ask_for_key(self, question: str, fingerprint: str) -> bool:
        """Ask a person whether a key counts: yes, no, or its digits (32 to 64, or a scanned label), held against it."""
        self.live_line()
        while True:
            asked = _as_question(f"{question} [y/N], or type the first 32 digits of its key")
            answer = click.prompt(asked, default="n", show_default=False, err=True).strip()
            if answer.lower() in ("y", "yes", "n", "no"):
                return answer.lower().startswith("y")
            label = labels.read_label(answer)
            digits = label[1] if label is not None else fingerprints.read_fingerprint(answer)
            if digits is not None and not fingerprints.same_key(digits, fingerprint):
                print_message("These digits belong to a different key.")
                return False
            if digits is not None:
                return True
            print_message("Answer y or n, or type 32 to 64 digits of the fingerprint.")

    @property
    def has_passphrase(self) -> bool:
        """True if a passphrase was given by --passphrase-fd, so that no prompt is needed."""
        return self._passphrase_fd is not None

    def ask_secret(self, prompt: str, confirm: bool = False) -> str:
        """Get a passphrase or PIN: from --passphrase-fd (one line, read once), else from the terminal."""
        hardening.harden()
        if self._passphrase_fd is not None:
            if self._passphrase is None:
                self._passphrase = read_line(self._passphrase_fd)
            return self._passphrase
        return self._typed(prompt, confirm=confirm, instead="--passphrase-fd 3 3<FILE")

    def ask_new(self, prompt: str) -> str:
        """Get a new passphrase if --passphrase-fd gives the old one: from the terminal, typed twice."""
        return self._typed(prompt, confirm=True, instead="--new-passphrase-fd 4 4<FILE")

    def _typed(self, prompt: str, *, confirm: bool, instead: str) -> str:
        if self.no_input or not sys.stdin.isatty():
            raise NoPassphraseError(
                f"{prompt.rstrip(': ')} is needed, but there is no terminal to ask on.",
                hint=f"Pass it through a file descriptor: {instead}.",
            )
        self.live_line()
        answer: str = click.prompt(_as_question(prompt), hide_input=True, confirmation_prompt=confirm, err=True)
        return answer

    # -- the station -----------------------------------------------------------------------------------------------

    def station(self) -> Station:
        """Open this base station (store now, vault when a key is first needed); NotFoundError points to init."""
        station = stations.Station.open(self.home, ask=self.ask_secret, notify=self.warn)
        station.notice = self.note
        station.use_agent = not self.has_passphrase
        station.released = self._released
        station.service_runs = self._service_runs
        self.closing(station.close)
        return station

    def inspected(self) -> Station:
        """Open the station of this home to look at it, also one whose init was not finished; raises StoreError."""
        station = stations.Station.inspect(self.home, ask=self.ask_secret)
        self.closing(station.close)
        return station

    def running_service(self, *, timeout: float) -> Client | None:
        """Return a client of the running `ncap` of this home, None if there is none."""
        return client.connect(home=self.home, timeout=timeout) if (self.home / SOCKET).exists() else None

    def _released(self, uuid: bytes, command: str) -> AbstractContextManager[object]:
        """Have the running `ncap` of this home let a node go that it measures."""
        if not (self.home / SOCKET).exists():
            return nullcontext()
        return client.connect(home=self.home).released(uuid.hex(), command)

    def _service_runs(self) -> bool:
        service = self.running_service(timeout=_SERVICE_SECONDS)
        if service is None:
            return False
        try:
            with service:
                service.status()
        except LinkError:  # the service has just ended
            return False
        return True

    def closing(self, close: Callable[[], None]) -> None:
        """Register what is to be closed when the command ends, however it ends."""
        self._closers.append(close)

    def close(self) -> None:
        """Close everything that was registered, last first; a second call does nothing."""
        self.live_line()
        while self._closers:
            self._closers.pop()()


def print_message(text: str) -> None:
    """Print on stderr; foreign text in it steers no terminal, and no word is broken at its edge."""
    with _PRINTING:  # threads take turns, so lines are not mixed
        sys.stderr.write(f"{folded(sanitize(text), sys.stderr)}\n")
        sys.stderr.flush()


def _as_question(question: str) -> str:
    """Return a question as it is shown, with room for click's suffix."""
    return folded(sanitize(question), sys.stderr, spare=len(_BEHIND))


def discard_output(stream: TextIO) -> None:
    """Send what is still buffered nowhere: the interpreter would fail on it once more at its end."""
    with suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def to_json(value: object, *, indent: int | None = None) -> str:
    """Return JSON for stdout: characters unchanged if it takes UTF-8, else escaped."""
    wide = (sys.stdout.encoding or "utf-8").lower().replace("-", "") == "utf8"
    return sanitize_json(json.dumps(value, ensure_ascii=not wide, indent=indent))


def read_line(descriptor: int) -> str:
    """Read a secret: one line of a file descriptor; raises UsageError (not readable), WrongPassphraseError (empty)."""
    try:
        with os.fdopen(os.dup(descriptor), "rb") as stream:
            line = stream.readline(4096)
    except OSError as error:
        raise UsageError(f"Cannot read --passphrase-fd {descriptor}: {error.strerror}.") from error
    text = line.decode(errors="surrogateescape").rstrip("\r\n")
    if not text:
        raise WrongPassphraseError(f"--passphrase-fd {descriptor} returned an empty line.")
    return text


def _log_to_stderr(*, logging_level: int, libraries: bool) -> None:
    """Log what we do (never a payload) on stderr; libraries too with --debug."""
    import logging

    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s"))
    logger = logging.getLogger() if libraries else logging.getLogger("teds_provision")
    logger.addHandler(handler)
    logger.setLevel(logging_level)


pass_app = click.make_pass_decorator(App)


# Plain text on a terminal: wrapped between words, never inside one. A pipe gets it unwrapped.

_NARROWEST: Final = 20
_COMMAND: Final = ": teds-provision "
_HINT: Final = "→ "


def folded(text: str, stream: TextIO, *, spare: int = 0) -> str:
    """Return the text with no line longer than the terminal behind ``stream``, less ``spare`` columns.

    A longer word stays whole (the terminal breaks it), and so does a command line at the end of a sentence, which
    begins a separate line: a copy of it can be run.
    """
    width = _columns(stream) - spare
    if width < _NARROWEST:
        return text
    return "\n".join(line if len(line) <= width else _fold(line, width) for line in text.split("\n"))


def _columns(stream: TextIO) -> int:
    """Return the columns of the terminal, 0 if unknown."""
    try:
        return os.get_terminal_size(stream.fileno()).columns if stream.isatty() else 0
    except (OSError, ValueError):
        return 0


def _fold(line: str, width: int) -> str:
    lead = " " * (len(line) - len(line.lstrip(" ")))
    rest = line[len(lead) :]
    later = lead + " " * len(_HINT) if rest.startswith(_HINT) else lead
    at = rest.find(_COMMAND)
    words = rest.split(" ") if at < 0 else [*rest[: at + 1].split(" "), rest[at + 2 :]]
    lines, current = [], lead + words[0]
    for word in words[1:]:
        if len(current) + 1 + len(word) <= width:
            current += f" {word}"
        else:
            lines.append(current.rstrip(" "))
            current = later + word
    return "\n".join([*lines, current])
