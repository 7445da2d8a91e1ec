"""Entry point: answers ``--version`` before anything heavy is imported, everything else goes to the command line."""

from __future__ import annotations

import gc
import sys

from teds_provision import __version__


def main() -> None:
    """Run the command line and exit with the codes of the contract."""
    if sys.argv[1:] == ["--version"] and sys.stdout is not None:
        print(f"teds-provision {__version__}")
        return
    gc.disable()  # until a command runs: what imports make is kept, and looking through it again and again takes 4 ms
    try:
        from teds_provision.cli import main as command_line  # here, so that Ctrl-C while Python imports it is caught
        from teds_provision.cli import stdout

        output = stdout.guard()
        code = stdout.ended(
            command_line.run(sys.argv[1:]), output, must_print=lambda: command_line.must_print(sys.argv[1:])
        )
        gc.freeze()  # what is left goes with the process: to search it for circles takes a tenth of a short command
        sys.exit(code)
    except ModuleNotFoundError as error:  # click: without it there is no command line that could report it
        cure = f"Install it: {sys.executable} -m pip install {error.name}"
        print(f"Error: The installation is incomplete: {error.name} missing.\n  → {cure}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:  # while Python was still importing, or already leaving
        sys.exit(130)


if __name__ == "__main__":
    main()
