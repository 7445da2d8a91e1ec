"""The keyring vault: what is refused, and a real gnome-keyring under its own D-Bus session."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest
from keyring.errors import InitError, KeyringLocked, NoKeyringError

from teds_provision.errors import KeyringUnavailableError, UsageError, VaultError
from teds_provision.vault import keyring_vault, selection
from teds_provision.vault.keyring_vault import KeyringVault
from teds_provision.vault.passphrase import THROWAWAY
from teds_provision.vault.selection import create_vault, forget_vaults, open_vault, plan_vault

STORE = "5e" * 16
CHAINER = "keyring.backends.chainer.ChainerBackend"
GOOD = "four random words here"
NOT_ALLOWED = [
    "keyring.backends.null.Keyring",
    "keyring.backends.fail.Keyring",
    "keyrings.alt.file.PlaintextKeyring",
    "keyrings.alt.file.EncryptedKeyring",
    "keyrings.cryptfile.cryptfile.CryptFileKeyring",
    "nonsense",
]


def ask(prompt: str, confirm: bool) -> str:
    return GOOD


def never(prompt: str, confirm: bool) -> str:
    pytest.fail("a keyring needs no passphrase from us")


@pytest.fixture(autouse=True)
def _no_bus(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Yield whatever keyring the person who runs the tests has, it is none of ours."""
    forget_vaults()
    monkeypatch.setenv("DBUS_SESSION_BUS_ADDRESS", f"unix:path={tmp_path}/no-bus")
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("PYTHON_KEYRING_BACKEND", "XDG_CONFIG_HOME", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    yield
    forget_vaults()


@pytest.mark.parametrize("name", NOT_ALLOWED)
def test_a_backend_that_may_not_hold_a_secret_is_refused(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv("PYTHON_KEYRING_BACKEND", name)
    with pytest.raises(KeyringUnavailableError, match=name.replace(".", r"\.")) as caught:
        KeyringVault.create(STORE)
    assert "--keystore file" in caught.value.hint
    assert caught.value.exit_code == 7
    with pytest.raises(KeyringUnavailableError):
        open_vault(Path("unused"), STORE, "keyring", never)


@pytest.mark.parametrize("name", NOT_ALLOWED)
def test_the_same_backend_named_in_the_configuration_file_is_refused(tmp_path: Path, name: str) -> None:
    place = tmp_path / ".config" / "python_keyring"
    place.mkdir(parents=True)
    (place / "keyringrc.cfg").write_text(f"[backend]\ndefault-keyring={name}\n")
    with pytest.raises(KeyringUnavailableError, match=name.replace(".", r"\.")):
        KeyringVault.create(STORE)


def test_an_unreadable_configuration_file_is_not_ignored(tmp_path: Path) -> None:
    place = tmp_path / ".config" / "python_keyring"
    place.mkdir(parents=True)
    (place / "keyringrc.cfg").write_bytes(b"default-keyring=\xff\xfe\n")
    with pytest.raises(KeyringUnavailableError, match=r"keyringrc\.cfg"):
        KeyringVault.create(STORE)


@pytest.mark.parametrize("name", [None, "keyring.backends.chainer.ChainerBackend"])
def test_a_machine_without_a_keyring_says_so(monkeypatch: pytest.MonkeyPatch, name: str | None) -> None:
    if name:
        monkeypatch.setenv("PYTHON_KEYRING_BACKEND", name)
    with pytest.raises(KeyringUnavailableError, match="no keyring"):
        KeyringVault.create(STORE)
    with pytest.raises(KeyringUnavailableError, match="no keyring"):
        KeyringVault.open(STORE)


def test_a_backend_that_forgets_is_found_out_before_a_key_is_trusted_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    forgetful = "keyring.backends.null.Keyring"
    monkeypatch.setenv("PYTHON_KEYRING_BACKEND", forgetful)
    monkeypatch.setitem(keyring_vault.ALLOWED, forgetful, "forgetful")
    monkeypatch.setattr("keyring.backends.null.Keyring.priority", 1)
    given: list[str] = []
    monkeypatch.setattr("keyring.backends.null.Keyring.set_password", lambda _, __, entry, ___: given.append(entry))
    with pytest.raises(VaultError, match="did not store"):
        KeyringVault.create(STORE)
    assert [entry.partition("/")[0] for entry in given] == ["probe"]


def test_without_a_keyring_init_takes_the_passphrase_file_and_says_why(tmp_path: Path) -> None:
    vault, why = create_vault(tmp_path, STORE, None, ask, costs=THROWAWAY)
    assert vault.kind == "file"
    assert "no OS keyring: this machine has no keyring" in why
    again, why = create_vault(tmp_path, STORE, None, ask)
    assert (again.identity().point, why) == (vault.identity().point, "the passphrase file already exists")


def test_a_forbidden_backend_is_named_in_the_reason(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PYTHON_KEYRING_BACKEND", "keyring.backends.null.Keyring")
    vault, why = create_vault(tmp_path, STORE, None, ask, costs=THROWAWAY)
    assert vault.kind == "file"
    assert "keyring.backends.null.Keyring" in why


@pytest.mark.parametrize(
    ("keystore", "file", "works", "planned"),
    [
        (None, False, True, ("keyring", "an OS keyring is available")),
        (None, False, False, ("file", "no OS keyring: it is locked")),
        (None, True, True, ("file", "the passphrase file already exists")),
        ("keyring", True, True, ("keyring", "as requested")),
        ("keyring", False, False, None),
        ("file", False, True, ("file", "as requested")),
        ("pkcs11:token=bench", False, False, ("pkcs11:token=bench", "as requested")),
    ],
)
def test_a_plan_chooses_the_keyring_that_works_else_a_passphrase_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keystore: str | None, file: bool, works: bool, planned: Any
) -> None:
    def inspect() -> str:
        if not works:
            raise KeyringUnavailableError("It is locked.")
        return "a keyring"

    monkeypatch.setattr(selection.keyring_vault, "inspect", inspect)
    if file:
        (tmp_path / "vault.json").write_text("{}")
    if planned is None:
        with pytest.raises(KeyringUnavailableError):
            plan_vault(tmp_path, keystore)
    else:
        assert plan_vault(tmp_path, keystore) == planned
    with pytest.raises(UsageError, match="There is no keystore 'x'"):
        plan_vault(tmp_path, "x")


class MemoryKeyring:
    """A keyring of two processes at once: each opens it, and both write."""

    def __init__(self) -> None:
        self.entries: dict[tuple[str, str], str] = {}

    def get_password(self, service: str, entry: str) -> str | None:
        return self.entries.get((service, entry))

    def set_password(self, service: str, entry: str, line: str) -> None:
        self.entries[service, entry] = line

    def delete_password(self, service: str, entry: str) -> None:
        del self.entries[service, entry]


def test_what_is_written_is_made_from_what_is_in_the_keyring_now(monkeypatch: pytest.MonkeyPatch) -> None:
    """The CA key was dropped by writing back what was read before another process changed the master key."""
    name = f"{MemoryKeyring.__module__}.{MemoryKeyring.__qualname__}"
    backend = MemoryKeyring()
    monkeypatch.setitem(keyring_vault.ALLOWED, name, "a keyring in memory")
    monkeypatch.setattr(keyring_vault, "_viable", lambda: iter([(name, backend)]))
    vault = KeyringVault.create(STORE)
    other = KeyringVault.open(STORE)
    wrapped = vault.wrap(bytes(16), context=b"x")
    other.add_master()
    assert vault.drop_ca()
    vault.add_master()
    now = KeyringVault.open(STORE)
    assert (now.masters(), now.ca()) == ((1, 2, 3), None)
    assert now.unwrap(wrapped, context=b"x") == bytes(16)
    assert other.refresh()
    assert not other.refresh()
    assert not other.drop_ca(), "it is gone already"
    backend.entries.clear()
    with pytest.raises(VaultError, match="no longer has"):
        other.add_master()
    assert backend.entries == {}


def test_a_keyring_that_has_an_entry_is_not_tried_out_and_takes_in_the_keys_of_a_backup(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name, backend = f"{MemoryKeyring.__module__}.{MemoryKeyring.__qualname__}", MemoryKeyring()
    tried: list[str] = []
    monkeypatch.setitem(keyring_vault.ALLOWED, name, "a keyring in memory")
    monkeypatch.setattr(keyring_vault, "_viable", lambda: iter([(name, backend)]))
    monkeypatch.setattr(keyring_vault, "_probe", lambda probed, _backend: tried.append(probed))
    vault = KeyringVault.create(STORE)
    assert tried == [name]
    backup, old = vault.secret_material(), vault.wrap(b"o" * 16, context=b"c")
    vault.add_master()
    vault.retire_masters()
    new = vault.wrap(b"n" * 16, context=b"c")
    lines = dict(backend.entries)
    KeyringVault.create(STORE)
    assert (tried, backend.entries) == ([name], lines), "nothing is written that is there already"
    KeyringVault.create(STORE, restored=backup)
    again = KeyringVault.open(STORE)
    assert tried == [name]
    assert [again.unwrap(wrapped, context=b"c") for wrapped in (old, new)] == [b"o" * 16, b"n" * 16]


class BrokenKeyring(MemoryKeyring):
    """A keyring that answers nothing, for a reason of its own."""

    def __init__(self, error: Exception) -> None:
        super().__init__()
        self.error = error

    def get_password(self, service: str, entry: str) -> str | None:
        raise self.error


def test_of_several_keyrings_the_one_with_the_entry_opens_and_else_the_first_that_failed_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name = f"{MemoryKeyring.__module__}.{MemoryKeyring.__qualname__}"
    monkeypatch.setitem(keyring_vault.ALLOWED, name, "a keyring in memory")
    first, second = BrokenKeyring(OSError()), BrokenKeyring(ValueError())
    empty, full = MemoryKeyring(), MemoryKeyring()

    def on(*backends: MemoryKeyring) -> None:
        monkeypatch.setattr(keyring_vault, "_viable", lambda: iter([(name, backend) for backend in backends]))

    on(full)
    made = KeyringVault.create(STORE)
    assert list(full.entries) == [(keyring_vault.SERVICE, f"station/{STORE}")], "no probe is left"
    on(first, empty, full)
    assert KeyringVault.open(STORE).identity().point == made.identity().point
    for backends, words in (
        ((first, empty, second), "OSError"),
        ((empty, second, first), "ValueError"),
        ((empty,), "no entry"),
    ):
        on(*backends)
        with pytest.raises(VaultError, match=words):
            KeyringVault.open(STORE)


SECRET_SERVICE = "keyring.backends.SecretService.Keyring"
LIBSECRET, KWALLET = "keyring.backends.libsecret.Keyring", "keyring.backends.kwallet.DBusKeyring"


@pytest.mark.parametrize(
    ("platform", "desktop", "names"),
    [
        ("darwin", "KDE", ["keyring.backends.macOS.Keyring"]),
        ("win32", "", ["keyring.backends.Windows.WinVaultKeyring"]),
        ("linux", "", [SECRET_SERVICE, LIBSECRET, KWALLET]),
        ("linux", "GNOME", [SECRET_SERVICE, LIBSECRET, KWALLET]),
        ("linux", "KDE", [KWALLET, SECRET_SERVICE, LIBSECRET]),
        ("linux", "X:KDE", [KWALLET, SECRET_SERVICE, LIBSECRET]),
        ("linux", "KDE2", [SECRET_SERVICE, LIBSECRET, KWALLET]),
    ],
)
def test_which_keyrings_are_tried_and_in_which_order(
    monkeypatch: pytest.MonkeyPatch, platform: str, desktop: str, names: list[str]
) -> None:
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setenv("XDG_CURRENT_DESKTOP", desktop)
    assert keyring_vault._candidates() == names


@pytest.mark.parametrize(
    ("error", "kind", "message", "hint"),
    [
        (
            NoKeyringError(),
            KeyringUnavailableError,
            "This machine has no keyring that is suitable for",
            "Start a Secret",
        ),
        (KeyringLocked(), VaultError, "The keyring is locked and was not unlocked (a keyring in memory).", "Unlock it"),
        (InitError(), VaultError, "The keyring is locked and was not unlocked (a keyring in memory).", "Unlock it"),
        (OSError(), VaultError, "The keyring failed (a keyring in memory: OSError).", "Check that its service runs."),
    ],
    ids=lambda part: type(part).__name__ if isinstance(part, Exception) else None,
)
def test_a_keyring_that_fails_says_how_and_what_to_do(
    monkeypatch: pytest.MonkeyPatch, error: Exception, kind: type[VaultError], message: str, hint: str
) -> None:
    name = f"{MemoryKeyring.__module__}.{MemoryKeyring.__qualname__}"
    monkeypatch.setitem(keyring_vault.ALLOWED, name, "a keyring in memory")
    monkeypatch.setattr(keyring_vault, "_viable", lambda: iter([(name, BrokenKeyring(error))]))
    for attempt in (lambda: KeyringVault.open(STORE), keyring_vault.inspect):
        with pytest.raises(VaultError) as failed:
            attempt()
        assert type(failed.value) is kind
        assert failed.value.message.startswith(message)
        assert failed.value.hint.startswith(hint)


def test_a_keyring_that_answers_is_named_and_has_no_passphrase_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"{MemoryKeyring.__module__}.{MemoryKeyring.__qualname__}"
    backend = MemoryKeyring()
    monkeypatch.setitem(keyring_vault.ALLOWED, name, "a keyring in memory")
    monkeypatch.setattr(keyring_vault, "_viable", lambda: iter([(name, backend)]))
    assert keyring_vault.inspect() == "a keyring in memory"
    assert backend.entries == {}, "to look changes nothing"
    vault = KeyringVault.create(STORE)
    assert vault.opener() == b""
    with pytest.raises(VaultError) as refused:
        vault.new_passphrase(never)
    assert refused.value.message == "The keyring has its own passphrase (a keyring in memory)."
    assert refused.value.hint.startswith("Change it with the keyring's own program")


# From here on a real Secret Service.


class Session:
    """D-Bus sessions of one user: each runs a snippet, with gnome-keyring as its Secret Service."""

    def __init__(self, home: Path) -> None:
        self.home = home
        (home / "run").mkdir(mode=0o700)
        self.environment = {
            "PATH": os.environ["PATH"],
            "HOME": str(home),
            "XDG_RUNTIME_DIR": str(home / "run"),
            "XDG_DATA_HOME": str(home / "data"),
            "LC_ALL": "C.UTF-8",
        }

    @classmethod
    def of_user(cls, home: Path) -> Session:
        """Return a user of this machine who never logged in before; skip the test if no keyring is installed."""
        for program in ("dbus-run-session", "gnome-keyring-daemon"):
            if shutil.which(program) is None:
                pytest.skip(f"{program} is missing: scripts/install-test-packages installs it")
        home.mkdir(mode=0o700)
        return cls(home)

    def run(self, snippet: str, *, password: str | None = "login", bus: tuple[str, ...] = ()) -> dict[str, Any]:
        unlock = (
            ""
            if password is None
            else ('gnome-keyring-daemon --unlock --components=secrets >"$HOME/daemon.log" 2>&1; ')
        )
        script = f'{unlock}exec "$@" </dev/null'
        code = _PRELUDE + dedent(snippet)
        process = subprocess.Popen(
            ["dbus-run-session", *bus, "--", "sh", "-c", script, "sh", sys.executable, "-c", code, str(self.home)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=self.environment,
            start_new_session=True,
        )
        try:
            output, errors = process.communicate(password or "", timeout=60)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        assert process.returncode == 0, errors
        record: dict[str, Any] = json.loads(output)
        return record


_PRELUDE = """
import json, sys
from pathlib import Path
from teds_provision.errors import TedsProvisionError
from teds_provision.vault.selection import create_vault, forget_vaults, open_vault
from teds_provision.vault.keyring_vault import KeyringVault
from teds_provision.vault.passphrase import THROWAWAY
home, store = Path(sys.argv[1]), "5e" * 16
def never(prompt, confirm): raise AssertionError("a keyring needs no passphrase from us")
def ask(prompt, confirm): return "four random words here"
def say(**what): print(json.dumps(what))
def attempt(action):
    try:
        action()
    except TedsProvisionError as error:
        say(error=type(error).__name__, message=error.message, hint=error.hint)
    else:
        say(error=None)
"""


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return Session.of_user(tmp_path / "user")


MAKE = """
    vault, why = create_vault(home, store, None, never)
    say(kind=vault.kind, why=why, about=vault.description, point=vault.identity().point.hex(),
        ca=vault.ca().point.hex(), wrapped=vault.wrap(b"k" * 16, context=b"c").hex())
"""


@pytest.mark.system
def test_a_real_keyring_holds_the_keys_from_one_login_to_the_next(session: Session) -> None:
    made = session.run(MAKE)
    assert (made["kind"], made["why"]) == ("keyring", "an OS keyring is available")
    assert "Secret Service" in made["about"]
    assert not (session.home / "vault.json").exists()
    later = session.run(f"""
        vault = open_vault(home, store, "keyring", never)
        assert open_vault(home, store, "keyring", never) is vault
        key = vault.unwrap(bytes.fromhex({made["wrapped"]!r}), context=b"c")
        say(point=vault.identity().point.hex(), ca=vault.ca().point.hex(), key=key.decode())
    """)
    assert later == {"point": made["point"], "ca": made["ca"], "key": "k" * 16}


@pytest.mark.system
def test_a_second_init_finds_the_same_keys_and_leaves_no_probe(session: Session) -> None:
    made = session.run(MAKE)
    again = session.run("""
        import secretstorage
        vault, why = create_vault(home, store, "keyring", never)
        items = list(secretstorage.get_default_collection(secretstorage.dbus_init()).get_all_items())
        entries = [item.get_attributes()["username"] for item in items]
        secret = items[0].get_secret()
        say(point=vault.identity().point.hex(), why=why, entries=entries, length=len(secret), ascii=secret.isascii(),
            lines=len(secret.splitlines()))
    """)
    assert again.pop("length") < 1280
    assert again == {
        "point": made["point"],
        "why": "as requested",
        "entries": [f"station/{STORE}"],
        "ascii": True,
        "lines": 1,
    }


@pytest.mark.system
def test_the_ca_key_leaves_and_comes_back_and_the_master_key_changes(session: Session) -> None:
    made = session.run(MAKE)
    changed = session.run(f"""
        vault = open_vault(home, store, "keyring", never)
        vault.export_ca(home / "ca.pem", "a passphrase for the safe")
        vault.drop_ca(); forget_vaults()
        vault = open_vault(home, store, "keyring", never)
        gone = vault.ca() is None
        back = vault.import_ca(home / "ca.pem", "a passphrase for the safe").point.hex()
        vault.add_master(); forget_vaults()
        vault = open_vault(home, store, "keyring", never)
        both = vault.unwrap(bytes.fromhex({made["wrapped"]!r}), context=b"c") == b"k" * 16
        new = vault.wrap(b"n" * 16, context=b"c")
        vault.retire_masters(); forget_vaults()
        vault = open_vault(home, store, "keyring", never)
        say(gone=gone, back=back, both=both, kept=vault.unwrap(new, context=b"c") == b"n" * 16,
            point=vault.identity().point.hex())
    """)
    assert changed == {"gone": True, "back": made["ca"], "both": True, "kept": True, "point": made["point"]}


@pytest.mark.system
def test_the_keyring_of_another_user_has_no_entry(session: Session) -> None:
    results = session.run('attempt(lambda: open_vault(home, store, "keyring", never))')
    assert results["error"] == "VaultError"
    assert "no entry" in results["message"]
    assert "restore" in results["hint"]


@pytest.mark.system
def test_a_keyring_that_stays_locked_is_not_taken_and_not_waited_for(session: Session) -> None:
    session.run(MAKE)
    results = session.run('attempt(lambda: open_vault(home, store, "keyring", never))', password="another password")
    assert results["error"] == "VaultError"
    assert "locked" in results["message"]
    assert "Unlock it" in results["hint"]
    fallen = session.run(
        'vault, why = create_vault(home, "77" * 16, None, ask, costs=THROWAWAY); say(kind=vault.kind, why=why)',
        password="another password",
    )
    assert fallen["kind"] == "file"
    assert "locked" in fallen["why"]


@pytest.mark.system
def test_a_secret_service_without_an_unlock_is_locked(session: Session) -> None:
    results = session.run('attempt(lambda: create_vault(home, store, "keyring", never))', password=None)
    assert results["error"] in ("VaultError", "KeyringUnavailableError")
    assert results["hint"]


@pytest.mark.system
def test_a_bus_without_a_secret_service_has_no_keyring(session: Session) -> None:
    config = session.home / "bus.conf"
    config.write_text(
        "<busconfig><type>session</type>"
        f"<listen>unix:tmpdir={tempfile.gettempdir()}</listen>"  # short: a socket has 107 characters
        '<policy context="default"><allow send_destination="*" eavesdrop="true"/><allow eavesdrop="true"/>'
        '<allow own="*"/></policy></busconfig>'
    )
    results = session.run(
        'attempt(lambda: create_vault(home, store, "keyring", never))',
        password=None,
        bus=("--config-file", str(config)),
    )
    assert results["error"] == "KeyringUnavailableError"
    assert "--keystore file" in results["hint"]


@pytest.mark.system
def test_an_entry_that_is_not_ours_is_damage_and_stays(session: Session) -> None:
    results = session.run("""
        import contextlib, io, keyring
        keyring.set_password("teds-provision", f"station/{store}", "something else")
        output = io.StringIO()
        with contextlib.redirect_stdout(output):
            attempt(lambda: create_vault(home, store, "keyring", never))
        kept = keyring.get_password("teds-provision", f"station/{store}")
        say(**json.loads(output.getvalue()), kept=kept)
    """)
    assert results["error"] == "VaultError"
    assert results["kept"] == "something else"
    assert "something else" not in results["message"] + results["hint"]


@pytest.mark.system
def test_a_service_that_dies_is_a_failure_with_a_cure(session: Session) -> None:
    results = session.run("""
        import os, signal, subprocess
        vault, _ = create_vault(home, store, "keyring", never)
        for name in os.listdir("/proc"):
            if name.isdigit():
                try:
                    with open(f"/proc/{name}/environ", "rb") as file:
                        ours = f"HOME={home}".encode() in file.read().split(b"\\0")
                    with open(f"/proc/{name}/comm") as file:
                        daemon = file.read().startswith("gnome-keyring-d")
                except OSError:
                    continue
                if ours and daemon:
                    os.kill(int(name), signal.SIGKILL)
        attempt(vault.drop_ca)
    """)
    assert results["error"] in ("VaultError", "KeyringUnavailableError")
    assert results["hint"]


class WorksHere:
    """A backend that works on this machine, though others are better."""

    priority = 0.5


class UselessHere:
    """A backend that may be asked, and does not work on this machine."""

    priority = 0


class _FailsToSay(type):
    @property
    def priority(cls) -> float:
        raise RuntimeError("no bus")


class FailsHere(metaclass=_FailsToSay):
    """A backend that fails when it is asked whether it works."""


def test_keyrings_that_do_not_work_here_are_passed_over_and_the_others_come_in_their_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    works, useless, fails = (f"{kind.__module__}.{kind.__qualname__}" for kind in (WorksHere, UselessHere, FailsHere))
    first, absent = works.replace("WorksHere", "BestHere"), works.replace("WorksHere", "NoneHere")
    monkeypatch.setattr(sys.modules[__name__], "BestHere", type("BestHere", (), {"priority": 5}), raising=False)
    names = ["no.such.module.Keyring", absent, fails, useless, first, works]
    monkeypatch.setattr(keyring_vault, "_candidates", lambda: names)
    monkeypatch.setitem(keyring_vault.ALLOWED, works, "a keyring of this machine")
    for configured, found in ((None, [first, works]), (CHAINER, [first, works]), (works, [works])):
        monkeypatch.setattr(keyring_vault, "_configured", lambda configured=configured: configured)
        assert [name for name, _backend in keyring_vault._viable()] == found
    names[4:] = []
    monkeypatch.setattr(keyring_vault, "_configured", lambda: None)
    with pytest.raises(KeyringUnavailableError, match="has no keyring"):
        next(keyring_vault._viable())


UNREADABLE = "of an unreadable keyringrc.cfg"


@pytest.mark.parametrize(
    ("named", "content", "configured"),
    [
        (None, "", None),
        (None, "[other]\n", None),
        (None, "[backend]\ndefault-keyring=\n", None),
        (None, "[backend]\ndefault-keyring = a%b \n", "a%b"),
        (None, "default-keyring=a.b\n", UNREADABLE),
        ("", "[backend]\ndefault-keyring=a.b\n", "a.b"),
        ("x.y", "[backend]\ndefault-keyring=a.b\n", "x.y"),
    ],
)
def test_the_environment_names_the_keyring_before_the_configuration_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, named: str | None, content: str, configured: str | None
) -> None:
    place = tmp_path / ".config" / "python_keyring"
    place.mkdir(parents=True)
    (place / "keyringrc.cfg").write_text(content)
    if named is not None:
        monkeypatch.setenv("PYTHON_KEYRING_BACKEND", named)
    assert keyring_vault._configured() == configured


def test_an_entry_that_was_deleted_meanwhile_is_not_made_anew_by_a_change(monkeypatch: pytest.MonkeyPatch) -> None:
    name, backend = f"{MemoryKeyring.__module__}.{MemoryKeyring.__qualname__}", MemoryKeyring()
    monkeypatch.setitem(keyring_vault.ALLOWED, name, "a keyring in memory")
    monkeypatch.setattr(keyring_vault, "_viable", lambda: iter([(name, backend)]))
    vault = KeyringVault.create(STORE)
    backend.entries.clear()
    for change in (vault.add_master, vault.drop_ca, vault.retire_masters):
        with pytest.raises(VaultError) as refused:
            change()
        assert refused.value.message == "The keyring no longer has an entry for this station."
        assert refused.value.hint == keyring_vault._NO_ENTRY
    assert backend.entries == {}
