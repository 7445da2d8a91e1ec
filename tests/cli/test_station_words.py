"""``trust``, ``vault``, ``init``, ``doctor``: what a person sees before the question, and what a plan checks."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.cli.station import doctor, handover, init, trust, vault
from teds_provision.doctor.checks import Finding
from teds_provision.errors import WrongPassphraseError

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
