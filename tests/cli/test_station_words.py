"""``trust``, ``vault``, ``init``, ``doctor``: what a person sees before the question, and what a plan checks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest

from teds_provision.cli.main import cli
from teds_provision.cli.station import backup, config, doctor, handover, init, log, profile, trust, vault
from teds_provision.doctor.checks import Finding
from teds_provision.errors import UsageError, VaultError, WrongPassphraseError
from teds_provision.station.store.audit import AuditEntry
from teds_provision.trace.record import Record

from .shell import call

DIGITS, OTHER, CA = "ab" * 32, "cd" * 32, "ef" * 32


class Lock:
    """Stands for the lock of the store: writes its beginning and its end into the course of a command."""

    def __init__(self, course: list[Any], command: str) -> None:
        self.course, self.command = course, command

    def __enter__(self) -> None:
        self.course.append(("lock", self.command))

    def __exit__(self, *_: object) -> None:
        self.course.append("free")


def app_with(course: list[Any], station: Any) -> Any:
    """Return an app of this station that writes all that it prints, asks and does into the course."""
    station.lock = lambda command, _note: Lock(course, command)
    station.unlock = lambda: course.append("unlock")
    return SimpleNamespace(
        station=lambda: station,
        note=lambda text: course.append(("note", text)),
        warn=lambda text: course.append(("warn", text)),
        confirm=lambda question, *, yes: course.append(("ask", question, yes)),
        emit=lambda result, text=None: course.append((result, text)),
    )


def run(command: Any, app: Any, *words: Any, **named: Any) -> None:
    command.callback.__wrapped__(app, *words, **named)


@pytest.mark.parametrize(("fresh", "dry_run"), [(True, False), (False, False), (True, True)])
def test_a_station_is_shown_before_it_is_certified_also_with_yes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fresh: bool, dry_run: bool
) -> None:
    course: list[Any] = []
    request, cert = tmp_path / "lab.request", tmp_path / "lab.cert"
    request.write_bytes(b"request")
    monkeypatch.setattr(trust, "read_request", lambda _octets: SimpleNamespace(name="lab", station="point"))
    monkeypatch.setattr(trust, "protocol_keys", SimpleNamespace(fingerprint={"point": DIGITS, "ca": CA}.get))
    monkeypatch.setattr(trust, "spoken", lambda digits: f"spoken {digits[:2]}")
    monkeypatch.setattr(trust, "sign_request", lambda _station, wanted: wanted.name)
    monkeypatch.setattr(trust, "write_certificate", lambda name: f"certificate of {name}".encode())
    if not fresh:
        cert.write_bytes(b"certificate of lab")
    run(trust.sign, app_with(course, SimpleNamespace(ca="ca")), request, cert, True, dry_run)
    facts = {"name": "lab", "fingerprint": DIGITS, "ca": CA, "certificate": str(cert)}
    if dry_run:
        assert course == [({**facts, "plan": True}, "Plan: certify\nStation lab\n  spoken ab")]
        assert not cert.exists()
        return
    done = f"lab ({DIGITS[:16]}) is certified: {cert}. On that station: teds-provision init --certificate {cert}"
    assert course == [
        "unlock",
        ("note", "Station lab\n  spoken ab"),
        ("ask", "Certify it? Whoever holds its key can then write and rekey all of this owner's nodes.", True),
        ("lock", "trust ca sign"),
        "free",
        ({**facts, "fresh": fresh}, done if fresh else f"Nothing to do: {cert} already exists."),
    ]
    assert cert.read_bytes() == b"certificate of lab"


@pytest.mark.parametrize("dry_run", [True, False])
def test_the_file_of_a_ca_key_is_opened_by_a_plan_too(monkeypatch: pytest.MonkeyPatch, dry_run: bool) -> None:
    """A plan that is good for a wrong passphrase, or for the key of another CA, is none."""
    course: list[Any] = []
    station: Any = SimpleNamespace(ca="ca", vault="vault")
    app = app_with(course, station)
    app.ask_secret = lambda prompt: course.append(("secret", prompt)) or "words"
    monkeypatch.setattr(trust.protocol_keys, "fingerprint", lambda _ca: CA)
    monkeypatch.setattr(trust, "require_own_ca", lambda _station, *words: course.append(("checked", *words)))
    monkeypatch.setattr(trust, "import_ca", lambda _station, *words: course.append(("imported", *words)))
    run(trust.import_, app, Path("ca.pem"), dry_run=dry_run)
    if dry_run:
        ends: list[Any] = [
            ("checked", Path("ca.pem"), "words"),
            ({"fingerprint": CA, "plan": True}, f"Plan: import the CA key {CA[:16]} into this vault."),
        ]
    else:
        ends = [
            ("lock", "trust ca import"),
            ("imported", "vault", Path("ca.pem"), "words"),
            "free",
            ({"fingerprint": CA}, f"The CA key {CA[:16]} is now in this vault."),
        ]
    assert course == [("secret", "Passphrase of the CA key's file"), *ends]
    if dry_run:

        def wrong(*_: object) -> None:
            raise WrongPassphraseError("Wrong.")

        monkeypatch.setattr(trust, "require_own_ca", wrong)
        with pytest.raises(WrongPassphraseError):
            run(trust.import_, app, Path("ca.pem"), dry_run=True)


def test_each_trusted_key_is_listed_with_one_mark_and_its_origin(monkeypatch: pytest.MonkeyPatch) -> None:
    course: list[Any] = []

    def key(role: str, name: str, digits: str) -> Any:
        facts = {"fingerprint": digits * 16, "point": digits, "added": "2026-11-22T10:00:00Z"}
        return SimpleNamespace(role=role, name=name, **facts)

    records = [
        key("station", "plain", "01ab"),
        key("station", "signed", "02ab"),
        key("station", "member", "03ab"),
        key("station", "both", "04ab"),
        key("ca", "owner", "02cd"),
    ]
    certified, members = {"02ab", "04ab", "02cd"}, {"03ab" * 16, "04ab" * 16}
    station: Any = SimpleNamespace(
        name="bench",
        fingerprint=DIGITS,
        ca="ca",
        policy=SimpleNamespace(listed=lambda: records, in_roster=lambda digits: digits in members),
        identity=SimpleNamespace(certificate=lambda _ca, point: object() if point in certified else None),
    )
    monkeypatch.setattr(trust.protocol_keys, "fingerprint", lambda _ca: CA)
    run(trust.list_, app_with(course, station))
    [(found, text)] = course
    assert text.splitlines() == [
        f"this station   bench  {DIGITS[:16]}, CA {CA[:16]}",
        "station        plain  01ab01ab01ab01ab",
        "station        signed  02ab02ab02ab02ab  certified by this station's CA",
        "station        member  03ab03ab03ab03ab  member of the plant",
        "station        both  04ab04ab04ab04ab  member of the plant",
        "ca             owner  02cd02cd02cd02cd",
    ]
    assert found["own"] == {"name": "bench", "fingerprint": DIGITS, "ca": CA}
    assert [(one["name"], one.get("certified"), one.get("source")) for one in found["trusted"]] == [
        ("plain", False, "added"),
        ("signed", True, "added"),
        ("member", False, "roster"),
        ("both", True, "roster"),
        ("owner", None, None),
    ]
    assert {one["added"] for one in found["trusted"]} == {"2026-11-22T10:00:00Z"}


def test_a_certified_key_is_shown_with_its_ca(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trust.protocol_keys, "fingerprint", {"ca": CA}.get)
    monkeypatch.setattr(trust, "spoken", lambda digits: f"spoken {digits[:2]}")

    def found(name: str, digits: str, **facts: Any) -> Any:
        record = SimpleNamespace(role="station", name=name, fingerprint=digits)
        return SimpleNamespace(record=record, path=f"{name}.pem", **facts)

    certificate = SimpleNamespace(ca="ca")
    keys = [
        found("lab", DIGITS, known=True, certificate=None),
        found("mill", OTHER, known=False, certificate=certificate),
    ]
    assert trust._shown(keys).splitlines() == [
        "station lab  (lab.pem)  already trusted",
        "  spoken ab",
        "station mill  (mill.pem)",
        "  spoken cd",
        f"  certified by the CA {CA[:32]}",
    ]


@pytest.mark.parametrize("descriptor", [None, 0, 7])
def test_of_a_changed_passphrase_the_new_one_alone_comes_from_its_descriptor(
    monkeypatch: pytest.MonkeyPatch, descriptor: int | None
) -> None:
    course: list[Any] = []

    class Vault:
        description = "The vault file"

        def new_passphrase(self, ask: Any) -> Any:
            course.append(("old", ask("Old: ", False), station.use_agent))
            course.append(("new", ask("New: ", True)))
            return lambda: course.append("set")

        def refresh(self) -> None:
            course.append("refresh")

    station: Any = SimpleNamespace(
        use_agent=True,
        vault=Vault(),
        identity=SimpleNamespace(keystore="file:x"),
        audit=lambda *words: course.append(("audit", *words)),
    )
    app = app_with(course, station)
    app.home, app.ask_secret, app.ask_new = "home", lambda prompt: f"said {prompt}", lambda prompt: f"typed {prompt}"
    monkeypatch.setattr(vault, "read_line", lambda number: f"line of {number}")
    monkeypatch.setattr(vault.agent, "lock", lambda home: course.append(("forget", home)))
    run(vault.passphrase, app, descriptor, False)
    assert course == [
        ("old", "said Old: ", False),
        ("new", "typed New: " if descriptor is None else f"line of {descriptor}"),
        ("lock", "vault passphrase"),
        "refresh",
        ("forget", "home"),
        "set",
        ("audit", "vault", None, "new passphrase"),
        "free",
        (
            {"keystore": "file", "rewrapped": 0},
            "The vault file now opens with the new passphrase. Existing copies and backups keep the old one.",
        ),
    ]
    course.clear()
    run(vault.passphrase, app, descriptor, True)
    assert course == [
        ({"keystore": "file", "rewrapped": 0, "plan": True}, "Plan: change the passphrase of the file keystore.")
    ]


def test_the_command_for_the_station_with_the_ca_key_can_be_copied(home: Path, tmp_path: Path) -> None:
    path = tmp_path / "my lab.request"
    shown = call(home, "init", "--request", path).out.splitlines()
    assert shown[-1] == (
        "On the station with the CA key: teds-provision trust ca sign 'my lab.request' --output 'my lab.cert'"
    )
    assert shown[0].endswith(f": {path}.")


@pytest.mark.parametrize(
    ("left", "words"),
    [
        (None, ""),
        (0, ", unlocked for 1 more min (to lock it: teds-provision lock)"),
        (59, ", unlocked for 1 more min (to lock it: teds-provision lock)"),
        (60, ", unlocked for 2 more min (to lock it: teds-provision lock)"),
    ],
)
def test_how_long_a_vault_stays_unlocked_is_rounded_up(
    monkeypatch: pytest.MonkeyPatch, left: int | None, words: str
) -> None:
    monkeypatch.setattr(init.agent, "seconds_left", lambda _home: left)
    assert init._open_for(SimpleNamespace(home=None)) == words  # type: ignore[arg-type]


def test_only_nodes_with_notes_have_some_in_the_result_of_an_import() -> None:
    def planned(digits: str, *notes: str, **facts: Any) -> Any:
        return SimpleNamespace(node=SimpleNamespace(uuid=bytes.fromhex(digits * 10)), notes=notes, **facts)

    nodes = [
        planned("01", decision="import", why=""),
        planned("02", "Its name is taken.", "It has no pin.", decision="import", why=""),
        planned("03", decision="refused", why="it is given away"),
    ]
    ban = SimpleNamespace(uuid=bytes.fromhex("04" * 10), why="stolen")
    bundle = SimpleNamespace(sender=DIGITS, mode="copy", id="7")
    plan: Any = SimpleNamespace(
        opened=SimpleNamespace(bundle=bundle), nodes=nodes, denied=[ban], passed_over=[(ban, "it was lifted")]
    )
    assert handover.import_plan(plan) == {
        "from": DIGITS,
        "id": "7",
        "mode": "copy",
        "count": 3,
        "imported": ["01" * 10, "02" * 10],
        "refused": [{"uuid": "03" * 10, "why": "it is given away"}],
        "decisions": {"01" * 10: "import", "02" * 10: "import", "03" * 10: "refused"},
        "revoked": [{"uuid": "04" * 10, "why": "stolen"}],
        "notes": {"02" * 10: ["Its name is taken.", "It has no pin."]},
        "revocations_passed_over": [{"uuid": "04" * 10, "why": "it was lifted"}],
    }


FOREIGN = Finding("reader \x1b[2J", "warning", "It is named a\x9bb\u202ec.", "Unplug \x07it.")


@pytest.mark.parametrize(("passphrase", "asks"), [(None, False), ("four random words", True)])
def test_the_doctor_has_a_passphrase_only_if_one_was_given_and_prints_names_of_devices_harmless(
    home: Path, monkeypatch: pytest.MonkeyPatch, passphrase: str | None, asks: bool
) -> None:
    systems: list[Any] = []
    monkeypatch.setattr(doctor, "examine", lambda system: systems.append(system) or iter([("link", FOREIGN)]))
    done = call(home, "doctor", passphrase=passphrase)
    assert done.out.splitlines() == ["warning  reader ?[2J  It is named a?b?c.", "  → Unplug ?it."]
    assert (systems[0].ask is not None) is asks


def test_a_key_that_is_trusted_already_is_not_asked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    course: list[Any] = []

    def found(name: str, *, known: bool) -> Any:
        return SimpleNamespace(record=SimpleNamespace(role="station", name=name, fingerprint=DIGITS), known=known)

    keys = [found("old", known=True), found("yes", known=False), found("no", known=False)]
    monkeypatch.setattr(trust, "_candidates", lambda *_words: keys)
    monkeypatch.setattr(
        trust, "_agreed", lambda _app, key, yes: course.append((key.record.name, yes)) or key.record.name == "yes"
    )
    monkeypatch.setattr(
        trust.handover_trust, "add", lambda _station, chosen: course.append([key.record.name for key in chosen]) or 1
    )
    app = app_with(course, SimpleNamespace())
    for fingerprint, yes, agreed in ((None, False, False), (DIGITS, False, True), (None, True, True)):
        course.clear()
        run(trust.add, app, None, None, Path("keys"), "station", fingerprint, yes, False)
        assert course[:6] == [
            ("yes", agreed), ("no", agreed), "unlock", ("lock", "trust add"), ["old", "yes"], "free",
        ]  # fmt: skip
        assert course[6][1] == "Now trusted: yes."


@pytest.mark.parametrize(
    ("what", "words", "refused"),
    [
        ("name", ("bench", None), False),
        ("name", (None, None), False),
        ("name", ("", None), True),
        ("name", ("mill", "file"), True),
        ("keystore", ("bench", "keyring"), True),
        ("keystore", (None, ""), True),
        ("keystore", (None, "file"), False),
    ],
)
def test_a_station_that_is_there_differs_from_what_was_asked_for(
    what: str, words: tuple[str | None, str | None], refused: bool
) -> None:
    station: Any = SimpleNamespace(name="bench", home="/home", identity=SimpleNamespace(keystore="file"))
    if not refused:
        init._require_same(station, *words)
        return
    with pytest.raises(UsageError) as error:
        init._require_same(station, *words)
    has = {"name": "bench", "keystore": "file"}[what]
    assert error.value.message == f"/home already holds a station whose {what} is {has!r}. Nothing was changed."
    assert error.value.hint == f"Omit --{what} to show it, or choose another --home."


def test_a_plan_for_the_key_of_an_owner_is_one_for_a_station_too(home: Path, tmp_path: Path) -> None:
    path = tmp_path / "owner.pem"
    path.write_bytes(b"x")
    plan = call(home, "--json", "init", "--ca", path, "--dry-run", passphrase=None).json
    assert (plan["plan"], "public_key" in plan) == (True, False)
    assert "Nothing to do" in call(home, "init", "--dry-run", passphrase=None).out
    text = call(home, "init", "--ca", path, "--keystore", "file", "--dry-run", passphrase=None).out
    assert text.startswith(f"Plan: create the station's key, certified by the CA key of {path}, in the file keystore")


ENTRY = AuditEntry(7, "2026-11-22T10:00:00Z", "ann", "write", None, "done", {}, "ab" * 32)


@pytest.mark.parametrize(
    ("detail", "text"),
    [
        ({}, ""),
        ({"octets": 0, "retyped": False, "why": "", "none": None}, "octets 0, retyped false, why"),
        ({"key": "ab" * 32}, f"key {'ab' * 8}"),
        ({"key": "ab" * 32 + "c"}, f"key {'ab' * 32}c"),
        ({"key": "ab" * 31}, f"key {'ab' * 31}"),
        ({"path": "/" + "a" * 63}, f"path /{'a' * 63}"),
        ({"nodes": ["ö"]}, 'nodes ["ö"]'),
    ],
)
def test_the_details_of_an_entry_have_zeros_and_hashes_are_short(
    monkeypatch: pytest.MonkeyPatch, detail: dict[str, Any], text: str
) -> None:
    monkeypatch.setattr(log, "local_time", lambda at: at)
    head = "    7  2026-11-22T10:00:00Z  ann  write      -                     done"
    assert log._line(replace(ENTRY, detail=detail)) == f"{head}  {text}".rstrip()


@pytest.mark.parametrize(("columns", "width"), [(20, 40), (50, 50)])
def test_a_narrow_terminal_has_lines_of_forty_columns(
    monkeypatch: pytest.MonkeyPatch, columns: int, width: int
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(log.sys, "stdout", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr(log.shutil, "get_terminal_size", lambda: SimpleNamespace(columns=columns))
    monkeypatch.setattr(log, "wrap", lambda text, width, **_how: asked.append(width) or [text])
    log._line(ENTRY)
    assert asked == [width, width]


def test_an_empty_time_is_none(home: Path) -> None:
    assert call(home, "--json", "log", "--since", "").code == 2


@pytest.mark.parametrize(
    ("facts", "text"),
    [
        ({}, "nfc  >   x  0102"),
        ({"layer": "message"}, "nfc  > x  0102"),
        ({"sealed": True, "opened": b""}, "nfc  >   x  sealed"),
        ({"sealed": True, "opened": b"\7"}, "nfc  >   x  sealed  07"),
        ({"sealed": True}, "nfc  >   x  sealed  0102"),
        ({"identifier": 0}, "nfc  >   x  00000000 0102"),
        ({"identifier": 0x18DAF101}, "nfc  >   x  18daf101 0102"),
        ({"octets": bytes(24)}, f"nfc  >   x  {'00' * 24}"),
        ({"octets": bytes(25)}, f"nfc  >   x  {'00' * 24}…"),
        ({"command": "a\x1b[2J"}, "nfc  >   a?[2J  0102"),
    ],
)
def test_the_line_of_a_frame(facts: dict[str, Any], text: str) -> None:
    record = Record(**{
        "time": 1.0, "direction": "out", "link": "nfc", "layer": "frame", "octets": b"\1\2", "command": "x",
    } | facts)  # fmt: skip
    [line] = log._lines(iter([record]), whole=False)
    assert line.partition(" ")[2] == text
    [whole] = log._lines(iter([record]), whole=True)
    assert whole.endswith("…") is False


@pytest.mark.parametrize(
    ("demand", "text"),
    [
        ({}, ""),
        ({"required": True, "method": "table", "monotone": "rising"}, "required, table, rising"),
        ({"monotone": "either"}, "monotone"),
        ({"monotone": "falling", "interval": 365 * 86_400.0}, "falling, every 365 d"),
        ({"interval": 1.75 * 86_400}, "every 2 d"),
    ],
)
def test_what_a_type_demands_of_a_calibration(demand: dict[str, Any], text: str) -> None:
    usual = {"required": False, "method": None, "monotone": None, "interval": None}
    assert profile._demand(usual | demand) == text


def test_mistakes_in_a_profile_are_counted_for_people_who_see_them_above(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('extends = "load-cell"\ntitle = "Mine"\n')
    where = SimpleNamespace(file="mine.toml", line=2)

    class Problem(SimpleNamespace):
        def __str__(self) -> str:
            return f"mine.toml:{self.where.line}: {self.message}"

    wrong = [Problem(where=where, field="x", message=f"mistake {n}", severity="error") for n in (1, 2, 3)]
    odd = Problem(where=where, field="x", message="odd", severity="warning")
    monkeypatch.setattr(profile, "check_profile", lambda _path, _folders: (None, [odd, *wrong]))
    people = call(home, "profile", "check", file)
    assert (people.code, "Error: mine.toml:2: mistake 1 (2 more, listed above)" in people.err) == (8, True)
    assert people.err.startswith("warning: mine.toml:2: odd\nerror: mine.toml:2: mistake 1\n")
    assert call(home, "--json", "profile", "check", file).json["error"]["message"] == "mine.toml:2: mistake 1"
    monkeypatch.setattr(profile, "check_profile", lambda _path, _folders: (None, wrong[:1]))
    assert "(" not in call(home, "profile", "check", file).err
    monkeypatch.setattr(profile, "check_profile", lambda _path, _folders: (None, [odd]))
    good = call(home, "--json", "profile", "check", file).json["profiles"]
    assert good == [
        {
            "name": "mine",
            "file": str(file),
            "ok": True,
            "problems": [{"file": "mine.toml", "line": 2, "field": "x", "message": "odd", "severity": "warning"}],
        }
    ]


def test_a_setting_is_that_of_the_first_command_that_takes_it_or_takes_several(home: Path) -> None:
    """``ble`` is one adapter for most commands and several for ``ncap run``; a number may be one of several values."""
    (home / "config.toml").write_text("[measure]\nchannel = 2\n")
    assert call(home, "config", "show").code == 0
    root = click.Context(cli)
    for name, several, wanted in (
        ("ble", False, ("provision", False)),
        ("ble", True, ("ncap run", True)),
        ("can", False, ("provision", True)),
        ("show.channel", False, ("show", False)),
        ("trust.add.role", False, ("trust add", False)),
        ("timeout", True, ("provision", False)),
    ):
        found = config._parameter(root, name, several=several)
        assert found is not None
        assert (found[0], found[2].multiple) == wanted, (name, several)
    named = config._parameter(root, "measure.can")
    assert named is not None
    assert (named[0], config._parameter(root, "measure.none")) == ("measure", None)


def test_settings_of_the_environment_are_listed_by_name(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("TIMEOUT", "NFC", "CAN"):
        monkeypatch.setenv(f"TEDS_PROVISION_{name}", "7")
    shown = call(home, "--json", "config", "show").json["settings"]
    assert [setting["name"] for setting in shown if setting["source"].startswith("environment")] == [
        "can", "nfc", "timeout",
    ]  # fmt: skip


@pytest.mark.parametrize("dry_run", [True, False])
def test_a_backup_that_was_opened_is_closed_however_the_command_ends(
    monkeypatch: pytest.MonkeyPatch, dry_run: bool
) -> None:
    course: list[Any] = []
    content: Any = SimpleNamespace(
        name="north", created="now", station=DIGITS, age_days=lambda: 3, close=lambda: course.append("content closed")
    )
    present: Any = SimpleNamespace(close=lambda: course.append("station closed"))
    app = app_with(course, SimpleNamespace())
    app.home, app.closing = Path("home"), lambda close: close()
    monkeypatch.setattr(backup, "_open", lambda *_words: content)
    monkeypatch.setattr(backup, "_asker", lambda *_words: None)
    monkeypatch.setattr(backup, "open_present", lambda *_words: present)
    monkeypatch.setattr(backup, "_merge", lambda *_words, yes, dry_run: course.append((yes, dry_run)))
    run(backup.restore, app, Path("b"), None, None, None, True, dry_run)
    assert course == ["content closed", "station closed", (True, dry_run)]


@pytest.mark.parametrize(
    ("error", "hint"),
    [
        (WrongPassphraseError("Wrong."), ""),
        (
            VaultError("It is no key."),
            "A recovery key is an encrypted PEM file: openssl genpkey -algorithm EC -pkeyopt "
            "ec_paramgen_curve:P-256 -aes256 -out recovery.pem",
        ),
    ],
)
def test_a_recovery_key_that_is_none_says_how_to_make_one_and_a_wrong_passphrase_is_one(
    monkeypatch: pytest.MonkeyPatch, error: VaultError, hint: str
) -> None:
    def read(*_words: object) -> None:
        raise error

    monkeypatch.setattr(backup, "SealedFile", lambda _file: SimpleNamespace(is_for_key=True))
    monkeypatch.setattr(backup, "read_ca", read)
    with pytest.raises(type(error)) as failed:
        backup._open(Path("b"), Path("key.pem"), lambda prompt, _confirm: prompt)
    assert (failed.value.message, failed.value.hint) == (error.message, hint)
    with pytest.raises(UsageError) as refused:
        backup._open(Path("b"), None, lambda prompt, _confirm: prompt)
    assert refused.value.hint == "Pass it with --recovery-key PEM."
