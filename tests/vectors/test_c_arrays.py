"""The vectors as C: they compile without a warning, and say in C what stands in the JSON; so does the page of costs."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.vectors.c_arrays import LEFT_OUT, PROFILE, main

ROOT = Path(__file__).parents[2]
STRICT = ("-std=c11", "-pedantic", "-Wall", "-Wextra", "-Werror")
TRANSCRIPTS = ("rotation", "sessions", "refusals", "commit", "reset", "repetition")
PLAYER = """
#include <inttypes.h>
#include <stdio.h>
#include "teds_vectors.h"
static void hex(teds_octets o) {
    if (o.octets == NULL) { printf("-"); return; }
    printf("h");
    for (size_t i = 0; i < o.length; i++) printf("%02x", o.octets[i]);
}
static void play(const struct teds_transcripts *t) {
    for (size_t e = 0; e < t->entries_count; e++) {
        printf("%s\\n", t->entries[e].name);
        for (size_t s = 0; s < t->entries[e].steps_count; s++) {
            const struct teds_transcripts_entries_steps *step = &t->entries[e].steps[s];
            printf("%s ", step->event == NULL ? "-" : step->event);
            hex(step->command); printf(" "); hex(step->reply); printf(" "); hex(step->nonceN);
            printf(" %" PRId64 " ", step->reason);
            hex(step->inner == NULL ? (teds_octets){NULL, 0} : step->inner->command);
            printf("\\n");
        }
    }
}
int main(void) {
    play(&teds_vectors_rotation); play(&teds_vectors_sessions); play(&teds_vectors_refusals);
    play(&teds_vectors_commit); play(&teds_vectors_reset); play(&teds_vectors_repetition);
    hex(teds_vectors_kat.uuid); printf("\\n");
    return 0;
}
"""


def compiler() -> str:
    found = shutil.which("gcc")
    if found is None:
        pytest.skip("gcc is not installed")
    return found


def octets(value: str | None) -> str:
    return "-" if value is None else f"h{value}"


def description(step: dict[str, Any]) -> str:
    inner = step.get("inner") or {}
    parts = [str(step.get("event") or "-"), *(octets(step.get(name)) for name in ("command", "reply", "nonceN"))]
    return " ".join([*parts, str(step.get("reason") or 0), octets(inner.get("command"))])


@pytest.mark.system
def test_the_vectors_are_the_same_in_c(tmp_path: Path) -> None:
    gcc = compiler()
    assert main([str(tmp_path)]) == 0
    (tmp_path / "player.c").write_text(PLAYER)
    sources = sorted(map(str, tmp_path.glob("*.c")))
    subprocess.run([gcc, *STRICT, "-o", str(tmp_path / "player"), *sources], check=True, timeout=240)
    shown = (
        subprocess.run([tmp_path / "player"], capture_output=True, check=True, timeout=60).stdout.decode().splitlines()
    )
    due = []
    for stem in TRANSCRIPTS:
        for entry in json.loads((PROFILE / f"{stem}.json").read_text())["entries"]:
            due += [entry["name"], *map(description, entry["steps"])]
    assert shown == [*due, octets(json.loads((PROFILE / "kat.json").read_text())["uuid"])]


def test_every_file_for_nodes_is_written(tmp_path: Path) -> None:
    assert main([str(tmp_path)]) == 0
    stems = {path.stem for path in PROFILE.glob("*.json")} - set(LEFT_OUT)
    assert {path.stem.removeprefix("teds_vectors_") for path in tmp_path.glob("*.c")} == stems
    assert main([]) == 2


@pytest.mark.system
def test_the_page_of_costs_says_what_the_header_costs(tmp_path: Path) -> None:
    gcc = compiler()
    page = (ROOT / "docs" / "node-cost.md").read_text(encoding="utf-8")
    rows = {name: int(octets) for name, octets in re.findall(r"\| `(teds_\w+)` \| (\d+) \|", page)}
    assert {"teds_node", "teds_session", "teds_pending", "teds_stream"} <= rows.keys()
    lines = "".join(f'printf("{name} %zu\\n", sizeof({name}));' for name in rows)
    source = tmp_path / "size.c"
    source.write_text(f'#include <stdio.h>\n#include "teds/node.h"\nint main(void) {{ {lines} return 0; }}\n')
    words = [gcc, *STRICT, f"-I{ROOT / 'firmware' / 'include'}", "-o", str(tmp_path / "size"), str(source)]
    subprocess.run(words, check=True, timeout=60)
    shown = subprocess.run([tmp_path / "size"], capture_output=True, check=True, timeout=60).stdout.decode()
    for name, octets in (line.split() for line in shown.splitlines()):
        assert rows[name] == pytest.approx(int(octets), rel=0.1), name
