"""The directory of Thing Descriptions, without a service: which nodes it lists, and which address it states."""

from __future__ import annotations

import asyncio
import json
from types import SimpleNamespace
from typing import Any, cast

import pytest
from starlette.requests import Request

from teds_provision.api.operations import MOST_NODES
from teds_provision.errors import NotFoundError
from teds_provision.ncap.web import wot


@pytest.fixture
def described(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replace the description of a node by its UUID and the base; node "00" has no authentic datasheet."""
    asked: list[str] = []

    def described_node(_station: object, uuid: bytes) -> str:
        asked.append(uuid.hex())
        if uuid == b"\0":
            raise NotFoundError("No datasheet is known here.")
        return uuid.hex()

    monkeypatch.setattr(wot, "described_node", described_node)
    monkeypatch.setattr(wot, "thing_description", lambda node, base: {"id": node, "base": base})
    return asked


def daemon_with(*uuids: str) -> Any:
    return cast(Any, SimpleNamespace(station=None, directory=SimpleNamespace(uuids=lambda: list(uuids))))


def test_a_node_without_an_authentic_datasheet_is_left_out_and_no_other(described: list[str]) -> None:
    found = wot._descriptions(daemon_with("aa", "00", "bb"), "http://arm:8451")
    assert found == [{"id": "aa", "base": "http://arm:8451"}, {"id": "bb", "base": "http://arm:8451"}]
    assert described == ["aa", "00", "bb"]


def test_as_many_nodes_are_listed_as_an_answer_of_the_api_has(described: list[str]) -> None:
    assert len(wot._descriptions(daemon_with(*["aa"] * (MOST_NODES + 1)), "")) == MOST_NODES


def test_the_base_is_the_address_that_the_client_asked(described: list[str]) -> None:
    scope = {
        "type": "http", "method": "GET", "path": "/.well-known/wot", "scheme": "https", "server": ("::1", 8451),
        "query_string": b"", "headers": [(b"host", b"arm.example:8451")],
    }  # fmt: skip
    answer = asyncio.run(wot.route(daemon_with("aa")).endpoint(Request(scope)))
    assert answer.media_type == "application/ld+json"
    assert json.loads(answer.body) == [{"id": "aa", "base": "https://arm.example:8451"}]
