"""Someone who knows a PIN, and Python code beside the tokens."""

from __future__ import annotations

import subprocess
import sys

from tests.vault.softhsm import PIN


class Person:
    """Someone who knows a PIN, and counts how often it was asked for."""

    def __init__(self, pin=PIN):
        self.pin, self.prompts = pin, []

    def __call__(self, prompt, confirm):
        assert not confirm
        self.prompts.append(prompt)
        return self.pin


def in_new_process(uris, code, *words):
    """Run Python code in a process of its own that sees the same tokens."""
    return subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=60, check=False)
