"""Where the time of one provisioning goes, exchange by exchange: what of each the wire needs, and the time between.

``python -m benchmarks.timeline ["CAN FD 500k/2M, named by UUID"] [--nodes 15]``: a row of the table of
benchmarks.provisioning. Of each exchange: octets of request and reply, how long they occupy the wire, how long the
exchange took beyond that (turnarounds of both ends, the node's work), and what the station did until the next one.
Medians and least values of so many nodes, in ms.
"""

from __future__ import annotations

import argparse
import secrets
import statistics
import tempfile
from pathlib import Path

from benchmarks.provisioning import LINES, Disk, Line, Run, measure
from teds_provision.station.station import initialise
from teds_provision.vault.passphrase import THROWAWAY


def table(line: Line, runs: list[Run]) -> None:
    """Print it; only runs with as many exchanges as most are looked at."""
    count = statistics.mode(len(run.timed.sizes) for run in runs)
    runs = [run for run in runs if len(run.timed.sizes) == count]
    print(f"{line.title}: {len(runs)} nodes, {count} exchanges")
    print(f"{'':>3}{'octets':>12}{'wire':>9}{'beyond':>9}{'least':>9}{'then':>9}{'least':>9}")
    sums = [0.0] * 5
    for number, sizes in enumerate(runs[0].timed.sizes):
        wire = line.limit.exchanges([sizes]) if line.limit else 0.0
        cells = (wire, *_beyond(runs, number, wire), *_spread([then(run, number) for run in runs]))
        sums = [total + cell for total, cell in zip(sums, cells, strict=True)]
        print(f"{number:>3}{f'{sizes[0]} → {sizes[1]}':>12}" + "".join(f"{cell * 1e3:>9.2f}" for cell in cells))
    print(f"{'':>15}" + "".join(f"{total * 1e3:>9.2f}" for total in sums))


def elapsed(run: Run, number: int) -> float:
    """Return the seconds of an exchange."""
    span = run.timed.spans[number]
    return span.ended - span.began


def then(run: Run, number: int) -> float:
    """Return the seconds from its end to the next one; 0 after the last."""
    spans = run.timed.spans
    return spans[number + 1].began - spans[number].ended if number + 1 < len(spans) else 0.0


def _beyond(runs: list[Run], number: int, wire: float) -> tuple[float, float]:
    return _spread([elapsed(run, number) - wire for run in runs])


def _spread(seconds: list[float]) -> tuple[float, float]:
    return statistics.median(seconds), min(seconds)


def main(words: list[str] | None = None) -> None:
    titles = [line.title for line in LINES]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("title", nargs="?", default="CAN 500 kbit/s, named by UUID", choices=titles)
    parser.add_argument("--nodes", type=int, default=15)
    options = parser.parse_args(words)
    line = next(line for line in LINES if line.title == options.title)
    secret = secrets.token_hex(8)
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder) / "home"
        station, _ = initialise(home, name="bench", keystore="file", ask=lambda p, c: secret, costs=THROWAWAY)
        measure(station, Disk(), line, 2)  # loads libraries and caches once
        table(line, measure(station, Disk(), line, options.nodes))
        station.close()


if __name__ == "__main__":
    main()
