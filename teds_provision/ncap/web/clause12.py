"""Paths of IEEE 1451.0-2007 clause 12 (HTTP), read only, off by default: for old clients of an NCAP.

TIMDiscovery, TransducerDiscovery, ReadData, ReadTeds, ReadRawTeds, as public programs of that clause use them: names of
parameters without regard to case, ``.htm`` behind a path or not, answers in XML, text or JSON (``responseFormat``, or
``format=1`` and ``0``). A ``timId`` is a number from 1 in the order in which nodes were seen, or the UUID itself.
ReadData gives the last value of a node that is measured, in the SI unit of its datasheet; it starts nothing.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from typing import Any, Final
from xml.etree import ElementTree

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from teds_provision.errors import NotFoundError, TedsProvisionError, UsageError
from teds_provision.ncap.daemon import Daemon
from teds_provision.ncap.web.responses import reading
from teds_provision.sanitize import printable

_DIGITS: Final = 5  # of a number; Python raises an error for four thousand
NO_ERROR, NO_SUCH, NO_VALUE, BAD_ARGUMENT, FAILED = 0, 1, 2, 3, 4
Fields = dict[str, Any]


class Clause12:
    """The five resources over one daemon."""

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon
        self._tims: dict[str, int] = {}
        self._resources: Final[dict[str, Callable[[dict[str, str]], Fields]]] = {
            "Discovery/TIMDiscovery": self.tims,
            "Discovery/TransducerDiscovery": self.transducers,
            "TransducerAccess/ReadData": self.read_data,
            "TEDSManager/ReadTeds": self.read_teds,
            "TEDSManager/ReadRawTeds": self.read_raw_teds,
        }

    def routes(self) -> list[Route]:
        """GET /1451/… in any case, with and without .htm."""
        return [Route("/1451/{path:path}", self._answer)]

    async def _answer(self, request: Request) -> Response:
        path = request.path_params["path"].removesuffix(".htm")
        name = next((path_known for path_known in self._resources if path_known.lower() == path.lower()), None)
        if name is None:
            raise NotFoundError(
                "This clause 12 path is not supported.", hint=f"Supported: {', '.join(self._resources)}."
            )
        given = {key.lower(): value for key, value in request.query_params.items()}
        try:
            fields = {"errorCode": NO_ERROR, **await reading(self._resources[name], given)}
        except NotFoundError as error:
            fields = {"errorCode": NO_SUCH, "errorMessage": error.message}
        except UsageError as error:
            fields = {"errorCode": BAD_ARGUMENT, "errorMessage": error.message}
        except TedsProvisionError as error:
            fields = {"errorCode": FAILED, "errorMessage": error.message}
        return _shown(name.rpartition("/")[2], fields, given)

    # -- the resources -----------------------------------------------------------------------------------------------

    def tims(self, _given: dict[str, str]) -> Fields:
        """Return every node that is present."""
        present = [uuid for uuid in self._daemon.directory.uuids() if self._daemon.directory.seen(uuid).present]
        numbers = [self._number(uuid) for uuid in present]
        return {"timIds": ",".join(map(str, numbers)), "uuids": ",".join(present)}

    def transducers(self, given: dict[str, str]) -> Fields:
        """Return the channels of one transducer module."""
        uuid = self._uuid(given)
        channels = self._daemon.directory.channel_names(uuid)
        return {
            "timId": self._number(uuid),
            "channelIds": ",".join(str(number) for number, _ in channels),
            "transducerNames": ",".join(name.replace(",", " ") for _, name in channels),
        }

    def read_data(self, given: dict[str, str]) -> Fields:
        """Return the last value of a channel."""
        uuid, channel = self._uuid(given), _integer(given, "channelId")
        if channel not in {number for number, _ in self._daemon.directory.channel_names(uuid)}:
            raise NotFoundError(f"Node {uuid} has no channel {channel}.")
        last = self._daemon.live.last(uuid, channel)
        ids = {"timId": self._number(uuid), "channelId": channel}
        if last is None or last.value is None:
            return {"errorCode": NO_VALUE, **ids, "transducerData": ""}
        return {**ids, "transducerData": last.value, "timestamp": last.time}

    def read_teds(self, given: dict[str, str]) -> Fields:
        """Return one TEDS with its fields decoded."""
        uuid, channel, code = self._teds(given)
        found, _ = self._daemon.sheets.as_json(uuid)
        for block in found["teds"]:
            if (block.get("channel") or 0, block.get("access_code")) == (channel, code):
                fields = {field.get("name", ""): field.get("text", "") for field in block["fields"]}
                ids = {"timId": self._number(uuid), "channelId": channel, "tedsType": code}
                return {**ids, "teds": json.dumps(fields, ensure_ascii=False)}
        raise NotFoundError(f"Node {uuid} has no TEDS {code} of channel {channel}.")

    def read_raw_teds(self, given: dict[str, str]) -> Fields:
        """Return one TEDS as octets in base64."""
        uuid, channel, code = self._teds(given)
        octets = self._daemon.sheets.read(uuid).image.blocks.get((channel, code))
        if octets is None:
            raise NotFoundError(f"Node {uuid} has no TEDS {code} of channel {channel}.")
        raw = base64.b64encode(octets).decode()
        return {"timId": self._number(uuid), "channelId": channel, "tedsType": code, "rawTEDS": raw}

    # -- names -------------------------------------------------------------------------------------------------------

    def _number(self, uuid: str) -> int:
        return self._tims.setdefault(uuid, len(self._tims) + 1)

    def _uuid(self, given: dict[str, str]) -> str:
        word = given.get("timid", "")
        self.tims({})  # assigns numbers in the order in which nodes are seen
        found = next((uuid for uuid, number in self._tims.items() if str(number) == word), None)
        if found is not None:
            return found
        if not word:
            raise UsageError("timId is missing.")
        return self._daemon.known(word)

    def _teds(self, given: dict[str, str]) -> tuple[str, int, int]:
        channel = _integer(given, "channelId") if "channelid" in given else 0
        return self._uuid(given), channel, _integer(given, "tedsType")


def _integer(given: dict[str, str], name: str) -> int:
    word = given.get(name.lower(), "")
    if not word.isdecimal() or len(word) > _DIGITS or int(word) > 0xFFFF:
        raise UsageError(f"{name} must be a number.")
    return int(word)


def _shown(name: str, fields: Fields, given: dict[str, str]) -> Response:
    form = given.get("responseformat", {"1": "xml", "0": "text"}.get(given.get("format", ""), "xml")).lower()
    if form == "json":
        return JSONResponse(fields)
    if form == "text":
        return Response("".join(f"{printable(str(value))}\n" for value in fields.values()), media_type="text/plain")
    root = ElementTree.Element(f"{name}HTTPResponse")
    for key, value in fields.items():
        ElementTree.SubElement(root, key).text = printable(str(value))
    return Response(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True), media_type="application/xml")
