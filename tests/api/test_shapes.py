"""The shapes of the API: what a type says is what is published, and exactly that is let in."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from teds_provision import client, ncap
from teds_provision.api import bodies
from teds_provision.api.operations import OPERATIONS, document
from teds_provision.api.schema import BadRequestError, read, schema_of

BODIES = [operation.body for operation in OPERATIONS if operation.body is not None]
SCHEMAS = document()["components"]["schemas"]
TEXTS = st.sampled_from(["", "transparent", "free", "gripper", "x.toml", "../x", "noise", "ab" * 10])
NUMBERS = st.sampled_from(
    [0, 1, -1, 1.0, 0.5, 20, 61, 255, 256, 1e6, 1000.0, 10_001, 10**30, 1e300, 1e301, -0.0]
) | st.integers(-5, 300)
VALUES = st.recursive(
    st.none() | st.booleans() | NUMBERS | TEXTS,
    lambda search_strategy: st.lists(search_strategy, max_size=3),
    max_leaves=4,
)


@pytest.mark.parametrize("body", BODIES, ids=lambda body: str(body.__name__))
@given(data=st.data())
def test_a_body_is_refused_if_and_only_if_its_published_schema_forbids_it(body: type[Any], data: st.DataObject) -> None:
    names = st.sampled_from([field.name for field in dataclasses.fields(body)] + ["x"])
    members = data.draw(st.dictionaries(names, VALUES, max_size=4))
    published = jsonschema.Draft202012Validator(schema_of(body, {})).is_valid(members)
    try:
        read(body, json.dumps(members).encode())
        taken = True
    except BadRequestError:
        taken = False
    assert taken == published


@pytest.mark.parametrize(
    ("body", "members", "fits"),
    [
        (bodies.NewMeasurement, {}, False),
        (bodies.NewMeasurement, {"group": "arm"}, True),
        (bodies.NewMeasurement, {"group": "arm", "match": None}, True),
        (bodies.NewMeasurement, {"group": "arm", "match": "all"}, False),
        (bodies.NewMeasurement, {"group": "arm", "uuids": []}, True),
        (bodies.NewMeasurement, {"group": "arm", "uuids": ["arm"]}, False),
        (bodies.NewMeasurement, {"uuids": []}, False),
        (bodies.NewVirtual, {"name": "arm"}, False),
        (bodies.NewVirtual, {"profile": "gripper"}, True),
        (bodies.NewVirtual, {"profile": "gripper", "content": ""}, False),
        (bodies.SetPoint, {}, False),
        (bodies.SetPoint, {"value": 1.0, "hold": 0}, True),
        (bodies.SetPoint, {"hold": 0.5}, False),
    ],
)
def test_of_members_that_exclude_each_other_one_is_sent(body: type[Any], members: dict[str, Any], fits: bool) -> None:
    """The property above rarely draws two that fit."""
    assert jsonschema.Draft202012Validator(schema_of(body, {})).is_valid(members) == fits
    with nullcontext() if fits else pytest.raises(BadRequestError):
        read(body, json.dumps(members).encode())


@pytest.mark.parametrize("match", ["", "a", "\u00e4" * 1000, "a" * 1001])
def test_a_text_is_as_long_as_its_published_schema_lets_it_be(match: str) -> None:
    published = jsonschema.Draft202012Validator(schema_of(bodies.NewMeasurement, {})).is_valid({"match": match})
    assert published == (0 < len(match) <= 1000)
    message = f"'match' must have 1 to 1000 characters, not {len(match)}."
    with nullcontext() if published else pytest.raises(BadRequestError, match=message):
        assert read(bodies.NewMeasurement, json.dumps({"match": match}).encode()).match == match


def test_the_end_of_a_pattern_is_the_end_of_the_text() -> None:
    """ECMA 262, which JSON Schema means, lets no line end pass before ``$``; Python does."""
    with pytest.raises(BadRequestError, match="'profile' must match"):
        read(bodies.Order, b'{"profile": "gripper\\n"}')


@given(st.text(max_size=40) | st.binary(max_size=40).map(lambda octets: octets.decode("latin-1")))
@example('{"mode": NaN}')
@example('{"mode": "\\ud83d"}')
@example("[" * 100_000)
@example("1" * 5000)
def test_what_is_no_json_object_is_refused_and_nothing_worse(text: str) -> None:
    with suppress(BadRequestError):
        assert read(bodies.Nothing, text.encode()) == bodies.Nothing()


@pytest.mark.parametrize(
    "text",
    [
        '{"mode": "whitelist", "mode": "whitelist"}',
        '{"mode": "whitelist", "m\\u006fde": "transparent"}',
        '{"mode": {"a": 1, "a": 1}}',
    ],
)
def test_equal_keys_are_refused_at_every_depth(text: str) -> None:
    with pytest.raises(BadRequestError, match="appears twice"):
        read(bodies.Detection, text.encode())


@pytest.mark.parametrize("form", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-le", "latin-1"])
def test_a_body_is_utf_8_without_a_byte_order_mark(form: str) -> None:
    text = '{"name": "pr\u00fcfstand", "uuids": []}'
    assert read(bodies.NewGroup, text.encode()).name == "pr\u00fcfstand"
    with pytest.raises(BadRequestError, match="not valid JSON"):
        read(bodies.NewGroup, text.encode(form))


NO_JSON = "The request body is not valid JSON."


@pytest.mark.parametrize(
    ("octets", "message", "hint"),
    [
        (b'{"name": NaN}', NO_JSON, ""),
        (b'{"name": -Infinity}', NO_JSON, ""),
        (b'{"name": "\\ud83d"}', NO_JSON, ""),
        (b'{"name": "\\ude00\\ud83d"}', NO_JSON, ""),
        (b'{"uuids": ["a", "\\udc00"]}', NO_JSON, ""),
        (b'{"\\ud83d": 1}', NO_JSON, ""),
        (b'{"name": "\xed\xa0\xbd"}', NO_JSON, ""),
        (b"[" * 100_000, NO_JSON, ""),
        (b'{"name": ' + b"1" * 5000 + b"}", NO_JSON, ""),
        (b" ", NO_JSON, ""),
        (b'{"name": 1, "name": 1}', "Member 'name' appears twice.", "Send each member once."),
        (b'{"%b": 1, "%b": 1}' % (b"x" * 65, b"x" * 65), f"Member '{'x' * 64}' appears twice.",
         "Send each member once."),
        (b"[]", "The request body must be a JSON object.", ""),
        (b"null", "The request body must be a JSON object.", ""),
    ],
)  # fmt: skip
def test_a_body_with_two_meanings_or_none_is_refused(octets: bytes, message: str, hint: str) -> None:
    with pytest.raises(BadRequestError) as refused:
        read(bodies.NewGroup, octets)
    assert (refused.value.message, refused.value.hint) == (message, hint)


def test_both_halves_of_a_surrogate_pair_are_one_character() -> None:
    assert read(bodies.NewGroup, b'{"name": "\\ud83d\\ude00", "uuids": []}').name == "\U0001f600"


def test_a_member_that_is_null_is_as_one_that_is_not_there() -> None:
    assert read(bodies.NewVirtual, b'{"profile": "gripper", "name": null}') == bodies.NewVirtual(profile="gripper")
    with pytest.raises(BadRequestError, match="'mode' must be"):
        read(bodies.Detection, b'{"mode": null}')


def test_whole_numbers_and_numbers_come_as_what_they_are() -> None:
    found = read(bodies.NewMeasurement, b'{"group": "g", "channels": [1.0], "rate": 5}')
    assert (found.channels, found.rate) == ([1], 5.0)
    assert (type((found.channels or [])[0]), type(found.rate)) == (int, float)


@pytest.mark.parametrize(
    ("body", "members", "message"),
    [
        (bodies.NewGroup, {}, "Member 'name' is missing."),
        (bodies.NewGroup, {"name": "g", "colour": 1}, "Unknown member 'colour'."),
        (bodies.NewGroup, {"name": "g", "uuids": ["a", 2]}, "'uuids[1]' must be of type string, not 2."),
        (bodies.NewMeasurement, {"group": "g", "rate": 0}, "'rate' must be between 0.001 and 1e+06, not 0."),
        (bodies.NewMeasurement, {"group": "g", "kind": "x"}, "'kind' must be one of periodic, event, free, not"),
        (bodies.NewMeasurement, {}, 'A measurement needs one of "group", "uuids" and "match".'),
        (bodies.SetPoint, {"hold": 1}, "to let it go."),
    ],
)
def test_a_refusal_names_the_member_and_what_it_may_be(body: type[Any], members: dict[str, Any], message: str) -> None:
    with pytest.raises(BadRequestError) as refused:
        read(body, json.dumps(members).encode())
    assert message in refused.value.message


@pytest.mark.parametrize(
    ("method", "body", "besides"),
    [
        (client.Client.provision, bodies.Order, {"node"}),
        (client.Client.set, bodies.SetPoint, {"node", "channel"}),
        (client.Client.write_teds, bodies.SheetText, {"node", "dry_run"}),
        (client.Client.login_url, bodies.LoginLink, set()),
        (client.Client.set_detection, bodies.Detection, set()),
    ],
)
def test_the_client_takes_what_the_body_takes(method: Any, body: type[Any], besides: set[str]) -> None:
    members = {field.name for field in dataclasses.fields(body)} - {"format"}  # the content shows what it is
    assert set(inspect.signature(method).parameters) - {"self"} == members | besides


# -- the page ----------------------------------------------------------------------------------------------------------

SHAPES = Path(ncap.__file__).parent / "page" / "js" / "shapes.js"
READ_AS = {"scaleOf": "Channel", "turnOf": "Channel", "channel": "Channel", "node": "Node", "status": "Status"}
"""Which schema the argument ``wire`` of a function has; ``link`` of status is a Link."""
FREE = {"power", "live", "moment", "modeOf"}  # what has no schema: flags of a battery, messages of /live, one value


def member(schema: dict[str, Any], name: str) -> dict[str, Any] | None:
    for item in schema.get("anyOf", [schema]):
        whole = SCHEMAS[item["$ref"].rpartition("/")[2]] if "$ref" in item else item
        if name in whole.get("properties", {}):
            return dict(whole["properties"][name])
    return None


def test_the_page_reads_only_members_that_the_description_has() -> None:
    text = SHAPES.read_text(encoding="utf-8")
    functions = dict(re.findall(r"^(?:export )?function (\w+)\([^)]*\) \{\n(.*?)^\}", text, re.MULTILINE | re.DOTALL))
    assert set(functions) == {*READ_AS, *FREE}
    wrong, walked = [], 0
    for function, schema in READ_AS.items():
        starts = {"wire": SCHEMAS[schema], "link": SCHEMAS["Link"], "shown": SCHEMAS["Shown"]}
        for variable, path in re.findall(r"\b(wire|link|shown)((?:\??\.\w+)+)", functions[function]):
            at = starts[variable]
            for name in re.findall(r"\w+", path):
                if name in ("map", "replace"):
                    break  # what JavaScript does with it
                found = member(at, name)
                walked += 1
                if found is None:
                    wrong.append(f"{function}: {variable}{path}: no {name}")
                    break
                at = found
    assert not wrong
    assert walked > 30


def test_the_page_knows_the_states_that_a_node_has_in_a_measurement() -> None:
    states = re.search(r"return \{ (.*) \}\[state\]", SHAPES.read_text(encoding="utf-8"))
    assert states is not None
    assert set(re.findall(r"(\w+): \"", states[1])) <= set(SCHEMAS["Report"]["properties"]["state"]["enum"])
