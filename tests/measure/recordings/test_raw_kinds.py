"""What holds the raw values of a channel in a file follows from the form that its datasheet gives them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from teds_provision.measure.recordings.columns import raw_kind
from teds_provision.teds.calibration.samples import DataModel, SampleForm, SampleReader

KINDS = {"f": "float", "u": "uint64", "O": "integer"}


def forms() -> list[tuple[DataModel, int]]:
    """Return each data model in the lengths that it may have."""
    every = itertools.product(DataModel, (1, 2, 4, 8, 9, 12))
    return [(model, octets) for model, octets in every if not SampleForm(model, octets, 0).problem]


@pytest.mark.parametrize(("model", "octets"), forms())
def test_each_form_is_held_as_its_samples_are_read(model: DataModel, octets: int) -> None:
    """A Parquet made of a CSV held text in place of numbers, and could not be read."""
    form = SampleForm(model, octets, 7 if model == DataModel.UNSIGNED else 0)
    read = SampleReader(form).raw(np.full(octets, 255, dtype=np.uint8))
    kind = KINDS[read.dtype.kind]
    assert raw_kind(form.name) == ("int64" if kind == "uint64" and octets < 8 else kind)


@pytest.mark.parametrize("form", ["", "model 9 (reserved), 2 octets", "unsigned integer", "unsigned integer, many"])
def test_a_form_that_is_not_known_is_none(form: str) -> None:
    assert raw_kind(form) == ""
