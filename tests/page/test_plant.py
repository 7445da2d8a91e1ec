"""The plant on the page: who belongs, what is to be decided and done, in a real browser."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING

import pytest

from teds_provision import plant
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.station.node_keys import REMOVED
from teds_provision.station.plant.alarms import Alarm
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry
from tests.plant.stations import ask, certified, request_of

from .lab import Lab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.system

NODE = bytes.fromhex("8d4d9da65281f7000000")


def test_the_plant_is_shown_with_conflicts_alarms_and_what_is_to_rotate(browser: Browser, fresh: Lab) -> None:
    stick = fresh.folder / "stick"
    stick.mkdir()
    with closing(Station.open(fresh.station.home, ask=ask)) as north:
        north.unlock()
        plant.owner.create(north, "plant Augsburg")
        south = certified(fresh.folder / "south", "south", north)
        signed = plant.owner.signed(north, plant.owner.add(north, request_of(south), frozenset({"keeper", "base"})))
        plant.apply_pages.put_roster(north, signed)
        plant.owner.join(south, signed, url=None, events=[])
        south.pins.put(WhitelistEntry(NODE, "cd" * 32, assurance="tap"))
        north.pins.put(WhitelistEntry(NODE, "ab" * 32, assurance="tap"))
        with north.transaction():
            north.plant.record_event("agreed", NODE, fingerprint="ab" * 32, epoch=2, key_id="0123456789abcdef")
        for station in (south, north):
            plant.sync.sync(station, FolderTransport(stick))
        plant.owner.join(north, signed, url=f"{plant.membership.FILES}{stick}", events=[])
        north.keys.demand_rotation(bytes(10), f"{REMOVED}station west (lost) has held this key")
        north.plant.alarms.put(Alarm("rolled-back", south.fingerprint, 3, "page 3 was there, and now 1 is the last"))
        south.close()
    fresh.run("--registry")
    with opened(browser, fresh, route="station") as page:
        panel = page.get_by_role("region", name="Plant")
        panel.get_by_text("plant Augsburg, roster 2").wait_for()
        shown = panel.inner_text()
        for words in ("bench", "here", "south", "heard", "keeper base, page 1", "two keys", "rolled-back",
                      "page 3 was there", "1 node", "Unsent"):  # fmt: skip
            assert words in shown, (words, shown)
        panel.get_by_role("searchbox", name="Who holds a node").fill("8d4d9d")
        found = panel.get_by_role("list", name="Who holds a node")
        found.get_by_text("held by bench (epoch 2)").wait_for()
        assert "two keys" in found.inner_text()
        panel.get_by_role("searchbox", name="Who holds a node").fill("nothing like it")
        found.get_by_text("No station reports such a node.").wait_for()
