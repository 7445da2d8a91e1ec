"""The value of ``--ble``: ``ADAPTER[?address=C1:D8:57:00:01:01]``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qsl

from teds_provision.errors import UsageError

_ADDRESS: Final = re.compile(r"([0-9A-F]{2}:){5}[0-9A-F]{2}")
_ADAPTER: Final = re.compile(r"[A-Za-z0-9_.-]{1,32}")
_HINT: Final = "Use --ble auto, --ble hci0 or --ble 'hci0?address=C1:D8:57:00:01:01'."


@dataclass(frozen=True)
class BleSpec:
    """``adapter`` None: the first that is powered; ``address`` None: any node."""

    adapter: str | None
    address: str | None

    @property
    def text(self) -> str:
        """Name of the adapter for people."""
        return self.adapter or "the Bluetooth adapter"

    def require_known(self) -> None:
        """Do nothing: :func:`parse_spec` knows every option."""


def parse_spec(text: str) -> BleSpec:
    """Read the value of ``--ble``; raises UsageError."""
    adapter, _, query = text.partition("?")
    options = dict(parse_qsl(query, keep_blank_values=True))
    address = options.pop("address", None)
    if options:
        raise UsageError(f"--ble knows no option {next(iter(options))!r}.", hint=_HINT)
    if address is not None:
        address = address.upper().replace("-", ":")
        if not _ADDRESS.fullmatch(address):
            raise UsageError(f"{address!r} is not a Bluetooth address.", hint=_HINT)
    if adapter not in ("", "auto") and not _ADAPTER.fullmatch(adapter):
        raise UsageError(f"{adapter!r} is not a Bluetooth adapter name.", hint=_HINT)
    return BleSpec(adapter if adapter not in ("", "auto") else None, address)
