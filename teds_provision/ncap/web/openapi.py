"""The description of the API as OpenAPI 3.1, from one table of its operations; tested against the answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

from teds_provision import __version__
from teds_provision.ncap.nodes.roster import MOST_SHOWN
from teds_provision.ncap.web.schemas import FLAG, INTEGER, SCHEMAS, Schema, listed, maybe, members, ref, text


@dataclass(frozen=True)
class Operation:
    """One method of one path: what it does, what it takes, what it answers."""

    method: str
    path: str
    does: str
    answer: Schema
    body: Schema | None = None
    status: int = 200
    query: dict[str, Schema] = field(default_factory=dict)
    document: bool = False  # whether it may answer a document that is no JSON


_NODES: Final = members("nodes", nodes=listed(ref("Node")))
_SOME_NODES: Final = members("nodes total", nodes=listed(ref("Node")), total=INTEGER)
_GROUPS: Final = members("groups", groups=listed(ref("Group")))
_MEASUREMENTS: Final = members("measurements", measurements=listed(ref("Measurement")))
_NAMES: Final = members("names", names=listed(ref("Name")))
_VIRTUAL: Final = members("virtual", virtual=listed(ref("Virtual")))
_MODE: Final = members("mode", closed=True, mode=ref("Mode"))
_EMPTY: Final = members(closed=True)

OPERATIONS: Final = (
    Operation("GET", "/status", "Version, station, links, detection, sinks, clock quality, budget.", ref("Status")),
    Operation("GET", "/detection", "Which nodes are taken up.", _MODE),
    Operation("PUT", "/detection", "Change that, and look at all links anew.", _MODE, _MODE),
    Operation("POST", "/discover", "Ask every link now.", _NODES, _EMPTY),
    Operation(
        "GET", "/nodes", "Every node: those that are there first, a thousand at a time; total: how many there are.",
        _SOME_NODES,
        query={
            "limit": {"type": "integer", "minimum": 1, "maximum": MOST_SHOWN},
            "offset": {"type": "integer", "minimum": 0, "maximum": 10_000_000},
        },
    ),
    Operation("GET", "/nodes/{uuid}", "One node, by UUID, prefix or name.", ref("Node")),
    Operation(
        "GET", "/nodes/{uuid}/teds", "Its datasheet, decoded and checked; or as a document.",
        {"anyOf": [ref("Sheet"), ref("Document")]},
        query={"format": text(enum=["json", "xml", "hex"])}, document=True,
    ),
    Operation(
        "PUT", "/nodes/{uuid}/teds", "Write what a document says; or show what that would change.", ref("SheetPlan"),
        members(
            "content", closed=True, content=text(description="XML, JSON or hex"), format=maybe("string"),
            accept_calibration=maybe("string", description="why a calibration that the guard refuses is right"),
        ),
        query={"dry_run": text()},
    ),
    Operation("GET", "/nodes/{uuid}/provision", "How its provisioning stands.", ref("Provisioning")),
    Operation(
        "POST", "/nodes/{uuid}/provision", "Provision it (uuid: next, for the next tap); or cancel the waiting.",
        ref("Provisioning"),
        members(
            closed=True, profile=maybe("string"), name=maybe("string"), calibration=maybe("string"),
            calibration_name=maybe("string"), cancel=FLAG,
        ),
        status=202,
    ),
    Operation(
        "PUT", "/nodes/{uuid}/channels/{number}", "Set an actuator and hold it; hold 0 lets go.", ref("Applied"),
        members(
            closed=True, value=maybe("number"), unit=maybe("string"), hold=maybe("number", minimum=0, maximum=60),
        ),
    ),
    Operation("GET", "/groups", "Measurement groups.", _GROUPS),
    Operation(
        "POST", "/groups", "Make one.", _GROUPS, members("name", closed=True, name=text(), uuids=listed(text())),
        status=201,
    ),
    Operation("PUT", "/groups/{name}", "Other members.", _GROUPS, members("uuids", closed=True, uuids=listed(text()))),
    Operation("DELETE", "/groups/{name}", "Delete one.", _GROUPS),
    Operation("GET", "/measurements", "What is measured.", _MEASUREMENTS),
    Operation(
        "POST", "/measurements", "Measure, after every restart too, until it is deleted.", ref("Measurement"),
        members(
            closed=True, group=maybe("string"), uuids=listed(text()), channels=listed(INTEGER),
            rate=maybe("number", minimum=0.001, maximum=1e6),
            kind=maybe("string", enum=["periodic", "event", "free", None]), trigger=FLAG,
            sinks=listed(text(description="ros1, ros2, the name of a broker, or of a file")),
            actuators={"type": "boolean", "description": "may set points come by topics of ROS; true unless said"},
            dead_man={"type": "integer", "minimum": 20, "maximum": 10000, "description": "ms, else the station's"},
            scalar_rate={"type": "number", "minimum": 0, "maximum": 1000, "description": "Hz, 10 unless said"},
        ),
        status=201,
    ),
    Operation("DELETE", "/measurements/{id}", "End one and forget it.", _MEASUREMENTS),
    Operation("GET", "/names", "The topic of every channel.", _NAMES),
    Operation(
        "PUT", "/names", "Rename one; null: as it was made.", _NAMES,
        members("uuid", closed=True, uuid=text(), channel=INTEGER, name=maybe("string"), topic=maybe("string")),
    ),
    Operation("GET", "/virtual", "Virtual transducers of this station.", _VIRTUAL),
    Operation(
        "POST", "/virtual", "Make one from a datasheet or a profile.", ref("Virtual"),
        members(
            closed=True, name=maybe("string"), source=text(description="noise, sine:S, ramp:S, file:/P, unix:/P"),
            content=maybe("string"), format=maybe("string"), profile=maybe("string"),
        ),
        status=201,
    ),
    Operation("DELETE", "/virtual/{uuid}", "End one, and its key with it.", _VIRTUAL),
    Operation("GET", "/profiles", "Transducer types that can be built.",
              members("profiles", profiles=listed(members("name title")))),
    Operation(
        "GET", "/log", "The newest entries of the audit log that are meant, of those before number ``before``.",
        members("entries intact", entries=listed(ref("Entry")), intact=FLAG, why=text()),
        query={
            "limit": {"type": "integer", "minimum": 1, "maximum": 10000},
            "before": {"type": "integer", "minimum": 1, "maximum": 10_000_000},
            "uuid": text(),
            "text": {"type": "string", "maxLength": 200},
            "act": text(),
            "failed": text(),
            "since": text(description="ISO 8601, or unix seconds"),
        },
    ),
    Operation("POST", "/login-link", "The page's address with a token that works once (Unix socket alone).",
              members("url", url=text()), members(closed=True, read_only=FLAG)),
    Operation("GET", "/lend", "Have the readers for as long as the answer goes on (Unix socket alone).", text(),
              document=True),
    Operation("GET", "/openapi.json", "This description.", members("openapi info paths")),
)  # fmt: skip

REFUSALS: Final = {
    "400": "not HTTP as it should be, or a member of the body comes twice",
    "401": "no token, or one that is not good",
    "403": "a foreign Origin, or a read-only token that changes something",
    "404": "no such thing",
    "405": "not for this resource",
    "409": "frozen: it is being measured",
    "413": "more than 1 MiB",
    "415": "what changes anything comes as JSON",
    "421": "a foreign Host",
    "422": "understood and refused: guard, limits, policy, bad data",
    "423": "claimed by another, or busy",
    "429": "too many wrong tokens",
    "500": "a bug",
    "503": "the link or the store failed",
}


def document() -> dict[str, Any]:
    """The whole description."""
    paths: dict[str, dict[str, Any]] = {}
    for one in OPERATIONS:
        paths.setdefault(one.path, {})[one.method.lower()] = _operation(one)
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "teds-provision: a base station",
            "version": __version__,
            "description": "Values are in the SI unit of the datasheet, times in unix seconds unless they are texts.",
        },
        "servers": [{"url": "/api/v1"}],
        "security": [{"token": []}, {"browser": []}],
        "paths": paths,
        "components": {
            "schemas": SCHEMAS,
            "securitySchemes": {
                "token": {"type": "http", "scheme": "bearer"},
                "browser": {"type": "apiKey", "in": "cookie", "name": "ncap-PORT"},
            },
            "responses": {
                key: {"description": why, "content": {"application/json": {"schema": ref("Error")}}}
                for key, why in REFUSALS.items()
            },
        },
    }


def _parameters(one: Operation) -> list[dict[str, Any]]:
    names = [part[1:-1] for part in one.path.split("/") if part.startswith("{")]
    path = [
        {"name": name, "in": "path", "required": True, "schema": INTEGER if name == "number" else text()}
        for name in names
    ]
    return [*path, *({"name": name, "in": "query", "schema": schema} for name, schema in one.query.items())]


def _operation(one: Operation) -> dict[str, Any]:
    parameters = _parameters(one)
    content: dict[str, Any] = {"application/json": {"schema": one.answer}}
    if one.document:
        content |= {"application/xml": {"schema": text()}, "text/plain": {"schema": text()}}
    answers: dict[str, Any] = {str(one.status): {"description": one.does, "content": content}}
    if one.status == 202:
        answers["200"] = answers["202"]  # a waiting that was cancelled
    answers |= {key: {"$ref": f"#/components/responses/{key}"} for key in REFUSALS}
    words = "".join(part.strip("{}").title().replace("-", "") for part in one.path.split("/"))
    found: dict[str, Any] = {
        "operationId": f"{one.method.lower()}{words}",
        "summary": one.does,
        "parameters": parameters,
        "responses": answers,
    }
    if one.body is not None:
        found["requestBody"] = {"required": True, "content": {"application/json": {"schema": one.body}}}
    return found
