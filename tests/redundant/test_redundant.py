"""The choice of redundant tests: what a probe counts, and that no probe loses its last two tests."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np

from tests.redundant.choice import FEWEST_HITS, Measured, choose
from tests.redundant.probes import HITS, PLACE, compile_with_probes, probed

MODULE = '''"""A module."""

from __future__ import annotations

ONCE = 1


class Counter:
    """A class."""

    total = 0

    def add(self, more: int) -> int:
        """Add, if there is more."""
        global ONCE
        if more:
            self.total += more
        for number in range(more):
            if number > 5:
                break
            elif number:
                continue
        return self.total
'''


def hits_of(call: str) -> set[str]:
    """Return the places that a call hits, without the file."""
    places: list[str] = []
    hits: dict[int, int] = {}
    space = {"__name__": "invented", HITS: hits}
    exec(compile(probed(MODULE, "m", places), "m", "exec", dont_inherit=True), space)
    assert not hits, "statements of the module count for nobody"
    exec(call, space)
    return {places[number].removeprefix("m:") for number in hits}


def test_statements_and_branches_are_counted_and_nothing_else_changes() -> None:
    assert hits_of("assert Counter().add(0) == 0") == {"16", "16 else", "18", "18 else", "23"}
    assert hits_of("assert Counter().add(1) == 1") == {"16", "17", "18", "19", "18 else", "21", "21 else", "23"}
    assert hits_of("assert Counter().add(7) == 7") == {"16", "17", "18", "19", "20", "21", "22", "21 else", "23"}
    assert hits_of("assert Counter.add.__doc__ == 'Add, if there is more.'") == set()


def test_a_process_counts_into_the_file_that_its_environment_names(tmp_path: Path) -> None:
    package = tmp_path / "teds_provision"
    package.mkdir()
    (package / "__init__.py").write_text(MODULE)
    places = compile_with_probes(tmp_path)
    assert Path(importlib.util.cache_from_source(str(package / "__init__.py"))).is_file()
    hits = tmp_path / "hits"
    hits.write_bytes(bytes(len(places)))
    code = "import os, signal, teds_provision; teds_provision.Counter().add(0); os.kill(os.getpid(), signal.SIGKILL)"
    words = [sys.executable, "-c", code]
    assert subprocess.run(words, cwd=tmp_path, env={PLACE: str(hits)}, check=False).returncode == -9
    found = {places[number] for number, octet in enumerate(hits.read_bytes()) if octet}
    assert found == {f"teds_provision/__init__.py:{line}" for line in ("16", "16 else", "18", "18 else", "23")}
    words[-1] = "import teds_provision; assert teds_provision.Counter().add(2) == 2"  # and nobody is asked
    assert subprocess.run(words, cwd=tmp_path, env={}, check=False).returncode == 0


def one(name: str, cpu: float, *more: int, failed: bool = False) -> Measured:
    """Return a test that hits the usual hundred probes and some more."""
    return Measured(name, cpu, np.array([*range(FEWEST_HITS), *(FEWEST_HITS + number for number in more)]), failed)


def chosen(*tests: Measured, kept: tuple[str, ...] = ()) -> dict[str, tuple[str, ...]]:
    return {choice.test.name: choice.holders for choice in choose(tests, least=1.0, others=2, kept=kept)}


def test_a_test_goes_if_two_others_that_stay_hit_each_of_its_probes() -> None:
    tests = one("a::x", 4, 1), one("b::x", 3, 1), one("c::x", 2, 1), one("d::x", 1, 2)
    assert chosen(*tests) == {"a::x": ("b::x",)}
    assert chosen(*tests, one("e::x", 0.1, 1)) == {"a::x": ("c::x",), "b::x": ("c::x",)}
    assert chosen(*tests[:2], one("c::fixture all", 9, 1)) == {"a::x": ("b::x",)}


def test_what_failed_what_is_kept_and_what_runs_nothing_stays() -> None:
    cheap = [one(f"z::{number}", 0.1) for number in range(3)]
    assert set(chosen(one("a::x[1]", 3), one("a::x[2]", 2), *cheap)) == {"a::x[1]", "a::x[2]"}
    assert set(chosen(one("a::x[1]", 3), one("a::x[2]", 2), *cheap, kept=("a::x(1)",))) == {"a::x[2]"}
    assert chosen(one("a::x", 3, failed=True), *cheap) == {}
    assert chosen(Measured("a::x", 3, np.array([1])), *cheap) == {}
