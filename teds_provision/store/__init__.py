"""What a station remembers: whitelist, nodes, wrapped keys, trust and the audit log, in one SQLite file."""

from teds_provision.store.audit import AuditEntry, AuditLog, AuditVerdict
from teds_provision.store.bulk_tables import Batch
from teds_provision.store.lock import StoreLock
from teds_provision.store.records import (
    Draft,
    Handover,
    Holder,
    KeyRecord,
    NodeRecord,
    Revocation,
    Tombstone,
    TrustRecord,
    WhitelistEntry,
    utc_now,
)
from teds_provision.store.store import Store

__all__ = [
    "AuditEntry",
    "AuditLog",
    "AuditVerdict",
    "Batch",
    "Draft",
    "Handover",
    "Holder",
    "KeyRecord",
    "NodeRecord",
    "Revocation",
    "Store",
    "StoreLock",
    "Tombstone",
    "TrustRecord",
    "WhitelistEntry",
    "utc_now",
]
