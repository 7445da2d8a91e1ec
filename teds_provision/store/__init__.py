"""What a station remembers: whitelist, nodes, wrapped keys, trust and the audit log, in one SQLite file."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.store.audit import AuditEntry, AuditLog, AuditVerdict, Choice, is_failure
    from teds_provision.store.lock import NodeTurn, StoreLock
    from teds_provision.store.records import (
        DatasheetRecord,
        Draft,
        ExportFacts,
        Group,
        Handed,
        Handover,
        Holder,
        KeptMeasurement,
        KeyRecord,
        Marks,
        NodeReading,
        NodeRecord,
        RevocationRecord,
        StationRecord,
        Tombstone,
        TrustRecord,
        WhitelistEntry,
        utc_now,
    )
    from teds_provision.store.store import Store
    from teds_provision.store.tables.line import EvidenceRow, JobRow, LineTables, SignRequestRow, UnitRow
    from teds_provision.store.tables.nodes import Batch, pages
    from teds_provision.store.tables.overview import NodeOverview, Search
else:
    __getattr__ = lazy(
        __name__,
        {
            "audit": "AuditEntry AuditLog AuditVerdict Choice is_failure",
            "lock": "NodeTurn StoreLock",
            "records": "DatasheetRecord Draft ExportFacts Group Handed Handover Holder KeyRecord Marks"
            " KeptMeasurement NodeReading NodeRecord RevocationRecord"
            " StationRecord Tombstone TrustRecord WhitelistEntry utc_now",
            "store": "Store",
            "tables.overview": "NodeOverview Search",
            "tables.line": "EvidenceRow JobRow LineTables SignRequestRow UnitRow",
            "tables.nodes": "Batch pages",
        },
    )

__all__ = [
    "AuditEntry",
    "AuditLog",
    "AuditVerdict",
    "Batch",
    "Choice",
    "DatasheetRecord",
    "Draft",
    "EvidenceRow",
    "ExportFacts",
    "Group",
    "Handed",
    "Handover",
    "Holder",
    "JobRow",
    "KeptMeasurement",
    "KeyRecord",
    "LineTables",
    "Marks",
    "NodeOverview",
    "NodeReading",
    "NodeRecord",
    "NodeTurn",
    "RevocationRecord",
    "Search",
    "SignRequestRow",
    "StationRecord",
    "Store",
    "StoreLock",
    "Tombstone",
    "TrustRecord",
    "UnitRow",
    "WhitelistEntry",
    "is_failure",
    "pages",
    "utc_now",
]
