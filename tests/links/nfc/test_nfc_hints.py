"""Charging and Bluetooth records in an initial message: what is read, and that nothing foreign is an error."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.links.hints import BleAddress, Charging
from teds_provision.links.nfc import hints, message
from teds_provision.links.nfc.message import WELL_KNOWN, NdefRecord

from .conftest import StartNode

SOLD_TAG = bytes.fromhex("910606574C434341502001091E030A510703574C4353544149056401")
"""The message of a product's tag, seen in public: WLCCAP and WLCSTAI."""


def well_known(name: str, octets: str) -> NdefRecord:
    return NdefRecord(WELL_KNOWN, name.encode(), bytes.fromhex(octets))


def test_the_records_of_a_sold_tag() -> None:
    found = hints.charging(message.decode(SOLD_TAG))
    assert found is not None
    assert (found.state, found.battery_percent, found.text) == ("wanted", 100, "battery 100 %, charging wanted")
    assert found.raw["WLCCAP"] == {
        "version": "2.0",
        "mode": "static",
        "retries": 0,
        "negotiation_wait": 0,
        "read_confirmation": 1,
        "wait_ms": 4096,
        "read_wait_ms": 300,
        "write_timeout_ms": 256,
        "write_wait_ms": 10,
    }
    assert found.raw["WLCSTAI"] == {"battery_percent": 100, "received_voltage": 1}


@pytest.mark.parametrize(
    ("records", "state", "percent", "celsius"),
    [
        ([("WLCCAP", "2081091E030A")], "full", None, None),
        ([("WLCCAP", "2001091E030A"), ("WLCSTAI", "0350 64")], "charging", 80, None),
        ([("WLCSTAI", "3F50002A0CFB1E")], "no", 80, -5),
        ([("WLCCTL", "0A4C004B0003")], "wanted", 75, None),
        ([("WLCCTL", "0A0C004B0003")], "no", 75, None),
        ([("WLCCTL", "8A0000FF0001")], "error", None, None),
        ([("WLCSTAI", "01FF")], "no", None, None),  # 255 %
        ([("WLCCAP", "2081091E030A"), ("WLCCTL", "8A0000FF0001")], "error", None, None),
        ([("WLCCAP", "2001091E030A"), ("WLCCTL", "0A0C004B0003")], "no", 75, None),
    ],
)
def test_states(records: list[tuple[str, str]], state: str, percent: int | None, celsius: int | None) -> None:
    found = hints.charging([well_known(name, octets) for name, octets in records])
    assert found is not None
    assert (found.state, found.battery_percent, found.battery_celsius) == (state, percent, celsius)


@pytest.mark.parametrize(
    ("octets", "fields"),
    [
        ("0F7F FF 4B C0 10", {"counter": 7, "error": 0, "power_wanted": 1, "information_wanted": 1, "power_step": -1,
                              "driver": 3, "battery_percent": 75, "hold_off_ms": 30}),
        ("08 00 01 64 3F 03", {"counter": 0, "error": 0, "power_wanted": 0, "information_wanted": 0, "power_step": 1,
                               "driver": 0, "battery_percent": 100, "hold_off_ms": 6}),
        ("91 80 7F 65 00 02", {"counter": 1, "error": 1, "power_wanted": 0, "information_wanted": 0, "power_step": 127,
                               "driver": 0, "protocol_error": 1, "temperature_error": 0}),
        ("8E 40 80 00 40 01", {"counter": 6, "error": 1, "power_wanted": 1, "information_wanted": 0,
                               "power_step": -128, "driver": 1, "battery_percent": 0, "protocol_error": 0,
                               "temperature_error": 1}),
    ],
)  # fmt: skip
def test_the_fields_of_a_control_record(octets: str, fields: dict[str, int]) -> None:
    found = hints.control(bytes.fromhex(octets))
    assert {name: value for name, value in found.items() if name != "duration_ms"} == fields
    assert hints.control(bytes.fromhex(octets)[:5]) == {}


@pytest.mark.parametrize(
    ("found", "text"),
    [
        (Charging("wanted", 80, 24), "battery 80 %, 24 °C, charging wanted"),
        (Charging("full", 0, 0, 31), "battery 0 %, 0 °C, full"),
        (Charging("no", None, -5), "-5 °C, no charging"),
        (Charging("charging", 100), "battery 100 %, charging"),
        (Charging("error", node_celsius=31), "charging error"),
    ],
)
def test_the_line_for_people_has_what_is_known_of_the_battery(found: Charging, text: str) -> None:
    assert found.text == text
    assert found.to_json() == {
        "state": found.state,
        "battery_percent": found.battery_percent,
        "battery_celsius": found.battery_celsius,
        "text": text,
        "raw": {},
    }


@pytest.mark.parametrize(
    ("tnf", "octets", "name"),
    [
        (1, b"U", "urn:nfc:wkt:U"),
        (2, b"text/plain", "text/plain"),
        (4, b"a b~", "urn:nfc:ext:a b~"),
        (1, b"\x00\x1f\x7f\x80\xff", "urn:nfc:wkt:\\x00\\x1f\\x7f\\x80\\xff"),
    ],
)
def test_of_the_name_of_a_record_all_but_printable_ascii_is_escaped(tnf: int, octets: bytes, name: str) -> None:
    assert NdefRecord(tnf, octets).name == name


def test_a_bluetooth_address_is_little_endian_in_its_record() -> None:
    octets = bytes.fromhex("081B01010057D8C101021C00")
    record = NdefRecord(2, b"application/vnd.Bluetooth.le.oob", octets)
    assert hints.ble_address([record]) == BleAddress(bytes.fromhex("C1D857000101"), random=True)
    assert hints.ble_address([NdefRecord(2, hints.OUT_OF_BAND, b"\x02\x1c\x00" + octets[:9])]) is not None
    assert hints.ble_address([NdefRecord(2, hints.OUT_OF_BAND, octets[:8])]) is None
    assert BleAddress(bytes.fromhex("C1D857000101"), random=True).text == "C1:D8:57:00:01:01"


@given(st.sampled_from(["WLCCAP", "WLCSTAI", "WLCCTL"]), st.binary(max_size=12))
def test_no_octets_are_an_error(name: str, octets: bytes) -> None:
    found = hints.charging([NdefRecord(WELL_KNOWN, name.encode(), octets)])
    assert isinstance(found, Charging)
    assert found.battery_percent is None or 0 <= found.battery_percent <= 100
    assert found.text


@given(st.binary(max_size=40))
def test_no_structures_are_an_error(octets: bytes) -> None:
    found = hints.ble_address([NdefRecord(2, hints.OUT_OF_BAND, octets)])
    assert found is None or len(found.octets) == 6


@pytest.mark.link
def test_a_contact_carries_what_its_initial_message_says(start_node: StartNode, path: str) -> None:
    from teds_provision.links import LinkSettings, open_port
    from teds_provision.links.nfc import tnep
    from teds_provision.protocol.messages.identity import Identity, NodeState

    identify = Identity(bytes(10), NodeState.FACTORY, 0, 0, 2048, 1).encode()
    initial = [
        *message.decode(SOLD_TAG),
        tnep.ServiceParameters(tnep.SERVICE, 4, 15, 2000).record(),
        tnep.id_record(identify),
        NdefRecord(2, hints.OUT_OF_BAND, bytes.fromhex("081B01010057D8C101021C00")),
    ]
    start_node(initial=message.encode(initial).hex())
    port = open_port(LinkSettings(nfc=path))
    contact = port.find(lambda identity: True, seconds=60, notice=lambda notice: None)
    assert contact.charging is not None
    assert contact.charging.battery_percent == 100
    assert contact.ble is not None
    assert contact.ble.text == "C1:D8:57:00:01:01"
    port.close()
