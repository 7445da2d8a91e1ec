"""Completion as people have it: the real shells, on a terminal, with names that others chose."""

from __future__ import annotations

import os
import pty
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import click
import pytest

from teds_provision.cli import shell_completion
from teds_provision.errors import StoreError
from teds_provision.protocol.keys import SoftwareKey, to_pem

from .shell import call, clean_environment

UUID = "8d4d9da65281f7000000"
HOSTILE = 'crane, a:b \'s \\x & $(touch ran) `touch ran` "arm"'
ROOT = Path(__file__).resolve().parents[2]
_SECONDS = 60.0

BASH = """
PS1='ready> '
eval "$(teds-provision completion bash)"
teds-provision() { printf '%s\\n' "$@" > got; exit; }
"""
ZSH = """
PS1='ready> '
autoload -Uz compinit; compinit -u -D
eval "$(teds-provision completion zsh)"
teds-provision() { printf '%s\\n' "$@" > got; exit; }
"""
FISH = """
function fish_prompt; printf 'ready> '; end
teds-provision completion fish | source
function teds-provision; printf '%s\\n' $argv > got; exit; end
"""


def offered(home: Path, line: str) -> list[str]:
    """Return the words that bash is offered for the end of a line."""
    asked = {
        "_TEDS_PROVISION_COMPLETE": "bash_complete",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(line.split(" ")) - 1),
        "TEDS_PROVISION_HOME": str(home),
    }
    words = [sys.executable, "-m", "teds_provision"]
    done = subprocess.run(words, env=clean_environment() | asked, capture_output=True, text=True, check=True)
    return done.stdout.split("\n")[:-1] if done.stdout.strip() else []


class CompletionShell:
    """A shell on a terminal, in a folder of its own, that knows the program by its name."""

    def __init__(self, shell: str, folder: Path, home: Path) -> None:
        program = folder / "bin" / "teds-provision"
        program.parent.mkdir()
        program.write_text(f'#!/bin/sh\nexec {sys.executable} -m teds_provision "$@"\n')
        program.chmod(0o755)
        text = {"bash": BASH, "zsh": ZSH, "fish": FISH}[shell]
        start = folder / (".zshrc" if shell == "zsh" else "start")
        start.write_text(text)
        words = {
            "bash": ["bash", "--rcfile", str(start), "-i"],
            "zsh": ["zsh", "-i"],
            "fish": ["fish", "--no-config", "-i", "-C", f"source {start}"],
        }[shell]
        places = {"HOME": str(folder), "ZDOTDIR": str(folder), "PYTHONPATH": str(ROOT), "TERM": "xterm"}
        path = f"{program.parent}:{os.environ['PATH']}"
        environment = clean_environment(TEDS_PROVISION_HOME=str(home), PATH=path, LANG="C.UTF-8", **places)
        self.master, terminal = pty.openpty()
        words = ["setsid", "--ctty", *words]  # so that the shell is in charge of the terminal
        self.process = subprocess.Popen(
            words, stdin=terminal, stdout=terminal, stderr=terminal, cwd=folder, env=environment
        )
        os.close(terminal)
        self.seen = b""

    def read_until(self, mark: bytes | None) -> None:
        """Read until the shell has shown ``mark``, or (None) has ended; fails after a minute."""
        until = time.monotonic() + _SECONDS
        while mark is None or mark not in self.seen:
            assert select.select([self.master], [], [], max(0.0, until - time.monotonic()))[0], self.seen
            try:
                octets = os.read(self.master, 4096)
            except OSError:  # the other end was closed
                octets = b""
            if not octets:
                assert mark is None, self.seen
                return
            self.seen += octets

    def type(self, keys: str) -> None:
        os.write(self.master, keys.encode())

    def close(self) -> None:
        os.close(self.master)
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()


@pytest.mark.parametrize(
    ("shell", "begun"), [("bash", "cra"), ("bash", "'cra"), ("bash", '"cra'), ("zsh", "cra"), ("fish", "cra")]
)
def test_a_name_is_inserted_as_one_word_and_runs_nothing(home: Path, tmp_path: Path, shell: str, begun: str) -> None:
    """bash was given it bare: with spaces it was several words, and ``$(…)`` of a name ran on Enter."""
    if shutil.which(shell) is None or shutil.which("setsid") is None:
        pytest.skip(f"{shell} or setsid is not installed")
    assert call(home, "whitelist", "add", UUID, "--name", HOSTILE).code == 0
    folder = tmp_path / "desk"
    folder.mkdir()
    typed = CompletionShell(shell, folder, home)
    try:
        typed.read_until(b"ready> ")
        typed.type(f"teds-provision verify {begun}\t")
        typed.read_until(b"arm")
        typed.type("\n")
        typed.read_until(None)
    finally:
        typed.close()
    assert (folder / "got").read_text().splitlines() == ["verify", HOSTILE]
    assert not (folder / "ran").exists()


def test_names_of_groups_stations_and_files_are_offered_where_they_are_meant(home: Path) -> None:
    assert call(home, "whitelist", "add", UUID, "--name", "finger").code == 0
    assert call(home, "group", "create", "left hand", UUID).code == 0
    for line in ("measure lef", "group add lef", "nodes --group lef"):
        assert offered(home, f"teds-provision {line}") == ["plain,left hand"], line
    for line in ("show bun", "show --diff a", "measure x --to run", "verify none"):
        assert offered(home, f"teds-provision {line}") == [f"file,{line.split()[-1]}"], line
    assert offered(home, "teds-provision profile show accel") == ["plain,accelerometer"]
    assert offered(home, "teds-provision group create lef") == []


def test_nodes_are_offered_by_name_and_uuid_and_stations_by_name(home: Path, tmp_path: Path) -> None:
    other = UUID[:-1] + "1"
    assert call(home, "whitelist", "add", UUID, "--name", "finger").code == 0
    assert call(home, "whitelist", "add", other, "--name", "thumb").code == 0
    for name, number in (("lab", 71), ("lathe", 72), ("mill", 73)):
        (tmp_path / f"{name}.pem").write_text(to_pem(SoftwareKey(number).point))
        assert call(home, "trust", "add", name, tmp_path / f"{name}.pem", "--yes").code == 0

    def offers(parameter: click.Parameter, begun: str, command: str = "x") -> list[str]:
        ctx: Any = SimpleNamespace(
            find_root=lambda: SimpleNamespace(params={"home": home}), command_path=f"teds-provision {command}"
        )
        offer = shell_completion._offer_for(parameter)
        return [] if offer is None else [item.value for item in offer(ctx, parameter, begun)]

    for name in ("uuid", "uuids", "what", "old", "new", "node", "nodes", "text", "names"):
        argument = click.Argument([name])
        assert (offers(argument, "fin"), offers(argument, UUID[:19])) == (["finger"], [UUID, other]), name
    stations = ["lab", "lathe"]
    assert offers(click.Argument(["name"]), "la", "trust remove") == stations
    assert offers(click.Option(["--to", "receivers"]), "la") == stations
    assert offers(click.Argument(["name"]), "la", "trust add") == []
    assert offers(click.Option(["--name"]), "fin") == []
    assert offers(click.Option(["--profile"]), "load-c") == ["load-cell"]
    assert offers(click.Option(["--extends"]), "load-c") == ["load-cell"]


def test_without_a_store_or_with_a_broken_one_nothing_is_offered(home: Path, tmp_path: Path) -> None:
    def broken(_station: Any) -> Any:
        raise StoreError("The disk is away.")

    there, nowhere = (
        cast(Any, SimpleNamespace(find_root=lambda folder=folder: SimpleNamespace(params={"home": folder})))
        for folder in (home, tmp_path / "none")
    )
    assert shell_completion._items(nowhere, lambda _station: [("a", "b")]) == []
    assert shell_completion._items(there, broken) == []
    found = shell_completion._items(there, lambda _station: [("a", "b\nc"), ("two\nlines", "x")])
    assert [item.value for item in found] == ["a"], "no word of two lines"


def test_what_begins_otherwise_is_not_offered(home: Path) -> None:
    """A word from the middle of a name would be put in the place of what was typed."""
    uuid = "8d4d9da65281f7000007"
    assert call(home, "whitelist", "add", uuid, "--name", "left hand").code == 0
    for name in ("left hand", "hand", "Hand"):
        assert call(home, "group", "create", name, uuid).code == 0
    ctx: Any = SimpleNamespace(
        find_root=lambda: SimpleNamespace(params={"home": home}), command_path="teds-provision nodes"
    )

    def offers(parameter: click.Parameter, begun: str) -> list[str]:
        offer = shell_completion._offer_for(parameter)
        assert offer is not None
        return [item.value if item.type == "plain" else item.type for item in offer(ctx, parameter, begun)]

    group, node = click.Option(["--group"]), click.Argument(["uuid"])
    assert (offers(group, "hand"), offers(group, "left"), offers(group, "eft")) == (["hand"], ["left hand"], [])
    assert (offers(node, "hand"), offers(node, "left"), offers(node, "d4d")) == (["file"], ["left hand"], ["file"])
    assert offers(click.Argument(["what"]), "left") == ["left hand", "left hand"], "the group and the node"


def test_in_a_list_of_zsh_only_what_has_a_description_is_escaped() -> None:
    zsh = shell_completion.Zsh(click.Command("x"), {}, "x", "x")
    assert zsh.format_completion(shell_completion.CompletionItem("a\\b")) == "plain\na\\b\n_"
    assert zsh.format_completion(shell_completion.CompletionItem("a\\b", help="an arm")) == "plain\na\\\\b\nan arm"


@pytest.mark.parametrize("fails", [False, True])
def test_the_store_is_closed_after_each_completion(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, fails: bool
) -> None:
    closed: list[str] = []
    station = SimpleNamespace(close=lambda: closed.append("closed"))
    monkeypatch.setattr(shell_completion.stations.Station, "open", lambda *_words, **_how: station)
    ctx: Any = SimpleNamespace(find_root=lambda: SimpleNamespace(params={"home": tmp_path}))

    def found(_station: Any) -> Any:
        if fails:
            raise StoreError("The disk is away.")
        return [("a", "b")]

    assert len(shell_completion._items(ctx, found)) == (0 if fails else 1)
    assert closed == ["closed"]
