"""The station's memory in one SQLite file: whitelist, nodes, wrapped keys, trust and the audit log."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.station.store.audit import AuditEntry, AuditFilter, AuditLog, AuditVerdict, is_failure
    from teds_provision.station.store.database import chunks
    from teds_provision.station.store.lock import NodeLock, StoreLock
    from teds_provision.station.store.records import (
        DatasheetRecord,
        Draft,
        ExportedNode,
        ExportEligibility,
        FirmwareRecord,
        Group,
        Handover,
        Holder,
        KeptMeasurement,
        KeyFlags,
        KeyRecord,
        NodeReading,
        NodeRecord,
        RevocationRecord,
        StationRecord,
        Tombstone,
        TrustRecord,
        WhitelistEntry,
        utc_now,
    )
    from teds_provision.station.store.store import Store
else:
    __getattr__ = lazy(
        __name__,
        {
            "audit": "AuditEntry AuditLog AuditVerdict AuditFilter is_failure",
            "lock": "NodeLock StoreLock",
            "records": "DatasheetRecord Draft ExportEligibility Group ExportedNode Handover Holder KeyRecord KeyFlags"
            " FirmwareRecord KeptMeasurement NodeReading NodeRecord RevocationRecord"
            " StationRecord Tombstone TrustRecord WhitelistEntry utc_now",
            "store": "Store",
            "database": "chunks",
        },
    )

__all__ = [
    "AuditEntry",
    "AuditFilter",
    "AuditLog",
    "AuditVerdict",
    "DatasheetRecord",
    "Draft",
    "ExportEligibility",
    "ExportedNode",
    "FirmwareRecord",
    "Group",
    "Handover",
    "Holder",
    "KeptMeasurement",
    "KeyFlags",
    "KeyRecord",
    "NodeLock",
    "NodeReading",
    "NodeRecord",
    "RevocationRecord",
    "StationRecord",
    "Store",
    "StoreLock",
    "Tombstone",
    "TrustRecord",
    "WhitelistEntry",
    "chunks",
    "is_failure",
    "utc_now",
]
