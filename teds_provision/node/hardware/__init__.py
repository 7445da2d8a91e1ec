"""The hardware of a virtual transducer: channels, clock, battery."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.node.hardware import board, clock, converter
else:
    __getattr__ = lazy(__name__)
