"""What a backup holds once it is open."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime
from types import TracebackType

from teds_provision.protocol.keys import fingerprint
from teds_provision.store import Store


@dataclass(frozen=True)
class Head:
    """Whose backup it is: store id, station's point (65 octets), name, time, keystore (its kind, as it was called).

    ``material`` is all that the vault keeps secret; for a token, only what it has sealed.
    """

    store: str
    point: bytes
    name: str
    created: str
    keystore: str
    material: str = field(repr=False)

    @property
    def station(self) -> str:
        """Fingerprint of the station."""
        return fingerprint(self.point)

    @property
    def in_token(self) -> bool:
        """Whether the station's key lies in a token."""
        return self.keystore.startswith("pkcs11")

    def age_days(self, now: datetime | None = None) -> int:
        """How many whole days ago it was made; negative for a time in the future, 0 where the time cannot be read."""
        try:
            made = datetime.fromisoformat(self.created)
        except ValueError:
            return 0
        made = made if made.tzinfo is not None else made.replace(tzinfo=UTC)
        return ((now or datetime.now(UTC)) - made).days


@dataclass(frozen=True)
class Content(Head):
    """An opened backup: its head, and its store as a private copy that lives until :meth:`close`."""

    copy: Store = field(repr=False, kw_only=True)

    def close(self) -> None:
        """Let the copy go."""
        self.copy.close()

    def __enter__(self) -> Content:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
