"""What the answers of the API are made of: JSON schemas of 2020-12, as OpenAPI 3.1 takes them."""

from __future__ import annotations

from typing import Any, Final

Schema = dict[str, Any]


def text(**more: Any) -> Schema:
    """A text."""
    return {"type": "string", **more}


def maybe(kind: str, **more: Any) -> Schema:
    """That kind, or null."""
    return {"type": [kind, "null"], **more}


def listed(of: Schema) -> Schema:
    """A list."""
    return {"type": "array", "items": of}


def ref(name: str) -> Schema:
    """A schema by its name."""
    return {"$ref": f"#/components/schemas/{name}"}


def members(required: str = "", *, closed: bool = False, **properties: Schema) -> Schema:
    """An object; ``required`` are names with spaces between, ``closed`` takes no others; ``from_`` stands for from."""
    named = {name.removesuffix("_"): schema for name, schema in properties.items()}
    out: Schema = {"type": "object", "properties": named}
    if required:
        out["required"] = required.split()
    if closed:
        out["additionalProperties"] = False
    return out


def or_null(schema: Schema) -> Schema:
    """That, or null."""
    return {"anyOf": [schema, {"type": "null"}]}


NUMBER: Final[Schema] = {"type": "number"}
INTEGER: Final[Schema] = {"type": "integer"}
FLAG: Final[Schema] = {"type": "boolean"}
UUID: Final = text(pattern="^[0-9a-f]{20}$", description="20 hex digits")
TIME: Final[Schema] = {"type": "number", "description": "unix seconds"}

SCHEMAS: Final[dict[str, Schema]] = {
    "Error": members(
        "error",
        error=members("code message hint", code=text(), message=text(), hint=text()),
    ),
    "Problem": members("code message hint", code=text(), message=text(), hint=text()),
    "Check": members("name result why", name=text(), result=text(enum=["passed", "failed", "skipped"]), why=text()),
    "Channel": members(
        "number name kind unit shown low high uncertainty rate calibrated due overdue problem topic last actuator",
        number=INTEGER,
        name=text(),
        kind=maybe("string", enum=["sensor", "actuator", "event sensor", None]),
        unit=text(description="SI unit of every number here"),
        shown=members(
            "unit factor offset",
            unit=text(description="the unit for people: SI value × factor + offset"),
            factor=maybe("number"),
            offset=maybe("number"),
        ),
        low=maybe("number"),
        high=maybe("number"),
        uncertainty=maybe("number"),
        rate=maybe("number", description="samples a second that the datasheet allows"),
        calibrated=maybe("string"),
        due=maybe("string"),
        overdue=FLAG,
        problem=maybe("string", description="why it gives no values"),
        topic=maybe("string"),
        last=or_null(members("value valid time age", value=maybe("number"), valid=FLAG, time=TIME, age=NUMBER)),
        actuator=or_null(
            members("value unit safe", value=maybe("number"), unit=maybe("string"), safe=maybe("boolean"))
        ),
    ),
    "Report": members(
        "uuid state why",
        uuid=UUID,
        state=text(enum=["waiting", "running", "lost", "refused", "ended"]),
        why=text(),
        samples=INTEGER,
        lost=INTEGER,
        late=INTEGER,
        bad=INTEGER,
        invalid=INTEGER,
        invalid_why=listed(members("channel why count", channel=INTEGER, why=text(), count=INTEGER)),
        clock_error=maybe("number", description="seconds"),
    ),
    "Verdict": members(
        "verdict checks from at by",
        verdict=text(enum=["authentic", "unsigned", "unverified", "not authentic", "unproven"]),
        checks=listed(ref("Check")),
        at=text(),
        by=text(),
        from_=text(enum=["session", "kept", "plain"]),
    ),
    "Node": members(
        "uuid name link via present state verdict heard problem channels groups measurement power whitelisted virtual",
        uuid=UUID,
        name=maybe("string"),
        profile=maybe("string"),
        link=maybe("string"),
        via=maybe("string"),
        address=maybe("integer"),
        present=FLAG,
        last_seen=maybe("string"),
        tapped=maybe("number"),
        state=maybe("string"),
        mode=maybe("string", enum=["idle", "measuring", None]),
        whitelisted=FLAG,
        virtual=FLAG,
        fingerprint=maybe("string"),
        epoch=INTEGER,
        sequence=INTEGER,
        due=maybe("string"),
        verdict=or_null(ref("Verdict")),
        heard=or_null(ref("Verdict")),
        verified=maybe("string"),
        retired=maybe("string"),
        problem=or_null(ref("Problem")),
        busy=maybe("string"),
        group=maybe("string"),
        groups=listed(text()),
        measurement=maybe("string"),
        measuring=or_null(ref("Report")),
        power=maybe("object"),
        channels=listed(ref("Channel")),
    ),
    "Group": members("name uuids measuring", name=text(), uuids=listed(UUID), measuring=FLAG),
    "Measurement": members(
        "id group uuids rate kind trigger sinks actuators state why nodes files",
        id=text(),
        group=maybe("string"),
        uuids=listed(UUID),
        channels=listed(INTEGER),
        rate=maybe("number"),
        kind=maybe("string"),
        trigger=FLAG,
        sinks=listed(text()),
        actuators={"type": "boolean", "description": "whether set points come by topics"},
        dead_man={"type": "integer", "description": "ms after which an actuator without set points is safe"},
        created=text(),
        state=text(enum=["starting", "waiting", "running", "failed", "ended"]),
        why=text(),
        nodes=listed(ref("Report")),
        files=listed(text()),
    ),
    "Sink": members(
        "measurement name state written dropped error hint",
        measurement=text(),
        name=text(),
        state=text(),
        detail=text(),
        error=text(),
        hint=text(),
        written=INTEGER,
        dropped=INTEGER,
        octets=INTEGER,
        messages=INTEGER,
        recorder=FLAG,
        files=listed(text()),
    ),
    "Link": members(
        "place via state problem nodes strangers",
        place=text(),
        via=text(),
        virtual=FLAG,
        state=text(enum=["opening", "up", "down", "lent"]),
        problem=or_null(ref("Problem")),
        waiting=maybe("string"),
        notice=maybe("string", description="what came by last: another station under our address, an address twice"),
        since=TIME,
        nodes=INTEGER,
        strangers=INTEGER,
    ),
    "Status": members(
        "version station time url detection links measurements sinks clock_error budget write",
        version=text(),
        station=members("name fingerprint", name=text(), fingerprint=text()),
        started=TIME,
        time=TIME,
        url=maybe("string"),
        detection=ref("Mode"),
        adopt=FLAG,
        actuators={"type": "boolean", "description": "whether set points come by topics where a measurement lets them"},
        dead_man={"type": "integer", "description": "ms, where a measurement says no other; also of requests"},
        links=listed(ref("Link")),
        nodes=INTEGER,
        strangers=INTEGER,
        clients=INTEGER,
        measurements=listed(ref("Measurement")),
        sinks=listed(ref("Sink")),
        clock_error=maybe("number"),
        budget=members("used limit", used=NUMBER, limit=NUMBER),
        write=FLAG,
    ),
    "Mode": text(enum=["transparent", "whitelist"]),
    "Change": members(
        "channel field before after text",
        channel=INTEGER,
        access_code=INTEGER,
        field=text(),
        before=text(),
        after=text(),
        text=text(),
    ),
    "Finding": members("severity message hint", severity=text(), message=text(), hint=text()),
    "Sheet": members(
        "uuid read_now verdict checks from at by teds guard curves",
        uuid=UUID,
        read_now=FLAG,
        verdict=text(),
        at=text(),
        by=text(),
        checks=listed(ref("Check")),
        teds=listed({"type": "object"}),
        guard=listed(ref("Finding")),
        curves=listed(members("channel name x_unit y_unit points", channel=INTEGER, points=listed(listed(NUMBER)))),
        from_=text(enum=["session", "kept", "plain"]),
    ),
    "Document": members(
        "format teds",
        format=text(enum=["teds/1"]),
        teds=listed(members("channel access_code", channel=INTEGER, access_code=INTEGER, octets=text())),
    ),
    "SheetPlan": members(
        "uuid dry_run changes guard steps verdict",
        uuid=UUID,
        dry_run=FLAG,
        changes=listed(ref("Change")),
        guard=listed(ref("Finding")),
        steps=listed(members("name result seconds detail")),
        verdict=maybe("string"),
    ),
    "Provisioning": members(
        "uuid state waits_for until steps error verdict",
        uuid=text(),
        state=text(enum=["waiting", "running", "done", "failed", "cancelled"]),
        waits_for=maybe("string", enum=["tap", None]),
        until=maybe("number"),
        steps=listed(members("name result detail", name=text(), result=text(), detail=text())),
        error=or_null(ref("Problem")),
        verdict=maybe("string"),
    ),
    "Applied": members(
        "applied until safe",
        applied=or_null(members("channel value unit raw", channel=INTEGER, value=NUMBER, unit=text())),
        until=maybe("number"),
        safe=maybe("boolean", description="what the node itself said after it was let go"),
    ),
    "Name": members("uuid channel name topic", uuid=UUID, channel=INTEGER, name=maybe("string"), topic=text()),
    "Virtual": members(
        "uuid name source state channels",
        uuid=UUID,
        name=text(),
        source=text(),
        state=text(enum=["starting", "running", "ended"]),
        why=text(),
        channels=INTEGER,
    ),
    "Entry": members(
        "seq time who actor act uuid outcome detail failed",
        seq=INTEGER,
        time=TIME,
        who=text(),
        actor=text(description="the user, the name of a token, or page"),
        act=text(),
        uuid=or_null(UUID),
        subject=text(),
        outcome=text(),
        detail=text(),
        facts={"type": "object"},
        failed=FLAG,
    ),
}
