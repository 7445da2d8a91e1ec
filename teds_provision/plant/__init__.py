"""A station among those of its owner: what it tells them, what it takes in, and what carries it."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.plant import (
        asking,
        backlog,
        evidence,
        fetching,
        files,
        folding,
        jobs,
        leaving,
        line,
        membership,
        office,
        owner,
        parcels,
        post,
        postgres,
        reaching,
        returned,
        schema,
        scram,
        status,
        sync,
        verify_evidence,
        yields,
    )
else:
    __getattr__ = lazy(__name__)
