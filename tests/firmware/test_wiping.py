"""Secrets of the node in C that lie on its stack are wiped before it is left (security-teds.md, 3 and 4).

Nothing that it answers shows whether they are: the sources are read instead.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from tests.firmware.builds import FIRMWARE

FUNCTION = re.compile(r"^[a-z][^\n;=]*?\b(\w+)\([^;{}]*\)\n\{\n(.*?)^\}", re.MULTILINE | re.DOTALL)
LOCALS = re.compile(r"^ +(?:uint8_t|teds_keys|teds_state|teds_taken) [^*(]+;", re.MULTILINE)
SECRET = re.compile(r"\b(z|okm|prk|key)\[|\bteds_(?:keys|state|taken) (\w+)")
"""Z, OKM and what it is made of, keys of a run; keys and the state of the node where they are copied by value."""


def secrets() -> Iterator[tuple[str, str, str]]:
    """Each secret local of a function: where it is, its name, and the function's text."""
    for path in sorted((FIRMWARE / "src").glob("*.c")):
        for name, body in FUNCTION.findall(path.read_text(encoding="utf-8")):
            for line in LOCALS.findall(body):
                for array, value in SECRET.findall(line):
                    yield f"{path.name} {name}", array or value, body


def test_keys_and_what_they_are_made_of_leave_no_copy_on_the_stack() -> None:
    found = list(secrets())
    assert {where for where, _, _ in found} >= {
        "agree.c teds_agree_keys",
        "agree.c teds_confirm",
        "commands.c run_sealed",
        "commands.c run_set_can_address",
        "commit.c teds_commit_state",
        "crypto.c teds_hkdf",
        "drive.c teds_drive",
        "session.c derive_keys",
        "session.c teds_open",
        "stream.c teds_subscribe",
    }
    blank = {"commit.c teds_to_factory"}  # it makes a state without a key
    left = [f"{where}: {name}" for where, name, body in found if where not in blank and not wiped(name, body)]
    assert left == []


def wiped(name: str, body: str) -> bool:
    """Return True if a function wipes the whole of this local."""
    return re.search(rf"teds_wipe\(&?{name}, sizeof {name}\);", body) is not None
