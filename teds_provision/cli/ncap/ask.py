"""``ncap status``, ``detection``, ``open``: questions to the running daemon, by the Unix socket in its home."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from teds_provision import client
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command
from teds_provision.cli.rendering import shown

if TYPE_CHECKING:
    from rich.console import Console


@command("teds-provision ncap status", name="status")
@pass_app
def status(app: App) -> None:
    """Show what the running base station does."""
    with client.connect(home=app.home) as station:
        found = {**station.status(), "nodes": station.nodes()}
    app.emit(found, lambda console: _status(console, found))


def _status(console: Console, found: dict[str, Any]) -> None:
    served = found["url"] or "no page; start it with --http"
    console.print(f"{found['station']['name']}: {found['detection']} mode, {served}", markup=False)
    for link in found["links"]:
        console.print(_link(link), markup=False)
    for node in found["nodes"]:
        there = "there" if node["present"] else "away"
        name = shown(node["name"]) or "no name"
        console.print(f"{node['uuid']}  {name}  {there}  {_verdict(node)}", markup=False)
    for one in found.get("measurements", ()):
        console.print(f"measurement {one['id']}: {one['state']}", markup=False)
    for one in found.get("sinks", ()):
        console.print(f"{shown(one['name'])}: {one['state']}, {one['dropped']} dropped", markup=False)


def _verdict(node: dict[str, Any]) -> str:
    if node["verdict"] is None:
        return "not looked at yet"
    kept = " (all but its Security TEDS as last read)" if node["verdict"]["from"] == "kept" else ""
    return f"{node['verdict']['verdict']}{kept}"


def _link(link: dict[str, Any]) -> str:
    problem = f": {link['problem']['message']}" if link["problem"] else ""
    others = f", {link['strangers']} not on the whitelist" if link["strangers"] else ""
    return f"{link['place']}: {link['state']}, {link['nodes']} nodes{others}{problem}"


@command("teds-provision ncap detection transparent", name="detection")
@click.argument("mode", type=click.Choice(["transparent", "whitelist"]))
@pass_app
def detection(app: App, mode: str) -> None:
    """Set which nodes are taken up: all, or those on the whitelist."""
    with client.connect(home=app.home) as station:
        now = station.set_detection(mode)
    app.emit({"detection": now}, f"Detection: {now}.")


@command("teds-provision ncap open", "teds-provision ncap open --read-only", name="open")
@click.option("--read-only", is_flag=True, help="For somebody who shall see and change nothing.")
@pass_app
def open_page(app: App, *, read_only: bool) -> None:
    """Print the page's address, with a token that works once.

    It is good for five minutes.
    """
    with client.connect(home=app.home) as station:
        url = station.login_url(read_only=read_only)
    app.emit({"url": url}, url)
