"""Documents of a plant: read as the known answers have them, refused where an octet of them is another."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from teds_provision.errors import BadDataError, NotAuthenticError, PolicyError, TedsProvisionError
from teds_provision.protocol.handover.strict_json import decode_base64url
from teds_provision.protocol.keys import GROUP_ORDER, SoftwareKey, station_key_message
from teds_provision.protocol.plant import document, event, page, roster
from teds_provision.protocol.plant.document import DocumentKind, NewerFormatError, hash_of
from teds_provision.protocol.plant.roster import Member, RemovedMember, Roster, open_roster, seal_roster, taking

KAT: dict[str, Any] = json.loads((Path(__file__).parent.parent / "vectors/profile/plant_kat.json").read_text())
KEYS = {name: SoftwareKey(int(key["d"], 16)) for name, key in KAT["keys"].items()}
POINTS = {key["fingerprint"]: bytes.fromhex(key["point"]) for key in KAT["keys"].values()}
KINDS: dict[str, DocumentKind] = {
    kind.format.split("/")[0].removeprefix("teds-"): kind
    for kind in (document.ROSTER, document.PAGE, document.MEMBER_REQUEST, document.JOB, document.SIGN_REQUEST,
                 document.SIGNED)
}  # fmt: skip
DOCUMENTS = [name for name, item in KAT["documents"].items() if item["typ"] in KINDS]
CA = KEYS["ca"]


def octets_of(name: str) -> bytes:
    octets: str = KAT["documents"][name]["jws"]
    return octets.encode()


def kind_of(name: str) -> DocumentKind:
    return KINDS[KAT["documents"][name]["typ"]]


def test_every_kind_of_document_has_a_known_answer() -> None:
    assert {kind_of(name) for name in DOCUMENTS} == set(KINDS.values())


@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_known_document_is_read_and_its_payload_is_written_alike(name: str) -> None:
    given = KAT["documents"][name]
    read = document.open_document(octets_of(name), POINTS.get, kind_of(name))
    assert read.members == given["payload"]
    assert read.hash == given["H"]
    assert read.signer == KAT["keys"][given["signed_by"]]["fingerprint"]
    assert document.payload(given["payload"]) == decode_base64url(octets_of(name).split(b".")[1], "")
    assert document.join(*document.split(octets_of(name))) == octets_of(name)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_document_with_another_octet_anywhere_is_nobodys(name: str) -> None:
    good = octets_of(name)
    step = max(1, len(good) // 400)
    for place in range(0, len(good), step):
        for change in (1, 0x20, 0x80):
            bad = bytearray(good)
            bad[place] ^= change
            with pytest.raises(TedsProvisionError) as error:
                document.open_document(bytes(bad), POINTS.get, kind_of(name))
            assert error.value.exit_code in (4, 6, 8)


def test_the_other_s_of_a_signature_is_good_and_names_the_same_document() -> None:
    header, text, signature = octets_of("west 1").split(b".")
    raw = decode_base64url(signature, "")
    other = raw[:32] + (GROUP_ORDER - int.from_bytes(raw[32:], "big")).to_bytes(32, "big")
    twin = document.join(header, decode_base64url(text, ""), other)
    read = page.open_page(twin, KAT["registry"], POINTS.get)
    assert twin != octets_of("west 1")
    assert read.hash == KAT["documents"]["west 1"]["H"]


@pytest.mark.parametrize(
    "header",
    [
        {"alg": "ES256", "kid": "KID", "typ": "teds-page+jws", "cty": "x"},
        {"alg": "ES256", "kid": "KID"},
        {"alg": "ES256", "kid": "KID", "typ": "application/teds-page+jws"},
        {"alg": "ES256", "kid": "KID", "typ": "teds-roster+jws"},
        {"alg": "none", "kid": "KID", "typ": "teds-page+jws"},
    ],
)
def test_a_header_holds_exactly_algorithm_signer_and_type(header: dict[str, str]) -> None:
    key = KEYS["west"]
    header_text = json.dumps(header).replace("KID", document.fingerprint(key.point)).encode()
    signed = b".".join((document.base64url(header_text), document.base64url(b'{"format":"teds-page/1"}')))
    octets = signed + b"." + document.base64url(key.sign(signed))
    with pytest.raises((BadDataError, PolicyError)):
        document.open_document(octets, POINTS.get, document.PAGE)


@pytest.mark.parametrize(
    "content",
    [
        b'{"format":"teds-page/1","n":1.0}',
        b'{"format":"teds-page/1","n":1e3}',
        b'{"format":"teds-page/1","n":1,"n":1}',
        b'{"format":"teds-page/1","n":NaN}',
        b"[" * 100_000,
        b'{"format":"teds-page/1","n":' + b"9" * 10_000 + b"}",
        b"[]",
        b"",
        b"\xff",
    ],
)
def test_a_payload_that_readers_might_read_differently_is_refused(content: bytes) -> None:
    octets = document.jose.sign_compact(content, KEYS["west"], typ=document.PAGE.typ)
    with pytest.raises(BadDataError):
        document.open_document(octets, POINTS.get, document.PAGE)


def test_a_document_of_a_newer_format_is_reported_as_one() -> None:
    octets = document.jose.sign_compact(b'{"format":"teds-page/2"}', KEYS["west"], typ=document.PAGE.typ)
    with pytest.raises(NewerFormatError, match="newer version"):
        document.open_document(octets, POINTS.get, document.PAGE)


def test_a_document_larger_than_its_kind_is_not_even_parsed() -> None:
    with pytest.raises(BadDataError, match="at most 1048576"):
        document.open_document(b"a" * (1 << 20) + b".b.c", POINTS.get, document.PAGE)


def test_a_request_is_signed_by_the_key_that_it_shows() -> None:
    read = document.open_request(octets_of("member-request"))
    assert (read.name, read.point) == ("south", KEYS["south"].point)
    forged = document.sign_document(
        KAT["documents"]["member-request"]["payload"], KEYS["west"], document.MEMBER_REQUEST
    )
    with pytest.raises(NotAuthenticError):
        document.open_request(forged)


# -- rosters -----------------------------------------------------------------------------------------------------------

NOW = datetime(2026, 2, 1, 12, tzinfo=UTC)


def a_member(name: str, *roles: str) -> Member:
    point = KEYS[name].point
    return Member(name, point, CA.sign(station_key_message(point)), frozenset(roles))


def a_roster(version: int, members: tuple[Member, ...], previous: str = "", **more: Any) -> Roster:
    draft = Roster(KAT["registry"], "plant", version, previous, NOW, NOW + timedelta(days=90), members, **more)
    return open_roster(seal_roster(draft, CA), CA.point)


def left(member: Member) -> RemovedMember:
    return RemovedMember(member.name, member.point, member.roles, "lost", (0, ""))


NORTH, WEST = a_member("north", "keeper"), a_member("west", "line", "sign")


def test_the_known_rosters_are_read_and_follow_each_other() -> None:
    first, second = (open_roster(octets_of(f"roster {n}"), CA.point) for n in (1, 2))
    assert [member.name for member in first.members] == ["north", "west", "office", "south"]
    assert [removed.name for removed in second.removed] == ["west"]
    assert second.removed[0].last == (1, KAT["documents"]["west 1"]["H"])
    assert taking(second, first, KAT["registry"]) == ("taken", "")
    assert taking(first, second, KAT["registry"])[0] == "older"
    assert document.payload(first.unsigned()) == document.payload(KAT["documents"]["roster 1"]["payload"])


def test_two_rosters_of_one_version_are_reported_and_the_next_version_cures() -> None:
    first, other = a_roster(1, (NORTH,)), a_roster(1, (NORTH, WEST))
    assert taking(other, first, first.registry)[0] == "two rosters"
    assert taking(a_roster(2, (NORTH, WEST), other.hash), first, first.registry)[0] == "taken, two rosters"
    assert taking(a_roster(2, (NORTH, WEST), first.hash), first, first.registry)[0] == "taken"
    assert taking(a_roster(5, (NORTH, WEST), "ab" * 32), first, first.registry)[0] == "taken"


def test_each_of_many_rosters_is_judged_by_those_before_it() -> None:
    own = a_roster(1, (NORTH,))
    straight = a_roster(2, (NORTH, WEST), own.hash)
    candidates = (a_roster(2, (NORTH, WEST), f"{number:064x}") for number in range(100))
    astray = next(found for found in candidates if found.hash < straight.hash)
    third = a_roster(3, (NORTH, WEST), astray.hash)
    judged = roster.best([third, straight, astray, own], own, own.registry)
    assert [(seen.hash, how) for seen, how, _ in judged] == [
        (own.hash, "same"),
        (astray.hash, "taken, two rosters"),
        (straight.hash, "two rosters"),
        (third.hash, "taken"),
    ]


def test_a_member_is_meant_before_a_removed_station_of_its_name_and_of_those_the_last() -> None:
    first, last = (replace(left(a_member(name, "line")), name="west") for name in ("south", "office"))
    assert a_roster(2, (NORTH, WEST), "ab" * 32, removed=(first, last)).named("west") == WEST
    gone = a_roster(2, (NORTH,), "ab" * 32, removed=(first, last))
    assert gone.named("west") == last
    assert gone.named(first.fingerprint[:16].upper()) == first
    assert gone.named(first.fingerprint[:15]) is None


def test_no_station_leaves_a_roster_without_being_removed_and_none_comes_back() -> None:
    both, gone = a_roster(1, (NORTH, WEST)), a_roster(2, (NORTH,), removed=(left(WEST),), previous="ab" * 32)
    assert taking(a_roster(2, (NORTH,), both.hash), both, both.registry)[0] == "refused"
    assert taking(a_roster(3, (NORTH, WEST), gone.hash), gone, gone.registry)[0] == "refused"
    assert taking(gone, both, both.registry)[0].startswith("taken")
    assert taking(gone, both, "00000000-0000-4000-8000-000000000000")[0] == "refused"


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"expires": "2026-02-01T12:00:00Z"}, "expires"),
        ({"expires": "2027-06-01T12:00:00Z"}, "expires"),
        ({"created": "2026-02-30T12:00:00Z"}, "created"),
        ({"version": 0}, "version"),
        ({"version": True}, "version"),
        ({"version": 1 << 32}, "version"),
        ({"previous": "ABC"}, "previous"),
        ({"registry": "6F1C0A52-6f0e-4c1b-8a55-0d9ce5609c29"}, "registry"),
        ({"name": " plant"}, "name"),
        ({"name": "plant\u202e"}, "name"),
        ({"name": "x" * 101}, "name"),
        ({"members": {}}, "members"),
        ({"members": [{"name": "x"}]}, "point"),
        ({"share": [{"what": {"all": 1}, "to": []}]}, "what"),
        ({"share": [{"what": {"group": "a", "all": True}, "to": []}]}, "what"),
        ({"removed": [{"name": "x", "point": "04" + "00" * 64, "roles": [], "why": "lost", "last": [0, ""]}]}, "point"),
    ],
)
def test_a_roster_that_does_not_add_up_is_refused_with_words(change: dict[str, object], why: str) -> None:
    members = {**KAT["documents"]["roster 1"]["payload"], **change}
    with pytest.raises(BadDataError, match=why):
        open_roster(document.sign_document(members, CA, document.ROSTER), CA.point)


def test_a_key_or_a_name_occurs_once_in_a_roster() -> None:
    namesake = Member("north", WEST.point, WEST.certificate, WEST.roles)
    for members, removed in (((NORTH, NORTH), ()), ((NORTH, namesake), ()), ((NORTH, WEST), (left(WEST),))):
        with pytest.raises(BadDataError):
            a_roster(1, members, removed=removed)


def test_a_certificate_of_another_ca_is_refused() -> None:
    stranger = Member("west", WEST.point, KEYS["office"].sign(station_key_message(WEST.point)), WEST.roles)
    with pytest.raises(BadDataError, match="certificate"):
        a_roster(1, (NORTH, stranger))


def test_unknown_roles_are_passed_over_and_none_is_audit() -> None:
    members = KAT["documents"]["roster 1"]["payload"]
    first = {**members["members"][0], "roles": ["driver", "keeper"]}
    second = {**members["members"][1], "roles": ["driver"]}
    read = open_roster(document.sign_document({**members, "members": [first, second]}, CA, document.ROSTER), CA.point)
    assert [sorted(member.roles) for member in read.members] == [["keeper"], ["audit"]]


# -- pages and their events --------------------------------------------------------------------------------------------


def test_the_known_pages_are_read_with_every_event() -> None:
    acts = set()
    for name in ("north 1", "west 1", "west 2", "south 1", "west 2, other history", *KAT["firmware"]["pages"]):
        read = page.open_page(octets_of(name), KAT["registry"], POINTS.get)
        events = [event.read(value) for value in read.events]
        assert all(isinstance(item, event.Event) for item in events)
        acts |= {item.act for item in events if isinstance(item, event.Event)}
    assert acts == set(event.FORMS)


@pytest.mark.parametrize("runs", KAT["firmware"]["refused"], ids=str)
def test_firmware_that_no_node_can_report_is_no_event(runs: object) -> None:
    good = KAT["documents"]["west 3"]["payload"]["events"][0]
    assert isinstance(event.read(good), event.Event)
    assert event.read({**good, "runs": runs}) == "firmware: runs is not of its form"


def test_a_page_is_its_members_and_of_its_registry() -> None:
    with pytest.raises(BadDataError, match="another registry"):
        page.open_page(octets_of("west 1"), "00000000-0000-4000-8000-000000000000", POINTS.get)
    with pytest.raises(NotAuthenticError):
        page.open_page(octets_of("west 1"), KAT["registry"], lambda kid: None)
    posed = document.sign_document(KAT["documents"]["west 1"]["payload"], KEYS["south"], document.PAGE)
    with pytest.raises(BadDataError, match="another station"):
        page.open_page(posed, KAT["registry"], POINTS.get)


def test_what_is_wrong_beside_the_chain_does_not_end_it() -> None:
    members = {**KAT["documents"]["west 1"]["payload"], "home": 7, "created": None, "heads": {"x": 1}, "audit": []}
    read = page.open_page(document.sign_document(members, KEYS["west"], document.PAGE), KAT["registry"], POINTS.get)
    assert (read.home, read.created, read.heads) == ("", "", {})


@pytest.mark.parametrize("change", [{"n": 0}, {"n": "1"}, {"previous": "x"}, {"n": 2}, {"events": {}}, {"station": ""}])
def test_a_page_without_its_place_in_a_chain_is_junk(change: dict[str, object]) -> None:
    members = {**KAT["documents"]["west 1"]["payload"], **change}
    with pytest.raises(BadDataError):
        page.open_page(document.sign_document(members, KEYS["west"], document.PAGE), KAT["registry"], POINTS.get)


def test_an_event_that_is_not_of_its_form_is_reported_and_one_that_is_not_known_is_passed_over() -> None:
    good = KAT["documents"]["west 1"]["payload"]["events"][0]
    assert isinstance(event.read(good), event.Event)
    assert isinstance(event.read({**good, "more": 1}), event.Event)
    assert event.read({**good, "act": "danced"}) is None
    changes: list[dict[str, object]] = [
        {"id": "F" * 16}, {"at": "yesterday"}, {"uuid": good["uuid"].upper()}, {"fingerprint": 1},
        {"assurance": "word"}, {"more": "x" * (17 << 10)}, {"more": "\ud800" * (6 << 10)}, {"act": 1}, {"act": []},
    ]  # fmt: skip
    for change in changes:
        assert isinstance(event.read({**good, **change}), str), change
    assert isinstance(event.read([]), str)
    written = KAT["documents"]["west 1"]["payload"]["events"][3]
    for name in event.FORMS["written"]:  # one that may be null is there all the same
        assert isinstance(event.read({key: value for key, value in written.items() if key != name}), str)


def test_the_reset_of_the_known_answers_is_proven_and_no_other() -> None:
    reset = next(item for item in KAT["documents"]["west 2"]["payload"]["events"] if item["act"] == "reset")
    good = event.read(reset)
    assert isinstance(good, event.Event)
    assert event.reset_proven(good) == KAT["keys"]["node"]["fingerprint"]
    other = event.read({**reset, "epoch": 2})
    assert isinstance(other, event.Event)
    assert event.reset_proven(other) is None


def test_a_page_takes_no_more_than_readers_do() -> None:
    draft = page.PageDraft(KAT["registry"], 1, "", "0" * 16, NOW, {}, (1, "0" * 64))
    unpinned = event.made("unpinned", "0" * 16, "2026-02-01T12:00:00Z", bytes(10), {})
    with pytest.raises(BadDataError, match="1000"):
        page.sign_page(draft, [unpinned] * 1001, KEYS["west"])
    with pytest.raises(BadDataError, match="700000"):
        page.sign_page(draft, [{**unpinned, "x": "y" * 1000}] * 900, KEYS["west"])
    assert hash_of(page.sign_page(draft, [unpinned], KEYS["west"])) == hash_of(
        page.sign_page(draft, [unpinned], KEYS["west"])
    )


def test_an_event_is_made_in_the_order_of_the_contract_or_not_made() -> None:
    made = event.made("agreed", "0" * 16, "2026-02-01T12:00:00Z", bytes(10), {
        "key_id": "0" * 16, "epoch": 1, "fingerprint": "0" * 64,
    })  # fmt: skip
    assert list(made) == ["act", "id", "at", "uuid", "fingerprint", "epoch", "key_id"]
    with pytest.raises(ValueError):
        event.made("agreed", "0" * 16, "2026-02-01T12:00:00Z", bytes(10), {**made, "epoch": -1})
    assert roster.best([], None, "") == []
