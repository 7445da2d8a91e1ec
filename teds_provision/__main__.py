"""Entry point: answers ``--version`` before anything heavy is imported, everything else goes to the command line."""

from __future__ import annotations

import sys
from io import TextIOWrapper


def main() -> None:
    """Run the command line and exit with the codes of the contract."""
    if sys.argv[1:] == ["--version"]:
        from teds_provision import __version__

        print(f"teds-provision {__version__}")
        return
    if isinstance(sys.stdout, TextIOWrapper):  # a name in another encoding is no reason to fail after the work is done
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        from teds_provision.cli.main import run

        sys.exit(run(sys.argv[1:]))
    except KeyboardInterrupt:  # while Python was still importing, or already leaving
        sys.exit(130)


if __name__ == "__main__":
    main()
