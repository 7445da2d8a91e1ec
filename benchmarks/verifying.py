"""``verify DIR`` of many datasheets beside three ECDSA checks each by openssl on all cores (issue 13 row 10).

Run: ``python -m benchmarks.verifying [COUNT]`` (default 10,000; half a minute). Ours is the shipped command from its
start to its last line, compiled as an installer leaves it, its files in the page cache; theirs what ``openssl speed
ecdsap256`` on all cores at once measures on this machine now, times three. Two cores that work at once are each slower
than one alone: what one alone does is printed beside. So is processor time of both, which a busy machine spoils less.
"""

from __future__ import annotations

import compileall
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import teds_provision
from benchmarks.machine import checks_a_second
from teds_provision.protocol.datasheet import SignedNodeKey, digests, sign_datasheet, unsigned_datasheet
from teds_provision.protocol.keys import SoftwareKey, fingerprint, node_key_message
from teds_provision.station.station import initialise
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.profile import load_profile
from teds_provision.vault import passphrase

AIM = 1.5
CHECKS = 3
PROFILE = "magnetic-angular-position-sensor"


def fill(folder: Path, home: Path, count: int) -> None:
    """Make a station, and so many images that it signed for nodes with different keys."""
    station, _ = initialise(
        home, name="n", keystore="file", ask=lambda p, c: "correct horse battery", costs=passphrase.THROWAWAY
    )
    profile, credentials = load_profile(PROFILE), station.credentials()
    folder.mkdir()
    for number in range(count):
        key, uuid = SoftwareKey.generate(), (1 + number).to_bytes(10, "big")
        node = SignedNodeKey(uuid, key.point, key.sign(node_key_message(uuid, key.point)))
        blocks = profile.build(uuid).blocks
        hint = security.ca_hint(station.name, fingerprint(station.ca))
        unsigned = unsigned_datasheet(
            node, station.point, station.identity.signature, digests(blocks), ca=hint, sequence=1, key_epoch=1
        )
        image = Image(uuid, {**blocks, SECURITY: sign_datasheet(unsigned, uuid, credentials)})
        (folder / f"{uuid.hex()}.json").write_text(image.to_json())
    station.close()


def ours(folder: Path, home: Path) -> tuple[float, float, str]:
    """Return seconds on the wall and of the processor, and the last line."""
    command = [sys.executable, "-m", "teds_provision", "--home", str(home), "verify", str(folder)]
    before, began = _used(), time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return time.perf_counter() - began, _used() - before, (done.stdout.splitlines() or [done.stderr])[-1]


def _used() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main(count: int) -> None:
    """Make, verify three times (the first fills the page cache), and print."""
    compileall.compile_dir(Path(teds_provision.__file__).parent, quiet=2)
    cores = len(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as name:
        folder, home = Path(name, "images"), Path(name, "home")
        fill(folder, home, count)
        runs = [ours(folder, home) for _ in range(3)]
    wall, cpu, last = min(runs)
    alone, together = checks_a_second(1), checks_a_second(cores)
    floor = CHECKS * count / together
    print(f"{last}  {wall:.2f} s, {cpu:.2f} s of the processor; load {os.getloadavg()[0]:.1f}")
    print(
        f"openssl: {together:,.0f} checks a second on {cores} cores at once ({alone:,.0f} on one alone);"
        f" {CHECKS} × {count:,} in {floor:.2f} s"
    )
    ratio = wall / floor
    print(f"verify DIR against that: {ratio:.2f} × (processor {cpu / cores / floor:.2f} ×); aim {AIM}: {_met(ratio)}")


def _met(ratio: float) -> str:
    return "met" if ratio <= AIM else "MISSED"


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
