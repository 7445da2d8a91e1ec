"""``unlock`` and ``lock``: asked once, held in memory alone, gone in time, and for nobody else."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn, cast

import pytest

from teds_provision import files
from teds_provision.cli.main import run as in_process
from teds_provision.errors import VaultError, WrongPassphraseError
from teds_provision.vault import agent, selection
from teds_provision.vault.base import Ask
from teds_provision.vault.pkcs11 import Pkcs11Vault
from teds_provision.vault.pkcs11_token import ask_pin
from teds_provision.vault.pkcs11_uri import Pkcs11Uri
from teds_provision.vault.selection import forget_vaults
from tests.bench import PASSPHRASE, make_station
from tests.cli.shell import Outcome, call, clean_environment, spawn
from tests.vault.softhsm import PIN, loaded, unload

NODE = "0102030405060708090a"
NEW = "four other random words"


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Path]:
    forget_vaults()
    make_station(tmp_path / "home").close()
    yield tmp_path / "home"
    agent.lock(tmp_path / "home")
    forget_vaults()


def run(home: Path, *words: str, passphrase: str | None = None) -> Outcome:
    """A command in a process of its own; without a passphrase nobody can be asked."""
    return spawn("--json", "--home", home, *words, passphrase=passphrase)


def opens(home: Path, node: str = NODE) -> int:
    """Exit code of a command that needs the vault, and asks nobody."""
    return run(home, "whitelist", "add", node, "--fingerprint", "ab" * 32).code


def process_of(home: Path) -> int:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line:
        line.connect(str(home / agent.SOCKET))
        return int.from_bytes(line.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)[:4], "little")


def lives(process: int) -> bool:
    """Return True if a process runs: one that has ended and was not waited for has no command line."""
    try:
        return bool(Path("/proc", str(process), "cmdline").read_bytes())
    except OSError:
        return False


def wait_until(holds: Callable[[], bool], seconds: float = 60) -> None:
    until = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < until
        time.sleep(0.02)


def test_asked_once_and_closed_by_lock(home: Path) -> None:
    assert opens(home) == 7
    assert not run(home, "lock").json["was_open"]
    outcome = run(home, "unlock", "--for", "10m", passphrase=PASSPHRASE)
    assert outcome.code == 0, outcome
    assert outcome.json["unlocked"]
    assert (home / agent.SOCKET).stat().st_mode & 0o777 == 0o600
    assert 500 < (agent.seconds_left(home) or 0) <= 600
    assert [opens(home) for _ in range(2)] == [0, 0]
    (seen,) = [check for check in run(home, "doctor").json["checks"] if check["name"] == "unlock"]
    assert (seen["result"], seen["fix"]) == ("warning", "teds-provision lock")
    assert "unlocked for" in spawn("--home", home, "init").out
    assert run(home, "lock").json == {"locked": True, "was_open": True}
    assert not (home / agent.SOCKET).exists()
    assert opens(home, "0f" * 10) == 7
    acts = [
        (entry["outcome"], entry["detail"]) for entry in run(home, "log").json["entries"] if entry["act"] == "vault"
    ]
    assert acts == [("unlocked", {"seconds": 600}), ("locked", {})]


def test_it_ends_by_itself_at_the_time(home: Path) -> None:
    assert run(home, "unlock", "--for", "1s", passphrase=PASSPHRASE).code == 0
    wait_until(lambda: not (home / agent.SOCKET).exists())
    assert opens(home) == 7


def test_a_pin_that_is_held_is_not_spent_on_the_last_attempt() -> None:
    from pkcs11 import TokenFlag

    class ShownToken:
        flags = TokenFlag(0)

    asked: list[str] = []

    def person(prompt: str, confirm: bool) -> str:
        asked.append(prompt)
        return "typed"

    give, uri = selection._holding(b"held", person), Pkcs11Uri("/m.so", token="t")
    assert ask_pin(cast(Any, ShownToken), uri, give) == "held"
    ShownToken.flags = TokenFlag.USER_PIN_FINAL_TRY
    assert ask_pin(cast(Any, ShownToken), uri, give) == "typed"
    assert len(asked) == 1


def test_a_pin_that_turns_out_wrong_does_not_stay_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The token counts each try: the next command must ask a person and not spend the same PIN again."""
    tried: list[str] = []

    def refuse(home: Path, store_id: str, uri: str, ask: Ask) -> NoReturn:
        tried.append(ask("PIN", False))
        raise WrongPassphraseError("The PIN is wrong.")

    monkeypatch.setattr(Pkcs11Vault, "open", refuse)
    listener = files.listen_alone(tmp_path / agent.SOCKET, 16)
    page = page_with(b"Pheld")

    def hold() -> None:
        with listener:  # who asks after the end must not wait for an answer
            agent.serve(listener, page, agent._now() + 60)

    thread = threading.Thread(target=hold)
    thread.start()
    try:
        for expected in ("held", "typed"):
            with pytest.raises(WrongPassphraseError):
                selection.open_vault(
                    tmp_path, "5e" * 16, "pkcs11:token=t", lambda prompt, confirm: "typed", use_agent=True
                )
            assert tried == [expected], "one try for each command"
            tried.clear()
            assert agent.held(tmp_path, "pkcs11") is None
    finally:
        agent.lock(tmp_path)
        thread.join(60)
    assert bytes(page.view()) == b""


def test_a_machine_that_slept_finds_it_closed(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock ran on while the wait stood still: the next one who asks gets nothing."""
    clock = [100.0]
    monkeypatch.setattr(agent, "_now", lambda: clock[0])
    page = page_with(b"Fsecret")
    listener = files.listen_alone(home / agent.SOCKET, 16)
    thread = threading.Thread(target=agent.serve, args=(listener, page, 200.0))
    thread.start()
    assert agent.held(home, "file") == b"secret"
    assert agent.held(home, "pkcs11") is None
    clock[0] = 201.0
    assert agent.held(home, "file") is None
    thread.join(60)
    listener.close()
    assert not thread.is_alive()
    assert bytes(page.view()) == b""


def test_another_user_at_either_end_gets_nothing(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = page_with(b"Fsecret")
    listener = files.listen_alone(home / agent.SOCKET, 16)
    thread = threading.Thread(target=agent.serve, args=(listener, page, agent._now() + 60))
    thread.start()
    for end in (threading.current_thread(), thread):  # who asks, who answers
        with monkeypatch.context() as patch:
            patch.setattr(agent, "user_at", lambda line, end=end: os.geteuid() + (threading.current_thread() is end))
            assert agent.held(home, "file") is None
            assert not agent.lock(home)
    assert agent.held(home, "file") == b"secret"
    assert agent.lock(home)
    thread.join(60)
    listener.close()


def test_the_process_keeps_its_secret(home: Path) -> None:
    """No core dump, its page locked, nothing in its arguments or environment, no stream of whoever started it."""
    assert run(home, "unlock", passphrase=PASSPHRASE).code == 0
    proc = Path("/proc") / str(process_of(home))
    limits = next(line for line in (proc / "limits").read_text().splitlines() if line.startswith("Max core file size"))
    assert limits.split()[4:6] == ["0", "0"]
    locked = next(line for line in (proc / "status").read_text().splitlines() if line.startswith("VmLck"))
    assert int(locked.split()[1]) >= 4
    assert PASSPHRASE.encode() not in (proc / "cmdline").read_bytes()
    with suppress(PermissionError):  # other users than root do not even see that
        # once the command has its answer: it lets its streams go after that
        wait_until(lambda: {os.readlink(proc / "fd" / str(number)) for number in (0, 1, 2)} == {"/dev/null"})


def test_a_killed_one_is_none_and_is_replaced(home: Path) -> None:
    assert run(home, "unlock", passphrase=PASSPHRASE).code == 0
    os.kill(process_of(home), signal.SIGKILL)
    wait_until(lambda: agent.seconds_left(home) is None)
    assert opens(home) == 7
    assert run(home, "unlock", passphrase=PASSPHRASE).code == 0
    first = process_of(home)
    assert run(home, "unlock", "--for", "1h", passphrase=PASSPHRASE).code == 0
    assert process_of(home) != first
    wait_until(lambda: not lives(first))  # nothing reaches it any more: lock would leave its secret where it is
    assert opens(home) == 0
    os.kill(process_of(home), signal.SIGTERM)
    wait_until(lambda: not (home / agent.SOCKET).exists())


def test_every_signal_that_ends_it_wipes_its_page_and_so_does_a_secret_that_does_not_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    course: list[Any] = []

    class Page:
        def read(self, descriptor: int) -> None:
            course.append(descriptor)
            raise ValueError("longer than any secret")

        def wipe(self) -> None:
            course.append("wiped")

    with monkeypatch.context() as patch:
        patch.setattr("sys.argv", ["agent", str(tmp_path), "60"])
        patch.setattr(agent, "harden", lambda: course.append("hardened"))
        patch.setattr(agent, "LockedPage", Page)
        patch.setattr(agent, "signal", SimpleNamespace(**{
            name: getattr(signal, name) for name in ("SIGTERM", "SIGINT", "SIGHUP")
        }, signal=lambda *how: course.append(how)))  # fmt: skip
        with pytest.raises(ValueError, match="longer than any secret"):
            agent.main()
    ends = [(number, agent._end) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)]
    assert course == ["hardened", *ends, 0, "wiped"]
    with pytest.raises(SystemExit) as ended:
        agent._end(signal.SIGHUP, None)
    assert ended.value.code == 0
    assert not (tmp_path / agent.SOCKET).exists()


def test_one_that_ends_leaves_the_socket_of_another_that_took_its_place(tmp_path: Path) -> None:
    """The first was cut off from its socket; at its end it must not take away that of the second."""
    agent.start(tmp_path, "file", b"first", 60)
    first = process_of(tmp_path)
    (tmp_path / agent.SOCKET).unlink()
    agent.start(tmp_path, "file", b"second", 60)
    try:
        os.kill(first, signal.SIGTERM)
        wait_until(lambda: not lives(first))
        assert agent.held(tmp_path, "file") == b"second"
    finally:
        assert agent.lock(tmp_path)
    assert not (tmp_path / agent.SOCKET).exists()


def test_what_changes_or_takes_the_keys_along_asks_all_the_same(home: Path, tmp_path: Path) -> None:
    assert run(home, "unlock", passphrase=PASSPHRASE).code == 0
    assert run(home, "vault", "passphrase").code == 7
    assert run(home, "trust", "ca", "export", str(tmp_path / "ca.pem")).code == 7
    assert agent.seconds_left(home)


def test_a_new_passphrase_ends_it(home: Path) -> None:
    assert run(home, "unlock", passphrase=PASSPHRASE).code == 0
    read, write = os.pipe()
    os.write(write, f"{PASSPHRASE}\n{NEW}\n".encode())
    os.close(write)
    new, more = os.pipe()
    os.write(more, NEW.encode() + b"\n")
    os.close(more)
    words = ["--passphrase-fd", str(read), "vault", "passphrase", "--new-passphrase-fd", str(new)]
    assert in_process(["--home", str(home), *words]) == 0
    assert agent.seconds_left(home) is None
    assert opens(home) == 7
    assert run(home, "unlock", passphrase=PASSPHRASE).code == 7
    assert run(home, "unlock", passphrase=NEW).code == 0
    assert opens(home) == 0


@pytest.mark.system
def test_a_token_is_asked_for_its_pin_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    uri = loaded(tmp_path, monkeypatch, ("bench",))["bench"]
    home = tmp_path / "home"
    more = clean_environment()

    def at_token(*words: str, passphrase: str | None = None) -> Outcome:
        return spawn("--json", "--home", home, *words, passphrase=passphrase, environment=more)

    try:
        assert at_token("init", "--keystore", uri, passphrase=PIN).code == 0
        assert at_token("whitelist", "add", NODE).code == 7
        assert at_token("unlock", passphrase=PIN).json["keystore"] == "pkcs11"
        assert at_token("whitelist", "add", NODE).code == 0
    finally:
        agent.lock(home)
        unload()


@pytest.mark.parametrize("span", ["", "15", "0m", "13h", "soon"])
def test_a_span_that_is_none_is_usage(home: Path, span: str) -> None:
    assert run(home, "unlock", "--for", span, passphrase=PASSPHRASE).code == 2


@pytest.mark.parametrize(
    ("answer", "file", "token"),
    [(b"Fkey", b"key", None), (b"P1234", None, b"1234"), (b"F", None, None), (b"", None, None), (b"Xkey", None, None)],
)
def test_what_is_held_opens_a_vault_of_its_kind_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: bytes, file: bytes | None, token: bytes | None
) -> None:
    monkeypatch.setattr(agent, "_ask", lambda *_: answer)
    assert (agent.held(tmp_path, "file"), agent.held(tmp_path, "pkcs11")) == (file, token)


@pytest.mark.parametrize(("span", "seconds"), [("12h", 43_200), ("1s", 1), ("90s", 90), (None, 900), ("43201s", None)])
def test_a_vault_is_held_open_from_a_second_to_twelve_hours_and_15_minutes_by_default(
    home: Path, monkeypatch: pytest.MonkeyPatch, span: str | None, seconds: int | None
) -> None:
    begun: list[int] = []
    monkeypatch.setattr(agent, "start", lambda _home, _kind, _secret, seconds: begun.append(seconds))
    done = call(home, "unlock", *(() if span is None else ("--for", span)))
    assert (done.code, begun) == ((2, []) if seconds is None else (0, [seconds]))


def page_with(secret: bytes) -> agent.LockedPage:
    read, write = os.pipe()
    os.write(write, secret)
    os.close(write)
    page = agent.LockedPage()
    page.read(read)
    os.close(read)
    return page


def test_a_page_takes_1024_octets_and_not_one_more() -> None:
    assert bytes(page_with(b"x" * 1024).view()) == b"x" * 1024
    with pytest.raises(ValueError, match="longer than any secret"):
        page_with(b"x" * 1025)


def test_what_cannot_be_kept_open_is_refused_with_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process that would keep the secret has no home folder: it ends and leaves nothing."""
    begun: list[subprocess.Popen[bytes]] = []
    real = subprocess.Popen

    def started(*words: Any, **how: Any) -> subprocess.Popen[bytes]:
        begun.append(real(*words, **how))
        return begun[0]

    monkeypatch.setattr(agent.subprocess, "Popen", started)
    with pytest.raises(VaultError) as refused:
        agent.start(tmp_path / "nowhere", "file", b"secret", 60)
    assert (
        refused.value.message
        == f"The vault cannot be kept open: agent.sock in {tmp_path / 'nowhere'} does not come up."
    )
    assert begun[0].returncode is not None, "it was waited for"
    monkeypatch.delattr(socket, "SO_PEERCRED")
    with pytest.raises(VaultError) as refused:
        agent.start(tmp_path, "file", b"secret", 60)
    assert refused.value.message == "unlock requires Linux: this system does not identify the peer of a socket."
    assert len(begun) == 1


@pytest.mark.parametrize(("question", "seconds"), [(agent.END, 60.0), (agent.SECRET, -1.0)], ids=["lock", "too late"])
def test_the_page_is_wiped_before_the_line_ends(question: bytes, seconds: float) -> None:
    """Who sees the end of the line may count on it: a copy of the memory made from then on holds no secret."""
    asking, answering = socket.socketpair()
    with asking, answering:
        page = page_with(b"Fsecret")
        asking.sendall(question)
        assert not agent._answer(answering, page, agent._now() + seconds)
        assert page._memory[:16] == bytes(16)
        assert bytes(page.view()) == b""
        answering.shutdown(socket.SHUT_WR)
        assert asking.recv(16) == b""


def test_other_questions_leave_the_page_as_it_is() -> None:
    asking, answering = socket.socketpair()
    with asking, answering:
        page = page_with(b"Fsecret")
        for question in (agent.SECRET, b"?", agent.TIME):
            asking.sendall(question)
            assert agent._answer(answering, page, agent._now() + 60)
        answering.shutdown(socket.SHUT_WR)
        answers = asking.makefile("rb").read()
        assert answers[:7] == b"Fsecret"
        assert len(answers) == 7 + 4, "an unknown question gets no answer"
        assert int.from_bytes(answers[7:], "big") in (59, 60)
        assert bytes(page.view()) == b"Fsecret"
