"""The one rule for the nodes that this station may measure and move, before and during a session.

A person decides by bans, handovers, the whitelist and trust, and any process may write that decision. ``measure``,
``ncap``, ``sample``, ``set`` and the API ask here: :func:`require_measurable` before a session, and
:class:`NodeStanding` while it lasts.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Final

from teds_provision.errors import (
    BadDatasheetError,
    KeyStolenError,
    NotAuthenticError,
    NotWhitelistedError,
    PolicyError,
    TedsProvisionError,
)
from teds_provision.provisioning.readings import verdict_of
from teds_provision.station.station import Station
from teds_provision.station.store.records import iso

SETTLING: Final = 0.5
"""Seconds between two judgements of one node while the store changes all the time."""


def is_listed(station: Station, uuid: bytes) -> bool:
    """Return True if whitelist mode opens a session with a node: it is listed with the key that it has to show."""
    entry = station.pins.entry(uuid)
    return entry is not None and entry.fingerprint is not None


def require_measurable(station: Station, uuid: bytes) -> None:
    """Raise unless the decisions made here let this station measure a node; its datasheet is the session's matter.

    Raises NotAuthenticError for a revoked node, NotWhitelistedError in whitelist mode, PolicyError if its key was given
    away or is not held.
    """
    banned = station.policy.denied(uuid, station.pins.pinned(uuid))
    if banned is not None:
        raise NotAuthenticError(
            f"Node {uuid.hex()} was revoked: {banned.why}.",
            hint=f"If that was a mistake: teds-provision revoke --lift {uuid.hex()}",
        )
    station.policy.require_not_given_away(uuid)
    if not station.keys.held(uuid):
        raise PolicyError(
            f"This station holds no key of node {uuid.hex()}.",
            hint=f"Tap it and agree on one: teds-provision agree {uuid.hex()}",
        )
    if station.measurements.detection == "whitelist" and not is_listed(station, uuid):
        raise NotWhitelistedError(
            f"Node {uuid.hex()} is not on the whitelist.", hint=f"Add it: teds-provision whitelist add {uuid.hex()}"
        )


def why_not_measured(station: Station, uuid: bytes) -> str:
    """Return why a node cannot be measured at present; "" if only its session can decide."""
    try:
        require_measurable(station, uuid)
    except (NotAuthenticError, PolicyError) as error:
        return error.message.rstrip(".")
    return ""


def require_whitelisted(station: Station, uuid: bytes) -> None:
    """Raise PolicyError unless the node is on the whitelist: only then actuators move (operation.md section 7)."""
    if station.pins.entry(uuid) is None:
        raise PolicyError(
            f"Node {uuid.hex()} is not on the whitelist, so its actuators are not moved.",
            hint=f"To add it: teds-provision whitelist add {uuid.hex()}",
        )


class NodeStanding:
    """Rights of a node while its session lasts, by today's decisions and today's verdict on its datasheet.

    ``drives``: True while set points are taken for its actuators. ``unsigned``: True if an unsigned datasheet is
    enough. ``mark`` is why its values are unproven, "" if they are not. ``ended`` is the error with which this station
    itself ended the session: no other try changes that.
    """

    def __init__(self, station: Station, uuid: bytes) -> None:
        self._station, self._uuid = station, uuid
        self._changes, self._judged = station.changes(), 0.0
        self._good = time.time()  # up to this moment there was no decision against the node
        self._stolen = station.keys.stolen(uuid)  # known before the session was opened, so it does not end it
        self.drives = self.unsigned = False
        self.mark = ""
        self.ended: TedsProvisionError | None = None

    def require_measurable(self) -> None:
        """Check as the function of this name does; the error is also kept in ``ended``."""
        try:
            require_measurable(self._station, self._uuid)
        except (NotAuthenticError, PolicyError) as error:
            self.ended = error
            raise

    def require(self) -> None:
        """Raise NotAuthenticError or PolicyError if the node may not be measured, or not be moved, any more.

        KeyStolenError if it may, under a new key: the session ends, and the next one begins with a rotation. Costs one
        question to the store until any process has changed it.
        """
        changes, now = self._station.changes(), time.monotonic()
        if changes == self._changes:
            self._good = time.time()
            return
        if now - self._judged < SETTLING:
            return
        asked = time.time()
        self._changes, self._judged = changes, now
        try:
            self._require_today()
        except (NotAuthenticError, PolicyError) as error:
            self.ended = error
            raise
        self._good = asked

    def _require_today(self) -> None:
        station, uuid = self._station, self._uuid
        require_measurable(station, uuid)
        judged = verdict_of(station, uuid)
        verdict = "authentic" if judged is None else judged.verified.verdict
        failed = [] if judged is None else [check for check in judged.verified.checks if check.result == "failed"]
        why = "; ".join(check.why or check.name for check in failed)
        if verdict == "not authentic" or (verdict == "unsigned" and not self.unsigned):
            raise BadDatasheetError(
                f"The datasheet of node {uuid.hex()} is {verdict} now: {why}. "
                f"Values recorded of it since {iso(datetime.fromtimestamp(self._good, UTC))} do not count.",
                hint=f"See: teds-provision verify {uuid.hex()}",
            )
        self.mark = f"its datasheet is unproven: {why}" if verdict == "unproven" else ""
        stolen = station.keys.stolen(uuid)
        if stolen is None:
            self._stolen = None
        elif stolen != self._stolen:
            raise KeyStolenError(f"Node {uuid.hex()} gets a new key: {stolen}.")
        if self.drives:
            require_whitelisted(station, uuid)
