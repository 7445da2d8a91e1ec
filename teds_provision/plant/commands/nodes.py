"""``nodes``: what the plant adds: names and conflicts, and ``--plant``, the view of all its stations."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any, Final

import click

from teds_provision import plant
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.extending import add_options, callback_of
from teds_provision.cli.rendering import local_time, print_json_list, shown
from teds_provision.errors import NotFoundError
from teds_provision.provisioning.inventory import CHUNK
from teds_provision.station.station import Station


def extend(command: click.Command) -> None:
    """Add --plant."""
    core = callback_of(command)

    @pass_app
    def nodes(app: App, /, *, of_plant: bool, **rest: Any) -> None:
        if of_plant:
            _show_plant(app, app.station(), rest["text"], as_json=app.json or rest["form"] == "json")
        else:
            core(**rest)

    says = "Show what the plant's stations report: holders, firmware, conflicts."
    add_options(command, "--format", click.Option(["--plant", "of_plant"], is_flag=True, help=says))
    command.callback = nodes


def resolve(station: Station, text: str) -> bytes | None:
    """Return the UUID that ``text`` means to the plant's stations, None if no node fits; UsageError if several do."""
    return plant.status.find_named(station, text)


class PlantView:
    """The nodes of this station as its plant knows them."""

    def named(self, station: Station, text: str) -> list[bytes]:
        """Return the known node that only another station of the plant calls ``text``; empty without a plant."""
        if station.plant.joined is None:
            return []
        uuid = plant.status.resolve(station, text)
        if not station.overview.is_known(uuid):
            raise NotFoundError(f"This station has not met node {uuid.hex()}.", hint=f"See: nodes --plant {uuid.hex()}")
        return [uuid]

    def described(self, station: Station, nodes: Iterator[dict[str, Any]]) -> Iterator[dict[str, Any]]:
        """Add to each node its conflicts in the plant, and the plant's name if this station gave it none.

        Leave the nodes unchanged if the station joined no registry.
        """
        roster = station.plant.roster
        if roster is None:
            yield from nodes
            return
        found: dict[str, list[dict[str, str]]] = {}
        for uuid, name, why in station.plant.claims.conflicts():
            found.setdefault(uuid.hex(), []).append({"name": name, "why": why})
        while chunk := list(islice(nodes, CHUNK)):
            nameless = [bytes.fromhex(node["uuid"]) for node in chunk if not node["name"]]
            names = plant.status.names(station, roster, nameless)
            for node in chunk:
                named = node["name"] or names.get(bytes.fromhex(node["uuid"]))
                yield {**node, "name": named, "conflicts": found.get(node["uuid"], [])}


VIEW: Final = PlantView()


def _show_plant(app: App, station: Station, text: str | None, *, as_json: bool) -> None:
    """Show the stations' claims about nodes, including those that this one never met."""
    described = plant.status.nodes(station, plant.apply_pages.require_roster(station), text)
    if as_json:
        print_json_list("nodes", described)
        return
    for node in described:
        says = node["says"]
        holders = ", ".join(name for names in says["holders"].values() for name in names)
        written = f", datasheet {says['sequence']} by {says['written_by']}" if says["written_by"] else ""
        banned = f", revoked by {', '.join(says['revoked'])}" if says["revoked"] else ""
        held = f"held by {holders} (epoch {says['epoch']})" if says["holders"] else "no holder"
        sentence = f"{held}{written}, firmware {_reported(says['firmware'])}{banned}"
        line = "  ".join(filter(None, (node["uuid"], shown(node["name"] or ""), sentence)))
        writer = says["older_than"]
        older = [f"  the datasheet known here is older than {shown(writer)} wrote"] if writer else []
        app.lines([
            line,
            *older,
            *(f"  {conflict['name']}: {shown(conflict['why'])}" for conflict in node["conflicts"]),
            *(f"  also reported: firmware {_reported(seen)}" for seen in _others(says)),
        ])  # fmt: skip


def _reported(firmware: dict[str, Any] | None) -> str:
    """Return the firmware that a station saw, by whom and when; None: no station reports any."""
    if firmware is None:
        return "not reported"
    by = f"({firmware['by']}, {local_time(firmware['at'])})"
    if firmware["version"] is None:
        return shown(f"not reported {by}")
    build = f"+{firmware['build']}" if firmware["build"] else ""
    return shown(" ".join(filter(None, (firmware["text"], f"{firmware['version']}{build}", by))))


def _others(says: dict[str, Any]) -> list[dict[str, Any]]:
    """Return earlier reports of other stations that differ from the newest."""
    newest = says["firmware"] or {}
    what = ("text", "version", "build", "image")
    return [seen for seen in says["firmware_by"].values() if any(seen[name] != newest[name] for name in what)]
