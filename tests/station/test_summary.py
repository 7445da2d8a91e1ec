"""A node in a few lines: what is shown of each channel, and what is left out."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.station import summary
from teds_provision.station.summary import ChannelSummary, summarise
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.image import Image


@dataclass(frozen=True)
class Channel:
    """Stands for a channel of a datasheet."""

    units_stated: bool
    has_range: bool
    display: str = "rad"
    low: float = -1.5
    high: float = 2.5

    @property
    def shown(self) -> Any:
        return SimpleNamespace(text=self.display or "none given")

    def show(self, value: float) -> str:
        return f"{value:g} {self.display}".strip()


def test_each_channel_has_its_name_its_unit_with_its_range_and_its_own_calibration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    channels = {1: Channel(True, True), 2: Channel(True, False), 3: Channel(False, True), 4: Channel(True, True)}
    names: dict[bytes, object] = {b"node": "arm\x1b[31m", b"one": "an\x07gle", b"three": 7}
    monkeypatch.setattr(summary, "channel_of", lambda number, _blocks: channels[number])
    monkeypatch.setattr(summary, "teds", SimpleNamespace(decode=lambda octets: {"TCName": names.get(octets)}))
    named = {(0, AccessCode.NAME): b"node", (1, AccessCode.NAME): b"one", (3, AccessCode.NAME): b"three"}
    blocks = {(number, AccessCode.CHANNEL): b"channel" for number in channels}
    found = summarise(Image(bytes(10), {**named, **blocks, (2, AccessCode.CALIBRATION): b"table"}), {1: "degree"})
    assert found.name is not None
    assert found.name.isprintable()
    assert found.name.startswith("arm")
    first, *others = found.channels
    assert (first.number, first.unit, first.range, first.calibrated) == (
        1,
        "degree",
        "-1.5 degree to 2.5 degree",
        False,
    )
    assert first.name.isprintable()
    assert others == [
        ChannelSummary(2, "", "", "", True),
        ChannelSummary(3, "", "", "", False),
        ChannelSummary(4, "", "none given", "-1.5 to 2.5", False),
    ]
    assert summarise(Image(bytes(10), {})).name is None
