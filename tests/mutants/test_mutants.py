"""The bench of mutants itself: its rules are found in the code, what it draws is Python, its tests are near."""

from __future__ import annotations

import ast
import random
import time
from pathlib import Path

import pytest

from tests.mutants.changes import ROOT, Module, Mutant, Pattern, any_of, found, found_in_c, modules
from tests.mutants.nearest import Suite
from tests.mutants.patterns import C_PATTERNS, PATTERNS, SCRIPT_PATTERNS
from tests.mutants.run import MOST, Bench, Copy, Fate, Ran, among, drawn, report


@pytest.fixture(scope="module")
def house() -> list[Module]:
    return modules()


def both(mutant: Mutant, module: Module) -> tuple[str, str]:
    """Return the syntax of the outermost function around a mutant, without it and with it."""
    spans = (module.span(tree) for _, tree in module.functions)
    begin, end = next(span for span in spans if span[0] <= mutant.start < mutant.end <= span[1])
    begin = module.source.rfind("\n", 0, begin) + 1
    was, now = module.source[begin:end], mutant.applied(module.source[:end])[begin:]
    inside = "if True:\n" if was[0] == " " else ""
    return ast.dump(ast.parse(inside + was)), ast.dump(ast.parse(inside + now))


def test_every_rule_is_found_once_and_its_change_is_python(house: list[Module]) -> None:
    by_name = {module.name: module for module in house}
    for pattern in PATTERNS:
        mutants = found(pattern, house)
        assert len(mutants) == 1, f"{pattern.function}: {pattern.was} (tests/mutants/patterns.py)"
        without, with_it = both(mutants[0], by_name[mutants[0].path])
        assert without != with_it, pattern.rule


def test_every_rule_of_the_node_in_c_and_of_the_page_is_found_once() -> None:
    for pattern in (*C_PATTERNS, *SCRIPT_PATTERNS):
        (mutant,) = found_in_c(pattern)
        source = (ROOT / mutant.path).read_text()
        assert source.splitlines()[mutant.line - 1] in source[max(0, mutant.start - 400) : mutant.end + 400]
        assert mutant.applied(source) == source.replace(pattern.was, pattern.now)
        assert (ROOT / pattern.test).is_file()


def test_a_pattern_outlives_a_move_and_another_layout() -> None:
    text = "class Standing:\n    def require(self):\n        if (a\n                and not b):\n            pass\n"
    (mutant,) = found(Pattern("a rule", "Standing.require", "a and (not b)", "False"), [Module("elsewhere.py", text)])
    assert "if (False):" in mutant.applied(text)


def test_what_chance_draws_is_python_that_says_something_else(house: list[Module]) -> None:
    by_name = {module.name: module for module in house}
    """Of one room: finding all of the house takes four seconds of CPU."""
    for mutant in drawn(40, "measure", random.Random(7)):
        without, with_it = both(mutant, by_name[mutant.path])
        assert without != with_it, str(mutant)


def test_of_more_rules_than_an_hour_has_time_for_others_are_tried_each_time() -> None:
    """The first of the list were tried each time, and those of the node in C and of the page never."""
    rules = [Mutant("rule.py", number, number, "", "rule", 1, str(number)) for number in range(800)]
    assert among(rules[:150], 150, random.Random(1)) == rules[:150]
    first, second = (among(rules, 150, random.Random(seed)) for seed in (1, 2))
    assert (len(set(first)), len(set(second))) == (150, 150)
    assert first != second
    assert any(mutant.start > 700 for mutant in first)


def test_the_nearest_tests_of_a_module_come_first(house: list[Module]) -> None:
    tests = Suite(("provisioning", "ncap", "protocol"))

    def first(name: str) -> list[str]:
        module = next(module for module in house if module.name == f"teds_provision/{name}")
        mutant: Mutant = any_of(module)[0]
        return tests.nearest(mutant, 4)

    assert "tests/provisioning/test_agree.py" in first("provisioning/agree.py")
    assert "tests/ncap/test_guard.py" in first("ncap/web/tokens.py")
    assert any(path.startswith("tests/protocol/") for path in first("protocol/tim/teds_access.py"))


class SlowCopy(Copy):
    """Stands for a copy of the checkout whose tests take ``seconds``, and with ``hangs`` for ever beside a mutant."""

    def __init__(self, seconds: float, code: int = 0, *, hangs: bool = False) -> None:
        self.seconds, self.code, self.hangs = seconds, code, hangs
        self.limits: list[float] = []
        self.source = ""

    def put(self, name: str, source: str) -> None:
        """Note whether the mutant is in place."""
        self.source = source

    def run(self, words: list[str], seconds: float) -> Ran:
        """Report what pytest would, without taking the time."""
        broken = self.source != _SOURCE
        self.limits.append(round(seconds))
        needed = float("inf") if broken and self.hangs else self.seconds
        if needed > seconds:
            return Ran(None, "", seconds)
        return Ran(self.code if broken else 0, "FAILED tests/a/test_a.py::test_it - no", needed)


class OneFile(Suite):
    """Stands for the tests of the house: one file, whatever the mutant."""

    def __init__(self) -> None:
        pass

    def nearest(self, mutant: Mutant, most: int) -> list[str]:
        """Return the one file."""
        return ["tests/a/test_a.py"]


_SOURCE = "def rule():\n    return True\n"


def fate_of(copy: SlowCopy, until: float = 3600.0, rule: str = "a rule") -> Fate:
    """Try the one mutant there is."""
    (mutant,) = found(Pattern(rule, "rule", "True", "False"), [Module("rule.py", _SOURCE)])
    fate = Bench([copy], time.monotonic() + until, {"rule.py": _SOURCE}, OneFile()).try_one(mutant)
    assert fate is not None
    return fate


def test_a_mutant_whose_tests_are_slow_without_it_too_gets_their_time() -> None:
    copy = SlowCopy(seconds=200)
    assert fate_of(copy).survived
    assert copy.limits == [MOST, 900, 400]
    noticed = fate_of(SlowCopy(seconds=200, code=1))
    assert (noticed.by, noticed.survived, noticed.finished) == ("tests/a/test_a.py::test_it", False, True)


def test_a_mutant_whose_tests_do_not_end_is_no_survivor() -> None:
    for copy in (SlowCopy(seconds=200, hangs=True), SlowCopy(seconds=5, hangs=True), SlowCopy(seconds=2000)):
        fate = fate_of(copy)
        assert (fate.by, fate.survived, fate.finished) == ("", False, False)
        assert "RAN OUT OF TIME" in str(fate)
        assert "SURVIVED" not in str(fate)


def test_a_mutant_that_gets_a_share_of_what_is_left_is_not_measured() -> None:
    copy = SlowCopy(seconds=50)
    assert not fate_of(copy, until=5.0, rule="").finished
    assert len(copy.limits) == 1


@pytest.mark.parametrize(
    ("copy", "rule", "code", "survivors", "unfinished"),
    [
        (SlowCopy(5), "a rule", 1, 1, 0),
        (SlowCopy(5), "", 0, 1, 0),
        (SlowCopy(5, hangs=True), "a rule", 3, 0, 1),
        (SlowCopy(5, hangs=True), "", 0, 0, 1),
        (SlowCopy(5, code=1), "a rule", 0, 0, 0),
    ],
)
def test_survivors_and_what_ran_out_of_time_are_listed_apart(
    tmp_path: Path, copy: SlowCopy, rule: str, code: int, survivors: int, unfinished: int
) -> None:
    assert report([fate_of(copy, rule=rule)], 1, tmp_path) == code
    for name, count in (("survivors.txt", survivors), ("unfinished.txt", unfinished)):
        assert len((tmp_path / name).read_text().splitlines()) == count
