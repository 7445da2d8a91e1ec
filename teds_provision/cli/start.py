"""``teds-provision`` alone: this station, what is on its links now, what is wrong, and the next command."""

from __future__ import annotations

import os
from collections.abc import Iterator
from shlex import quote
from typing import Any

import click

from teds_provision.cli.context import App
from teds_provision.cli.rendering import aligned, count_of, shown
from teds_provision.doctor import fleet
from teds_provision.doctor.checks import System
from teds_provision.errors import LinkError, NotFoundError, TedsProvisionError
from teds_provision.links import LinkSettings
from teds_provision.measure.link_survey import LinkSurvey, look, readers
from teds_provision.provisioning.inventory import inventory, search
from teds_provision.sanitize import sanitize
from teds_provision.station.station import Station

_SHOWN = 20


def start(app: App, ctx: click.Context) -> None:
    """Show one screen: the station, its links and their nodes, problems, and the next command."""
    try:
        station = app.station()
    except NotFoundError:
        found: dict[str, Any] = {
            "station": None,
            "links": [_link(survey) for survey in readers()],
            "nodes": [],
            "problems": [],
            "next": "teds-provision init",
        }
    else:
        found = _of_service(app, station) or _of_links(station, _named(ctx))
        waiting = fleet.nodes(System(app.home))
        found["problems"] += [
            {"what": finding.why, "fix": finding.fix} for finding in waiting if finding.result == "warning"
        ]
        found["next"] = _next(found)
    if app.json:
        app.emit(found)
    else:
        app.lines([sanitize(line) for line in _lines(found)])


def _named(ctx: click.Context) -> LinkSettings:
    """Return the links that config.toml or the environment names for every command."""

    def setting(name: str) -> tuple[str, ...]:
        value = os.environ.get(f"TEDS_PROVISION_{name.upper()}") or (ctx.default_map or {}).get(name) or ()
        return tuple(value.split()) if isinstance(value, str) else tuple(map(str, value))

    ble = setting("ble")
    return LinkSettings(nfc=setting("nfc") or None, can=setting("can") or None, ble=ble[0] if ble else None)


def _station(station: Station) -> dict[str, Any]:
    return {
        "name": station.name,
        "fingerprint": station.fingerprint,
        "keystore": station.identity.keystore,
        "home": str(station.home),
    }


def _of_links(station: Station, named: LinkSettings) -> dict[str, Any]:
    """Ask on the links themselves: the named ones, else those of the last contacts, and present readers."""
    known = [node.uuid for node in inventory(station, search(station))]
    remembered = sorted(set(station.nodes.last_places([bytes.fromhex(uuid) for uuid in known]).values()))
    places = [place for place in named.places if named.nfc] + list(named.buses or remembered)
    present = [*look(station, places), *([] if named.nfc else readers())]
    nodes = [_node(station, link.place, address, who) for link in present for address, who in link.nodes]
    problems = [{"what": link.why, "fix": link.cure} for link in present if link.state == "down"]
    problems += [{"what": text, "fix": f"teds-provision identify --via can --can {link.place.partition(':')[2]}"}
                 for link in present for text in link.troubles]  # fmt: skip
    return {
        "station": _station(station),
        "links": [_link(survey) for survey in present],
        "nodes": nodes,
        "known": len(known),
        "problems": problems,
    }


def _link(link: LinkSurvey) -> dict[str, Any]:
    return {"place": link.place, "state": link.state, "nodes": len(link.nodes), "why": link.why or None}


def _node(station: Station, place: str, address: int, who: Any) -> dict[str, Any]:
    (known,) = inventory(station, [who.uuid])
    return {
        "uuid": who.uuid.hex(),
        "name": known.name,
        "link": place,
        "address": address,
        "state": who.state.name.lower(),
        "whitelisted": known.whitelisted,
        "verdict": known.verdict,
    }


def _of_service(app: App, station: Station) -> dict[str, Any] | None:
    """Return what a running `ncap` of this home sees, which watches its links all the time; None if none runs."""
    service = app.running_service(timeout=5)
    if service is None:
        return None
    try:
        with service as running:
            status, nodes = running.status(), running.nodes()
    except (LinkError, OSError, TedsProvisionError):
        return None
    here = [node for node in nodes if node["present"]]
    return {
        "station": _station(station),
        "ncap": {"url": status["url"], "measurements": len(status["measurements"])},
        "links": [
            {
                "place": link["place"],
                "state": "down" if link["problem"] else "up",
                "nodes": link["nodes"],
                "why": link["problem"]["message"] if link["problem"] else None,
            }
            for link in status["links"]
        ],
        "nodes": [
            {
                "uuid": node["uuid"],
                "name": node["name"],
                "link": node["link"],
                "address": node.get("address"),
                "state": node["state"],
                "whitelisted": node["whitelisted"],
                "verdict": node["verdict"]["verdict"] if node["verdict"] else None,
            }
            for node in here
        ],
        "known": len(nodes),
        "problems": [
            {"what": f"{link['place']}: {link['problem']['message']}", "fix": link["problem"]["hint"]}
            for link in status["links"]
            if link["problem"]
        ],
    }


def _next(found: dict[str, Any]) -> str:
    """Return the command that most likely comes next: a fault before new boards, new boards before work."""
    mute = (
        [link for link in found["links"] if link["state"] == "up" and not link["nodes"]] if not found["nodes"] else []
    )
    down = [link for link in found["links"] if link["state"] == "down"] or mute
    if down:
        kind, _, where = str(down[0]["place"]).partition(":")
        return f"teds-provision doctor --{kind} {quote(where)}"
    for node in found["nodes"]:
        over = f" --can {quote(str(node['link']).partition(':')[2])}" if str(node["link"]).startswith("can:") else ""
        if not node["whitelisted"]:
            return f"teds-provision identify --add{over}"
        if node["state"] == "factory":
            return f"teds-provision provision --profile PROFILE{over}"
        if node["verdict"] != "authentic":
            return f"teds-provision verify {quote(node['name'] or node['uuid'])}{over}"
    if "ncap" in found:
        return "teds-provision ncap open"
    if found["nodes"]:
        first = found["nodes"][0]
        return f"teds-provision measure {quote(first['name'] or first['uuid'])}"
    if found["links"] and all(link["place"].startswith("nfc:") for link in found["links"]):
        return "teds-provision provision --profile PROFILE"
    if not found["links"]:
        return "teds-provision config set can socketcan:can0"
    return "teds-provision doctor"


def _lines(found: dict[str, Any]) -> Iterator[str]:
    station = found["station"]
    if station is None:
        yield "No station yet."
    else:
        yield f"Station {shown(station['name'])}, key {station['fingerprint'][:16]}, {count_of(found['known'])} known"
    if "ncap" in found:
        yield f"ncap is running: {found['ncap']['url'] or 'without a page'}"
    yield from (f"  {_link_line(link)}" for link in found["links"])
    if not found["links"]:
        yield "  No reader is plugged in, and no bus is configured."
    if found["nodes"]:
        yield from _table(found["nodes"][:_SHOWN])
        if len(found["nodes"]) > _SHOWN:
            yield f"  … and {len(found['nodes']) - _SHOWN} more"
    for problem in found["problems"]:
        yield f"! {problem['what']}"
        if problem["fix"]:
            yield f"  → {problem['fix']}"
    yield f"Next: {found['next']}"
    yield "All commands: teds-provision --help"


def _table(nodes: list[dict[str, Any]]) -> list[str]:
    """Return a line per node, in columns."""
    rows = [("uuid", "name", "link", "state", "verdict")]
    for node in nodes:
        listed = node["verdict"] or ("not verified" if node["whitelisted"] else "not whitelisted")
        rows.append((node["uuid"], shown(node["name"] or ""), node["link"], node["state"], listed))
    return aligned(rows)


def _link_line(link: dict[str, Any]) -> str:
    if link["state"] == "down":
        return f"{link['place']}: {link['why']}"
    if link["state"] == "listed":
        return f"{link['place']}: waits for a {'tap' if link['place'].startswith('nfc:') else 'connection'}"
    if not link["nodes"]:
        return f"{link['place']}: no node answers"
    return f"{link['place']}: {count_of(link['nodes'])} {'answers' if link['nodes'] == 1 else 'answer'}"
