"""The node's end of a CAN bus."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.node.can import endpoint, server
else:
    __getattr__ = lazy(__name__)
