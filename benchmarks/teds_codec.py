"""Speed of the TEDS codec beside a struct-only parse of the same octets, and memory over 10,000 images in a folder.

Run: python benchmarks/teds_codec.py [--images 10000] [--json]

The floor walks the same tuples with ``struct.unpack_from`` into plain dictionaries: no names, no findings, no checksum,
no units, nothing nested but what it must take apart. It is what a parser in pure Python cannot be faster than by much.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import resource
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Mapping
from fractions import Fraction
from pathlib import Path
from statistics import median

from teds_provision import teds
from teds_provision.teds.codec import security
from teds_provision.teds.image import Image

Set = list[bytes]


def example_set(seed: int = 1) -> Set:
    """Return Meta, TransducerChannel, Calibration and Security TEDS of one node."""
    chance = random.Random(seed)
    octets = chance.randbytes
    meta = {"UUID": octets(10), "OholdOff": 0.5, "SHoldOff": 0.1, "TestTime": 5.0, "MaxChan": 1}
    sample = {"DatModel": "unsigned integer", "ModLenth": 2, "SigBits": 14}
    channel = {
        "CalKey": "TIM_CAL_SUPPLIED",
        "ChanType": "sensor",
        "PhyUnits": teds.Units(meters=Fraction(1), kilograms=Fraction(1), seconds=Fraction(-2)),
        "LowLimit": -200.0,
        "HiLimit": 200.0,
        "OError": 0.2,
        "SelfTest": 1,
        "Sample": sample,
        "DataSet": {
            "Repeats": 9,
            "SOrigin": 0.0,
            "StepSize": 0.01,
            "SUnits": teds.Units(seconds=Fraction(1)),
            "PreTrigg": 0,
        },
        "UpdateT": 0.1,
        "RSetupT": 25e-6,
        "SPeriod": 0.1,
        "WarmUpT": 30.0,
        "RDelayT": 25e-6,
        "TestTime": 5.0,
        "Sampling": {"SampMode": 1, "SDefault": 1},
        "DataXmit": 1,
    }
    calibration = {
        "LstCalDt": 1767225600,
        "CalInrvl": 365 * 86400,
        "SIConvrt": {"Slope": 1.0, "Intercept": 0.0},
        "LowLimit": -200.0,
        "HiLimit": 200.0,
        "OError": 0.2,
        "CalInput": {"ChanNum": 1, "ChanKey": 0, "Degree": 1, "Boundaries": [0, 8192, 16383], "Offsets": [0, 8192]},
        "Coefs": [-200.0, 0.02441, 0.0, 0.02443],
        "Method": "table with interpolation",
        "ZeroOffset": 0.0,
    }
    blocks = {(0, 1): teds.compose(1, meta), (1, 3): teds.compose(3, channel), (1, 5): teds.compose(5, calibration)}
    signed = security.SecurityTeds(
        b"\x04" + octets(64),
        octets(64),
        sequence=seed,
        key_epoch=1,
        ca="Works:0123456789abcdef",
        signature=octets(64),
        station_key=b"\x04" + octets(64),
        station_key_signature=octets(64),
        signed_blocks={key: octets(32) for key in blocks},
    )
    return [*blocks.values(), signed.encode()]


_HEAD = struct.Struct(">IBBBBBB")
_TUPLE = struct.Struct(">BB")
_F32, _U16, _U32, _U8 = struct.Struct(">f"), struct.Struct(">H"), struct.Struct(">I"), struct.Struct(">B")
_VALUES: dict[int, dict[int, struct.Struct]] = {
    1: {10: _F32, 11: _F32, 12: _F32, 13: _U16},
    3: {10: _U8, 11: _U8, 13: _F32, 14: _F32, 15: _F32, 16: _U8}
    | dict.fromkeys(range(20, 27), _F32)
    | {32: _U8, 40: _U8, 41: _U8, 42: _U16, 43: _U16, 44: _F32, 45: _F32, 47: _U16, 48: _U8, 49: _U8}
    | dict.fromkeys(range(50, 61), _U8),
    5: {10: struct.Struct(">II"), 11: struct.Struct(">II"), 13: _F32, 14: _F32, 15: _F32, 30: _F32, 31: _F32}
    | {129: struct.Struct(">4f"), 130: _U16, 131: _U8, 132: _U8, 133: struct.Struct(">3f"), 134: struct.Struct(">2f")}
    | {135: _U8, 136: _F32},
    128: dict.fromkeys((1, 2, 3, 4, 105, 109, 110), _U8) | {6: struct.Struct(">II"), 106: _U32, 107: _U32},
}
_NESTED = {3: {12, 18, 19, 31, 46}, 5: {12, 128}}


def struct_only(octets: bytes) -> list[tuple[int, object]]:
    """Parse one TEDS with nothing but ``struct``."""
    access_code = _HEAD.unpack_from(octets)[4]
    return _tuples(octets, 10, len(octets) - 2, _VALUES[access_code], _NESTED.get(access_code, ()))


def _tuples(
    octets: bytes, at: int, end: int, values: dict[int, struct.Struct], nested: Collection[int]
) -> list[tuple[int, object]]:
    out: list[tuple[int, object]] = []
    while at < end:
        kind, size = _TUPLE.unpack_from(octets, at)
        at += 2
        if kind in nested:
            out.append((kind, _tuples(octets, at, at + size, values, nested)))
        elif kind in values:
            out.append((kind, values[kind].unpack_from(octets, at)))
        else:
            out.append((kind, octets[at : at + size]))
        at += size
    return out


def seconds_per_set(work: Callable[[], object], *, rounds: int = 7, repeats: int = 300) -> float:
    """Return the median over rounds of the seconds for one call."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        for _ in range(repeats):
            work()
        times.append((time.perf_counter() - start) / repeats)
    return median(times)


def speed() -> dict[str, float]:
    """Decode, encode and the floor over one set, in the same run."""
    blocks = example_set()
    assert all(teds.decode(block).verdict == "clean" for block in blocks)
    decoded = [teds.decode(block) for block in blocks]
    assert [teds.recompose(teds_read) for teds_read in decoded] == blocks
    octets = sum(map(len, blocks))
    floor = seconds_per_set(lambda: [struct_only(block) for block in blocks])
    decode = seconds_per_set(lambda: [teds.decode(block) for block in blocks])
    encode = seconds_per_set(lambda: [teds.recompose(teds_read) for teds_read in decoded])
    result = {"octets per set": octets, "decode / floor": decode / floor, "encode / floor": encode / floor}
    for name, value in (("floor", floor), ("decode", decode), ("encode", encode)):
        result[f"{name} us per set"] = value * 1e6
        result[f"{name} sets/s"] = 1 / value
        result[f"{name} MB/s"] = octets / value / 1e6
    return result


NAMES = ("Meta-TEDS", "TransducerChannel TEDS", "calibration TEDS", "Security TEDS")
AIMS = (9.0, 12.0)


def each_kind() -> dict[str, str]:
    """Decode against the floor, for each TEDS by itself and for all, in processor time (issue 13 row 11)."""
    sets = [example_set(number) for number in range(60)]

    def best(work: Callable[[bytes], object], place: int) -> float:
        least = math.inf
        for _ in range(12):
            began = time.process_time()
            for set_of_blocks in sets:
                work(set_of_blocks[place])
            least = min(least, time.process_time() - began)
        return least

    taken = [(best(teds.decode, place), best(struct_only, place)) for place in range(len(NAMES))]
    ratios = {name: decode / floor for name, (decode, floor) in zip(NAMES, taken, strict=True)}
    ratios["all"] = sum(decode for decode, _ in taken) / sum(floor for _, floor in taken)
    aims = {NAMES[-1]: AIMS[1], "all": AIMS[0]}
    return {name: f"{ratio:.1f} ×{_verdict(ratio, aims.get(name))}" for name, ratio in ratios.items()}


def _verdict(ratio: float, aim: float | None) -> str:
    return "" if aim is None else f"   aim {aim:g}: {'met' if ratio <= aim else 'MISSED'}"


def images(count: int) -> dict[str, float]:
    """Write ``count`` images to a folder, then read, decode and check each; memory early and at the end, in MiB."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number in range(count):
            write_image(folder, number)
        start, early, total = time.perf_counter(), 0.0, 0
        for number, path in enumerate(sorted(folder.iterdir())):
            image = Image.from_json(path.read_bytes())
            for key in image:
                total += len(image.blocks[key])
                if teds.decode(image.blocks[key]).verdict != "clean":
                    raise SystemExit(f"{path.name} {key} is not clean")
            if number == count // 10:
                early = peak()
        seconds = time.perf_counter() - start
    return {
        "images": count,
        "images/s": count / seconds,
        "MB/s": total / seconds / 1e6,
        "peak MiB at a tenth": early,
        "peak MiB at the end": peak(),
    }


def write_image(folder: Path, number: int) -> None:
    meta, channel, calibration, signed = example_set(number)
    blocks = {(0, 1): meta, (1, 3): channel, (1, 5): calibration, (0, 128): signed}
    (folder / f"{number:06d}.json").write_text(Image(meta[12:22], blocks).to_json())


def peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def import_time(rounds: int = 15) -> dict[str, float]:
    """Return the ms that importing the package costs over bare Python, median of several processes."""
    with tempfile.TemporaryDirectory() as cache:  # compiled once, as installed
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        environment["PYTHONPYCACHEPREFIX"] = cache

        def run(code: str) -> float:
            start = time.perf_counter()
            subprocess.run([sys.executable, "-c", code], check=True, env=environment)
            return (time.perf_counter() - start) * 1e3

        run("import teds_provision.teds")
        pairs = [(run("pass"), run("import teds_provision.teds")) for _ in range(rounds)]
    bare, whole = (median(column) for column in zip(*pairs, strict=True))
    return {"bare Python ms": bare, "import teds_provision.teds ms more": whole - bare}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=10_000)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    report: dict[str, Mapping[str, object]] = {
        "decode / floor": each_kind(),
        "speed": speed(),
        "import": import_time(),
        "folder": images(options.images) if options.images else {},
    }
    if options.json:
        print(json.dumps(report, indent=1))
        return
    for title, figures in report.items():
        print(title)
        for name, figure in figures.items():
            print(f"  {name:36} {figure if isinstance(figure, str) else f'{figure:12.2f}'}")


if __name__ == "__main__":
    main()
