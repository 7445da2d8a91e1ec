"""Many images at once: each as if it were alone, in order, with totals and the worst one's exit code."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.cli.node import verify as verify_command
from teds_provision.cli.stdout import BROKEN_PIPE
from teds_provision.errors import NotFoundError
from teds_provision.files import json_files
from teds_provision.protocol import datasheet
from teds_provision.protocol.keys import SoftwareKey, node_key_message, station_key_message, to_pem
from teds_provision.provisioning import verify_files as many
from teds_provision.provisioning.verify import snapshot_trust
from teds_provision.provisioning.verify_files import FileVerdict, VerdictTotals
from teds_provision.teds.calibration import Calibration, CalibrationInput
from teds_provision.teds.codec import security
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from tests.bench import make_station
from tests.cli.shell import PROGRAM, ROOT, call, clean_environment, spawn
from tests.pace import PATIENCE

CA, STATION = (SoftwareKey.from_secret(number.to_bytes(32, "big")) for number in (5, 6))
PASSPHRASE = "a passphrase of the tests"


def signed(number: int, calibration: Calibration | None = None, *, ca: SoftwareKey = CA) -> Image:
    """Return a signed datasheet of node ``number``, the station certified by ``ca``."""
    uuid, node = number.to_bytes(10, "big"), SoftwareKey.from_secret((1000 + number).to_bytes(32, "big"))
    profile = load_profile("magnetic-angular-position-sensor")
    blocks = dict(profile.build(uuid, calibration={1: calibration} if calibration else {}).blocks)
    keys = datasheet.SignedNodeKey(uuid, node.point, node.sign(node_key_message(uuid, node.point)))
    teds = datasheet.unsigned_datasheet(
        keys,
        STATION.point,
        ca.sign(station_key_message(STATION.point)),
        datasheet.digests(blocks),
        ca="plant:0",
        last_modified=bytes(8),
        sequence=1,
        key_epoch=1,
    )
    signature = STATION.sign(security.tbs(uuid, teds.encode()))
    return Image(uuid, blocks).with_block((0, 128), teds.with_signature(signature).encode())


@pytest.fixture
def home(tmp_path: Path) -> Path:
    folder = tmp_path / "home"
    assert spawn("--home", folder, "init", "--keystore", "file", passphrase=f"{PASSPHRASE}\n{PASSPHRASE}").code == 0
    (tmp_path / "ca.pem").write_text(to_pem(CA.point))
    words = ("--home", folder, "trust", "add", "--role", "ca", "plant", tmp_path / "ca.pem", "--yes")
    done = spawn(*words, passphrase=PASSPHRASE)
    assert done.code == 0, done.err
    return folder


def write(folder: Path, name: str, image: Image | str) -> Path:
    folder.mkdir(exist_ok=True, parents=True)
    path = folder / name
    path.write_text(image if isinstance(image, str) else image.to_json())
    return path


def lines(out: str) -> list[dict[str, object]]:
    return [json.loads(line) for line in out.splitlines()]


def _of_no_file(line: dict[str, object]) -> dict[str, object]:
    return {name: value for name, value in line.items() if name != "file"}


def test_a_folder_gives_a_line_for_each_image_and_totals(home: Path, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    for number in range(3):
        write(folder / "good", f"{number}.json", signed(number))
    done = call(home, "--json", "verify", folder)
    assert done.code == 0, done.err
    *rows, last = lines(done.out)
    assert [entry["verdict"] for entry in rows] == ["authentic"] * 3
    assert [entry["uuid"] for entry in rows] == [bytes([0] * 9 + [number]).hex() for number in range(3)]
    assert {entry["scope"] for entry in rows} == {"image"}
    assert last == {"totals": {"files": 3, "authentic": 3}}


def test_each_fault_is_reported_in_its_line_and_the_worst_one_ends_the_command(home: Path, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    harmful = Calibration(1, "linear", (CalibrationInput(1, 1, (0.0, 65535.0), (0.0,)),), (0.0, 0.0))
    changed = signed(3)
    faults = {
        "a-good.json": signed(1),
        "b-harmful.json": signed(2, harmful),
        "c-changed.json": Image(bytes(10), changed.blocks),
        "d-broken.json": "{",
        "e-foreign.json": signed(4, ca=SoftwareKey.from_secret(bytes(31) + b"\7")),
        "f-unsigned.json": Image(bytes(10), signed(5).unsigned_blocks()),
    }
    for name, image in faults.items():
        write(folder, name, image)
    done = call(home, "--json", "verify", folder)
    *rows, last = lines(done.out)
    assert [Path(str(entry["file"])).name for entry in rows] == list(faults)
    codes = [entry.get("error", {}).get("code") for entry in rows]  # type: ignore[union-attr, attr-defined]
    assert codes == [None, "refused", "not-authentic", "bad-data", "not-authentic", "not-authentic"]
    assert last["totals"] == {"files": 6, "authentic": 2, "not authentic": 2, "unreadable": 1, "unsigned": 1}
    assert done.code == 4
    assert call(home, "verify", folder / "a-good.json", folder / "b-harmful.json").code == 6
    assert call(home, "verify", folder / "a-good.json", folder / "gone.json").code == 3
    assert call(home, "verify", folder / "a-good.json", folder / "d-broken.json").code == 8


def test_an_image_of_key_agreement_1_is_refused_by_name_alone_and_among_others(home: Path, tmp_path: Path) -> None:
    image = signed(1)
    shown = security.decode(image.blocks[0, 128])
    older = replace(shown, values={**shown.values, 110: 1})
    teds = older.with_signature(STATION.sign(security.tbs(image.uuid, older.encode()))).encode()
    old = write(tmp_path / "images", "old.json", image.with_block((0, 128), teds))
    write(tmp_path / "images", "new.json", signed(2))
    for words in ([old], [old.parent]):
        done = spawn("--home", home, "--json", "verify", *words)
        assert done.code == 8
        assert "KeyAgreement 1; 2 is spoken here" in done.out
    assert spawn("--home", home, "verify", old.parent / "new.json").code == 0


def test_people_see_a_line_each_and_a_sum(home: Path, tmp_path: Path) -> None:
    first, other = (write(tmp_path / "images", f"{number}.json", signed(number)) for number in (1, 2))
    done = call(home, "verify", first, other)
    assert done.code == 0
    assert done.out.splitlines()[-1] == "2 images: 2 authentic."
    assert str(first) in done.out


def test_the_same_verdicts_come_from_one_process_and_from_several(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "images"
    for number in range(6):
        write(folder, f"{number}.json", signed(number) if number % 2 else Image(bytes(10), signed(number).blocks))
    alone = call(home, "--json", "verify", folder).out
    monkeypatch.setattr(many, "_FEW", 1)
    monkeypatch.setattr(many, "_CHUNK", 2)
    together = call(home, "--json", "verify", folder).out
    assert together == alone
    assert call(home, "--json", "verify", folder / "1.json").json["checks"] == lines(alone)[1]["checks"]


def test_a_process_that_is_killed_ends_the_command_with_an_error(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a pool the command waited for ever for what that process had."""
    image, whole, here = signed(1), verify_command._json, os.getpid()
    for number in range(200):
        write(tmp_path / "images", f"{number:03}.json", image)

    def killed(found: FileVerdict) -> str:
        if found.path.name == "100.json" and os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        return whole(found)

    monkeypatch.setattr(verify_command, "_json", killed)
    done = call(home, "--json", "verify", tmp_path / "images")
    assert done.code == 1
    *rows, last = lines(done.out)
    assert 0 < len(rows) <= 100
    assert last["error"]["code"] == "failed"  # type: ignore[index]
    assert "ended by signal 9" in last["error"]["message"]  # type: ignore[index]


def test_output_that_is_closed_ends_the_command_and_every_process_of_it(home: Path, tmp_path: Path) -> None:
    image = signed(1)
    for number in range(200):
        write(tmp_path / "images", f"{number:03}.json", image)
    words = [*PROGRAM, "--home", str(home), "--json", "verify", str(tmp_path / "images")]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=clean_environment(), cwd=ROOT
    ) as program:
        assert program.stdout is not None
        assert program.stderr is not None
        assert b"authentic" in program.stdout.readline()
        program.stdout.close()
        assert program.stderr.read() == b""  # its end is the end of the last process
        assert program.wait(PATIENCE) == BROKEN_PIPE


def test_every_check_of_an_image_is_independent_of_the_others_in_the_batch(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good, unsigned, strange = signed(1), Image(bytes(10), signed(2).unsigned_blocks()), signed(3)
    other_key = strange.with_block((0, 128), signed(4).blocks[0, 128])
    octets = bytearray(signed(5).blocks[0, 128])
    octets[-3] ^= 1  # the checksum no longer fits: not canonical
    kinds = (unsigned, good, other_key, "{", signed(5).with_block((0, 128), bytes(octets)))
    names = [write(tmp_path / "images", f"{number:02}.json", kinds[number % 5]) for number in range(40)]
    alone = [lines(call(home, "--json", "verify", name, tmp_path / "gone").out)[0] for name in names[:5]]
    monkeypatch.setattr(many, "_FEW", 1)
    monkeypatch.setattr(many, "_CHUNK", 8)  # four images after one another, by each of two processes
    together = lines(call(home, "--json", "verify", tmp_path / "images").out)
    for number in range(40):
        assert _of_no_file(together[number]) == _of_no_file(alone[number % 5])


def test_so_many_images_are_held_at_a_time_as_there_is_room_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = signed(1)
    paths = [str(write(tmp_path, f"{number}.json", image if number != 2 else "{")) for number in range(5)]
    size = len(image.to_json())
    for room, held in ((0, [1, 1, 1, 1, 1]), (2 * size, [3, 2]), (9 * size, [5])):
        monkeypatch.setattr(many, "_TOGETHER", room)
        assert [len(some) for some in many._some(paths)] == held


def test_images_that_are_verified_together_are_decoded_once_each(tmp_path: Path) -> None:
    images = [signed(number) for number in range(40)]
    names = [str(write(tmp_path, f"{number}.json", image)) for number, image in enumerate(images)]
    station = make_station(tmp_path / "home")
    work = many._Work(snapshot_trust(station), lambda found: found.path.name, names)
    security.decode.cache_clear()
    verdicts, totals = work.judge(range(40))
    assert (len(verdicts), totals.files) == (40, 40)
    assert security.decode.cache_info().misses == 40
    station.close()


def test_images_without_a_calibration_load_no_guard(home: Path, tmp_path: Path) -> None:
    write(tmp_path / "images", "1.json", signed(1))
    code = (
        "import sys\nfrom teds_provision.__main__ import main\n"
        f"sys.argv = ['teds-provision', '--home', {str(home)!r}, 'verify', {str(tmp_path / 'images')!r}]\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "print(*sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "1 image: 1 authentic." in done.stdout
    assert "teds_provision.provisioning.verify" in done.stderr.split()
    assert not {"teds_provision.teds.guard", "teds_provision.teds.codec.decode"}.intersection(done.stderr.split())


def test_a_folder_without_images_is_reported_and_doubles_count_once(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="no image"):
        json_files([tmp_path], "image")
    image = write(tmp_path, "1.json", signed(1))
    assert json_files([image, tmp_path, image], "image") == [str(image)]


def test_images_of_a_folder_come_by_name_folders_in_their_place_links_to_files_too(tmp_path: Path) -> None:
    names = ("a/z.json", "a-b/y.json", "a.json", "b.json", "b/a/x.json", "b/b.json", "c.json/d.json")
    for name in names:
        path = tmp_path / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    (tmp_path / "images" / "link.json").symlink_to(tmp_path / "images" / "a.json")
    (tmp_path / "images" / "nowhere.json").symlink_to(tmp_path / "gone")
    (tmp_path / "images" / "round").symlink_to(tmp_path / "images")
    (tmp_path / "images" / "notes.txt").touch()
    found = [Path(file).relative_to(tmp_path / "images") for file in json_files([tmp_path / "images"], "image")]
    assert found == sorted(map(Path, (*names, "link.json")))


def test_the_worst_exit_code_wins_whatever_the_order() -> None:
    for codes in ((0, 6, 4), (4, 0, 8), (4,)):
        totals = VerdictTotals()
        for code in codes:
            totals.add(FileVerdict("x", exit_code=code))
        assert totals.exit_code == 4
