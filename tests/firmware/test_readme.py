"""firmware/README.md says what was measured, and what a port takes."""

from __future__ import annotations

import re

import pytest

from tests.firmware import budgets, builds

README = (builds.FIRMWARE / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("step", budgets.STEPS["m0"])
def test_it_tells_the_figures_that_are_held(step: str) -> None:
    assert budgets.row(step) in README


def test_it_names_the_two_sizes_that_are_held() -> None:
    assert f"{budgets.STACK:,} octets" in README
    assert f"| {budgets.NODE:,} |" in README
    for build, octets in budgets.TEXT.items():
        assert f"{octets / 1000:.1f} KB" in README, build


def test_a_whole_port_has_under_200_lines_and_the_page_its_number() -> None:
    lines = len((builds.FIRMWARE / "port/qemu/node.c").read_text(encoding="utf-8").splitlines())
    assert lines < 200
    assert f"{lines} lines on bare metal" in README


def test_every_file_that_it_names_is_there() -> None:
    for path in re.findall(r"\]\(((?:port|include|src|\.\./docs)[^)#]*|arm\.mk)", README):
        assert (builds.FIRMWARE / path).exists(), path
    for path in re.findall(r"`(tests/firmware/[\w.]+|src/\w+\.c)`", README):
        assert (builds.ROOT / path).exists() or (builds.FIRMWARE / path).exists(), path
