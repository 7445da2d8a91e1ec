"""Firmware images for tests, signed by imgtool as an owner signs them."""

from __future__ import annotations

import contextlib
import io
import random
from pathlib import Path

from imgtool.main import imgtool

BOARD = "virtual/finger"


def make_key(path: Path) -> Path:
    """Return a key pair of an owner."""
    _run("keygen", "-k", path, "-t", "ecdsa-p256")
    return path


def sign(
    folder: Path,
    version: str,
    key: Path | None,
    *,
    board: str | None = BOARD,
    octets: int = 3000,
    counter: int | None = None,
    behaves: str = "",
    more: tuple[str, ...] = (),
) -> Path:
    """An image file of a version; its payload is the same for the same arguments.

    ``behaves`` ("mute", "crash", "confirm"): virtual nodes and the node in C fail so when they run it.
    """
    name = f"{(board or 'nameless').replace('/', '-')}-{version}"
    payload, image = folder / f"{name}.raw", folder / f"{name}.bin"
    line = f"#!{behaves}\n".encode() if behaves else b""
    payload.write_bytes(line + random.Random(name).randbytes(octets))
    options: list[object] = [] if key is None else ["-k", key]
    options += [] if board is None else ["--custom-tlv", "0x54a0", board]
    options += [] if counter is None else ["--security-counter", counter]
    layout = ["--align", 4, "--header-size", "0x200", "--pad-header", "--slot-size", "0x60000"]
    _run("sign", *options, "--version", version, *layout, *more, payload, image)
    return image


def public(key: Path, encoding: str) -> Path:
    """Return the public half of a key: ``pem``, or ``raw`` as the node in C reads it."""
    path = key.with_suffix(f".public.{encoding}")
    _run("getpub", "-k", key, "-e", encoding, "-o", path)
    return path


def _run(*words: object) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        imgtool.main([str(word) for word in words], standalone_mode=False)
