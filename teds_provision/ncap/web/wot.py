"""``/.well-known/wot``: Thing Descriptions of the nodes, for clients of the Web of Things.

An array of Thing Descriptions, as a directory lists them (WoT Discovery, section 7.3.2). The guard in front of it asks
for a token, as for every other path; any token that may read will do.
"""

from __future__ import annotations

import json
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from teds_provision.api.operations import MOST_NODES
from teds_provision.describe.described_node import described_node
from teds_provision.describe.thing_description import thing_description
from teds_provision.errors import TedsProvisionError
from teds_provision.ncap.daemon import Daemon
from teds_provision.ncap.web.responses import reading

PATH: Final = "/.well-known/wot"
_MEDIA_TYPE: Final = "application/ld+json"


def route(daemon: Daemon) -> Route:
    """Return the route; a node without an authentic datasheet, or without a name, is left out."""

    async def answer(request: Request) -> Response:
        host, server = request.headers.get("host", ""), request.scope.get("server")
        served = server is not None and server[1] is not None  # over the Unix socket Host is no address of the station
        base = f"{request.url.scheme}://{host}" if served and host else ""
        found = await reading(_descriptions, daemon, base)
        return Response(json.dumps(found, ensure_ascii=False), media_type=_MEDIA_TYPE)

    return Route(PATH, answer)


def _descriptions(daemon: Daemon, base: str) -> list[dict[str, Any]]:
    found = []
    for uuid in daemon.directory.uuids()[:MOST_NODES]:
        try:
            found.append(thing_description(described_node(daemon.station, bytes.fromhex(uuid)), base))
        except TedsProvisionError:
            continue
    return found
