"""What ``show`` and ``profile show`` print of every shipped type and every collected TEDS, kept as it is.

``python -m tests.cli.shown`` writes the files below ``tests/cli/kept_outputs`` again. Before they are committed, read
their difference line by line, against the standard's table or the profile.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from teds_provision.teds.calibration.files import read_calibrations
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile

HERE = Path(__file__).parent / "kept_outputs"
ROOT = Path(__file__).parents[2]
VECTORS = ROOT / "tests" / "vectors" / "ieee1451"
UUID = bytes.fromhex("8d4d9da65281f7000000")
POINTS = {
    "magnetic-angular-position-sensor": ("degree", ((0, 0.0), (32768, 180.5), (65535, 360.0))),
    "load-cell": ("N", ((0, -500.0), (8388608, 0.25), (16777215, 500.0))),
}
"""Calibrations: unit of the value, and pairs of raw number and value."""
TYPES = (
    "accelerometer",
    "gripper",
    "limit-switch",
    "load-cell",
    "magnetic-angular-position-sensor",
    "tactile-finger-sensor",
    "temperature-sensor",
)
ANGLE, UNCALIBRATED = "magnetic-angular-position-sensor", "uncalibrated"
WHOLE = ("gripper", "load-cell", "magnetic-angular-position-sensor", "temperature-sensor")
"""Types whose whole datasheet is kept: an actuator, two calibrations, a sensor of digital values."""
Run = Callable[..., str]
"""Runs a command (words) and returns its stdout."""


def image_of(name: str, *, calibrated: bool = True) -> str:
    """Return the image of a board of a shipped type, as JSON.

    It is calibrated on 2 January 2020, for 90 years, if the type has points.
    """
    kind = load_profile(name)
    calibration = None
    if calibrated and name in POINTS:
        unit, points = POINTS[name]
        rows = "\n".join(f"{raw},{value}" for raw, value in points)
        head = f"# date: 2020-01-02\n# interval: 90 years\nraw,value [{unit}]\n"
        calibration = read_calibrations(f"{head}{rows}\n", "c", kind)
    return Image(UUID, kind.build(UUID, calibration=calibration).blocks).to_json()


def files_in(folder: Path) -> dict[str, Path]:
    """Return the files of :func:`images`."""
    return {name: folder / f"{name}.json" for name in (*TYPES, UNCALIBRATED)}


def images(folder: Path) -> None:
    """Write the image of each type into a folder."""
    for name, file in files_in(folder).items():
        file.write_text(image_of(ANGLE, calibrated=False) if name == UNCALIBRATED else image_of(name))


def cases(run: Run, files: dict[str, Path]) -> dict[str, Callable[[], str]]:
    """Return what is kept, by file name, and how it is made."""

    def pretty(*words: object) -> str:
        return json.dumps(json.loads(run("--json", *words)), indent=1, ensure_ascii=False) + "\n"

    found: dict[str, Callable[[], str]] = {}
    for name in TYPES:
        image = files[name]
        if name in WHOLE:
            found |= {
                f"{name}.txt": lambda image=image: run("show", image),  # type: ignore[misc]
                f"{name}.json": lambda image=image: pretty("show", image),  # type: ignore[misc]
                f"{name}.xml": lambda image=image: run("show", image, "--format", "xml"),  # type: ignore[misc]
            }
        found |= {
            f"{name}.profile.txt": lambda name=name: run("profile", "show", name),  # type: ignore[misc]
            f"{name}.profile.json": lambda name=name: pretty("profile", "show", name),  # type: ignore[misc]
        }
    angle, load = files[ANGLE], files["load-cell"]
    found |= {
        "diff-calibration.txt": lambda: run("show", "--diff", files[UNCALIBRATED], angle),
        "diff-type.txt": lambda: run("show", "--diff", angle, load),
        "diff-type.json": lambda: pretty("show", "--diff", angle, load),
        "edition-2024.txt": lambda: run("show", angle, "--edition", "2024"),
        "edition-2024.json": lambda: pretty("show", load, "--edition", "2024"),
        "template.toml": lambda: run("show", load, "--format", "toml"),
        "collected.txt": lambda: "".join(
            f"== {file.name}\n{run('show', file)}" for file in sorted(VECTORS.glob("*.hex"))
        ),
    }
    return found


def main() -> None:
    """Write all of them again."""
    HERE.mkdir(exist_ok=True)
    with TemporaryDirectory() as folder:
        images(Path(folder))

        def run(*words: object) -> str:
            program = [sys.executable, "-m", "teds_provision", "--home", f"{folder}/home", *map(str, words)]
            return subprocess.run(program, stdout=subprocess.PIPE, text=True, check=False).stdout

        for name, make in cases(run, files_in(Path(folder))).items():
            (HERE / name).write_text(kept(make(), Path(folder)))


def kept(text: str, folder: Path) -> str:
    """Return an output without the names of folders that differ from run to run."""
    return text.replace(str(folder), "FOLDER").replace(str(VECTORS), "VECTORS").replace(str(ROOT), "ROOT")


if __name__ == "__main__":
    main()
