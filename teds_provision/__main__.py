"""Entry point: answers ``--version`` before anything heavy is imported, everything else goes to the command line."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line and exit with the codes of the contract."""
    if sys.argv[1:] == ["--version"] and sys.stdout is not None:
        from teds_provision import __version__

        print(f"teds-provision {__version__}")
        return
    try:
        from teds_provision.cli.main import run, wants_json
        from teds_provision.cli.stdout import ended, guard

        output = guard()
        code = run(sys.argv[1:])
        sys.exit(ended(code, output, as_json=wants_json(sys.argv[1:])))
    except KeyboardInterrupt:  # while Python was still importing, or already leaving
        sys.exit(130)


if __name__ == "__main__":
    main()
