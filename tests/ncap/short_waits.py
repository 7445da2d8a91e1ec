"""The program with a service that looks ten times as often at what no event reports; hundreds of tests wait for it.

Nothing of the program can ask for it: this passes the one argument of the service that holds its waits. Waits that a
missing event would fall back to are the usual ones, so that a test notices that the event is missing.

As a program: python -m tests.ncap.short_waits [words of the command line]
"""

from __future__ import annotations

import sys
from functools import partial

from teds_provision.__main__ import main
from teds_provision.ncap import service_run
from teds_provision.ncap.waits import Waits

PROGRAM = (sys.executable, "-m", "tests.ncap.short_waits")
SHORT = Waits(store=0.1, selection=0.2, keys=1.0, link=0.1, token=0.2, discovery=0.5)


if __name__ == "__main__":
    service_run.run = partial(service_run.run, waits=SHORT)
    main()
