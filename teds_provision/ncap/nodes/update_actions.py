"""Records of requested firmware updates: the owner, the result of each board, and the image until the end.

One action is a record (JSON) and an image in ``updates/`` of the home, a folder of this user alone.
"""

from __future__ import annotations

import json
import logging
import time
from collections import Counter
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from teds_provision.api.operations import LARGEST_IMAGE
from teds_provision.errors import BadDataError, StoreError, TedsProvisionError
from teds_provision.files import private_folder, read_limited, write_whole
from teds_provision.firmware_image import FirmwareImage, read_firmware_image
from teds_provision.provisioning.update import RESULTS
from teds_provision.shapes.problem import Problem

_log = logging.getLogger(__name__)
FOLDER: Final = "updates"
KEPT: Final = 20
"""Actions that are over and still shown, the newest."""
_LARGEST_RECORD: Final = 4 << 20
_FORMAT: Final = "ncap-update/1"


@dataclass
class BoardRow:
    """One board of an action: its plan, what it does, how it ended. ``before``: the version that runs, or ran."""

    uuid: str
    state: str = "waiting"  # planned, waiting, running, ended, skipped
    before: str | None = None
    board: str | None = None
    plan: str | None = None
    octets: int = 0
    seconds: float = 0.0
    interrupts: list[str] = field(default_factory=list)
    question: str = ""
    step: str | None = None
    written: int = 0
    result: str | None = None
    error: Problem | None = None

    def as_json(self, to: str) -> dict[str, Any]:
        """Return the row as the API shows it."""
        members = vars(self).copy()
        return {
            "uuid": members.pop("uuid"),
            "from": members.pop("before"),
            "to": to,
            **members,
            "seconds": round(self.seconds, 3),
        }


@dataclass(frozen=True)
class UpdateRequest:
    """The request: which boards may get an image that does not name them, and whether an older version is allowed."""

    uuids: tuple[str, ...]
    other_board: frozenset[str] = frozenset()
    allow_downgrade: bool = False
    parallel: int = 1
    wait: float = 180.0


@dataclass
class UpdateAction:
    """One action; ``owner`` asked for it, ``actor`` is the same in the audit log (None: this machine's user)."""

    id: str
    request: UpdateRequest
    image: dict[str, Any]
    rows: dict[str, BoardRow]
    owner: str
    actor: str | None
    began: float
    state: str = "running"  # planned, running, done, stopped
    ended: float | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the action as the API shows it."""
        counted = Counter(row.result for row in self.rows.values())
        until = self.ended if self.ended is not None else time.time()
        return {
            "id": self.id or None,
            "state": self.state,
            "owner": self.owner,
            "began": self.began,
            "ended": self.ended,
            "image": self.image,
            "allow_downgrade": self.request.allow_downgrade,
            "parallel": self.request.parallel,
            "boards": [row.as_json(self.image["version"]) for row in self.rows.values()],
            "totals": {name: counted[name] for name in RESULTS} | {"seconds": round(max(0.0, until - self.began), 3)},
        }

    def record(self) -> bytes:
        """Return what is kept on disk."""
        asked = vars(self.request) | {"other_board": sorted(self.request.other_board)}
        members = vars(self) | {"request": asked, "rows": [vars(row) for row in self.rows.values()]}
        return json.dumps({"format": _FORMAT, **members}, indent=1).encode()

    @classmethod
    def read(cls, octets: bytes) -> UpdateAction:
        """Return a kept action; raises ValueError, KeyError, TypeError for anything else."""
        document = json.loads(octets)
        if document.pop("format") != _FORMAT:
            raise ValueError("format")
        asked = document.pop("request")
        uuids, other = tuple(asked.pop("uuids")), frozenset(asked.pop("other_board"))
        rows = {row["uuid"]: BoardRow(**row) for row in document.pop("rows")}
        return cls(request=UpdateRequest(uuids, other, **asked), rows=rows, **document)


class UpdateFolder:
    """The records and images of one home."""

    def __init__(self, home: Path) -> None:
        self._folder = home / FOLDER

    def keep_new(self, action: UpdateAction, octets: bytes) -> None:
        """Write a new action and its image, durable; raises StoreError."""
        try:
            private_folder(self._folder)
        except OSError as error:
            raise StoreError(
                f"{self._folder} cannot be used: {error.strerror}.", hint="Give this user the folder alone, mode 0700."
            ) from error
        write_whole(self._image(action), octets)
        write_whole(self._record(action), action.record())

    def keep(self, action: UpdateAction) -> None:
        """Store the state of an action; a failed write ends no update, since the boards have their own state."""
        try:
            write_whole(self._record(action), action.record())
        except TedsProvisionError as error:
            _log.warning("How the update goes cannot be kept: %s", error.message)

    def image_of(self, action: UpdateAction) -> FirmwareImage:
        """Return the image of an action that was cut; raises TedsProvisionError."""
        image = read_firmware_image(
            read_limited(self._image(action), LARGEST_IMAGE, "firmware image", failure=StoreError)
        )
        if image.digest.hex() != action.image["digest"]:
            raise BadDataError("The image that was kept for this update is another one.")
        return image

    def read(self) -> list[UpdateAction]:
        """Return the kept actions, the oldest first; a record that cannot be read is left out."""
        found = []
        for path in sorted(self._folder.glob("*.json")):
            try:
                octets = read_limited(path, _LARGEST_RECORD, "record of an update", failure=StoreError)
                action = UpdateAction.read(octets)
            except (TedsProvisionError, ValueError, KeyError, TypeError, AttributeError):
                _log.warning("%s is no record of an update.", path)
                continue
            if path.stem == action.id:
                found.append(action)
        return sorted(found, key=by_age)

    def forget(self, action: UpdateAction) -> None:
        """Remove the record of an action, and its image."""
        for path in (self._image(action), self._record(action)):
            with suppress(OSError):
                path.unlink(missing_ok=True)

    def sweep(self, running: Collection[UpdateAction]) -> None:
        """Remove every image that no running action needs."""
        needed = {self._image(action) for action in running}
        for path in self._folder.glob("*.image"):
            if path not in needed:
                with suppress(OSError):
                    path.unlink()

    def _image(self, action: UpdateAction) -> Path:
        return self._folder / f"{action.id}.image"

    def _record(self, action: UpdateAction) -> Path:
        return self._folder / f"{action.id}.json"


def by_age(action: UpdateAction) -> tuple[float, str]:
    """Return what sorts actions, the oldest first."""
    return action.began, action.id
