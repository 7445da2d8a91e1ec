"""``verify DIR`` of many datasheets beside three ECDSA checks each by openssl on all cores (issue 13 row 10).

Run: ``python -m benchmarks.verifying [COUNT]`` (default 10,000; half a minute). Ours is the shipped command from its
start to its last line, compiled as an installer leaves it, its files in the page cache; theirs what ``openssl speed
ecdsap256`` on all cores at once measures on this machine now, times three. Two cores that work at once are each slower
than one alone: what one alone does is printed beside. So is processor time of both, which a busy machine spoils less.

It also prints what the libraries alone need for one file, in turns with ours in one process: the file by the
system's calls, its JSON, the node's key loaded, the two checks that ours makes (a certificate vouches for all files).
"""

from __future__ import annotations

import compileall
import hashlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import teds_provision
from benchmarks.bare_checks import (
    PREHASHED,
    ROW,
    FileCost,
    SignedDigest,
    cost_of_a_file,
    load_key,
    octets_of,
    signed_digest,
)
from benchmarks.machine import checks_a_second
from teds_provision.files import read_limited
from teds_provision.limits import LIMITS
from teds_provision.protocol.datasheet import SignedNodeKey, digests, sign_datasheet, unsigned_datasheet
from teds_provision.protocol.keys import SoftwareKey, fingerprint, node_key_message
from teds_provision.provisioning.verify import snapshot_trust, verify_images
from teds_provision.station.station import Station, initialise
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.profile import load_profile
from teds_provision.vault import passphrase

AIM = 1.4
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


def cost(folder: Path, home: Path, files: int = 60 * ROW) -> FileCost:
    """Return what a file costs, ours without its line; its bare checks are three, though ours makes two."""
    with Station.open(home, ask=lambda p, c: "correct horse battery") as station:
        trust = snapshot_trust(station)

        def judge(row: list[Path]) -> None:
            images = [Image.from_json(read_limited(path, LIMITS.teds_file, "image")) for path in row]
            assert len(verify_images(trust, images)) == len(row)

        made = cost_of_a_file(
            sorted(folder.iterdir())[:files],
            signed=_signed,
            ours=judge,
            libraries=_libraries,
            forget=security.decode.cache_clear,
        )
    return replace(made, checks=made.checks * CHECKS / 2)


def _signed(path: Path) -> list[SignedDigest]:
    """Return the checks of fields 102 and 100."""
    image = Image.from_json(path.read_bytes())
    shown = security.decode(image.blocks[SECURITY])
    assert shown.station_key is not None
    assert shown.signature is not None
    return [
        signed_digest(shown.node_key, node_key_message(image.uuid, shown.node_key), shown.node_key_signature),
        signed_digest(shown.station_key, security.tbs(image.uuid, image.blocks[SECURITY]), shown.signature),
    ]


def _libraries(row: list[Path], signed: list[list[SignedDigest]]) -> None:
    """Read and check a row of images, and look at nothing else."""
    for path in row:
        for block in json.loads(octets_of(path))["blocks"]:
            hashlib.sha256(bytes.fromhex(block["teds"])).digest()
    station = load_key(signed[0][1].point)
    for node, datasheet in signed:
        load_key(node.point).verify(node.der, node.digest, PREHASHED)
        station.verify(datasheet.der, datasheet.digest, PREHASHED)


def main(count: int) -> None:
    """Make, verify three times (the first fills the page cache), and print."""
    compileall.compile_dir(Path(teds_provision.__file__).parent, quiet=2)
    cores = len(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as name:
        folder, home = Path(name, "images"), Path(name, "home")
        fill(folder, home, count)
        runs = [ours(folder, home) for _ in range(3)]
        a_file = cost(folder, home)
    wall, cpu, last = min(runs)
    alone, together = checks_a_second(1), checks_a_second(cores)
    floor = CHECKS * count / together
    print(f"{last}  {wall:.2f} s, {cpu:.2f} s of the processor; load {os.getloadavg()[0]:.1f}")
    print(
        f"openssl: {together:,.0f} checks a second on {cores} cores at once ({alone:,.0f} on one alone);"
        f" {CHECKS} × {count:,} in {floor:.2f} s"
    )
    ratio = wall / floor
    print(f"a file in one process, in turns: {a_file.text}")
    print(f"verify DIR against that: {ratio:.2f} × (processor {cpu / cores / floor:.2f} ×); aim {AIM}: {_met(ratio)}")


def _met(ratio: float) -> str:
    return "met" if ratio <= AIM else "MISSED"


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
