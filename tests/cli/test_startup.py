"""What the program loads before it says anything: a person waits for each module, each time."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from teds_provision.optional_rooms import rooms

from .shell import python

OURS = {
    "teds_provision",
    "teds_provision.__main__",
    "teds_provision.cli",
    "teds_provision.cli.config_file",
    "teds_provision.cli.context",
    "teds_provision.cli.main",
    "teds_provision.cli.option_names",
    "teds_provision.cli.stdout",
    "teds_provision.cli.table",
    "teds_provision.errors",
    "teds_provision.sanitize",
    "teds_provision.lazy",
    "teds_provision.optional_rooms",
    *(f"teds_provision.{name}" for room in rooms() for name in (room, f"{room}.room")),
}
NEEDLESS = {"bz2", "difflib", "ipaddress", "json", "lzma", "pathlib", "shlex", "shutil", "tomllib", "urllib.parse"}


def loaded(*words: str) -> set[str]:
    """Modules that a run of these words loads beside those of a bare ``import click``."""
    code = (
        "import sys, click\n"
        "before = set(sys.modules)\n"
        f"sys.argv = ['teds-provision', *{list(words)!r}]\n"
        "from teds_provision.__main__ import main\n"
        "try:\n"
        "    main()\n"
        "except SystemExit as end:\n"
        "    assert not end.code, end.code\n"
        "finally:\n"
        "    print(*sorted(set(sys.modules) - before), file=sys.stderr)\n"
    )
    return set(python(code, COLUMNS="100").err.split())


def test_help_loads_the_command_line_and_nothing_else() -> None:
    modules = loaded("--help")
    assert {name for name in modules if name.split(".")[0] == "teds_provision"} == OURS
    assert modules & NEEDLESS == set()


def test_the_version_loads_nothing_of_the_command_line() -> None:
    modules = loaded("--version")
    assert {name for name in modules if name.split(".")[0] == "teds_provision"} == {
        "teds_provision",
        "teds_provision.__main__",
    }


def test_provisioning_loads_the_readers_of_calibration_files_only_for_a_file() -> None:
    code = "import sys, teds_provision.provisioning.provision\nprint(*sys.modules)"
    assert {f"teds_provision.teds.calibration.{name}" for name in ("files", "order")} & set(
        python(code).out.split()
    ) == set()


@pytest.mark.parametrize("columns", ["0", "20", "60", "80", "97", "300", "many"])
def test_help_is_as_wide_as_click_makes_it(columns: str) -> None:
    """The sections and the width are written without click's own wrapping: both must come to the same text."""
    code = (
        "import sys\n"
        "import click\n"
        "from teds_provision.cli.main import LazyGroup, SECTIONS, COMMANDS, cli, run\n"
        "def rows(self, ctx, formatter):\n"
        "    width = max(map(len, COMMANDS))\n"
        "    for title, entries in SECTIONS.items():\n"
        "        with formatter.section(title):\n"
        "            formatter.write_dl([(name.ljust(width), entry.help) for name, entry in entries.items()])\n"
        "run(['--help'])\n"
        "print('=====')\n"
        "LazyGroup.format_commands = rows\n"
        "cli.main(['--help'], prog_name='teds-provision', standalone_mode=False)\n"
    )
    ours, _, clicks = python(code, COLUMNS=columns).out.partition(f"====={os.linesep}")
    assert ours == clicks


def test_a_command_ends_without_a_search_for_circles() -> None:
    code = (
        "import atexit, gc, sys\n"
        "atexit.register(lambda: print('kept', gc.get_freeze_count(), file=sys.stderr))\n"
        "sys.argv = ['teds-provision', '--help']\n"
        "from teds_provision.__main__ import main\n"
        "main()\n"
    )
    word, count = python(code, COLUMNS="100").err.split()
    assert word == "kept"
    assert int(count) > 5_000


def test_circles_are_searched_for_while_a_command_runs(tmp_path: Path) -> None:
    code = (
        "import gc, sys\n"
        "from teds_provision.cli import context\n"
        "context.App.station = lambda app: print('searched', gc.isenabled(), file=sys.stderr) or sys.exit(0)\n"
        f"sys.argv = ['teds-provision', '--home', {str(tmp_path)!r}, 'nodes']\n"
        "from teds_provision.__main__ import main\n"
        "main()\n"
    )
    assert python(code).err.split() == ["searched", "True"]
