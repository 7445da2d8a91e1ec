"""Field tables of every TEDS class, one per access code, open to inspection (teds.md, "Access codes").

The rows stand in ``standard`` (Meta, TransducerChannel, names), ``phy_text_security`` (PHY, text-based, security) and
the data file ``calibration_fields.toml``, whose numbers nobody has checked against the standard.
"""

from __future__ import annotations

from functools import cache

from teds_provision.teds.codec.codes import MANUFACTURER, ONLY_2024, TEXT_BASED, AccessCode
from teds_provision.teds.codec.tables import phy_text_security, standard
from teds_provision.teds.codec.tables.calibration import calibration_table
from teds_provision.teds.codec.tables.field_spec import NAMES, OCTETS, FieldSpec, Table, name_of

__all__ = ["MANUFACTURER", "NAMES", "OCTETS", "ONLY_2024", "TEXT_BASED", "FieldSpec", "Table", "name_of", "table"]


@cache
def table(access_code: int) -> Table:
    """Field table of a TEDS class; one without rows where no fields are known (their tuples stay raw)."""
    name = name_of(access_code)
    if access_code == AccessCode.CALIBRATION:
        return calibration_table()
    if access_code in TEXT_BASED:
        return Table(
            access_code, name, phy_text_security.TEXT, source='teds.md, "Text-based TEDS (2, 4, 6, 10, 11, 14, 15)"'
        )
    entry = standard.TABLES.get(access_code) or phy_text_security.TABLES.get(access_code)
    if entry is None:
        return Table(access_code, name, verified=False)
    return Table(access_code, name, **entry)
