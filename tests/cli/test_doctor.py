"""``doctor`` as a command: what it tells, and its exit codes."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from teds_provision.cli.station import doctor
from teds_provision.doctor.checks import Finding

from .shell import call, clean_environment, spawn


def test_every_check_has_name_result_cause_and_cure(home: Path) -> None:
    outcome = spawn("--home", home, "--json", "doctor")
    assert outcome.code == 0, outcome.out
    checks = outcome.json["checks"]
    assert all(set(check) == {"name", "result", "why", "fix", "sampled"} for check in checks)
    assert {check["result"] for check in checks} <= {"ok", "warning", "skipped"}
    assert {"python", "libraries", "clock", "store", "keyring", "can loopback"} <= {check["name"] for check in checks}
    assert "Traceback" not in outcome.err


def test_people_see_the_cure_under_each_trouble(home: Path) -> None:
    home.chmod(0o755)
    shown = call(home, "doctor")
    assert shown.code == 0
    assert f"→ chmod 700 {home}" in shown.out
    assert "warning" in shown.err


@pytest.mark.parametrize(
    ("words", "code"),
    [(("--nfc", "tty:NONE7:pn532"), 5), (("--can", "nosuch:can0"), 5)],
)
def test_a_named_link_that_fails_is_exit_5(home: Path, words: tuple[str, ...], code: int) -> None:
    outcome = call(home, "--json", "doctor", *words)
    assert outcome.code == code
    assert any(check["result"] == "failed" and check["fix"] for check in outcome.json["checks"])


def test_a_broken_store_is_exit_7_whatever_else_fails(home: Path) -> None:
    (home / "vault.json").unlink()
    assert call(home, "doctor", "--can", "nosuch:can0").code == 7


def test_it_works_before_there_is_a_station_and_makes_nothing(tmp_path: Path) -> None:
    outcome = spawn("--home", tmp_path / "none", "doctor", environment=clean_environment(HOME=str(tmp_path)))
    assert outcome.code == 0
    assert "teds-provision init" in outcome.out
    assert not (tmp_path / "none").exists()


def test_a_broken_config_stops_every_command_but_doctor(home: Path) -> None:
    (home / "config.toml").write_text("via = [")
    assert call(home, "nodes").code == 8
    checks = {check["name"]: check for check in call(home, "--json", "doctor").json["checks"]}
    assert checks["config"]["result"] == "failed"
    assert checks["store"]["result"] == "ok"
    (home / "config.toml").write_text("via = 'nfc'\nno_input = true\n[provision]\nprofile = 'load-cell'\nprofle = 1\n")
    config = {check["name"]: check for check in call(home, "--json", "doctor").json["checks"]}["config"]
    assert config["why"] == (
        f"{home / 'config.toml'}, line 5: provision has no option --profle. Did you mean 'profile'?"
    )


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('can = "socketcan:can0"\n[ncap.brokers]\nlab = "mqtts://h"\n[whitelist.add]\ndry-run = true\n', ""),
        ("[ncap.brokers]\nlab = 7\n", 'line 2: a broker is named with its URL: lab = "mqtts://HOST".'),
        ("[whitelist.add]\nbogus = true\n", "line 2: whitelist add has no option --bogus."),
        ("[ncap.runn]\nrate = 5\n", "line 1: there is no command 'ncap runn'."),
        ("passphrase-fd = 3\n", "line 1: no command has an option --passphrase-fd."),
    ],
)
def test_the_doctor_finds_what_every_command_refuses_and_nothing_else(home: Path, text: str, why: str) -> None:
    """It called brokers unknown, to be removed, and missed what stands in a table of a command of a group."""
    (home / "config.toml").write_text(text)
    checks = {check["name"]: check for check in call(home, "--json", "doctor").json["checks"]}
    config = checks["config"]
    assert (config["result"], why in config["why"]) == ("failed" if why else "ok", True)
    assert (call(home, "nodes").code == 8) == bool(why)


def test_values_that_no_command_takes_and_profiles_that_cannot_be_read_are_reported(home: Path) -> None:
    """Both were passed over: only ``config show`` and the command itself said so."""
    (home / "config.toml").write_bytes(b"\xef\xbb\xbf[provision]\ntimeout = -3\n")
    (home / "profiles").mkdir()
    (home / "profiles" / "mine.toml").write_text("x = [")
    done = call(home, "--json", "doctor")
    checks = {check["name"]: check for check in done.json["checks"]}
    assert done.code == 1
    assert (checks["config"]["result"], "provision.timeout = -3" in checks["config"]["why"]) == ("failed", True)
    assert (checks["profiles"]["result"], "profile mine" in checks["profiles"]["why"]) == ("failed", True)
    (home / "config.toml").write_bytes(b"\xff\xfe=")
    assert call(home, "--json", "nodes").json["error"]["message"].endswith("config.toml:1: the text is not UTF-8.")
    (home / "profiles" / "mine.toml").write_text('extends = "load-cell"\ntitle = "mine"\n')
    (home / "config.toml").write_text("[provision]\ntimeout = 3\n")
    assert call(home, "--json", "doctor").json["failed"] == 0


FOUND = [
    ("machine", Finding("python", "ok", "3.11.9", "nothing")),
    ("machine", Finding("clock", "warning", "It is [b]late[/b].", "Set it.")),
    ("link", Finding("can0", "failed", "It is down.", "ip link set can0 up")),
    ("link", Finding("nfc", "skipped", "No reader was named.")),
]


def test_a_terminal_shows_each_finding_in_its_colour_and_the_cure_of_trouble_below(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setattr(doctor, "examine", lambda _system: iter(FOUND))
    shown = call(home, "doctor", terminal=True)
    assert shown.code == 5
    colours = re.findall(r"\x1b\[([0-9;]+)m(ok|warning|failed|skipped) ", shown.out)
    assert colours == [("32", "ok"), ("33", "warning"), ("1;31", "failed"), ("2", "skipped")]
    plain = [line.rstrip() for line in re.sub(r"\x1b\[[0-9;]*m", "", shown.out).splitlines()]
    lines = [
        "ok       python  3.11.9",
        "warning  clock   It is [b]late[/b].",
        "         → Set it.",
        "failed   can0    It is down.",
        "         → ip link set can0 up",
        "skipped  nfc     No reader was named.",
    ]
    assert plain == lines
    assert shown.err == "1 ok, 1 warning, 1 failed, 1 skipped.\n"
    piped = call(home, "doctor")
    assert piped.out.splitlines() == [line.replace("         →", "  →") for line in lines]


def test_a_report_for_a_program_is_a_member_of_its_one_object(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "examine", lambda _system: iter(FOUND[:2]))
    monkeypatch.setattr(doctor, "build_report", lambda _system, findings, _settings, **how: {"n": len(findings)} | how)
    found = call(home, "--json", "doctor", "--report", "-", "--with-uuids").json
    assert (found["report"], found["ok"], found["warning"], len(found["checks"])) == (
        {"n": 2, "with_uuids": True},
        1,
        1,
        2,
    )
    plain = call(home, "doctor", "--report", "-")
    assert (json.loads(plain.out), plain.code) == ({"n": 2, "with_uuids": False}, 0)
