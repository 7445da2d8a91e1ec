"""Every rule asks the reference node what ``asked.txt`` has, gets the replies there, and says what it saw.

A rule that leaves out one of its cases still passes on a good node, and finds the one fault of the table: this file
holds what it asks. A line is a rule, what it saw, and its commands: ``channel:class.function/access code+octets`` of
the payload, ``=reason`` of a refusal, ``[…]`` in a session, ``x3`` three times in a row. Who changes a rule writes the
file anew, and reads what changed: ``python -m tests.check.test_asked``.
"""

from __future__ import annotations

import re
import tempfile
from collections import defaultdict
from itertools import groupby
from pathlib import Path

import pytest

from teds_provision.check.probe import Probe
from teds_provision.check.rule import Rule, RuleResult
from teds_provision.check.run import _Run
from teds_provision.protocol.messages.frames import Command, Function, Reply
from teds_provision.protocol.session import StationSession
from teds_provision.station.station import Station
from tests.bench import make_station

from . import nodes

ASKED = Path(__file__).with_name("asked.txt")
OVER = ("measuring can", "nfc read-only")


def _token(command: Command, reply: Reply, *, inside: bool) -> str:
    code = f"/{command.payload[0]}" if command.command_class == 1 and command.payload else ""
    refused = "" if reply.ok else f"={int(reply.reason or 0)}"
    text = f"{command.channel}:{command.command_class}.{command.function}{code}+{len(command.payload)}{refused}"
    return f"[{text}]" if inside else text


def asked(station: Station, over: str) -> list[str]:
    """Return a line for each rule that was tried, in order."""
    commands, results, now = defaultdict[str, list[str]](list), list[RuleResult](), [""]
    plain, sealed, tried = Probe.plain, Probe._sealed, _Run._tried

    def plainly(self: Probe, command: Command) -> Reply:
        reply = plain(self, command)
        if (command.command_class, command.function) != (128, Function.SEALED):
            commands[now[0]].append(_token(command, reply, inside=False))
        return reply

    def in_session(self: Probe, session: StationSession, command: Command) -> Reply:
        reply = sealed(self, session, command)
        commands[now[0]].append(_token(command, reply, inside=True))
        return reply

    def of_rule(self: _Run, rule: Rule) -> RuleResult:
        now[0] = rule.name
        results.append(tried(self, rule))
        return results[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Probe, "plain", plainly)
        patch.setattr(Probe, "_sealed", in_session)
        patch.setattr(_Run, "_tried", of_rule)
        nodes.checked(station, patch, nodes.made(over), over=over)
    lines = []
    for result in results:
        runs = [(token, len(list(same))) for token, same in groupby(commands[result.rule])]
        text = " ".join(token if count == 1 else f"{token} x{count}" for token, count in runs)
        seen = re.sub(r"\b[0-9.]+ ms\b", "… ms", result.detail)  # what a machine that is busy takes
        lines.append(f"{result.rule} | {result.result}: {seen} | {text}".rstrip())
    return lines


def _all(station: Station) -> str:
    return "\n".join(line for over in OVER for line in (f"== over {over}", *asked(station, over))) + "\n"


def test_every_rule_asks_what_it_asked(station: Station) -> None:
    found, due = _all(station).splitlines(), ASKED.read_text().splitlines()
    assert [line for line in found if line not in due] == [line for line in due if line not in found] == []
    assert found == due


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        ASKED.write_text(_all(make_station(Path(folder) / "bench", "bench")))
