"""``--trace FILE``: the file is made before anything is waited for, and ended with the command."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from teds_provision.cli.context import App
from teds_provision.errors import StoreFailure
from teds_provision.lazy import late

if TYPE_CHECKING:
    from teds_provision.links import Trace
    from teds_provision.trace import recorder
else:  # most runs have no trace
    recorder = late("teds_provision.trace.recorder")


@contextmanager
def tracing(path: Path | None) -> Iterator[Trace | None]:
    """Give the trace that ``path`` names, None for none. A command whose trace is not whole, and all else well, is 7.

    Raises UsageFailure where the file is there already, NotFound without its folder, StoreFailure.
    """
    if path is None:
        yield None
        return
    app = App.current
    trace = recorder.open_trace(path, app.warn if app is not None else print)
    try:
        yield trace
    finally:
        trace.close()
    if trace.failure:  # it was told when it happened, and the result stands on stdout already
        raise click.exceptions.Exit(StoreFailure.exit_code)
