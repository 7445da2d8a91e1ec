"""What a station remembers: whitelist, nodes, wrapped keys, trust and the audit log, in one SQLite file."""

from teds_provision.store.audit import AuditEntry, AuditLog, AuditVerdict
from teds_provision.store.lock import StoreLock
from teds_provision.store.records import (
    DatasheetRecord,
    Draft,
    Facts,
    Group,
    Handover,
    Holder,
    KeyRecord,
    Marks,
    Measurement,
    NodeRecord,
    Revocation,
    Tombstone,
    TrustRecord,
    WhitelistEntry,
    utc_now,
)
from teds_provision.store.store import Store
from teds_provision.store.tables.batches import Batch

__all__ = [
    "AuditEntry",
    "AuditLog",
    "AuditVerdict",
    "Batch",
    "DatasheetRecord",
    "Draft",
    "Facts",
    "Group",
    "Handover",
    "Holder",
    "KeyRecord",
    "Marks",
    "Measurement",
    "NodeRecord",
    "Revocation",
    "Store",
    "StoreLock",
    "Tombstone",
    "TrustRecord",
    "WhitelistEntry",
    "utc_now",
]
