"""The base station over store and vault: identity, node keys, pins, policy."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.station import (
        firmware,
        groups,
        identity,
        label,
        node_keys,
        nodes,
        pins,
        plant,
        policy,
        row_macs,
        station,
        store,
        summary,
    )
else:
    __getattr__ = lazy(__name__)
