"""Which link a measuring command takes, where more than one is named: what was typed here goes before what is kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import click
import pytest

from teds_provision.cli import options
from teds_provision.cli.config_file import Defaults
from teds_provision.cli.context import App
from teds_provision.cli.measure.sample import over_the_bus
from teds_provision.cli.options import link_options, links_given, readers_for
from teds_provision.errors import TedsProvisionError
from teds_provision.links import LinkSettings
from teds_provision.links.nfc import pcsc_readers, reader
from teds_provision.links.ports import LISTEN_SECONDS
from teds_provision.provisioning import sign
from teds_provision.station.station import Station
from tests.bench import PASSPHRASE
from tests.places import free_bus

from .shell import call

READER, BUS, AIR = "usb", "socketcan:can0", "hci0"


def given(kept: dict[str, Any], *typed: str, read: Callable[[LinkSettings], LinkSettings] = lambda links: links) -> Any:
    """The links of a command with these options in config.toml, and those on its line, as ``read`` there gives them."""
    found: list[LinkSettings] = []

    @click.command()
    @link_options
    def probe(links: LinkSettings) -> None:
        found.append(read(links))

    probe.main(list(typed), default_map=Defaults(kept).get("measure"), standalone_mode=False)
    return found[0]


def taken(kept: dict[str, str], *typed: str, streams: bool) -> str:
    """Return the link of a measuring command."""
    return str(given(kept, *typed, read=lambda links: over_the_bus(links, streams=streams)).via)


def test_a_bus_that_is_named_is_meant() -> None:
    both = {"nfc": READER, "can": BUS}
    for kept, typed, streams, via in (
        ({}, ["--can", BUS], False, "can"),
        ({"can": BUS}, [], False, "can"),
        (both, [], False, "nfc"),
        (both, [], True, "can"),  # a reader carries no streams
        (both, ["--can", BUS], False, "can"),
        ({"nfc": READER}, ["--can", BUS], False, "can"),
        (both, ["--nfc", READER], False, "nfc"),
        (both, ["--via", "nfc"], True, "nfc"),
        (both, ["--via", "can"], False, "can"),
        ({"can": BUS}, ["--nfc", READER], False, "nfc"),
        ({"can": BUS}, ["--ble", AIR], False, "ble"),
        ({"nfc": READER, "ble": AIR}, [], True, "ble"),
        ({}, ["--nfc", READER, "--ble", AIR], False, "ble"),  # the reader for the tap, the air for the rest
    ):
        assert taken(kept, *typed, streams=streams) == via, (kept, typed, streams)


@pytest.mark.parametrize(
    ("kept", "typed", "via", "chosen", "reader_chosen"),
    [
        ({}, [], "nfc", False, False),
        ({}, ["--nfc", READER], "nfc", False, True),
        ({"nfc": READER}, [], "nfc", False, False),  # a reader of this machine: the node may be elsewhere as well
        ({}, ["--can", BUS], "can", True, False),
        ({"nfc": READER}, ["--can", BUS], "can", True, False),
        ({"can": BUS}, [], "nfc", False, False),  # where it is looked for first, but a tap will do
        ({}, ["--can", BUS, "--can", "socketcan:can1"], "can", True, False),
        ({}, ["--ble", AIR], "ble", True, False),
        ({"can": BUS}, ["--ble", AIR], "ble", True, False),
        ({"nfc": READER}, ["--ble", AIR], "nfc", False, False),  # tapped there first
        ({}, ["--nfc", READER, "--ble", AIR], "nfc", False, True),
        ({}, ["--can", BUS, "--ble", AIR], "nfc", False, False),  # two were named
        ({}, ["--can", BUS, "--nfc", READER], "nfc", False, True),
        ({}, ["--via", "nfc"], "nfc", True, False),
        ({}, ["--via", "ble", "--can", BUS], "ble", True, False),
        ({"via": "can"}, [], "can", True, False),
        ({"via": "ble"}, ["--can", BUS], "ble", True, False),
    ],
)
def test_one_link_that_is_typed_is_chosen_and_one_that_is_kept_is_not(
    kept: dict[str, str], typed: list[str], via: str, chosen: bool, reader_chosen: bool
) -> None:
    links = given(kept, *typed)
    assert (links.via, links.via_chosen, links.reader_chosen) == (via, chosen, reader_chosen)
    typed_buses = [word for option, word in pairwise(typed) if option == "--can"]
    buses = typed_buses or [value for name, value in kept.items() if name == "can"]
    assert links.can == (None if not buses else buses[0] if len(buses) == 1 else tuple(buses))
    assert links.nfc == ((READER,) if "nfc" in kept or "--nfc" in typed else None)
    assert links.ble == (AIR if "--ble" in typed else None)


def test_who_names_a_time_has_the_nodes_collected_for_so_long() -> None:
    """`--timeout` in config.toml is patience for a tap: it makes no identify of a bus wait for two minutes."""
    for kept, typed, seconds in (
        ({}, [], (60, LISTEN_SECONDS)),
        ({"timeout": 120}, [], (120, LISTEN_SECONDS)),
        ({"timeout": 120}, ["--timeout", "9"], (9, 9)),
    ):
        links = given(kept, *typed)
        assert (links.timeout, links.listen) == seconds, (kept, typed)


def test_replace_and_import_keys_meet_a_node_if_any_link_is_named() -> None:
    for kept, typed, meets in (
        ({}, [], False),
        ({}, ["--timeout", "9"], False),
        ({}, ["--via", "nfc"], True),
        ({}, ["--nfc", READER], True),
        ({}, ["--can", BUS], True),
        ({}, ["--ble", AIR], True),
        ({"ble": AIR}, [], True),
    ):
        found: list[bool] = []

        def noted(links: LinkSettings, found: list[bool] = found) -> LinkSettings:
            found.append(links_given(click.get_current_context()))
            return links

        given(kept, *typed, read=noted)
        assert found == [meets], (kept, typed)


def test_only_who_reads_tags_borrows_the_readers_of_the_base_station(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, none = tmp_path / "runs", tmp_path / "none"
    for folder in (runs, none):
        folder.mkdir()
    (runs / "ncap.sock").touch()
    asked: list[Path] = []

    class Neighbour:
        """A client that notes what it borrows, and when it gives it back."""

        @contextmanager
        def readers(self) -> Iterator[bool]:
            asked.append(runs)
            yield True
            asked.append(none)

    def connect(home: Path) -> Neighbour:
        assert home == runs
        return Neighbour()

    monkeypatch.setattr(options.client, "connect", connect)  # where it is used: a late module keeps what was used
    for via, home, borrows in (
        ("nfc", runs, 1),
        ("nfc", none, 0),
        ("can", runs, 0),
        ("ble", runs, 0),
        ("nfc", None, 0),
    ):
        monkeypatch.setattr(App, "current", None if home is None else App(home=home))
        with readers_for(via):
            assert len(asked) == borrows, (via, home)
        assert len(asked) == 2 * borrows, (via, home)
        asked.clear()


def test_measure_takes_the_bus_that_is_kept_beside_a_reader(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TEDS_PROVISION_NFC", "udp:127.0.0.1:9")
    monkeypatch.setenv("TEDS_PROVISION_CAN", "socketcan:can7")
    outcome = call(home, "--json", "measure", "8d4d9da65281f7000000", "--timeout", "1")
    assert "Streaming needs CAN" not in outcome.out
    assert outcome.code == 5


def remember(home: Path, uuid: str, **facts: object) -> None:
    station = Station.open(home, ask=lambda _prompt, _confirm: PASSPHRASE)
    try:
        with station.durable("test"):
            station.nodes.remember(bytes.fromhex(uuid), **facts)
    finally:
        station.close()


def test_a_node_without_a_link_is_told_what_to_name(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`sample NODE` spoke of USB readers that nfcpy knows."""
    uuid = "8d4d9da65281f7000000"
    call(home, "whitelist", "add", uuid, "--fingerprint", "ab" * 32)
    remember(home, uuid, can_address=0x21)
    monkeypatch.setattr(reader, "_usb_readers", lambda _path: [])
    monkeypatch.setattr(pcsc_readers, "names_if_any", list)
    for command in ("sample", "mode", "verify", "read"):
        outcome = call(home, "--json", command, uuid)
        assert outcome.code == 5, outcome
        error = outcome.json["error"]
        assert f"No link to node {uuid} is named" in error["message"]
        assert all(word in error["hint"] for word in ("--can", "--ble", "--nfc", "config.toml", "CAN bus", "0x21"))


def test_auto_chooses_from_usb_readers_and_from_those_of_pc_sc_only_without_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """PC/SC names a USB reader once more: both would be two readers, of which auto takes none."""
    monkeypatch.setattr(reader, "paths", lambda: ["pcsc:ACS ACR122U 00 00"])
    for usb, found in (
        ([(0x072F, 0x2200, 1, 5)], ["usb:001:005"]),
        ([(0x072F, 0x2200, 1, 5), (0x04E6, 0x5591, 2, 17)], ["usb:001:005", "usb:002:017"]),
        ([], ["pcsc:ACS ACR122U 00 00"]),
    ):
        monkeypatch.setattr(reader, "_usb_readers", lambda _path, usb=usb: usb)
        assert reader.plugged_in() == found


def test_a_link_that_is_named_means_a_node_and_not_a_folder_of_its_name(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hand").mkdir()
    call(home, "whitelist", "add", "8d4d9da65281f7000000", "--fingerprint", "ab" * 32)
    remember(home, "8d4d9da65281f7000000", name="hand")
    outcome = call(home, "--json", "verify", "hand", "--via", "can", "--can", free_bus(), "--timeout", "0.5")
    assert (
        outcome.code,
        "no-node" in outcome.json["error"]["code"] or "answered" in outcome.json["error"]["message"],
    ) == (
        5,
        True,
    )
    assert call(home, "--json", "verify", "hand").code == 3, "without one it is the folder, which holds no image"


def test_a_trace_without_a_frame_does_not_make_the_repetition_fail(home: Path, tmp_path: Path) -> None:
    for name in ("one.jsonl", "one.pcapng"):
        for _ in range(2):
            outcome = call(home, "--json", "identify", "--nfc", "tty:NONE7:pn532", "--trace", tmp_path / name)
            assert outcome.code == 5, outcome.out
        assert not (tmp_path / name).exists()


@pytest.mark.parametrize(
    ("bus", "code", "words"),
    [
        ("gs_usb:0", 5, "-m pip install 'python-can[gs-usb]'"),
        ("kvaser:0", 5, "CANlib"),
        ("pcan:PCAN_USBBUS1", 5, "PCAN-Basic"),
        ("socketcan:can0?bitrat=250000", 2, "bitrate"),
        ("udp_multicast:239.74.163.2?prot=9", 2, "port"),
        ("slcan:/dev/ttyNONE?speed=9", 2, "tty_baudrate"),
        ("socketcand:can0?hots=127.0.0.1", 2, "host"),
    ],
)
def test_a_bus_that_cannot_be_opened_says_what_to_install_or_which_keys_there_are(
    home: Path, bus: str, code: int, words: str
) -> None:
    outcome = call(home, "--json", "identify", "--via", "can", "--can", bus, "--timeout", "0.5")
    assert (outcome.code, words in outcome.json["error"]["hint"]) == (code, True), outcome.out


def test_several_readers_for_a_command_of_one_are_listed(home: Path) -> None:
    words = ("--nfc", "udp:127.0.0.1:9", "--nfc", "usb:072f")
    outcome = call(home, "--json", "identify", *words)
    assert (outcome.code, "(udp:127.0.0.1:9, usb:072f)" in outcome.json["error"]["message"]) == (2, True), outcome.out


def test_a_clock_that_no_datasheet_can_hold_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """TimeInstance has 32 bits of seconds: until 2106."""
    monkeypatch.setattr(sign.time, "time_ns", lambda: (1 << 32) * 1_000_000_000)
    with pytest.raises(TedsProvisionError, match="clock"):
        sign._now()
    monkeypatch.setattr(sign.time, "time_ns", lambda: ((1 << 32) - 1) * 1_000_000_000)
    assert sign._now() == b"\xff\xff\xff\xff\0\0\0\0"
