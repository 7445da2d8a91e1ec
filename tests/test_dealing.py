"""The order in which workers get the tests: none is lost, and each begins with those that take long."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tests.dealing import SECONDS, dealt, room_of

FILES = st.sampled_from(
    ["tests/page/test_a.py", "tests/page/test_b.py", "tests/ncap/test_c.py", "tests/teds/test_d.py", "tests/test_e.py"]
)


def named(files: list[str]) -> list[str]:
    return [f"{file}::test_{number}" for number, file in enumerate(sorted(files))]


@given(st.lists(FILES, max_size=60), st.integers(1, 9))
def test_each_test_is_dealt_once(files: list[str], workers: int) -> None:
    names = named(files)
    assert sorted(dealt(names, names, workers)) == sorted(names)


def test_every_worker_begins_with_what_takes_long_and_modules_stay_whole() -> None:
    files = [f"tests/ncap/test_{letter}.py" for letter in "abcdefgh" for _ in range(5)]
    files += [f"tests/page/test_{letter}.py" for letter in "ab" for _ in range(5)]
    files += ["tests/teds/test_all.py"] * 350
    names = named(files)
    order = dealt(names, names, 4)
    shares = [order[number : number + 100] for number in range(0, 400, 100)]
    assert order != names
    for share in shares:
        assert room_of(share[0]) in SECONDS
        assert room_of(share[-1]) == "tests/teds"
    for file in set(files) - {"tests/teds/test_all.py"}:
        assert sum(any(name.startswith(f"{file}::") for name in share) for share in shares) == 1
    pages = {number for number, share in enumerate(shares) if any(room_of(name) == "tests/page" for name in share)}
    assert len(pages) == 1, "one browser"
