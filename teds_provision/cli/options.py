"""Options that several commands share."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click
from click.core import ParameterSource

from teds_provision.cli.context import SOCKET, App
from teds_provision.errors import NotFoundError, StoreError
from teds_provision.files import require_no_pipe
from teds_provision.lazy import late
from teds_provision.protocol.fingerprints import read_fingerprint

if TYPE_CHECKING:
    from teds_provision import client, links
    from teds_provision.measure.sinks import foxglove_server
    from teds_provision.teds import certificate
    from teds_provision.trace import recorder
else:
    certificate = late("teds_provision.teds.certificate")  # imports the codec: only with a calibration
    client = late("teds_provision.client")  # HTTP: only if a base station is running
    foxglove_server = late("teds_provision.measure.sinks.foxglove_server")
    links = late("teds_provision.links")  # only for commands that reach a node
    recorder = late("teds_provision.trace.recorder")  # most runs have no trace

Function = TypeVar("Function", bound=Callable[..., Any])

COMMAND_SETTINGS: dict[str, Any] = {"auto_envvar_prefix": "TEDS_PROVISION"}
"""context_settings of every command: each option also reads TEDS_PROVISION_<NAME>."""


def examples(*lines: str) -> str:
    """Return the epilog of a command's help: lines that were run unchanged."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


def command(*lines: str, **attributes: Any) -> Callable[[Callable[..., Any]], click.Command]:
    """Make a click command whose options read TEDS_PROVISION_<NAME>; ``lines`` are the examples of its help."""
    settings = COMMAND_SETTINGS | attributes.pop("context_settings", {})
    return click.command(context_settings=settings, epilog=examples(*lines), **attributes)


class Number(click.FloatRange):
    """A finite number within bounds: NaN is within all bounds of click, and nothing can be done with it."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read a number; raises BadParameter."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


class WholeNumber(click.IntRange):
    """A whole number within bounds, with a matching message."""

    means = "whole number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read a whole number; raises BadParameter."""
        if isinstance(value, str) and not value.strip().lstrip("+-").isdecimal():
            self.fail(f"{value!r} is not a {self.means}.", param, ctx)
        return super().convert(value, param, ctx)


class FileToRead(click.Path):
    """A file that is read: if a folder is there, there is no such file (3); a file to be written has a usage error (2).

    ``exists``: it must exist; else its reader raises the error.
    """

    def __init__(self, *, exists: bool = False) -> None:
        super().__init__(path_type=Path)
        self._must_exist = exists

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> str | bytes | os.PathLike[str]:
        """Read a path; raises NotFoundError."""
        path = super().convert(value, param, ctx)
        if os.path.isdir(path):
            raise NotFoundError(f"{os.fsdecode(path)} is a folder, not a file.")
        if self._must_exist and not os.path.exists(path):
            raise NotFoundError(f"There is no file {os.fsdecode(path)}.")
        require_no_pipe(Path(os.fsdecode(path)))
        return path


class CalibrationFile(FileToRead):
    """A calibration file, ``FILE`` or ``N=FILE`` for channel N alone: (N or None, path)."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read a path and the channel before it; raises NotFoundError."""
        if isinstance(value, tuple):
            return value
        channel, file = certificate.split_channel(os.fsdecode(value))
        if channel is not None and not 1 <= channel <= 255:
            self.fail(f"{channel} is not a channel number, 1 to 255.", param, ctx)
        return channel, super().convert(value if channel is None else file, param, ctx)


def file_units_option(function: Function) -> Function:
    """Add --unit, which config.toml calls file-units: ``file_units``."""
    return click.option(
        "--file-units",
        "--unit",
        "file_units",
        type=click.Choice(["si", "shown"]),
        default="si",
        show_default=True,
        help="Units of values in files: SI, or as they are shown to people; .mcap is always in SI.",
    )(function)


class Day(click.DateTime):
    """A day like 2027-10-31, as its first moment in UTC."""

    name = "date"

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """Return the name as help shows it, in place of a list of formats."""
        return self.name.upper()

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read a day; raises BadParameter."""
        if isinstance(value, datetime):
            return value
        try:
            day = date.fromisoformat(str(value))
        except ValueError:
            self.fail(f"{value!r} is not a date; write it like 2027-10-31.", param, ctx)
        return datetime(day.year, day.month, day.day, tzinfo=UTC)


class ChannelName(WholeNumber):
    """A TransducerChannel by its number, from ``least`` to 255, or its name in the datasheet: an int or a str."""

    name = "channel"

    def __init__(self, least: int = 1) -> None:
        super().__init__(least, 255)
        self.means = f"channel number, {least} to 255, or a channel's name"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read a number; anything else but a number is a name, which the datasheet resolves."""
        text = str(value).strip()
        if text and text.isprintable() and not _NUMBER.fullmatch(text):
            return text
        return super().convert(value, param, ctx)


_NUMBER: Final = re.compile(r"[-+]?[0-9.]+")


class Seconds(Number):
    """A time in seconds, with a matching message."""

    name = "seconds"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read a number of seconds; raises BadParameter."""
        try:
            float(value)
        except (TypeError, ValueError):
            self.fail(f"{value!r} is not a number of seconds, e.g. 30 or 2.5.", param, ctx)
        return super().convert(value, param, ctx)


@contextmanager
def readers_for(via: str) -> Iterator[None]:
    """Borrow the readers of a running base station (`ncap run`) of this home for a command that needs one."""
    app = App.current
    if via != "nfc" or app is None or not (app.home / SOCKET).exists():
        yield
        return
    with client.connect(home=app.home).readers():
        yield


def link_options(function: Function) -> Function:
    """Add --via, --nfc and --can (several for some commands), --ble, --timeout, --trace; gives ``links``."""
    from functools import wraps

    @wraps(function)
    def with_links(
        *args: Any,
        via: str,
        nfc: tuple[str, ...],
        can: tuple[str, ...],
        ble: str | None,
        timeout: float,
        trace: Path | None,
        **rest: Any,
    ) -> Any:
        named = can[0] if len(can) == 1 else can or None
        chosen = click.get_current_context().get_parameter_source("via") is not ParameterSource.DEFAULT
        here = options_given("nfc", "can", "ble")
        reader_chosen = "nfc" in here
        if not chosen and (here == {"can"} or (here == {"ble"} and not nfc)):  # naming one link chooses it
            via, chosen = here.pop(), True
        with tracing(trace) as opened, readers_for(via):
            # The setting in config.toml limits the wait for a tap; --timeout on the command line also limits the search
            # here.
            listen = timeout if options_given("timeout") else links.ports.LISTEN_SECONDS
            settings = links.LinkSettings(
                via, nfc or None, named, ble, timeout, opened, listen, chosen, reader_chosen=reader_chosen
            )
            return function(*args, links=settings, **rest)

    options = [
        click.option(
            "--via",
            type=click.Choice(list(links.LINKS)),
            default="nfc",
            show_default=True,
            help="The link to use; without it, the one link that is named, or the bus on which the node was last met.",
        ),
        click.option(
            "--nfc",
            metavar="PATH",
            multiple=True,
            help="Reader: auto (the one that is connected), usb, usb:072f:2200, tty:USB0:pn532, udp:localhost:54321; "
            "several with --watch.",
        ),
        click.option(
            "--can",
            metavar="INTERFACE:CHANNEL",
            multiple=True,
            help="Bus: socketcan:can0, udp_multicast:239.74.163.2, …; several with measure.",
        ),
        click.option(
            "--ble",
            metavar="ADAPTER",
            help="Bluetooth: auto, hci0, 'hci0?address=C1:D8:57:00:01:01'; with --nfc, identify and agree use the "
            "reader and the rest uses Bluetooth.",
        ),
        click.option(
            "--timeout",
            type=Seconds(min=0.1),
            default=60.0,
            show_default=True,
            metavar="SECONDS",
            help="How long to wait for the node; also how long identify and provision --all listen on CAN or BLE.",
        ),
        click.option(
            "--trace",
            metavar="FILE",
            type=click.Path(path_type=Path, dir_okay=False),
            help="Record every frame, with sealed ones decrypted; use FILE.pcapng for Wireshark. See: trace show.",
        ),
    ]
    wrapped: Any = with_links
    for option in reversed(options):
        wrapped = option(wrapped)
    return wrapped  # type: ignore[no-any-return]


def links_given(ctx: click.Context) -> bool:
    """Return True if an option (or setting) of this run selects the link to a node."""
    return any(ctx.get_parameter_source(name) != ParameterSource.DEFAULT for name in ("via", "nfc", "can", "ble"))


def options_given(*names: str) -> set[str]:
    """Return which of these options were given explicitly on the command line."""
    ctx = click.get_current_context()
    return {name for name in names if ctx.get_parameter_source(name) == ParameterSource.COMMANDLINE}


def foxglove_options(function: Function) -> Function:
    """Add --foxglove, --foxglove-at, --no-scalars."""
    for option in (
        click.option("--no-scalars", is_flag=True, help="Leave out the single-value topics of MCAP and Foxglove."),
        click.option("--foxglove-at", metavar="HOST:PORT", help="Serve Foxglove on this address instead."),
        click.option("--foxglove", is_flag=True, help="Serve live values to Foxglove on 127.0.0.1:8765."),
    ):
        function = option(function)
    return function


def foxglove_address(foxglove: bool, foxglove_at: str | None) -> str | None:
    """Return HOST:PORT of the server that the options ask for, None for none."""
    return foxglove_at or (foxglove_server.USUAL if foxglove else None)


def exposure_options(function: Function) -> Function:
    """Add --http-allow, --tls-cert, --tls-key: what a server needs to be reached from other machines."""
    for option in (
        click.option(
            "--tls-key",
            "key",
            type=FileToRead(exists=True),
            metavar="FILE",
            help="Private key of the certificate, PEM.",
        ),
        click.option(
            "--tls-cert", "certificate", type=FileToRead(exists=True), metavar="FILE", help="Certificate chain, PEM."
        ),
        click.option(
            "--http-allow",
            "allow",
            multiple=True,
            metavar="HOST",
            help="Host name under which clients on other machines may connect; repeatable.",
        ),
    ):
        function = option(function)
    return function


def fingerprint_option(says: str) -> Callable[[Function], Function]:
    """Add --fingerprint: 32 to 64 hex digits, given as they are read out (blanks, colons)."""

    def read(_ctx: click.Context, _parameter: click.Parameter, text: str | None) -> str | None:
        digits = None if text is None else read_fingerprint(text)
        if text is not None and digits is None:
            raise click.BadParameter("a fingerprint has 64 hex digits; give at least the first 32.")
        return digits

    return click.option("--fingerprint", "-f", callback=read, metavar="F", help=says)


def yes_option(function: Function) -> Function:
    """Add --yes: no question is asked."""
    return click.option("--yes", "-y", is_flag=True, help="Do not ask for confirmation.")(function)


def dry_run_option(function: Function) -> Function:
    """Add --dry-run: print the plan, change nothing."""
    return click.option("--dry-run", is_flag=True, help="Print the plan without changing anything.")(function)


# ``--trace FILE``: the file is created before the command waits for anything, and closed with the command.


@contextmanager
def tracing(path: Path | None) -> Iterator[links.Trace | None]:
    """Yield the trace that ``path`` names, None for none. A command with an incomplete trace, and all else well, is 7.

    Raises UsageError if the file exists already, NotFoundError without its folder, StoreError.
    """
    if path is None:
        yield None
        return
    app = App.current
    trace = recorder.open_trace(path, app.warn if app is not None else print)
    try:
        yield trace
    except BaseException:  # if no frame was recorded the file is removed, so that the command can be repeated
        trace.close(keep_empty=False)
        raise
    trace.close()
    if trace.failure:  # reported when it happened; the result is on stdout already
        raise click.exceptions.Exit(StoreError.exit_code)
