"""Keys from one base station to another, and whom this one trusts."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.handover import deny, incoming, life, outgoing, pending, trust
else:
    __getattr__ = lazy(__name__)
