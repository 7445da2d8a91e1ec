"""What the demo works on: its folder, its links, the node, and the look at it from one station."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from teds_provision.errors import NotAuthentic
from teds_provision.links import LinkSettings
from teds_provision.links.loopback import free_port
from teds_provision.station.station import Station
from teds_provision.steps.agree import require_session
from teds_provision.steps.build_order import BuildOrder
from teds_provision.steps.identify import identify
from teds_provision.steps.provision import Provisioned, provision
from teds_provision.steps.read import read_image
from teds_provision.steps.verify import require_authentic
from teds_provision.steps.verify_node import verify_node
from teds_provision.talk.meeting import meet
from teds_provision.talk.progress import Reporter, Steps


@dataclass
class Demo:
    """What the demo is at: its folder, stations, links and the steps so far."""

    folder: Path
    reporter: Reporter
    say: Callable[[str], None]
    nfc: str = ""
    can: str = ""
    uuid: bytes = b""
    stack: ExitStack = field(default_factory=ExitStack)

    def __post_init__(self) -> None:
        self.steps = Steps(self.reporter)
        self.nfc = f"udp:127.0.0.1:{free_port()}"
        self.can = f"udp_multicast:239.74.163.2?port={free_port()}"

    def over(self, via: str) -> LinkSettings:
        """Link options of a station in this demo."""
        return LinkSettings(via, self.nfc, self.can, timeout=15.0)


def provision_over(demo: Demo, station: Station, via: str, uuid: bytes, order: BuildOrder) -> Provisioned:
    """Every step of provisioning, from one station over one link; raises unless the node is authentic at the end."""
    with meet(station, demo.over(via), uuid, demo.reporter) as node:
        done = provision(station, node, order, accept=lambda who: None, reporter=demo.reporter)
    require_authentic(done.verified)
    demo.steps.done += done.steps
    return done


def verify_from(demo: Demo, station: Station, what: str) -> None:
    """Verify the node from one station over CAN, in a session under its key; raises unless it is authentic."""
    with demo.steps.step(what) as step:
        with meet(station, demo.over("can"), demo.uuid, demo.reporter) as node:
            who = identify(station, node)
            held = require_session(station, node)
            verified = verify_node(station, node, read_image(node), who.point)
        if verified.verdict != "authentic":
            raise NotAuthentic(f"The demo's node is {verified.verdict} as seen from {station.name}.")
        step.detail = f"{station.name} finds it {verified.verdict}, key epoch {held.record.epoch}"
