"""How much of the house a factory node passes through: modules entered by its ``provision``, own functions called.

``python -m benchmarks.entered``; `make house` prints its last line. One node over NFC in a process of its own is
provisioned in this one, from the look for a tag to the verdict; only calls of functions of ours are counted.
"""

from __future__ import annotations

import secrets
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from inspect import CO_OPTIMIZED
from pathlib import Path
from types import FrameType

from benchmarks.provisioning import PROFILE, next_node, nodes
from teds_provision.links import LinkSettings, Notice, open_port
from teds_provision.links.ports import free_port
from teds_provision.station.station import Station, initialise
from teds_provision.steps.build import BuildOrder, prepare
from teds_provision.steps.provision import provision
from teds_provision.talk.conversation import Conversation
from teds_provision.talk.progress import Silent
from teds_provision.vault.passphrase import THROWAWAY

PACKAGE = str(Path(__file__).resolve().parent.parent / "teds_provision")


@contextmanager
def counted(calls: Counter[str]) -> Iterator[None]:
    """Count the calls of our functions by file, in every thread that begins now."""

    def called(frame: FrameType, event: str, _argument: object) -> None:
        code = frame.f_code
        # Neither a module's own code nor a class's is optimised: they run when it is imported, and are no calls.
        if event == "call" and code.co_flags & CO_OPTIMIZED and code.co_filename.startswith(PACKAGE):
            calls[code.co_filename] += 1

    sys.setprofile(called)
    threading.setprofile(called)
    try:
        yield
    finally:
        sys.setprofile(None)
        threading.setprofile(None)


def provision_one(station: Station, calls: Counter[str]) -> None:
    """Provision one factory node, and count."""
    link = f"udp:127.0.0.1:{free_port()}"
    with nodes("nfc", link) as process:
        uuid, _ = next_node(process)
        with counted(calls):
            order = prepare(station, BuildOrder(PROFILE))
            port = open_port(LinkSettings("nfc", nfc=link))
            try:
                found = port.find(lambda identity: identity.uuid == uuid, seconds=20, notice=_quiet)
                with Conversation(found, notice=_quiet) as node:
                    done = provision(station, node, order, accept=lambda who: None, reporter=Silent())
            finally:
                port.close()
    assert done.verified.verdict == "authentic"


def _quiet(_notice: Notice) -> None:
    return None


def main() -> None:
    """Provision, count, tell."""
    secret = secrets.token_hex(8)
    calls: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        station, _ = initialise(
            Path(folder) / "home", name="bench", keystore="file", ask=lambda prompt, confirm: secret, costs=THROWAWAY
        )
        provision_one(station, calls)
        station.close()
    for file, count in calls.most_common(10):
        print(f"{count:6} {Path(file).relative_to(PACKAGE)}")
    print(f"{len(calls)} modules entered, {calls.total()} own functions called")


if __name__ == "__main__":
    main()
