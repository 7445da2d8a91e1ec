"""One document to paste into a bug report: versions, links, checks, last errors, without what identifies a site.

It holds no keys and no passphrases, as the checks and the audit log hold none. Fingerprints, the user's name, the
host's name, those of the plant and of stations, and the paths of home and working folder are replaced; UUIDs too,
unless they are asked for.
"""

from __future__ import annotations

import getpass
import platform
import re
import socket
import sys
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from importlib import metadata
from typing import Any, Final

from teds_provision import __version__
from teds_provision.doctor.checks import Finding, System
from teds_provision.errors import TedsProvisionError
from teds_provision.station.station import Station
from teds_provision.station.store.audit import AuditFilter
from teds_provision.station.store.sqlite import has_store

FORMAT: Final = "teds-report/1"
_LAST_ERRORS: Final = 20
_UUID: Final = re.compile(r"(?<![0-9A-Fa-f])[0-9A-Fa-f]{20}(?![0-9A-Fa-f])")
# Fingerprints, hashes and keys, whole or in the groups of four in which they are read out.
_LONG_HEX: Final = re.compile(r"(?<![0-9A-Fa-f])(?:[0-9A-Fa-f]{16,}|[0-9a-f]{4}(?: [0-9a-f]{4}){3,})(?![0-9A-Fa-f])")


class Mask:
    """Replaces what identifies a person, a machine or a board; the same value always becomes the same word."""

    def __init__(self, system: System, *, with_uuids: bool) -> None:
        self._with_uuids = with_uuids
        self._uuids: dict[str, str] = {}
        private = {
            **_names_of_stations(system),
            str(system.home.absolute()): "HOME",
            str(system.home): "HOME",
            str(system.workspace): "WORKSPACE",
            system.environment.get("HOME", ""): "~",
            socket.gethostname(): "HOST",
            _user(): "USER",
        }
        for link in (system.nfc, system.can, system.ble):
            if link:
                private[link[len(_kind(link)) + 1 :]] = "ADDRESS"  # hosts and ports of this site
        # The longest first, so that replacing a folder does not cut the paths below it.
        self._private = sorted(
            ((word, name) for word, name in private.items() if len(word) > 1), key=lambda pair: -len(pair[0])
        )

    def __call__(self, text: str) -> str:
        """Return a text with its private parts replaced."""
        for word, name in self._private:
            text = re.sub(rf"(?<![A-Za-z0-9]){re.escape(word)}(?![A-Za-z0-9])", name, text)
        if not self._with_uuids:
            text = _UUID.sub(self._number, text)
        return _LONG_HEX.sub(lambda found: found[0] if _UUID.fullmatch(found[0]) else "HEX", text)

    def _number(self, found: re.Match[str]) -> str:
        return self._uuids.setdefault(found[0].lower(), f"UUID-{len(self._uuids) + 1}")


def _names_of_stations(system: System) -> dict[str, str]:
    """Return a word for the name of this station, of each that it trusts, and of the plant and each of its stations."""
    if not has_store(system.home):
        return {}
    try:
        with Station.inspect(system.home) as station:
            names = {record.name for record in station.policy.listed()} | {station.name}
            roster = station.plant.roster
    except TedsProvisionError:  # the checks report why
        return {}
    names |= {member.name for member in roster.by_key.values()} if roster is not None else set()
    words = {name: f"STATION-{number}" for number, name in enumerate(sorted(names), 1)}
    return words | ({roster.name: "PLANT"} if roster is not None else {})


def _kind(link: str) -> str:
    """Return what a link is, without the place: ``tty``, ``socketcan``, ``hci0``."""
    return re.split(r"[:?]", link, maxsplit=1)[0]


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user without a name, as in a container
        return ""


def build_report(
    system: System, findings: Iterable[Finding], config: Mapping[str, Any], *, with_uuids: bool
) -> dict[str, Any]:
    """Return the report of a machine: JSON-ready; ``config`` gives the names of its settings, never their values."""
    mask = Mask(system, with_uuids=with_uuids)
    return {
        "format": FORMAT,
        "at": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "version": __version__,
        "python": sys.version.split()[0],
        "platform": mask(platform.platform()),
        "packages": _packages(),
        "links": {name: _kind(path) for name in ("nfc", "can", "ble") if (path := getattr(system, name))},
        "config": sorted(_names(config)),
        "checks": [
            {"name": check.name, "result": check.result, "why": mask(check.why), "fix": mask(check.fix)}
            for check in findings
        ],
        "errors": _last_errors(system, mask),
    }


def _packages() -> dict[str, str]:
    """Return the version of each package that this tool requires and that is installed, extras included."""
    versions = {}
    try:
        requirements = metadata.requires("teds-provision") or []
    except metadata.PackageNotFoundError:  # run from a copy that was not installed
        requirements = []
    for requirement in requirements:
        name = re.split(r"[^A-Za-z0-9._-]", requirement, maxsplit=1)[0]
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return dict(sorted(versions.items()))


def _names(config: Mapping[str, Any], table: str = "") -> Iterable[str]:
    for name, value in config.items():
        if isinstance(value, dict):
            yield from _names(value, f"{table}{name}.")
        else:
            yield f"{table}{name}"


def _last_errors(system: System, mask: Mask) -> list[dict[str, str]]:
    """Return what failed or was refused last, oldest first; empty if the store cannot be read (see its check)."""
    if not has_store(system.home):
        return []
    try:
        with Station.inspect(system.home) as station:
            choice, log = AuditFilter(failed=True), station.audit_log
            entries = list(log.chosen(choice, log.entry_before(choice, last=_LAST_ERRORS)))
    except TedsProvisionError:
        return []
    return [
        {
            "at": entry.at,
            "act": entry.act,
            "outcome": mask(entry.outcome),
            "uuid": mask(entry.uuid.hex()) if entry.uuid is not None else "",
        }
        for entry in entries
    ]
