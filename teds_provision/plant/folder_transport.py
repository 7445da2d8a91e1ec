"""Transfer folder: a stick or a share. ``roster/VERSION.jws``, ``FINGERPRINT/N.jws``, ``to/FINGERPRINT/ID``.

It carries the pages of all stations. A file is written atomically, and never over another: a roster or page
that exists with other content gets a second file beside it, named by the first 16 digits of its H, and readers take
both.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Final

from teds_provision.errors import BadDataError, LinkError, NotFoundError, TedsProvisionError
from teds_provision.files import SHARED, read_limited, write_new
from teds_provision.plant.transport import AT_ONCE, SMALL, CarriedPage, Parcel, Returned
from teds_provision.protocol.plant.document import PAGE, ROSTER, hash_of

_STATION: Final = re.compile("[0-9a-f]{64}")
_NUMBERED: Final = re.compile(r"([1-9]\d{0,9})(\.[0-9a-f]{16})?\.jws", re.ASCII)
_PARCEL: Final = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
MOST_FILES: Final = 1_000_000
LARGEST_PARCEL: Final = 64 << 20


class FolderTransport:
    """A folder as a transport; files with other names are neither changed nor read."""

    carries_all = True
    returned: Returned | None = None

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.where = str(folder)
        self._require()

    def registry(self) -> str | None:
        """Return None: a folder does not name its registry; its rosters do."""
        return None

    def rosters(self) -> Iterator[bytes]:
        """Yield every roster in it."""
        for _, path in self._numbered(self._folder / "roster"):
            octets = self._read(path, ROSTER.most)
            if octets is not None:
                yield octets.strip()

    def post_roster(self, version: int, hash: str, octets: bytes) -> None:
        """Put a roster there."""
        self._put(self._folder / "roster", version, hash, octets)

    def heads(self) -> Mapping[str, int]:
        """Return the greatest number of a page in it, by station."""
        found = {}
        for folder in self._listed(self._folder):
            if _STATION.fullmatch(folder.name) and (numbers := [n for n, _ in self._numbered(folder)]):
                found[folder.name] = max(numbers)
        return found

    def pages(self, station: str, after: int) -> Iterator[CarriedPage]:
        """Yield every page of a station, ascending, those up to ``after`` too: one may be of another history."""
        for n, path in self._numbered(self._folder / station):
            octets = self._read(path, PAGE.most)
            if octets is not None:
                yield CarriedPage(station, n, octets.strip())

    def append(self, station: str, n: int, previous: str, hash: str, octets: bytes) -> None:
        """Put a page there."""
        self._put(self._folder / station, n, hash, octets)

    def parcels(self, to: str) -> Iterator[Parcel]:
        """Yield the parcels for a station; their expiry is inside the sealed part."""
        return self._parcels(to, (), LARGEST_PARCEL)

    def new_parcels(self, to: str, known: Collection[str]) -> Iterator[Parcel]:
        """Yield the parcels for a station, skipping known ids."""
        return islice(self._parcels(to, known, SMALL), AT_ONCE)

    def _parcels(self, to: str, known: Collection[str], most: int) -> Iterator[Parcel]:
        for path in sorted(self._listed(self._folder / "to" / to)):
            if path.name in known or not _PARCEL.fullmatch(path.name):
                continue
            if (octets := self._read(path, most)) is not None:
                yield Parcel(path.name, to, octets, "")

    def send(self, parcel: Parcel) -> None:
        """Put a parcel there."""
        folder = self._folder / "to" / parcel.to
        self._make(folder)
        if not (folder / parcel.id).exists():
            self._write(folder / parcel.id, parcel.octets)

    def drop(self, parcel: str, to: str) -> None:
        """Delete the copy of a parcel that is addressed to ``to``."""
        try:
            (self._folder / "to" / to / parcel).unlink(missing_ok=True)
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Do nothing: no file stays open."""

    # -- files -----------------------------------------------------------------------------------------------------

    def _require(self) -> None:
        if not self._folder.is_dir():
            raise LinkError(f"There is no folder {self._folder}.", hint="Create it, or plug in the stick.")

    def _put(self, folder: Path, n: int, hash: str, octets: bytes) -> None:
        self._make(folder)
        for path in (folder / f"{n}.jws", folder / f"{n}.{hash[:16]}.jws"):
            if not path.exists() and not path.is_symlink():
                self._write(path, octets)
                return
            there = self._read(path, len(octets) + 64)
            if there is not None and hash_of(there.strip()) == hash:
                return

    def _write(self, path: Path, octets: bytes) -> None:
        write_new(path, octets, mode=SHARED, failure=LinkError)

    def _make(self, folder: Path) -> None:
        self._require()  # a stick that was unplugged: its mount point must not be made again on the disk below
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self._failed(error) from error

    def _numbered(self, folder: Path) -> list[tuple[int, Path]]:
        found = [(match, path) for path in self._listed(folder) if (match := _NUMBERED.fullmatch(path.name))]
        return sorted((int(match[1]), path) for match, path in found)

    def _listed(self, folder: Path) -> list[Path]:
        try:
            names = [path for _, path in zip(range(MOST_FILES), folder.iterdir(), strict=False)]
        except FileNotFoundError:
            return []
        except NotADirectoryError:
            return []
        except OSError as error:
            raise self._failed(error) from error
        return names

    def _read(self, path: Path, most: int) -> bytes | None:
        """Return a file, None if it is gone, a link, or larger than any of its kind: no station wrote it."""
        try:
            return read_limited(path, most + 64, "document of a plant", failure=LinkError, follow=False)
        except (BadDataError, NotFoundError):
            return None
        except LinkError:
            if path.is_symlink():
                return None
            raise

    def _failed(self, error: OSError) -> TedsProvisionError:
        return LinkError(
            f"Cannot use folder {self._folder}: {error.strerror}.", hint="Check its owner, its mode and the free space."
        )
