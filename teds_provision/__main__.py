"""Entry point: answers ``--version`` before anything heavy is imported, everything else goes to the command line."""

from __future__ import annotations

import os
import sys
from io import TextIOWrapper


def main() -> None:
    """Run the command line and exit with the codes of the contract."""
    if sys.argv[1:] == ["--version"]:
        from teds_provision import __version__

        print(f"teds-provision {__version__}")
        return
    if sys.stdout is None:  # closed by the caller: the exit code still tells
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - until the process ends
    if isinstance(sys.stdout, TextIOWrapper):  # a name in another encoding is no reason to fail after the work is done
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        from teds_provision.cli.main import run

        sys.exit(_told(run(sys.argv[1:])))
    except KeyboardInterrupt:  # while Python was still importing, or already leaving
        sys.exit(130)


def _told(code: int) -> int:
    """The exit code, once stdout is written out; 141 where its reader went away (``| head``), without a word."""
    try:
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more when it ends
        return 141 if isinstance(error, BrokenPipeError) and not code else code
    return code


if __name__ == "__main__":
    main()
