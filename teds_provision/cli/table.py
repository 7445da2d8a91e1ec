"""Every command of the tool: where its code lives and its line in ``--help``.

The group's help is drawn from this table alone, so that ``--help`` imports no command and none of their libraries.
"""

from __future__ import annotations

from typing import Final, NamedTuple


class Entry(NamedTuple):
    """Where a command lives (module under ``teds_provision.cli``, attribute) and its one-line help."""

    module: str
    attribute: str
    help: str


SECTIONS: Final[dict[str, dict[str, Entry]]] = {
    "Set up": {
        "init": Entry("station.init", "init", "Make this base station's identity and CA key, or show them."),
        "trust": Entry("handover.trust", "trust", "Public keys of other stations and CAs that count here."),
        "profile": Entry("profile", "profile", "Datasheets by transducer type: list, show, check, new."),
        "config": Entry("station.config", "config", "What is set in config.toml and the environment: show, path."),
        "completion": Entry("station.config", "completion", "What a shell needs to complete command lines."),
        "doctor": Entry("station.doctor", "doctor", "Look at reader, CAN, keyring, clock and store: cause and fix."),
    },
    "Nodes": {
        "provision": Entry(
            "steps.provision", "provision", "All of it in one: identify, whitelist, agree, build, sign, write, verify."
        ),
        "identify": Entry(
            "steps.identify", "identify", "Wait for a tap; read UUID and key, and have the node prove it."
        ),
        "whitelist": Entry("steps.whitelist", "whitelist", "The nodes that may be keyed and written."),
        "agree": Entry("steps.agree", "agree", "Agree on a key with a node, or rotate it."),
        "build": Entry("steps.build", "build", "Build a node's datasheet from its profile and calibration."),
        "sign": Entry("steps.sign", "sign", "Sign a built datasheet; say what changes on the node."),
        "write": Entry("steps.write", "write", "Write a signed datasheet to the node's flash, commit, read back."),
        "draft": Entry("steps.history", "draft", "What was built and not written: list, drop."),
        "history": Entry("steps.history", "history", "The datasheets that a node had; write --from brings one back."),
        "verify": Entry("steps.verify", "verify", "Check a node or an image against everything the profile demands."),
        "read": Entry("steps.read", "read", "Read every TEDS of a node."),
        "reset": Entry("steps.reset", "reset", "Take a node back to factory state, with its signed receipt."),
        "address": Entry("steps.address", "address", "Give a node another CAN address."),
        "nodes": Entry("station.nodes", "nodes", "What this station knows of its nodes."),
        "label": Entry("station.nodes", "label", "A label for a board: QR code and text of UUID and fingerprint."),
        "log": Entry("station.log", "log", "The audit log, and whether its hash chain holds."),
        "trace": Entry("trace", "trace", "What --trace wrote, in words: show."),
        "show": Entry("show", "show", "Decode TEDS, images, profiles, bundles and messages."),
    },
    "Measure": {
        "measure": Entry("measure.measure", "measure", "Stream nodes or a group into files and topics, calibrated."),
        "sample": Entry("measure.values", "sample", "One reading now, verified and calibrated."),
        "set": Entry("measure.values", "set_value", "Operate an actuator within its limits; let go: safe state."),
        "mode": Entry("measure.values", "mode", "What a node claims and does."),
        "ncap": Entry("ncap.group", "ncap", "The base station as a service, with a page: run, status, open, token."),
        "group": Entry("measure.group", "group", "Measurement groups: create, add, remove, delete, list."),
        "names": Entry("measure.names", "names", "Topics under which channels are published: list, set, reset."),
    },
    "A key's life": {
        "export-keys": Entry(
            "handover.export_keys", "export_keys", "Hand node keys to another base station in a sealed bundle."
        ),
        "import-keys": Entry("handover.import_keys", "import_keys", "Take node keys over from another base station."),
        "handover": Entry("handover.pending", "handover", "Handovers under way: list, receipt, undo."),
        "revoke": Entry("handover.life", "revoke", "Ban a node's key, here and where bundles from here go."),
        "decommission": Entry("handover.life", "decommission", "Reset a node and take it out of service."),
        "replace": Entry("handover.life", "replace", "Put a spare in the place of a broken node."),
        "backup": Entry("station.backup", "backup", "Write the whole store to a sealed file."),
        "vault": Entry("station.vault", "vault", "A new passphrase or PIN; a new master key over every node key."),
        "unlock": Entry("station.unlock", "unlock", "Hold the vault open for a while, in memory alone."),
        "lock": Entry("station.unlock", "lock", "Close the vault that unlock holds open."),
        "restore": Entry("station.backup", "restore", "Bring a sealed store back; no epoch or sequence goes back."),
    },
    "Try it": {
        "demo": Entry("station.demo", "demo", "Two stations and a virtual node on this machine, start to end."),
        "node": Entry("node.group", "node", "A virtual transducer: create, run; check a board."),
    },
}

COMMANDS: Final = {name: entry for section in SECTIONS.values() for name, entry in section.items()}
GROUPS: Final = frozenset(
    {"draft", "vault", "group", "trace", "trust", "config", "profile", "whitelist", "handover", "node", "ncap", "names"}
)
"""The commands that have commands of their own."""
