"""``unlock``: a process that holds what opens the vault, in memory alone, until its time is over or ``lock``.

:mod:`.holding` is that process, :mod:`.asking` what every command says to it. Between them a Unix
socket of mode 0600 in the home, and on both sides a look at who is at the other end (SO_PEERCRED). Linux only.
"""
