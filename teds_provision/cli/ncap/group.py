"""``ncap``: run it, ask it, let others in."""

from __future__ import annotations

import click

from teds_provision.cli.ncap.ask import detection, open_page, status
from teds_provision.cli.ncap.run import run
from teds_provision.cli.ncap.token import token
from teds_provision.cli.options import COMMAND_SETTINGS, examples


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples(
        "teds-provision ncap run --http 127.0.0.1:8351 --can socketcan:can0",
        "teds-provision ncap open",
        "teds-provision ncap status",
    ),
)
def ncap() -> None:
    """The base station as a service: finds nodes, measures what it shall, serves a page and an API."""


for one in (run, status, detection, open_page, token):
    ncap.add_command(one)
