"""The doctor's checks of nodes: overdue work, unfinished runs, changes by another program."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from functools import partial
from typing import Final

from teds_provision import teds
from teds_provision.doctor.checks import Finding, System, check, intact
from teds_provision.errors import BadDataError, NotFoundError, StoreChangedError, StoreError, VaultError
from teds_provision.files import read_text
from teds_provision.limits import LIMITS, load_toml
from teds_provision.sanitize import counted
from teds_provision.station.firmware import FirmwareDemands, known_firmware
from teds_provision.station.node_keys import deferred_until
from teds_provision.station.station import Station
from teds_provision.station.store.database import chunks
from teds_provision.station.store.records import utc_now
from teds_provision.station.store.row_sample import SAMPLED, RowSample
from teds_provision.station.store.sqlite import has_store

_SHOWN: Final = 5


@check("config", "machine")
def config(system: System) -> Iterator[Finding]:
    """Check config.toml: it is TOML, with keys that some command knows."""
    path = system.home / "config.toml"
    if not path.exists():
        yield Finding("config", "skipped", "There is no config.toml.")
        return
    try:
        text = read_text(path, LIMITS.text_file, "config.toml")
        values = load_toml(text, str(path))
    except (BadDataError, NotFoundError) as error:
        yield Finding("config", "failed", error.message, error.hint or "Fix or remove the file.")
        return
    wrong = list(system.bad_names(values, text))
    if wrong:
        more = f" And {len(wrong) - _SHOWN} more." if len(wrong) > _SHOWN else ""
        why = f"{path}, {' '.join(wrong[:_SHOWN])}{more}"
        yield Finding("config", "failed", why, "Fix or remove that line." if len(wrong) == 1 else "Fix these lines.")
        return
    bad = system.bad_value(values)
    if bad:
        yield Finding("config", "failed", bad, "Fix that line.")
    else:
        yield Finding("config", "ok", f"{path} contains {counted(len(values), 'setting')}.")


@check("profiles", "machine")
def profiles(system: System) -> Iterator[Finding]:
    """Check that every profile in this home can be loaded; the project's tests cover the shipped ones."""
    folder = system.home / "profiles"
    if not folder.is_dir():
        yield Finding("profiles", "skipped", f"There is no folder {folder}.")
        return
    listed = [
        listed
        for listed in teds.profile.list_profiles(teds.profile.default_folders(system.home))
        if folder in listed.path.parents
    ]
    for profile in listed:
        if profile.error:
            why = f"Cannot use profile {profile.name}: {profile.error}"
            yield Finding("profiles", "failed", why, f"teds-provision profile check {profile.path}")
    if not any(profile.error for profile in listed):
        yield Finding("profiles", "ok", f"{counted(len(listed), 'profile')} in {folder}.")


@check("store file", "store")
def store_file(system: System) -> Iterator[Finding]:
    """Check that the store is there if the vault is: one without the other is a loss."""
    vault = any((system.home / name).exists() for name in ("vault.json", "vault-pkcs11.json"))
    if vault and not has_store(system.home):
        why = f"{system.home} has a vault but no store: names, pins and wrapped keys of all nodes are missing."
        yield Finding("store file", "failed", why, "teds-provision restore FILE (a backup)")


def _firmware(station: Station, sample: RowSample) -> tuple[list[bytes], list[bytes]]:
    """Return the nodes whose firmware their type does not accept, and those that another image runs on than before."""
    demands = FirmwareDemands(station.home)
    odd, changed = [], []
    for chunk in chunks(station.firmware_reports.all(sample)):
        nodes = station.nodes.get_many([record.uuid for record in chunk])
        for record in chunk:
            node = nodes.get(record.uuid)
            known = known_firmware(record, partial(demands.demand_of, node.profile if node is not None else None))
            if known is not None and known.state not in ("good", "unjudged", "on-trial", "pending"):
                odd.append(record.uuid)
            if known is not None and known.changed:
                changed.append(record.uuid)
    return odd, changed


@check("nodes", "store")
def nodes(system: System) -> Iterator[Finding]:
    """Report what needs an operator: ended calibrations, duplicate names, drafts, unverified nodes, rotations."""
    if not has_store(system.home):
        return
    sample = RowSample(full=system.full)
    with Station.inspect(system.home) as station:
        tally = station.overview.waiting(datetime.now(UTC).strftime("%Y-%m-%d"), sample)
        due = station.keys.rotations_due()
        odd, changed = _firmware(station, sample)
    begins = {uuid: deferred_until(why) or "" for uuid, why in due.items()}
    later = tuple(uuid for uuid in tally.rotations if begins.get(uuid, "") > utc_now())
    own = tuple(uuid for uuid in tally.rotations if uuid not in later)
    first = min((begins[uuid] for uuid in later), default="")
    among = f" (of the {SAMPLED:,} keyed last)" if sample.sampled else ""
    rows = [
        (tally.overdue, "with an expired calibration", "teds-provision nodes --due 0"),
        (
            tally.twice,
            f"with a name that another node has{among}",
            "Give them different names: build UUID --name, sign, write",
        ),
        (tally.drafts, "with a datasheet that was built but not written", "teds-provision draft list"),
        (tally.unverified, f"keyed but never verified{among}", "teds-provision verify UUID"),
        (odd, "with firmware that their type does not accept", "teds-provision update UUID IMAGE"),
        (changed, "whose firmware changed since calibration", "Calibrate again, or: verify UUID --accept-firmware"),
        (own, "whose key must be rotated", "Open a session once: teds-provision verify UUID"),
        (
            later,
            "whose key another holder rotates first",
            f"Wait for its copy; verify UUID does it from {first} on",
        ),
    ]
    for uuids, what, fix in rows:
        if uuids:
            some = ", ".join(uuid.hex() for uuid in uuids[:_SHOWN]) + (" …" if len(uuids) > _SHOWN else "")
            yield Finding("nodes", "warning", f"{len(uuids)} {what}: {some}.", fix)
    part = f"names, verdicts and firmware were looked at of the {SAMPLED:,} nodes keyed last and of some others"
    if not any(uuids for uuids, _, _ in rows):
        whole = "No node needs attention"
        yield intact("nodes", whole, f"{whole}; {part}", sample)
    elif sample.sampled:
        yield intact("nodes", "", f"{part[0].upper()}{part[1:]}", sample)


@check("seals", "store")
def seals(system: System) -> Iterator[Finding]:
    """Check the MACs of the rows that decide whom the station trusts; only if no prompt is needed for that."""
    if not has_store(system.home):
        return
    sample = RowSample(full=system.full)
    station = Station.open(system.home, ask=system.ask or _nobody)
    try:
        if system.ask is None and station.identity.keystore != "keyring":  # a keyring opens without a prompt
            why = "Not checked: pins and trust need the vault, and no passphrase was given."
            yield Finding("seals", "skipped", why, "teds-provision --passphrase-fd 3 doctor 3<FILE")
            return
        station.unlock()
        broken = list(station.row_macs.all_broken(sample))
    except StoreChangedError as error:
        yield Finding("seals", "failed", error.message, error.hint)
        return
    except (VaultError, StoreError) as error:
        yield Finding("seals", "skipped", error.message, error.hint)
        return
    finally:
        station.close()
    if broken:
        some = ", ".join(broken[:_SHOWN]) + (" …" if len(broken) > _SHOWN else "")
        fix = "Remove them (whitelist remove, trust remove), find out who changed the file, and add them again."
        yield Finding("seals", "failed", f"Changed by another program and not trusted: {some}.", fix)
    else:
        whole = "Pins, trust and the station's own CA are unchanged"
        part = f"{whole}, of each large table the newest and {SAMPLED:,} random rows"
        yield intact("seals", whole, part, sample)


def _nobody(_prompt: str, _confirm: bool = False) -> str:
    raise VaultError("doctor never asks for a passphrase.")
