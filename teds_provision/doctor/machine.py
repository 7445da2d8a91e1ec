"""The doctor's checks of any machine: Python, the libraries, libusb, the clock."""

from __future__ import annotations

import ctypes
import platform
import re
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib import metadata
from typing import Final

from teds_provision.doctor.checks import Finding, System, check
from teds_provision.errors import StoreError
from teds_provision.lazy import REQUIRED, install_command
from teds_provision.station.station import Station
from teds_provision.station.store.sqlite import has_store
from teds_provision.vault.passphrase import THROWAWAY, SealingKey

_MIN_PYTHON: Final = (3, 11)
_LIBRARIES: Final = {name: least for name, (_, least) in REQUIRED.items()} | {"ndeflib": "0.3.3"}  # nfcpy needs it
_LIBUSB: Final = ("libusb-1.0.so.0", "libusb-1.0.dylib", "libusb-1.0.dll")
_FIRST_YEAR: Final = 2025
_LAST_YEAR: Final = 2099
_TOLERANCE_SECONDS: Final = 120


@check("python", "machine")
def python(system: System) -> Iterator[Finding]:
    """Check that this Python is new enough."""
    version = platform.python_version()
    enough = sys.version_info[:2] >= _MIN_PYTHON
    fix = "" if enough else "Install Python 3.11 or newer and recreate the virtual environment."
    yield Finding("python", "ok" if enough else "failed", f"Python {version} on {platform.platform()}.", fix)


@check("libraries", "machine")
def libraries(system: System) -> Iterator[Finding]:
    """Check that the libraries are installed, new enough, and not shadowed."""
    present, missing, old = [], [], []
    for name, least in _LIBRARIES.items():
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            missing.append(name)
            continue
        present.append(f"{name} {version}")
        if _numbers(version) < _numbers(least):
            old.append(f"{name} {version} (needs {least})")
    if missing or old:
        wrong = ", ".join([*(f"{name} is missing" for name in missing), *old])
        wanted = [f"{name}>={_LIBRARIES[name]}" for name in _LIBRARIES if name in missing or name in str(old)]
        yield Finding("libraries", "failed", f"{wrong}.", install_command(*wanted))
    else:
        yield Finding("libraries", "ok", f"{', '.join(present)}.")
    yield from _shadowed()


def _shadowed() -> Iterator[Finding]:
    """Check for the package ``ndef`` of PyPI, whose module shadows the one that nfcpy needs from ``ndeflib``."""
    try:
        version = metadata.version("ndef")
    except metadata.PackageNotFoundError:
        yield Finding("ndeflib", "ok", "Not shadowed by another package.")
        return
    yield Finding(
        "ndeflib",
        "failed",
        f"The package ndef {version} shadows ndeflib, which nfcpy needs.",
        "pip uninstall --yes ndef; pip install --force-reinstall ndeflib",
    )


@check("argon2id", "machine")
def argon2id(system: System) -> Iterator[Finding]:
    """Check that this OpenSSL can derive keys from passphrases."""
    SealingKey.derive("a self-test, no secret", costs=THROWAWAY)
    yield Finding("argon2id", "ok", "Passphrases work.")


@check("libusb", "machine")
def libusb(system: System) -> Iterator[Finding]:
    """Check that the C library of USB readers loads."""
    for name in _LIBUSB:
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        yield Finding("libusb", "ok", f"{name} loads.")
        return
    asked = (system.nfc or "").startswith("usb")
    why = "The C library libusb is missing: USB readers do not work (simulated and serial ones do)."
    yield Finding("libusb", "failed" if asked else "warning", why, "sudo apt install libusb-1.0-0")


@check("clock", "machine")
def clock(system: System) -> Iterator[Finding]:
    """Check that the time can be signed: plausible, and not before anything signed already."""
    now = datetime.now(UTC)
    fix = "sudo timedatectl set-ntp true, or: sudo date --utc --set '2026-01-31 12:00'"
    if not _FIRST_YEAR <= now.year <= _LAST_YEAR:
        yield Finding("clock", "failed", f"The clock is wrong: {now:%Y-%m-%d}.", fix)
        return
    last = _last_entry(system)
    if last is not None and (last - now).total_seconds() > _TOLERANCE_SECONDS:
        yield Finding(
            "clock", "failed", f"The clock is wrong: {now:%Y-%m-%d %H:%M} UTC is before the last audit log entry.", fix
        )
        return
    drift = _drift(system)
    if drift is not None and abs(drift) > _TOLERANCE_SECONDS:
        why = f"The hardware clock differs from the system's by {drift:.0f} s."
        yield Finding("clock", "warning", why, "sudo hwclock --systohc, once the system's time is right")
        return
    yield Finding("clock", "ok", f"{now:%Y-%m-%d %H:%M} UTC.")


def _last_entry(system: System) -> datetime | None:
    if not has_store(system.home):
        return None
    try:
        with Station.inspect(system.home) as station:
            latest = station.audit_log.latest()
        return datetime.strptime(latest, "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=UTC) if latest is not None else None
    except (StoreError, ValueError):  # the checks of the store report it
        return None


def _drift(system: System) -> float | None:
    """Return the seconds that the hardware clock is ahead, None if unknown.

    It is assumed to run in UTC; if that is off by more, in local time.
    """
    try:
        seconds = int(system.at("/sys/class/rtc/rtc0/since_epoch").read_text())
    except (OSError, ValueError):
        return None
    drift = seconds - time.time()
    zone = -time.timezone if time.localtime().tm_isdst == 0 else -time.altzone
    return drift - zone if abs(drift - zone) < abs(drift) else drift


def _numbers(version: str) -> tuple[int, ...]:
    """Return the leading numbers of a version: enough to compare releases (1.2.3rc4 counts as 1.2.3)."""
    numbers = []
    for part in version.split("."):
        digits = re.match(r"[0-9]*", part)
        if digits is None or not digits[0]:
            break
        numbers.append(int(digits[0]))
        if digits[0] != part:
            break
    return tuple(numbers)
