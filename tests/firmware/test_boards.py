"""The example boards: the Zephyr port compiled against a stand-in of Zephyr, and run on a bus of this machine."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from teds_provision.links.can.bus import Bus
from teds_provision.links.can.isotp import FUNCTIONAL, Frame, single
from teds_provision.links.can.port import CanPort
from teds_provision.links.can.spec import parse_spec
from teds_provision.protocol.announce import Announce
from teds_provision.protocol.messages.firmware import ABOUT, FirmwareFlag, FirmwareReport
from teds_provision.protocol.messages.frames import IDENTIFY, Function, decode_reply, security_command
from tests.bench import make_station
from tests.e2e.desk import Desk, Running, Station
from tests.firmware import builds
from tests.pace import until

pytestmark = pytest.mark.system
LOAD, GRIPPER = "loadcell_hx711", "gripper_servo"
CALIBRATION = "# date: 2026-10-01\n# method: linear\n4194304,-499\n12582912,499\n"


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stations")
    make_station(folder / "bench", "bench").close()
    return folder


@pytest.fixture
def desk(tmp_path: Path, prepared: Path) -> Iterator[Desk]:
    desk = Desk(tmp_path, prepared)
    yield desk
    desk.clear()


def powered(desk: Desk, name: str, chip: int, **more: str) -> Running:
    """A board on the bus; its identity key lies in the folder where it runs, as PSA's storage."""
    folder = desk.folder / name
    folder.mkdir(exist_ok=True)
    around = os.environ | {"TEDS_FLASH": "flash.bin", "TEDS_CAN": desk.links.can, "TEDS_CHIP": str(chip), **more}
    running = desk.start(program=(str(builds.board(name)),), fork=False, cwd=folder, environment=around)
    assert running.wait_for_lines(1)[0]["ready"]
    return running


def servo(board: Running) -> list[dict[str, Any]]:
    while board.read(0.05):
        pass
    return [line for line in map(json.loads, board.out.splitlines()) if "servo" in line]


def test_a_load_cell_reads_its_bridge_and_knows_itself_after_a_start(desk: Desk) -> None:
    station: Station = desk.station()
    calibration = desk.folder / "load.csv"
    calibration.write_text(CALIBRATION)
    board = powered(desk, LOAD, 1, TEDS_RAW="0x100000")  # 1,048,576 above no load
    over = desk.links.over("can")
    done = station.ask("provision", "--profile", "load-cell", "--calibration", calibration, "--yes", *over)
    assert done["verdict"] == "authentic"
    assert {step["name"]: step["result"] for step in done["steps"]}["check"] == "done", "the hardware bears it"
    (shown,) = station.ask("sample", done["uuid"], *over)["samples"]
    assert shown["raw"] == 0x800000 + 0x100000
    assert shown["value"] == pytest.approx(499 * 0x100000 / 0x400000, abs=1e-3)
    board.process.kill()
    board.end()
    powered(desk, LOAD, 1, TEDS_RAW="0x7fffff")  # an input is torn off
    assert station.ask("verify", done["uuid"], *over)["verdict"] == "authentic"
    assert not station.ask("sample", done["uuid"], *over)["samples"][0]["valid"]


def test_a_reset_pad_that_is_stuck_erases_nothing(desk: Desk) -> None:
    """Or one whose pull-up is described the wrong way round; held for five seconds after it was let go, it resets."""
    station: Station = desk.station()
    board = powered(desk, LOAD, 4, TEDS_RAW="0x100000", TEDS_PAD="1")
    since = time.monotonic()
    over = desk.links.over("can")
    uuid = station.ask("provision", "--profile", "load-cell", "--yes", *over)["uuid"]
    until(lambda: time.monotonic() > since + 6)
    assert station.ask("verify", uuid, *over)["verdict"] == "authentic"
    os.kill(board.process.pid, signal.SIGUSR1)
    time.sleep(0.1)  # that it was let go is seen every 2 ms
    os.kill(board.process.pid, signal.SIGUSR1)
    until(lambda: station.ask("identify", *over)["state"] == "factory")


def test_chips_of_two_lots_from_one_place_of_their_wafers_are_two_nodes(desk: Desk) -> None:
    """Their numbers have twelve octets, a UUID ten."""
    station: Station = desk.station()
    uuids = []
    for chip in (5, 5 + 0x100):
        board = powered(desk, LOAD, chip, TEDS_FLASH=f"{chip}.bin")
        uuids.append(station.ask("identify", *desk.links.over("can"))["uuid"])
        board.process.kill()
        board.end()
    assert uuids[0] != uuids[1]


def test_a_gripper_moves_and_lets_go_when_its_station_is_gone(desk: Desk) -> None:
    station: Station = desk.station()
    board = powered(desk, GRIPPER, 2)
    over = desk.links.over("can")
    calibration = desk.folder / "gripper.toml"
    head = "[[calibration]]\ndate = 2026-11-01\n"
    whole = [
        f'{head}channel = {channel}\nunit = "{unit}"\npoints = [[0, 0], [4095, {most}]]\n'
        for channel, unit, most in ((1, "mm", 110), (2, "mm", 110), (3, "N", 140))
    ]
    calibration.write_text("".join(whole))
    done = station.ask("provision", "--profile", "gripper", "--calibration", calibration, "--yes", *over)
    assert done["verdict"] == "authentic"
    assert servo(board) == [], "a servo has no power before its first set point"
    holds = station.start("--json", "set", done["uuid"], 1, 55, "--unit", "mm", "--dead-man", 200, *over)

    def moves() -> bool:
        holds.read(0.01)
        return any(line["servo"] == "on" for line in servo(board))

    until(moves, lambda: holds.out + holds.err)
    assert servo(board)[-1]["pulse"] == pytest.approx(1_500_000, abs=1000), "half of its stroke"
    holds.process.kill()
    holds.end()
    until(lambda: servo(board)[-1]["servo"] == "off")


def test_a_board_whose_frames_are_not_acknowledged_leaves_the_processor_to_others(desk: Desk) -> None:
    """Its plug is out: the Announce stays with the controller, and a reply that is due waits behind it."""
    board = powered(desk, LOAD, 3, TEDS_CAN_DEAF="1")
    bus = Bus(parse_spec(desk.links.can))
    try:
        time.sleep(0.6)  # the Announce
        bus.send(Frame(FUNCTIONAL | 0xF1, single(b"\x05" + IDENTIFY.encode())))
        time.sleep(0.2)
        before = seconds_of(board.process.pid)
        time.sleep(1.5)
        assert seconds_of(board.process.pid) - before < 0.5
    finally:
        bus.close()


def seconds_of(pid: int) -> float:
    """Of the processor, that a process has had."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def test_the_parts_for_nfc_and_bluetooth_compile() -> None:
    """Against stub headers alone: what they name is not on this machine."""
    builds.need("make", "gcc", headers=("psa/crypto.h",))
    builds.make("boards-radio")


def test_the_sizes_of_kconfig_are_those_that_compile() -> None:
    """Each that a board may need has an option; its ends lie within the bounds of config.h, its default is the same."""
    kconfig = (builds.FIRMWARE / "zephyr" / "Kconfig").read_text()
    cmake = (builds.FIRMWARE / "zephyr" / "CMakeLists.txt").read_text()
    config = (builds.FIRMWARE / "include" / "teds" / "config.h").read_text()
    options = dict(re.findall(r"(TEDS_\w+)=\$\{CONFIG_(TEDS_NODE_\w+)\}", cmake))
    assert {"TEDS_MAX_MESSAGE", "TEDS_STAGING", "TEDS_SESSIONS", "TEDS_CHANNELS", "TEDS_STREAMS"} <= options.keys()
    for name, option in options.items():
        found = re.search(rf"config {option}\n\tint .*\n\trange (\d+) (\d+)\n\tdefault (\d+)\n", kconfig)
        assert found is not None, option
        least, most, usual = found.groups()
        assert f"#define {name} {usual}\n" in config
        for value in (least, most):
            words = [f"-D{name}={value}", *(["-DTEDS_CHANNELS=32"] if name == "TEDS_EVENT_CHANNELS" else [])]
            done = subprocess.run(
                ["gcc", "-std=c99", "-fsyntax-only", *words, f"-I{builds.FIRMWARE}/include", "-xc", "-"],
                input='#include "teds/node.h"\n', capture_output=True, text=True, check=False,
            )  # fmt: skip
            assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", [LOAD, GRIPPER])
def test_what_zephyr_needs_is_beside_each_board(name: str) -> None:
    """West builds it from these; nothing of that can run here."""
    folder = builds.FIRMWARE / "boards" / name
    words = (folder / "CMakeLists.txt").read_text()
    assert f"project({name})" in words
    assert all((folder / source).exists() for source in words.split("PRIVATE ")[1].rstrip(")\n").split())
    kconfig = (builds.FIRMWARE / "zephyr" / "Kconfig").read_text()
    ours = [line.split("=")[0] for line in (folder / "prj.conf").read_text().splitlines() if "TEDS_NODE" in line]
    assert ours
    assert all(f"config {option.removeprefix('CONFIG_')}\n" in kconfig for option in ours)
    assert '#include "../nucleo_g474re_partitions.dtsi"' in (folder / "nucleo_g474re.overlay").read_text()
    overlay = (folder.parent / "nucleo_g474re_partitions.dtsi").read_text()
    labels = ("slot1_partition", "teds_identity", "teds_slot_a", "teds_slot_b")
    assert all(f"{label}: partition@" in overlay for label in labels)
    places = [(int(at, 16), int(octets, 16)) for at, octets in re.findall(r"reg = <(0x\w+) (0x\w+)>;", overlay)]
    ends = [at + octets for at, octets in places]
    assert len(places) == 5, "both images of MCUboot before the node's own"
    assert all(at % 0x800 == 0 and octets % 0x800 == 0 for at, octets in places), "whole pages"
    assert all(end <= begin for end, (begin, _) in zip(ends, places[1:], strict=False)), "none in another's place"
    assert ends[-1] <= 0x7E800, "there the board's storage_partition begins, which holds the identity key"


_GOOD_BUILD = ("CONFIG_MCUMGR_GRP_IMG_TOO_LARGE_SYSBUILD=1", "CONFIG_UPDATEABLE_IMAGE_NUMBER=1", "HAS_WATCHDOG=1")
_REFUSED_OF_MCUMGR = [
    *(f"TRANSPORT_{name}" for name in ("BT", "UART", "UDP", "SHELL", "LORAWAN", "DUMMY")),
    *(f"GRP_{name}" for name in ("FS", "SETTINGS", "STAT", "SHELL", "ZBASIC", "ENUM")),
    "GRP_OS_RESET_BOOT_MODE",
    "GRP_IMG_DIRECT_UPLOAD",
    "GRP_IMG_ALLOW_CONFIRM_NON_ACTIVE_IMAGE_SECONDARY",
    "GRP_IMG_ALLOW_CONFIRM_NON_ACTIVE_IMAGE_ANY",
]


def refusal_of(options: tuple[str, ...]) -> str:
    """Return what the preprocessor refuses of a Zephyr build with updates and these options; "" if it is good."""
    source = (builds.FIRMWARE / "port" / "zephyr" / "firmware.c").read_text()
    _, found, checks = source.partition("/* One way in, which asks who it is. */")
    assert found
    checks = checks.partition("static struct {")[0]
    words = [f"-D{option}" for option in ("DT_ALIAS(x)=0", "DT_NODE_HAS_STATUS(x,y)=HAS_WATCHDOG", *options)]
    done = subprocess.run(["gcc", "-E", *words, "-xc", "-"], input=checks, capture_output=True, text=True, check=False)
    return done.stderr if done.returncode else ""


def test_a_zephyr_build_with_updates_has_one_way_in_one_image_and_a_watchdog() -> None:
    builds.need("gcc")
    assert refusal_of(_GOOD_BUILD) == ""
    assert refusal_of(("CONFIG_MCUMGR_GRP_IMG_TOO_LARGE_BOOTLOADER_INFO=1", *_GOOD_BUILD[1:])) == ""
    for name in _REFUSED_OF_MCUMGR:
        assert "CONFIG_TEDS_MANAGE: " in refusal_of((*_GOOD_BUILD, f"CONFIG_MCUMGR_{name}=1")), name
    for left_out, why in zip(
        _GOOD_BUILD, ("TOO_LARGE_SYSBUILD=y", "one image", "an image on trial needs a watchdog"), strict=True
    ):
        assert why in refusal_of(tuple(option for option in _GOOD_BUILD if option != left_out))
    assert "one image" in refusal_of((_GOOD_BUILD[0], "CONFIG_UPDATEABLE_IMAGE_NUMBER=2", _GOOD_BUILD[2]))


def test_the_example_of_a_build_with_updates_is_one_that_is_taken() -> None:
    """What is on by default is turned off in it by name."""
    builds.need("gcc")
    words = dict(re.findall(r"^(CONFIG_\w+)=(\S+)$", (builds.FIRMWARE / "boards" / "update.conf").read_text(), re.M))
    assert words["CONFIG_MCUMGR_GRP_IMG_ALLOW_CONFIRM_NON_ACTIVE_IMAGE_SECONDARY"] == "n"
    assert (words["CONFIG_BOOTLOADER_MCUBOOT"], words["CONFIG_TEDS_MANAGE"]) == ("y", "y")
    options = [f"{name}={1 if value == 'y' else value}" for name, value in words.items() if value != "n"]
    assert refusal_of((*options, *_GOOD_BUILD[1:])) == ""


def test_kconfig_offers_updates_only_over_a_boot_loader_that_reverts() -> None:
    kconfig = (builds.FIRMWARE / "zephyr" / "Kconfig").read_text()
    option = kconfig.partition("config TEDS_MANAGE\n")[2].partition("\thelp\n")[0].replace("\\\n\t\t", "")
    depends = [line.removeprefix("\tdepends on ") for line in option.splitlines() if line.startswith("\tdepends on ")]
    assert depends == [
        "BOOTLOADER_MCUBOOT",
        "MCUBOOT_BOOTLOADER_MODE_SWAP_USING_MOVE || MCUBOOT_BOOTLOADER_MODE_SWAP_USING_OFFSET || "
        "MCUBOOT_BOOTLOADER_MODE_SWAP_SCRATCH || MCUBOOT_BOOTLOADER_MODE_SWAP_WITHOUT_SCRATCH",
        "ZEPHYR_ZCBOR_MODULE",
    ]
    for selected in ("IMG_ERASE_PROGRESSIVELY", "IMG_ENABLE_IMAGE_CHECK", "WATCHDOG", "REBOOT"):
        assert f"\tselect {selected}\n" in option
    assert "config TEDS_MANAGE_SECURITY_COUNTER\n" in kconfig


def test_kconfig_takes_in_what_psa_is_asked_for() -> None:
    """What a build leaves out is refused at run time alone, and a signature that is none ends every agreement."""
    kconfig = (builds.FIRMWARE / "zephyr" / "Kconfig").read_text()
    psa = (builds.FIRMWARE / "port" / "psa" / "teds_psa.c").read_text()
    asked = set(re.findall(r"PSA_ALG_(DETERMINISTIC_ECDSA|ECDSA|ECDH|CCM|HMAC|SHA_256)\b", psa))
    assert asked == {"DETERMINISTIC_ECDSA", "ECDSA", "ECDH", "CCM", "HMAC", "SHA_256"}
    assert all(f"\tselect PSA_WANT_ALG_{item}\n" in kconfig for item in asked)


def test_zephyr_is_skipped_with_a_line_if_there_is_no_tree() -> None:
    """`make firmware-zephyr` builds against a tree that is given; without one nothing fails."""
    build = str(builds.FIRMWARE / "zephyr" / "build.sh")
    for words, message in (([], "no Zephyr tree. Give one"), ([str(builds.FIRMWARE)], "is no Zephyr tree")):
        done = subprocess.run(["sh", build, *words], capture_output=True, text=True, check=True)
        assert done.stdout.startswith("Skipped: ")
        assert message in done.stdout


def test_native_sim_has_the_nodes_partitions_and_its_can() -> None:
    """Both forms of it, 32 and 64 bits of the host: the same overlay."""
    folder = builds.FIRMWARE / "boards" / LOAD / "boards"
    overlay = (folder / "native_sim.overlay").read_text()
    assert overlay == (folder / "native_sim_native_64.overlay").read_text()
    assert "zephyr,canbus = &can0;" in overlay
    places = [(int(at, 16), int(octets, 16)) for at, octets in re.findall(r"reg = <(0x\w+) (0x\w+)>", overlay)]
    assert [octets >= 4096 + 256 for _, octets in places[1:]] == [True, True]
    assert all(at + octets <= more for (at, octets), (more, _) in pairwise(places))


def test_a_board_reports_what_runs_and_shows_which_one_it_is(desk: Desk) -> None:
    """By its LED and its button: aliases of the devicetree."""
    board = powered(desk, LOAD, 6)
    with closing(Bus(parse_spec(desk.links.can))) as bus:
        address = until(lambda: _pressed(board, bus))
    with closing(CanPort(desk.links.can)) as port:
        link = port.link(address)
        report = FirmwareReport.decode(decode_reply(link.exchange(ABOUT.encode())).payload)
        assert (report.text, report.image) == ("standin/board", None)
        assert report.flags == FirmwareFlag.LOCATE, "without MCUboot there is no update"
        for seconds in (60, 0):
            assert decode_reply(link.exchange(security_command(Function.LOCATE, bytes([seconds])).encode())).ok
    assert board.wait_for_lines(3)[1:] == [{"led": True}, {"led": False}]


def _pressed(board: Running, bus: Bus) -> int | None:
    """Press the button and let it go; the address that announces it, None if a busy machine held it too long."""
    for _ in range(2):
        board.process.send_signal(signal.SIGUSR2)
        time.sleep(0.1)
    while (frame := bus.receive(1.1)) is not None:  # a second press counts after a second
        announce = Announce.decode(frame.identifier, frame.data)
        if announce is not None and announce.pressed:
            return announce.address
    return None
