"""The changing commands of the pair bench, and what must hold after each: written once, beside every long run.

A change that exits 0 must have taken effect, and one that does not must have left the store as it was: ``done`` looks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from tests.pairs.scene import ABSENT, NEW_PASSPHRASE, NODES, REVOKED, Outcome, Scene

MEASURING: Final = ("ncap run", "measure")
PROVISIONING: Final = ("provision --watch", "provision --batch", "provision --all")
PLANT: Final = ("signer run", "registry sync")
EVERY: Final = (*MEASURING, *PROVISIONING, *PLANT)
Looks = Callable[[Scene], bool]


@dataclass(frozen=True)
class Change:
    """One changing command.

    ``beside``: the long runs that make a cell with it. ``done``: True if its effect is in the store.
    ``leaves``: the nodes that may no longer be measured then; ``touches``: those that may be interrupted.
    ``refused``: the exit code if a measurement holds what it changes (None: it is never refused).
    ``verdicts``: the exit code of ``verify`` for a node afterwards, 0 for those not named. ``again``: how it may end
    when it is repeated. ``ends``: the exit codes of a long run that the change ends, by the name of the run.
    ``locks_out``: a long run that begins beside it may find its passphrase replaced, and do nothing (7).
    ``after`` takes note of what the change did; ``edit`` changes a file, in place of a command.
    """

    name: str
    words: tuple[str, ...]
    beside: tuple[str, ...]
    done: Looks
    leaves: tuple[str, ...] = ()
    touches: tuple[str, ...] = ()
    refused: int | None = None
    verdicts: Mapping[str, int] = field(default_factory=dict)
    again: tuple[int, ...] = (0,)
    ends: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    locks_out: bool = False
    after: Callable[[Scene, Outcome], None] | None = None
    edit: Callable[[Scene], None] | None = None


# -- looking into the store by the commands that show it --------------------------------------------------------------


def _node(scene: Scene, name: str) -> dict[str, Any]:
    nodes = scene.ask("nodes")["nodes"]
    return next((dict(node) for node in nodes if node["uuid"] == NODES.get(name, name)), {})


def _is(name: str, key: str, value: object) -> Looks:
    return lambda scene: bool(_node(scene, name).get(key) == value)


def _trusts(name: str, wanted: bool = True) -> Looks:
    return lambda scene: (name in {row["name"] for row in scene.ask("trust", "list")["trusted"]}) is wanted


def _listed(uuid: str, wanted: bool = True) -> Looks:
    return lambda scene: (uuid in {row["uuid"] for row in scene.ask("whitelist", "list")["whitelist"]}) is wanted


def _group(name: str, *members: str) -> Looks:
    """Return a look at a group; without members it must not exist."""
    wanted = {NODES[member] for member in members} or None

    def look(scene: Scene) -> bool:
        groups = {group["name"]: set(group["uuids"]) for group in scene.ask("group", "list")["groups"]}
        return groups.get(name) == wanted

    return look


def _file(name: str) -> Looks:
    return lambda scene: (scene.files / name).exists()


def _holds_values(name: str) -> Looks:
    """Return a look at a recording; one of a refused measurement may be there, without a value."""
    return lambda scene: (scene.files / name).exists() and '"event":"data"' in (scene.files / name).read_text()


def _drop_empty_recording(scene: Scene, ended: Outcome) -> None:
    """Remove the recording of a refused measurement: the same command would refuse to write over it."""
    if ended.code:
        (scene.files / "hand.jsonl").unlink(missing_ok=True)


def _counts(query: str, wanted: int = 1) -> Looks:
    return lambda scene: scene.count(query) >= wanted


def _banned(uuid: str, wanted: bool) -> Looks:
    return lambda scene: bool(_node(scene, uuid).get("revoked")) is wanted


def _set(name: str, value: object) -> Looks:
    def look(scene: Scene) -> bool:
        shown = scene.ask("config", "show")["settings"]
        return any(row["name"] == name and row["value"] == value for row in shown)

    return look


def _keeps_new_passphrase(scene: Scene, ended: Outcome) -> None:
    if ended.code == 0:
        scene.passphrases["bench"] = NEW_PASSPHRASE


def _opens(scene: Scene) -> bool:
    """Return True if the new passphrase opens the vault."""
    before = scene.passphrases["bench"]
    scene.passphrases["bench"] = NEW_PASSPHRASE
    opened = scene.run("export-keys", "--to", "crane", "{SPARE}", "--yes", "--output", "{FILES}/probe.jwe").code == 0
    scene.passphrases["bench"] = before
    return opened


def _rename_in_sheet(scene: Scene) -> None:
    sheet = scene.files / "sheet.csv"
    if not sheet.exists():  # the long run has not begun, and writes it then
        return
    sheet.write_text(sheet.read_text().replace(",second,", ",renamed,"))


def _follows_sheet(scene: Scene) -> bool:
    """Run the sheet again; returns True if the second board has the name that the sheet gives it now."""
    _rename_in_sheet(scene)
    board = scene.tap("second")
    try:
        again = scene.run("provision", "--batch", "{FILES}/sheet.csv", "--yes", "TAP", "--timeout", "20")
    finally:
        scene.cut(board)
    return again.code == 0 and _node(scene, "second")["name"] == "renamed"


def _member(name: str, wanted: bool = True) -> Looks:
    return lambda scene: (name in {row["name"] for row in scene.ask("registry", "status")["members"]}) is wanted


_MEMBERS_OF_HAND = ("target", "bystander", "handed")
_CALIBRATED = ("--calibration", "{FILES}/angle.csv")
_ANGLE_TO = ("--profile", "{ANGLE}", *_CALIBRATED)

CHANGES: Final = (
    Change("trust add", ("trust", "add", "mast", "{FILES}/mast.pem", "--yes"), EVERY, _trusts("mast")),
    Change(
        "trust remove",
        ("trust", "remove", "crane", "--yes"),
        (*MEASURING, "provision --all", "signer run"),
        _trusts("crane", False),
        leaves=("handed",),
        verdicts={"handed": 4},
        ends={"measure": (0, 4), "provision --all": (0, 6)},  # what is not authentic is not finished, for --all
        again=(0, 3),
    ),
    Change("whitelist add", ("whitelist", "add", ABSENT), EVERY, _listed(ABSENT)),
    Change(
        "whitelist remove",
        ("whitelist", "remove", "{TARGET}", "--yes"),
        (*MEASURING, "provision --watch", "provision --all", "signer run"),
        _listed(NODES["target"], False),
        leaves=("target",),
        ends={"measure": (0, 6)},
    ),
    Change(
        "revoke",
        ("revoke", "{TARGET}", "--why", "stolen", "--yes"),
        (*MEASURING, "provision --watch", "provision --all", *PLANT),
        _banned("target", True),
        leaves=("target",),
        verdicts={"target": 4},
        ends={"measure": (0, 4, 6)},
    ),
    Change("revoke --lift", ("revoke", "--lift", REVOKED, "--yes"), (*MEASURING, "provision --all", *PLANT),
           _banned(REVOKED, False), again=(0, 3)),
    Change(
        "replace",
        ("replace", "{TARGET}", "{SPARE}", "--yes"),
        (*MEASURING, "provision --all", "signer run"),
        _is("spare", "name", "target"),
        leaves=("target",),
        refused=6,
        ends={"measure": (0, 6)},
    ),
    Change(
        "decommission",
        ("decommission", "{TARGET}", "--yes", "BUS"),
        (*MEASURING, "provision --watch", "provision --all", "signer run"),
        lambda scene: bool(_node(scene, "target").get("retired")),
        leaves=("target",),
        refused=6,
        verdicts={"target": 4},
        ends={"measure": (0, 5, 6)},
    ),
    Change("group add", ("group", "add", "hand", "{SPARE}"), (*MEASURING, "provision --watch", "provision --all"),
           _group("hand", *_MEMBERS_OF_HAND, "spare"), refused=6),
    Change("group remove", ("group", "remove", "hand", "{TARGET}"), (*MEASURING, "provision --batch"),
           _group("hand", "bystander", "handed"), leaves=("target",), refused=6),
    Change("group delete", ("group", "delete", "hand"), MEASURING, _group("hand"),
           leaves=_MEMBERS_OF_HAND, refused=6, again=(0, 3), ends={"measure": (0, 3), "ncap run": (0, 3)}),
    Change("group create", ("group", "create", "pair", "{SPARE}"), (*MEASURING, "provision --all"),
           _group("pair", "spare"), again=(0, 2)),
    Change("names set", ("names", "set", "{TARGET}", "1", "crane/slew"), (*MEASURING, "provision --all"),
           lambda scene: "crane/slew" in str(scene.ask("names", "list")), refused=6, touches=("target",)),
    Change("config set", ("config", "set", "rate", "5"), EVERY, _set("rate", 5.0)),
    Change("vault passphrase", ("vault", "passphrase", "--new-passphrase-fd", "{NEW_FD}"), EVERY,
           _opens, after=_keeps_new_passphrase, ends={"signer run": (0, 7, 130)}, locks_out=True),
    Change("vault rewrap", ("vault", "rewrap", "--yes"), EVERY, lambda scene: True,
           ends={"provision --watch": (0, 7, 130), "signer run": (0, 7, 130), "registry sync": (0, 7)}),
    Change("agree --rotate", ("agree", "{TARGET}", "--rotate", "BUS"),
           (*MEASURING, "provision --watch", "provision --all", "signer run"),
           lambda scene: int(_node(scene, "target")["epoch"]) >= 2, touches=("target",), refused=6,
           ends={"measure": (0, 4, 5, 6)}),
    Change("write --from", ("write", "{TARGET}", "--from", "1", "--yes", "BUS"),
           (*MEASURING, "provision --watch", "provision --all"),
           lambda scene: True, touches=("target",), refused=6, again=(0, 6)),
    Change("provision", ("provision", "{TARGET}", "--name", "renamed", "--yes", "BUS"),
           (*MEASURING, "provision --watch", "provision --all", "signer run"),
           _is("target", "name", "renamed"), touches=("target",), refused=6, again=(0, 6)),
    Change("calibrate zero", ("calibrate", "zero", "{TARGET}", "1", "--value", "1.0", "--yes", "BUS"),
           (*MEASURING, "provision --all"),
           lambda scene: int(_node(scene, "target")["sequence"]) >= 2, touches=("target",), refused=6),
    Change("address", ("address", "{TARGET}", "33", "BUS"), (*MEASURING, "provision --all"),
           _is("target", "can_address", 33), touches=("target",), refused=6),
    Change("export-keys copy", ("export-keys", "--to", "crane", "{TARGET}", "--yes", "--output", "{FILES}/c.jwe"),
           (*MEASURING, "provision --all", *PLANT), _file("c.jwe"), again=(0, 2)),
    Change("export-keys move",
           ("export-keys", "--to", "crane", "{TARGET}", "--mode", "move", "--yes", "--output", "{FILES}/m.jwe"),
           (*MEASURING, "provision --watch", "signer run"), _file("m.jwe"), leaves=("target",), refused=6,
           again=(0, 3, 6), ends={"measure": (0, 6)}),
    Change("import-keys", ("import-keys", "{FILES}/bundled.jwe", "--yes", "--no-prove"),
           EVERY, lambda scene: bool(_node(scene, "bundled").get("keys"))),
    Change("backup", ("backup", "{FILES}/b", "--backup-passphrase-fd", "{NEW_FD}", "--yes"), EVERY, _file("b"),
           again=(0, 2)),
    Change("restore", ("restore", "{FILES}/backup", "--backup-passphrase-fd", "{NEW_FD}", "--yes"),
           (*MEASURING, "provision --watch", "provision --all", "signer run"), lambda scene: True),
    Change("measure", ("measure", "{SPARE}", "--duration", "0.5", "--to", "{FILES}/spare.csv", "BUS"),
           (*MEASURING, "provision --all"), _file("spare.csv"), again=(0, 2)),
    Change("measure GROUP",
           ("measure", "hand", "--duration", "1", "--to", "{FILES}/hand.jsonl", "--timeout", "3", "BUS"),
           (*MEASURING, "provision --all"), _holds_values("hand.jsonl"), refused=6, touches=_MEMBERS_OF_HAND,
           again=(0, 2), after=_drop_empty_recording),
    Change("set", ("set", "{GRIPPER}", "1", "0.01", "--hold", "0.3", "BUS"), (*MEASURING, "provision --all"),
           lambda scene: True),
    Change("identify --add", ("identify", "--add", "--via", "can", "--can", "{CAN}"),
           ("ncap run",), lambda scene: True),
    Change("token add", ("ncap", "token", "add", "robot"), ("ncap run", "provision --watch"),
           lambda scene: "robot" in str(scene.ask("ncap", "token", "list")), again=(0, 2)),
    Change("draft", ("build", "{TARGET}", *_ANGLE_TO, "--name", "drafted"),
           (*MEASURING, "provision --all"), lambda scene: bool(scene.ask("draft", "list")["drafts"])),
    Change("edit of the sheet", (), ("provision --batch",), _follows_sheet, edit=_rename_in_sheet),
    Change("registry sync", ("registry", "sync", "--files", "{FILES}/stick"), ("signer run",),
           _counts("SELECT count(*) FROM pages")),
    Change("registry add", ("registry", "add", "{FILES}/guest.member", "--role", "base", "--yes"), PLANT,
           _member("guest")),
    Change("registry remove", ("registry", "remove", "line", "--retired", "--yes"), PLANT, lambda scene: True,
           ends={"registry sync": (0, 6), "the line": (0, 5, 6)}),
    Change("job close", ("job", "close", "{JOB}"), PLANT, lambda scene: True,
           ends={"signer run": (0, 6, 130), "the line": (0, 5, 6)}),
    Change("job new",
           ("job", "new", "--title", "more", "--profile", "{ANGLE}", "--station", "line", "--count", "1", "--ends",
            "2099-01-01", "--output", "{FILES}/more.jws"), PLANT, _file("more.jws"), again=(0, 2)),
)  # fmt: skip
