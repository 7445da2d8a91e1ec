"""The JSON keys that docs/contract/cli.md promises, at least, of the commands that need no node."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from teds_provision.protocol.keys import SoftwareKey, to_pem

from .shell import call

UUID = "8d4d9da65281f7000000"
LISTED = {"uuid", "fingerprint", "added", "assurance"}
DRAFT = {"uuid", "profile", "stage", "created"}

# In their order: each finds what the ones before it left. Keys on top, and of the entries of the list that is first.
KEYS: tuple[tuple[str, set[str], set[str]], ...] = (
    (f"whitelist add {UUID} --fingerprint {'ab' * 32}", {"whitelist"}, LISTED),
    ("whitelist list", {"whitelist"}, LISTED),
    (f"whitelist remove {UUID} --dry-run", {"whitelist"}, LISTED),
    ("whitelist export FOLDER/list.xml", {"whitelist"}, LISTED),
    ("whitelist import FOLDER/list.xml", {"whitelist"}, LISTED),
    (f"build {UUID} --profile gripper", {"blocks", "uuid", "warnings"},
     {"access_code", "channel", "octets", "sha256"}),
    ("draft list", {"drafts"}, DRAFT),
    (f"draft drop {UUID} --dry-run", {"drafts"}, DRAFT),
    (f"label {UUID} --output FOLDER/label.svg", {"label"}, set()),
    ("nodes", {"nodes"},
     {"uuid", "due", "group", "sequence", "last_seen", "fingerprint", "name", "firmware", "wrapped"}),
    ("nodes --fits rate>=1Hz", {"fits"}, {"uuid", "channel", "result", "why"}),
    ("trust add lab FOLDER/lab.pem --yes", {"trusted"}, {"name", "role", "fingerprint"}),
    ("trust list", {"trusted"}, {"name", "role", "fingerprint"}),
    ("trust remove lab --dry-run", {"trusted"}, {"name", "role", "fingerprint"}),
    ("profile list", {"profiles"}, {"name"}),
    ("profile show gripper", {"profiles"}, {"name"}),
    ("profile check gripper", {"profiles"}, {"name"}),
    ("config set can socketcan:can0", {"settings"}, {"name", "value", "source"}),
    ("config show", {"settings"}, {"name", "value", "source"}),
    ("config unset can", {"settings"}, set()),
    (f"group create hand {UUID}", {"groups"}, {"name", "uuids"}),
    ("group list", {"groups"}, {"name", "uuids"}),
    (f"names frame {UUID} 0 tool", {"names"}, set()),
    (f"history {UUID}", {"history"}, set()),
    ("log", {"entries", "intact", "totals"}, {"act", "at", "outcome", "uuid"}),
    ("handover list", {"handovers"}, set()),
    ("vault rewrap --dry-run", {"keystore", "rewrapped"}, set()),
    ("init", {"name", "public_key", "fingerprint", "ca", "keystore"}, set()),
    ("doctor", {"checks"}, {"name", "result", "why", "fix"}),
    ("node create FOLDER/node --profile gripper", {"channels", "origin", "uuid", "fingerprint", "firmware"},
     {"channel"}),
    ("describe ffff --as td", {"error"}, set()),
    ("group delete hand --yes", {"groups"}, set()),
    ("", {"station", "links", "nodes", "next", "known", "problems"}, set()),
)  # fmt: skip


def test_each_command_has_the_keys_of_the_contract(home: Path, tmp_path: Path) -> None:
    (tmp_path / "lab.pem").write_text(to_pem(SoftwareKey(51).point))
    lacking = {}
    for text, keys, entry_keys in KEYS:
        outcome = call(home, "--json", *text.replace("FOLDER", str(tmp_path)).split())
        found: Mapping[str, Any] = outcome.json
        missing = keys - found.keys()
        if entry_keys and not missing:
            lists = [found[key] for key in sorted(keys) if isinstance(found[key], list)]
            assert lists[0], (text, outcome)
            missing = set().union(*(entry_keys - entry.keys() for entry in lists[0]))
        if missing or ("error" in found) != ("error" in keys):
            lacking[text] = (missing, outcome)
    assert lacking == {}


def test_an_error_has_code_message_and_hint(home: Path) -> None:
    """A whole one, of each of its kinds: by the program, by click, and none that was foreseen."""
    for words, code in ((["nodes", "zz"], "not-found"), (["nodes", "--zz"], "usage"), (["zz"], "usage")):
        found = call(home, "--json", *words).json
        assert found.keys() == {"error"}
        assert found["error"].keys() == {"code", "message", "hint"}
        assert found["error"]["code"] == code
