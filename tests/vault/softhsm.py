"""A SoftHSM 2 of one's own: configuration and tokens in a temporary folder, no root needed."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

MODULE = next((str(path) for path in Path("/usr/lib").glob("**/libsofthsm2.so")), "/usr/lib/softhsm/libsofthsm2.so")
PIN = "482915"


class SoftHsm:
    """Tokens of one test run. The configuration is read when the module is loaded, so there is one per process."""

    def __init__(self, folder: Path) -> None:
        if shutil.which("softhsm2-util") is None:
            pytest.skip("the Debian package softhsm2 is not installed (scripts/install-test-packages)")
        (folder / "tokens").mkdir()
        self.configuration = folder / "softhsm2.conf"
        self.configuration.write_text(
            f"directories.tokendir = {folder / 'tokens'}\nobjectstore.backend = file\nlog.level = ERROR\n"
        )
        self.environment = {**os.environ, "SOFTHSM2_CONF": str(self.configuration)}

    def new_token(self, label: str) -> str:
        """Make a token and return the URI that names it."""
        words = ["softhsm2-util", "--init-token", "--free", "--label", label, "--pin", PIN, "--so-pin", "87654321"]
        subprocess.run(words, env=self.environment, capture_output=True, check=True, timeout=60)
        return f"pkcs11:token={label}?module-path={MODULE}"


def loaded(folder: Path, monkeypatch: pytest.MonkeyPatch, labels: tuple[str, ...]) -> dict[str, str]:
    """Make tokens and point this process at them; returns their URIs. The module is loaded anew."""
    hsm = SoftHsm(folder)
    uris = {label: hsm.new_token(label) for label in labels}
    monkeypatch.setenv("SOFTHSM2_CONF", str(hsm.configuration))
    unload()
    return uris


def unload() -> None:
    """Let go of the module, so that the next user reads its configuration anew."""
    import pkcs11

    if MODULE in pkcs11._loaded:
        pkcs11._loaded[MODULE].reinitialize()
