"""``record convert`` at three sizes, each way held against the libraries' own copies of the two formats.

Run: python -m benchmarks.recordings [--samples 10000000]

The recording: one node of 25 channels at 1 kHz, 16-bit values that look like a sensor's. A copy by the library of a
format is what a user would write without this command: mcap's reader into mcap's writer, pandas' ``read_csv`` into
``to_csv``, ``json.loads`` into ``json.dumps`` line by line. It prints nothing of the file's content; ``convert``
decodes all of it, checks it, and writes the other format, so it is held against the slower copy of the two (Parquet has
none here: pyarrow copies columns that it need not read). Each in a separate process; CPU seconds of it, imports
included, and its largest memory.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from subprocess import DEVNULL, Popen

import numpy as np

from teds_provision.measure.blocks import Block, ChannelFacts, StationFacts
from teds_provision.measure.sinks import FILES
from teds_provision.measure.sinks.files import FileSink

CHANNELS, RATE, TOGETHER, AIM = 25, 1000, 20, 2.0
UUID = "8d4d9da65281f7000001"

COPIES = {
    ".mcap": """
import sys
from mcap.reader import make_reader
from mcap.writer import Writer
with open(sys.argv[1], "rb") as one, open(sys.argv[2], "wb") as other:
    writer, schemas, channels = Writer(other), {}, {}
    writer.start()
    for schema, channel, message in make_reader(one).iter_messages(log_time_order=False):
        if channel.id not in channels:
            number = schemas.setdefault(schema.id, writer.register_schema(schema.name, schema.encoding, schema.data))
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, number, channel.metadata)
        writer.add_message(
            channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence)
    writer.finish()
""",
    ".csv": """
import sys
import pandas
pandas.read_csv(sys.argv[1], comment="#").to_csv(sys.argv[2], index=False)
""",
    ".jsonl": """
import json, sys
with open(sys.argv[1]) as one, open(sys.argv[2], "w") as other:
    for line in one:
        other.write(json.dumps(json.loads(line), separators=(",", ":")) + "\\n")
""",
}
CONVERT = """
import sys
from teds_provision.__main__ import main
sys.argv = ["teds-provision", "--quiet", "record", "convert", *sys.argv[1:]]
main()
"""


def recording(path: Path, samples: int) -> None:
    """Make the recording that is converted, as its recorder makes it: blocks of 20 ms."""
    facts = tuple(
        ChannelFacts(UUID, "hand", n, f"ch {n}", unit="N", sample_form="uint16", period=1 / RATE)
        for n in range(1, CHANNELS + 1)
    )
    sink = FILES[path.suffix](path)
    assert isinstance(sink, FileSink)
    rows = samples // CHANNELS
    walk = np.random.default_rng(1).integers(-3, 4, (4096, CHANNELS)).cumsum(axis=0) + 30_000

    def blocks() -> object:
        for k in range(0, rows, TOGETHER):
            n = min(TOGETHER, rows - k)
            index = np.arange(k, k + n)
            raw = walk[index % 4096].astype(np.uint64)
            valid = np.ones(raw.shape, dtype=bool)
            ticks = (index * 1_000_000).astype(np.uint64)
            yield Block(
                UUID, 0, tuple(range(1, CHANNELS + 1)), k, 1.8e9 + index / RATE, ticks, raw, raw * 0.001, valid, 0, 1e-4
            )

    sink.copy(blocks(), facts, StationFacts("bench", group="hand"))  # type: ignore[arg-type]


def run(code: str, *words: object) -> tuple[float, float, float]:
    """Return wall seconds, CPU seconds and MB of a program."""
    began = time.monotonic()
    process = Popen([sys.executable, "-c", code, *map(str, words)], stdout=DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    return time.monotonic() - began, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--tries", type=int, default=1)
    arguments = parser.parse_args()
    sizes = [arguments.samples // 100, arguments.samples // 10, arguments.samples]
    for samples in sizes:
        with tempfile.TemporaryDirectory() as place:
            _size(Path(place), samples, arguments.tries)


def _size(folder: Path, samples: int, tries: int) -> None:
    copies = {}
    for begin, code in COPIES.items():
        recording(folder / f"run{begin}", samples)
        copies[begin] = min((run(code, folder / f"run{begin}", folder / "copy") for _ in range(tries)), key=_cpu)
        octets = (folder / f"run{begin}").stat().st_size / samples
        print(f"{samples:>10,} {begin[1:]:6s} {octets:5.1f} octets a sample; copy {_told(copies[begin])}", flush=True)
        (folder / "copy").unlink()
    for begin in COPIES:
        for end in (".mcap", ".csv", ".jsonl", ".parquet"):
            ways = []
            for _ in range(tries):
                (folder / f"to{end}").unlink(missing_ok=True)
                ways.append(run(CONVERT, folder / f"run{begin}", folder / f"to{end}"))
            best = min(ways, key=_cpu)
            ratio = best[1] / max(copies[name][1] for name in (begin, end) if name in copies)
            met = "met" if ratio <= AIM else "MISSED"
            way = f"{begin[1:]} to {end[1:]}"
            print(f"{samples:>10,} {way:17s} {_told(best)} {ratio:6.2f} ×   aim ≤ {AIM:g}: {met}", flush=True)
            (folder / f"to{end}").unlink()


def _cpu(run_of: tuple[float, float, float]) -> float:
    return run_of[1]


def _told(run_of: tuple[float, float, float]) -> str:
    return f"{run_of[1]:7.2f} s CPU, {run_of[2]:5.0f} MB"


if __name__ == "__main__":
    main()
