"""From datasheet to measurement: sessions, streams, clocks, groups, and the sinks that take calibrated values."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.measure import (
        background_reread,
        blocks,
        buses,
        capture,
        clock,
        exposure,
        grid,
        held_actuator,
        interpreter,
        matching,
        node_supervisor,
        planning,
        presence,
        recordings,
        request,
        sample_series,
        sampling,
        sinks,
        sources,
        standing,
        stream_receiver,
        topic_actuators,
        verified_session,
        zero,
    )
    from teds_provision.measure.running import measurement_job
else:
    __getattr__ = lazy(__name__, {"running": "measurement_job"})
