"""The exception tree: what a message may be."""

from __future__ import annotations

from teds_provision.errors import NotFoundError


def test_a_word_that_nobody_can_read_is_cut_in_the_middle() -> None:
    error = NotFoundError(f"No node is known as {'x' * 5000!r}, and no file.", hint="Look.")
    assert len(error.message) < 400
    assert error.message.startswith("No node is known as 'xxx")
    assert error.message.endswith(", and no file.")
    assert NotFoundError("y" * 512).message == "y" * 512, "paths and keys stay whole"
