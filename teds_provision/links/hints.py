"""Hints from a node's initial NFC message beside its identity: its charge, and its address over the air."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

ChargingState = Literal["full", "charging", "wanted", "no", "error"]


@dataclass(frozen=True)
class Charging:
    """A node's report about its battery and charging (NFC Forum WLC 2.0); unauthenticated.

    ``battery_percent`` 0 to 100; ``battery_celsius`` and ``node_celsius`` whole degrees; ``raw`` every field as it
    came, by name: power, voltage and current have no public unit.
    """

    state: ChargingState
    battery_percent: int | None = None
    battery_celsius: int | None = None
    node_celsius: int | None = None
    raw: dict[str, dict[str, int | str]] = field(default_factory=dict)

    def to_json(self) -> dict[str, object]:
        """Return the members that ``identify``, ``nodes`` and ``mode`` show."""
        return {
            "state": self.state,
            "battery_percent": self.battery_percent,
            "battery_celsius": self.battery_celsius,
            "text": self.text,
            "raw": self.raw,
        }

    @property
    def text(self) -> str:
        """One line for people: ``battery 80 %, 24 °C, charging wanted``."""
        percent = "" if self.battery_percent is None else f"battery {self.battery_percent} %"
        celsius = "" if self.battery_celsius is None else f"{self.battery_celsius} °C"
        words = {
            "full": "full",
            "charging": "charging",
            "wanted": "charging wanted",
            "no": "no charging",
            "error": "charging error",
        }
        return ", ".join(part for part in (percent, celsius, words[self.state]) if part)


@dataclass(frozen=True)
class BleAddress:
    """A Bluetooth LE device address, 6 octets as people write them; ``random`` is its type."""

    octets: bytes
    random: bool

    @property
    def text(self) -> str:
        """Return a Bluetooth address in its usual form, ``C1:D8:57:00:01:01``."""
        return ":".join(f"{octet:02X}" for octet in self.octets)
