"""A Python that lacks what only Linux, or only Unix, has: a fixture, and no other system.

``python elsewhere.py`` reads command lines and a passphrase as JSON from stdin and runs one after the other; it prints
what each returned and wrote. The modules, flags, socket families, signals and folders below are those that Windows
lacks; macOS lacks some of them. What Windows does differently (open files that cannot be renamed, its own paths) does
not show here.
"""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import select
import shutil
import signal
import socket
import subprocess  # noqa: F401  loaded before the modules that it needs here are hidden
import sys
import tempfile

MODULES = ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog")
OF_OS = """
O_NOFOLLOW O_CLOEXEC O_DIRECTORY O_NONBLOCK O_PATH O_TMPFILE O_SYNC O_DSYNC geteuid getuid getegid getgid getgroups
pread pwrite preadv pwritev fork forkpty fchmod fchown chown lchown mkfifo mknod sched_getaffinity sched_setaffinity
sched_setscheduler setsid getsid killpg getpgid setpgid posix_fallocate posix_fadvise sendfile statvfs fstatvfs sync
fdatasync getloadavg memfd_create eventfd pipe2 splice copy_file_range getrandom nice set_blocking get_blocking
"""
OF_SIGNAL = "SIGHUP SIGKILL SIGUSR1 SIGUSR2 SIGALRM SIGPIPE setitimer pthread_sigmask sigwait"
FOLDERS = ("/proc", "/sys", "/dev", "/run")
TEMPORARY = tempfile.gettempdir() + os.sep
"""Every system has one; that of the tests may lie below /dev/shm."""


def hide() -> None:
    """Take away what another system lacks; what is imported later finds it missing."""
    for module in MODULES:
        sys.modules[module] = None  # type: ignore[assignment]
    for owner, names in ((os, OF_OS.split()), (signal, OF_SIGNAL.split()), (select, ["poll", "epoll"])):
        for name in names:
            if hasattr(owner, name):
                delattr(owner, name)
    for name in dir(socket):
        if name.startswith(("AF_", "CAN_", "BT", "SO_PEER")) and name not in ("AF_INET", "AF_INET6", "AF_UNSPEC"):
            delattr(socket, name)
    os.supports_follow_symlinks.discard(os.link)
    shutil._use_fd_functions = False  # type: ignore[attr-defined]  # its choice was made for Unix
    sys.addaudithook(_watch)


def _watch(event: str, arguments: tuple[object, ...]) -> None:
    if event in ("open", "os.listdir", "os.scandir") and isinstance(arguments[0], str):
        _refuse(arguments[0])


def _refuse(path: str) -> None:
    if path.startswith(FOLDERS) and path != os.devnull and not path.startswith(TEMPORARY):
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)


def main() -> None:
    """Run the command lines of stdin."""
    asked = json.load(sys.stdin)
    hide()
    from teds_provision.cli.main import run

    done = []
    for words in asked["lines"]:
        read, write = os.pipe()
        os.write(write, asked["passphrase"].encode() + b"\n")
        os.close(write)
        out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = run(["--passphrase-fd", str(read), *words])
        os.close(read)
        done.append((code, *(stream.buffer.getvalue().decode() for stream in (out, err))))
    print(json.dumps(done))


if __name__ == "__main__":
    main()
