"""Hold what the mark ``nightly`` needs: a reason that begins with a test of the gate."""

from __future__ import annotations

import pytest

from tests.nightly import REFUSED, UNNAMED, refusals


class FakeItem(pytest.Item):
    def runtest(self) -> None:
        """Nothing: only its marks count."""


@pytest.fixture
def suite(request: pytest.FixtureRequest) -> list[pytest.Item]:
    """Return two tests, and one with two cases, of which the second is out of the gate."""
    items: list[pytest.Item] = [
        FakeItem.from_parent(request.node.parent, name=name, nodeid=f"tests/{name}")
        for name in ("x.py::test_holder", "x.py::test_moved", "y.py::test_case[a]", "y.py::test_case[b]")
    ]
    items[3].add_marker(pytest.mark.nightly("tests/y.py::test_case[a] holds it"))
    return items


def test_each_test_that_is_out_of_the_gate_names_one_in_it(request: pytest.FixtureRequest) -> None:
    """Of all that this run collected."""
    wrong = request.config.stash.get(REFUSED, [])
    assert not wrong, "\n".join(wrong)


def test_each_file_with_a_test_marked_realtime_has_the_mark_in_its_text(request: pytest.FixtureRequest) -> None:
    """``make unit`` collects those files alone for rules about time: a collection of all takes 6 s of CPU."""
    assert request.config.stash[UNNAMED] == []


@pytest.mark.parametrize(
    "reason",
    [
        "tests/x.py::test_holder holds it",
        "tests/y.py::test_case holds it",
        "tests/y.py::test_case[a], tests/x.py::test_holder: together",
        "tests/z.py::test_elsewhere: its file is not collected",
    ],
)
def test_a_reason_that_begins_with_tests_of_the_gate_is_accepted(suite: list[pytest.Item], reason: str) -> None:
    suite[1].add_marker(pytest.mark.nightly(reason))
    assert not refusals(suite)


@pytest.mark.parametrize(
    ("reason", "because"),
    [
        ("because it is slow", "begins with no test"),
        ("", "begins with no test"),
        ("held by tests/x.py::test_holder", "begins with no test"),
        ("tests/x.py::test_gone holds it", "is not held in the gate by tests/x.py::test_gone"),
        ("tests/y.py::test_case[b] holds it", "is not held in the gate by tests/y.py::test_case[b]"),
        ("tests/x.py::test_holder, tests/x.py::test_moved", "is not held in the gate by tests/x.py::test_moved"),
    ],
)
def test_any_other_reason_is_refused(suite: list[pytest.Item], reason: str, because: str) -> None:
    suite[1].add_marker(pytest.mark.nightly(reason))
    (line,) = refusals(suite)
    assert line.startswith("tests/x.py::test_moved: ")
    assert line.endswith(because)


def test_a_mark_without_a_reason_is_refused(suite: list[pytest.Item]) -> None:
    suite[1].add_marker(pytest.mark.nightly)
    assert len(refusals(suite)) == 1


@pytest.mark.parametrize("outside", ["soak", "machine", "rclpy"])
def test_a_test_that_is_left_out_for_another_reason_holds_nothing(suite: list[pytest.Item], outside: str) -> None:
    suite[0].add_marker(getattr(pytest.mark, outside))
    suite[1].add_marker(pytest.mark.nightly("tests/x.py::test_holder holds it"))
    assert len(refusals(suite)) == 1
