"""A certificate as plain data, and in lines for people."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from teds_provision.teds.dcc.items import CertificateItem, items_of
from teds_provision.teds.dcc.read import DigitalCertificate

_POINTS_SHOWN = 12


@dataclass(frozen=True)
class ShownCertificate:
    """A certificate and the results in it that can calibrate a channel."""

    certificate: DigitalCertificate
    items: tuple[CertificateItem, ...]

    @classmethod
    def from_certificate(cls, certificate: DigitalCertificate) -> ShownCertificate:
        """Find the results of a certificate."""
        return cls(certificate, tuple(items_of(certificate)))

    def to_json(self) -> dict[str, Any]:
        """Return everything that was read."""
        known = self.certificate
        return {
            "file": known.file,
            "schema_version": known.schema_version,
            "certificate": known.number,
            "laboratory": known.laboratory,
            "country": known.country,
            "date": known.calibrated.isoformat(),
            "issued": known.issued.isoformat() if known.issued is not None else None,
            "sha256": known.sha256,
            "signed": known.signed,
            "signature": known.signature,
            "not_checked": list(known.unchecked),
            "devices": [
                {
                    "name": device.name,
                    "manufacturer": device.manufacturer,
                    "model": device.model,
                    "serial": device.serial or None,
                    "identifications": [{"issuer": issuer, "value": value} for issuer, value in device.identifications],
                }
                for device in known.devices
            ],
            "conditions": [{"name": condition.name, "text": condition.text} for condition in known.conditions],
            "methods": list(known.methods),
            "items": [item.to_json() for item in self.items],
            "warnings": list(known.warnings),
        }

    def lines(self) -> Iterator[tuple[str, str]]:
        """Yield lines of (label, text)."""
        known = self.certificate
        yield "certificate", known.number
        yield "laboratory", f"{known.laboratory}, {known.country}"
        issued = f", issued {known.issued}" if known.issued is not None else ""
        yield "calibrated", f"{known.calibrated}{issued}"
        for device in known.devices:
            maker = " ".join(word for word in (device.manufacturer, device.model) if word)
            named = ", ".join(f"{value} ({issuer})" for issuer, value in device.identifications)
            yield "device", ", ".join(word for word in (device.name, maker, named) if word)
        for condition in known.conditions:
            yield "condition", f"{condition.name}: {condition.text}"
        yield "signature", known.signature
        for text in known.unchecked:
            yield "", text
        yield "sha256", known.sha256


def points_of(item: CertificateItem) -> Sequence[tuple[str, str]]:
    """Return rows of an item for people: indication and reference value, the first of many."""
    if item.indicated is None:
        values = [value for part in item.coefficients for value in part.values]
        return [(f"c{power}", f"{value:.9g}") for power, value in enumerate(values)]
    pairs = list(zip(item.indicated.values, item.reference.values, strict=True))
    rows = [(f"{raw:.9g}", f"{value:.9g}") for raw, value in pairs[:_POINTS_SHOWN]]
    return [*rows, ("…", f"{len(pairs) - _POINTS_SHOWN} more")] if len(pairs) > _POINTS_SHOWN else rows
