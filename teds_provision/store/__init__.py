"""What a station remembers: whitelist, nodes, wrapped keys, trust and the audit log, in one SQLite file."""

from teds_provision.store.audit import AuditEntry, AuditLog, AuditVerdict, Choice, is_failure
from teds_provision.store.lock import NodeTurn, StoreLock
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
from teds_provision.store.tables.overview import Known, Search

__all__ = [
    "AuditEntry",
    "AuditLog",
    "AuditVerdict",
    "Batch",
    "Choice",
    "DatasheetRecord",
    "Draft",
    "Facts",
    "Group",
    "Handover",
    "Holder",
    "KeyRecord",
    "Known",
    "Marks",
    "Measurement",
    "NodeRecord",
    "NodeTurn",
    "Revocation",
    "Search",
    "Store",
    "StoreLock",
    "Tombstone",
    "TrustRecord",
    "WhitelistEntry",
    "is_failure",
    "utc_now",
]
