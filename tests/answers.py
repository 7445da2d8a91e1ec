"""A person's answers in tests."""

from __future__ import annotations

from collections.abc import Callable

from teds_provision.provisioning.operator import AcceptingOperator


class Answers(AcceptingOperator):
    """Answers each question as it is given here, by its name; else as an operator who only accepts boards."""

    def __init__(self, **answers: Callable[..., object]) -> None:
        unknown = [name for name in answers if not hasattr(AcceptingOperator, name)]
        assert not unknown
        vars(self).update(answers)
