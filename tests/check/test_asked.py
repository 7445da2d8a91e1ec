"""Every rule sends the requests of ``asked.txt`` to the reference node, gets the replies there, and reports them.

A rule that leaves out one of its cases still passes on a good node, and finds the one fault of the table: this file
holds what it asks. A line is a rule, what it saw, and its commands: ``channel:class.function/access code+octets`` of
the payload, the payload itself if it is specific to the rule and not random (of a long one the first octets and a
checksum), ``=reason`` of a refusal, ``[…]`` in a session, ``x3`` three times in a row. After a change of a rule,
rewrite the file and review the difference: ``python -m tests.check.test_asked``.
"""

from __future__ import annotations

import base64
import re
import string
import tempfile
import zlib
from collections import defaultdict
from itertools import groupby
from pathlib import Path

import pytest

from teds_provision.check.probe import Probe
from teds_provision.check.rule import Rule, RuleResult
from teds_provision.check.run import _Run
from teds_provision.protocol.keys import GROUP_ORDER, is_point, verify
from teds_provision.protocol.messages.frames import Command, Function, Reply
from teds_provision.protocol.session import StationSession
from teds_provision.station.station import Station
from tests.bench import make_station

from . import bends, nodes

ASKED = Path(__file__).with_name("asked.txt")
OVER = ("measuring can", "nfc read-only")
_SHORT = 12
_BASE64 = frozenset(string.ascii_letters.encode() + string.digits.encode() + b"+/=")
_OF_KEYS = {(128, number) for number in (1, 2, 3, 4, 8, 9, 17)}
"""Confirm, Open, Sealed, Prove, Reset and Arm: what is random in them differs from run to run."""


def _signed(point: bytes, message: bytes, signature: bytes) -> str:
    """Return whether a signature is right, right with the other s (high), or wrong."""
    high = int.from_bytes(signature[32:], "big") > GROUP_ORDER // 2
    right = is_point(point) and verify(point, message, bends.high(signature) if high else signature)
    return f"{'right' if right else 'wrong'}{' high' if high else ''}"


def _request(payload: bytes) -> str:
    """Return what is right of P(station), SIG104, P(CA) and E of a Request (profile.md, "Key agreement")."""
    station, signature, ca, one_time = payload[:65], payload[65:129], payload[129:194], payload[194:]
    signed = _signed(ca, b"TEDS1 station key\0" + station, signature)
    points = [is_point(point) for point in (station, ca, one_time)]
    return f"({''.join('nP'[point] for point in points)}{'=' * (one_time == station)} {signed})"


def _opened(probe: Probe, counter: bytes, payload: bytes) -> str:
    """Return what is right of keyId, Es and mac of an Open (profile.md, "Sessions")."""
    key = probe.key or b""
    known, point, mac = payload[:8], payload[8:73], payload[73:]
    right = bends.mac(key, b"station open" + probe.uuid + counter + point)[:16]
    wrong = [at for at in range(len(mac)) if mac[at] != right[at]]
    mac_is = "mac" if not wrong else f"octet {wrong[0]} of mac wrong" if len(wrong) == 1 else "mac wrong"
    own = known == bends.sha(b"TEDS1 key id" + bytes(1) + key)[:8]
    return f"({'nK'[own]}{'nP'[is_point(point)]} {mac_is})"


def _decoded(text: bytes) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except ValueError:
        return b""


def _sheet(probe: Probe, teds: bytes) -> str:
    """Return what a Security TEDS has in it, field by field, and which of its signatures are right."""
    block = teds[4:-2]
    fields, at, parts = dict[int, bytes](), 0, list[str]()
    while at < len(block):
        number, value = block[at], block[at + 2 : at + 2 + block[at + 1]]
        text = value.hex()
        if 100 <= number <= 104 and at:
            other = next(
                (f"{letter:02x} at {place}" for place, letter in enumerate(value) if letter not in _BASE64), ""
            )
            text = other or ("base64" if base64.b64encode(_decoded(value)) == value else "spare bits")
        elif number == 5 and at:
            text = re.sub(rb"[0-9a-f]{16,}", b"#", value).hex()
        parts.append(f"{number}={text}" + " twice" * (number in fields and number != 108))
        fields[number] = value
        at += 2 + len(value)
    words = f"{zlib.crc32(' '.join(parts).encode()):08x}, 106 {fields[106].hex()}, 107 {fields[107].hex()}"
    if 100 not in fields:
        return f"({words}, not signed)"
    unsigned = block.replace(bytes([100, 88]) + fields[100], b"")
    node, station, ca = _decoded(fields[101]), _decoded(fields[103]), probe.station.ca
    good = (
        _signed(station, b"TEDS1 datasheet\0" + probe.uuid + unsigned, _decoded(fields[100])),
        _signed(node, b"TEDS1 node key\0" + probe.uuid + node, _decoded(fields[102])),
        _signed(ca, b"TEDS1 station key\0" + station, _decoded(fields[104])),
    )
    return f"({words}, 100 {good[0]}, 102 {good[1]}, 104 {good[2]})"


def _shown(probe: Probe, command: Command, *, inside: bool, counter: bytes) -> str:
    """Return the payload, "" if it is the same for every rule or contains random octets."""
    kind, payload = (command.command_class, command.function), command.payload
    if kind == (128, 1) and len(payload) == 259:
        return _request(payload)
    if kind == (128, 3) and len(payload) == 89 and counter:
        return _opened(probe, counter, payload)
    if kind in _OF_KEYS or kind in ((1, 1), (1, 4)) or (kind == (1, 2) and not inside) or not payload:
        return ""
    if kind == (1, 3) and payload[0] == 128:
        return _sheet(probe, payload[5:])
    if kind == (4, 1):
        payload = payload[16:]  # after the digest of a Security TEDS
    if len(payload) <= _SHORT:
        return f"({payload.hex()})"
    return f"({payload[:8].hex()}…{zlib.crc32(payload):08x})"


def _token(command: Command, reply: Reply, shown: str, *, inside: bool) -> str:
    code = f"/{command.payload[0]}" if command.command_class == 1 and command.payload else ""
    refused = "" if reply.ok else f"={int(reply.reason or 0)}"
    text = f"{command.channel}:{command.command_class}.{command.function}{code}+{len(command.payload)}{shown}{refused}"
    return f"[{text}]" if inside else text


def asked(station: Station, over: str) -> list[str]:
    """Return a line for each rule that was tried, in order."""
    commands, results, now = defaultdict[str, list[str]](list), list[RuleResult](), [""]
    counters = dict[Probe, bytes]()
    plain, sealed, tried = Probe.plain, Probe._sealed, _Run._tried

    def plainly(self: Probe, command: Command) -> Reply:
        shown = _shown(self, command, inside=False, counter=counters.get(self, b""))
        reply = plain(self, command)
        if (command.command_class, command.function) == (128, Function.OPEN) and not command.payload and reply.ok:
            counters[self] = reply.payload
        if (command.command_class, command.function) != (128, Function.SEALED):
            commands[now[0]].append(_token(command, reply, shown, inside=False))
        return reply

    def in_session(self: Probe, session: StationSession, command: Command) -> Reply:
        shown = _shown(self, command, inside=True, counter=b"")
        reply = sealed(self, session, command)
        commands[now[0]].append(_token(command, reply, shown, inside=True))
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
