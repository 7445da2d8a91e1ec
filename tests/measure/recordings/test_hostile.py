"""Recordings from anybody: refused with words, in little time and memory, whatever is in them."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from teds_provision.errors import BadDataError, TedsProvisionError
from teds_provision.measure.recordings import source
from teds_provision.measure.recordings.converting import convert
from teds_provision.measure.recordings.opening import open_recording
from teds_provision.measure.sinks.mcap.writer import CHUNK, CHUNK_HEAD, HEADER, MAGIC, record, text
from teds_provision.measure.sinks.mcap.zstandard_frames import zstd
from tests.measure.recordings.test_converting import FORMATS, convert_to, recorded


def read(path: Path) -> int:
    return sum(1 for _ in open_recording(path).entries())


def refused(path: Path, *words: str) -> None:
    with pytest.raises(BadDataError) as caught:
        read(path)
    for word in words:
        assert word in caught.value.message


@pytest.mark.parametrize(
    ("octets", "words"),
    [
        (b"", ["is empty"]),
        (b"\x7fELF" + bytes(100), ["not a recording"]),
        (b"PAR1" + bytes(100) + b"PAR1", ["Parquet"]),
        (b'{"event":"data","uuid":"1","channel":1,"index":0,"time":[1],"raw":[1,2],"value":[1],"valid":[true]}\n', []),
        (b'{"event":' + b"[" * 100_000 + b"\n", [":1:", "not JSON"]),
        (b'{"event":"data"' + b" " * (9 << 20), [":1:", "octets"]),
        (b'{"event":"channel","uuid":5}\n', ["uuid"]),
        (b'{"event":"channel","uuid":"1","number":1e9}\n', ["channel number"]),
        (b'{"event":"channel","uuid":"1","number":1,"low":NaN}\n', ["not finite"]),
        (b'{"event":"channel","uuid":"1","number":1,"low":1' + 400 * b"0" + b"}\n", ["low of a channel is 1000"]),
        (b'{"event":"channel","uuid":"1","number":1,"calibration":{"method":"x"}}\n', [":1:", "calibration of"]),
        (b"# teds-provision measurement, text 1\ntime,uuid,index\n", ["columns"]),
        (b"# teds-provision measurement, text 1\n# channel: [1]\n", ["JSON object"]),
        (b"# teds-provision measurement, text 1\ntime,uuid,index,clock_error,note\n1,2,3,4,5,6\n", [":3:", "6 cells"]),
        (b"# teds-provision measurement, text 1\ntime,uuid,index,clock_error,note\n1,2,x,4,5\n", ["no number"]),
        (b"# teds-provision measurement, text 1\ntime,uuid,index,clock_error,note\n1,2,9999999999999999999,4,5\n",
         [":3:", "too large"]),
        (b"# teds-provision measurement, text 1\n\xff\xfe\n", [":2:", "UTF-8"]),
        (b"# teds-provision measurement, text 1\n" + b"1" * (9 << 20), [":2:", "more than 8388608 octets"]),
    ],
)  # fmt: skip
def test_what_is_no_recording_is_refused_with_its_place(tmp_path: Path, octets: bytes, words: list[str]) -> None:
    path = tmp_path / "run"
    path.write_bytes(octets)
    refused(path, str(path), *words)


@pytest.mark.parametrize(
    ("line", "member", "value"),
    [
        ('{"event":"note","time":%s,"why":"x"}', "at", 0.0),
        ('{"event":"status","uuid":"ab","state":"lost","time":%s}', "time", 0.0),
        ('{"event":"status","uuid":"ab","state":"lost","clock_error":%s,"time":1}', "clock_error", None),
    ],
)
def test_a_whole_number_that_no_float_can_hold_is_none(tmp_path: Path, line: str, member: str, value: object) -> None:
    """Python reads integers of thousands of digits, and refuses to make them a float with an error of its own."""
    path = tmp_path / "run.jsonl"
    for number in ("1" + 400 * "0", "true", '"1"'):
        path.write_text('{"event":"recording","station":"x"}\n' + line % number + "\n")
        [entry] = filter(None, open_recording(path).entries())
        assert getattr(entry, member) == value
    path.write_text('{"event":"recording","station":"x"}\n' + line % "2" + "\n")
    [entry] = filter(None, open_recording(path).entries())
    assert getattr(entry, member) == 2.0


def test_channels_of_a_recording_are_counted_once_each_and_only_so_many_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source, "MOST", replace(source.MOST, channels=2))
    path = tmp_path / "run.jsonl"
    lines = [f'{{"event":"channel","uuid":"ab","number":{number}}}' for number in (1, 2, 1, 2)]
    path.write_text("\n".join(['{"event":"recording","station":"x"}', *lines, ""]))
    assert set(open_recording(path).facts) == {("ab", 1), ("ab", 2)}
    with path.open("a") as file:
        file.write(lines[0].replace("1", "3") + "\n")
    with pytest.raises(BadDataError, match="names more than 2 channels"):
        list(open_recording(path).entries())


def test_a_chunk_that_unpacks_to_gigabytes_is_refused_unopened(tmp_path: Path) -> None:
    bomb = zstd.compress(bytes(1 << 28), 19)
    head = MAGIC + record(HEADER, text("ros2") + text(""))
    for claimed in (1 << 28, 100):  # honest, and a lie
        body = CHUNK_HEAD.pack(0, 0, claimed, 0) + text("zstd") + struct.pack("<Q", len(bomb)) + bomb
        path = tmp_path / f"{claimed}.mcap"
        path.write_bytes(head + record(CHUNK, body) + record(CHUNK, body))
        code = (
            "import resource, sys\n"
            "from pathlib import Path\n"
            "from teds_provision.errors import BadDataError\n"
            "from teds_provision.measure.recordings.opening import open_recording\n"
            "resource.setrlimit(resource.RLIMIT_DATA, (400 << 20, 400 << 20))\n"
            "try:\n"
            "    list(open_recording(Path(sys.argv[1])).entries())\n"
            "except BadDataError as error:\n"
            "    print(error.message)\n"
        )
        done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=False)
        assert "damaged" in done.stdout, done.stderr


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"time": [-1, 2]}, "has a time that is not in the years 1970 to 2540."),
        ({"time": [1, None]}, "has a time that is not in the years 1970 to 2540."),
        ({"time": [1, 1.9e10]}, "has a time that is not in the years 1970 to 2540."),
        ({"time": [1, float("inf")]}, "has a time that is not in the years 1970 to 2540."),
        ({"index": -1}, "has a sample number that is negative or too large."),
        ({"index": 2**63 - 2}, "has a sample number that is negative or too large."),
        ({"clock_error": float("inf")}, "has a clock error that is not finite."),
    ],
)
def test_numbers_that_no_recorder_writes_are_refused_in_every_format_that_they_could_go_to(
    tmp_path: Path, change: dict[str, object], why: str
) -> None:
    """Python's own errors came of them when they were converted."""
    words = {"event": "data", "uuid": "ab", "channel": 1, "index": 0, "time": [1, 2], "raw": [1, 2], "value": [1, 2]}
    path = tmp_path / "run.jsonl"
    for changes in (change, {"index": 2**63 - 3}, {"time": [0, 1.7e10]}, {"clock_error": 0.0}):
        path.write_text('{"event":"note","why":"x"}\n' + json.dumps(words | changes) + "\n")
        if changes is change:
            refused(path, f"{path}: node ab {why}")
        else:
            read(path)
    if "time" in change:
        cells = ["" if time is None else str(time) for time in change["time"]]  # type: ignore[attr-defined]
        wide = tmp_path / "run.csv"
        wide.write_text("# teds-provision measurement, text 1, wide; times\ntime\n" + "\n".join([*cells, ""]))
        refused(wide, f"{wide}: group all {why}")


@pytest.mark.parametrize("suffix", FORMATS)
@given(data=st.data())
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_whatever_octets_are_changed_ends_in_values_or_words(tmp_path: Path, suffix: str, data: st.DataObject) -> None:
    whole = tmp_path / f"run{suffix}"
    if not whole.exists():
        convert_to(tmp_path, suffix, whole)
    octets = bytearray(whole.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(octets) - 1))
        octets[at : at + data.draw(st.sampled_from([0, 1, 8]))] = data.draw(st.binary(max_size=9))
    broken = tmp_path / f"broken{suffix}"
    broken.write_bytes(octets)
    try:
        read(broken)
    except TedsProvisionError as refusal:
        message = refusal.message
    else:
        return
    assert str(broken) in message


@pytest.mark.parametrize("suffix", [".csv", ".jsonl", ".mcap"])
def test_a_file_cut_anywhere_gives_all_that_is_whole(tmp_path: Path, suffix: str) -> None:
    whole = recorded(tmp_path / f"run{suffix}")
    octets, before = whole.read_bytes(), -1
    for at in np.linspace(len(octets) // 3, len(octets), 40).astype(int).tolist():
        cut = tmp_path / "cut"
        cut.write_bytes(octets[:at])
        recording = open_recording(cut)
        rows = sum(len(entry.time) for entry in recording.entries() if hasattr(entry, "value"))
        assert rows >= before, "more octets hold no less"
        before = rows
    assert before == 80


def test_a_damaged_mcap_is_refused_with_the_command_that_saves_the_rest(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap")
    octets = bytearray(path.read_bytes())
    octets[octets.find(b"zstd") + 200] ^= 0xFF
    path.write_bytes(octets)
    with pytest.raises(BadDataError, match="chunk at octet") as caught:
        convert(path, tmp_path / "run.csv")
    assert "measure recover" in caught.value.hint
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"], "nothing half done is left"
