"""The commands that work on files alone run without what only Linux has (docs/compatibility.md), on real files."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from teds_provision.protocol.keys import SoftwareKey, to_pem
from teds_provision.station.station import Station
from tests.bench import PASSPHRASE, Board
from tests.cli.shell import Outcome, call, clean_environment
from tests.measure.recordings.test_converting import recorded
from tests.plant.proofs import evidence_of
from tests.provisioning.test_provision import run as provision

ROOT = Path(__file__).resolve().parents[2]
PROFILE = ROOT / "profiles" / "magnetic-angular-position-sensor.toml"


def run_elsewhere(home: Path, *lines: Sequence[object]) -> list[Outcome]:
    """Run command lines of a home in a Python that lacks what only Linux has."""
    asked = {"passphrase": PASSPHRASE, "lines": [["--debug", "--home", str(home), *map(str, words)] for words in lines]}
    done = subprocess.run(
        [sys.executable, "-m", "tests.release.elsewhere"],
        input=json.dumps(asked),
        cwd=ROOT,
        env=clean_environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [Outcome(*outcome) for outcome in json.loads(done.stdout)]


def test_the_commands_on_files_run(tmp_path: Path, station: Station, board: Board) -> None:
    evidence, image, recording = tmp_path / "proofs", tmp_path / "image.json", tmp_path / "run.mcap"
    evidence.mkdir()
    document = evidence_of(station, board)
    for number in range(200):  # so many that elsewhere several processes share them
        (evidence / f"{number}.json").write_bytes(document)
    image.write_text(provision(station, board).image.to_json())
    recorded(recording)
    (tmp_path / "ca.pem").write_text(to_pem(station.identity.ca))
    (tmp_path / "lab.pem").write_text(to_pem(SoftwareKey(7).point))
    converted = [tmp_path / f"run.{suffix}" for suffix in ("csv", "jsonl", "txt")]
    lines: list[tuple[object, ...]] = [
        ("show", image),
        ("show", image, "--format", "xml"),
        ("show", PROFILE),
        ("--json", "verify", image),
        ("--json", "evidence", "verify", tmp_path / "proofs", "--ca", tmp_path / "ca.pem"),
        ("record", "info", recording),
        ("record", "show", recording),
        *(("record", "convert", recording, target) for target in converted),
        ("profile", "list"),
        ("profile", "show", PROFILE),
        ("profile", "check", PROFILE),
        ("profile", "new", "my-sensor", "--output", tmp_path / "my-sensor.toml"),
        ("trust", "add", "lab", tmp_path / "lab.pem", "--yes"),
        ("trust", "list"),
        ("trust", "ca", "export", tmp_path / "exported.pem"),
        ("trust", "remove", "lab", "--yes"),
    ]
    done = run_elsewhere(station.home, *lines)
    for words, outcome in zip(lines, done, strict=True):
        assert outcome.code == 0, f"{words}\n{outcome.err}"
    outcomes = {words[1]: outcome for words, outcome in zip(lines, done, strict=True) if words[0] == "--json"}
    assert outcomes["verify"].json["verdict"] == "authentic"
    assert json.loads(outcomes["evidence"].out.splitlines()[0])["good"] is True
    assert all(path.stat().st_size > 100 for path in converted)
    assert "lab" in done[-3].out


HOLDER = """
import sys
from pathlib import Path
from tests.release.elsewhere import hide
hide()
from teds_provision.errors import StoreLockedError
from teds_provision.station.store.lock import StoreLock
try:
    with StoreLock(Path(sys.argv[1]), command="trust add", wait=0):
        print("held", flush=True)
        sys.stdin.read()
except StoreLockedError as error:
    print(error)
"""


def test_two_commands_never_change_a_store_at_once(tmp_path: Path) -> None:
    def start() -> subprocess.Popen[str]:
        command = [sys.executable, "-c", HOLDER, str(tmp_path)]
        return subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    with start() as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "held\n"
        with start() as second:
            output, _ = second.communicate()
        assert output.startswith(f"The store is locked by pid {first.pid} (trust add) since ")
        first.kill()
    with start() as third:
        assert third.communicate()[0] == "held\n", "a killed holder leaves no lock behind"


def test_a_command_at_a_node_says_that_it_needs_linux(tmp_path: Path, station: Station) -> None:
    assert call(station.home, "node", "create", tmp_path / "n").code == 0
    (outcome,) = run_elsewhere(station.home, ("node", "run", tmp_path / "n", "--nfc", "udp:localhost:1"))
    assert outcome.code != 0
    assert "needs Linux" in outcome.err, outcome.err
