"""The buses of a process, and a look at the links of a station; every link is a mock."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError, LinkError, NoNodeError, PolicyError, UsageError
from teds_provision.measure import buses as of_buses
from teds_provision.measure import exposure, link_survey
from teds_provision.measure.buses import Buses
from teds_provision.measure.exposure import Exposure, is_loopback
from teds_provision.measure.held_actuator import HeldActuator
from teds_provision.measure.link_survey import LinkSurvey, look
from teds_provision.measure.verified_session import VerifiedSession
from teds_provision.teds.origin import Origin
from tests.measure.test_topic_actuators import SHEET
from tests.teds.test_interpreter import changed


class Port:
    """A link with streams; ``fails`` is raised by its broadcast."""

    others_load = 0.0

    def __init__(self, place: str, course: list[Any], fails: LinkError | None = None) -> None:
        self.place, self.course, self.fails = place, course, fails

    def airtime(self) -> Any:
        return None

    def discover(self, _sightings: object, *, poll: float | None) -> Any:
        self.course.append((self.place, "discovery", poll))
        return SimpleNamespace(poll=lambda seconds: self.course.append((self.place, seconds)), discover=self.broadcast,
                               close=lambda: self.course.append((self.place, "closed")))  # fmt: skip

    def broadcast(self) -> None:
        self.course.append((self.place, "broadcast"))
        if self.fails is not None:
            raise self.fails


@pytest.fixture
def course(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    monkeypatch.setattr(of_buses, "HearingThread", lambda _port: SimpleNamespace(close=lambda: None))
    return []


def test_every_bus_is_polled_from_now_on_and_one_that_is_opened_again_as_well(course: list[Any]) -> None:
    first, second, again = Port("can0", course), Port("can1", course), Port("can0", course)
    ports: list[Any] = [first, second]
    with Buses(ports) as buses:
        buses.poll(5.0)
        assert course == [("can0", "discovery", None), ("can1", "discovery", None), ("can0", 5.0), ("can1", 5.0)]
        course.clear()
        known: Any = first
        assert buses.add(known) is buses.all()[0], "the same port"
        assert course == []
        other: Any = again
        assert buses.add(other).port is again
        assert course == [("can0", "closed"), ("can0", "discovery", 5.0)]
        course.clear()
    assert course == [("can0", "closed"), ("can1", "closed")]
    assert buses.all() == ()


@pytest.mark.parametrize(
    ("fails", "raised"),
    [((False, False), None), ((True, False), None), ((False, True), None), ((True, True), "can1 is down."), ((), None)],
)
def test_a_broadcast_goes_to_every_bus_and_fails_only_if_all_of_them_do(
    course: list[Any], fails: tuple[bool, ...], raised: str | None
) -> None:
    ports: list[Any] = [
        Port(f"can{k}", course, LinkError(f"can{k} is down.") if broken else None) for k, broken in enumerate(fails)
    ]
    with Buses(ports) as buses:
        if raised:
            with pytest.raises(LinkError) as failure:
                buses.discover()
            assert failure.value.message == raised
        else:
            assert buses.discover() == []
        assert [place for place, what, *_ in course if what == "broadcast"] == [port.place for port in ports]


def test_a_look_at_the_links_asks_those_that_carry_a_question_and_names_what_is_wrong(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A reader is listed, a bus without an answer is up without nodes, one that cannot be opened is down."""
    closed: list[str] = []
    identity: Any = object()

    class Searched:
        def __init__(self, place: str) -> None:
            self.place = place

        def find_all(self, *, seconds: float, notice: Any) -> list[Any]:
            assert seconds == 1.0
            for kind in ("conflict", "other", "unfinished"):
                notice(SimpleNamespace(kind=kind, text=f"{kind} at {self.place}"))
            if self.place == "silent":
                raise NoNodeError("Nobody answers.")
            if self.place == "torn":
                raise LinkError("The cable is torn.", hint="Plug it in.")
            return [SimpleNamespace(address=0x21, identity=identity), SimpleNamespace(address=None, identity=identity)]

        def close(self) -> None:
            closed.append(self.place)

    class Own:
        def __init__(self, place: str) -> None:
            self.place = place

        def __enter__(self) -> Any:
            if self.place == "taken":
                raise PolicyError("It is in use.", hint="Wait.")
            return SimpleNamespace(places=(self.place,))

        def __exit__(self, *_why: object) -> None:
            """Nothing is left."""

    def own(_station: object, links: Any, command: str) -> Own:
        assert command == "looking"
        return Own(links.places[0])

    monkeypatch.setattr(link_survey, "own_source_address", own)
    monkeypatch.setattr(link_survey, "open_place", Searched)
    monkeypatch.setattr(link_survey, "capabilities_at", lambda place: SimpleNamespace(connectionless=place != "reader"))
    monkeypatch.setattr(link_survey, "LinkSettings", lambda: SimpleNamespace(at=lambda p: SimpleNamespace(places=(p,))))
    station: Any = None
    found = list(look(station, ["reader", "taken", "torn", "silent", "bus"]))
    assert found == [
        LinkSurvey("reader", "listed"),
        LinkSurvey("taken", "down", "It is in use.", "Wait."),
        LinkSurvey("torn", "down", "The cable is torn.", "Plug it in."),
        LinkSurvey("silent", "up", troubles=("conflict at silent", "unfinished at silent")),
        LinkSurvey(
            "bus", "up", nodes=((0x21, identity), (0, identity)), troubles=("conflict at bus", "unfinished at bus")
        ),
    ]
    assert closed == ["torn", "silent", "bus"]


# -- who may reach a server --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("host", "own"),
    [("127.0.0.1", True), ("127.8.8.8", True), ("::1", True), ("localhost", True), ("LocalHost", True),
     ("0.0.0.0", False), ("::", False), ("10.0.0.1", False), ("bench", False), ("localhost.lan", False), ("", False)],
)  # fmt: skip
def test_only_an_address_of_this_machine_is_safe_without_more(host: str, own: bool) -> None:
    assert is_loopback(host) is own
    if own:
        Exposure().require_safe("--at", host, sends="values", clients="readers")
        return
    with pytest.raises(UsageError) as plain:
        Exposure(("bench",)).require_safe("--at", host, sends="values", clients="readers")
    assert plain.value.message == f"--at {host} would send values over the network unencrypted."
    assert plain.value.hint == "Add --tls-cert and --tls-key, or serve 127.0.0.1 and use an SSH tunnel."
    with pytest.raises(UsageError) as nameless:
        Exposure((), Path("c"), Path("k")).require_safe("--at", host, sends="values", clients="readers")
    assert nameless.value.message == f"--at {host} needs the names under which readers may reach it."
    assert nameless.value.hint == "Add --http-allow HOST for each of them."
    Exposure(("bench",), Path("c"), Path("k")).require_safe("--at", host, sends="values", clients="readers")


def test_a_certificate_and_its_key_are_both_there_and_can_be_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    certificate, key, empty = tmp_path / "c.pem", tmp_path / "k.pem", tmp_path / "empty.pem"
    certificate.write_text("x")
    key.write_text("x")
    empty.write_text("")
    Exposure().require_pair()
    for half in (Exposure((), certificate), Exposure((), None, key)):
        with pytest.raises(UsageError, match=r"^--tls-cert and --tls-key must be used together\.$"):
            half.require_pair()
    for pair in ((certificate, empty), (empty, key)):
        with pytest.raises(BadDataError) as refused:
            Exposure((), *pair).require_pair()
        assert refused.value.message == f"{empty} is empty."
    with pytest.raises(BadDataError) as refused:
        Exposure((), certificate, key).require_pair()
    assert refused.value.message.startswith(f"{certificate} and {key} are not a certificate and its key: ")
    assert refused.value.hint == "Both must be PEM files, and the certificate must come first in its file."
    asked: list[Any] = []

    class Context:
        def __init__(self, protocol: object) -> None:
            asked.append(protocol)

        def load_cert_chain(self, *words: Any) -> None:
            asked.append(words[:2])
            if len(asked) > 2:
                words[2]()

    monkeypatch.setattr(
        exposure, "ssl", SimpleNamespace(SSLContext=Context, PROTOCOL_TLS_SERVER="server", SSLError=ValueError)
    )
    Exposure((), certificate, key).require_pair()
    assert asked == ["server", (certificate, key)]
    with pytest.raises(BadDataError) as refused:
        Exposure((), certificate, key).require_pair()
    assert refused.value.message == f"{key} is encrypted."
    assert refused.value.hint == "A service starts unattended: store the key decrypted, with mode 0600."


# -- one node ----------------------------------------------------------------------------------------------------------


def test_an_actuator_that_cannot_be_computed_is_not_held() -> None:
    node: Any = None
    bare = changed(SHEET, calibration=None, calibration_problem="The Calibration TEDS of channel 1 is damaged.")
    trusted = VerifiedSession(node, bare, "00" * 32, "g")
    problem = bare.channels[0].value_problem
    assert problem
    with pytest.raises(BadDataError) as refused:
        HeldActuator(trusted, 1)
    assert refused.value.message == problem


def test_values_of_a_node_that_wraps_a_sensor_are_marked_with_it() -> None:
    node: Any = None
    origin = Origin("dbc", "Torque", "ab" * 32)
    wraps = replace(SHEET, meta=replace(SHEET.meta, origin=origin))
    for sheet, wrapped in ((SHEET, ""), (wraps, origin.text)):
        trusted = VerifiedSession(node, sheet, "5a" * 32, "g")
        facts = trusted.facts(sheet.channels[0], 0.01)
        assert (facts.wrapped, facts.period, facts.fingerprint) == (wrapped, 0.01, "5a" * 32)
    assert "Torque" in origin.text
