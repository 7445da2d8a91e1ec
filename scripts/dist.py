"""Build what is released into a folder: `make dist`, or `python scripts/dist.py FOLDER`.

Wheel and sdist (the wheel is built from the sdist, so the sdist is whole), a bill of materials of the tool (from
locks/base.txt) and one of the C library, and SHA256SUMS. Two builds of one commit are equal octet for octet: archives
carry a fixed time, and the bills neither a time nor a random serial number.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import uuid
from pathlib import Path
from typing import Any, Final

from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

FIRMWARE: Final = Path("firmware")
# What the C library is linked against: one of them, chosen by the maker of a board (firmware/README.md).
CRYPTO: Final = {"BearSSL": ("0.6", "MIT"), "Mbed TLS": ("2.28", "Apache-2.0")}


def version() -> str:
    """Return the version of the package, as the build reads it."""
    found = re.search(r'__version__ = "([^"]+)"', Path("teds_provision/__init__.py").read_text())
    assert found is not None
    return found[1]


def run(*command: str) -> None:
    """Run one of the tools of a release; its output is shown only if it fails."""
    environment = {name: value for name, value in os.environ.items() if name != "SOURCE_DATE_EPOCH"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")


def without_time(bill: dict[str, Any]) -> dict[str, Any]:
    """Return a bill of materials without its time and with a serial number that follows from its content."""
    bill["metadata"].pop("timestamp", None)
    bill.pop("serialNumber", None)
    content = json.dumps(bill, sort_keys=True).encode()
    bill["serialNumber"] = f"urn:uuid:{uuid.UUID(bytes=hashlib.sha256(content).digest()[:16], version=4)}"
    return bill


def bill_of_tool(folder: Path) -> Path:
    """Write the bill of materials of the tool: every package of locks/base.txt with its hashes."""
    path = folder / f"teds-provision-{version()}.cdx.json"
    run(
        str(Path(sys.executable).parent / "cyclonedx-py"),
        *("requirements", "locks/base.txt", "--pyproject", "pyproject.toml", "--mc-type", "application"),
        *("--output-reproducible", "--sv", "1.6", "--output-format", "JSON", "--output-file", str(path)),
    )
    bill = json.loads(path.read_text())
    bill["metadata"]["component"]["version"] = version()
    path.write_text(json.dumps(without_time(bill), indent=2, sort_keys=True) + "\n")
    return path


def bill_of_firmware(folder: Path) -> Path:
    """Write the bill of materials of the C library: its files with their hashes, and the crypto library it calls."""
    sources = sorted([*(FIRMWARE / "src").glob("*.[ch]"), *(FIRMWARE / "include").rglob("*.h")])
    library = "teds-node"
    components: list[dict[str, Any]] = [
        {
            "type": "file",
            "bom-ref": str(path),
            "name": path.relative_to(FIRMWARE).as_posix(),
            "hashes": [{"alg": "SHA-256", "content": hashlib.sha256(path.read_bytes()).hexdigest()}],
        }
        for path in sources
    ]
    for name, (oldest, licence) in CRYPTO.items():
        components.append(
            {
                "type": "library",
                "bom-ref": name,
                "name": name,
                "version": oldest,
                "description": "the oldest version that is tested; a board links one of these libraries",
                "scope": "optional",
                "licenses": [{"license": {"id": licence}}],
            }
        )
    bill = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {
            "component": {
                "type": "firmware",
                "bom-ref": library,
                "name": library,
                "version": version(),
                "licenses": [{"license": {"id": "Apache-2.0"}}],
            }
        },
        "components": components,
        "dependencies": [{"ref": library, "dependsOn": sorted(CRYPTO)}],
    }
    path = folder / f"{library}-{version()}.cdx.json"
    path.write_text(json.dumps(without_time(bill), indent=2, sort_keys=True) + "\n")
    return path


def check_bill(path: Path) -> None:
    """Check a bill of materials against the schema of CycloneDX 1.6."""
    errors = JsonStrictValidator(SchemaVersion.V1_6).validate_str(path.read_text())
    if errors:
        sys.exit(f"{path} is no valid bill of materials: {errors}")


def main(folder: Path) -> int:
    """Build everything into an empty folder, check it, and print the checksums."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    os.umask(0o022)  # a mode in the archives must not depend on who builds
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder))  # hatchling of locks/release.txt
    archives = sorted(folder.iterdir())
    run(sys.executable, "-m", "twine", "check", "--strict", *map(str, archives))
    run(
        str(Path(sys.executable).parent / "check-wheel-contents"),
        *(str(path) for path in archives if path.suffix == ".whl"),
    )
    for bill in (bill_of_tool(folder), bill_of_firmware(folder)):
        check_bill(bill)
    released = sorted(folder.iterdir())
    sums = "".join(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in released)
    (folder / "SHA256SUMS").write_text(sums)
    print(sums, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
