"""Places of links: which one an option names, what each link can do, and which bus two processes share."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import UsageError
from teds_provision.links import LinkSettings, discovery, opening
from teds_provision.links.discovery import BroadcastPace
from teds_provision.links.hints import BleAddress, Charging
from teds_provision.links.opening import (
    LINKS,
    capabilities_at,
    open_place,
    open_port,
    open_ports,
    require_known_place,
    shared_bus,
    with_source,
    without_source,
)
from teds_provision.links.ports import Capabilities


@pytest.mark.parametrize(
    ("settings", "places", "buses", "onward", "names_no_link"),
    [
        (LinkSettings(), ("nfc:",), (), None, True),
        (LinkSettings(nfc="usb"), ("nfc:usb",), (), None, False),
        (LinkSettings(nfc=("a", "b")), ("nfc:a", "nfc:b"), (), None, False),
        (LinkSettings(via_chosen=True), ("nfc:",), (), None, False),
        (LinkSettings(nfc="usb", reader_chosen=False), ("nfc:usb",), (), None, True),
        (LinkSettings(can=("a:1", "b:2"), ble="hci0"), ("nfc:",), ("can:a:1", "can:b:2", "ble:hci0"), None, True),
        (LinkSettings("can"), ("can:",), (), None, False),
        (LinkSettings("can", can="a:1"), ("can:a:1",), ("can:a:1",), None, False),
        (LinkSettings(nfc="usb", ble="hci0"), ("nfc:usb",), ("ble:hci0",), "ble:hci0", False),
        (LinkSettings("ble", nfc="usb", ble="hci0"), ("ble:hci0",), ("ble:hci0",), None, False),
    ],
)
def test_what_the_options_of_a_command_name(
    settings: LinkSettings, places: tuple[str, ...], buses: tuple[str, ...], onward: str | None, names_no_link: bool
) -> None:
    assert (settings.places, settings.buses, settings.onward) == (places, buses, onward)
    assert settings.names_no_link is names_no_link
    assert settings.after_agreeing() == (replace(settings, via="ble") if onward else settings)


def test_the_same_settings_at_another_place() -> None:
    settings = LinkSettings(nfc="usb", can="a:1", ble="hci0", timeout=7.0)
    assert settings.at("can:b:2?x=1") == replace(settings, via="can", can="b:2?x=1", via_chosen=True)
    assert settings.at("ble:hci1") == replace(settings, via="ble", ble="hci1", via_chosen=True)
    assert settings.at("nfc:") == replace(settings, nfc=None, via_chosen=True)
    assert replace(settings, via="can").at_places(["can:x:1", "can:y:2"]).can == ("x:1", "y:2")
    assert settings.at_places(["nfc:b", "nfc:c"]).nfc == "b"
    assert (LinkSettings().timeout, LinkSettings().listen, LinkSettings().via) == (60.0, 3.0, "nfc")


def test_what_each_link_can_do() -> None:
    facts = {name: kind.capabilities for name, kind in LINKS.items()}
    assert [facts[name].tapped for name in ("nfc", "can", "ble")] == [True, False, False]
    assert [facts[name].wired for name in ("nfc", "can", "ble")] == [False, True, False]
    assert [facts[name].shared for name in ("nfc", "can", "ble")] == [False, True, False]
    assert capabilities_at("can:socketcan:can0") == facts["can"]
    assert capabilities_at("usb:x") == Capabilities()


def test_a_place_that_cannot_be_meant_is_refused_at_once() -> None:
    with pytest.raises(UsageError, match=r"^The link 'usb' is not part of this version\.$") as refused:
        open_place("usb:x")
    assert refused.value.hint == "Use --via nfc or --via can or --via ble."
    with pytest.raises(UsageError, match=r"^--via can requires --can\.$") as refused:
        open_place("can:")
    assert refused.value.hint == "For example --can socketcan:can0?bitrate=500000."
    require_known_place("nfc:anything")
    require_known_place("usb:anything")
    require_known_place("can:udp_multicast:239.1.2.3?port=4000")
    for wrong in ("can:udp_multicast:239.1.2.3?prot=4000", "can:can0", "ble:hci0?x=1"):
        with pytest.raises(UsageError):
            require_known_place(wrong)


def test_which_bus_a_place_shares_with_other_stations() -> None:
    bus = shared_bus("can:socketcan:can0?source=0xF3&bitrate=250000")
    assert bus is not None
    assert (bus.wire, bus.source, bus.sources) == ("socketcan:can0", 0xF3, (0xF3,))
    assert shared_bus("nfc:usb") is None
    assert shared_bus("ble:hci0") is None
    assert shared_bus("usb:x") is None


@pytest.mark.parametrize(
    ("place", "with_f2", "without"),
    [
        ("can:socketcan:can0", "can:socketcan:can0?source=0xF2", "can:socketcan:can0"),
        ("can:socketcan:can0?fd=1", "can:socketcan:can0?fd=1&source=0xF2", "can:socketcan:can0?fd=1"),
        ("can:a:b?source=0xF7&fd=1", "can:a:b?source=0xF7&fd=1", "can:a:b?fd=1"),
        ("can:a:b?source=0xF7", "can:a:b?source=0xF7", "can:a:b"),
        ("nfc:usb", "nfc:usb", "nfc:usb"),
        ("ble:hci0?address=X", "ble:hci0?address=X", "ble:hci0?address=X"),
    ],
)
def test_a_source_address_in_a_place(place: str, with_f2: str, without: str) -> None:
    assert with_source(place, 0xF2) == with_f2
    assert without_source(place) == without


def test_one_command_works_with_one_link_and_several_are_opened_together_or_not_at_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    opened: list[Any] = []

    def open_it(place: str, trace: object) -> Any:
        if place == "nfc:broken":
            raise UsageError("broken")
        port = SimpleNamespace(place=place, trace=trace, closed=0)
        port.close = lambda: setattr(port, "closed", port.closed + 1)
        opened.append(port)
        return port

    monkeypatch.setattr(opening, "open_place", open_it)
    trace: Any = object()
    assert open_port(LinkSettings(nfc="a", trace=trace)) is opened[0]
    assert (opened[0].place, opened[0].trace) == ("nfc:a", trace)
    for via, kind in (("nfc", "readers"), ("can", "buses")):
        with pytest.raises(UsageError) as refused:
            open_port(replace(LinkSettings(via), **{via: ("a", "b")}))
        assert refused.value.message == f"2 {kind} are named (a, b), but this command works with one."
        assert refused.value.hint == f"Choose one with --{via}; several only work with --watch and measure."
    opened.clear()
    assert open_ports(LinkSettings(nfc=("a", "b"))) == opened
    opened.clear()
    with pytest.raises(UsageError, match="broken"):
        open_ports(LinkSettings(nfc=("a", "b", "broken", "c")))
    assert [(port.place, port.closed) for port in opened] == [("nfc:a", 1), ("nfc:b", 1)]


# -- how often a bus is asked ------------------------------------------------------------------------------------------


class Clock:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = time.monotonic()
        monkeypatch.setattr(discovery, "time", SimpleNamespace(monotonic=lambda: self.now))


def asked_at(clock: Clock, pace: BroadcastPace, seconds: float, **more: Any) -> list[float]:
    began, found = clock.now, []
    while clock.now - began < seconds:
        if pace.is_due(**{"wanted": False, "missing": False, "poll": None, **more}):
            found.append(round(clock.now - began, 2))
            pace.asked = clock.now
        clock.now += 0.25
    return found


def test_a_missing_node_is_asked_for_after_pauses_that_double_to_half_a_minute(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock(monkeypatch)
    pace = BroadcastPace(clock.now, first=0.25)
    assert asked_at(clock, pace, 125, missing=True) == [0.25, 1.25, 3.25, 7.25, 15.25, 31.25, 61.25, 91.25, 121.25]
    assert asked_at(clock, pace, 60) == []
    assert asked_at(clock, pace, 2, missing=True) == [0.0, 1.0], "from the beginning again"
    assert asked_at(clock, pace, 0.5, wanted=True, missing=True) == [0.0, 0.25]
    assert asked_at(clock, pace, 10, missing=True) == [0.0, 1.0, 3.0, 7.0]
    pace = BroadcastPace(clock.now)
    assert asked_at(clock, pace, 4, missing=True) == [1.0, 3.0]
    pace = BroadcastPace(clock.now)
    assert asked_at(clock, pace, 16, poll=5.0) == [5.0, 10.0, 15.0]


# -- hints of a tap ----------------------------------------------------------------------------------------------------


def test_a_charge_report_in_words_and_json() -> None:
    words = ("full", "charging", "wanted", "no", "error")
    texts = ("full", "charging", "charging wanted", "no charging", "charging error")
    for state, text in zip(words, texts, strict=True):
        assert Charging(state).text == text  # type: ignore[arg-type]
        assert Charging(state, 0, -5).text == f"battery 0 %, -5 °C, {text}"  # type: ignore[arg-type]
    raw: dict[str, dict[str, int | str]] = {"WLCCAP": {"mode": "full"}}
    assert Charging("full", 80, 24, 30, raw).to_json() == {
        "state": "full",
        "battery_percent": 80,
        "battery_celsius": 24,
        "text": "battery 80 %, 24 °C, full",
        "raw": raw,
    }
    assert BleAddress(bytes.fromhex("c1d857000101"), random=True).text == "C1:D8:57:00:01:01"
