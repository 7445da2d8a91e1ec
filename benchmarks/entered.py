"""How much of the house a task passes through: modules entered by each of five verbs, own functions called.

``python -m benchmarks.entered``; `make house` prints its last line. One node over NFC in a separate process is
provisioned in this one, from the look for a tag to the verdict. Then ``identify``, ``verify``, ``measure`` and
``export-keys`` run whole, from their words to their exit code, against a node on a CAN bus. Only calls of functions of
ours are counted.
"""

from __future__ import annotations

import secrets
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from inspect import CO_OPTIMIZED
from pathlib import Path
from types import FrameType

from benchmarks.provisioning import PROFILE, next_node, nodes
from teds_provision.links import LinkSettings, Notice, open_port
from teds_provision.links.ports import free_port
from teds_provision.provisioning.build import BuildOrder, prepare
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.station.station import Station, initialise
from teds_provision.vault.passphrase import THROWAWAY
from tests.bench import PASSPHRASE, make_station
from tests.cli.shell import call
from tests.e2e.desk import ANGLE
from tests.handover.desk import trust
from tests.measure.rig import Rig

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
                    done = provision(station, node, order, operator=AcceptingOperator(), reporter=SilentReporter())
            finally:
                port.close()
    assert done.verified.verdict == "authentic"


def _quiet(_notice: Notice) -> None:
    return None


def verbs(folder: Path) -> Iterator[tuple[str, Counter[str]]]:
    """Run each verb on a station with one provisioned node on its bus, and count."""
    folder.mkdir()
    rig = Rig(folder, {"a": ANGLE})
    try:
        home = rig.station.home
        with (
            closing(make_station(folder / "other", "other")) as other,
            closing(Station.open(home, ask=lambda *_: PASSPHRASE)) as own,
        ):
            trust(own, other, "other")
        rig.nodes["a"].start()
        uuid, link = rig.nodes["a"].uuid, ("--can", rig.can, "--via", "can")
        commands: tuple[tuple[object, ...], ...] = (
            ("identify", *link),
            ("verify", uuid, *link),
            ("measure", uuid, "--duration", "1", *link),
            ("export-keys", "--to", "other", uuid, "--output", folder / "keys.jwe", "--yes"),
        )
        for words in commands:
            calls: Counter[str] = Counter()
            with counted(calls):
                done = call(home, "--json", *words)
            assert done.code == 0, done
            yield str(words[0]), calls
    finally:
        rig.close()


def main() -> None:
    """Provision, run the verbs, count them and print the result."""
    secret = secrets.token_hex(8)
    calls: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        station, _ = initialise(
            Path(folder) / "home", name="bench", keystore="file", ask=lambda prompt, confirm: secret, costs=THROWAWAY
        )
        provision_one(station, calls)
        station.close()
        for verb, entered in verbs(Path(folder) / "verbs"):
            print(f"{verb:12} {len(entered):4} modules entered, {entered.total()} own functions called")
    for file, count in calls.most_common(10):
        print(f"{count:6} {Path(file).relative_to(PACKAGE)}")
    print(f"{len(calls)} modules entered, {calls.total()} own functions called")


if __name__ == "__main__":
    main()
