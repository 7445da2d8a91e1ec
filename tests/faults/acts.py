"""The changing commands that the bench cuts, and how the state that each starts from is made."""

from __future__ import annotations

from dataclasses import dataclass, replace

from tests.e2e.desk import ANGLE

UUID = "8d4d9da65281f7000000"


@dataclass(frozen=True)
class Act:
    """A changing command: from which state it starts, and what must be true when it was carried on after a cut.

    ``ends`` are the exit codes with which carrying on may end. ``proof`` is the station that must then have the node
    in its hands (none: the command gives it away), ``verdicts`` the exit codes of ``verify`` that count: 0 authentic,
    4 for a node without a datasheet; 5 and 6 mean a lost key. ``until`` is what a command that goes on says when it has
    done its work: then it gets SIGTERM. ``cuts_node``: the node is cut too, not only the station.
    ``seconds``: how long it may take. ``keys``: so many lie in the store at the end (0: not counted).
    """

    name: str
    start: str
    words: tuple[str, ...]
    node: bool = True
    home: str = "home"
    ends: tuple[int, ...] = (0,)
    proof: str = "home"
    verdicts: tuple[int, ...] = (0,)
    until: str = ""
    cuts_node: bool = True
    seconds: float = 60.0
    keys: int = 0


NO_SHEET = (0, 4)
_JOB = ("job", "new", "--title", "one", "--profile", ANGLE, "--station", "bench", "--count", "1")
_JOB += ("--ends", "2099-01-01", "--output", "{FILES}/job.jws")
_BY_OFFICE = ("job", "new", "--title", "one", "--profile", ANGLE, "--station", "lab", "--count", "1", "--sign", "bench")
_BY_OFFICE += ("--ends", "2099-01-01", "--output", "{FILES}/job.jws")
_STICK = ("--files", "{FILES}/stick")
_ASKED = ("sign", "{UUID}", "--by", "bench", "--job", "{JOB}", "--output", "{FILES}/request.jws", "TAP")
TAKEN_UP = '"verified"'
ACTS = (
    Act("whitelist add", "new", ("whitelist", "add", "{UUID}"), node=False, proof=""),
    Act("identify", "new", ("identify", "--add", "TAP"), proof=""),
    Act("agree", "listed", ("agree", "{UUID}", "TAP"), verdicts=NO_SHEET),
    Act("build", "keyed", ("build", "{UUID}", "--profile", ANGLE), node=False, verdicts=NO_SHEET),
    Act("sign", "built", ("sign", "{UUID}"), node=False, verdicts=NO_SHEET),
    Act("write", "signed", ("write", "{UUID}", "LINK")),
    Act("provision", "new", ("provision", "--profile", ANGLE, "--yes", "TAP")),
    Act("rotate", "provisioned", ("agree", "{UUID}", "--rotate", "LINK"), verdicts=NO_SHEET),
    Act("address", "provisioned", ("address", "{UUID}", "33", "LINK")),
    Act("update", "updatable", ("update", "{UUID}", "{FILES}/new.bin", "--yes", "--wait", "10", "LINK")),
    Act("reset", "provisioned", ("reset", "{UUID}", "--yes", "LINK"), proof=""),
    Act("trust add", "strangers", ("trust", "add", "crane", "{FILES}/crane.pem", "--yes"), node=False),
    Act("copy", "pair", ("export-keys", "--to", "crane", "--all", "--yes", "--output", "{FILES}/c.jwe"), node=False),
    Act(
        "move",
        "pair",
        ("export-keys", "--to", "crane", "--all", "--mode", "move", "--yes", "--output", "{FILES}/m.jwe"),
        node=False,
        proof="",
    ),
    Act(
        "import",
        "bundled",
        ("import-keys", "{FILES}/bundle.jwe", "--yes", "--no-prove"),
        node=False,
        home="other",
        proof="other",
    ),
    Act("receipt", "imported", ("handover", "receipt", "{FILES}/receipt.jws"), node=False, proof="other"),
    Act("undo", "bundled", ("handover", "undo", "{ID}", "--yes"), node=False),
    Act("backup", "provisioned", ("backup", "{FILES}/backup", "--backup-passphrase-fd", "{FD}", "--yes"), node=False),
    Act(
        "restore",
        "backed up",
        ("restore", "{FILES}/backup", "--keystore", "file", "--backup-passphrase-fd", "{FD}", "--yes"),
        node=False,
        home="fresh",
        proof="",
    ),
    Act("revoke", "provisioned", ("revoke", "{UUID}", "--why", "lost", "--yes"), node=False, proof=""),
    Act("rewrap", "provisioned", ("vault", "rewrap", "--yes"), node=False),
    Act("decommission", "provisioned", ("decommission", "{UUID}", "--yes", "LINK"), proof=""),
    Act("batch", "new", ("provision", "--batch", "{FILES}/sheet.csv", "--report", "{FILES}/report.csv", "TAP")),
    Act("group", "provisioned", ("group", "create", "hand", "{UUID}"), node=False, ends=(0, 2)),
    Act("group add", "grouped", ("group", "add", "hand", "{UUID}"), node=False),
    Act("names", "provisioned", ("names", "set", "{UUID}", "1", "crane/slew"), node=False),
    Act("lift", "revoked", ("revoke", "--lift", "{UUID}", "--yes"), node=False, ends=(0, 3), proof=""),
    Act(
        "merge",
        "behind",
        ("restore", "{FILES}/backup", "--backup-passphrase-fd", "{FD}", "--yes"),
        node=False,
    ),
    Act("passphrase", "provisioned", ("vault", "passphrase", "--new-passphrase-fd", "{FD}"), node=False),
    Act(
        "trust ca",
        "asked",
        ("trust", "ca", "sign", "{FILES}/lab.request", "--output", "{FILES}/lab.cert", "--yes"),
        node=False,
    ),
    Act("registry create", "provisioned", ("registry", "create", "--name", "plant", "--yes"), node=False, ends=(0, 6)),
    Act("registry sync", "founded", ("registry", "sync", "--files", "{FILES}/stick"), node=False),
    Act("job new", "founded", _JOB, node=False),
    Act("provision --job", "ordered", ("provision", "--job", "{FILES}/job.jws", "--yes", "TAP")),
    Act("job send", "line", ("job", "send", "{JOB}", *_STICK), node=False, proof=""),
    Act("job close", "ordered", ("job", "close", "{JOB}"), node=False, proof=""),
    Act("sign --by", "at the line", _ASKED, home="lab", proof="lab", verdicts=NO_SHEET),
    Act(
        "signer once",
        "requested",
        ("signer", "once", "{FILES}/request.jws", "--output", "{FILES}/signed.json"),
        node=False,
        proof="",
    ),
    Act(
        "write signed",
        "answered",
        ("write", "{UUID}", "--image", "{FILES}/signed.json", "LINK"),
        home="lab",
        proof="lab",
    ),
    Act("evidence export", "proven", ("evidence", "export", "{FILES}/proof"), node=False),
    Act("measure", "measured", ("measure", "hand", "--duration", "0.5", "--to", "{FILES}/run.csv", "LINK")),
    Act("zero", "calibrated", ("calibrate", "zero", "{UUID}", "1", "--value", "0.5", "LINK")),
    Act("ncap run", "measured", ("ncap", "run", "--record", "{FILES}/runs", "BUS"), until=TAKEN_UP, cuts_node=False),
)
"""Every command that changes what lies on a disk or in a node."""

MANY = 100_000
_BACKUP, _MERGE = (next(act for act in ACTS if act.name == name) for name in ("backup", "merge"))
LARGE = (
    replace(_BACKUP, name="backup of 100,000 nodes", start="many", seconds=900.0, keys=MANY + 1),
    replace(_MERGE, name="merge of 100,000 nodes", start="many behind", seconds=900.0, keys=MANY + 1),
)
"""Long ones, each cut in a few places only: a backup of very many nodes, and its merge into a store that has one."""

MIXED = (
    Act("whitelist add", "mixed", ("whitelist", "add", "{OTHER}")),
    Act("provision", "mixed", ("provision", "--profile", ANGLE, "--name", "turned", "--yes", "LINK")),
    Act("rotate", "mixed", ("agree", "{UUID}", "--rotate", "LINK"), verdicts=NO_SHEET),
    Act("build", "mixed", ("build", "{UUID}", "--profile", ANGLE, "--name", "built"), verdicts=NO_SHEET),
    Act("sign", "mixed", ("sign", "{UUID}"), verdicts=NO_SHEET),
    Act("address", "mixed", ("address", "{UUID}", "33", "LINK")),
    Act("reset", "mixed", ("reset", "{UUID}", "--yes", "LINK"), proof=""),
    Act("trust add", "mixed", ("trust", "add", "lab", "{FILES}/lab.pem", "--yes")),
    Act("trust remove", "mixed", ("trust", "remove", "crane", "--yes"), ends=(0, 3)),
    Act(
        "copy",
        "mixed",
        ("export-keys", "--to", "crane", "--all", "--yes", "--output", "{FILES}/c.jwe"),
        ends=(0, 2, 3, 6),  # 2: the key was rotated since, and the file that lies there has the older one
    ),
    Act(
        "move",
        "mixed",
        ("export-keys", "--to", "crane", "--all", "--mode", "move", "--yes", "--output", "{FILES}/m.jwe"),
        ends=(0, 3, 6),
        proof="",
    ),
    Act("backup", "mixed", ("backup", "{FILES}/b", "--backup-passphrase-fd", "{FD}", "--yes")),
    Act("merge", "mixed", ("restore", "{FILES}/backup", "--backup-passphrase-fd", "{FD}", "--yes")),
    Act("revoke", "mixed", ("revoke", "{UUID}", "--why", "lost", "--yes"), proof=""),
    Act("lift", "mixed", ("revoke", "--lift", "{UUID}", "--yes"), ends=(0, 3)),
    Act("rewrap", "mixed", ("vault", "rewrap", "--yes")),
    Act("passphrase", "mixed", ("vault", "passphrase", "--new-passphrase-fd", "{FD}")),
    Act("trust ca", "mixed", ("trust", "ca", "sign", "{FILES}/lab.request", "--output", "{FILES}/lab.cert", "--yes")),
    Act("decommission", "mixed", ("decommission", "{UUID}", "--yes", "LINK"), proof=""),
    Act("group", "mixed", ("group", "add", "hand", "{UUID}")),
    Act("names", "mixed", ("names", "set", "{UUID}", "1", "crane/slew")),
    Act("measure", "mixed", ("measure", "hand", "--duration", "0.3", "--to", "{FILES}/run.csv", "LINK")),
    Act("ncap run", "mixed", ("ncap", "run", "BUS"), until=TAKEN_UP),
)
"""Commands that may all begin in one state, for two at once."""

NEXT: dict[str, tuple[str, tuple[tuple[str, tuple[str, ...]], ...]]] = {
    # state: (from which, ((station, words), ...)); "new", "sensor" (which can be measured) and "slots" (which takes
    # firmware) are made by hand
    "listed": ("new", (("home", ("whitelist", "add", "{UUID}")),)),
    "keyed": ("listed", (("home", ("agree", "{UUID}", "TAP")),)),
    "built": ("keyed", (("home", ("build", "{UUID}", "--profile", ANGLE)),)),
    "signed": ("built", (("home", ("sign", "{UUID}")),)),
    "provisioned": ("new", (("home", ("provision", "--profile", ANGLE, "--yes", "TAP")),)),
    "updatable": ("slots", (("home", ("provision", "--profile", ANGLE, "--yes", "TAP")),)),
    "founded": ("provisioned", (("home", ("registry", "create", "--name", "plant", "--yes")),)),
    "plant": ("new", (("home", ("registry", "create", "--name", "plant", "--yes")),)),
    "ordered": ("plant", (("home", _JOB),)),
    "proven": ("ordered", (("home", ("provision", "--job", "{FILES}/job.jws", "--yes", "TAP")),)),
    "line": (
        "plant",
        (
            ("lab", ("init", "--name", "lab", "--keystore", "file", "--request", "{FILES}/lab.request")),
            ("home", ("trust", "ca", "sign", "{FILES}/lab.request", "--output", "{FILES}/lab.cert", "--yes")),
            ("lab", ("init", "--certificate", "{FILES}/lab.cert", "--yes")),
            ("lab", ("registry", "request", "--output", "{FILES}/lab.member")),
            ("home", ("registry", "add", "{FILES}/lab.member", "--role", "line", "--yes")),
            ("home", ("registry", "sync", *_STICK)),
            ("lab", ("registry", "connect", *_STICK, "--yes")),
            ("home", _BY_OFFICE),
        ),
    ),
    "at the line": (
        "line",
        (
            ("lab", ("job", "show", "{FILES}/job.jws")),
            ("lab", ("identify", "--add", "TAP")),
            ("lab", ("agree", "{UUID}", "TAP")),
            ("lab", ("build", "{UUID}", "--profile", ANGLE)),
        ),
    ),
    "requested": ("at the line", (("lab", _ASKED),)),
    "answered": (
        "requested",
        (("home", ("signer", "once", "{FILES}/request.jws", "--output", "{FILES}/signed.json")),),
    ),
    "strangers": ("provisioned", (("other", ("trust", "add", "bench", "{FILES}/bench.pem", "--yes")),)),
    "pair": ("strangers", (("home", ("trust", "add", "crane", "{FILES}/crane.pem", "--yes")),)),
    "bundled": (
        "pair",
        (
            (
                "home",
                ("export-keys", "--to", "crane", "--all", "--mode", "move", "--yes", "--output", "{FILES}/bundle.jwe"),
            ),
        ),
    ),
    "imported": (
        "bundled",
        (("other", ("import-keys", "{FILES}/bundle.jwe", "--yes", "--receipt", "{FILES}/receipt.jws", "TAP")),),
    ),
    "measured": (
        "sensor",
        (
            ("home", ("provision", "--profile", ANGLE, "--yes", "TAP")),
            ("home", ("group", "create", "hand", "{UUID}")),
        ),
    ),
    "calibrated": (
        "sensor",
        (("home", ("provision", "--profile", ANGLE, "--calibration", "{FILES}/angle.csv", "--yes", "TAP")),),
    ),
    "grouped": ("provisioned", (("home", ("group", "create", "hand", "{UUID}")),)),
    "revoked": ("provisioned", (("home", ("revoke", "{UUID}", "--why", "lost", "--yes")),)),
    "behind": ("backed up", (("home", ("whitelist", "remove", "{UUID}", "--yes")),)),
    "asked": (
        "provisioned",
        (("lab", ("init", "--name", "lab", "--keystore", "file", "--request", "{FILES}/lab.request")),),
    ),
    "mixed": (
        "measured",
        (
            ("home", ("trust", "add", "crane", "{FILES}/crane.pem", "--yes")),
            ("lab", ("init", "--name", "lab", "--keystore", "file", "--request", "{FILES}/lab.request")),
            ("home", ("backup", "{FILES}/backup", "--backup-passphrase-fd", "{FD}", "--yes")),
        ),
    ),
    "many": ("provisioned", ()),
    "many behind": ("many", (("home", ("backup", "{FILES}/backup", "--backup-passphrase-fd", "{FD}", "--yes")),)),
    "backed up": ("provisioned", (("home", ("backup", "{FILES}/backup", "--backup-passphrase-fd", "{FD}", "--yes")),)),
}
