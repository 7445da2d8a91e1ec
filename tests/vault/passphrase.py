"""Someone at the terminal who knows the passphrase of a vault."""

from __future__ import annotations

GOOD = "four random words here"
STORE = "5e" * 16


class Person:
    """Someone at the terminal: answers with one passphrase and remembers what was asked."""

    def __init__(self, passphrase: str = GOOD) -> None:
        self.passphrase = passphrase
        self.asked: list[tuple[str, bool]] = []

    def __call__(self, prompt: str, confirm: bool) -> str:
        self.asked.append((prompt, confirm))
        return self.passphrase
