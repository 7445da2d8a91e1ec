"""The client of the API, without a base station: what it asks for, and under which condition it writes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from teds_provision.client import Client

UUID, OTHER = "ab" * 10, "cd" * 10
Asked = tuple[str, str, Any, str | None]


class Desk(Client):
    """A client whose requests are kept, and answered by ``answers``; mock, no base station is there."""

    def __init__(self, *answers: Any) -> None:
        super().__init__("http://localhost:1")
        self.asked: list[Asked] = []
        self.answers = list(answers)

    def request(self, method: str, path: str, body: Any = None, *, if_match: str | None = None) -> Any:
        """Keep a request."""
        self.asked.append((method, path, body, if_match))
        return self.answers.pop(0) if self.answers else {"uuid": OTHER if OTHER in path else UUID, "safe": None}


def write(desk: Desk, node: str, *, dry_run: bool = False) -> str | None:
    """Write a datasheet; return the condition under which it is written."""
    desk.write_teds(node, "<teds/>", dry_run=dry_run)
    return desk.asked[-1][3]


@pytest.mark.parametrize("read", [lambda desk: desk.teds("hand"), lambda desk: write(desk, "hand", dry_run=True)])
def test_a_datasheet_that_was_read_is_the_condition_of_one_write_by_whichever_name(read: Callable[[Desk], Any]) -> None:
    """Read under its name and written under its UUID, its next write under the name was refused."""
    for first, second in (("hand", UUID), (UUID, "hand")):
        desk = Desk()
        desk.etag = '"e1"'
        read(desk)
        desk.etag = None
        assert write(desk, OTHER) is None, "another node's reading is no condition"
        assert write(desk, first) == '"e1"'
        assert write(desk, second) is None


def test_of_two_readings_of_a_node_under_two_names_the_later_is_the_condition() -> None:
    desk = Desk()
    for tag, name in (('"e1"', "hand"), ('"e2"', UUID)):
        desk.etag = tag
        desk.teds(name)
    desk.etag = None
    assert write(desk, "hand") == '"e2"'


def test_a_dry_run_is_under_no_condition_and_what_has_no_tag_makes_none() -> None:
    desk = Desk()
    desk.etag = '"e1"'
    desk.teds(UUID)
    desk.etag = '"e2"'
    assert write(desk, UUID, dry_run=True) is None
    desk.etag = None
    desk.teds(UUID)
    assert write(desk, UUID) == '"e2"', "the newest reading that is known"


def test_nodes_are_fetched_until_all_are_there_or_none_comes_any_more() -> None:
    pages = [
        {"nodes": [{"uuid": f"{at:020x}"} for at in range(*span)], "total": 5} for span in ((0, 2), (2, 4), (4, 5))
    ]
    desk = Desk(*pages)
    assert [int(node["uuid"], 16) for node in desk.nodes()] == [0, 1, 2, 3, 4]
    assert [path for _, path, *_ in desk.asked] == [f"/nodes?offset={offset}" for offset in (0, 2, 4)]
    some_left = Desk(pages[0], {"nodes": [], "total": 5})
    assert len(some_left.nodes()) == 2


@pytest.mark.parametrize(
    ("ask", "expected"),
    [
        (lambda desk: desk.past("a/b", 2), ("GET", "/nodes/a%2Fb/past?channel=2&points=600", None)),
        (
            lambda desk: desk.past(UUID, 1, since=0.0, until=9.5, points=3),
            ("GET", f"/nodes/{UUID}/past?channel=1&points=3&from=0.0&until=9.5", None),
        ),
        (lambda desk: desk.update(b"x", "a", "b"), ("POST", "/updates?nodes=a%2Cb", b"x")),
        (
            lambda desk: desk.update(b"x", match="all", dry_run=True, other_board=["a"], allow_downgrade=True, wait=9),
            ("POST", "/updates?match=all&dry_run=1&other_board=a&allow_downgrade=1&wait=9", b"x"),
        ),
        (lambda desk: desk.release_actuator(UUID, 3), ("PUT", f"/nodes/{UUID}/channels/3", {"hold": 0})),
        (
            lambda desk: desk.set(UUID, 3, 0.0),
            ("PUT", f"/nodes/{UUID}/channels/3", {"value": 0.0, "unit": None, "hold": None}),
        ),
        (lambda desk: desk.end_measurement("a/b"), ("DELETE", "/measurements/a%2Fb", None)),
        (lambda desk: desk.locate(UUID, 0), ("POST", f"/nodes/{UUID}/locate", {"seconds": 0})),
    ],
)
def test_each_call_asks_what_it_says(ask: Callable[[Desk], Any], expected: tuple[str, str, Any]) -> None:
    desk = Desk()
    ask(desk)
    [(method, path, body, condition)] = desk.asked
    assert ((method, path, body), condition) == (expected, None)
