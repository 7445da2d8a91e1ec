"""The second half of the demo: the key goes to another station, first as a copy, then for good."""

from __future__ import annotations

from typing import Literal

from teds_provision.demo.desk import Demo, verify_from
from teds_provision.errors import LinkFailure, PolicyRefused
from teds_provision.handover.export_keys import export_keys, plan_export
from teds_provision.handover.import_keys import Imported, import_keys, plan_import
from teds_provision.handover.pending import close
from teds_provision.handover.prove import Proven, prove_nodes
from teds_provision.handover.selection import ExportOrder
from teds_provision.handover.trust import Candidate, add
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.station import Station
from teds_provision.store import TrustRecord


def hand_over(demo: Demo, first: Station, second: Station) -> None:
    """Copy: both stations reach the node. Move: only the second does."""
    with demo.steps.step("trust") as step:
        for station, other in ((first, second), (second, first)):
            record = TrustRecord(other.name, "station", other.point, fingerprint(other.point))
            add(station, [Candidate(record, demo.folder)])
        step.detail = "each station trusts the other's key, by a person's word"
    _send(demo, first, second, "copy")
    verify_from(demo, second, "verify")
    verify_from(demo, first, "verify")
    _send(demo, first, second, "move")
    verify_from(demo, second, "verify")
    with demo.steps.step("refuse") as step:
        try:
            first.policy.require_whitelisted(demo.uuid)
        except PolicyRefused as refused:
            step.detail = refused.message
        else:
            raise LinkFailure("The demo's first station still uses a key that it gave away.")


def _send(demo: Demo, sender: Station, receiver: Station, mode: Literal["copy", "move"]) -> None:
    bundle = demo.folder / f"{mode}.jwe"
    with demo.steps.step("export-keys") as step:
        plan = plan_export(sender, ExportOrder((receiver.name,), (demo.uuid,), mode))
        sealed = export_keys(sender, plan, bundle)
        step.detail = f"{mode}: {sealed.octets} octets, sealed to {receiver.fingerprint[:16]}"
    with demo.steps.step("import-keys") as step:
        planned = plan_import(receiver, bundle.read_bytes())
        taken = planned if isinstance(planned, Imported) else import_keys(receiver, planned)
        outcome = prove_nodes(receiver, demo.over("can"), taken.uuids, demo.reporter)[0]
        if not isinstance(outcome, Proven):
            raise LinkFailure(f"The node was not reached after the import: {outcome.why}")
        rotated = ", key rotated, the sender is locked out" if outcome.rotated else ""
        step.detail = f"proven in a session{rotated}"
    with demo.steps.step("receipt") as step:
        close(sender, taken.receipt)
        step.detail = f"{sender.name} has {receiver.name}'s signed receipt"
