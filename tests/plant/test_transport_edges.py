"""Documents that are missing, arrive twice or are malformed, and who gets an answer."""

from __future__ import annotations

import errno
import hashlib
import json
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import (
    BadDataError,
    LinkError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    RosterExpiredError,
    StoreError,
    UsageError,
)
from teds_provision.handover import incoming
from teds_provision.plant import (
    apply_pages,
    backlog,
    connecting,
    evidence,
    fetching,
    jobs,
    membership,
    owner,
    parcels,
    postgres,
    removed_members,
    returned,
    service,
    sign_requests,
    sync,
    verify_evidence,
    yield_stats,
)
from teds_provision.plant.connecting import NotMemberError
from teds_provision.plant.fetching import take_carried
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.sign_requests import (
    FileOffice,
    Inbox,
    JoinedOffice,
    OfficeOrder,
    OfficeSilentError,
    RemoteOffice,
)
from teds_provision.plant.sync import ForkError
from teds_provision.plant.transport import CarriedPage, Parcel
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.plant.document import SIGN_REQUEST, NewerFormatError
from teds_provision.station.plant.alarms import Alarm
from teds_provision.station.plant.pages import PageRow
from teds_provision.station.plant.parcels import ParcelRow
from teds_provision.station.plant.plant import PlantRecord
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft
from teds_provision.teds.image import Image
from tests.bench import PASSPHRASE

from .owner import REGISTRY, alone

NODE = bytes.fromhex("8d4d9da65281f7000001")
WEST = "ee" * 32
NOW = datetime(2026, 3, 1, 12, tzinfo=UTC)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("made") / "owner"
    alone(home).close()
    return home


@pytest.fixture
def home(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "owner")
    return tmp_path / "owner"


@pytest.fixture
def station(home: Path) -> Iterator[Station]:
    with Station.open(home, ask=lambda *_: PASSPHRASE) as opened:
        yield opened


def h(name: str) -> str:
    return name.encode().hex().rjust(64, "0")


def raises(error: Exception) -> Callable[..., Any]:
    def raised(*_: Any, **__: Any) -> Any:
        raise error

    return raised


def stub(**members: Any) -> Any:
    return SimpleNamespace(**members)


# -- documents of a line -----------------------------------------------------------------------------------------------


def test_without_a_way_to_others_nothing_is_sent(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(PolicyError) as error:
        sign_requests.transport_for(station, None)
    assert (error.value.message, error.value.hint) == (
        "This station has no way to reach the other stations.", "Give a transfer folder: --files DIR"
    )  # fmt: skip
    assert sign_requests.transport_for(station, tmp_path).where == str(tmp_path)
    monkeypatch.setattr(connecting, "open_transport", lambda _: "the registry")
    assert cast("str", sign_requests.transport_for(station, None)) == "the registry"
    sent = list[Parcel]()
    with pytest.raises(PolicyError) as error:
        sign_requests.send(station, stub(send=sent.append), WEST, b"document", "name")
    assert (error.value.message, error.value.hint) == (
        f"Station {WEST[:16]} is not a member of the plant.", "See: registry status"
    )  # fmt: skip
    assert sent == []


def test_a_document_is_sealed_for_a_member_under_its_own_name_for_seven_days(station: Station) -> None:
    station.unlock()
    sent, before = list[Parcel](), datetime.now(UTC).replace(microsecond=0)
    sign_requests.send(station, stub(send=sent.append), station.fingerprint, b"document", "name")
    [parcel] = sent
    assert (parcel.id, parcel.to, parcel.sender) == ("name", station.fingerprint, station.fingerprint)
    assert timedelta(days=7) <= datetime.fromisoformat(parcel.expires) - before < timedelta(days=7, minutes=5)
    opened = sign_requests.jose.decrypt(
        parcel.octets, station.credentials().key, cty=sign_requests.CONTENT_TYPE, max_octets=9999
    )
    assert opened == b"document"


def test_an_inbox_gives_each_document_once_until_it_is_dropped(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    there, gone = [Parcel("p2", "", b"{two", ""), Parcel("p3", "", b"junk", "")], list[tuple[str, str]]()
    asked = list[set[str]]()

    def new_parcels(own: str, known: set[str]) -> list[Parcel]:
        asked.append(set(known))
        return [parcel for parcel in there if parcel.id not in known]

    transport = stub(new_parcels=new_parcels, drop=lambda parcel, to: gone.append((parcel, to)))
    with station.transaction():
        for name, kind in (("p1", "sign-request"), ("p0", "job")):
            row = ParcelRow(name, "in", WEST, cast("Any", kind), "waiting", "2099-01-01T00:00:00Z")
            station.plant.parcels.put(row, name.encode())
    inbox = Inbox(station, transport, SIGN_REQUEST)
    monkeypatch.setattr(inbox, "_opened", lambda octets: octets if octets.startswith(b"{") else None)
    first = inbox.collect()
    assert [come.document for come in first] == [b"p1", b"{two"]
    assert inbox.collect() == []
    assert asked == [{"p1"}, {"p1", "p2", "p3"}]
    first[0].drop()
    first[1].drop()
    assert gone == [("p2", station.fingerprint)]
    assert station.plant.parcels.get("p1", "in") is None
    there[:] = [Parcel("p2", "", b"{again", "")]
    assert [come.document for come in inbox.collect()] == [b"{again"], "a repeated request has the same id"
    inbox.start_over()
    assert [come.document for come in inbox.collect()] == [b"{again"], "all that is there, once more"


def test_an_inbox_waits_for_a_notification_and_without_one_looks_again(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    done, sleeps = list[Any](), list[float]()
    listener = stub(
        listen=lambda: done.append("listen"), close=lambda: done.append("close"),
        interrupt=lambda: done.append("interrupt"),
        wait=lambda seconds, parcel_to: done.append((seconds, parcel_to)),
    )  # fmt: skip
    found = [listener]
    monkeypatch.setattr(sign_requests, "time", stub(sleep=sleeps.append))
    monkeypatch.setattr(connecting, "listener", lambda _: found[0])
    transport = postgres.PostgresTransport(cast("Any", None), "office", station.fingerprint)
    inbox = Inbox(station, transport, SIGN_REQUEST)
    inbox.interrupt()
    inbox.close()
    assert done == []
    inbox.wait(1.0, 0.2)
    assert done == ["listen"], "what came before the first listen causes no notification"
    inbox.wait(1.5, 0.2)
    inbox.interrupt()
    assert done == ["listen", (1.5, station.fingerprint), "interrupt"]
    listener.wait = raises(LinkError("The server is gone."))
    inbox.wait(1.0, 0.2)
    assert (done[3:], sleeps) == (["close"], [0.2])
    inbox.wait(0.1, 0.2)
    assert sleeps == [0.2, 0.1], "no longer than asked"
    inbox.start_over()
    inbox.wait(1.0, 0.2)
    inbox.start_over()
    assert done[4:] == ["listen", "close"]
    found[0] = None
    inbox.wait(1.0, 0.2)
    assert (done[6:], sleeps) == ([], [0.2, 0.1, 0.2]), "a folder notifies nobody"
    folder = Inbox(station, cast("Any", stub()), SIGN_REQUEST)
    folder.wait(3.0, 0.2)
    assert sleeps == [0.2, 0.1, 0.2, 0.2]


def test_what_an_inbox_cannot_open_is_for_nobody(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    station.unlock()
    inbox = Inbox(station, cast("Any", None), SIGN_REQUEST)
    header = {"typ": SIGN_REQUEST.typ}
    monkeypatch.setattr(sign_requests.jose, "decrypt", lambda *_, **__: b"head.rest.sign")
    monkeypatch.setattr(sign_requests, "decode_base64url", lambda text, _: text)
    monkeypatch.setattr(sign_requests, "load_object", lambda octets, _what: header if octets == b"head" else {})
    assert inbox._opened(b"{sealed") == b"head.rest.sign"
    assert inbox._opened(b"sealed") is None
    header["typ"] = "JOSE"
    assert inbox._opened(b"{sealed") is None
    header["typ"] = SIGN_REQUEST.typ
    for error in (BadDataError("x"), NotAuthenticError("x"), PolicyError("x")):
        monkeypatch.setattr(sign_requests.jose, "decrypt", raises(error))
        assert inbox._opened(b"{sealed") is None


def test_an_office_signs_for_a_job_that_names_it(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    def order(job: str | None = "0b5f", by: str = "owner") -> OfficeOrder:
        return OfficeOrder(NODE.hex(), by, job, None, None, None)

    office = [station.fingerprint]
    monkeypatch.setattr(sign_requests, "find_job", lambda _s, text: stub(id="job", title="cells", office=office[0]))
    cases = [
        (UsageError, order(None), "An office only signs for a job.",
         "Name it: --job ID; see: teds-provision job list"),
        (PolicyError, order(by="nobody"), "The job “cells” names another office than nobody.", ""),
        (NotFoundError, order(), f"Nothing has been built for node {NODE.hex()}.",
         f"To build it: teds-provision build {NODE.hex()}"),
    ]  # fmt: skip
    for kind, asked, message, hint in cases:
        with pytest.raises(kind) as error:
            sign_requests.sign_by_office(station, cast("Any", None), asked, cast("Any", None))
        assert (error.value.message, error.value.hint) == (message, hint)
    office[0] = WEST
    with pytest.raises(PolicyError, match="names another office than owner"):
        sign_requests.sign_by_office(station, cast("Any", None), order(), cast("Any", None))


def test_a_draft_is_signed_over_a_file_or_a_transport_and_kept(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    station.unlock()
    image, signed = Image(NODE, {(0, 1): b"meta"}), Image(NODE, {(0, 1): b"meta", (0, 16): b"security"})
    with station.transaction():
        station.datasheets.keep_draft(Draft(NODE, image, "built", "load-cell"))
    job = stub(id="job", title="cells", office=station.fingerprint)
    visit = stub(node="node", who=stub(point=b"point", key_signature=b"signature"))
    ways, closed = list[object](), list[str]()

    class Visit:
        def __enter__(self) -> Any:
            return visit

        def __exit__(self, *_: object) -> None:
            closed.append("node")

    def by_office(_station: Any, way: Any, node: Any, keys: Any, wanted: Any, on_node: Any) -> Any:
        ways.append(way)
        assert (node, keys.uuid, keys.key, on_node) == ("node", NODE, b"point", None)
        assert (wanted.job, wanted.office, wanted.image, wanted.name) == ("job", station.fingerprint, image, "cell 1")
        assert (wanted.calibration, wanted.epoch, wanted.sequence, wanted.profile) == (calibration, 3, 9, "load-cell")
        return stub(image=signed)

    monkeypatch.setattr(sign_requests, "find_job", lambda *_: job)
    opened = list[Any]()
    monkeypatch.setattr(sign_requests, "at_node", lambda *given, unlock: opened.append((given[2], unlock)) or Visit())
    monkeypatch.setattr(sign_requests, "require_session", lambda _station, node: closed.append(f"session of {node}"))
    monkeypatch.setattr(sign_requests, "read_identity", lambda _: stub(epoch=3, sequence=9))
    monkeypatch.setattr(sign_requests, "own_name", lambda *_: "cell 1")
    monkeypatch.setattr(sign_requests, "by_office", by_office)
    (tmp_path / "cal.csv").write_bytes(bytes(1 << 20))
    (tmp_path / "large.csv").write_bytes(bytes((1 << 20) + 1))
    calibration: bytes | None = bytes(1 << 20)
    (tmp_path / "stick").mkdir()
    monkeypatch.setattr(FolderTransport, "close", lambda _: closed.append("transport"))
    for output, file in ((tmp_path / "request.jws", tmp_path / "cal.csv"), (None, None)):
        calibration = bytes(1 << 20) if file is not None else None
        order = OfficeOrder(NODE.hex(), "owner", "0b5f", file, tmp_path / "stick", output)
        done = sign_requests.sign_by_office(station, cast("Any", stub(timeout=2.5)), order, cast("Any", None))
        assert done.image is signed
        draft = station.datasheets.draft(NODE)
        assert draft is not None
        assert (draft.image, draft.stage, draft.profile) == (signed, "signed", "load-cell")
        with station.transaction():
            station.datasheets.keep_draft(Draft(NODE, image, "built", "load-cell"))
    assert ways[0] == FileOffice(tmp_path / "request.jws")
    assert isinstance(ways[1], RemoteOffice)
    assert ways[1].timeout == 2.5
    assert closed == ["session of node", "node", "session of node", "node", "transport"]
    assert opened == [(NODE, "always")] * 2, "the request is signed with the station's key"
    order = OfficeOrder(NODE.hex(), "owner", "0b5f", tmp_path / "large.csv", tmp_path / "stick", None)
    with pytest.raises(BadDataError):
        sign_requests.sign_by_office(station, cast("Any", stub(timeout=2.5)), order, cast("Any", None))


def test_what_a_node_has_is_not_asked_for_and_an_office_may_be_silent(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    station.unlock()
    same, asked = [True], list[str]()
    wanted: Any = stub(
        sequence=9, office=station.fingerprint, job="job", profile=None, image=Image(NODE, {(0, 1): b"x"})
    )
    keys: Any = stub(uuid=NODE)
    office: Any = stub(request_signature=lambda request: asked.append(request.octets))
    monkeypatch.setattr(sign_requests, "_says_the_same", lambda *args: same[0] and args[4] == b"on the node")
    monkeypatch.setattr(sign_requests.security, "decode", lambda _: stub(sequence=8))
    monkeypatch.setattr(sign_requests, "_earlier", lambda *_: None)
    monkeypatch.setattr(sign_requests, "_new_request", lambda *_: stub(octets="new", hash="h"))
    done = sign_requests.by_office(station, office, cast("Any", None), keys, wanted, b"on the node")
    assert (done.sequence, done.reused, asked) == (8, True, [])
    assert done.image.security == b"on the node"
    for on_node, says in ((b"on the node", False), (None, True)):
        same[0] = says
        with pytest.raises(OfficeSilentError) as error:
            sign_requests.by_office(station, office, cast("Any", None), keys, wanted, on_node)
        assert (error.value.message, error.value.hint) == (
            "The office owner has not answered yet.",
            "The request is kept. Run the same command again once the office has signed.",
        )
    assert asked == ["new", "new"]


def test_a_board_that_signs_with_another_key_gets_no_request(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    station.unlock()
    wanted = stub(image=Image(NODE, {(0, 1): b"meta"}), epoch=1, sequence=2, office=station.fingerprint, job="job")
    keys = stub(uuid=NODE, key=SoftwareKey(5).point)
    node = stub(request_idempotent=lambda _command, what: SoftwareKey(6).sign(what.encode()))
    with pytest.raises(NotAuthenticError) as error:
        sign_requests._new_request(station, node, keys, wanted)
    assert error.value.message == "The node's signature of the request does not match the key it presented."
    claim = stub(challenge=lambda nonce: bytes(32), teds=b"", uuid=NODE)
    monkeypatch.setattr(evidence.security, "decode", lambda _: stub(node_key=SoftwareKey(5).point))
    with pytest.raises(NotAuthenticError) as error:
        evidence.prove_claim(node, claim, bytes(16))
    assert error.value.message == "The node's signature of the evidence does not match the key it presented."


SIGNER, BOARD = SoftwareKey(41), SoftwareKey(42)
OF_SIGNER = fingerprint(SIGNER.point)


@pytest.mark.parametrize(
    ("changes", "by", "same"),
    [
        ({}, None, True),
        ({}, OF_SIGNER, True),
        ({}, WEST, False),  # another member with sign than the one that was asked
        ({"signed": False}, None, False),
        ({"node_key": SIGNER.point}, None, False),
        ({"node_key_signature": b"of another UUID"}, None, False),
        ({"station_key": None}, None, False),
        ({"station_key": BOARD.point}, None, False),  # no member with sign
        ({"key_epoch": 2}, None, False),
        ({"signed_blocks": "of another image"}, None, False),
        ({"station_key_signature": b"of another CA"}, None, False),
        ({"good": False}, None, False),
        ({"damaged": True}, None, False),
    ],
)
def test_a_security_teds_says_the_same_if_each_part_of_it_does(
    station: Station, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], by: str | None, same: bool
) -> None:
    shown = stub(**{
        "signed": True, "node_key": BOARD.point, "node_key_signature": b"102", "station_key": SIGNER.point,
        "key_epoch": 3, "signed_blocks": ("digests of", "blocks"), "station_key_signature": b"104", "good": True,
        "damaged": False, **changes,
    })  # fmt: skip

    def decode(octets: bytes) -> Any:
        assert octets == b"teds"
        if shown.damaged:
            raise BadDataError("damaged")
        return shown

    known = (station.ca, shown.station_key, b"104")
    monkeypatch.setattr(sign_requests.security, "decode", decode)
    monkeypatch.setattr(sign_requests, "datasheet", stub(
        digests=lambda blocks: ("digests of", blocks), is_certified=lambda *given: given == known,
        signature_good=lambda given, octets, uuid: given.good and (octets, uuid) == (b"teds", NODE),
    ))  # fmt: skip
    roster: Any = stub(has=lambda digits, role: (digits, role) == (OF_SIGNER, "sign"))
    keys: Any = stub(uuid=NODE, key=BOARD.point, signature=b"102")
    wanted: Any = stub(epoch=3, image=stub(blocks="blocks"))
    assert sign_requests._says_the_same(station, roster, keys, wanted, b"teds", by=by) is same


@pytest.mark.parametrize(
    ("word", "hint"),
    [
        ("job", "Ask the operator of the office: signer run --job ID."),
        ("full", "Set the board aside, or ask the keeper for another job."),
        ("differs", "Station and office need the same profile and version of the program."),
        ("sequence", "Someone at the office must confirm it: signer once FILE --jump"),
        ("revoked", ""),
    ],
)
def test_an_answer_is_the_offices_to_this_request_or_a_refusal_with_its_cure(
    station: Station, monkeypatch: pytest.MonkeyPatch, word: str, hint: str
) -> None:
    answer = stub(of="H of request", refused="", why="", security=b"security", sequence=7)

    def open_answer(octets: bytes, find: Callable[[str], bytes | None]) -> Any:
        assert (octets, find("office"), find("another")) == (b"answer", b"point", None)
        return answer

    same = [True]
    monkeypatch.setattr(sign_requests, "open_answer", open_answer)
    monkeypatch.setattr(sign_requests, "hash_of", lambda octets: f"H of {octets.decode()}")
    monkeypatch.setattr(sign_requests, "_says_the_same", lambda *args, by: same[0] and (args[4], by) == (
        b"security", "office"))  # fmt: skip
    roster: Any = stub(point_of=lambda digits: b"point", name_of=lambda digits: f"the {digits}")
    wanted: Any = stub(office="office", image=Image(NODE, {(0, 1): b"meta"}))

    def taken(request: bytes = b"request") -> Any:
        return sign_requests._taken(station, roster, cast("Any", None), wanted, request, b"answer")

    done = taken()
    assert (done.image.security, done.image.blocks[0, 1], done.sequence, done.reused) == (
        b"security",
        b"meta",
        7,
        False,
    )
    with pytest.raises(NotAuthenticError, match="The office's answer belongs to another request"):
        taken(b"another")
    same[0] = False
    with pytest.raises(NotAuthenticError) as error:
        taken()
    assert (error.value.message, error.value.hint) == (
        "The office signed something other than what was requested.", "Ask the owner to check this office."
    )  # fmt: skip
    answer.refused, answer.why = word, "as it is."
    with pytest.raises(sign_requests.OfficeRefusedError) as refused:
        taken()
    assert (refused.value.message, refused.value.hint) == (
        f"The office the office does not sign ({word}): as it is.", hint
    )  # fmt: skip


def test_a_request_goes_to_the_place_that_is_joined_now(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    places, opened, closed = ["one", "one", "two", "two"], list[str](), list[str]()

    def transport_for(_station: Any, folder: Any) -> Any:
        assert folder is None
        name = f"transport {len(opened) + 1}"
        opened.append(name)
        return stub(name=name, close=lambda: closed.append(name))

    monkeypatch.setattr(connecting, "place_of", lambda _: places.pop(0))
    monkeypatch.setattr(sign_requests, "transport_for", transport_for)
    monkeypatch.setattr(RemoteOffice, "request_signature", lambda office, request: (office.transport.name, request))
    joined = JoinedOffice(station, 2.0)
    asked = [cast("Any", joined).request_signature(request) for request in "abc"]
    assert asked == [("transport 1", "a"), ("transport 2", "b"), ("transport 2", "c")]
    joined.close()
    assert closed == ["transport 1", "transport 2"]


def test_jobs_that_a_sync_brought_are_taken_or_reported(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    results: dict[bytes, Exception | None] = {
        b"1": None, b"2": BadDataError("It is damaged."), b"3": NotAuthenticError("Nobody signed it."),
        b"4": PolicyError("Another job has its id."), b"5": RosterExpiredError("The roster expired."), b"6": None,
    }  # fmt: skip
    taken, notices = list[bytes](), list[str]()

    def take_job(_station: Station, octets: bytes) -> None:
        taken.append(octets)
        if (error := results[octets]) is not None:
            raise error

    monkeypatch.setattr(jobs, "take_job", take_job)
    monkeypatch.setattr(station, "notice", notices.append)
    with station.transaction():
        for octets in results:
            row = ParcelRow(
                octets.decode(), "in", WEST, "job", "waiting", "2099-01-01T00:00:00Z", created=octets.decode()
            )
            station.plant.parcels.put(row, octets)
    jobs.take_received(station)
    assert taken == [b"1", b"2", b"3", b"4", b"5"]
    assert [row.id for row in station.plant.parcels.all("in", "waiting")] == ["5", "6"], "a renewed roster decides"
    assert notices == [
        "A received job was rejected: It is damaged.", "A received job was rejected: Nobody signed it.",
        "A received job was rejected: Another job has its id.",
    ]  # fmt: skip


# -- pages -------------------------------------------------------------------------------------------------------------


def test_only_a_fork_of_this_station_waits_for_a_decision(station: Station) -> None:
    me = station.fingerprint
    for code, about in (("junk", me), ("fork", WEST), ("two-histories", me)):
        with station.transaction():
            station.plant.alarms.put(Alarm(code, about, 3, "why"))
        sync._require_resumed(station)
    with station.transaction():
        station.plant.alarms.put(Alarm("fork", me, 5, "pages of another home"))
    with pytest.raises(ForkError) as error:
        sync._require_resumed(station)
    assert (error.value.message, error.value.hint) == (
        "Pages under this station's key that this home did not write were found, from number 5 on, and the decision is"
        " still open.",
        "Find out who has a copy; if in doubt, have this station removed. Then: teds-provision registry resume",
    )


def test_a_folder_gets_each_page_once_and_a_registry_its_own_alone(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    me = station.fingerprint
    with station.transaction():
        for of, numbers in ((me, (1, 2, 3)), (WEST, (1,))):
            chain = station.plant.pages.chain(of)
            for n in numbers:
                station.plant.pages.add(
                    chain.id, PageRow(n, h(f"{of[:4]}{n}"), h(f"{of[:4]}{n - 1}"), "", "", b"", b"", bytes(64))
                )
    monkeypatch.setattr(sync, "octets_of", lambda row: row.hash.encode())
    monkeypatch.setattr(sync, "hash_of", lambda octets: octets.decode())
    counted = {(1, h(f"{me[:4]}1")), (3, h(f"{me[:4]}3")), (1, h("eeee1"))}
    monkeypatch.setattr(sync, "counted_places", lambda *_: counted)

    def pushed(*, folder: bool, there: dict[str, list[str]], heads: dict[str, int]) -> tuple[list[str], int]:
        sent = list[str]()

        def append(of: str, n: int, previous: str, hash: str, octets: bytes) -> None:
            assert (previous, octets) == (h(f"{of[:4]}{n - 1}"), hash.encode())
            sent.append(hash)

        def pages(of: str, after: int) -> list[CarriedPage]:
            assert (folder, after) == (True, 0), "of a registry the heads are enough; another history may be lower"
            return [CarriedPage(of, 1, hash.encode()) for hash in there.get(of, ())]

        done = stub(pushed=0)
        transport = stub(carries_all=folder, heads=lambda: heads, pages=pages, append=append)
        sync._push(station, transport, cast("Any", None), cast("Any", done), connected=False)
        return sent, done.pushed

    mine, wests = [h(f"{me[:4]}{n}") for n in (1, 2, 3)], h("eeee1")
    assert pushed(folder=True, there={}, heads={me: 9}) == ([*mine, wests], 3)
    assert pushed(folder=True, there={me: mine[:2], WEST: [wests]}, heads={}) == ([mine[2]], 1)
    assert pushed(folder=True, there={me: mine, WEST: ["other"]}, heads={}) == ([wests], 0)
    assert pushed(folder=False, there={}, heads={}) == ([mine[0], mine[2]], 2), "a page that was given up stays here"
    assert pushed(folder=False, there={}, heads={me: 1}) == ([mine[2]], 1)
    assert pushed(folder=False, there={me: []}, heads={me: 3}) == ([], 0)


@pytest.mark.parametrize(
    ("connected", "folder", "url", "before", "after"),
    [
        (True, False, "postgresql://office/plant", 1, 3),
        (True, True, None, 1, 3),
        (True, False, "postgresql://office/plant", 5, 3),  # the database was rolled back and is filled again
        (False, True, "file:/media/one", 1, 3),  # a disk has another path on each machine
        (False, True, "postgresql://office/plant", 1, 1),
        (False, True, None, 1, 1),
        (False, False, "file:/media/one", 1, 1),
        (True, False, None, 3, 3),
    ],
)
def test_what_the_joined_registry_has_is_acknowledged(
    station: Station, monkeypatch: pytest.MonkeyPatch, connected: bool, folder: bool, url: str | None, before: int,
    after: int,
) -> None:  # fmt: skip
    kept = list[int]()
    put = station.plant.put_record
    with station.transaction():
        put(PlantRecord(REGISTRY, url=url, acknowledged=before))
        chain = station.plant.pages.chain(station.fingerprint)
        station.plant.pages.put_chain(replace(chain, counted=(3, h("3"))))
    monkeypatch.setattr(sync, "counted_places", lambda *_: set())
    monkeypatch.setattr(station.plant, "put_record", lambda record: kept.append(record.acknowledged) or put(record))
    transport = stub(carries_all=folder, heads=dict, pages=lambda *_: [])
    sync._push(station, transport, cast("Any", None), cast("Any", stub(pushed=0)), connected=connected)
    record = station.plant.joined
    assert record is not None
    assert (record.acknowledged, record.url, kept) == (after, url, [after] if after != before else [])


def test_events_of_pages_that_were_given_up_are_stated_again(station: Station) -> None:
    station.unlock()
    names = [digit * 16 for digit in "1234"]
    events = [{"id": name, "act": "closed", "job": "j"} for name in names]
    chain = station.plant.pages.chain(station.fingerprint)
    with station.transaction():
        content = json.dumps({"events": events[:3]}).encode()
        station.plant.pages.add(chain.id, PageRow(4, h("h4"), "", "", "", b"", content, bytes(64)))
    new = [stub(events=["none", {"id": names[1]}]), stub(events=())]
    with station.transaction():
        sync._report_again(station, chain, [(4, h("h4")), (5, h("lost"))], cast("Any", new))
    assert [id for _, id, _ in station.plant.outbox(9)] == [names[0], names[2]]


def test_own_pages_that_this_station_did_not_sign_stop_a_registry_and_no_folder(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Into a folder anybody writes; into a registry members alone."""
    held = station.plant.roster
    assert held is not None
    read: tuple[list[str], list[int]] = ["page"], [3, 5]
    monkeypatch.setattr(fetching, "read_pages", lambda pages, _roster, of: read if (pages, of) == (
        [7], station.fingerprint) else ([], []))  # fmt: skip

    def own(*, folder: bool) -> tuple[Any, list[str]]:
        done: Any = stub(remarks=[])
        transport = stub(pages=lambda _of, above: [above], carries_all=folder, where="office")
        return sync._own_pages(station, transport, held, done, 7), done.remarks

    assert own(folder=True) == (
        ["page"], ["office: 2 files in this station's folder that it did not sign; ignored"]
    )  # fmt: skip
    assert station.plant.alarms.all() == []
    with pytest.raises(NotAuthenticError) as error:
        own(folder=False)
    assert (error.value.message, error.value.hint) == (
        "office has pages of this station that its key did not sign, from number 3 on.",
        "To delete them there: registry sql --mend owner 3",
    )
    [alarm] = station.plant.alarms.all()
    assert (alarm.code, alarm.about, alarm.n) == ("junk", station.fingerprint, 3)
    assert alarm.why == "office has pages that this station's key did not sign"
    read[1].clear()
    assert own(folder=False) == own(folder=True) == (["page"], [])


@pytest.mark.parametrize(
    ("earlier", "answered", "reused", "asked"),
    [
        (None, 0, False, "new"),
        ("kept", None, False, "kept"),  # not answered yet: the very same request again
        ("kept", 9, False, "new"),  # what it signed then is no newer than the node's datasheet
        ("kept", 10, True, None),
    ],
)
def test_an_earlier_request_is_repeated_and_its_answer_used_if_it_is_newer(
    station: Station, monkeypatch: pytest.MonkeyPatch, earlier: str | None, answered: int | None, reused: bool,
    asked: str | None,
) -> None:  # fmt: skip
    station.unlock()
    requests = list[str]()

    def taken(_s: Any, _r: Any, _k: Any, _w: Any, request: str, answer: Any) -> Any:
        return sign_requests.SignResult(cast("Any", f"image of {request}"), answer, reused=False)

    def request_signature(request: Any) -> int:
        requests.append(request.octets)
        return 12

    kept = None if earlier is None else stub(request="kept", answer=answered)
    monkeypatch.setattr(sign_requests, "_earlier", lambda *_: kept)
    monkeypatch.setattr(sign_requests, "_taken", taken)
    monkeypatch.setattr(sign_requests, "open_request", lambda octets, _: stub(octets=octets, hash="h"))
    monkeypatch.setattr(sign_requests, "_new_request", lambda *_: stub(octets="new", hash="h"))
    stored = list[Any]()
    for part, name in ((station.plant.line, "put_sign_request"), (station.datasheets, "keep_draft")):
        monkeypatch.setattr(part, name, stored.append)
    monkeypatch.setattr(station.nodes, "remember", lambda uuid, *, sequence: stored.append((uuid, sequence)))
    wanted: Any = stub(sequence=9, office="office", job="job", profile="load-cell")
    done = sign_requests.by_office(
        station, cast("Any", stub(request_signature=request_signature)), cast("Any", None),
        cast("Any", stub(uuid=NODE)), wanted, None,
    )  # fmt: skip
    assert requests == ([] if asked is None else [asked])
    assert done.reused is reused
    assert (done.image, done.sequence) == (f"image of {asked or 'kept'}", 12 if asked else answered)
    assert len(stored) == (3 if asked else 0), "a new signature is durable with its draft and its sequence"
    assert not stored or stored[2] == (NODE, 12)
    signed = [entry for entry in station.audit_log.entries() if (entry.act, entry.outcome) == ("sign", "by office")]
    assert [entry.detail for entry in signed] == ([{"sequence": 12, "office": "office"}] if asked else [])


@pytest.mark.parametrize(
    ("rows", "found"),
    [
        ([], None),
        ([{}], 0),
        ([{"sequence": 8}], None),  # the node has written since, and nothing was signed
        ([{"sequence": 8, "answer": b"signed"}], 0),
        ([{"peer": "another"}], None),
        ([{"peer": "another"}, {}], 1),
        ([{"ahead": timedelta(0)}], 0),
        ([{"ahead": timedelta(seconds=1)}], None),  # no office takes it before its time
        ([{"ahead": timedelta(seconds=1), "answer": b"signed"}], 0),
        ([{"epoch": 4}], None),
        ([{"name": None}], None),
        ([{"calibration": b"d"}], None),
        ([{"blocks": {(0, 1): b"y"}}], None),
        ([{"blocks": {(0, 1): b"x", (0, 128): b"signed"}}], 0),  # signed or not, it is the same
        ([{"sequence": 8, "answer": b"signed"}, {}], 1),
        ([{}, {"sequence": 8, "answer": b"signed"}], 0),
        ([{}, {"answer": b"signed"}], 1),
        ([{"answer": b"signed"}, {}], 0),
        ([{"sequence": 10, "answer": b"signed"}, {"sequence": 9, "answer": b"signed"}], 0),
    ],
)
def test_an_earlier_request_is_one_for_exactly_this_the_newest_by_its_sequence(
    monkeypatch: pytest.MonkeyPatch, rows: list[dict[str, Any]], found: int | None
) -> None:
    latest = NOW + timedelta(hours=24)
    usual = {"sequence": 9, "answer": None, "peer": "office", "ahead": -timedelta(days=1), "epoch": 3, "name": "cell",
             "calibration": b"c", "blocks": {(0, 1): b"x"}}  # fmt: skip
    made = [stub(**usual | row | {"request": number}) for number, row in enumerate(rows)]
    asked = list[tuple[object, ...]]()
    requests = [
        stub(epoch=row.epoch, name=row.name, calibration=row.calibration, sequence=row.sequence,
             created=latest + row.ahead, image=Image(NODE, row.blocks)) for row in made
    ]  # fmt: skip
    monkeypatch.setattr(sign_requests, "roster_of", lambda _: None)
    monkeypatch.setattr(sign_requests, "now_of", lambda _: NOW)
    monkeypatch.setattr(sign_requests, "open_request", lambda number, _: requests[number])
    station: Any = stub(plant=stub(line=stub(sign_requests=lambda *given: asked.append(given) or made)), point=b"")
    wanted: Any = stub(job="job", office="office", image=Image(NODE, {(0, 1): b"x", (0, 128): b"of the node"}),
                       epoch=3, name="cell", calibration=b"c", sequence=9)  # fmt: skip
    earlier = sign_requests._earlier(station, wanted)
    assert earlier is (None if found is None else made[found])
    assert asked == [("job", NODE, "out")]


@pytest.mark.parametrize(
    "error", [BadDataError("It is damaged."), NotAuthenticError("Nobody signed it."), PolicyError("It is weak.")]
)
def test_an_answer_that_cannot_be_read_is_for_no_request(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    office = RemoteOffice.__new__(RemoteOffice)
    office.station = cast("Any", None)
    monkeypatch.setattr(sign_requests, "roster_of", lambda _: stub(point_of="points"))
    monkeypatch.setattr(sign_requests, "load_object", lambda octets, _what: octets)

    def verified(octets: bytes, point_of: object, *, typ: str, max_octets: int) -> Any:
        assert (octets, point_of, typ, max_octets) == (b"answer", "points", "teds-signed+jws", 65_536)
        return stub(kid="office", payload={"of": "H"})

    monkeypatch.setattr(sign_requests.jose, "verify_compact", verified)
    assert office._answered(b" answer\n") == ("office", "H")
    monkeypatch.setattr(sign_requests, "load_object", raises(error))
    assert office._answered(b"answer") == ("", "")
    monkeypatch.setattr(sign_requests.jose, "verify_compact", raises(error))
    assert office._answered(b"answer") == ("", "")


def test_an_answer_is_looked_for_less_and_less_often_and_its_parcel_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    sent, waits, gone = list[Any](), list[Any](), list[str]()
    answer = stub(document=b"answer", drop=lambda: gone.append("dropped"))
    found = iter([*([] for _ in range(7)), [answer]])
    office: Any = RemoteOffice.__new__(RemoteOffice)
    office.station, office.transport, office.timeout = "station", "transport", 60.0
    office._news, office._came, office._looking = threading.Condition(), {}, False
    office._inbox = stub(collect=lambda: next(found), wait=lambda most, pause: waits.append((most, pause)))
    office._answered = lambda document: ("office", "H") if document == b"answer" else ("", "")
    monkeypatch.setattr(sign_requests, "time", stub(monotonic=lambda: 100.0))
    monkeypatch.setattr(sign_requests, "send", lambda *given: sent.append(given))
    monkeypatch.setattr(sign_requests, "name_of", lambda hash: f"name of {hash}")
    assert office.request_signature(stub(to="office", hash="H", octets=b"request")) == b"answer"
    assert sent == [("station", "transport", "office", b"request", "name of H")]
    assert (waits, gone) == ([(1.0, pause) for pause in (0.05, 0.1, 0.2, 0.4, 0.8, 1.0, 1.0)], ["dropped"])
    assert (office._came, office._looking) == ({}, False), "another thread may look now"


def test_a_transport_of_another_registry_is_not_used(station: Station) -> None:
    for registry in (None, REGISTRY):
        transport = stub(
            registry=lambda r=registry: r, rosters=lambda: iter(()), post_roster=lambda *_: None, where="office"
        )  # fmt: skip
        found = sync._rosters(station, transport, cast("Any", stub(rosters=[])))
        assert found == []
    with pytest.raises(PolicyError) as error:
        sync._rosters(station, stub(registry=lambda: "another", where="office"), cast("Any", None))
    assert (error.value.message, error.value.hint) == (
        "office belongs to another registry (another).", "Use the one that this station joined."
    )  # fmt: skip


def test_the_own_roster_is_posted_and_one_that_was_not_taken_is_a_remark(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    held, posted = station.plant.held_roster(), list[Any]()
    assert held is not None
    made = [(stub(version=number), how, f"why {number}") for number, how in enumerate(("taken", "older", "expired"), 5)]
    monkeypatch.setattr(sync, "take_rosters", lambda _station, octets: made if octets == ["octets"] else [])
    transport = stub(registry=lambda: None, rosters=lambda: ["octets"], post_roster=lambda *given: posted.append(given))
    done: Any = stub(remarks=[])
    assert sync._rosters(station, transport, done) == made
    assert (posted, done.remarks) == ([(held.version, held.hash, held.octets)], ["roster 7: expired: why 7"])


def test_a_sync_waits_for_another_one_under_its_own_name(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    course = list[Any]()

    @contextmanager
    def lock(home: Path, **how: Any) -> Iterator[None]:
        course.append((home, how))
        yield
        course.append("free")

    monkeypatch.setattr(sync, "StoreLock", lock)
    with sync.sync_lock(station):
        course.append("sync")
    how = {"command": "registry sync", "notice": station.notice, "file": "registry.lock"}
    assert course == [(station.home, how), "sync", "free"]


@pytest.mark.parametrize(
    ("pages", "follows"),
    [
        ((), True),
        (((5, "h4", "h5"),), True),
        (((6, "h5", "h6"), (5, "h4", "h5")), True),
        (((6, "h5", "h6"),), False),
        (((5, "other", "h5"),), False),
        (((5, "h4", "h5"), (6, "other", "h6")), False),
        (((5, "h4", "h5"), (7, "h5", "h7")), False),
    ],
)
def test_pages_follow_without_a_gap_whatever_their_order(
    pages: tuple[tuple[int, str, str], ...], follows: bool
) -> None:
    new = [stub(number=number, previous=previous, hash=hash) for number, previous, hash in pages]
    assert sync._follows(stub(counted=(4, "h4")), new) is follows


def test_pages_that_count_are_handed_in_before_all_others(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    chain = station.plant.pages.chain(WEST)
    with station.transaction():
        for n, hash in ((1, "a"), (2, "b"), (2, "c"), (3, "d")):
            station.plant.pages.add(chain.id, PageRow(n, h(hash), "", "", "", b"", b"", bytes(64)))
    monkeypatch.setattr(returned, "octets_of", lambda row: bytes.fromhex(row.hash)[-1:])
    monkeypatch.setattr(returned, "counted_places", lambda *_: {(1, h("a")), (2, h("c"))})
    digest = {hash: hashlib.sha256(hash.encode()).hexdigest() for hash in "abcd"}

    def lacking(*there: tuple[int, str]) -> list[tuple[int, bytes]]:
        return list(returned._lacking(station, cast("Any", None), chain, there))

    assert lacking() == [(1, b"a"), (2, b"c"), (2, b"b"), (3, b"d")]
    assert lacking((1, digest["a"]), (3, digest["c"]), (2, digest["b"])) == [(2, b"c"), (3, b"d")]


def test_pages_are_read_up_to_one_of_a_newer_format(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    """Junk among them is passed over; what follows none that is here is left."""
    batches, junk = list[list[int]](), list[int]()

    def opened(carried: CarriedPage, _roster: Any, author: str) -> Any:
        assert author == WEST
        if carried.octets == b"newer":
            raise NewerFormatError("a page of format 2")
        if carried.octets == b"junk":
            raise NotAuthenticError("no signature")
        return stub(number=carried.number, hash=carried.octets.decode(), events=[1] * 3)

    monkeypatch.setattr(fetching, "open_carried", opened)
    monkeypatch.setattr(fetching, "hash_of", lambda octets: octets.decode())
    monkeypatch.setattr(fetching, "EVENTS_AT_ONCE", 6)
    take_pages = lambda _s, _r, batch: batches.append([page.number for page in batch])  # noqa: E731
    monkeypatch.setattr(fetching, "take_pages", take_pages)

    def taken(*octets: bytes, first: int = 1) -> Any:
        batches.clear()
        pages = [CarriedPage(WEST, n, each) for n, each in enumerate(octets, first)]
        return take_carried(station, cast("Any", None), WEST, pages, lambda carried: junk.append(carried.number))

    done = taken(b"p1", b"p2", b"p3", b"p4", b"p5")
    assert (done.pages, done.waits, batches) == (5, None, [[1, 2], [3, 4], [5]])
    done = taken(b"p1", b"newer", b"p3")
    assert (done.pages, bool(done.waits), batches) == (1, True, [[1]])
    done = taken(b"p1", b"junk", b"p3")
    assert (done.pages, [carried.number for carried in done.junk], junk, batches) == (1, [2], [2], [[1]])
    assert taken(b"p7", first=7).pages == 0
    good, bad = fetching.read_pages(
        [CarriedPage(WEST, 1, b"p1"), CarriedPage(WEST, 2, b"junk")], cast("Any", None), WEST
    )
    assert ([page.number for page in good], bad) == ([1], [2])
    with pytest.raises(NewerFormatError):
        fetching.read_pages([CarriedPage(WEST, 1, b"junk"), CarriedPage(WEST, 2, b"newer")], cast("Any", None), WEST)


def test_a_ban_is_lifted_by_its_signer_or_a_keeper(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    keeper, base = "aa" * 32, "bb" * 32
    roles = {keeper: frozenset({"keeper"}), base: frozenset({"base"})}
    roster = stub(
        point_of=lambda kid: b"member" if kid in roles else None, roles_of=lambda of: roles.get(of, frozenset())
    )
    points = {"trusted": b"trusted"}
    lifters = list[str]()
    monkeypatch.setattr(apply_pages, "require_roster", lambda _: roster)
    monkeypatch.setattr(station.plant.claims, "lifters", lambda hash: lifters if hash == "H" else [])
    monkeypatch.setattr(station.policy, "station_points", lambda: points)

    def opened(statement: str, find: Callable[[str], bytes | None]) -> Any:
        if find(statement) is None:
            raise NotAuthenticError("a stranger signed it")
        return stub(sender=statement)

    monkeypatch.setattr(apply_pages, "open_revocation", opened)

    def lifted(signer: str, *by: str) -> bool:
        lifters[:] = by
        return apply_pages._is_lifted(station, signer, "H")

    assert [lifted(base), lifted(base, base), lifted(base, keeper), lifted(keeper, base)] == [False, True, True, False]
    assert lifted("trusted", "trusted"), "a station that a person trusts"
    assert lifted(station.fingerprint, base, station.fingerprint), "this station"
    assert not lifted("stranger", "stranger", keeper)


def test_removals_are_known_from_rosters_that_the_ca_signed(station: Station) -> None:
    held = station.plant.roster
    assert held is not None
    assert removed_members._removals_in(held.octets, station.ca) == (held.created, frozenset())
    never = datetime.max.replace(tzinfo=UTC), frozenset()
    assert removed_members._removals_in(b"a proof of two rosters", station.ca) == never


def test_nodes_are_looked_through_so_many_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(removed_members, "_PAGE", 2)

    def pages(*numbers: int) -> list[list[bytes]]:
        names = [(bytes([number]) * 10, "k", 1, "active") for number in numbers]
        keys = stub(all_key_names=lambda: iter(names))
        return list(removed_members._pages(cast("Any", stub(keys=keys))))

    one, two, three = (bytes([number]) * 10 for number in (1, 2, 3))
    assert pages() == []
    assert pages(1, 2, 1, 3, 2) == [[one, two], [three]], "each node once"
    assert pages(1, 2) == [[one, two]]


# -- folder and database -----------------------------------------------------------------------------------------------


def test_a_folder_that_cannot_be_used_is_named_with_its_cause(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    transport = FolderTransport(tmp_path)
    transport.send(Parcel("11111111-2222-4333-8444-555555555555", "me", b"one", ""))
    (tmp_path / "to" / "me" / "readme.txt").write_bytes(b"two")
    link = tmp_path / "to" / "me" / "21111111-2222-4333-8444-555555555555"
    link.symlink_to(tmp_path / "to" / "me" / "readme.txt")
    found = list(transport.parcels("me"))
    assert [(parcel.id[:2], parcel.octets) for parcel in found] == [("11", b"one")]
    assert list(transport.new_parcels("me", {found[0].id})) == []
    transport.drop(found[0].id, "me")
    transport.drop(found[0].id, "me")
    assert list(transport.parcels("me")) == []
    full = OSError(errno.EIO, "Input/output error")
    calls: list[tuple[str, Callable[[], object]]] = [
        ("unlink", lambda: transport.drop("x", "me")),
        ("iterdir", lambda: list(transport.parcels("me"))),
        ("mkdir", lambda: transport.send(Parcel("x", "you", b"", ""))),
    ]
    for method, call in calls:
        with monkeypatch.context() as patch:
            patch.setattr(Path, method, raises(full))
            with pytest.raises(LinkError) as error:
                call()
        assert (error.value.message, error.value.hint) == (
            f"Cannot use folder {tmp_path}: Input/output error.", "Check its owner, its mode and the free space."
        )  # fmt: skip
    with monkeypatch.context() as patch:
        patch.setattr(Path, "iterdir", raises(NotADirectoryError()))
        assert list(transport.parcels("me")) == []
    (tmp_path / "to" / "me" / "31111111-2222-4333-8444-555555555555").write_bytes(b"three")
    monkeypatch.setattr("teds_provision.plant.folder_transport.read_limited", raises(LinkError("It cannot be read.")))
    with pytest.raises(LinkError, match="It cannot be read"):
        list(transport.parcels("me"))


def test_a_transport_follows_from_what_was_joined(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def at(url: str | None) -> None:
        with station.transaction():
            station.plant.put_record(PlantRecord(REGISTRY, url=url))

    assert (connecting.open_transport(station), connecting.listener(station)) == (None, None)
    at(f"{membership.FILES}{tmp_path}")
    found = connecting.open_transport(station)
    assert isinstance(found, FolderTransport)
    assert (found.where, connecting.listener(station)) == (str(tmp_path), None)
    assert connecting.check_database(station, found) == []
    at("postgresql://office/plant")
    for asked in (connecting.open_transport, connecting.listener):
        with pytest.raises(NotMemberError) as error:
            asked(station)
        assert (error.value.message, error.value.hint) == (
            "This station has no database login yet.",
            "To get one: registry request --output FILE; the database's administrator then runs: registry"
            " sql --member FILE | psql",
        )
    monkeypatch.setattr(station.plant, "login", lambda: ("key", "verifier"))
    monkeypatch.setattr(postgres, "parameters", lambda url, digits, key: {"url": url, "key": key})
    opened = connecting.open_transport(station)
    assert isinstance(opened, postgres.PostgresTransport)
    listened = connecting.listener(station)
    assert listened is not None
    assert listened._told == {"url": "postgresql://office/plant", "key": "key"}


def test_open_doors_of_a_database_are_kept_with_the_logins_of_removed_stations(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    swept, doors, logins = list[bool](), ["public may create"], [WEST, station.fingerprint]
    transport = postgres.PostgresTransport(cast("Any", None), "office", station.fingerprint)
    for name, given in (("sweep", lambda: swept.append(True)), ("open_doors", lambda: list(doors)),
                        ("open_logins", lambda: logins)):  # fmt: skip
        monkeypatch.setattr(transport, name, given)
    roster = stub(removed=(stub(fingerprint=WEST, name="west"), stub(fingerprint="cc" * 32, name="south")))
    monkeypatch.setattr(type(station.plant), "roster", roster)
    found = connecting.check_database(station, transport)
    assert found == ["public may create", "login of west, which was removed"]
    assert (station.plant.doors(), swept) == (found, [True])
    doors.clear()
    logins.clear()
    assert connecting.check_database(station, transport) == station.plant.doors() == []


def test_a_database_needs_its_driver_and_a_schema_that_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    class Missing:
        @property
        def conninfo(self) -> Any:
            raise ImportError("psycopg")

    with monkeypatch.context() as patch:
        patch.setattr(postgres, "psycopg", Missing())
        with pytest.raises(UsageError) as error:
            postgres.require_driver()
    assert error.value.message == "A registry on PostgreSQL needs psycopg, which is not installed."
    assert error.value.hint.startswith("Install it: ")
    assert "[registry]" in error.value.hint
    registry = postgres.Registry({})
    rows = list[Any]()
    monkeypatch.setattr(registry, "_rows", lambda *_: rows)
    with pytest.raises(StoreError) as failed:
        registry.look()
    assert (failed.value.message, failed.value.hint) == (
        "The database does not contain a registry.", "Ask its administrator to run: registry sql | psql"
    )  # fmt: skip
    rows.append(("meta", None, 3, REGISTRY))
    with pytest.raises(StoreError) as failed:
        registry.look()
    assert (failed.value.message, failed.value.hint) == (
        "The database has schema 3; this program knows 2.", "Use a newer version of teds-provision."
    )  # fmt: skip
    rows[0] = ("meta", None, 2, REGISTRY)
    assert registry.look().registry == REGISTRY
    asked = list[str]()

    def rows_of(version: int) -> Callable[..., list[Any]]:
        def ask(statement: str, _values: object) -> list[Any]:
            asked.append(statement)
            if statement == postgres._LOOK:
                raise postgres._NoSchemaError("There is no table.")
            return [("meta", None, version, REGISTRY)]

        return ask

    for version, statements in ((1, [postgres._LOOK_1]), (2, [])):
        asked.clear()
        monkeypatch.setattr(registry, "_rows", rows_of(version))
        assert registry.look().schema == version
        assert asked[2:] == statements, "only of an older schema less is asked"


# -- parcels -----------------------------------------------------------------------------------------------------------


def test_a_station_without_a_roster_takes_and_sends_nothing(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(station.plant), "roster", None)
    untouched: Any = stub()
    assert parcels.take_in(station, untouched, untouched, NOW) == parcels.ParcelCounts(0, 0)
    assert parcels.send_out(station, untouched, untouched, NOW) == parcels.SentParcels(0)
    assert list(yield_stats._of_pages(station, "job")) == []


@pytest.mark.parametrize("behind", [timedelta(days=-1), timedelta(days=1)])
def test_parcels_come_before_they_go_at_a_time_that_is_not_before_the_roster(
    station: Station, monkeypatch: pytest.MonkeyPatch, behind: timedelta
) -> None:
    """By a clock that was set back, a copy that is over would count again."""
    held = station.plant.roster
    assert held is not None
    clock, asked = held.created - behind, list[tuple[str, object]]()
    at = max(clock, held.created)

    def take_in(_station: Any, _transport: Any, seen: Any, when: object) -> Any:
        asked.append(("in", when))
        assert seen([NODE]) == ("views of", [NODE])
        return parcels.ParcelCounts(2, 3)

    def send_out(_station: Any, _transport: Any, seen: Any, when: object) -> Any:
        asked.append(("out", when))
        return parcels.SentParcels(4, ("held back",))

    monkeypatch.setattr(sync, "now", lambda: clock)
    monkeypatch.setattr(sync, "merged_views", lambda _station, roster, uuids: roster is held and ("views of", uuids))
    monkeypatch.setattr(sync.removed_members, "review", lambda _station, _roster, when: asked.append(("review", when)))
    monkeypatch.setattr(sync.parcels, "take_in", take_in)
    monkeypatch.setattr(sync.parcels, "send_out", send_out)
    done = sync.SyncResult(remarks=["before"])
    sync._parcels(station, cast("Any", None), held, done)
    assert asked == [("review", at), ("in", at), ("out", at)], "what came in goes on, and no key of who was removed"
    assert (done.parcels_in, done.waiting, done.parcels_out, done.remarks) == (2, 3, 4, ["before", "held back"])


def test_a_parcel_that_waited_for_pages_is_judged_once_more(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    station.unlock()
    refused, imported = list[object](), list[str]()
    held = station.plant.roster
    assert held is not None
    reader = parcels._Reader(station, held, cast("Any", None), NOW)
    monkeypatch.setattr(parcels, "refuse_bundle", lambda _station, error: refused.append(error))
    monkeypatch.setattr(parcels, "import_parcel", lambda _station, row, plan: imported.append(row.id))
    monkeypatch.setattr(reader, "_why_not", lambda plan: plan)
    nothing = incoming.NothingImportedError(
        cast("Any", stub(id="b", sender=WEST)), (stub(node=stub(uuid=NODE), why="x"),)
    )

    def judged(plan: Any) -> tuple[bool, str | None, str]:
        row = ParcelRow("p", "in", WEST, "bundle", "later", "2099-01-01T00:00:00Z")
        with station.transaction():
            station.plant.parcels.put(row, b"document")
        answer = plan if isinstance(plan, Exception) else None
        monkeypatch.setattr(incoming, "plan_import", raises(answer) if answer else lambda *_: plan)
        done = reader.judge_again(row)
        kept = station.plant.parcels.get("p", "in")
        return done, kept.state if kept is not None else None, kept.detail if kept is not None else ""

    assert judged(nothing) == (True, None, "")
    assert refused == [nothing]
    assert judged(BadDataError("It is damaged.")) == (True, None, "")
    assert refused == [nothing], "its sender is not answered"
    assert judged("its sender is not a member") == (False, "waiting", "its sender is not a member")
    assert (judged("")[0], imported) == (True, ["p"])
    taken = incoming.ImportResult.__new__(incoming.ImportResult)
    assert (judged(taken)[0], imported) == (True, ["p", "p"])


def test_a_parcel_that_waits_here_already_stays_in_the_registry_too(station: Station) -> None:
    reader: Any = parcels._Reader.__new__(parcels._Reader)
    reader.station = station
    with station.transaction():
        station.plant.parcels.put(ParcelRow("p1", "in", WEST, "bundle", "waiting", "2099-01-01T00:00:00Z"), b"kept")
    assert reader.process_parcel(Parcel("p1", station.fingerprint, b"{another", "")) is False
    assert station.plant.parcels.document("p1", "in") == b"kept"
    assert station.plant.alarms.all() == []


def test_a_failure_that_is_not_the_parcels_fault_throws_nothing_away(station: Station) -> None:
    station.unlock()
    held = station.plant.roster
    assert held is not None
    reader = parcels._Reader(station, held, cast("Any", None), NOW)
    parcel = Parcel("p", station.fingerprint, b"{}", "2099-01-01T00:00:00Z", WEST)
    with pytest.raises(StoreError, match="no space"):
        reader._junk(parcel, StoreError("There is no space."))
    for error, alarms in (
        (NotFoundError("unknown bundle"), 0),
        (PolicyError("too late"), 0),
        (BadDataError("cut."), 1),
    ):
        assert reader._junk(parcel, error)
        assert len(station.plant.alarms.all()) == alarms
    [alarm] = station.plant.alarms.all()
    assert (alarm.code, alarm.about, alarm.why) == ("parcel", WEST, "a parcel was discarded: cut")


# -- evidence, jobs, vouching ------------------------------------------------------------------------------------------


def test_a_file_of_evidence_that_cannot_be_read_is_judged_with_its_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bad.json").write_bytes(b"none")
    grounds: Any = stub(faults_of=lambda *_: [])
    bad, missing = verify_evidence.judge_files(grounds, [str(tmp_path / "bad.json"), str(tmp_path / "none.json")])
    assert (bad.file, bad.evidence, isinstance(bad.error, BadDataError)) == (str(tmp_path / "bad.json"), None, True)
    assert (missing.good, isinstance(missing.error, NotFoundError)) == (False, True)


def test_evidence_that_another_station_writes_at_once_keeps_its_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_new, taken = evidence.write_new, {3}

    def raced(path: Path, octets: bytes, *, mode: int) -> None:
        if path.name == "x.2.json":
            path.write_bytes(b"of another station")
        write_new(path, octets, mode=mode)

    monkeypatch.setattr(evidence, "write_new", raced)
    assert evidence._new_file(tmp_path, "x", 2, taken, b"mine") == tmp_path / "x.4.json"
    assert (tmp_path / "x.2.json").read_bytes() == b"of another station"
    assert (tmp_path / "x.4.json").read_bytes() == b"mine"
    assert evidence._new_file(tmp_path, "x", 2, taken, None) == tmp_path / "x.5.json"
    assert taken == {2, 3, 4, 5}


def test_a_datasheet_that_cannot_be_read_is_in_no_backlog(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = {b"good": stub(signed=True, station_key=station.point, key_epoch=3, sequence=7),
             b"other": stub(signed=True, station_key=b"other", key_epoch=3, sequence=8),
             b"unsigned": stub(signed=False, station_key=station.point, key_epoch=3, sequence=9)}  # fmt: skip

    def decode(octets: bytes) -> Any:
        if octets not in shown:
            raise BadDataError("damaged")
        return shown[octets]

    images = [
        stub(image=stub(security=octets)) for octets in (b"damaged", b"other", b"unsigned", None, b"good", b"good")
    ]
    monkeypatch.setattr(backlog.security, "decode", decode)
    monkeypatch.setattr(backlog, "signature_good", lambda *_: True)
    monkeypatch.setattr(station.datasheets, "history", lambda _: images)
    assert list(backlog.signed_here(station, NODE)) == [(3, 7, hashlib.sha256(b"good").hexdigest())]


def test_a_keeper_vouches_for_authentic_datasheets_of_who_may_not_sign(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    uuids = [bytes([number]) * 10 for number in range(7)]
    gone, member = SoftwareKey(31), SoftwareKey(32)
    shown = {b"damaged": None, b"unsigned": stub(station_key=None), b"members": stub(station_key=member.point),
             b"false": stub(station_key=gone.point), b"gone": stub(station_key=gone.point)}  # fmt: skip
    octets = [None, *shown, b"absent"]
    roster = stub(has=lambda digits, role: (digits, role) == (fingerprint(member.point), "sign"))

    def decode(of: bytes) -> Any:
        if shown[of] is None:
            raise BadDataError("damaged")
        return shown[of]

    images = {uuid: stub(security=each) for uuid, each in zip(uuids, octets, strict=True) if each != b"absent"}
    monkeypatch.setattr(membership, "require_roster", lambda _: roster)
    monkeypatch.setattr(membership.security, "decode", decode)
    monkeypatch.setattr(membership, "verify_image", lambda _trust, image: (image,))
    verdict = lambda _uuid, checks: stub(verdict="authentic" if checks[0].security != b"false" else "changed")  # noqa: E731
    monkeypatch.setattr(membership, "Verification", verdict)
    monkeypatch.setattr(station.datasheets, "datasheet", images.get)
    monkeypatch.setattr(station.nodes, "all_shown_keys", lambda: [stub(uuid=uuid) for uuid in uuids])
    found = [(uuids[5], hashlib.sha256(b"gone").hexdigest(), fingerprint(gone.point)[:16])]
    assert membership.vouchable(station, None) == membership.vouchable(station, uuids) == found
    assert membership.vouchable(station, uuids[:5]) == []
    with pytest.raises(PolicyError) as error:
        membership.vouch(station, found)
    assert (error.value.message, error.value.hint) == (
        "Only a keeper can vouch for datasheets.", "See: registry status"
    )  # fmt: skip
    monkeypatch.undo()
    assert (membership.vouch(station, found), station.plant.unsent()) == (1, 1)
    me = station.fingerprint
    words = list[tuple[str, int, bool]]()
    monkeypatch.setattr(
        station.plant.claims, "signers", lambda digest: words if digest == hashlib.sha256(b"gone").digest() else []
    )
    for known, fresh in (((WEST, 3, True), 1), ((me, 3, False), 1), ((me, 3, True), 0)):
        words[:] = [known]
        assert membership.vouch(station, found) == fresh, "what this station vouched for already is not stated again"


# -- beside the service ------------------------------------------------------------------------------------------------


def test_a_folder_that_becomes_a_database_is_listened_to(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    """A station that left the registry meanwhile reports no last sync."""
    said = list[dict[str, str]]()
    watch = service.PlantWatch(station, cast("Any", stub(event=lambda _of, **facts: said.append(facts))), lambda: None)
    monkeypatch.setattr(type(station.plant), "joined", None)
    watch._after(3)
    assert said == []
    done, turns = list[object](), iter([False, False, False, True, True])
    stop: Any = stub(is_set=lambda: next(turns), wait=done.append)
    listener = stub(listen=lambda: done.append("listen"), sweep=lambda: done.append("sweep"), close=lambda: None,
                    wait=lambda seconds: done.append("wait") or True)  # fmt: skip
    found = iter([None, listener])
    monkeypatch.setattr(watch, "_stop", stop)
    monkeypatch.setattr(connecting, "place_of", lambda _: "place")
    monkeypatch.setattr(connecting, "listener", lambda _: next(found))
    watch._listen()
    assert done == [service.EVERY, "listen", "sweep", "wait"]
    assert watch._wake.is_set()


# -- pages that others handed in ---------------------------------------------------------------------------------------


def test_own_pages_are_taken_from_who_handed_in_none_that_is_false(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a member that handed in one false page, no further one is read; those that are known are not asked for."""
    me = station.fingerprint
    pages = [(3, "liar", "h3"), (1, "liar", "false"), (2, "west", "h2"), (4, "west", "known"), (5, "", "mine")]
    offers = [stub(n=n, by=by, hash=hash) for n, by, hash in pages]
    read = list[str]()

    def octets(batch: Any) -> Iterator[Any]:
        yield from (stub(by=offer.by, hash=offer.hash) for offer in batch)

    def read_pages(carried: Any, _roster: Any, of: str) -> tuple[list[Any], list[int]]:
        [one] = carried
        assert of == me
        read.append(one.hash)
        return ([], [1]) if one.hash == "false" else ([one], [])

    database: Any = stub(
        was_handed_in=lambda of: of == me, offers=lambda of: offers if of == me else [], octets=octets
    )  # fmt: skip
    new = [False]
    monkeypatch.setattr(returned, "read_pages", read_pages)
    monkeypatch.setattr(returned, "is_new", lambda *_: new[0])

    def own(*, always: bool = False) -> list[str]:
        read.clear()
        found = returned.own_pages(station, database, cast("Any", None), {"known"}, always=always)
        return [page.hash for page in found]

    assert (own(), read) == ([], [])
    assert (own(always=True), read) == (["h2"], ["false", "h2"])
    new[0] = True
    assert (own(), read) == (["h2"], ["false", "h2"])
    database.was_handed_in = lambda _: False
    assert own(always=True) == []
    assert returned.own_pages(station, None, cast("Any", None), (), always=True) == []


def test_what_both_sides_have_of_others_is_new_if_any_part_of_it_is() -> None:
    """By roster, by who may hand in, by the database's state of each, and by every page that is here."""

    def digest(
        roster: str = "R", takes: bool = True, states: tuple[str, ...] = ("1", "2"), pages: tuple[str, ...] = ("a", "b")
    ) -> str:
        by_name = dict(zip((WEST, "dd" * 32), states, strict=True))
        chains = {"dd" * 32: stub(id=1)}
        links = [(n, hash, "") for n, hash in enumerate(pages)]
        station = stub(plant=stub(pages=stub(chains=lambda: chains, chain_links=lambda _: links)))
        database: Any = stub(state=by_name.get, takes_pages=takes)
        return returned._digest(station, database, cast("Any", stub(by_key=by_name, hash=roster)))

    other: list[dict[str, Any]] = [
        {}, {"roster": "S"}, {"takes": False}, {"states": ("1", "3")}, {"states": ("", "2")}, {"pages": ("a", "c")},
        {"pages": ("a",)}, {"pages": ("c", "b")},
    ]  # fmt: skip
    found = [digest(**changes) for changes in other]
    assert digest() == found[0]
    assert len(set(found)) == len(other)
    assert digest(states=("", "")) == ""


def test_who_is_in_no_roster_joins_none(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    held = station.plant.roster
    assert held is not None
    with pytest.raises(PolicyError) as error:
        owner.join(station, replace(held, members=()), url=None, events=())
    assert (error.value.message, error.value.hint) == (
        "The roster of plant does not name this station.",
        "Send its owner a request (registry request --output FILE); the owner then runs: registry add FILE --role …",
    )
    events = [("closed", None, {"job": "11111111-2222-4333-8444-555555555555"})]
    order, transaction = list[str](), station.transaction
    monkeypatch.setattr(station, "unlock", lambda: order.append("unlock"))
    monkeypatch.setattr(station, "transaction", lambda: order.append("transaction") or transaction())
    assert owner.join(station, held, url="file:/stick", events=cast("Any", events)) == 1
    assert order[:2] == ["unlock", "transaction"], "nobody types a passphrase while the store is held"
    record = station.plant.joined
    assert record is not None
    assert (record.url, len(station.plant.outbox(9))) == ("file:/stick", 1)
    [entry] = [entry for entry in station.audit_log.entries() if (entry.act, entry.outcome) == ("registry", "joined")]
    assert (entry.detail["version"], entry.detail["events"]) == (1, 1)
