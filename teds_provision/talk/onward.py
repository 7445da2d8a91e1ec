"""Tap first, air after: a node that was agreed with at the reader is gone on with over BLE (profile.md, "BLE").

It may lie there or be carried away meanwhile. The tap has named its address; its key says that it is the one.
"""

from __future__ import annotations

from collections.abc import Callable

from teds_provision.links import LinkSettings, open_place
from teds_provision.links.ports import NoticeSink
from teds_provision.protocol.messages.identity import Identity
from teds_provision.talk.conversation import Conversation


def onward(links: LinkSettings, notice: NoticeSink) -> Callable[[Conversation], None] | None:
    """How to go on once a key is agreed on: where both ``--nfc`` and ``--ble`` are named, over BLE; None where not.

    What is returned raises NoReader, NoNode (it does not advertise, or is out of reach), LinkFailure.
    """
    place = links.onward
    if place is None:
        return None

    def go_on(node: Conversation) -> None:
        if not node.tapped:
            return
        named = node.contact.ble
        at = f"{'&' if '?' in place else '?'}address={named.text}" if named and "address=" not in place else ""
        port = open_place(place + at, links.trace)

        def wanted(identity: Identity) -> bool:
            return identity.uuid == node.uuid

        try:
            node.move_to(lambda: port.find(wanted, seconds=links.timeout, notice=notice), port.close)
        except BaseException:
            port.close()
            raise

    return go_on
