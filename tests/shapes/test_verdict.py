"""A verdict and its checks have one form: verify --json, the API and its description follow from it."""

from __future__ import annotations

import ast
from dataclasses import replace
from typing import get_args, get_type_hints

import pytest

from teds_provision.api import answers
from teds_provision.api.operations import document
from teds_provision.provisioning.verify_files import FileVerdict
from teds_provision.shapes.verdict import (
    MERELY_UNSIGNED,
    PAGES,
    SESSION,
    Check,
    CheckMembers,
    NodeVerdict,
    VerdictMembers,
    VerdictWord,
    Verification,
)

from ..test_architecture import MODULES, PACKAGE, name_of, parsed

PASSED = Check("signed", "passed")
VERDICT = NodeVerdict(Verification(bytes(10), (PASSED,)), "session", "2026-11-27T12:00:00Z", "verify")


def test_a_check_has_the_same_members_as_object_json_and_description() -> None:
    """``kept`` becomes ``from: kept``, which only a check that is not of this start has."""
    members = [name for name in get_type_hints(CheckMembers) if name != "from"]
    assert [name for name in Check._fields if name != "kept"] == members == list(PASSED.to_json())
    assert list(PASSED._replace(kept=True).to_json().items())[-1] == ("from", "kept")
    assert schema("Check")["required"] == members
    assert set(schema("Check")["properties"]) == {*members, "from"}
    assert schema("Check")["properties"]["from"]["enum"] == ["kept"]


def test_a_verdict_has_the_same_members_as_object_json_and_description() -> None:
    members = set(get_type_hints(VerdictMembers))
    assert (
        set(VERDICT.to_json()) == set(schema("Verdict")["required"]) == set(schema("Verdict")["properties"]) == members
    )
    assert members <= set(get_type_hints(answers.Sheet)), "a datasheet comes with its verdict"
    assert VERDICT.reading() == {"from": "session", "at": "2026-11-27T12:00:00Z", "by": "verify"}
    assert VERDICT.reading().items() <= VERDICT.to_json().items()
    assert schema("Verdict")["properties"]["verdict"]["enum"] == list(get_args(VerdictWord))


def test_one_file_of_many_has_the_members_of_one_alone() -> None:
    alone = list(VERDICT.verified.to_json())
    for verified in (VERDICT.verified, None):
        assert list(FileVerdict(str(PACKAGE), verified).to_json()) == ["file", *alone, "warnings"]


WORDS = [
    ((), "authentic"),
    (sorted(MERELY_UNSIGNED), "unsigned"),
    (("signature", "signed"), "not authentic"),
    ((SESSION, "signature"), "unproven"),
    ((SESSION, PAGES), "unproven"),
    ((PAGES, "signature"), "not authentic"),
    ((SESSION, "sequence"), "not authentic"),
    ((SESSION, "key epoch"), "not authentic"),
    (("signed",), "unsigned"),
    ((SESSION,), "unproven"),
    ((SESSION, "signed"), "unproven"),
    ((PAGES,), "unproven"),
    ((PAGES, "sequence"), "not authentic"),
    ((SESSION, PAGES, "sequence"), "not authentic"),
    (("sequence",), "not authentic"),
]


@pytest.mark.parametrize(("failed", "word"), WORDS)
def test_one_word_sums_up_all_checks(failed: tuple[str, ...], word: str) -> None:
    checks = (PASSED, *(Check(name, "failed", "it is so") for name in failed))
    assert replace(VERDICT.verified, checks=checks).verdict == word
    skipped = tuple(check._replace(result="skipped") for check in checks)
    assert replace(VERDICT.verified, checks=skipped).verdict == "authentic", "what was not tried did not fail"


def test_the_description_names_the_words_that_are_given_and_no_other() -> None:
    assert {word for _, word in WORDS} == set(get_args(VerdictWord))


def test_no_other_place_writes_a_verdict_or_a_check_as_json() -> None:
    """Neither as a literal nor as a typed dictionary; a file that cannot be read has a verdict of null."""
    shapes = ({"verdict", "checks"}, {"name", "result", "why"})
    found = [
        f"{name_of(path)}:{node.lineno}"
        for path in MODULES
        if name_of(path) not in ("shapes/verdict.py", *OTHERS)
        for node in ast.walk(parsed(path))
        for shape in shapes
        if isinstance(node, ast.Dict) and shape <= {key.value for key in node.keys if isinstance(key, ast.Constant)}
        if not any(isinstance(value, ast.Constant) and value.value is None for value in node.values)
    ]
    assert found == []


OTHERS = ("provisioning/inventory.py", "doctor/report.py")
"""What has the same words and is something else: whether a channel fits a task, what is wrong on this machine."""


def schema(name: str) -> dict[str, list[str]]:
    found: dict[str, list[str]] = document()["components"]["schemas"][name]
    return found
