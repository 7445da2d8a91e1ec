"""A station whose keys lie in a real gnome-keyring: init, doctor, backup, a lost keyring, restore."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.vault.test_keyring_vault import Session

pytestmark = pytest.mark.system

RUN = """
import os
from teds_provision.__main__ import main
import teds_provision.cli.main
def program(*words, passphrase=None):  # in a child that has imported the program already
    command = ["teds-provision", "--json", "--home", str(home / "station")]
    read, write = os.pipe()
    if passphrase:
        os.write(write, passphrase.encode() + b"\\n")
        command += ["--passphrase-fd", str(read)]
    os.close(write)
    answer, stdout = os.pipe()
    if not (child := os.fork()):
        os.dup2(stdout, 1)
        os.close(stdout)
        os.close(answer)
        sys.argv = [*command, *words]
        main()
    os.close(read)
    os.close(stdout)
    with os.fdopen(answer) as printed:
        text = printed.read()
    return [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), json.loads(text)]
"""
WORDS = "four random words here"


@pytest.fixture
def session(tmp_path: Path) -> Session:
    made = Session.of_user(tmp_path / "user")
    made.environment["PYTHONPATH"] = str(Path(__file__).parents[2])
    return made


def run(session: Session, lines: str, **options: Any) -> dict[str, Any]:
    return session.run(RUN + lines, **options)


def test_the_whole_life_of_a_station_with_a_keyring(session: Session) -> None:
    outcomes = run(
        session,
        f"""
made, again = program("init"), program("init")
doctor = program("doctor")
backup = program("backup", str(home / "b"), passphrase={WORDS!r})
say(made=made, again=again, doctor=doctor, backup=backup)
""",
    )
    (code, made), (_, again) = outcomes["made"], outcomes["again"]
    assert (code, made["keystore"], made["why"]) == (0, "keyring", "an OS keyring is available")
    assert again == made
    results = {check["name"]: check["result"] for check in outcomes["doctor"][1]["checks"]}
    assert (outcomes["doctor"][0], results["keyring"], results["vault"]) == (0, "ok", "ok")
    assert results["seals"] == "ok", "a keyring asks nobody for a passphrase"
    assert outcomes["backup"][0] == 0
    assert [path.name for path in (session.home / "station").iterdir() if "vault" in path.name] == []

    locked = run(session, 'say(doctor=program("doctor"), backup=program("backup", str(home / "c")))', password=None)
    assert (locked["doctor"][0], locked["backup"][0]) == (7, 7)
    assert not (session.home / "c").exists()

    (session.home / "data" / "keyrings" / "login.keyring").unlink()  # the keyring is lost, the store is not
    restored = run(
        session,
        f"""
lost = program("backup", str(home / "c"), passphrase={WORDS!r})
back = program("restore", str(home / "b"), passphrase={WORDS!r})
say(lost=lost, back=back, doctor=program("doctor"), backup=program("backup", str(home / "c"), passphrase={WORDS!r}))
""",
    )
    assert restored["lost"][0] == 7
    assert (restored["back"][0], restored["back"][1]["action"]) == (0, "nothing")
    assert restored["doctor"][0] == 0
    assert restored["backup"][0] == 0


def test_a_keyring_station_comes_back_on_a_machine_without_a_keyring(session: Session, tmp_path: Path) -> None:
    results = run(
        session, f'say(made=program("init"), backup=program("backup", str(home / "b"), passphrase={WORDS!r}))'
    )
    words = tmp_path / "words"
    words.write_text(WORDS + "\n")
    command = f"{sys.executable} -m teds_provision --json --home {tmp_path / 'new'} --passphrase-fd 3 restore"
    environment = {**session.environment, "DBUS_SESSION_BUS_ADDRESS": f"unix:path={tmp_path}/no-bus"}
    done = subprocess.run(
        ["bash", "-c", f"{command} {session.home / 'b'} 3<{words}"],
        capture_output=True,
        text=True,
        env=environment,
        check=True,
        timeout=60,
    )
    record = json.loads(done.stdout)
    assert (record["action"], record["keystore"]) == ("rebuilt", "file")
    assert record["station"] == results["made"][1]["fingerprint"]
