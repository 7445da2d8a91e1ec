"""Write the archive that later versions must read: ``python -m tests.release.make_assets`` (RELEASING.md).

Two homes of today's schema, a backup and a bundle, as test_older_homes.py describes them, in assets/schema-N.zip. Each
step is a command of the program on virtual nodes, so that the archive holds what a user's home would.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path
from typing import Final

from teds_provision.station.store.schema import SCHEMA_VERSION
from tests.release.test_older_homes import GRIPPER, PASSPHRASE, SENSOR

ASSETS: Final = Path(__file__).parent / "assets"
NODES: Final = {
    SENSOR: ("magnetic-angular-position-sensor", "slew angle", "udp:localhost:54891"),
    GRIPPER: ("gripper", "hand", "udp:localhost:54892"),
}
RAW: Final = {SENSOR: "raw,value [deg]\n0,0\n65535,359.9\n"}
RAW[GRIPPER] = "raw,value,channel\n0,0,1\n4095,110,1\n0,0,2\n4095,110,2\n0,0,3\n4095,140,3\n"
PROGRAM: Final = (sys.executable, "-m", "teds_provision")


def run(*words: object) -> str:
    """Run a command that has to succeed and return what it prints; the passphrase comes through a pipe."""
    read, write = os.pipe()
    os.write(write, f"{PASSPHRASE}\n".encode())
    os.close(write)
    command = [*PROGRAM, "--passphrase-fd", str(read), *map(str, words)]
    done = subprocess.run(command, pass_fds=(read,), capture_output=True, text=True, check=False)
    os.close(read)
    if done.returncode:
        sys.exit(f"{' '.join(command)}\n{done.stdout}{done.stderr}")
    return done.stdout


def provision(folder: Path, north: Path) -> None:
    """Have station north provision both nodes."""
    for uuid, (profile, name, reader) in NODES.items():
        run("node", "create", folder / uuid, "--uuid", uuid, "--profile", profile)
        node = subprocess.Popen([*PROGRAM, "node", "run", folder / uuid, "--nfc", reader], stdout=subprocess.DEVNULL)
        try:
            time.sleep(3)  # provision itself waits for the node on the reader
            curve = folder / f"{uuid}.csv"
            curve.write_text("# date: 2026-11-01\n" + RAW[uuid])
            words = ("--profile", profile, "--calibration", curve, "--name", name, "--nfc", reader, "--yes")
            run("--home", north, "provision", *words)
        finally:
            node.terminate()
            node.wait()


def main() -> int:
    """Make homes, backup and bundle, and put them into the archive."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        north, south = folder / "north", folder / "south"
        outcome = run("--home", north, "init", "--name", "north", "--keystore", "file")
        (folder / "north.pem").write_text(outcome[outcome.index("-----BEGIN") :])
        request, certificate = folder / "south.request", folder / "south.cert"
        run("--home", south, "init", "--name", "south", "--keystore", "file", "--request", request)
        run("--home", north, "trust", "ca", "sign", request, "--output", certificate, "--yes")
        run("--home", south, "init", "--certificate", certificate, "--yes")
        provision(folder, north)
        run("--home", north, "group", "create", "crane", SENSOR, GRIPPER)
        run("--home", north, "names", "set", SENSOR, "1", "crane/slew_angle")
        run("--home", north, "trust", "add", "south", certificate, "--yes")
        run("--home", south, "trust", "add", "north", folder / "north.pem", "--yes")
        bundle = ("--to", "south", "--all", "--output", folder / "keys.jwe", "--expires", "365", "--yes")
        run("--home", north, "export-keys", *bundle)
        run("--home", north, "backup", folder / "north.backup")
        kept = [*(home / name for home in (north, south) for name in ("store.sqlite3", "vault.json"))]
        kept += [folder / "keys.jwe", folder / "north.backup"]
        target = ASSETS / f"schema-{SCHEMA_VERSION}.zip"
        with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in kept:
                archive.write(path, path.relative_to(folder))
    print(target)
    return 0


if __name__ == "__main__":
    sys.exit(main())
