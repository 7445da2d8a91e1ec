"""Evidence made at a board: the station states the facts, the board signs them, the station signs the whole."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

from teds_provision import __version__
from teds_provision.errors import LinkError, NodeRefusedError, NotAuthenticError, UsageError
from teds_provision.files import SHARED, holds, make_folder, write_new
from teds_provision.protocol.keys import Credentials, prove_message, verify
from teds_provision.protocol.messages.frames import Function, security_command
from teds_provision.protocol.plant.evidence import NONCE_OCTETS, EvidenceClaim, seal
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.station.plant.line import EvidenceRow
from teds_provision.station.station import Station
from teds_provision.station.store.records import utc_now
from teds_provision.teds.codec import security

TOOL = f"teds-provision {__version__}"
_EVIDENCE_FILE: Final = re.compile(r"([0-9a-f]{20})\.([1-9][0-9]{0,9})\.json", re.ASCII)


def sign_evidence(
    node: Conversation,
    credentials: Credentials,
    claim: EvidenceClaim,
    *,
    operator: str | None = None,
    finished: str = "",
) -> bytes:
    """Have the board sign the facts of ``claim``, and return the envelope that the station signed over both.

    A board that passed must answer: raises NotAuthenticError if its signature does not verify, LinkError. One whose
    attempt failed may be gone; then the envelope holds the station's signature alone. ``finished``: now, unless it is
    given.
    """
    nonce = os.urandom(NONCE_OCTETS)
    proof = b""
    if claim.facts.failure is None:
        proof = prove_claim(node, claim, nonce)
    else:
        with suppress(LinkError, NodeRefusedError, NotAuthenticError, SessionLostError):
            proof = prove_claim(node, claim, nonce)
    return seal(
        credentials.key,
        credentials.station_signature,
        claim,
        nonce=nonce if proof else b"",
        proof=proof,
        finished=finished or utc_now(),
        operator=operator,
    )


def prove_claim(node: Conversation, claim: EvidenceClaim, nonce: bytes) -> bytes:
    """Return the board's signature over the facts (128.8); raises NotAuthenticError if it is not that of field 101."""
    asked = claim.challenge(nonce)
    proof = node.request_idempotent(security_command(Function.PROVE, asked), "to sign the evidence")
    if not verify(security.decode(claim.teds).node_key, prove_message(claim.uuid, asked), proof):
        raise NotAuthenticError("The node's signature of the evidence does not match the key it presented.")
    return proof


def export(station: Station, rows: Iterable[EvidenceRow], folder: Path, *, write: bool = True) -> dict[Path, bool]:
    """Write documents as ``UUID.N.json``; return every file, and True for each new one.

    N counts all documents of a board that are kept here, whichever are chosen. A document that the folder holds under
    another number stays there, and a number that another document has (another station's, or one from before the clock
    was set back) is passed over: no file is replaced. Each is written whole; raises StoreError if one cannot be.
    """
    files: dict[Path, bool] = {}
    numbers: dict[bytes, dict[str, int]] = {}
    if write:
        make_folder(folder)
    there = _evidence_files(folder)
    for row in rows:
        if row.uuid not in numbers:
            ordered = sorted(
                station.plant.line.evidence(uuid=row.uuid), key=lambda row: (row.finished, row.attempt, row.sha256)
            )
            numbers = {row.uuid: {row.sha256: number for number, row in enumerate(ordered, 1)}}
        name, number = row.uuid.hex(), numbers[row.uuid][row.sha256]
        taken = there.setdefault(name, set())
        same = (folder / f"{name}.{known}.json" for known in sorted(taken, key=lambda known: (known != number, known)))
        path = next((path for path in same if holds(path, row.document)), None)
        if path is not None:
            files[path] = False
            continue
        path = _new_file(folder, name, number, taken, row.document if write else None)
        files[path] = True
    return files


def _evidence_files(folder: Path) -> dict[str, set[int]]:
    """Return the numbers that the files of each board have in a folder, by its UUID."""
    found: dict[str, set[int]] = {}
    with suppress(FileNotFoundError, NotADirectoryError):
        for path in folder.iterdir():
            match = _EVIDENCE_FILE.fullmatch(path.name)
            if match is not None:
                found.setdefault(match[1], set()).add(int(match[2]))
    return found


def _new_file(folder: Path, name: str, number: int, taken: set[int], document: bytes | None) -> Path:
    """Write a document under the next number that is free (None: only choose one), also if two stations write at once.

    Raises StoreError.
    """
    while True:
        while number in taken:
            number += 1
        taken.add(number)
        path = folder / f"{name}.{number}.json"
        if document is None:
            return path
        try:
            write_new(path, document, mode=SHARED)
        except UsageError:
            continue
        return path
