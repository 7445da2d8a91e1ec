"""Run a program as the shipped systemd unit confines it: by Debian's python3-seccomp, so by the system's own Python.

Arguments: a file of JSON ({"calls": […], "errno": N, "families": […]}), then the program. Everything else than these
calls gives the error, as ``SystemCallErrorNumber`` says; so do sockets of other families (``RestrictAddressFamilies``)
and memory that is written to and executed (``MemoryDenyWriteExecute``); systemd.exec(5).
"""

import errno
import json
import mmap
import os
import sys

import seccomp

with open(sys.argv[1], encoding="utf-8") as file:
    filters = json.load(file)

more = seccomp.SyscallFilter(seccomp.ALLOW)
above = max(filters["families"])
for family in range(above):
    if family not in filters["families"]:
        more.add_rule(seccomp.ERRNO(errno.EAFNOSUPPORT), "socket", seccomp.Arg(0, seccomp.EQ, family))
more.add_rule(seccomp.ERRNO(errno.EAFNOSUPPORT), "socket", seccomp.Arg(0, seccomp.GT, above))
both = mmap.PROT_WRITE | mmap.PROT_EXEC
more.add_rule(seccomp.ERRNO(errno.EPERM), "mmap", seccomp.Arg(2, seccomp.MASKED_EQ, both, both))
more.add_rule(seccomp.ERRNO(errno.EPERM), "mprotect", seccomp.Arg(2, seccomp.MASKED_EQ, mmap.PROT_EXEC, mmap.PROT_EXEC))
more.load()  # sets no_new_privs, as NoNewPrivileges does

rules = seccomp.SyscallFilter(seccomp.ERRNO(filters["errno"]))
for name in filters["calls"]:
    try:
        rules.add_rule(seccomp.ALLOW, name)
    except (RuntimeError, ValueError):  # a call of another processor
        continue
rules.load()  # the last one: it allows no other
os.execv(sys.argv[2], sys.argv[2:])
