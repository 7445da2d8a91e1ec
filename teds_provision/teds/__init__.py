"""IEEE 1451.0 TEDS: octets <-> datasheets, both editions, pure (no I/O, no third-party import at import time).

``decode`` gives values, findings and a verdict and never raises; ``compose`` writes a TEDS from field names;
``encode`` and ``recompose`` give a decoded one back; ``table`` and ``name_of`` show what is known of every class.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.teds import (
        calibration,
        codec,
        curve,
        dcc,
        diff,
        fits,
        formats,
        guard,
        image,
        plot,
        profile,
        sheet,
        show,
        units,
    )
    from teds_provision.teds.codec.access_code import AccessCode
    from teds_provision.teds.codec.composer import compose, convert, encode, recompose
    from teds_provision.teds.codec.decode import decode
    from teds_provision.teds.codec.keyforms import ParsedKey, read_key
    from teds_provision.teds.codec.model import (
        Conformity,
        DecodedTeds,
        Edition,
        Field,
        Finding,
        Severity,
        TimeInstance,
        Units,
        Value,
    )
    from teds_provision.teds.codec.tables import FieldSpec, Table, name_of, table
    from teds_provision.teds.codec.uuid import UuidParts, pack_uuid, unpack_uuid
    from teds_provision.teds.sheet import Sheet

__all__ = [
    "AccessCode",
    "Conformity",
    "DecodedTeds",
    "Edition",
    "Field",
    "FieldSpec",
    "Finding",
    "ParsedKey",
    "Severity",
    "Sheet",
    "Table",
    "TimeInstance",
    "Units",
    "UuidParts",
    "Value",
    "compose",
    "convert",
    "decode",
    "encode",
    "name_of",
    "pack_uuid",
    "read_key",
    "recompose",
    "table",
    "unpack_uuid",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "codec.access_code": "AccessCode",
            "codec.composer": "compose convert encode recompose",
            "codec.decode": "decode",
            "codec.keyforms": "ParsedKey read_key",
            "codec.model": "Conformity DecodedTeds Edition Field Finding Severity TimeInstance Units Value",
            "codec.tables": "FieldSpec Table name_of table",
            "codec.uuid": "UuidParts pack_uuid unpack_uuid",
            "sheet": "Sheet",
        },
    )
