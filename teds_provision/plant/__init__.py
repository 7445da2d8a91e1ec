"""A station among those of its owner: its statements, what it takes in, and the transports."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.plant import (
        apply_pages,
        backlog,
        connecting,
        demo,
        evidence,
        fetching,
        folder_transport,
        jobs,
        line,
        membership,
        office,
        owner,
        parcels,
        postgres,
        removed_members,
        returned,
        schema,
        scram,
        sign_requests,
        status,
        sync,
        transport,
        verify_evidence,
        yield_stats,
    )
else:
    __getattr__ = lazy(__name__)
