"""One row of reading for each node, and one verdict judged from it wherever it is shown (cli.md, "One verdict").

What would have found the faults: a kept copy beside octets that nobody read (a changed calibration stayed "authentic"
in ncap), a Security TEDS alone taken for a whole datasheet, a stranger's plain answer beside a reading in a session.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import (
    BadDataError,
    BadDatasheetError,
    KeyMismatchError,
    NotAuthenticError,
    NotFoundError,
    StoreChangedError,
)
from teds_provision.measure import background_reread
from teds_provision.measure.background_reread import BackgroundReread
from teds_provision.measure.verified_session import open_trusted
from teds_provision.protocol.keys import SoftwareKey, fingerprint, node_key_message, station_key_message
from teds_provision.provisioning import identify as identify_module
from teds_provision.provisioning import readings
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.inventory import inventory
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.sign import known_node_keys
from teds_provision.provisioning.teds_read import read_identity, read_image
from teds_provision.provisioning.verify import (
    Signers,
    _certifier,
    freshness_floor_of,
    possession_check,
    snapshot_trust,
    snapshot_trust_of,
)
from teds_provision.provisioning.verify_node import NodeVerification, judge_and_keep, verify_at_node, verify_in_session
from teds_provision.provisioning.write import write
from teds_provision.shapes.verdict import Check
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeReading, RevocationRecord, TrustRecord, utc_now
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.frame import frame, unframe
from teds_provision.teds.image import SECURITY, Image
from tests.bench import Board, MemoryLink, make_station, talk
from tests.handover.desk import Pair, provisioned

NAME = (0, AccessCode.NAME)


@pytest.fixture
def board(station: Station) -> Board:
    made = Board()
    provisioned(station, made)
    return made


def over_the_bus(board: Board) -> MemoryLink:
    return MemoryLink(board, via="can", tapped=False)


def changed_in_flash(board: Board, block: tuple[int, int] = NAME, *, restart: bool = True) -> None:
    """One octet of a TEDS, its checksum mended: what a debugger does, or a flash cell."""
    body = bytearray(unframe(board.state.blocks[block]))
    body[-1] ^= 1
    board.flash.commit(replace(board.state, blocks={**board.state.blocks, block: frame(bytes(body))}))
    if restart:
        board.power_on()


def looked(station: Station, board: Board) -> NodeVerification:
    """Return what a measurement does before it claims anything."""
    with talk(board, over_the_bus(board)) as node:
        require_session(station, node)
        return verify_in_session(station, node, by="measure")


def test_a_node_that_is_read_in_a_session_is_in_service_again(station: Station, board: Board) -> None:
    """A key that a backup brought back: it was retired here, and answers all the same."""
    with station.durable("test"):
        station.nodes.remember(board.uuid, retired="replaced by another")
    assert verified(station, board) == "authentic"
    station.flush()
    known = station.nodes.get(board.uuid)
    assert known is not None
    assert known.retired is None


def test_what_a_board_says_plainly_does_not_replace_what_its_datasheet_said(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(identify_module, "describe", lambda node: SimpleNamespace(channels=9, name="impostor"))
    stranger = Board(bytes([7]) * 10)
    before = station.nodes.get(board.uuid)
    assert before is not None
    for one, channels, name in ((board, before.channels, before.name), (stranger, 9, "impostor")):
        with talk(one) as node:
            identify_module._identified(station, node, add=False, dry_run=False)
        known = station.nodes.get(one.uuid)
        assert known is not None
        assert (known.channels, known.name) == (channels, name)


def verified(station: Station, board: Board) -> str:
    with talk(board) as node:
        return verify_at_node(station, node, identify(station, node)).verified.verdict


def shown(station: Station, board: Board) -> tuple[str | None, str | None]:
    """Return the verdict as every screen has it: of the one node, and of it in a list."""
    judged = readings.verdict_of(station, board.uuid)
    (listed,) = inventory(station, [board.uuid])
    word = None if judged is None else judged.verified.verdict
    assert listed.verdict == word
    assert listed.reading == (judged and {"from": judged.origin, "at": judged.at, "by": judged.by})
    return word, judged and judged.origin


# -- what stands in the row ------------------------------------------------------------------------------------------


def test_the_row_names_the_digest_of_each_teds_the_command_and_the_session(station: Station, board: Board) -> None:
    row = station.datasheets.reading(board.uuid)
    assert row is not None
    assert (row.by, row.whole, row.in_session) == ("provision", True, True)
    image = station.datasheets.datasheet(board.uuid)
    assert image is not None
    assert set(readings.digests_of(row)) == set(image.blocks)
    assert shown(station, board) == ("authentic", "session")


def test_a_security_teds_alone_is_no_datasheet(station: Station) -> None:
    board = Board()
    with talk(board) as node:
        identify(station, node)
    assert station.datasheets.datasheet(board.uuid) is None
    assert shown(station, board) == (None, None)
    assert known_node_keys(station, board.uuid).key == board.key.point, "who builds knows its key all the same"


@pytest.mark.parametrize("mode", ["copy", "move"])
def test_a_station_that_imported_the_key_measures_at_once(tmp_path: Path, mode: str) -> None:
    """Identify had kept the Security TEDS alone, and the measurement took it for the whole: "TEDS 1 … is absent"."""
    pair = Pair.make(tmp_path)
    provisioned(pair.north, pair.board)
    path, _ = pair.export(mode)
    pair.take(path)
    with talk(pair.board, over_the_bus(pair.board)) as node:
        identify(pair.south, node)
    found = looked(pair.south, pair.board)
    assert (found.verified.verdict, found.judged.origin) == ("authentic", "session")
    assert shown(pair.south, pair.board) == ("authentic", "session")


def test_a_kept_image_that_lacks_a_teds_of_field_108_is_none(station: Station, board: Board) -> None:
    image = station.datasheets.datasheet(board.uuid)
    assert image is not None
    station.datasheets.put(replace(image, blocks={NAME: image.blocks[NAME], SECURITY: image.blocks[SECURITY]}))
    assert station.datasheets.datasheet(board.uuid) is None
    assert looked(station, board).verified.verdict == "authentic"
    assert station.datasheets.datasheet(board.uuid) == image


# -- kept, and read again --------------------------------------------------------------------------------------------


def test_a_kept_image_replaces_no_row_but_the_one_that_was_read_of_it_in_a_session(
    station: Station, board: Board
) -> None:
    row = station.datasheets.reading(board.uuid)
    assert row is not None
    other = row.digests[:-1] + bytes([row.digests[-1] ^ 1])
    for changed in (replace(row, digests=other), replace(row, c=None)):
        station.datasheets.forget_reading(board.uuid)
        assert station.datasheets._put_reading(changed)
        found = looked(station, board)
        assert not found.kept, "all of it was read"
        again = station.datasheets.reading(board.uuid)
        assert again is not None
        assert again.digests == row.digests, "it was read"
        assert (found.verified.verdict, found.judged.origin) == ("authentic", "session")
        assert shown(station, board) == ("authentic", "session")


def test_in_the_same_power_up_nothing_is_read_again(station: Station, board: Board) -> None:
    link = over_the_bus(board)
    with talk(board, link) as node:
        require_session(station, node)
        verify_in_session(station, node, by="measure")
    assert link.count <= 6, "c, Open, Identify, one TEDS, Close"
    assert shown(station, board) == ("authentic", "session")


def test_after_a_restart_the_rest_is_kept_until_it_is_read(station: Station, board: Board) -> None:
    board.power_on()
    found = looked(station, board)
    assert (found.verified.verdict, found.kept) == ("authentic", True)
    kept = {check.name for check in found.verified.checks if check.to_json().get("from") == "kept"}
    assert kept == {"form", "signed TEDS", "every TEDS is signed", "UUID"}
    assert shown(station, board) == ("authentic", "kept")
    assert looked(station, board).kept, "another session of that power-up has not read it either"
    assert verified(station, board) == "authentic"
    assert shown(station, board) == ("authentic", "session")


def test_a_write_that_finds_everything_there_has_read_the_rest(station: Station, board: Board) -> None:
    board.power_on()
    assert looked(station, board).kept
    image = station.datasheets.datasheet(board.uuid)
    assert image is not None
    with talk(board, over_the_bus(board)) as node:
        require_session(station, node)
        assert write(station, node, image).octets == 0
    assert shown(station, board) == ("authentic", "session")


def test_verify_reads_all_and_every_screen_says_what_it_found(station: Station, board: Board) -> None:
    """The kept copy had stood in: verify said not authentic, ncap, API and page "Authentic, 15 of 15"."""
    changed_in_flash(board)
    assert looked(station, board).kept
    assert verified(station, board) == "not authentic"
    assert shown(station, board) == ("not authentic", "session")
    for _ in range(2):  # in this power-up, and after another restart: what spoke against it is not forgotten
        assert looked(station, board).verified.verdict == "not authentic"
        with talk(board, over_the_bus(board)) as node, pytest.raises(NotAuthenticError):
            open_trusted(station, node, by="sample")
        board.power_on()


def test_a_node_that_was_mended_is_authentic_again(station: Station, board: Board) -> None:
    changed_in_flash(board)
    assert verified(station, board) == "not authentic"
    provisioned(station, board)
    assert shown(station, board) == ("authentic", "session")
    assert not looked(station, board).kept


def test_another_security_teds_makes_everything_be_read(station: Station, board: Board) -> None:
    with talk(board) as node:
        from teds_provision.provisioning.progress import SilentReporter
        from teds_provision.provisioning.provision import provision

        provision(station, node, BuildOrder(name="other"), operator=AcceptingOperator(), reporter=SilentReporter())
    assert shown(station, board) == ("authentic", "session")
    image = station.datasheets.datasheet(board.uuid)
    assert image is not None
    assert {(0, code) for _, code in image} >= {NAME}


@given(first=st.integers(0, 2**64 - 1), opens=st.integers(0, 2**64 - 1))
def test_c_shows_a_restart(first: int, opens: int) -> None:
    row = NodeReading(bytes(10), utc_now(), "verify", first.to_bytes(8, "big"), True, b"")
    later = ((first + opens) % 2**64).to_bytes(8, "big")
    assert row.is_of_this_start(later) == (opens < 2**32)


# -- who may change it -----------------------------------------------------------------------------------------------


def test_what_is_received_outside_a_session_changes_no_row(station: Station, board: Board) -> None:
    """A stranger on the bus answers for the node: the row that was read in a session stays, and so does the verdict."""
    before = station.datasheets.reading(board.uuid)
    changed_in_flash(board)
    with talk(board) as node:
        who = identify(station, node)
        plain = judge_and_keep(station, node, read_image(node), who.point, why="the node does not open a session")
    assert plain.verified.verdict == "unproven"
    assert plain.origin == "plain"
    assert station.datasheets.reading(board.uuid) == before
    assert shown(station, board) == ("authentic", "session")


def test_only_a_datasheet_that_was_read_in_a_session_is_kept(station: Station, board: Board, tmp_path: Path) -> None:
    """Whatever its checks gave: what anybody on the bus may have sent is shown beside, as its row."""
    image = station.datasheets.datasheet(board.uuid)
    assert image is not None
    row, judged = readings.judge_reading(station, image, bytes(8), by="verify", floor=None)
    assert judged.verified.verdict != "not authentic"
    other = make_station(tmp_path / "other", "other")
    with other.durable("test"):
        readings.keep_judged(other, replace(row, c=None), judged, image)
    assert other.datasheets.datasheet(board.uuid) is None
    with other.durable("test"):
        readings.keep_judged(other, row, judged, image)
    assert other.datasheets.datasheet(board.uuid) == image
    other.close()


def test_a_reading_in_no_session_is_replaced_by_any(station: Station) -> None:
    row = NodeReading(bytes(10), "2026-01-01T00:00:00Z", "verify", None, True, b"")
    assert station.datasheets.keep_reading(row)
    assert station.datasheets.keep_reading(replace(row, by="other"))
    assert station.datasheets.keep_reading(replace(row, by="measure", c=bytes(8)))
    assert not station.datasheets.keep_reading(replace(row, by="late"))
    assert station.datasheets.reading(bytes(10)) == replace(row, by="measure", c=bytes(8))


def test_a_row_that_no_reading_of_ours_made_is_never_authentic(station: Station) -> None:
    station.datasheets.keep_reading(NodeReading(bytes(10), utc_now(), "x", bytes(8), True, b""))
    judged = readings.verdict_of(station, bytes(10))
    assert judged is not None
    assert judged.verified.verdict == "unsigned"


def test_a_ban_of_today_is_in_the_verdict_of_a_reading_of_yesterday(station: Station, board: Board) -> None:
    station.policy.deny(RevocationRecord(board.uuid, None, "stolen", "{}"))
    assert shown(station, board) == ("not authentic", "session")
    judged = readings.verdict_of(station, board.uuid)
    assert judged is not None
    assert [check.name for check in judged.verified.checks if check.result == "failed"] == ["not revoked"]
    station.policy.lift(board.uuid)
    assert shown(station, board) == ("authentic", "session")


def test_trust_that_ends_is_in_the_verdict_of_what_was_read_before(tmp_path: Path) -> None:
    pair = Pair.make(tmp_path)
    provisioned(pair.north, pair.board)
    path, _ = pair.export("copy")
    pair.take(path)
    assert looked(pair.south, pair.board).verified.verdict == "authentic"
    pair.south.policy.distrust("north")
    pair.south.policy.end_ca(pair.north.ca)
    assert shown(pair.south, pair.board) == ("not authentic", "session")


def test_a_reset_forgets_the_reading(station: Station, board: Board) -> None:
    from teds_provision.provisioning.agree import reset_node

    with talk(board) as node:
        reset_node(station, node, identify(station, node))
    assert shown(station, board) == (None, None)


def test_a_board_that_was_replaced_under_its_uuid_has_no_reading(station: Station, board: Board) -> None:
    station.pins.unpin(board.uuid)
    assert station.datasheets.reading(board.uuid) is None


# -- in the background of a measurement ----------------------------------------------------------------------


def read_behind(station: Station, board: Board) -> list[str]:
    """The rest of a node read as the keeper does; the outcomes of its steps, the last one an error where it raised."""
    bus = SimpleNamespace(reading=threading.Lock(), beginning=set())
    with talk(board, over_the_bus(board)) as node:
        trusted = open_trusted(station, node, by="ncap")
        rest = BackgroundReread(station, trusted, bus, by="ncap")  # type: ignore[arg-type]
        rest._due = 0.0
        steps = 0
        while rest.step():
            steps += 1
            assert bus.reading.locked(), "one node of a bus at a time"
            rest._due = 0.0
        assert not bus.reading.locked()
        return ["step"] * steps


def test_the_rest_is_read_behind_the_measurement(station: Station, board: Board) -> None:
    board.power_on()
    assert looked(station, board).kept
    assert len(read_behind(station, board)) >= len(board.state.blocks)
    assert shown(station, board) == ("authentic", "session")
    row = station.datasheets.reading(board.uuid)
    assert row is not None
    assert row.by == "ncap"


def test_a_change_that_is_found_behind_a_measurement_ends_it(station: Station, board: Board) -> None:
    changed_in_flash(board)
    with pytest.raises(BadDatasheetError, match=r"since .* do not count"):
        read_behind(station, board)
    assert shown(station, board) == ("not authentic", "session")


def test_a_bus_that_another_node_is_read_on_is_waited_for(station: Station, board: Board) -> None:
    board.power_on()
    bus = SimpleNamespace(reading=threading.Lock(), beginning=set())
    link = over_the_bus(board)
    with talk(board, link) as node, bus.reading:
        rest = BackgroundReread(station, open_trusted(station, node, by="ncap"), bus, by="ncap")  # type: ignore[arg-type]
        rest._due, asked = 0.0, link.count
        assert rest.step()
        assert link.count == asked


def test_nodes_that_begin_go_first_but_not_for_ever(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two hundred switched on together, the first ones were read whole while the last ones waited for the bus."""
    now = time.monotonic()
    monkeypatch.setattr("teds_provision.measure.background_reread.time.monotonic", lambda: now)
    board.power_on()
    bus = SimpleNamespace(reading=threading.Lock(), beginning={bytes(10)})
    link = over_the_bus(board)
    with talk(board, link) as node:
        rest = BackgroundReread(station, open_trusted(station, node, by="ncap"), bus, by="ncap")  # type: ignore[arg-type]
        asked = link.count
        now += background_reread.PATIENCE
        assert rest.step()
        assert link.count == asked
        bus.beginning.clear()
        assert rest.step()
        assert link.count == asked + 1
        bus.beginning.add(bytes(10))
        now += background_reread.FIRST + 1.0
        assert rest.step()
        assert link.count == asked + 2, "one that begins again and again is not waited for"


def test_a_node_without_its_key_is_not_authentic_by_any_row(station: Station, board: Board) -> None:
    """A failed challenge is part of what was read: it stays in the row."""
    with talk(board) as node:
        require_session(station, node)
        failed = possession_check(lambda: (_ for _ in ()).throw(NotAuthenticError("It does not hold the key.")))  # type: ignore[arg-type, return-value]
        readings.keep(station, node, read_image(node), by="verify", floor=None, more=[failed])
    assert shown(station, board) == ("not authentic", "session")


def test_a_pin_that_another_program_changed_costs_that_node_alone_its_verdict(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = Board(uuid=bytes(range(10)))
    provisioned(station, other)
    judge, judged = readings._judged, list[bool]()

    def changed(*_: Any) -> Any:
        raise StoreChangedError("A pin was changed by another program.")

    def judged_or_changed(trust: Any, row: NodeReading, *, keyed: bool) -> Any:
        if row.uuid == other.uuid:
            changed()
        judged.append(keyed)
        return judge(trust, row, keyed=keyed)

    before = readings.verdicts_of(station, [board.uuid, other.uuid], [board.uuid])
    monkeypatch.setattr(readings, "snapshot_trust_of", changed)
    monkeypatch.setattr(readings, "_judged", judged_or_changed)
    found = readings.verdicts_of(station, [board.uuid, other.uuid], [board.uuid])
    assert (found[board.uuid], judged) == (before[board.uuid], [True])
    verdict, row = found[other.uuid], station.datasheets.reading(other.uuid)
    assert row is not None
    assert verdict.verified.checks == (Check("node key", "failed", "A pin was changed by another program."),)
    assert (verdict.verified.verdict, verdict.at, verdict.by) == ("not authentic", row.at, row.by)
    assert readings.verdicts_of(station, [bytes(10)], []) == {}


def test_a_snapshot_of_pins_refuses_another_key_as_the_station_does(station: Station, board: Board) -> None:
    pins = snapshot_trust(station).pins
    pins.check(board.uuid, board.key.point)
    pins.check(bytes(10), board.key.point)
    with pytest.raises(KeyMismatchError) as refused:
        pins.check(board.uuid, SoftwareKey(7).point)
    with pytest.raises(KeyMismatchError) as by_station:
        station.pins.check(board.uuid, SoftwareKey(7).point)
    assert (refused.value.message, refused.value.hint) == (by_station.value.message, by_station.value.hint)


@pytest.mark.parametrize("what", ["no datasheet", "no Security TEDS", "damaged", "unsigned", "by a stranger", "signed"])
def test_only_what_this_station_trusts_is_a_bound_for_sequence_and_epoch(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    image, identity = station.datasheets.datasheet(board.uuid), cast(Any, object())
    assert image is not None
    unsigned = Board(uuid=board.uuid, key=board.key).state.blocks
    stored = {
        "no datasheet": None,
        "no Security TEDS": Image(board.uuid, image.unsigned_blocks()),
        "damaged": Image(board.uuid, {**image.blocks, SECURITY: frame(b"\xff\xff")}),
        "unsigned": Image(board.uuid, dict(unsigned)),
    }.get(what, image)
    if what == "by a stranger":
        monkeypatch.setattr(type(station.policy), "trusted_cas", lambda *_: [SoftwareKey(7).point])
        monkeypatch.setattr(type(station.policy), "trusted_stations", lambda *_: [])
    monkeypatch.setattr(type(station.datasheets), "datasheet", lambda *_: stored)
    found = freshness_floor_of(station, board.uuid, identity)
    bound = (1, 1) if what == "signed" else (0, 0)
    assert (found.identity, (found.sequence, found.key_epoch)) == (identity, bound)


def test_a_reading_whose_key_another_node_signed_is_no_key_of_this_one(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = station.datasheets.reading(board.uuid)
    assert row is not None
    assert row.node_key_signature is not None
    monkeypatch.setattr(type(station.datasheets), "datasheet", lambda *_: None)
    assert known_node_keys(station, board.uuid).key == board.key.point
    other = node_key_message(bytes(10), board.key.point)
    for key, signature, error in (
        (board.key.point, board.key.sign(other), BadDataError),
        (None, row.node_key_signature, NotFoundError),
        (board.key.point, None, NotFoundError),
    ):
        forged = replace(row, node_key=key, node_key_signature=signature)
        monkeypatch.setattr(type(station.datasheets), "reading", lambda *_, forged=forged: forged)
        with pytest.raises(error) as refused:
            known_node_keys(station, board.uuid)
        assert board.uuid.hex() in str(refused.value)


def test_a_datasheet_that_was_read_before_stands_for_one_of_the_same_signature_while_nothing_newer_was_seen(
    station: Station, board: Board
) -> None:
    image = station.datasheets.datasheet(board.uuid)
    assert image is not None
    assert image.security is not None
    with talk(board) as node:
        require_session(station, node)
        floor = freshness_floor_of(station, board.uuid, read_identity(node))
        for security, bound, found in (
            (image.security, floor, image),
            (image.security, replace(floor, sequence=9), None),
            (image.security, replace(floor, key_epoch=9), None),
            (image.security + b"x", floor, None),
        ):
            assert readings.cached_image_if_current(station, node, security, bound) == found


@pytest.mark.parametrize(
    ("keyed", "result", "why"),
    [
        (True, "failed", "its datasheet was last read outside a session"),
        (False, "skipped", "this station holds no key of this node"),
    ],
)
def test_a_session_is_missed_only_of_a_node_whose_key_is_held(
    station: Station, board: Board, keyed: bool, result: str, why: str
) -> None:
    row = station.datasheets.reading(board.uuid)
    assert row is not None
    with talk(board) as node:
        identify(station, node)
    assert station.datasheets.reading(board.uuid) == row, "a plain look replaces no reading whose key is known"
    found = readings._judged(station, replace(row, c=None), keyed=keyed)
    (check,) = [check for check in found.verified.checks if check.name == "session"]
    assert (check.result, check.why) == (result, why)


def test_a_snapshot_of_some_nodes_has_the_trust_of_the_store(station: Station, board: Board) -> None:
    north, kept, ban = SoftwareKey(211).point, SoftwareKey(212).point, bytes(9) + b"\1"
    station.policy.trust(TrustRecord("north", "station", north, fingerprint(north)))
    station.keys.set_ca_of(board.uuid, kept)
    station.policy.deny(RevocationRecord(ban, None, "lost", "s"))
    for snapshot in (snapshot_trust(station), snapshot_trust_of(station, [board.uuid, ban])):
        assert north in snapshot.policy.trusted_stations()
        assert snapshot.policy.trusted_stations() == station.policy.trusted_stations()
        for uuid in (None, board.uuid, ban):
            assert snapshot.policy.trusted_cas(uuid) == station.policy.trusted_cas(uuid)
        assert kept in snapshot.policy.trusted_cas(board.uuid)
        assert snapshot.policy.revocation(ban) == station.policy.revocation(ban)
        assert snapshot.policy.revocation(board.uuid) is None
        assert snapshot.pins.by_uuid[board.uuid] == station.pins.pinned(board.uuid)


def test_a_ca_that_one_node_keeps_certifies_for_this_node_alone(station: Station, board: Board) -> None:
    kept, signer = SoftwareKey(213), SoftwareKey(214).point
    station.keys.set_ca_of(board.uuid, kept.point)
    signers = Signers(station_key=signer, station_key_signature=kept.sign(station_key_message(signer)))
    found = [_certifier(station, uuid, signers) for uuid in (board.uuid, bytes(9) + b"\1")]
    assert found == [kept.point, None]


def test_a_channel_of_a_reading_has_two_octets() -> None:
    digests = b"".join(
        channel.to_bytes(2, "big") + bytes([code, *[code] * 32]) for channel, code in ((0, 1), (1, 3), (258, 5))
    )
    row = NodeReading(bytes(10), utc_now(), "read", None, whole=True, digests=digests)
    assert readings.digests_of(row) == {(0, 1): b"\1" * 32, (1, 3): b"\3" * 32, (258, 5): b"\5" * 32}
    assert readings.digests_of(replace(row, digests=b"")) == {}
