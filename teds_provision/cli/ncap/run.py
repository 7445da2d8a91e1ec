"""``ncap run``: the daemon in the foreground, for a terminal or for systemd."""

from __future__ import annotations

import importlib.util
import os
import sys
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from teds_provision.cli.configuration import brokers_of, config_path
from teds_provision.cli.context import App, pass_app, to_json
from teds_provision.cli.options import FileToRead, WholeNumber, command, tracing
from teds_provision.errors import UsageFailure
from teds_provision.lazy import how_to_install, late

if TYPE_CHECKING:
    from teds_provision.ncap import running, settings
else:
    running, settings = late("teds_provision.ncap.running"), late("teds_provision.ncap.settings")

MOST: Final = 1000  # lines that may wait for somebody to read them
LEAVING: Final = 2.0  # seconds for them to leave at the end
_NEEDED = ("starlette", "uvicorn", "websockets")
_FILE = FileToRead(exists=True)


@command(
    "teds-provision ncap run --http 127.0.0.1:8351 --can socketcan:can0 --nfc usb",
    "teds-provision ncap run --can socketcan:can0 --record /var/lib/measured --mqtt mqtt://broker",
    name="run",
)
@click.option("--detection", type=click.Choice(["transparent", "whitelist"]), help="Which nodes are taken up.")
@click.option("--adopt", is_flag=True, help="In transparent mode, agree with factory nodes on a wired bus.")
@click.option("--http", metavar="HOST:PORT", help="Serve the page and the API there, e.g. 127.0.0.1:8351.")
@click.option("--http-allow", "allow", multiple=True, metavar="HOST", help="Another name by which browsers may call.")
@click.option("--tls-cert", "certificate", type=_FILE, metavar="FILE", help="Certificate chain, PEM.")
@click.option("--tls-key", "key", type=_FILE, metavar="FILE", help="Its private key, PEM.")
@click.option("--record", type=click.Path(path_type=Path, file_okay=False), metavar="DIR", help="Record everything.")
@click.option("--ros1", is_flag=True, help="Publish to ROS 1 (ROS_MASTER_URI).")
@click.option("--ros2", is_flag=True, help="Publish to ROS 2 (ROS_DOMAIN_ID), on this machine.")
@click.option("--mqtt", metavar="URL", help="Publish to a broker: mqtt://HOST.")
@click.option("--actuators/--no-actuators", default=True, show_default=True, help="Take set points from ROS topics.")
@click.option("--dead-man", type=WholeNumber(20, 10_000), default=1000, show_default=True, metavar="MS",
              help="An actuator without set points for so long is safe.")  # fmt: skip
@click.option("--metrics", is_flag=True, help="Serve /metrics for Prometheus.")
@click.option("--http-1451", "clause_12", is_flag=True, help="Serve the paths of IEEE 1451.0 clause 12, read only.")
@click.option("--nfc", multiple=True, metavar="PATH", help="A reader: auto, usb, udp:localhost:54321; several times.")
@click.option("--can", multiple=True, metavar="INTERFACE:CHANNEL", help="A bus: socketcan:can0; several times.")
@click.option("--ble", multiple=True, metavar="ADAPTER", help="Bluetooth: auto, hci0; several times.")
@click.option(
    "--trace",
    metavar="FILE",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write down every frame of every link; it grows without bound. See: trace show.",
)
@pass_app
def run(
    app: App,
    /,
    nfc: Sequence[str],
    can: Sequence[str],
    ble: Sequence[str],
    http: str | None,
    ros1: bool,
    ros2: bool,
    mqtt: str | None,
    trace: Path | None,
    **wished: Any,
) -> None:
    """Run the base station until SIGTERM or Ctrl-C.

    One line is printed when it is ready, then a line for each event.
    """
    _require_extra()
    places = [f"{link}:{one}" for link, named in (("can", can), ("nfc", nfc), ("ble", ble)) for one in named]
    sinks = [name for name, asked in (("ros1", ros1), ("ros2", ros2), (mqtt or "", mqtt)) if asked]
    wanted = settings.Settings(
        places=tuple(dict.fromkeys(places)),
        http=None if http is None else settings.parse_http(http),
        sinks=tuple(sinks),
        brokers=brokers_of(config_path(app.home)),
        **wished,
    )
    settings.require_safe(wanted)
    settings.require_places(wanted)
    station = app.station()
    station.unlock()  # nobody is asked for a passphrase later
    lines = Lines(app)
    with tracing(trace) as opened:
        running.run(station, replace(wanted, trace=opened), lines.tell)
    if not lines.end():
        os._exit(0)  # all has ended in order; a line that nobody takes would hold the end of the process up for ever


def _require_extra() -> None:
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageFailure(f"ncap run needs {', '.join(missing)}.", hint=how_to_install("ncap"))


class Lines:
    """The daemon's lines: JSON on stdout, or sentences on stderr; a thread of their own writes them.

    Whoever stops reading them, a script that wanted the first one or a terminal that is held by Ctrl-S, stops nothing:
    of more than MOST that wait the oldest go, and the next line says how many.
    """

    def __init__(self, app: App) -> None:
        self._app = app
        self._waiting: deque[dict[str, Any]] = deque()
        self._news = threading.Condition()
        self._dropped = 0
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="lines", daemon=True)
        self._thread.start()

    def tell(self, event: dict[str, Any]) -> None:
        """One line, from whichever thread; returns at once."""
        with self._news:
            if len(self._waiting) >= MOST:
                self._waiting.popleft()
                self._dropped += 1
            self._waiting.append(event)
            self._news.notify()

    def end(self) -> bool:
        """Write what waits; False where nobody takes it within LEAVING seconds."""
        with self._news:
            self._ending = True
            self._news.notify()
        self._thread.join(LEAVING)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._waiting or self._ending)
                if not self._waiting:
                    return
                events = [*self._waiting]
                if self._dropped:
                    events.insert(0, {"event": "lines", "state": "dropped", "count": self._dropped})
                self._waiting.clear()
                self._dropped = 0
            for event in events:
                self._write(event)

    def _write(self, event: dict[str, Any]) -> None:
        with suppress(OSError, ValueError):
            if self._app.json:
                sys.stdout.write(to_json(event) + "\n")
                sys.stdout.flush()
            else:
                self._app.note(_sentence(event))


def _sentence(event: dict[str, Any]) -> str:
    if event.get("ready"):
        where = event["url"] or f"the Unix socket {event['api'].removeprefix('unix:')}"
        return f"Ready on {where}. The page with its token: teds-provision ncap open"
    facts = {key: value for key, value in event.items() if key not in ("event", "time", "state") and value}
    told = ", ".join(f"{key} {_text(value)}" for key, value in facts.items())
    return f"{event['event']} {event.get('state', '')}: {told}"


def _text(value: Any) -> str:
    return str(value.get("message", value)) if isinstance(value, dict) else str(value)
