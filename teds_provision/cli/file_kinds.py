"""Recognizes the kind of a file that was given to the wrong command, for one more line in the error.

A file is recognized by its first octets alone, and only kinds that are easily confused are known. A recognized kind
decides nothing: the command has failed already.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

_READ: Final = 65_536

_IMAGE, _TREE, _TEDS_XML, _PROFILE = "a TEDS image", "TEDS in JSON", "TEDS in XML", "a transducer profile (TOML)"
_DBC, _EDS = "a DBC file", "an EDS file"
_CALIBRATION, _DCC, _SHEET = "a calibration (CSV)", "a calibration certificate (DCC)", "a sheet of boards (CSV)"
_WHITELIST, _BUNDLE, _BACKUP = "a whitelist", "a handover bundle", "a backup of a station"
_PUBLIC, _PRIVATE, _X509 = "a public key (PEM)", "a private key (PEM)", "an X.509 certificate (PEM)"
_REQUEST, _CERTIFICATE = "a station's certificate request", "a station's certificate"
_MCAP, _PARQUET = "a recording (MCAP)", "a recording (Parquet)"
_TEXT, _LINES, _TRACE = "a recording (text)", "a recording (JSON lines)", "a trace"
_THING, _SHELL = "a Thing Description (JSON)", "an Asset Administration Shell (JSON)"
_ROBOT = "a robot description (xacro, URDF)"
_OTHERS: Final = ("a PDF", "a ZIP archive or an office document", "an empty file")

_TEDS: Final = (_IMAGE, _TREE, _TEDS_XML, _PROFILE)
_TAKEN: Final[dict[str, tuple[str, ...]]] = {
    "show": (*_TEDS, _BUNDLE, _DCC),
    "verify": (_IMAGE,),
    "sign": (_IMAGE,),
    "write": (_IMAGE,),
    "whitelist": (_WHITELIST,),
    "import-keys": (_BUNDLE,),
    "restore": (_BACKUP,),
    "trust add": (_PUBLIC, _CERTIFICATE),
    "trust ca import": (_PRIVATE,),
    "trust ca sign": (_REQUEST,),
    "init": (_CERTIFICATE, _PRIVATE),
    "calibrate fit": (_CALIBRATION, _DCC),
    "record": (_MCAP, _PARQUET, _TEXT, _LINES),
    "measure recover": (_MCAP,),
    "handover receipt": (),
    "trace show": (_TRACE,),
    "profile check": (_PROFILE,),
    "--teds": _TEDS,
    "--batch": (_SHEET,),
    "--calibration": (_CALIBRATION, _DCC),
    "--profile": (_PROFILE,),
    "-p": (_PROFILE,),
    "--require": (),
    "--image": (_IMAGE,),
    "--certificate": (_CERTIFICATE,),
    "--ca": (_PUBLIC, _PRIVATE),
    "dbc": (_DBC,),
    "eds": (_EDS,),
}
"""Kinds that a command takes as its argument, and an option or a prefix of a value as its value."""

_FORMATS: Final = {
    "teds-image": _IMAGE,
    "teds-backup": _BACKUP,
    "teds-station-request": _REQUEST,
    "teds-station-certificate": _CERTIFICATE,
    "teds": _TREE,
    "teds-trace": _TRACE,
}


def mistaken_file(arguments: Sequence[str]) -> str:
    """Return a sentence about the first file on a command line that is of a kind which is not taken there, or ""."""
    command = _command_of(arguments)
    before = ""
    for word in arguments:
        option, given = before, word
        if word.startswith("--") and "=" in word:
            option, _, given = word.partition("=")
        prefix, _, rest = given.partition(":")
        if prefix in ("dbc", "eds") and rest:
            option, given = prefix, rest
        elif option == "--calibration" and re.match(r"\d+=", given):
            given = given.partition("=")[2]
        before = word if word.startswith("-") else ""
        taken = _TAKEN.get(option, _TAKEN.get(command) if not option else None)
        kind = _kind_of(Path(given)) if taken is not None and not given.startswith("-") else None
        if taken is not None and kind is not None and kind not in taken:
            return f"{given} is {kind}."
    return ""


def _command_of(arguments: Sequence[str]) -> str:
    """Return the words of the command, as far as the table names them."""
    words = [word for word in arguments if not word.startswith("-")]
    for start in range(len(words)):
        for length in (3, 2, 1):
            if (name := " ".join(words[start : start + length])) in _TAKEN:
                return name
    return ""


def _kind_of(path: Path) -> str | None:
    """Return what a file is by its beginning; None if it is nothing of the above, or cannot be read."""
    try:
        if not path.is_file():
            return None
        with path.open("rb") as file:
            head = file.read(_READ)
    except (OSError, ValueError):
        return None
    for magic, kind in (
        (b"\x89MCAP", _MCAP),
        (b"PAR1", _PARQUET),
        (b"%PDF", _OTHERS[0]),
        (b"PK\x03\x04", _OTHERS[1]),
        (b"-----BEGIN PUBLIC", _PUBLIC),
        (b"-----BEGIN ENCRYPTED", _PRIVATE),
        (b"-----BEGIN PRIVATE", _PRIVATE),
        (b"-----BEGIN EC PRIVATE", _PRIVATE),
        (b"-----BEGIN CERT", _X509),
    ):
        if head.startswith(magic):
            return kind
    text = head.decode("utf-8", "replace").lstrip("\ufeff \t\r\n")
    if not text:
        return _OTHERS[2]
    return _kind_of_text(text)


def _kind_of_text(text: str) -> str | None:
    if text.startswith("<"):
        root = re.search(r"<(?:[\w.-]+:)?([A-Za-z][\w.-]*)", re.sub(r"<[?!][^>]*>", "", text))
        roots = {"whitelist": _WHITELIST, "teds-set": _TEDS_XML, "digitalCalibrationCertificate": _DCC, "robot": _ROBOT}
        return roots.get(root[1]) if root else None
    if text.startswith("{"):
        named = re.search(r'"format"\s*:\s*"([a-z-]+)/', text[:4096])
        if named:
            return _FORMATS.get(named[1])
        if text.startswith('{"event"'):
            return _LINES
        if re.search(r'"@context"\s*:[^{}]*/wot/td/', text):
            return _THING
        if re.search(r'"(assetAdministrationShells|submodels)"\s*:\s*\[', text):
            return _SHELL
        return _BUNDLE if '"recipients"' in text else _WHITELIST if '"whitelist"' in text[:64] else None
    if text.startswith("# teds-provision measurement"):
        return _TEXT
    if text.startswith('VERSION "') or re.search(r"^BO_ \d+ ", text, re.MULTILINE):
        return _DBC
    if re.search(r"^\[(FileInfo|DeviceInfo)\]", text, re.MULTILINE | re.IGNORECASE):
        return _EDS
    if re.search(r"^(extends\s*=|\[channel[.\]])", text, re.MULTILINE):
        return _PROFILE
    first = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    columns = {cell.strip().lower().partition(" ")[0] for cell in re.split("[,;\t]", first)}
    if {"raw", "value"} <= columns:
        return _CALIBRATION
    if "uuid" in columns:
        return _SHEET if columns & {"profile", "calibration"} else _WHITELIST
    return None
