"""Processes of the program that cost a fork instead of a start: one process imports everything once and waits.

Most of what a short command takes is Python importing the same modules; the suite starts some 1,500 of them, a trial of
the fault bench five. The zygote has one thread and no open file of anybody's; a child of it gets its own environment,
files and folder, runs the module as ``python -m`` would, and ends as a Python process ends. Under cut.c's library (the
fault bench) the library begins anew in each child (``faults_begin``).

What such a child cannot show is how the program starts: what it imports, what the interpreter makes of its environment,
how much memory it takes. Tests of that start an interpreter; ``forkable`` tells environments that only a start obeys.

As a program: python -m tests.zygote FD [MODULE] (the control socket that its parent holds the other end of).
"""

from __future__ import annotations

import atexit
import ctypes
import fcntl
import gc
import importlib
import json
import os
import pkgutil
import runpy
import selectors
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from tests.pace import PATIENCE

ROOT = Path(__file__).resolve().parents[1]
# What commands import late, or a library for them: foreign and heavy. Seen by comparing sys.modules before and after.
FOREIGN = (
    "_strptime",
    "can",
    "can.interfaces.udp_multicast",
    "cryptography.hazmat.backends.openssl.backend",
    "cryptography.hazmat.primitives.asymmetric.ec",
    "cryptography.hazmat.primitives.ciphers.aead",
    "cryptography.hazmat.primitives.kdf.argon2",
    "cryptography.hazmat.primitives.kdf.hkdf",
    "cryptography.hazmat.primitives.keywrap",
    "cryptography.hazmat.primitives.serialization",
    "encodings.idna",
    "encodings.utf_8_sig",
    "imgtool.image",
    "isotp",
    "ndef",
    "nfc",
    "nfc.clf.udp",
    "numpy.ma",
    "platformdirs",
    "resource",
    "rich.console",
    "rich.live",
    "rich.table",
    "smp.image_management",
    "uvicorn.protocols.websockets.websockets_sansio_impl",
)
LISTENS = 1.5  # seconds; see _listen_shortly
FIRST_FD = 3  # of the descriptors that a child is given beside stdin, stdout and stderr
LARGEST = 1 << 17


@dataclass
class ForkedProcess:
    """A process of the zygote, as ``subprocess.Popen`` has one: its id, and how it ended (minus the signal)."""

    pid: int
    status: int  # a pipe: the wait status comes here as text when it has ended
    returncode: int | None = field(default=None, init=False)

    def poll(self) -> int | None:
        """The exit code, or None while it runs."""
        return self._ended(0)

    def wait(self, timeout: float) -> int:
        """Return the exit code; raises TimeoutExpired."""
        code = self._ended(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout)
        return code

    def send_signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)

    def _ended(self, seconds: float) -> int | None:
        if self.returncode is None and _readable(self.status, seconds):
            self.returncode = os.waitstatus_to_exitcode(int(os.read(self.status, 64) or b"9"))
            os.close(self.status)
        return self.returncode


@dataclass
class Child(ForkedProcess):
    """One whose output is kept: what it wrote."""

    out: int  # a file in memory, or the reading end of a pipe
    err: int

    def wait(self, timeout: float) -> int:
        """Return the exit code; kills it and raises TimeoutExpired where it has not ended after ``timeout``."""
        try:
            return super().wait(timeout)
        except subprocess.TimeoutExpired:
            self.kill()
            raise

    def kill(self) -> None:
        """End it at once, and wait for that."""
        super().kill()
        self._ended(30)

    def stdout(self) -> str:
        """Return what it wrote to a file in memory."""
        return _whole(self.out)

    def stderr(self) -> str:
        """Return what it wrote to stderr."""
        return _whole(self.err)

    def wait_for(self, text: str, seconds: float) -> None:
        """Read its stdout (a pipe) until ``text`` came; AssertionError where it ends without, or takes too long."""
        came = ""
        until = time.monotonic() + seconds
        while text not in came:
            left = until - time.monotonic()
            octets = os.read(self.out, 65536) if left > 0 and _readable(self.out, left) else b""
            assert octets, f"ended without {text!r}: {came!r} {self.stderr()[-500:]!r}"
            came += octets.decode()

    def close(self) -> None:
        """End it and give its files back."""
        self.kill()
        os.close(self.out)
        os.close(self.err)


def first_of(wanted: Child, other: Child, seconds: float) -> Child | None:
    """Return the child that ends first (``wanted`` if both have), or None if neither ends within ``seconds``."""
    until = time.monotonic() + seconds
    with selectors.PollSelector() as poll:
        for child in (wanted, other):
            poll.register(child.status, selectors.EVENT_READ)
        while wanted.returncode is None and other.returncode is None:
            left = until - time.monotonic()
            if left <= 0 or not poll.select(left):
                return None
            wanted.poll()
            other.poll()
    return wanted if wanted.returncode is not None else other


@dataclass
class Zygote:
    """The parent's end: starts the program again and again, from any thread."""

    environment: dict[str, str]  # in which it imports
    library: Path | None = None  # what is to be loaded before the system's own
    module: str = ""  # another one than the program, which alone is imported, with all that it imports
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False)

    def __post_init__(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (ours, theirs):
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, LARGEST)
        self._control = ours
        more = {"LD_PRELOAD": str(self.library)} if self.library else {}
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.zygote", str(theirs.fileno()), *([self.module] if self.module else [])],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                env=self.environment | more | {"OPENBLAS_NUM_THREADS": "1"},  # threads would not outlive a fork
                cwd=ROOT,
            )

    def run(
        self,
        module: str,
        words: list[str],
        environment: dict[str, str],
        *,
        out: int,
        err: int,
        given: tuple[int, ...] = (),
        cwd: Path = ROOT,
        stdin: int | None = None,
    ) -> ForkedProcess:
        """Run ``python -m module words`` with its output to two files; ``given`` become descriptors 3, 4 … there.

        With a ``stdin`` it leads a session of its own: the terminal of the tests is not its terminal.
        """
        sys.audit("tests.zygote.run", module)  # tests/second_try.py counts the processes of a test
        nothing = os.dup(stdin) if stdin is not None else os.open(os.devnull, os.O_RDONLY)
        status, output = os.pipe()
        facts = {
            "module": module,
            "words": words,
            "environment": environment,
            "cwd": str(cwd),
            "umask": _umask(),
            "session": stdin is not None,
        }
        try:
            with self._lock:
                socket.send_fds(self._control, [json.dumps(facts).encode()], [output, nothing, out, err, *given])
        finally:
            os.close(output)
            os.close(nothing)
        assert _readable(status, PATIENCE), "the zygote does not answer"
        return ForkedProcess(int(os.read(status, 16)), status)

    def start(
        self,
        module: str,
        words: list[str],
        environment: dict[str, str],
        given: tuple[int, ...] = (),
        *,
        piped: bool = False,
    ) -> Child:
        """Return the same with output that is kept in memory; ``piped``: stdout is a pipe."""
        err = os.memfd_create("stderr", os.MFD_CLOEXEC)
        out, written = os.pipe() if piped else (os.memfd_create("stdout", os.MFD_CLOEXEC),) * 2
        try:
            begun = self.run(module, words, environment, out=written, err=err, given=given)
        finally:
            if piped:
                os.close(written)
        return Child(begun.pid, begun.status, out, err)

    def close(self) -> None:
        """End it; it ends its children."""
        self._control.close()
        self._process.wait(60)


_OBEYED_LATE = ("TEDS_PROVISION", "XDG_", "DBUS_", "PYTEST_")
_ALSO = {"COLUMNS", "HOME", "LINES", "NO_COLOR", "PATH", "TERM", "TMPDIR"}


def forkable(asked: dict[str, str], before: dict[str, str]) -> bool:
    """Whether a fork obeys this environment: no name differs but those that the program reads, and that as it works."""
    if "COVERAGE_PROCESS_START" in asked or "COVERAGE_PROCESS_CONFIG" in asked:
        return False
    differ = {name for name in asked.keys() | before.keys() if asked.get(name) != before.get(name)}
    return all(name in _ALSO or name.startswith(_OBEYED_LATE) for name in differ)


def _umask() -> int:
    now = os.umask(0o077)
    os.umask(now)
    return now


def _readable(fd: int, seconds: float) -> bool:
    with selectors.PollSelector() as poll:
        poll.register(fd, selectors.EVENT_READ)
        return bool(poll.select(max(0.0, seconds)))


def _whole(fd: int) -> str:
    return os.pread(fd, os.fstat(fd).st_size, 0).decode(errors="replace")


# -- the zygote itself -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Request:
    module: str
    words: list[str]
    environment: dict[str, str]
    cwd: str
    umask: int
    session: bool
    files: tuple[int, ...]  # status pipe, stdin, stdout, stderr, and what else is given


def _serve(control: socket.socket) -> _Request | None:
    """Fork a child for each request; returns a request in the child that shall run it, None when all is over."""
    children: dict[int, tuple[int, int]] = {}  # pidfd -> pid, status pipe
    with selectors.DefaultSelector() as selector:
        selector.register(control, selectors.EVENT_READ)
        while True:
            for key, _ in selector.select():
                if key.fileobj is not control:
                    selector.unregister(key.fileobj)
                    _tell_end(key.fd, *children.pop(key.fd))
                    continue
                octets, files, _, _ = socket.recv_fds(control, LARGEST, 16)
                if not octets:
                    for pid, _pipe in children.values():
                        os.kill(pid, signal.SIGKILL)
                    return None
                pid = os.fork()
                if not pid:
                    return _Request(**json.loads(octets), files=tuple(files))
                for descriptor in files[1:]:
                    os.close(descriptor)
                os.write(files[0], f"{pid}".encode().ljust(16))
                pidfd = os.pidfd_open(pid)
                children[pidfd] = pid, files[0]
                selector.register(pidfd, selectors.EVENT_READ)


def _tell_end(pidfd: int, pid: int, pipe: int) -> None:
    _, status = os.waitpid(pid, 0)
    with suppress(BrokenPipeError):
        os.write(pipe, str(status).encode())
    os.close(pipe)
    os.close(pidfd)


def _become(request: _Request) -> None:
    """In the child: take on files and environment of the request, and run its module."""
    high = [fcntl.fcntl(descriptor, fcntl.F_DUPFD, 512) for descriptor in request.files[1:]]
    os.closerange(0, 512)
    for number, descriptor in enumerate(high):
        os.dup2(descriptor, number)
    os.closerange(512, max(high) + 1)
    under_faults = os.environ.get("LD_PRELOAD")
    os.environ.clear()
    os.environ.update(request.environment)
    os.chdir(request.cwd)
    os.umask(request.umask)
    if request.session:
        os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if under_faults:
        ctypes.CDLL(None).faults_begin()
    sys.argv = [request.module, *request.words]
    code = 0
    try:
        runpy.run_module(request.module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # noqa: BLE001  as Python itself ends: a traceback and 1
        traceback.print_exc()
        code = 1
    _leave(code)


def _leave(code: int) -> None:
    """End as Python does, but for freeing what the zygote imported, which is most of the cost of a short command."""
    threading._shutdown()  # type: ignore[attr-defined]  # what Python itself calls at its end
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()
    os._exit(code)


def _import_all() -> None:
    import teds_provision

    for found in pkgutil.walk_packages(teds_provision.__path__, "teds_provision."):
        if not found.name.endswith("__main__"):
            with suppress(ImportError):  # of an extra that is not installed
                importlib.import_module(found.name)
    for name in FOREIGN:
        with suppress(ImportError):  # of an extra that is not installed
            importlib.import_module(name)
    importlib.import_module("tests.passphrase_costs").lower_costs()
    _listen_shortly()


def _listen_shortly() -> None:
    """Have commands that collect nodes listen half as long unless ``--timeout`` is given; each test waits for that.

    A node of a test answers at once. The usual time is held by tests/provisioning/test_identify_at.py and by every
    program that a test starts by an interpreter.
    """
    ports = importlib.import_module("teds_provision.links.ports")
    assert ports.LISTEN_SECONDS > LISTENS
    ports.LISTEN_SECONDS = LISTENS  # type: ignore[attr-defined]  # read by the options alone from here on


def main() -> None:
    """Import, then serve; in a child: run what was asked for."""
    control = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal: for the tests, which end this one
    if sys.argv[2:]:
        importlib.import_module(sys.argv[2])
        del sys.modules[sys.argv[2]]  # it runs as __main__, and who imports it then gets one of its own
        folder, _, name = sys.argv[2].rpartition(".")
        if folder:
            delattr(sys.modules[folder], name)
    else:
        _import_all()
    assert threading.active_count() == 1
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)  # a child seldom lives long enough to make that much garbage
    request = _serve(control)
    control.detach()
    if request is not None:
        _become(request)


if __name__ == "__main__":
    main()
