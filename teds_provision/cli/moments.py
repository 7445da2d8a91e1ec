"""Points in time as people give them to ``--since``: ISO 8601, ``today``, or how long ago (``2h``, ``3d``)."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta

from teds_provision.errors import UsageFailure

_UNITS = {"s": "seconds", "m": "minutes", "h": "hours", "d": "days", "w": "weeks"}


def duration(text: str) -> float:
    """Seconds of a time span as people give it: ``90s``, ``15m``, ``2h``; raises UsageFailure."""
    found = re.fullmatch(r"(\d{1,6})\s*([smhdw])", text.strip().lower())
    if found is None:
        raise UsageFailure(f"{text!r} is no span of time.", hint="Give 90s, 15m or 2h.")
    return timedelta(**{_UNITS[found[2]]: int(found[1])}).total_seconds()


def moment(text: str, now: datetime | None = None) -> str:
    """Return a moment in UTC as the store writes it (``2026-01-31T12:00:00Z``); raises UsageFailure.

    A time without an offset is local; a date alone, and ``today``, mean its first moment there.
    """
    at = (now or datetime.now(UTC)).astimezone()
    word = text.strip().lower()
    ago = re.fullmatch(r"(\d{1,6})\s*([smhdw])", word)
    try:
        if word in ("today", "yesterday"):
            found = at.replace(hour=0, minute=0, second=0, microsecond=0) - timedelta(days=word == "yesterday")
        elif ago is not None:
            found = at - timedelta(**{_UNITS[ago[2]]: int(ago[1])})
        else:
            found = datetime.fromisoformat(text.strip())
        return found.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    except (ValueError, OverflowError) as error:
        raise UsageFailure(
            f"{text!r} is no point in time.", hint="Give 2026-01-31, 2026-01-31T12:00, today, or how long ago: 2h, 3d."
        ) from error
