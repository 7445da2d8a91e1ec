"""The additions of plant and line to the program."""

from __future__ import annotations

from typing import Final

from teds_provision.optional_rooms import CommandRow, OptionalRoom

ROOM: Final = OptionalRoom(
    sections={
        "The plant": {
            "registry": CommandRow(
                "commands.registry",
                "registry",
                "Connect an owner's stations, so that each knows what the others did.",
            ),
        },
        "The line": {
            "job": CommandRow("commands.line", "job", "Define what a line may build, and follow its progress."),
            "signer": CommandRow("commands.line", "signer", "Sign what a line builds, as the office of a job."),
            "evidence": CommandRow("commands.line", "evidence", "List, export and verify evidence of every board."),
        },
    },
    groups=frozenset({"evidence", "job", "registry", "signer"}),
    extends={
        "demo": "commands.demo:extend",
        "export-keys": "commands.parcels:extend_export",
        "import-keys": "commands.parcels:extend_import",
        "ncap": "commands.ncap:extend",
        "nodes": "commands.nodes:extend",
        "provision": "commands.provision:extend",
        "sign": "commands.sign:extend",
    },
    hooks={
        "cli.node.names": "commands.nodes:resolve",
        "cli.node.views": "commands.nodes:VIEW",
        "doctor.checks": "doctor:registry",
        "ncap.service_part": "service:PART",
    },
)
