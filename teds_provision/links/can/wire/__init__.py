"""What lies below a bus: its own frames given back, the multicast bus of one machine, how long frames take."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.links.can.wire import echoes, multicast, pacing
else:
    __getattr__ = lazy(__name__)
