"""Every operation of the API, and its description as OpenAPI 3.1; tested against the routes and the answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

from teds_provision import __version__
from teds_provision.api import answers, bodies
from teds_provision.api.schema import Schema, schema_of
from teds_provision.shapes.problem import Error

API: Final = "/api/v1"
MOST_NODES: Final = 1000
"""Nodes in one answer."""
MOST_ENTRIES: Final = 10_000
"""Entries of the log in one answer."""
FURTHEST: Final = 10_000_000
LONGEST_TEXT: Final = 200
LAST_CHANNEL: Final = 255
MOST_POINTS: Final = 3600
"""Bins of the past of a channel in one answer."""
LARGEST_IMAGE: Final = 4 << 20
"""Octets of the largest firmware image."""
MOST_AT_ONCE: Final = 24
"""Boards that are updated at once, as with ``update --parallel``."""
LONGEST_WAIT: Final = 3600
"""Seconds for which a restarted board is waited for, as with ``update --wait``."""

_TEXT: Final[Schema] = {"type": "string"}
_DATASHEET_TAG: Final[Schema] = {
    "type": "string",
    "description": "ETag of the datasheet that was reviewed; if the node has another one by now: 412, nothing written",
}
_MOMENT: Final[Schema] = {"type": "string", "description": "ISO 8601, or unix seconds"}


@dataclass(frozen=True)
class Operation:
    """One method of one path: what it does, what it takes, what it answers.

    ``answer`` is a type of ``answers``, several of which one is given, ``str`` for text, None for any object.
    """

    method: str
    path: str
    does: str
    answer: Any
    body: type[Any] | None = None
    status: int = 200
    query: dict[str, Schema] = field(default_factory=dict)
    document: bool = False  # True if the answer may be a document that is not JSON
    header: dict[str, Schema] = field(default_factory=dict)  # optional headers of the request
    tag: str = ""  # when the answer has an ETag; "" for never
    octets: int = 0  # longest body, if it is a file and not JSON


def _integer(least: int, most: int) -> Schema:
    return {"type": "integer", "minimum": least, "maximum": most}


OPERATIONS: Final = (
    Operation("GET", "/status", "Version, station, links, detection, sinks, clock quality, budget.", answers.Status),
    Operation("GET", "/detection", "Get the detection mode.", answers.DetectionMode),
    Operation("PUT", "/detection", "Set the detection mode, and look at every link again.", answers.DetectionMode,
              bodies.Detection),
    Operation("GET", "/plant", "Get the plant that this station belongs to; 404 where it joined none.", answers.Plant),
    Operation("GET", "/plant/nodes", "Find who holds a node, by what the plant's stations say.", answers.PlantNodes,
              query={"text": _TEXT}),
    Operation("GET", "/jobs", "List the jobs of the line.", answers.Jobs),
    Operation("GET", "/jobs/{id}", "Get how a job goes, by its id or its first digits.", answers.JobStatus),
    Operation("POST", "/discover", "Ask every link now.", answers.Found, bodies.Nothing),
    Operation("GET", "/nodes", "List nodes by name, those that are present first.", answers.Nodes,
              query={"limit": _integer(1, MOST_NODES), "offset": _integer(0, FURTHEST)}),
    Operation("GET", "/nodes/{uuid}", "Get a node, by UUID, prefix or name.", answers.Node),
    Operation("GET", "/nodes/{uuid}/past", "Get the last hour of a channel: least, greatest, count, invalid, lost.",
              answers.Past, query={"channel": _integer(1, LAST_CHANNEL), "from": _MOMENT, "until": _MOMENT,
                                   "points": _integer(1, MOST_POINTS)}),
    Operation("GET", "/nodes/{uuid}/teds", "Read a node's datasheet: decoded and checked, or as a document.",
              (answers.Sheet, answers.Document),
              query={"format": {"type": "string", "enum": ["json", "xml", "hex"]}}, document=True,
              tag="always"),
    Operation("PUT", "/nodes/{uuid}/teds", "Write a datasheet, or show what that would change.", answers.SheetPlan,
              bodies.SheetText, query={"dry_run": _TEXT}, header={"If-Match": _DATASHEET_TAG}, tag="with dry_run"),
    Operation("GET", "/nodes/{uuid}/provision", "Follow a node's provisioning.", answers.Provisioning),
    Operation("POST", "/nodes/{uuid}/provision",
              "Provision a node (next: whichever is tapped next), or stop waiting for it.", answers.Provisioning,
              bodies.Order, status=202),
    Operation("POST", "/nodes/{uuid}/locate", "Make a node blink or beep, to see which one it is.", answers.Located,
              bodies.Locate),
    Operation("GET", "/nodes/{uuid}/channels/{number}", "Get a channel with its last value.", answers.Channel),
    Operation("PUT", "/nodes/{uuid}/channels/{number}", "Set an actuator and hold it, or let it go.", answers.Applied,
              bodies.SetPoint),
    Operation("GET", "/updates", "List the firmware updates, the newest first.", answers.Updates),
    Operation("POST", "/updates",
              "Update the firmware of boards to the image in the body, or show the plan. One update runs at a time.",
              answers.Update, status=202, octets=LARGEST_IMAGE,
              query={
                  "nodes": {"type": "string", "description": "UUIDs, prefixes or names, separated by commas"},
                  "match": {"type": "string", "description": "in place of nodes: type:P, name:GLOB, group:G, …"},
                  "dry_run": {"type": "string", "description": "1: answer the plan (200), change nothing"},
                  "other_board": {"type": "string", "description": "the nodes of these, by commas, that get the image"
                                  " although it names another board, or none: a person was asked about each"},
                  "allow_downgrade": {"type": "string", "description": "1: install an older version, too"},
                  "parallel": _integer(1, MOST_AT_ONCE),
                  "wait": _integer(1, LONGEST_WAIT),
              }),
    Operation("GET", "/updates/{id}", "Follow an update.", answers.Update),
    Operation("DELETE", "/updates/{id}", "Begin no further board of an update; those that were begun are finished.",
              answers.Update),
    Operation("GET", "/groups", "List the measurement groups.", answers.Groups),
    Operation("POST", "/groups", "Create a group.", answers.Groups, bodies.NewGroup, status=201),
    Operation("PUT", "/groups/{name}", "Replace the members of a group.", answers.Groups, bodies.GroupMembers),
    Operation("DELETE", "/groups/{name}", "Delete a group.", answers.Groups),
    Operation("GET", "/measurements", "List the measurements.", answers.Measurements),
    Operation("POST", "/measurements", "Measure until deleted, across restarts of the station and of nodes.",
              answers.Measurement, bodies.NewMeasurement, status=201),
    Operation("GET", "/measurements/rate", "Propose the rate that bus, budget and machine can carry.",
              answers.Rate, query={"group": _TEXT, "uuids": _TEXT}),
    Operation("DELETE", "/measurements/{id}", "End a measurement and forget it.", answers.Measurements),
    Operation("GET", "/names", "List the name and topic of every channel.", answers.Names),
    Operation("PUT", "/names", "Rename a node or a channel.", answers.Names, bodies.NewName),
    Operation("GET", "/virtual", "List the virtual transducers of this station.", answers.Virtuals),
    Operation("POST", "/virtual", "Create a virtual transducer from a datasheet or a profile.", answers.Virtual,
              bodies.NewVirtual, status=201),
    Operation("DELETE", "/virtual/{uuid}", "Delete a virtual transducer and its key.", answers.Virtuals),
    Operation("GET", "/profiles", "List the transducer types that can be built.", answers.Profiles),
    Operation(
        "GET", "/log", "Search the audit log: the newest entries, or the newest before entry ``before``.", answers.Log,
        query={
            "limit": _integer(1, MOST_ENTRIES),
            "before": _integer(1, FURTHEST),
            "uuid": _TEXT,
            "text": {"type": "string", "maxLength": LONGEST_TEXT},
            "act": _TEXT,
            "failed": _TEXT,
            "since": _MOMENT,
        },
    ),
    Operation("POST", "/login-link", "Get the page's address with a token that works once (Unix socket only).",
              answers.Url, bodies.LoginLink),
    Operation("GET", "/lend", "Borrow the readers until this answer is closed (Unix socket only).", str,
              document=True),
    Operation("GET", "/nodes/{uuid}/let-go",
              "Have a measured node to write to until this answer is closed (Unix socket only).", str,
              query={"for": _TEXT}, document=True),
    Operation("GET", "/openapi.json", "Get this description.", None),
)  # fmt: skip

REFUSALS: Final = {
    "400": "malformed HTTP",
    "401": "no token, or one that is invalid or has expired",
    "403": "a foreign Origin, or a read-only token used to change something",
    "404": "not found",
    "405": "method not allowed",
    "409": "frozen: being measured",
    "412": "changed: the datasheet is no longer the one that If-Match names",
    "413": "body over 1 MiB; a firmware image over 4 MiB",
    "415": "a request that changes something must be JSON, a firmware image application/octet-stream",
    "421": "a foreign Host",
    "422": "bad-request: the body does not match its schema; other codes: guard, limits, policy, bad data",
    "423": "claimed by another station, or busy",
    "429": "too many wrong tokens",
    "500": "a bug",
    "503": "the link or the store failed",
}


def document() -> dict[str, Any]:
    """Return the whole description."""
    named: dict[str, Schema] = {}
    paths: dict[str, dict[str, Any]] = {}
    for operation in OPERATIONS:
        paths.setdefault(operation.path, {})[operation.method.lower()] = _operation(operation, named)
    error = schema_of(Error, named)
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "teds-provision: a base station",
            "version": __version__,
            "description": "Values are in the SI unit of the datasheet, times in unix seconds unless they are texts. "
            "/live (values and events) and /virtual/{name}/source (a simulation feeds its virtual transducer) are "
            "WebSockets: docs/ncap.md.",
        },
        "servers": [{"url": API}],
        "security": [{"token": []}, {"browser": []}],
        "paths": paths,
        "components": {
            "schemas": named,
            "securitySchemes": {
                "token": {"type": "http", "scheme": "bearer"},
                "browser": {"type": "apiKey", "in": "cookie", "name": "ncap-PORT"},
            },
            "responses": {
                key: {"description": why, "content": {"application/json": {"schema": error}}}
                for key, why in REFUSALS.items()
            },
        },
    }


def _operation(operation: Operation, named: dict[str, Schema]) -> dict[str, Any]:
    names = [part[1:-1] for part in operation.path.split("/") if part.startswith("{")]
    path = [
        {"name": name, "in": "path", "required": True, "schema": {"type": "integer"} if name == "number" else _TEXT}
        for name in names
    ]
    if isinstance(operation.answer, tuple):
        schema: Schema = {"anyOf": [schema_of(kind, named) for kind in operation.answer]}
    else:
        schema = {"type": "object"} if operation.answer is None else schema_of(operation.answer, named)
    content: dict[str, Any] = {"application/json": {"schema": schema}}
    if operation.document:
        content |= {"application/xml": {"schema": _TEXT}, "text/plain": {"schema": _TEXT}}
    responses: dict[str, Any] = {str(operation.status): {"description": operation.does, "content": content}}
    if operation.tag:
        responses[str(operation.status)]["headers"] = {
            "ETag": {"description": f"Names the datasheet that the node has ({operation.tag}).", "schema": _TEXT}
        }
    if operation.status == 202:
        responses["200"] = responses["202"]  # 200 for a cancelled wait or a plan
    responses |= {key: {"$ref": f"#/components/responses/{key}"} for key in REFUSALS}
    words = "".join(part.strip("{}").title().replace("-", "") for part in operation.path.split("/"))
    found: dict[str, Any] = {
        "operationId": f"{operation.method.lower()}{words}",
        "summary": operation.does,
        "parameters": [
            *path,
            *({"name": name, "in": "query", "schema": kind} for name, kind in operation.query.items()),
            *({"name": name, "in": "header", "schema": kind} for name, kind in operation.header.items()),
        ],
        "responses": responses,
    }
    if operation.octets:
        image = {"type": "string", "format": "binary", "maxLength": operation.octets}
        found["requestBody"] = {"required": True, "content": {"application/octet-stream": {"schema": image}}}
    if operation.body is not None:
        schema = schema_of(operation.body, named)
        found["requestBody"] = {"required": "required" in schema, "content": {"application/json": {"schema": schema}}}
    return found
