"""``node check``: the rules of the profile against a board."""

from __future__ import annotations

from typing import Final

import click

from teds_provision import check as check_room
from teds_provision.cli.context import App, Console, pass_app
from teds_provision.cli.options import command, dry_run_option, link_options, yes_option
from teds_provision.cli.rendering import print_table, reporter_for
from teds_provision.errors import NotAuthenticError, TedsProvisionError
from teds_provision.links import LinkSettings


@command(
    "teds-provision node check --nfc udp:localhost:54321",
    "teds-provision node check --explain --nfc udp:localhost:54321",
    "teds-provision node check --factory --yes --via can --can udp_multicast:239.74.163.2",
)
@click.option(
    "--factory",
    is_flag=True,
    help="Also key, write and reset the node, and claim an actuator without moving it; the node ends in factory state,"
    " and one of this station's nodes loses its key.",
)
@click.option(
    "--explain",
    is_flag=True,
    help="Show T, OKM, M and tags of a test agreement that is never confirmed, to compare with a firmware's values.",
)
@yes_option
@dry_run_option
@link_options
@pass_app
def check(app: App, factory: bool, explain: bool, yes: bool, dry_run: bool, links: LinkSettings) -> None:
    """Check a board's firmware against the rules of the profile.

    Each rule is passed, failed or skipped, with its clause and what was observed.

    If a known mistake explains a failure (a label without its 00, swapped halves of Z …), it is named.

    Another owner's node is left alone (6). Keys change only with --factory, which keys, writes and resets a factory
    node or one of this station's.
    Exits 4 if a rule failed, 5 if there is no node or it stopped answering.
    """
    station = app.station()
    if dry_run:
        plan = (
            "key, write and reset the node, claim an actuator, every rule"
            if factory
            else "the rules that change no key"
        )
        app.emit({"plan": plan}, f"Plan: {plan}.")
        return
    if factory:
        app.confirm(
            "Key, write and reset the node found, and claim an actuator that it has? If the node is one of yours, it"
            " loses its key and datasheet.",
            yes=yes,
        )
    report = check_room.run.check_at(station, links, reporter_for(app), factory=factory, explained=explain)
    counts = {result: report.count(result) for result in ("passed", "failed", "skipped")}
    checks = [
        {
            "rule": result.rule,
            "clause": result.clause,
            "result": result.result,
            "detail": result.detail,
            "slip": result.slip,
        }
        for result in report.checks
    ]
    explained = {"explain": _explained(report.explained)} if report.explained is not None else {}
    broken = [result.rule for result in report.checks if result.result == "failed"]
    error: TedsProvisionError | None = report.lost
    if broken:
        count = "a rule" if len(broken) == 1 else f"{len(broken)} rules"
        error = NotAuthenticError(
            f"The node breaks {count}: {', '.join(broken)}.",
            hint="" if report.lost is None else f"{report.lost.message} The remaining rules were not tried.",
        )
    app.conclude(
        {"uuid": report.uuid.hex(), "checks": checks, **counts, **explained},
        lambda console: _table(console, report),
        error,
    )


def _explained(explained: check_room.agreement_rules.ExplainedRequest | str) -> dict[str, str | None]:
    """Return the test agreement in hex; without one only ``problem``."""
    if isinstance(explained, str):
        return {"problem": explained}
    reply = explained.reply
    return {
        "request": explained.request.hex(),
        "security_teds": explained.security_teds.hex(),
        "nonce": reply[:16].hex(),
        "epoch": reply[16:20].hex(),
        "en": reply[20:85].hex(),
        "t": explained.transcript.hex(),
        "okm": explained.okm.hex(),
        "m": explained.confirmation_key.hex(),
        "tag_n": explained.tag_due.hex(),
        "tag_n_received": reply[85:101].hex(),
        "sig_n_received": reply[101:].hex(),
        "tag_s": explained.station_tag.hex(),
        "problem": explained.problem or None,
        "slip": explained.slip,
    }


_EXPLAINED: Final = {
    "request": "Request, payload",
    "security_teds": "Security TEDS",
    "nonce": "nonceN",
    "epoch": "epoch",
    "en": "En",
    "t": "T",
    "okm": "OKM (48 octets)",
    "m": "M",
    "tag_n": "tagN, expected",
    "tag_n_received": "tagN, received",
    "sig_n_received": "sigN, received",
    "tag_s": "tagS",
}


def _table(console: Console, report: check_room.run.CheckReport) -> None:
    from rich.markup import escape
    from rich.table import Table

    style = {"passed": "green", "failed": "bold red", "skipped": "dim"}
    table = Table("rule", "result", "clause", "seen", box=None, pad_edge=False)
    for rule_result in report.checks:
        table.add_row(
            rule_result.rule,
            f"[{style[rule_result.result]}]{rule_result.result}[/]",
            rule_result.clause,
            escape(rule_result.detail),
        )
    print_table(console, table)
    counts = ", ".join(f"{report.count(result)} {result}" for result in style)
    console.print(f"{report.uuid.hex()}: {counts}")
    if report.explained is None:
        return
    explained = _explained(report.explained)
    console.print("A test agreement, never confirmed and ended on the node; none of these values is a key in use:")
    for key, name in _EXPLAINED.items():
        if (value := explained.get(key)) is not None:
            console.print(f"{name:<18} {value}", markup=False, highlight=False, soft_wrap=True)
    if explained["problem"]:
        console.print(explained["problem"], markup=False, highlight=False, soft_wrap=True)


def extend(command: click.Command) -> None:
    """Add ``check`` to the group ``node``."""
    assert isinstance(command, click.Group)
    command.add_command(check)
