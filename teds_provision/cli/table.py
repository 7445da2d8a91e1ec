"""Every command of the tool: its module and its line in ``--help``.

The group's help is drawn from this table alone, so that ``--help`` imports no command and none of their libraries.
Commands of optional rooms come from what those register.
"""

from __future__ import annotations

from typing import Final

from teds_provision.optional_rooms import CommandRow as Entry
from teds_provision.optional_rooms import rooms

_LAST: Final = "Try it out"
_CORE: Final[dict[str, dict[str, Entry]]] = {
    "Start here": {
        "init": Entry("station.init", "init", "Create this station's identity and CA key, or show them."),
        "provision": Entry(
            "node.provision", "provision", "Identify, whitelist, key, sign, write and verify a node in one go."
        ),
        "verify": Entry("node.verify", "verify", "Check a node or image against everything the profile demands."),
        "nodes": Entry("node.nodes", "nodes", "Show what this station knows about its nodes."),
        "measure": Entry("measure.measure", "measure", "Stream calibrated values from nodes to files and topics."),
        "ncap run": Entry("service.ncap", "ncap", "Run the base station as a service, with API and web page."),
    },
    "Set up": {
        "trust": Entry("station.trust", "trust", "Manage trusted public keys of other stations and CAs."),
        "profile": Entry("station.profile", "profile", "List, show, check and create transducer types."),
        "config": Entry("station.config", "config", "Show and change the settings in config.toml and the environment."),
        "completion": Entry("station.config", "completion", "Print the script that completes commands in your shell."),
        "doctor": Entry("station.doctor", "doctor", "Check reader, CAN, keyring, clock and store; suggest fixes."),
    },
    "Nodes": {
        "identify": Entry("node.at_node", "identify", "Wait for a tap, read UUID and key, and have the node prove it."),
        "whitelist": Entry("node.whitelist", "whitelist", "Manage the nodes that may be keyed and written."),
        "agree": Entry("node.at_node", "agree", "Agree on a key with a node, or rotate it."),
        "build": Entry("node.build", "build", "Build a node's datasheet from its profile and calibration."),
        "sign": Entry("node.build", "sign", "Sign a built datasheet and show what changes on the node."),
        "write": Entry("node.build", "write", "Write a signed datasheet to a node's flash and read it back."),
        "draft": Entry("node.build", "draft", "List and drop datasheets that were built but not written."),
        "history": Entry("node.build", "history", "List a node's earlier datasheets; write --from restores one."),
        "read": Entry("node.build", "read", "Read every TEDS of a node."),
        "reset": Entry("node.at_node", "reset", "Reset a node to factory state and keep its signed receipt."),
        "locate": Entry("node.at_node", "locate", "Make a board blink or beep, to see which one it is."),
        "address": Entry("node.at_node", "address", "Change a node's CAN address."),
        "update": Entry(
            "node.update", "update", "Install new firmware over the session; it must prove itself to stay."
        ),
        "label": Entry("node.nodes", "label", "Make a label with QR code, UUID and fingerprint."),
        "log": Entry("station.log", "log", "Show the audit log and check its hash chain."),
        "trace": Entry("station.log", "trace", "Show what --trace recorded."),
        "show": Entry("node.show", "show", "Decode TEDS, images, profiles, bundles and messages."),
        "describe": Entry("node.describe", "describe", "Export datasheets as Thing Description, ros2_control or AAS."),
    },
    "Measure and actuate": {
        "record": Entry("measure.record", "record", "Inspect and convert recordings."),
        "sample": Entry("measure.sample", "sample", "Take one verified, calibrated reading."),
        "calibrate": Entry(
            "measure.calibrate", "calibrate", "Zero a sensor where it is mounted; take calibration points."
        ),
        "set": Entry(
            "measure.sample", "set_value", "Drive an actuator within its limits; it returns to its safe state."
        ),
        "mode": Entry("measure.sample", "mode", "Show what a node does, which channels are claimed, and its power."),
        "ncap": Entry("service.ncap", "ncap", "Run and control the base station service."),
        "group": Entry("measure.group", "group", "Manage groups of nodes that are measured together."),
        "names": Entry("measure.names", "names", "Choose the topics under which channels are published."),
    },
    "Keys and backup": {
        "export-keys": Entry(
            "station.handover", "export_keys", "Hand node keys to another station in a sealed bundle."
        ),
        "import-keys": Entry("station.handover", "import_keys", "Take over node keys from another station."),
        "handover": Entry("station.handover", "handover", "List, confirm and undo key handovers."),
        "revoke": Entry("node.life", "revoke", "Ban a node's key on this station and those it hands keys to."),
        "decommission": Entry("node.life", "decommission", "Reset a node and take it out of service."),
        "replace": Entry("node.life", "replace", "Replace a broken node with a spare."),
        "backup": Entry("station.backup", "backup", "Back up the whole store to a sealed file."),
        "restore": Entry("station.backup", "restore", "Restore a backup; no epoch or sequence ever goes back."),
        "vault": Entry("station.vault", "vault", "Change the passphrase or PIN, or rewrap every node key."),
        "unlock": Entry("station.vault", "unlock", "Keep the vault unlocked in memory for a while."),
        "lock": Entry("station.vault", "lock", "Lock the vault again."),
    },
    "Try it out": {
        "demo": Entry("demo", "demo", "Run two stations and a virtual node on this machine, start to finish."),
        "node": Entry("node.virtual_nodes", "node", "Create and run virtual nodes."),
    },
}


def _sections() -> dict[str, dict[str, Entry]]:
    """Return the sections of the core, and before its last one those of the rooms that are present."""
    found = {title: dict(rows) for title, rows in _CORE.items()}
    last = found.pop(_LAST)
    for name, room in rooms().items():
        for title, rows in room.sections.items():
            found.setdefault(title, {}).update({command: row._replace(room=name) for command, row in rows.items()})
    found[_LAST] = last
    for room in rooms().values():
        for rows in found.values():
            rows.update({name: rows[name]._replace(help=text) for name, text in room.helps.items() if name in rows})
    return found


SECTIONS: Final = _sections()
"""Sections of ``--help``; a name of two words is a line of help only: its first word is below as a command."""

COMMANDS: Final = {name: entry for section in SECTIONS.values() for name, entry in section.items() if " " not in name}
GROUPS: Final = frozenset(
    {"draft", "vault", "group", "trace", "trust", "config", "profile", "whitelist", "handover", "node", "ncap", "names"}
    | {"calibrate", "record"}
).union(*(room.groups for room in rooms().values()))
"""The commands that have commands of their own."""
