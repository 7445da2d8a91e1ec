"""The bench of mutants itself: its rules are found in the code, what it draws is Python, its tests are near."""

from __future__ import annotations

import ast
import random

import pytest

from tests.mutants.changes import ROOT, Module, Mutant, Pattern, any_of, found, found_in_c, modules
from tests.mutants.nearest import Suite
from tests.mutants.patterns import C_PATTERNS, PATTERNS
from tests.mutants.run import drawn


@pytest.fixture(scope="module")
def house() -> list[Module]:
    return modules()


def test_every_rule_is_found_once_and_its_change_is_python(house: list[Module]) -> None:
    for pattern in PATTERNS:
        mutants = found(pattern, house)
        assert len(mutants) == 1, f"{pattern.function}: {pattern.was} (tests/mutants/patterns.py)"
        source = (ROOT / mutants[0].path).read_text()
        changed = mutants[0].applied(source)
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(source)), pattern.rule


def test_every_rule_of_the_node_in_c_is_found_once() -> None:
    for pattern in C_PATTERNS:
        (mutant,) = found_in_c(pattern)
        source = (ROOT / mutant.path).read_text()
        assert source.splitlines()[mutant.line - 1] in source[mutant.start - 200 : mutant.end + 200]
        assert mutant.applied(source) == source.replace(pattern.was, pattern.now)
        assert (ROOT / pattern.test).is_file()


def test_a_pattern_outlives_a_move_and_another_layout() -> None:
    text = "class Standing:\n    def require(self):\n        if (a\n                and not b):\n            pass\n"
    (mutant,) = found(Pattern("a rule", "Standing.require", "a and (not b)", "False"), [Module("elsewhere.py", text)])
    assert "if (False):" in mutant.applied(text)


def test_what_chance_draws_is_python_that_says_something_else(house: list[Module]) -> None:
    sources = {module.name: module.source for module in house}
    """Of one room: finding all of the house takes four seconds of CPU."""
    for mutant in drawn(40, "measure", random.Random(7)):
        changed = mutant.applied(sources[mutant.path])
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(sources[mutant.path])), str(mutant)


def test_the_nearest_tests_of_a_module_come_first(house: list[Module]) -> None:
    tests = Suite(("provisioning", "ncap", "protocol", "station", "cli"))

    def first(name: str) -> list[str]:
        module = next(module for module in house if module.name == f"teds_provision/{name}")
        mutant: Mutant = any_of(module)[0]
        return tests.nearest(mutant, 4)

    assert "tests/provisioning/test_agree.py" in first("provisioning/agree.py")
    assert "tests/ncap/test_guard.py" in first("ncap/web/tokens.py")
    assert any(path.startswith("tests/protocol/") for path in first("protocol/tim/teds_access.py"))
