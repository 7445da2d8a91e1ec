"""The field tables are open to inspection, agree with the documentation, and importing them is cheap."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from teds_provision import teds

DOCS = Path(__file__).parents[2] / "docs" / "teds.md"
CLASSES = [1, 3, 5, 10, 12, 13, 16, 128]


def test_names_of_access_codes() -> None:
    assert [teds.name_of(code) for code in (1, 3, 5, 12, 13)] == [
        "MetaTEDS",
        "ChanTEDS",
        "CalTEDS",
        "XdcrName",
        "PHYTEDS",
    ]
    assert teds.name_of(64) == "reserved 64"
    assert teds.name_of(200) == "manufacturer 200"


def test_every_access_code_has_a_table() -> None:
    for code in range(256):
        assert teds.table(code).access_code == code


def test_a_row_says_everything() -> None:
    row = teds.table(3).by_name["ChanType"]
    assert (row.type, row.kind, row.need, row.confidence) == (11, "u8", "R", "H")
    assert row.enumeration == {0: "sensor", 1: "actuator", 2: "event sensor"}


def test_calibration_is_marked_unverified() -> None:
    table = teds.table(5)
    assert not table.verified
    assert {row.confidence for row in table.rows} == {"MEM", "unverified"}
    assert {row.type for row in table.rows if row.confidence == "unverified"} >= {128, 129, 135, 136}


def rows_of(access_code: int) -> list[teds.FieldSpec]:
    table = teds.table(access_code)
    return [*table.rows, *table.inner.values()]


@pytest.mark.parametrize("access_code", CLASSES)
def test_the_documentation_has_every_row(access_code: int) -> None:
    text = DOCS.read_text()
    for row in rows_of(access_code):
        assert f"| {row.type} | {row.name} | {row.kind} | {row.need} | {row.confidence} |" in text, row.name


def test_import_loads_nothing_heavy() -> None:
    code = (
        "import sys; from teds_provision import teds; "
        "teds.decode(teds.compose(3, {'PhyUnits': teds.Units()})); "
        "print([m for m in ('numpy', 'pint', 'cryptography', 'nfc', 'can', 'click', 'rich') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_lazy_names_are_found_and_others_are_not() -> None:
    assert all(hasattr(teds, name) for name in teds.__all__)
    assert callable(teds.encode)
    assert callable(teds.decode)
    with pytest.raises(AttributeError, match="nothing"):
        _ = teds.nothing


def test_fuzz_corpus_is_there() -> None:
    corpus = Path(__file__).parents[1] / "fuzz" / "corpus" / "teds"
    assert len(list(corpus.iterdir())) > 100
