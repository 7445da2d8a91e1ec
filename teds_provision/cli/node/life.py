"""``revoke``, ``decommission``, ``replace``: the end of a node's life."""

from __future__ import annotations

from typing import Any

import click

from teds_provision import provisioning
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.node.node_names import resolve
from teds_provision.cli.options import command, dry_run_option, link_options, links_given, yes_option
from teds_provision.cli.rendering import reporter_for
from teds_provision.cli.station.handover import require_same
from teds_provision.errors import FrozenError, LinkError, PolicyError
from teds_provision.handover import deny, life
from teds_provision.handover.life import (
    RevokeResult,
    TakeoverPlan,
    hand_on,
    is_finished,
    plan_takeover,
    retire,
    take_over,
)
from teds_provision.links import LinkSettings
from teds_provision.provisioning.agree import ResetReceipt
from teds_provision.sanitize import counted
from teds_provision.station.measurements import HandedOn
from teds_provision.station.station import Station

_TAKEN_OVER = "Nothing to do: it has already taken over."


@command('teds-provision revoke 8d4d --why "stolen with the arm"', "teds-provision revoke --lift 8d4d --yes")
@click.argument("uuid")
@click.option("--why", metavar="TEXT", help="Reason, shown to everyone who meets the node, and logged.")
@click.option("--lift", is_flag=True, help="Lift the ban on this station, also one that another station issued.")
@yes_option
@dry_run_option
@pass_app
def revoke(app: App, uuid: str, why: str | None, lift: bool, yes: bool, dry_run: bool) -> None:
    """Ban a node: remove it from the whitelist, delete its keys, and add a signed statement to every future bundle.

    Stations that trust this one and know the node honor it when they import. --lift lifts a ban on this station, even
    one issued by another station; deleted keys do not come back.
    """
    if lift == (why is not None):
        raise click.UsageError("Use --why TEXT to revoke, or --lift alone to lift a ban.")
    station = app.station()
    octets = resolve(station, uuid)
    if lift:
        _lift(app, station, octets, yes=yes, dry_run=dry_run)
        return
    assert why is not None
    done = life.already_revoked(station, octets)
    if done is not None:
        _print_revoked(app, done)
        return
    if dry_run:
        keys = len(station.keys.keys_of(octets))
        app.emit(
            {"uuid": octets.hex(), "plan": "revoke", "keys": keys},
            f"Plan: revoke {octets.hex()}, delete {counted(keys, 'key')}.",
        )
        return
    station.unlock()
    if station.policy.revocation(octets) is None:
        app.confirm(f"Revoke node {octets.hex()}? Its keys will be deleted here.", yes=yes)
    with station.lock("revoke", app.note):
        done = life.revoke(station, octets, why)
    _print_revoked(app, done)


def _print_revoked(app: App, done: RevokeResult) -> None:
    node = done.entry.uuid.hex()
    result = {
        "uuid": node,
        "fingerprint": done.entry.fingerprint,
        "why": done.entry.why,
        "created": done.entry.created,
        "fresh": done.fresh,
    }
    app.emit(result, f"Node {node} is revoked: {done.entry.why}" + ("" if done.fresh else " (already known)."))


def _lift(app: App, station: Station, uuid: bytes, *, yes: bool, dry_run: bool) -> None:
    entry = station.policy.revocation(uuid)
    if entry is None:
        _print_not_revoked(app, uuid)
        return
    result: dict[str, Any] = {"lifted": uuid.hex(), "why": entry.why, "fresh": True}
    if dry_run:
        app.emit({**result, "plan": True}, f"Plan: lift the ban on {uuid.hex()}: {entry.why}")
        return
    station.unlock()
    app.confirm(f"Lift the ban on node {uuid.hex()} ({entry.why}, {entry.created})?", yes=yes)
    with station.lock("revoke --lift", app.note):
        current = station.policy.revocation(uuid)
        if current is None:  # the same command, run at the same time, was first
            _print_not_revoked(app, uuid)
            return
        require_same(current == entry)
        deny.lift(station, uuid)
    app.emit(result, f"The ban on node {uuid.hex()} is lifted here. To use it, whitelist it and agree on a key.")


def _print_not_revoked(app: App, uuid: bytes) -> None:
    result = {"lifted": uuid.hex(), "why": None, "fresh": False}
    app.emit(result, f"Nothing to do: node {uuid.hex()} is not revoked here.")


@command("teds-provision decommission 8d4d --yes --via can --can udp_multicast:239.74.163.2")
@click.argument("uuid")
@click.option(
    "--force", is_flag=True, help="Take it out of service even if it does not answer (recorded as unconfirmed)."
)
@yes_option
@dry_run_option
@link_options
@pass_app
def decommission(app: App, uuid: str, force: bool, yes: bool, dry_run: bool, links: LinkSettings) -> None:
    """Reset a node in a session, keep its signed receipt, and take it out of service.

    With --force, a node that does not answer is recorded as unconfirmed; its keys remain, so you can run this again.
    """
    station = app.station()
    octets = station.nodes.resolve(uuid)
    station.policy.require_not_given_away(octets)
    if is_finished(station, octets):
        app.emit(
            _result(octets, None) | {"confirmed": True, "fresh": False}, "Nothing to do: it is already out of service."
        )
        return
    if dry_run:
        app.emit({"uuid": octets.hex(), "plan": "decommission"}, f"Plan: reset {octets.hex()}, take it out of service.")
        return
    station.unlock()
    app.confirm(
        f"Take node {octets.hex()} out of service? Its key will be erased on the node and on this station.", yes=yes
    )
    receipt = _reset(app, station, octets, links, force=force)  # without the lock: it may ask, and wait for the node
    with station.lock("decommission", app.note):
        left = retire(station, octets, receipt)
    state = "is out of service and signed that it is in factory state" if receipt else "is out of service, unconfirmed"
    result = _result(octets, receipt) | {"fresh": True, "removed": left.to_json()}
    app.emit(result, f"Node {octets.hex()} {state}.{_handed_on(left, 'Removed from')}")


def _handed_on(moved: HandedOn, verb: str) -> str:
    """Return what a node was removed from, or handed on, in lines; "" if there is nothing."""
    lines = [
        f"{verb} {what}: {', '.join(values)}"
        for what, values in (
            ("groups", moved.groups),
            ("topic names", moved.topics),
            ("measurements", moved.measurements),
        )
        if values
    ]
    lines += [f"Measurements that had no other node were deleted: {', '.join(moved.ended)}"] if moved.ended else []
    return "".join(f"\n{line}" for line in (*lines, *(f"Not moved: {why}" for why in moved.kept)))


def _result(uuid: bytes, receipt: ResetReceipt | None) -> dict[str, Any]:
    return {
        "uuid": uuid.hex(),
        "confirmed": receipt is not None,
        "epoch": receipt.epoch if receipt else None,
        "challenge": receipt.challenge.hex() if receipt else None,
        "proof": receipt.proof.hex() if receipt else None,
    }


def _reset(app: App, station: Station, uuid: bytes, links: LinkSettings, *, force: bool) -> ResetReceipt | None:
    """Reset the node; None if it is unreachable and that is to be recorded as unconfirmed."""
    try:
        with (
            provisioning.meeting.meet(station, links, uuid, reporter_for(app)) as node,
            station.node_lock(uuid),
            station.released(uuid, "reset") as released,
        ):
            undone = "It was not reset and stays in service."
            provisioning.sign.require_not_measured(station, node, released=bool(released), undone=undone)
            return provisioning.agree.reset_node(station, node, provisioning.identify.identify(station, node))
    except (LinkError, PolicyError) as error:
        if isinstance(error, FrozenError) or provisioning.conversation.is_busy(error):
            raise  # the node answers and will sign its reset once it is free; --force would record less
        if not force and not app.interactive:
            first = "Bring the node within reach" if isinstance(error, LinkError) else error.hint.rstrip(".")
            error.hint = (
                f"{first}, or add --force to record it as unconfirmed." if first else "Add --force: unconfirmed."
            )
            raise
        app.note(f"Cannot reset the node: {error.message}")
        app.confirm("Take it out of service anyway, unconfirmed?", yes=force)
        return None


@command(
    "teds-provision replace 8d4d9da65281f7000000 8d4d9da65281f7000001 --yes",
    "teds-provision replace old-finger 8d4d --copy-calibration",
)
@click.argument("old")
@click.argument("new")
@click.option(
    "--copy-calibration", is_flag=True, help="Copy OLD's calibration to NEW; only if the sensor itself moves."
)
@yes_option
@dry_run_option
@link_options
@click.pass_context
def replace(
    ctx: click.Context, old: str, new: str, copy_calibration: bool, yes: bool, dry_run: bool, links: LinkSettings
) -> None:
    """Replace OLD with the whitelisted spare NEW.

    NEW takes over its name, groups, topic names, measurements and profile; what moved, and what could not, is listed.
    A calibration belongs to one sensor, so it is copied only on request. If you name a link, OLD is reset when it can
    be reached; otherwise it goes out of service unconfirmed.
    """
    app = ctx.find_object(App)
    assert app is not None
    station = app.station()
    octets, spare = station.nodes.resolve(old), station.nodes.resolve(new)
    shown = plan_takeover(station, octets, spare, copy_calibration=copy_calibration)
    result, text = _takeover(shown)
    result["groups"] = station.groups.names_of_node(spare if shown.done else octets)
    if dry_run and shown.done and not station.measurements.has_node(octets):
        app.emit({**result, "moved": HandedOn().to_json(), "fresh": False}, _TAKEN_OVER)
        return
    for warning in shown.warnings:
        app.warn(warning)
    if dry_run:
        app.emit({**result, "warnings": list(shown.warnings), "plan": True}, f"Plan: {text}.")
        return
    receipt = None
    if not shown.done:
        station.unlock()
        app.confirm(f"{text}?", yes=yes)
        # without the lock: it may wait for the node
        receipt = _reset(app, station, octets, links, force=True) if links_given(ctx) else None
    with station.lock("replace", app.note):
        plan = plan_takeover(station, octets, spare, copy_calibration=copy_calibration)
        same = _takeover(plan)[0] == _takeover(shown)[0] and plan.warnings == shown.warnings
        require_same(same and plan.done == shown.done)
        if plan.done:
            moved = hand_on(station, plan)
        else:
            warnings, moved = take_over(station, plan, receipt)
    if plan.done:
        rest = _handed_on(moved, "Moved")
        text = "It has already taken over." if rest else _TAKEN_OVER
        app.emit({**result, "moved": moved.to_json(), "fresh": False}, f"{text}{rest}")
        return
    for warning in warnings[len(shown.warnings) :]:  # those of the plan were printed before the question
        app.warn(warning)
    confirmed = receipt is not None
    next_step = f"Next, run provision (or sign and write) for {spare.hex()}."
    result |= {"confirmed": confirmed, "fresh": True, "warnings": list(warnings), "moved": moved.to_json()}
    app.emit(result, f"{text}.{_handed_on(moved, 'Moved')}\n{next_step}")


def _takeover(plan: TakeoverPlan) -> tuple[dict[str, Any], str]:
    """Return what one node takes over from another, for scripts and in a sentence."""
    taken = plan.new if plan.done else plan.old
    result = {
        "old": plan.old.uuid.hex(),
        "new": plan.new.uuid.hex(),
        "name": taken.name,
        "profile": taken.profile,
        "calibration_copied": bool(plan.calibration),
    }
    given = [f"{what} {value}" for what, value in (("name", taken.name), ("profile", taken.profile)) if value]
    now = f" (now {plan.new.name!r})" if plan.new.name and not plan.done else ""
    text = f"{plan.new.uuid.hex()}{now} takes over from {plan.old.uuid.hex()}"
    return result, f"{text}: {', '.join(given) or 'no name or profile'}"
