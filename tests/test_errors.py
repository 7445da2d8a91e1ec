"""The exception tree: what a message may be."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import teds_provision
from teds_provision.client import ApiError
from teds_provision.errors import EXIT_CODES, LinkError, NotFoundError
from tests.parsed import parsed


def test_an_unreadable_word_is_cut_in_the_middle() -> None:
    error = NotFoundError(f"No node is known as {'x' * 5000!r}, and no file.", hint="Look.")
    assert len(error.message) < 400
    assert error.message.startswith("No node is known as 'xxx")
    assert error.message.endswith(", and no file.")
    assert NotFoundError("y" * 512).message == "y" * 512, "paths and keys stay whole"


@pytest.mark.needs_room("plant")
def test_each_code_of_the_tree_has_an_exit_code_which_the_client_has_too() -> None:
    """Read from the sources: most rooms name errors of their own, and load much."""
    files = Path(teds_provision.__file__).parent.rglob("*.py")
    codes = {
        part.value.value
        for file in files
        for node in ast.walk(parsed(file))
        if isinstance(node, ast.ClassDef) and node.name.endswith("Error")
        for part in node.body
        if isinstance(part, ast.Assign | ast.AnnAssign) and ast.unparse(part).startswith("code")
        if isinstance(part.value, ast.Constant) and isinstance(part.value.value, str)
    }
    assert codes == EXIT_CODES.keys() - {"bad-request"}
    assert {code: ApiError(418, code, "").exit_code for code in EXIT_CODES} == EXIT_CODES


def test_an_error_whose_code_has_no_exit_code_cannot_be_defined() -> None:
    with pytest.raises(KeyError):
        type("OvenError", (LinkError,), {"code": "too-hot"})
