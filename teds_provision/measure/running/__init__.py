"""Measurements as the station keeps them, begun, carried on after a restart, and ended."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.measure.running import (
        common_start,
        measurement,
        measurement_job,
        retry_policy,
        streams,
        trigger,
    )
else:
    __getattr__ = lazy(__name__)
