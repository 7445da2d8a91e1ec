"""The node's end of a reader: an emulated tag and the node's half of TNEP."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.node.nfc import server, tags, tnep
else:
    __getattr__ = lazy(__name__)
