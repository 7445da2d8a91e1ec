"""Command frames, key agreement, sessions, bundles: pure state machines of both roles, no I/O."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.protocol import (
        announce,
        datasheet,
        fingerprints,
        flash,
        handover,
        keys,
        messages,
        operation,
        plant,
        repetition,
        session,
        tim,
        wire_agreement,
    )
else:
    __getattr__ = lazy(__name__)
