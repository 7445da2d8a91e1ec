"""Numbers, edges and orders of contract/plant.md, as literals: what is read at the limit, and not one beyond it."""

from __future__ import annotations

import json
from datetime import timedelta
from typing import Any

import pytest

from teds_provision.errors import BadDataError, NotAuthenticError, TedsProvisionError
from teds_provision.protocol.handover.strict_json import base64url, decode_base64url, time_text
from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message
from teds_provision.protocol.plant import document, event, page, signing
from teds_provision.protocol.plant.document import DocumentKind, open_document, sign_document
from teds_provision.protocol.plant.roster import (
    Member,
    RemovedMember,
    Roster,
    Share,
    names_other_ca,
    open_roster,
    read_roster,
    seal_roster,
)
from tests.plant.plants import CA, NOW, REGISTRY, certificate
from tests.plant.test_documents import KAT, KEYS, POINTS, octets_of

ANYBODY = SoftwareKey(4711)
H = "ab" * 32


def payload_of(octets: bytes) -> bytes:
    return decode_base64url(octets.split(b".")[1], "")


# -- how large a document may be ---------------------------------------------------------------------------------------

KIND_SIZES: list[tuple[DocumentKind, str, int]] = [
    (document.ROSTER, "teds-roster+jws", 1_048_576),
    (document.PAGE, "teds-page+jws", 1_048_576),
    (document.MEMBER_REQUEST, "teds-member-request+jws", 16_384),
    (document.JOB, "teds-job+jws", 4_194_304),
    (document.SIGN_REQUEST, "teds-sign-request+jws", 1_048_576),
    (document.SIGNED, "teds-signed+jws", 65_536),
]


@pytest.mark.parametrize(("kind", "typ", "most"), KIND_SIZES)
def test_a_document_has_the_type_and_at_most_the_octets_of_its_kind(kind: DocumentKind, typ: str, most: int) -> None:
    assert kind.typ == typ
    with pytest.raises(BadDataError, match=f"at most {most} "):
        open_document(b"." * (most + 1), lambda kid: None, kind)
    if kind is document.MEMBER_REQUEST:
        with pytest.raises(BadDataError, match=f"at most {most} "):
            document.open_request(b"." * (most + 1))
    with pytest.raises(TedsProvisionError) as error:
        open_document(b"." * most, lambda kid: None, kind)
    assert "at most" not in error.value.message


def test_no_document_is_signed_that_its_readers_refuse_for_its_size() -> None:
    def sized(octets: int) -> bytes:
        return sign_document({"format": "teds-signed/1", "why": "x" * octets}, ANYBODY, document.SIGNED)

    spare = 65_536 - len(sized(0))
    at_most = next(octets for octets in (sized(spare * 3 // 4 - more) for more in range(8)) if len(octets) <= 65_536)
    assert len(at_most) > 65_530
    with pytest.raises(BadDataError, match="at most 65536"):
        sized(spare * 3 // 4 + 8)


# -- members in the order of the contract ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["roster 1", "roster 2"])
def test_a_roster_is_written_as_the_known_answers_have_it(name: str) -> None:
    read = open_roster(octets_of(name), KEYS["ca"].point)
    assert document.payload(read.unsigned()) == payload_of(octets_of(name))
    assert payload_of(seal_roster(read, KEYS["ca"])) == payload_of(octets_of(name))


def test_blanks_around_a_roster_and_a_request_do_not_count() -> None:
    octets, ca = octets_of("roster 1"), KEYS["ca"].point
    spaced = b" " + octets + b"\r\n"
    assert open_roster(spaced, ca) == open_roster(octets, ca)
    assert [names_other_ca(each, ca) for each in (octets, spaced)] == [False, False]
    assert [names_other_ca(each, KEYS["west"].point) for each in (octets, spaced)] == [True, True]
    asked = octets_of("member-request")
    assert document.open_request(b" " + asked + b"\r\n") == document.open_request(asked)


def test_a_roster_is_written_in_the_order_of_the_contract() -> None:
    gone = RemovedMember("west", KEYS["west"].point, frozenset({"sign", "keeper"}), "stolen", (9, H), (4, "cd" * 32))
    whole = Roster(
        REGISTRY, "plant", 3, H, NOW, NOW + timedelta(days=90),
        (Member("north", ANYBODY.point, bytes(64), frozenset({"line", "base"}), (7, H)),), (gone,),
        (Share(("group", "hand"), ("ef" * 32,), forget=True), Share(("all", ""), ())),
    )  # fmt: skip
    assert document.payload(whole.unsigned()).decode() == (
        f'{{"format":"teds-roster/1","registry":"{REGISTRY}","name":"plant","version":3,"previous":"{H}",'
        '"created":"2026-03-01T12:00:00Z","expires":"2026-05-30T12:00:00Z",'
        f'"members":[{{"name":"north","point":"{ANYBODY.point.hex()}","certificate":"{"A" * 86}",'
        f'"roles":["line","base"],"signed":[7,"{H}"]}}],'
        f'"removed":[{{"name":"west","point":"{KEYS["west"].point.hex()}","roles":["keeper","sign"],'
        f'"signed":[4,"{"cd" * 32}"],"why":"stolen","last":[9,"{H}"]}}],'
        f'"share":[{{"what":{{"group":"hand"}},"to":["{"ef" * 32}"],"forget":true}},'
        '{"what":{"all":true},"to":[],"forget":false}]}'
    )


def test_a_request_to_join_a_sign_request_and_an_answer_are_written_as_the_known_answers_have_them() -> None:
    asked = document.open_request(octets_of("member-request"))
    assert payload_of(asked.signed(KEYS["south"])) == payload_of(octets_of("member-request"))
    request = signing.open_request(octets_of("sign-request"), POINTS.get)
    assert payload_of(signing.seal_request(request, KEYS["west"])) == payload_of(octets_of("sign-request"))
    answer = signing.open_answer(octets_of("signed"), POINTS.get)
    assert payload_of(signing.seal_answer(answer, KEYS["office"])) == payload_of(octets_of("signed"))
    refused = signing.Answer(H, refused="full", why="all 3 units of the job are assigned")
    assert payload_of(signing.seal_answer(refused, ANYBODY)).decode() == (
        f'{{"format":"teds-signed/1","of":"{H}","refused":"full","why":"all 3 units of the job are assigned"}}'
    )


def test_a_page_is_written_in_the_order_of_the_contract_its_heads_by_fingerprint() -> None:
    heads = {"b" * 64: (7, H), "a" * 64: (4_294_967_295, H)}
    draft = page.PageDraft(REGISTRY, 2, H, "0123456789abcdef", NOW, heads, (12, "cd" * 32))
    unpinned = event.made("unpinned", "0" * 16, "2026-02-01T12:00:00Z", bytes(10), {})
    octets = page.sign_page(draft, [unpinned], ANYBODY)
    station = fingerprint(ANYBODY.point)
    assert payload_of(octets).decode() == (
        f'{{"format":"teds-page/1","registry":"{REGISTRY}","station":"{station}","n":2,"previous":"{H}",'
        '"home":"0123456789abcdef","created":"2026-03-01T12:00:00Z",'
        f'"heads":{{"{"a" * 64}":[4294967295,"{H}"],"{"b" * 64}":[7,"{H}"]}},"audit":[12,"{"cd" * 32}"],'
        '"events":[{"act":"unpinned","id":"0000000000000000","at":"2026-02-01T12:00:00Z",'
        '"uuid":"00000000000000000000"}]}'
    )
    read = page.open_page(octets, REGISTRY, lambda kid: ANYBODY.point if kid == station else None)
    assert (read.station, read.number, read.previous, read.home) == (station, 2, H, "0123456789abcdef")
    assert (read.created, dict(read.heads)) == ("2026-03-01T12:00:00Z", heads)


# -- who may be in a roster, how many, for how long --------------------------------------------------------------------


def roster_members(**changes: Any) -> dict[str, Any]:
    me = Member("north", ANYBODY.point, certificate(ANYBODY), frozenset({"keeper"}))
    whole = Roster(REGISTRY, "plant", 1, "", NOW, NOW + timedelta(days=90), (me,))
    return {**json.loads(document.payload(whole.unsigned())), **changes}


def points(count: int) -> list[str]:
    return [SoftwareKey(number).point.hex() for number in range(20_000, 20_000 + count)]


def test_a_roster_removes_at_most_1024_stations_and_has_at_most_256_shares() -> None:
    removed = [{"name": "west", "point": point, "roles": [], "why": "lost", "last": [0, ""]} for point in points(1025)]
    shares = [{"what": {"group": f"hand {number}"}, "to": [], "forget": False} for number in range(257)]
    whole = read_roster(roster_members(removed=removed[:1024], share=shares[:256]), CA.point)
    assert (len(whole.removed), len(whole.share)) == (1024, 256)
    for change, why in (({"removed": removed}, "removed has 1025"), ({"share": shares}, "share has 257")):
        with pytest.raises(BadDataError, match=why):
            read_roster(roster_members(**change), CA.point)


def test_a_roster_has_at_most_256_members_and_one_share_as_many_receivers() -> None:
    keys = [SoftwareKey(number) for number in range(30_000, 30_257)]
    members = [
        {
            "name": f"station {number}",
            "point": key.point.hex(),
            "certificate": base64url(CA.sign(station_key_message(key.point))).decode(),
            "roles": ["base"],
        }
        for number, key in enumerate(keys)
    ]
    to = [fingerprint(key.point) for key in keys]
    share = {"what": {"all": True}, "to": to[:256], "forget": True}
    whole = read_roster(roster_members(members=members[:256], share=[share]), CA.point)
    assert len(whole.members) == 256
    assert whole.share == (Share(("all", ""), tuple(to[:256]), forget=True),)
    with pytest.raises(BadDataError, match="members has 257"):
        read_roster(roster_members(members=members), CA.point)
    with pytest.raises(BadDataError, match="to has 257"):
        read_roster(roster_members(share=[{**share, "to": to}]), CA.point)


@pytest.mark.parametrize(
    ("seconds", "good"), [(-1, False), (0, False), (1, True), (400 * 86_400, True), (400 * 86_400 + 1, False)]
)
def test_a_roster_ends_after_it_was_made_and_within_400_days(seconds: int, good: bool) -> None:
    changed = roster_members(expires=time_text(NOW + timedelta(seconds=seconds)))
    if good:
        assert read_roster(changed, CA.point).expires == NOW + timedelta(seconds=seconds)
        return
    with pytest.raises(BadDataError, match="expires is not within 400 days after created"):
        read_roster(changed, CA.point)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"version": 2}, "previous"),  # it follows nothing
        ({"version": 2, "previous": None}, "previous"),
        ({"previous": "0"}, "previous"),
        ({"share": [{"what": {"all": True}, "to": ["south"]}]}, "to is no list of fingerprints"),
        ({"share": [{"what": {"all": True}, "to": [], "forget": 1}]}, "forget is neither true nor false"),
        ({"share": [{"what": {"group": " hand"}, "to": []}]}, "what is none of"),
        ({"share": [{"what": {"node": "hand"}, "to": []}]}, "what is none of"),
        ({"share": [{"what": {"all": False}, "to": []}]}, "what is none of"),
        ({"removed": [{"name": "west", "point": KEYS["west"].point.hex(), "roles": [], "why": "sold",
                       "last": [0, ""]}]}, "why is none of retired, lost, stolen"),
        ({"removed": [{"name": "west", "point": KEYS["west"].point.hex(), "roles": [], "why": "lost",
                       "last": [1, ""]}]}, "last is no page"),
    ],
)  # fmt: skip
def test_what_no_roster_can_say_is_refused(changes: dict[str, Any], why: str) -> None:
    with pytest.raises(BadDataError, match=why):
        read_roster(roster_members(**changes), CA.point)


def test_lists_that_are_not_there_are_empty_and_a_share_forgets_nothing_by_itself() -> None:
    members = roster_members(share=[{"what": {"profile": "load-cell"}}])
    del members["removed"]
    read = read_roster(members, CA.point)
    assert (read.removed, read.share) == ((), (Share(("profile", "load-cell"), (), forget=False),))
    assert open_roster(seal_roster(read, CA), CA.point).unsigned() == read.unsigned()


def test_a_request_to_join_is_signed_by_the_very_key_that_its_header_names() -> None:
    members = KAT["documents"]["member-request"]["payload"]
    header = {"alg": "ES256", "kid": fingerprint(KEYS["west"].point), "typ": "teds-member-request+jws"}
    signed = b".".join((base64url(json.dumps(header).encode()), base64url(document.payload(members))))
    posed = signed + b"." + base64url(KEYS["south"].sign(signed))
    with pytest.raises(NotAuthenticError):
        document.open_request(posed)
    for name, value in (("login", members["login"] + "\n"), ("login", members["login"].replace("4096", "1")),
                        ("name", "south "), ("certificate", members["certificate"] + "AA")):  # fmt: skip
        with pytest.raises(BadDataError, match=name):
            document.open_request(sign_document({**members, name: value}, KEYS["south"], document.MEMBER_REQUEST))


# -- events ------------------------------------------------------------------------------------------------------------

NODE: dict[str, object] = {"uuid": "8d4d9da65281f7000000"}
JOB = "0b5f6f5e-0f3b-4a55-9d7c-2f1b8a3c4d5e"
BUNDLE = {"peer": H, "bundle": JOB}
HANDED = {**NODE, "epoch": 3, "key_id": "0123456789abcdef", "mode": "move", **BUNDLE}
SIGNED = {**NODE, "epoch": 3, "sequence": 4, "teds_sha256": H}
RESET = {**NODE, "epoch": 3, "challenge": "0a" * 32, "proof": "0b" * 64, "point": ANYBODY.point.hex()}
WRITTEN = {**SIGNED, "profile": "load-cell", "profile_sha256": H, "due": "2026-12-31"}
NOT_32_OCTETS: tuple[object, ...] = ("0a" * 31, "0a" * 33, "0A" * 32, "0g" * 32, "0a" * 31 + " a", "٣" * 64, 7)
NOT_A_DIGEST: tuple[object, ...] = (*NOT_32_OCTETS, None)
NOT_A_NUMBER: tuple[object, ...] = (-1, 4_294_967_296, "3", True, None, 3.0)

EVENTS: list[tuple[str, dict[str, object], dict[str, tuple[object, ...]], dict[str, tuple[object, ...]]]] = [
    # act, members, what else each may be, what it may not
    ("pinned", {**NODE, "fingerprint": H, "assurance": "tap"},
     {"assurance": ("bus", "uuid", "import", "registry")},
     {"fingerprint": NOT_A_DIGEST, "assurance": ("Tap", "", None), "uuid": ("8d4d9da65281f70000", None, "8D" * 10)}),
    ("unpinned", NODE, {}, {"uuid": (None,)}),
    ("agreed", {**NODE, "fingerprint": H, "epoch": 0, "key_id": "0123456789abcdef"},
     {"epoch": (4_294_967_295,)},
     {"epoch": NOT_A_NUMBER, "key_id": ("0123456789ABCDEF", "0" * 15, None), "fingerprint": NOT_A_DIGEST}),
    ("signed", SIGNED, {}, {"epoch": NOT_A_NUMBER, "sequence": NOT_A_NUMBER, "teds_sha256": NOT_A_DIGEST}),
    ("written", WRITTEN, {"profile": (None,), "profile_sha256": (None,), "due": (None,)},
     {"sequence": NOT_A_NUMBER, "profile_sha256": NOT_32_OCTETS, "profile": (1, "a\nb", "x" * 1025), "due": (1,)}),
    ("vouched", {**NODE, "teds_sha256": H}, {}, {"teds_sha256": NOT_A_DIGEST, "uuid": (None,)}),
    ("gave", HANDED, {"mode": ("copy",)},
     {"mode": ("lend", None), "peer": NOT_A_DIGEST, "bundle": ("0" * 36, None), "epoch": NOT_A_NUMBER}),
    ("took", HANDED, {"mode": ("copy",)}, {"mode": ("lend", None), "key_id": ("", None)}),
    ("undone", {**NODE, **BUNDLE, "why": "by hand"}, {"why": ("", "x" * 1024)}, {"bundle": (None,), "why": (None, 1)}),
    ("refused", {**NODE, **BUNDLE, "why": "revoked"}, {}, {"peer": NOT_A_DIGEST, "why": ("x" * 1025,)}),
    ("forgot", {**NODE, "epoch": 3}, {}, {"epoch": NOT_A_NUMBER}),
    ("reset", RESET, {},
     {"challenge": NOT_A_DIGEST, "proof": ("0b" * 63, "0b" * 65, None), "point": ("03" + "00" * 64, None)}),
    ("revoked", {**NODE, "statement": "e30.e30.e30"}, {}, {"statement": (None, 1), "uuid": (None,)}),
    ("lifted", {"of": H}, {"uuid": ("no node is asked for",)}, {"of": NOT_A_DIGEST}),
    ("named", {**NODE, "name": "left hand"}, {"name": ("x" * 100,)}, {"name": ("x" * 101, "", " x", "x ", None)}),
    ("grouped", {**NODE, "group": "hand", "member": True}, {"member": (False,)},
     {"member": (None, 1, "true"), "group": ("", "hand ", None)}),
    ("firmware", {**NODE, "runs": ["app", "1.2.3+4", H]}, {"runs": (None,)}, {"runs": ([], "app")}),
    ("evidence", {**NODE, "sha256": H, "job": JOB, "unit": 37, "verdict": "passed"},
     {"job": (None,), "unit": (None,)},
     {"sha256": NOT_A_DIGEST, "job": ("0b5f",), "unit": ("37", -1), "verdict": (None,), "uuid": (None,)}),
    ("closed", {"job": JOB}, {}, {"job": (None, "0b5f")}),
    ("alarm", {"code": "fork", "about": H, "n": 3}, {"about": (None,)},
     {"code": (None,), "about": ("",), "n": (None,)}),
]  # fmt: skip


def stated(act: str, members: dict[str, object]) -> dict[str, object]:
    return {"act": act, "id": "0123456789abcdef", "at": "2026-01-31T12:00:00Z", **members}


def test_every_act_is_in_the_table() -> None:
    assert [act for act, *_ in EVENTS] == list(event.FORMS)


@pytest.mark.parametrize(("act", "members", "also", "never"), EVENTS, ids=[act for act, *_ in EVENTS])
def test_an_act_has_its_members_each_of_its_form(
    act: str,
    members: dict[str, object],
    also: dict[str, tuple[object, ...]],
    never: dict[str, tuple[object, ...]],
) -> None:
    good = stated(act, members)
    assert isinstance(event.read(good), event.Event), event.read(good)
    for name, values in also.items():
        for value in values:
            assert isinstance(event.read({**good, name: value}), event.Event), (name, value)
    for name, values in never.items():
        for value in values:
            assert isinstance(event.read({**good, name: value}), str), (name, value)
    for name in members:
        assert isinstance(event.read({k: v for k, v in good.items() if k != name}), str), name
    for name, value in (("id", "0123456789abcde"), ("id", 1), ("at", "2026-01-31 12:00:00Z"), ("at", None)):
        assert event.read({**good, name: value}) == f"{act}: no good id or time"
    uuid = bytes.fromhex("8d4d9da65281f7000000") if "uuid" in members else None
    own = {name: value for name, value in members.items() if name != "uuid"}
    assert event.made(act, "0123456789abcdef", "2026-01-31T12:00:00Z", uuid, own) == good
    assert list(event.made(act, "0123456789abcdef", "2026-01-31T12:00:00Z", uuid, own)) == [
        "act", "id", "at", *(["uuid"] if uuid is not None else []), *event.FORMS[act]
    ]  # fmt: skip


@pytest.mark.parametrize(("act", "members", "most"), [("unpinned", NODE, 16_384), ("revoked", {}, 20_480)])
def test_an_event_has_at_most_16_kib_and_a_ban_20(act: str, members: dict[str, object], most: int) -> None:
    good = stated(act, {**NODE, **members, "statement": ""})
    room = most - len(json.dumps(good, separators=(",", ":")))
    assert isinstance(event.read({**good, "statement": "x" * room}), event.Event)
    assert event.read({**good, "statement": "x" * (room + 1)}) == f"{act}: larger than an event may be"


def test_a_page_has_at_most_1000_events_and_700000_octets_of_payload() -> None:
    draft = page.PageDraft(REGISTRY, 1, "", "0" * 16, NOW, {}, (1, "0" * 64))
    unpinned = stated("unpinned", NODE)
    assert (
        len(
            page.open_page(
                page.sign_page(draft, [unpinned] * 1000, ANYBODY), REGISTRY, lambda kid: ANYBODY.point
            ).events
        )
        == 1000
    )
    least = len(payload_of(page.sign_page(draft, [{**unpinned, "x": ""}], ANYBODY)))
    page.sign_page(draft, [{**unpinned, "x": "y" * (700_000 - least)}], ANYBODY)
    with pytest.raises(BadDataError, match="at most 700000 octets"):
        page.sign_page(draft, [{**unpinned, "x": "y" * (700_001 - least)}], ANYBODY)


@pytest.mark.parametrize(
    ("head", "kept"),
    [
        ([4_294_967_295, H], True), ([0, H], True), ([4_294_967_296, H], False), ([-1, H], False), ([1, ""], False),
        ([1, H, 1], False), ([True, H], False), ([1.5, H], False), ((H, 1), False),
    ],
)  # fmt: skip
def test_a_head_that_is_not_of_its_form_is_passed_over_alone(head: Any, kept: bool) -> None:
    good = {"c" * 64: (1, H)}
    found = page._heads({**{name: list(place) for name, place in good.items()}, "d" * 64: head, "D" * 64: [1, H]})
    assert found == ({**good, "d" * 64: (head[0], head[1])} if kept else good)


def test_a_page_has_at_most_2048_heads_or_none_is_read() -> None:
    heads = {f"{number:064x}": [number, H] for number in range(2048)}
    assert len(page._heads(heads)) == 2048
    assert page._heads({**heads, "f" * 64: [1, H]}) == {}
    assert page._heads(list(heads)) == {}


@pytest.mark.parametrize(
    ("n", "previous", "good"),
    [(1, "", True), (1, None, False), (1, ..., False), (1, H, False), (1, 0, False), (1, [], False), (2, H, True),
     (2, "", False), (2, H.upper(), False), (2, H[:-1], False)],
)  # fmt: skip
def test_a_page_names_the_one_before_and_the_first_one_none(n: int, previous: object, good: bool) -> None:
    draft = page.PageDraft(REGISTRY, 1, "", "0" * 16, NOW, {}, (1, "0" * 64))
    members = {**json.loads(payload_of(page.sign_page(draft, [], ANYBODY))), "n": n, "previous": previous}
    if previous is ...:
        del members["previous"]
    octets = sign_document(members, ANYBODY, document.PAGE)
    if good:
        assert page.open_page(octets, REGISTRY, lambda kid: ANYBODY.point).previous == previous
        return
    with pytest.raises(BadDataError, match="previous is not H of the page before"):
        page.open_page(octets, REGISTRY, lambda kid: ANYBODY.point)


@pytest.mark.parametrize("around", [b"", b"\n", b" \r\n"])
def test_an_answer_of_the_office_may_have_a_line_end_of_an_editor(around: bytes) -> None:
    sealed = signing.seal_answer(signing.Answer(H, refused="full", why="no unit is left"), ANYBODY)
    found = signing.open_answer(around + sealed + around, lambda kid: ANYBODY.point)
    assert found == signing.Answer(H, refused="full", why="no unit is left")


def test_a_page_of_no_such_day_has_no_time() -> None:
    draft = page.PageDraft(REGISTRY, 1, "", "0" * 16, NOW, {}, (1, "0" * 64))
    members = json.loads(payload_of(page.sign_page(draft, [], ANYBODY)))

    def read(created: object) -> str:
        octets = sign_document({**members, "created": created}, ANYBODY, document.PAGE)
        return page.open_page(octets, REGISTRY, lambda kid: ANYBODY.point).created

    assert [read(text) for text in ("2026-02-28T12:00:00Z", "2026-02-31T12:00:00Z", "2026-02-28", 1)] == [
        "2026-02-28T12:00:00Z", "", "", ""
    ]  # fmt: skip
