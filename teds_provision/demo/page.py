"""The demo with a page: a running base station, three virtual transducers that it made, a measured group.

The station is the real one (``ncap run`` in a process), its home is thrown away, and it is reached on 127.0.0.1 alone.
A fourth node waits beside the simulated reader: powering it is a tap.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from teds_provision import client
from teds_provision.errors import LinkError, TedsProvisionError
from teds_provision.links.ports import free_port
from teds_provision.shapes.problem import problem_in
from teds_provision.station.station import initialise
from teds_provision.vault.passphrase import THROWAWAY

RATE: Final = 50.0
GROUP: Final = "crane"
NODES: Final = (
    ("magnetic-angular-position-sensor", "slew angle", "sine:8"),
    ("accelerometer", "boom", "sine:3"),
    ("gripper", "hand", "sine:5"),
)
_TAPPED: Final = "temperature-sensor"
_READY: Final = 60.0  # in seconds; enough for a loaded machine
_ENDING: Final = 15.0


@dataclass(frozen=True)
class PageDemo:
    """A running demo: the page's address with a token that works once, the home, and the command that places a node."""

    url: str
    home: Path
    tap: str


@contextmanager
def page_demo(say: Callable[[str], None], http: str | None = None) -> Iterator[PageDemo]:
    """Run it for the length of the block; the folder is gone afterwards. Raises what its commands raise."""
    folder = Path(tempfile.mkdtemp(prefix="teds-provision-page-"))
    try:
        home, secret, nfc = folder / "home", secrets.token_hex(16), f"udp:127.0.0.1:{free_port()}"
        say("A base station with its own keys, in a temporary folder.")
        station, _ = initialise(
            home, name="bench", keystore="file", ask=lambda prompt, confirm: secret, costs=THROWAWAY
        )
        station.close()
        where = http or f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        with _daemon(home, secret, "--http", where, "--nfc", nfc), client.connect(home=home) as api:
            say(
                "Three virtual transducers: created, provisioned and verified by the station, then measured as"
                " one group."
            )
            _measured(api)
            tapped = folder / "oven"
            _run("node", "create", str(tapped), "--profile", _TAPPED, "--name", "oven")
            yield PageDemo(api.login_url(), home, f"teds-provision node run {tapped} --nfc {nfc}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _measured(api: client.Client) -> None:
    uuids = []
    for profile, name, source in NODES:
        made = api.request("POST", "/virtual", {"profile": profile, "name": name, "source": source})
        uuids.append(made["uuid"])
    until = time.monotonic() + _READY

    def authentic(uuid: str) -> bool:
        verdict = api.node(uuid)["verdict"]
        return verdict is not None and verdict["verdict"] == "authentic"

    while not all(map(authentic, uuids)):
        if time.monotonic() > until:
            raise LinkError(f"The virtual transducers were not ready within {_READY:.0f} s.", hint="Try again.")
        time.sleep(0.2)
    api.request("POST", "/groups", {"name": GROUP, "uuids": uuids})
    api.measure(group=GROUP, rate=RATE)


@contextmanager
def _daemon(home: Path, secret: str, *options: str) -> Iterator[None]:
    read, write = os.pipe()
    os.write(write, f"{secret}\n".encode())
    os.close(write)
    command = [sys.executable, "-m", "teds_provision", "--home", str(home), "--json", "--passphrase-fd", str(read)]
    with (home / "events").open("w+b") as events:  # a file and no pipe, because only the first line is read
        try:
            process = subprocess.Popen(
                [*command, "ncap", "run", *options],
                stdin=subprocess.DEVNULL, stdout=events, stderr=subprocess.DEVNULL, pass_fds=(read,),
                process_group=0,  # Ctrl-C reaches only this process, which ends the station in order
            )  # fmt: skip
        finally:
            os.close(read)
        try:
            until = time.monotonic() + _READY
            while (
                b"\n" not in (first := (home / "events").read_bytes())
                and process.poll() is None
                and time.monotonic() < until
            ):
                time.sleep(0.05)
            if b'"ready"' not in first:
                raise _failure(first)
            yield
        finally:
            process.terminate()
            try:
                process.wait(_ENDING)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _run(*words: str) -> None:
    command = [sys.executable, "-m", "teds_provision", "--json", *words]
    done = subprocess.run(command, capture_output=True, check=False)
    if done.returncode:
        raise _failure(done.stdout)


def _failure(output: bytes) -> TedsProvisionError:
    """Return the error of a child process, from its line of JSON."""
    body: object = None
    with suppress(ValueError):
        body = json.loads(output)
    problem = problem_in(body, otherwise="The base station of the demo did not start.")
    return TedsProvisionError(problem["message"], hint=problem["hint"])
