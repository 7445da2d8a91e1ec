"""Whitelists of other people: every form that is read, every mistake that is named, nothing by half."""

from __future__ import annotations

import json
import string
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from teds_provision.errors import BadDataError, KeyMismatchError, NotFoundError, PolicyError, UsageError
from teds_provision.provisioning.whitelist import (
    FORMATS,
    ListedNode,
    _WhitelistReader,
    add,
    form_of,
    named,
    plan_addition,
    read_whitelist,
    remove,
    render,
    require_name,
)
from teds_provision.station.station import Station
from teds_provision.station.store.records import RevocationRecord, WhitelistEntry
from tests.pace import costs_at_most

ONE, TWO = bytes.fromhex("8d4d9da65281f7000000"), bytes.fromhex("8d4d9da65281f7000001")
KEY, OTHER = "ab" * 32, "cd" * 32


def read(folder: Path, text: str, name: str = "list.txt") -> list[ListedNode]:
    path = folder / name
    path.write_text(text)
    return read_whitelist(path)


def pairs(listed: list[ListedNode]) -> list[tuple[bytes, str | None]]:
    return [(entry.uuid, entry.fingerprint) for entry in listed]


@pytest.mark.parametrize(
    "text",
    [
        f'<whitelist><transducer uuid="0x{ONE.hex()}" fingerprint="{KEY}"/>'
        f'<transducer uuid="{TWO.hex()}"/></whitelist>',
        f"<w:whitelist xmlns:w='u'><w:tim UUID='0X{ONE.hex().upper()}' Fingerprint='{KEY}'/>"
        f"<w:tim uuid='{TWO.hex()}'/></w:whitelist>",
        f"<a><transducer><uuid>0x{ONE.hex()}</uuid><fingerprint>{KEY}</fingerprint></transducer>"
        f"<transducer><uuid>{TWO.hex()}</uuid></transducer></a>",
        f"uuid,fingerprint\n{ONE.hex()},{KEY}\n{TWO.hex()},\n",
        f"name;UUID;Fingerprint\nfinger;0x{ONE.hex()};{KEY.upper()}\n\n# a remark\n;{TWO.hex()};\n",
        f"{ONE.hex()},{KEY}\n{TWO.hex()}\n",
        f"{ONE.hex()},{KEY[:32]}\n{TWO.hex()}\n{ONE.hex()},{KEY}\n{ONE.hex()}\n{ONE.hex()},{KEY[:40]}\n",
        json.dumps({"whitelist": [{"uuid": ONE.hex(), "fingerprint": KEY}, {"uuid": TWO.hex(), "fingerprint": None}]}),
        json.dumps([{"UUID": "0x" + ONE.hex(), "fingerprint": KEY}, TWO.hex()]),
    ],
)
def test_entries_with_and_without_a_key_are_read_from_every_form(tmp_path: Path, text: str) -> None:
    assert pairs(read(tmp_path, text)) == [(ONE, KEY), (TWO, None)]


@pytest.mark.parametrize(
    "text",
    [
        f"<whitelist><uuid>0x{ONE.hex()}</uuid><uuid>{TWO.hex()}</uuid></whitelist>",
        f"<whitelist><transducer>\n 0x{ONE.hex()}\n</transducer><transducer>{TWO.hex()}</transducer></whitelist>",
        f"<uuids>0x{ONE.hex()}\n0x{TWO.hex()}</uuids>",
        f"<uuids>{ONE.hex()} {TWO.hex()}</uuids>",
        f"<ncap><list><entry><id>0x{ONE.hex()}</id></entry><x>0x{TWO.hex()}</x></list><note>hello</note></ncap>",
        f"{ONE.hex()}\n0x{TWO.hex()}\n",
        json.dumps([ONE.hex(), f"0x{TWO.hex()}"]),
        f"\ufeff{ONE.hex()}\r\n{TWO.hex()}\r\n",
    ],
)
def test_a_bare_list_of_uuids_is_read(tmp_path: Path, text: str) -> None:
    assert pairs(read(tmp_path, text)) == [(ONE, None), (TWO, None)]


@pytest.mark.parametrize("text", ["<whitelist/>", "uuid,fingerprint\n", '{"whitelist": []}'])
def test_an_empty_whitelist_is_one(tmp_path: Path, text: str) -> None:
    assert read(tmp_path, text) == []


@pytest.mark.parametrize(
    ("text", "places"),
    [
        (f'<whitelist>\n<transducer uuid="12"/>\n<transducer uuid="{ONE.hex()}" fingerprint="ab"/></whitelist>',
         [":2: uuid: expected 20 hex digits", ":3: fingerprint: expected 32 to 64 hex digits"]),
        ("<whitelist>\n\n<transducer/></whitelist>", [":3: uuid: expected 20 hex digits, not nothing"]),
        (f"uuid\n{ONE.hex()}\nzz\n", [":3: uuid"]),
        (f"uuid,name\n{ONE.hex()},a,b\n", [":2: row: 3 cells for 2 columns"]),
        (f'[\n"{ONE.hex()}",\n{{"uuid": "{TWO.hex()}",\n "fingerprint": 7}},\n 4]',
         [":3: fingerprint: expected a string", ":5: entry"]),
        (f"{ONE.hex()},{KEY}\n{ONE.hex()},{OTHER}\n", [":2: fingerprint: line 1 has the same UUID with another key"]),
        (f"{ONE.hex()}{'00' * 6}\n", [":1: uuid"]),
        (f"uuid,name\n{ONE.hex()},a\x1bb\n", [":2: name"]),
        ("<whitelist>\n<a></whitelist>", [":2: this is not XML"]),
        ("<html><p>404</p></html>", ["no UUID in this document"]),
        ('{"whitelist": 3}', ["whitelist: expected a list"]),
        ('{"whitelist": [', [":1: this is not JSON"]),
        ("[" * 100_000, ["list.txt"]),
        ("<a>" * 40, ["nested too deeply"]),
        (f"<r><uuid>{ONE.hex()}</uuid><uuid>{TWO.hex()}</uuid><fingerprint>{KEY}</fingerprint></r>",
         ["belongs to none"]),
    ],
)  # fmt: skip
def test_every_wrong_line_is_named(tmp_path: Path, text: str, places: list[str]) -> None:
    with pytest.raises(BadDataError) as caught:
        read(tmp_path, text)
    for place in places:
        assert place in caught.value.message
    assert "list.txt" in caught.value.message


def test_the_first_ten_of_many_wrong_lines_are_shown(tmp_path: Path) -> None:
    with pytest.raises(BadDataError, match=r"list\.txt:10: .*and 20 more") as caught:
        read(tmp_path, "x\n" * 30)
    assert "list.txt:11" not in caught.value.message


BOMB = '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {chr(98 + n)} "{f"&{chr(97 + n)};" * 10}">' for n in range(8)
)


@pytest.mark.parametrize(
    "text",
    [
        BOMB + "]><whitelist><uuid>&i;</uuid></whitelist>",
        '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><whitelist><uuid>&x;</uuid></whitelist>',
        '<!DOCTYPE whitelist SYSTEM "http://127.0.0.1:1/x.dtd"><whitelist/>',
        "<!DOCTYPE whitelist><whitelist/>",
    ],
)
def test_entity_bombs_and_external_entities_are_refused(tmp_path: Path, text: str) -> None:
    with costs_at_most(1.0), pytest.raises(BadDataError, match="DTD"):
        read(tmp_path, text)


def test_a_missing_file_and_other_encodings_are_reported(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError):
        read_whitelist(tmp_path / "none.xml")
    with pytest.raises(NotFoundError, match="is a folder"):
        read_whitelist(tmp_path)
    (tmp_path / "latin.csv").write_bytes(b"uuid,name\n\xe4")
    with pytest.raises(BadDataError, match=r"latin\.csv:2: the text is not UTF-8"):
        read_whitelist(tmp_path / "latin.csv")


NAMES = st.text(alphabet=string.printable[:95] + "äß€&<>\"'", min_size=1, max_size=20).map(str.strip).filter(bool)
ENTRIES = st.lists(
    st.builds(
        WhitelistEntry,
        uuid=st.binary(min_size=10, max_size=10),
        fingerprint=st.none() | st.binary(min_size=32, max_size=32).map(bytes.hex),
        assurance=st.sampled_from(["tap", "bus", "uuid", "import"]),
        name=st.none() | NAMES,
    ),
    unique_by=lambda entry: entry.uuid,
    max_size=8,
)


@pytest.mark.parametrize("form", FORMATS)
@given(entries=ENTRIES)
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_exported_is_read_back(tmp_path: Path, form: str, entries: list[WhitelistEntry]) -> None:
    path = tmp_path / f"out.{form}"
    path.write_text("".join(render(entries, form)))
    read_back = {(entry.uuid, entry.fingerprint, entry.name) for entry in read_whitelist(path)}
    assert read_back == {(entry.uuid, entry.fingerprint, entry.name) for entry in entries}


@pytest.mark.parametrize("form", FORMATS)
@given(octets=st.binary(max_size=200) | st.text(alphabet='<>/"=&;[]{}:, \n0x8d4fuidlst', max_size=120).map(str.encode))
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_octets_make_anything_but_entries_or_one_of_our_errors(tmp_path: Path, form: str, octets: bytes) -> None:
    path = tmp_path / "junk"
    path.write_bytes(octets)
    try:
        listed = read_whitelist(path, form)
    except BadDataError:
        return
    assert all(len(entry.uuid) == 10 for entry in listed)


@pytest.mark.slow
def test_ten_thousand_entries_are_quick(tmp_path: Path, station: Station) -> None:
    entries = [WhitelistEntry(number.to_bytes(10, "big"), KEY, assurance="tap") for number in range(10_000)]
    for form in FORMATS:
        (tmp_path / f"big.{form}").write_text("".join(render(entries, form)))
    with costs_at_most(6):  # 1 s on a quiet machine; each looked up among all, one by one, took minutes
        listed = [read_whitelist(tmp_path / f"big.{form}") for form in FORMATS]
        assert len(listed[0]) == len(listed[1]) == len(listed[2]) == 10_000
        add(station, plan_addition(station, listed[0]), source="big.xml")
    assert len(station.pins.whitelist()) == 10_000
    assert plan_addition(station, listed[1]).write == ()


@pytest.mark.slow
def test_more_entries_than_a_whitelist_has_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadDataError, match="more than 250000 entries"):
        read(tmp_path, "".join(f"{number:020x}\n" for number in range(250_001)))


# -- trust -------------------------------------------------------------------------------------------------------------


def put(station: Station, *listed: ListedNode) -> None:
    add(station, plan_addition(station, listed), source="test")


def test_a_pinned_key_is_never_replaced_and_one_conflict_refuses_all(station: Station) -> None:
    put(station, ListedNode(1, ONE, KEY))
    with pytest.raises(KeyMismatchError, match="pinned to the key abababababababab") as caught:
        plan_addition(station, [ListedNode(1, TWO), ListedNode(2, ONE, OTHER)])
    assert caught.value.exit_code == 6
    assert station.pins.entry(TWO) is None


def test_an_unpinned_entry_gains_a_key_and_keeps_the_rest(station: Station) -> None:
    put(station, ListedNode(1, ONE, name="finger"))
    before = station.pins.entry(ONE)
    assert before is not None
    assert before.assurance == "uuid"
    put(station, ListedNode(1, ONE, KEY, "thumb"))
    after = station.pins.entry(ONE)
    assert after is not None
    assert (after.fingerprint, after.name, after.assurance, after.added) == (KEY, "finger", "import", before.added)
    assert plan_addition(station, [ListedNode(1, ONE), ListedNode(2, ONE, KEY)]).write == ()
    station.pins.put(replace(before, assurance="bus"))
    put(station, ListedNode(1, ONE, KEY))
    after = station.pins.entry(ONE)
    assert after is not None
    assert (after.fingerprint, after.assurance) == (KEY, "bus"), "a list takes no assurance away"


def test_the_first_name_that_a_file_gives_a_node_is_its_name(tmp_path: Path) -> None:
    text = f"uuid,name\n{ONE.hex()},\n{ONE.hex()},finger\n{ONE.hex()},thumb\n"
    assert [entry.name for entry in read(tmp_path, text)] == ["finger"]


def test_the_key_that_a_node_has_proved_counts_as_pinned(station: Station) -> None:
    station.nodes.remember(ONE, point=station.point)
    with pytest.raises(KeyMismatchError):
        plan_addition(station, [ListedNode(1, ONE, KEY)])
    put(station, ListedNode(1, ONE, station.fingerprint))
    assert remove(station, ONE)
    assert not remove(station, ONE)
    put(station, ListedNode(1, ONE, KEY))  # the board was replaced


def test_removing_keeps_epoch_and_sequence(station: Station) -> None:
    station.nodes.remember(ONE, point=station.point, epoch=3, sequence=9)
    put(station, ListedNode(1, ONE))
    remove(station, ONE)
    known = station.nodes.get(ONE)
    assert known is not None
    assert (known.point, known.epoch, known.sequence) == (None, 3, 9)


def test_a_revoked_node_is_not_whitelisted_again(station: Station) -> None:
    station.policy.deny(RevocationRecord(ONE, None, "stolen", "{}"))
    with pytest.raises(PolicyError, match="stolen"):
        plan_addition(station, [ListedNode(1, ONE)])


def test_a_list_of_many_pages_is_held_against_what_is_known_on_each(station: Station) -> None:
    """Pages end at 500: the entries on the last one count as those on the first."""
    listed = [ListedNode(number, number.to_bytes(10, "big"), KEY) for number in range(1201)]
    add(station, plan_addition(station, listed[:1000]), source="test")
    plan = plan_addition(station, listed)
    assert (plan.new, plan.unchanged, len(plan.write)) == (201, 1000, 201)
    other = [*listed[:999], ListedNode(999, listed[999].uuid, OTHER), *listed[1000:]]
    with pytest.raises(KeyMismatchError, match=listed[999].uuid.hex()):
        plan_addition(station, other)


def test_an_eui_64_gets_the_uuid_of_the_written_rule_in_every_format(tmp_path: Path) -> None:
    """The NCAP of the second paper lists transducers by 8 octets (its Figure 4)."""
    for name, text in {
        "list.xml": '<whitelist><transducer uuid="0x0011223344556677" fingerprint="" /></whitelist>',
        "text.xml": "<UUIDs><UUID>00-11-22-33-44-55-66-77</UUID></UUIDs>",
        "several.xml": "<whitelist>0x0011223344556677 0x8d4d9da65281f7000000</whitelist>",
        "list.csv": "uuid,name\n00:11:22:33:44:55:66:77,arm\n",
        "list.json": '["0011223344556677"]',
    }.items():
        (tmp_path / name).write_text(text)
        found = read_whitelist(tmp_path / name)
        assert found[0].uuid.hex() == "fffe0011223344556677", name
    assert found[0].uuid != bytes.fromhex("00000011223344556677")
    for wrong in ("00112233445566", "001122334455667788"):
        (tmp_path / "wrong.csv").write_text(f"uuid\n{wrong}\n")
        with pytest.raises(BadDataError, match="20 hex digits"):
            read_whitelist(tmp_path / "wrong.csv")


SHOWN = (
    WhitelistEntry(ONE, KEY, "2026-11-28T01:02:03Z", "tap", 'a "b" <&>'),
    WhitelistEntry(TWO, None, "2026-11-28T01:02:04Z", "uuid", None),
)


@pytest.mark.parametrize(
    ("form", "text"),
    [
        (
            "xml",
            '<?xml version="1.0" encoding="UTF-8"?>\n<whitelist>\n'
            f'  <transducer uuid="0x8d4d9da65281f7000000" fingerprint="{KEY}" added="2026-11-28T01:02:03Z"'
            ' assurance="tap"'
            ' name="a &quot;b&quot; &lt;&amp;&gt;"/>\n'
            '  <transducer uuid="0x8d4d9da65281f7000001" added="2026-11-28T01:02:04Z" assurance="uuid"/>\n'
            "</whitelist>\n",
        ),
        (
            "csv",
            "uuid,fingerprint,added,assurance,name\n"
            f'8d4d9da65281f7000000,{KEY},2026-11-28T01:02:03Z,tap,"a ""b"" <&>"\n'
            "8d4d9da65281f7000001,,2026-11-28T01:02:04Z,uuid,\n",
        ),
        (
            "json",
            f"""{{
 "whitelist": [
  {{
   "uuid": "8d4d9da65281f7000000",
   "fingerprint": "{KEY}",
   "added": "2026-11-28T01:02:03Z",
   "assurance": "tap",
   "name": "a \\"b\\" <&>"
  }},
  {{
   "uuid": "8d4d9da65281f7000001",
   "fingerprint": null,
   "added": "2026-11-28T01:02:04Z",
   "assurance": "uuid",
   "name": null
  }}
 ]
}}
""",
        ),
    ],
)
def test_a_whole_whitelist_in_each_form(form: str, text: str) -> None:
    assert "".join(render(SHOWN, form)) == text


@pytest.mark.parametrize(
    ("name", "form", "expected"),
    [("a.CSV", None, "csv"), ("a.json", "xml", "xml"), ("a", None, "xml"), ("-", None, "xml"), ("a.txt", "csv", "csv")],
)
def test_the_form_to_write_follows_the_option_then_the_name(name: str, form: str | None, expected: str) -> None:
    assert form_of(Path(name), form) == expected


def test_a_name_that_tells_no_form_is_refused() -> None:
    with pytest.raises(UsageError, match=r"^Cannot tell the format from the name a\.txt\.$"):
        form_of(Path("a.txt"), None)


def test_the_form_to_read_follows_the_option_then_the_name_then_the_content(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text(f"{ONE.hex()}\n")
    assert pairs(read_whitelist(tmp_path / "a.xml", "csv")) == [(ONE, None)]
    with pytest.raises(BadDataError, match="this is not XML"):
        read_whitelist(tmp_path / "a.xml")
    with pytest.raises(BadDataError, match=r"list\.txt is empty"):
        read(tmp_path, " \n")


def test_of_two_digits_of_one_key_the_longer_one_is_kept(station: Station) -> None:
    put(station, ListedNode(1, ONE, KEY[:32]))
    assert plan_addition(station, [ListedNode(1, ONE, KEY[:32])]).unchanged == 1
    plan = plan_addition(station, [ListedNode(1, ONE, KEY), ListedNode(2, TWO)])
    assert (plan.new, plan.unchanged, [entry.fingerprint for entry in plan.write]) == (1, 0, [KEY, None])
    add(station, plan, source="list.csv")
    assert plan_addition(station, [ListedNode(1, ONE, KEY[:40])]).write == (), "the shorter one adds nothing"
    entry = station.pins.entry(ONE)
    assert entry is not None
    assert (entry.fingerprint, entry.assurance) == (KEY, "import")
    other = station.pins.entry(TWO)
    assert other is not None
    assert other.assurance == "uuid"


def test_what_an_addition_and_a_removal_leave_in_the_log(station: Station) -> None:
    add(station, plan_addition(station, [ListedNode(1, ONE, KEY), ListedNode(2, TWO)]), source="list.csv")
    add(station, plan_addition(station, [ListedNode(1, ONE, KEY)]), source="list.csv")  # nothing to add
    third = bytes(9) + b"\3"
    add(station, plan_addition(station, [ListedNode(0, third)]))
    assert remove(station, ONE)
    station.nodes.remember(bytes(9) + b"\4", point=station.point)
    assert remove(station, bytes(9) + b"\4")
    assert not remove(station, bytes(9) + b"\5")
    log = [
        (line.uuid, line.outcome, dict(line.detail)) for line in station.audit_log.entries() if line.act == "whitelist"
    ]
    assert log == [
        (None, "imported", {"file": "list.csv", "entries": 2, "new": 2}),
        (third, "added", {"fingerprint": None, "assurance": "uuid"}),
        (ONE, "removed", {}),
        (bytes(9) + b"\4", "unpinned", {}),
    ]


def test_of_many_refused_nodes_the_first_five_are_named(station: Station) -> None:
    uuids = [bytes([number]) * 10 for number in range(1, 8)]
    listed = [ListedNode(1, uuid, KEY) for uuid in uuids]
    add(station, plan_addition(station, listed), source="x")
    with pytest.raises(KeyMismatchError) as mismatch:
        plan_addition(station, [ListedNode(1, uuid, OTHER) for uuid in uuids])
    message = mismatch.value.message
    assert message.startswith(
        f"{uuids[0].hex()} is pinned to the key {KEY[:32]}, not {OTHER[:32]}; {uuids[1].hex()} is"
    )
    assert message.endswith(f"{uuids[4].hex()} is pinned to the key {KEY[:32]}, not {OTHER[:32]} and 2 more.")
    assert mismatch.value.hint.endswith(f"teds-provision whitelist remove {uuids[0].hex()}")
    for uuid in uuids[:5]:
        station.policy.deny(RevocationRecord(uuid, None, "lost", "{}"))
    with pytest.raises(PolicyError) as refused:
        plan_addition(station, listed)
    shown = ", ".join(f"{uuid.hex()} (lost)" for uuid in uuids[:5])
    assert refused.value.message == f"Revoked nodes cannot be whitelisted: {shown}."
    for uuid in uuids[5:]:
        station.policy.deny(RevocationRecord(uuid, None, "lost", "{}"))
    with pytest.raises(PolicyError) as refused:
        plan_addition(station, listed)
    assert refused.value.message == f"Revoked nodes cannot be whitelisted: {shown} and 2 more."
    assert refused.value.hint == "Nothing was added."


@pytest.mark.parametrize(("name", "good"), [("a" * 200, True), ("a" * 201, False), ("a\tb", False), ("", True)])
def test_a_name_of_a_list_is_printable_and_has_at_most_200_letters(tmp_path: Path, name: str, good: bool) -> None:
    text = json.dumps([{"uuid": ONE.hex(), "name": name}])
    if good:
        assert [entry.name for entry in read(tmp_path, text)] == [name or None]
        require_name(name)
        return
    with pytest.raises(BadDataError, match=r":1: name: a name is printable and has at most 200 characters\.$"):
        read(tmp_path, text)
    with pytest.raises(BadDataError, match=r"^A name is printable and has at most 200 characters\.$"):
        require_name(name)


def test_a_node_without_a_name_of_its_own_in_the_list_is_shown_by_its_datasheet(station: Station) -> None:
    station.nodes.remember(ONE, name="own")
    station.nodes.remember(TWO, name="own 2")
    listed = (WhitelistEntry(ONE), WhitelistEntry(TWO, name="listed"), WhitelistEntry(bytes(10)))
    assert [entry.name for entry in named(station, listed)] == ["own", "listed", None]


def test_a_whitelist_has_a_quarter_of_a_million_entries_and_no_more() -> None:
    reader = _WhitelistReader("list.csv", count=249_999)
    reader.add(1, {"uuid": "8d4d9da65281f7000000"})
    assert (reader.mistakes, len(reader.entries)) == ([], 1)
    with pytest.raises(BadDataError, match=r"list\.csv:2: there are more than 250000 entries"):
        reader.add(2, {"uuid": "8d4d9da65281f7000001"})


@pytest.mark.parametrize(
    ("text", "entries"),
    [
        # an element of our name whose text is the UUID, with the key as its attribute
        (f'<whitelist><uuid fingerprint="{KEY}">{ONE.hex()}</uuid></whitelist>', [(ONE, KEY, None)]),
        # the document is one entry
        (f"<tim><uuid>{ONE.hex()}</uuid><fingerprint>{KEY}</fingerprint></tim>", [(ONE, KEY, None)]),
        (f'<tim fingerprint="{KEY}" name="a">{ONE.hex()}</tim>', [(ONE, KEY, "a")]),
        # names with a prefix, below one another
        (f"<w:a xmlns:w='u'><w:b><w:UUID>{ONE.hex()}</w:UUID><w:name>a</w:name></w:b></w:a>", [(ONE, None, "a")]),
        # a name that several have is the list's own
        (f'<list name="crane"><uuid>{ONE.hex()}</uuid><uuid>{TWO.hex()}</uuid></list>',
         [(ONE, None, None), (TWO, None, None)]),
        (f"\n \n<uuids>{ONE.hex()}; {TWO.hex()}</uuids>", [(ONE, None, None), (TWO, None, None)]),
        (f'\n  ["{ONE.hex()}"]', [(ONE, None, None)]),
        (f'\n  {{"whitelist": ["{ONE.hex()}"]}}', [(ONE, None, None)]),
        # what another program lists beside ours
        (json.dumps([{"uuid": ONE.hex(), "epoch": 3, "name": None, "keys": []}]), [(ONE, None, None)]),
        (json.dumps([{"ID": ONE.hex(), "name": "a"}]), [(ONE, None, "a")]),
        # a remark says nothing of how the lines are separated, and empty cells at the end say nothing
        (f"# one; two; three; four\nuuid,name\n{ONE.hex()},a;b\n", [(ONE, None, "a;b")]),
        (f"{ONE.hex()},{KEY},a,,\n{TWO.hex()},,,,\n", [(ONE, KEY, "a"), (TWO, None, None)]),
        (f"uuid\tname\n{ONE.hex()}\ta, b\n", [(ONE, None, "a, b")]),
    ],
)  # fmt: skip
def test_lists_of_other_programs_are_read_for_what_they_mean(
    tmp_path: Path, text: str, entries: list[tuple[bytes, str | None, str | None]]
) -> None:
    assert [(entry.uuid, entry.fingerprint, entry.name) for entry in read(tmp_path, text)] == entries


def test_of_one_node_listed_twice_the_longer_of_its_digits_and_the_name_count(tmp_path: Path) -> None:
    for lines in ((f"{KEY[:32]},", f"{KEY},a"), (f"{KEY},a", f"{KEY[:40]},b"), (",", f"{KEY},a")):
        found = read(tmp_path, "".join(f"{ONE.hex()},{line}\n" for line in lines))
        assert [(entry.line, entry.fingerprint, entry.name) for entry in found] == [(1, KEY, "a")]


def test_a_new_entry_keeps_the_name_that_a_list_gives_it_and_a_known_one_does_not_take_the_nodes_own(
    station: Station,
) -> None:
    """Exports show the node's own name where an entry has none; imported again, that changes nothing."""
    station.nodes.remember(ONE, name="own")
    (new,) = plan_addition(station, [ListedNode(1, ONE, name="own")]).write
    assert new.name == "own"
    put(station, ListedNode(1, ONE))
    assert plan_addition(station, [ListedNode(1, ONE, name="own")]).write == ()
    assert plan_addition(station, [ListedNode(1, ONE, name="own")], rename=True).write == ()
    (named_now,) = plan_addition(station, [ListedNode(1, ONE, name="other")]).write
    assert named_now.name == "other"
    add(station, plan_addition(station, [ListedNode(1, ONE, name="other")]), source="x")
    assert plan_addition(station, [ListedNode(1, ONE, name="third")]).write == ()
    (renamed,) = plan_addition(station, [ListedNode(1, ONE, name="third")], rename=True).write
    assert renamed.name == "third"


def test_a_name_that_xml_cannot_hold_is_still_written_and_read_back() -> None:
    text = "".join(render([WhitelistEntry(ONE, None, "2026-11-28T01:02:03Z", "uuid", "a\x01b\nc")], "xml"))
    assert 'name="a\ufffdb\ufffdc"/>' in text


def test_elements_are_nested_sixteen_deep_and_no_deeper(tmp_path: Path) -> None:
    for deep in (15, 16):
        text = f"{'<a>' * deep}\n<uuid>{ONE.hex()}</uuid>{'</a>' * deep}"
        if deep == 15:
            assert pairs(read(tmp_path, text)) == [(ONE, None)]
        else:
            with pytest.raises(BadDataError, match=r"list\.txt:2: elements are nested too deeply\.$"):
                read(tmp_path, text)
