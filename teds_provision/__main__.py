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
    gc.disable()  # until a command runs: objects made by imports are kept, and repeated collections over them take 4 ms
    try:
        # imported inside the try, so that Ctrl-C during the import is handled
        from teds_provision.cli import main as command_line
        from teds_provision.cli import stdout

        output = stdout.guard()
        code = stdout.ended(
            command_line.run(sys.argv[1:]), output, purpose=lambda: command_line.purpose_of(sys.argv[1:])
        )
        gc.freeze()  # skips the collection at exit, which takes a tenth of a short command
        sys.exit(code)
    except ModuleNotFoundError as error:  # click is missing, so there is no command line that could report it
        cure = f"Install it: {sys.executable} -m pip install {error.name}"
        print(f"Error: The installation is incomplete: {error.name} missing.\n  → {cure}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:  # during the imports, or at exit
        sys.exit(130)


if __name__ == "__main__":
    main()
