"""The option --ble, and what errors of bleak and BlueZ mean for a person."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest
from dbus_fast import BusType, Message, MessageType
from dbus_fast.errors import DBusError

from teds_provision.errors import NodeSilentError, NoReaderError, UsageError
from teds_provision.links.ble import ble_errors, bluez
from teds_provision.links.ble.spec import BleSpec, parse_spec


@pytest.mark.parametrize(
    ("text", "adapter", "address"),
    [
        ("", None, None),
        ("auto", None, None),
        ("hci0", "hci0", None),
        ("?address=c1-d8-57-00-01-01", None, "C1:D8:57:00:01:01"),
        ("hci1?address=C1:D8:57:00:01:01", "hci1", "C1:D8:57:00:01:01"),
    ],
)
def test_the_option_names_an_adapter_and_perhaps_a_node(text: str, adapter: str | None, address: str | None) -> None:
    spec = parse_spec(text)
    assert spec == BleSpec(adapter, address)
    assert spec.text == (adapter or "the Bluetooth adapter")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hci0?x=1", "--ble knows no option 'x'."),
        ("hci0?address=C1:D8", "'C1:D8' is not a Bluetooth address."),
        ("hci0?address=", "'' is not a Bluetooth address."),
        ("hci 0", "'hci 0' is not a Bluetooth adapter name."),
        ("x" * 33, f"'{'x' * 33}' is not a Bluetooth adapter name."),
    ],
)
def test_a_wrong_option_is_named(text: str, message: str) -> None:
    with pytest.raises(UsageError) as refused:
        parse_spec(text)
    assert refused.value.message == message
    assert refused.value.hint == "Use --ble auto, --ble hci0 or --ble 'hci0?address=C1:D8:57:00:01:01'."


class BlueZError(Exception):
    def __init__(self, text: str = "", *, name: str = "", reason: str = "") -> None:
        super().__init__(text)
        self.dbus_error = name
        self.reason = SimpleNamespace(name=reason)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (FileNotFoundError(), "There is no D-Bus system bus, so Bluetooth is unavailable."),
        (ConnectionRefusedError(), "There is no D-Bus system bus, so Bluetooth is unavailable."),
        (PermissionError(), "There is no D-Bus system bus, so Bluetooth is unavailable."),
        (
            BlueZError(name="org.freedesktop.DBus.Error.ServiceUnknown"),
            "The Bluetooth service (bluetoothd) is not running.",
        ),
        (
            BlueZError(name="org.freedesktop.DBus.Error.NameHasNoOwner"),
            "The Bluetooth service (bluetoothd) is not running.",
        ),
        (BlueZError(reason="POWERED_OFF"), "Bluetooth is switched off on hci0."),
        (BlueZError("br-connection-adapter-not-powered"), "Bluetooth is switched off on hci0."),
        (BlueZError(reason="NO_BLE_CENTRAL_ROLE"), "The LE central role is not supported by hci0."),
        (BlueZError(reason="NO_BLUETOOTH"), "There is no Bluetooth adapter."),
        (BlueZError("adapter 'hci7' not found"), "There is no Bluetooth adapter hci0."),
        (BlueZError("org.bluez.AccessDenied"), "This user may not use Bluetooth."),
    ],
)
def test_why_bluetooth_cannot_be_used(error: Exception, message: str) -> None:
    found = ble_errors.adapter_trouble(error, "hci0")
    assert isinstance(found, NoReaderError)
    assert found.message == message
    assert found.hint


def test_what_is_the_air_and_no_trouble_of_the_machine() -> None:
    busy = ("org.bluez.Error.InProgress", "org.bluez.Error.NotReady")
    gone = ("org.freedesktop.DBus.Error.UnknownObject", "org.freedesktop.DBus.Error.UnknownMethod")
    for name in (*busy, *gone, "org.bluez.Error.Failed"):
        error = BlueZError("le-connection-abort-by-local", name=name)
        assert ble_errors.adapter_trouble(error, "hci0") is None
        assert ble_errors.is_busy(error) is (name in busy)
        assert ble_errors.is_gone(error) is (name in gone)
    assert ble_errors.is_gone(Exception("Device C1 was not found."))


@pytest.mark.parametrize(
    ("text", "held", "full"),
    [
        ("le-connection-concurrent-connection-limit", 0, True),
        ("le-connection-refused", 0, False),
        ("le-connection-refused", 1, True),
        ("le-connection-busy", 2, True),
        ("le-connection-memory-allocation", 1, True),
        ("le-connection-abort-by-local", 9, False),
    ],
)
def test_an_adapter_is_full_by_its_word_or_if_it_holds_connections_and_takes_no_more(
    text: str, held: int, full: bool
) -> None:
    assert ble_errors.is_full(Exception(text), range(held)) is full


def test_a_bluetoothd_that_does_not_answer_and_one_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    raised: list[Exception] = [TimeoutError(), OSError("It is broken")]

    async def adapters(_bus: str | None) -> list[bluez.AdapterFacts]:
        raise raised.pop(0)

    monkeypatch.setattr(bluez, "_adapters", adapters)
    with pytest.raises(NoReaderError) as silent:
        bluez.adapters("tcp:host=127.0.0.1,port=9")
    assert (silent.value.message, silent.value.hint) == (
        "bluetoothd does not answer.", "sudo systemctl restart bluetooth",
    )  # fmt: skip
    with pytest.raises(NoReaderError) as broken:
        bluez.adapters("tcp:host=127.0.0.1,port=9")
    assert broken.value.message == "Cannot talk to bluetoothd: It is broken."
    assert "bluetooth" in broken.value.hint


def test_the_words_of_a_full_adapter_and_of_a_silent_node() -> None:
    assert ble_errors.too_many(1, "hci0").message == "The Bluetooth of hci0 holds 1 connection and takes no more."
    assert ble_errors.too_many(2, "hci0").message == "The Bluetooth of hci0 holds 2 connections and takes no more."
    silent = "The node at C1 does not answer over BLE"
    assert ble_errors.silent("C1", None).message == f"{silent}."
    assert ble_errors.silent("C1", Exception("the connection ended. ")).message == f"{silent} (the connection ended)."
    assert ble_errors.silent("C1", TimeoutError()).message == f"{silent} (TimeoutError)."
    assert ble_errors.silent("C1", NodeSilentError("It is gone.")).message == f"{silent} (It is gone)."


@pytest.mark.parametrize(
    ("interfaces", "held"),
    [
        ({"org.bluez.Device1": ("/org/bluez/hci0", True)}, True),
        ({"org.bluez.Device1": ("/org/bluez/hci0", False)}, False),
        ({"org.bluez.Device1": ("/org/bluez/hci1", True)}, False),
        ({"org.bluez.Adapter1": ("/org/bluez/hci0", True)}, False),
    ],
    ids=["its own", "not connected", "another adapter's", "an adapter"],
)
def test_an_adapter_holds_the_connections_of_its_own_devices(
    interfaces: dict[str, tuple[str, bool]], held: bool
) -> None:
    as_dbus = {
        name: {"Adapter": SimpleNamespace(value=adapter), "Connected": SimpleNamespace(value=connected)}
        for name, (adapter, connected) in interfaces.items()
    }
    assert bluez._is_held(as_dbus, "/org/bluez/hci0") is held


class MockMessageBus:
    """A system bus whose bluetoothd answers each call, in turn, by what ``replies`` has."""

    def __init__(self, *, bus_address: str | None, bus_type: Any) -> None:
        self.opened = bus_address, bus_type
        self.replies: list[Any] = []
        self.calls: list[tuple[Any, ...]] = []
        self.ended = 0

    async def connect(self) -> MockMessageBus:
        return self

    def disconnect(self) -> None:
        self.ended += 1

    async def call(self, message: Message) -> Any:
        self.calls.append(
            (message.destination, message.path, message.interface, message.member, message.signature, message.body)
        )
        return self.replies.pop(0)


def _answer(*body: Any) -> Any:
    return SimpleNamespace(message_type=MessageType.METHOD_RETURN, body=body)


@pytest.fixture
def system_bus(monkeypatch: pytest.MonkeyPatch) -> MockMessageBus:
    bus = MockMessageBus(bus_address=None, bus_type=None)

    def opened(*, bus_address: str | None, bus_type: Any) -> MockMessageBus:
        bus.opened = bus_address, bus_type
        return bus

    monkeypatch.setattr("dbus_fast.aio.MessageBus", opened)
    return bus


def test_each_adapter_is_listed_by_name_with_what_it_can_and_how_many_connections_it_holds(
    system_bus: MockMessageBus,
) -> None:
    """An old bluetoothd states no roles: its adapters connect to nodes."""

    def facts(**values: Any) -> dict[str, Any]:
        return {name: SimpleNamespace(value=value) for name, value in values.items()}

    device = {"org.bluez.Device1": facts(Adapter="/org/bluez/hci1", Connected=True)}
    objects = {
        "/org/bluez/hci1": {"org.bluez.Adapter1": facts(Address="F0:00:00:00:00:01", Powered=False)},
        "/org/bluez": {"org.bluez.AgentManager1": {}},
        "/org/bluez/hci1/dev_1": device,
        "/org/bluez/hci1/dev_2": device,
        "/org/bluez/hci0": {
            "org.bluez.Adapter1": facts(Address="F0:00:00:00:00:00", Powered=True, Roles=["peripheral"])
        },
    }
    system_bus.replies = [_answer(True), _answer(objects)]
    assert asyncio.run(bluez._adapters("unix:path=/bus")) == [
        bluez.AdapterFacts("hci0", "F0:00:00:00:00:00", True, False, 0),
        bluez.AdapterFacts("hci1", "F0:00:00:00:00:01", False, True, 2),
    ]
    bus, manager = "org.freedesktop.DBus", "org.freedesktop.DBus.ObjectManager"
    assert system_bus.calls == [
        (bus, "/org/freedesktop/DBus", bus, "NameHasOwner", "s", ["org.bluez"]),
        ("org.bluez", "/", manager, "GetManagedObjects", "", []),
    ]
    assert (system_bus.opened, system_bus.ended) == (("unix:path=/bus", BusType.SYSTEM), 1)


def test_a_bluetoothd_that_does_not_run_or_refuses_is_named_and_its_bus_closed(system_bus: MockMessageBus) -> None:
    system_bus.replies = [_answer(False)]
    with pytest.raises(NoReaderError) as absent:
        asyncio.run(bluez._adapters(None))
    assert absent.value.message == "The Bluetooth service (bluetoothd) is not running."
    assert absent.value.hint == ble_errors.SERVICE_HINT
    name = "org.freedesktop.DBus.Error.AccessDenied"
    refusal = SimpleNamespace(message_type=MessageType.ERROR, error_name=name, body=["Not for you"])
    system_bus.replies = [_answer(True), refusal]
    with pytest.raises(DBusError) as refused:
        asyncio.run(bluez._adapters(None))
    assert (refused.value.type, refused.value.text) == (name, "['Not for you']")
    assert system_bus.ended == 2


@pytest.mark.parametrize(
    ("name", "dbus_error", "text", "gone"),
    [
        ("BleakDBusError", "org.freedesktop.DBus.Error.UnknownObject", "x", True),
        ("BleakDBusError", "org.freedesktop.DBus.Error.UnknownMethod", "x", True),
        ("BleakDBusError", "org.bluez.Error.InProgress", "x", False),
        ("BleakDeviceNotFoundError", "", "x", True),
        ("BleakError", "", "device 'dev_C1' not found", True),
        ("BleakError", "", "x", False),
    ],
)
def test_a_device_that_bluez_has_forgotten_is_known_by_each_of_its_words(
    name: str, dbus_error: str, text: str, gone: bool
) -> None:
    error = type(name, (Exception,), {"dbus_error": dbus_error})(text)
    assert ble_errors.is_gone(error) is gone
