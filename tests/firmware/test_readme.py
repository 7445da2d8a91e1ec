"""The pages of firmware/ say what was measured, and what a port takes; what they show compiles."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.firmware import budgets, builds

PAGES = [builds.FIRMWARE / "README.md", *sorted((builds.FIRMWARE / "docs").glob("*.md"))]
FIGURES = (builds.FIRMWARE / "docs/figures.md").read_text(encoding="utf-8")
PORTING = (builds.FIRMWARE / "docs/porting.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("step", budgets.STEPS["m0"])
def test_it_reports_the_figures_that_are_held(step: str) -> None:
    assert budgets.row(step) in FIGURES


def test_it_names_the_sizes_that_are_held() -> None:
    assert f"{budgets.STACK:,} octets" in FIGURES
    assert f"| {budgets.NODE:,} |" in FIGURES
    for build, octets in budgets.TEXT.items():
        assert f"{octets / 1000:.1f} KB" in FIGURES, build


def test_whole_ports_have_the_lines_that_the_page_names() -> None:
    lines = len((builds.FIRMWARE / "port/qemu/node.c").read_text(encoding="utf-8").splitlines())
    assert lines < 200
    assert f"{lines} lines on bare metal" in PORTING
    lines = len((builds.FIRMWARE / "port/posix/flash_file.c").read_text(encoding="utf-8").splitlines())
    assert f"[flash_file.c](../port/posix/flash_file.c) {lines}" in PORTING


def test_the_main_loop_is_that_of_the_blank_port() -> None:
    """Which test_packaging.py compiles and links: each function that the page calls exists."""
    shown = re.findall(r"```c\n(.*?)```", PORTING, flags=re.DOTALL)
    assert len(shown) == 1
    assert (builds.FIRMWARE / "port/template/main.c").read_text(encoding="utf-8").endswith(shown[0])


@pytest.mark.needs_room("check")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_that_it_names_is_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for path in re.findall(r"`(tests/firmware/[\w.]+|src/\w+\.c)`", text):
        assert (builds.ROOT / path).exists() or (builds.FIRMWARE / path).exists(), path
