"""``ncap run``: the daemon in the foreground, for a terminal or for systemd."""

from __future__ import annotations

import importlib.util
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from teds_provision.cli.context import App, pass_app, to_json
from teds_provision.cli.options import command
from teds_provision.errors import UsageFailure
from teds_provision.lazy import how_to_install, late

if TYPE_CHECKING:
    from teds_provision.ncap import running, settings
else:
    running, settings = late("teds_provision.ncap.running"), late("teds_provision.ncap.settings")

_NEEDED = ("starlette", "uvicorn", "websockets")
_FILE = click.Path(path_type=Path, dir_okay=False, exists=True)


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
@click.option("--metrics", is_flag=True, help="Serve /metrics for Prometheus.")
@click.option("--http-1451", "clause_12", is_flag=True, help="Serve the paths of IEEE 1451.0 clause 12, read only.")
@click.option("--nfc", multiple=True, metavar="PATH", help="A reader: auto, usb, udp:localhost:54321; several times.")
@click.option("--can", multiple=True, metavar="INTERFACE:CHANNEL", help="A bus: socketcan:can0; several times.")
@click.option("--ble", multiple=True, metavar="ADAPTER", help="Bluetooth: auto, hci0; several times.")
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
        **wished,
    )
    settings.require_safe(wanted)
    station = app.station()
    station.unlock()  # nobody is asked for a passphrase later
    running.run(station, wanted, Lines(app).tell)


def _require_extra() -> None:
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageFailure(f"ncap run needs {', '.join(missing)}.", hint=how_to_install(*missing))


class Lines:
    """The daemon's lines: JSON on stdout, or sentences on stderr. Whoever stops reading them stops nothing."""

    def __init__(self, app: App) -> None:
        self._app = app
        self._turn = threading.Lock()

    def tell(self, event: dict[str, Any]) -> None:
        """One line, whole, from whichever thread."""
        with self._turn, suppress(OSError, ValueError):
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
