"""The octets between NCAP and TIM: command and reply frames, Identify."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.protocol.messages import arguments, ble, firmware, frames, identity, message, tables
else:
    __getattr__ = lazy(__name__)
