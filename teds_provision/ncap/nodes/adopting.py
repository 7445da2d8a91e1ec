"""Nodes that are taken up without being asked for.

Virtual transducers of this station, whose key it made itself; and factory nodes of a wired bus where the operator said
so (`--adopt`, transparent mode; operation.md section 7, assurance ``bus``).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from teds_provision.ncap.live import Live
from teds_provision.ncap.nodes.roster import Roster
from teds_provision.ncap.nodes.virtual import Virtuals
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.station.station import Station
from teds_provision.steps.agree import agree
from teds_provision.steps.build_order import BuildOrder
from teds_provision.steps.identify import identify
from teds_provision.steps.provision import newcomer, provision
from teds_provision.steps.verify import Verified
from teds_provision.steps.visits.sheet_file import write_sheet
from teds_provision.talk.conversation import Conversation
from teds_provision.talk.progress import Silent
from teds_provision.teds.formats import placed


class Adopting:
    """Takes up what may be; ``adopts`` says whether factory nodes of a bus are among it."""

    def __init__(
        self, station: Station, roster: Roster, live: Live, virtuals: Virtuals, adopts: Callable[[], bool]
    ) -> None:
        self._station, self._roster, self._live = station, roster, live
        self._virtuals, self._adopts = virtuals, adopts

    def serve(self, node: Conversation) -> bool:
        """Take up a node in factory state; False where it is not to be, or has been. Raises as the steps do."""
        if node.tapped or node.identity.state != NodeState.FACTORY:
            return False
        uuid = node.uuid.hex()
        if uuid in self._virtuals:
            verified = self._virtual(node, uuid)
            self._note(uuid, verified=time.time(), verdict=verified)
            return True
        if (
            self._adopts()
            and node.contact.link.capabilities.wired
            and self._station.policy.tombstone(node.uuid) is None
        ):
            who = identify(self._station, node)
            entry = None if who.whitelisted is not None else newcomer(self._station, node, who)
            with self._station.turn(node.uuid):
                agree(self._station, node, who, newcomer=entry)
            self._station.audit("adopt", node.uuid, "done", fingerprint=who.fingerprint)
            self._live.event("node", uuid=uuid, state="adopted")
        return False  # it has a key now, and is looked at like any other

    def _virtual(self, node: Conversation, uuid: str) -> Verified:
        """A virtual transducer gets the datasheet that it was made from."""
        station, profile = self._station, self._virtuals.profile_of(uuid)
        if profile is not None:
            order = BuildOrder(
                profile, calibration=self._virtuals.calibration_of(uuid), name=self._virtuals.name_of(uuid) or None
            )
            return provision(station, node, order, accept=lambda _who: None, reporter=Silent()).verified
        blocks = placed((self._virtuals.document_of(uuid) or "").encode())
        with station.turn(node.uuid):
            agree(station, node, identify(station, node))
            done = write_sheet(station, node, blocks, Silent())
        if self._virtuals.name_of(uuid):
            station.nodes.remember(node.uuid, name=self._virtuals.name_of(uuid))
        return done.verified

    def _note(self, uuid: str, *, verified: float, verdict: Verified) -> None:
        facts: dict[str, Any] = {"verdict": verdict.verdict, "heard": None, "looked": verified}
        self._roster.show_sheet(uuid, None)
        self._roster.refresh([uuid])
        self._roster.note(uuid, "verified", problem=None, **facts)
