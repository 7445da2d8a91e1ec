"""``show`` and ``profile show`` of every shipped type and every collected TEDS, against what is kept (shown.py)."""

from __future__ import annotations

from pathlib import Path

import pytest

from teds_provision.cli.main import run
from tests.cli.shown import HERE, cases, files_in, images, kept

NAMES = sorted(cases(lambda *words: "", files_in(Path())))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("shown")
    images(made)
    return made


@pytest.mark.parametrize("name", NAMES)
def test_what_is_shown_is_what_is_kept(name: str, folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    def called(*words: object) -> str:
        run(["--home", str(folder / "home"), *map(str, words)])
        return capfd.readouterr().out

    assert kept(cases(called, files_in(folder))[name](), folder) == (HERE / name).read_text()


def test_every_file_that_is_kept_is_compared() -> None:
    assert sorted(path.name for path in HERE.iterdir()) == NAMES
