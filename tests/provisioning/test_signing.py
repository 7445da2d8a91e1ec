"""When a datasheet is signed again, under which number, and what a signature leaves in the store."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision import teds
from teds_provision.errors import BadDataError, FrozenError, NotFoundError, PolicyError, TedsProvisionError, UsageError
from teds_provision.links import LinkSettings
from teds_provision.protocol.datasheet import SignedNodeKey
from teds_provision.provisioning import sign as signing
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.sign import (
    SignOrder,
    known_node_keys,
    node_keys_of,
    require_not_measured,
    sign,
    sign_image,
    unsigned_security,
)
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft
from teds_provision.teds.codec import security
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.image import SECURITY, Image
from tests.bench import Board, make_station

from .test_provision import run


@pytest.fixture
def image(station: Station, board: Board) -> Image:
    return run(station, board).image


@pytest.fixture
def keys(station: Station, image: Image) -> SignedNodeKey:
    return known_node_keys(station, image.uuid, image)


def renamed(image: Image, name: str = "other") -> Image:
    return image.with_block((0, 12), teds.compose(12, {"Format": 0, "TCName": name}))


def security_of(image: Image) -> bytes:
    octets = image.security
    assert octets is not None
    return octets


def test_what_is_signed_already_is_not_signed_again(station: Station, image: Image, keys: SignedNodeKey) -> None:
    def again(made: Image = image, *, epoch: int = 1, node: int = 1, **more: object) -> tuple[int, bool]:
        done = sign(station, keys, made, epoch=epoch, node_sequence=node, **more)  # type: ignore[arg-type]
        return done.sequence, done.reused

    octets = security_of(image)
    assert again(on_node=octets) == (1, True), "the very one that the node has"
    assert again(earlier=[octets], node=0) == (1, True), "one that never arrived, above the node's"
    assert again(on_node=b"no TEDS", earlier=[octets], node=0) == (1, True)
    before = station.nodes.get(image.uuid)
    assert before is not None
    assert before.sequence == 1
    assert again(earlier=[octets]) == (2, False), "the node would refuse it"
    assert again(on_node=octets, epoch=2) == (3, False)
    assert again(renamed(image), on_node=octets) == (4, False)
    assert again(on_node=octets, sequence=9) == (9, False), "a number that was asked for"
    assert again(on_node=security_of(image)[:-3] + b"\0\0\0") == (10, False)
    assert again(node=70_000) == (70_001, False), "the node may have one by another station"
    known = station.nodes.get(image.uuid)
    assert known is not None
    assert known.sequence == 70_001


def test_another_signer_signs_again(station: Station, image: Image, keys: SignedNodeKey) -> None:
    shown = security.decode(security_of(image))
    for change in (
        {"station_key": station.ca},
        {"ca": "other"},
        {"node_key_signature": bytes(64)},
        {"signature": bytes(64)},
        {"signature": None},
    ):
        octets = replace(shown, **change).encode()  # type: ignore[arg-type]
        assert not sign(station, keys, image, epoch=1, node_sequence=1, on_node=octets).reused, change


def test_under_another_name_of_the_station_a_datasheet_is_signed_again(
    station: Station, image: Image, keys: SignedNodeKey, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(station), "name", property(lambda _station: "renamed"))
    assert not sign(station, keys, image, epoch=1, node_sequence=1, on_node=security_of(image)).reused


def test_a_signature_holds_what_it_was_made_for_and_is_in_the_log(
    station: Station, image: Image, keys: SignedNodeKey
) -> None:
    done = sign(
        station, keys, renamed(image), epoch=3, node_sequence=7, keep_draft=True, profile="gripper", unit=("J1", 4)
    )
    shown = security.decode(security_of(done.image))
    assert (shown.sequence, shown.key_epoch, shown.station_key) == (8, 3, station.point)
    assert (shown.node_key, shown.node_key_signature) == (keys.key, keys.signature)
    assert set(shown.signed_blocks) == set(image.unsigned_blocks())
    assert done.signature == shown.signature
    draft = station.datasheets.draft(image.uuid)
    assert draft is not None
    assert (draft.stage, draft.profile, draft.image) == ("signed", "gripper", done.image)
    line = [entry for entry in station.audit_log.entries() if entry.act == "sign"][-1]
    assert (line.uuid, line.outcome) == (image.uuid, "done")
    assert line.detail == {"sequence": 8, "epoch": 3, "teds": renamed(image).digest()}


def test_what_stops_a_signature_leaves_the_number_free(station: Station, image: Image, keys: SignedNodeKey) -> None:
    def stop() -> None:
        raise FrozenError("it is being measured")

    with pytest.raises(FrozenError):
        sign(station, keys, renamed(image), epoch=1, node_sequence=1, before=stop)
    assert sign(station, keys, image, epoch=1, node_sequence=1, on_node=security_of(image), before=stop).reused
    with pytest.raises(PolicyError, match="no sequence numbers left"):
        sign(station, keys, renamed(image), epoch=1, node_sequence=0xFFFFFFFF)
    known = station.nodes.get(image.uuid)
    assert known is not None
    assert known.sequence == 1
    assert sign(station, keys, renamed(image), epoch=1, node_sequence=0xFFFFFFFE).sequence == 0xFFFFFFFF
    damaged = image.with_block((0, 12), image.blocks[0, 12][:-1] + b"\0")
    with pytest.raises(BadDataError, match=r"^TEDS 12 of channel 0 is damaged: Length, checksum or class is wrong\.$"):
        sign(station, keys, damaged, epoch=1, node_sequence=1)
    misplaced = image.with_block((0, 3), frame(bytes.fromhex("0304000c0101")))
    with pytest.raises(BadDataError, match="TEDS 3 of channel 0 is damaged"):
        sign(station, keys, misplaced, epoch=1, node_sequence=1)


def test_whose_keys_are_signed(station: Station, image: Image, board: Board) -> None:
    assert node_keys_of(image.uuid, security_of(image)).key == board.key.point
    other = bytes(9) + b"\1"
    with pytest.raises(
        BadDataError, match=rf"^The Security TEDS of {other.hex()} belongs to another node \(field 102\)"
    ):
        node_keys_of(other, security_of(image))
    with pytest.raises(NotFoundError, match=f"The key of node {other.hex()} is not known yet"):
        known_node_keys(station, other)
    bare = Image(image.uuid, image.unsigned_blocks())
    assert known_node_keys(station, image.uuid, bare).key == board.key.point, "of the last reading"


def test_a_security_teds_before_its_signature_has_the_present_numbers(
    station: Station, image: Image, keys: SignedNodeKey
) -> None:
    station.nodes.remember(image.uuid, sequence=12, epoch=5)
    shown = security.decode(unsigned_security(station, keys, image))
    assert (shown.signed, shown.sequence, shown.key_epoch) == (False, 12, 5)
    assert shown.station_key == station.point
    unknown = SignedNodeKey(bytes(9) + b"\1", keys.key, keys.signature)
    shown = security.decode(unsigned_security(station, unknown, image))
    assert (shown.sequence, shown.key_epoch) == (0, 0)


@pytest.mark.parametrize(
    ("released", "tapped", "holder", "frozen"),
    [
        (False, False, "ncap", True),
        (True, False, "ncap", False),
        (False, True, "ncap", False),
        (False, False, None, False),
    ],
)
def test_a_node_that_is_measured_is_left_alone(
    station: Station, monkeypatch: pytest.MonkeyPatch, released: bool, tapped: bool, holder: str | None, frozen: bool
) -> None:
    monkeypatch.setattr(station.measurements, "holder", lambda _uuid: holder)
    node = SimpleNamespace(uuid=bytes(10), tapped=tapped)
    if not frozen:
        require_not_measured(station, node, released=released)  # type: ignore[arg-type]
        return
    with pytest.raises(FrozenError) as refused:
        require_not_measured(station, node, released=released, undone="Nothing was done.")  # type: ignore[arg-type]
    assert refused.value.message == f"Node {'00' * 10} is being measured by ncap. Nothing was done."


def brought(image: Image, *, sequence: int, epoch: int = 1, unsigned: bool = True) -> Image:
    """Return an image file from elsewhere: what the node has, under another name and number."""
    shown = security.decode(security_of(image))
    made = replace(shown, sequence=sequence, key_epoch=epoch)
    return renamed(image, "brought").with_block(
        SECURITY, (replace(made, signature=None) if unsigned else made).encode()
    )


@pytest.mark.parametrize(
    ("sequence", "epoch", "signed_as"),
    [(0, 1, (2, 1)), (5, 1, (6, 1)), (5, 3, (6, 3)), (5, 0, (6, 1)), (65537, 1, (65538, 1))],
)
def test_an_image_file_counts_where_it_is_newer(
    station: Station, image: Image, sequence: int, epoch: int, signed_as: tuple[int, int]
) -> None:
    done = sign_image(station, SignOrder(image.uuid, brought(image, sequence=sequence, epoch=epoch)), None).signed
    shown = security.decode(security_of(done.image))
    assert (shown.sequence, shown.key_epoch) == signed_as


def test_an_image_file_uses_up_no_numbers_of_a_known_node(station: Station, image: Image) -> None:
    far = brought(image, sequence=65538)
    with pytest.raises(PolicyError, match="The image has sequence 65538; the last one known here is 1") as refused:
        sign_image(station, SignOrder(image.uuid, far), None)
    assert refused.value.hint == "That number is unverified. Check it against the node: sign IMAGE --read-node"
    ours = brought(image, sequence=900, unsigned=False)
    assert sign_image(station, SignOrder(image.uuid, ours), None).signed.sequence == 2, "a number that was given here"


def test_what_is_kept_of_what_was_signed(station: Station, image: Image) -> None:
    again = sign_image(station, SignOrder(image.uuid), None)
    assert (again.signed.reused, again.changes, station.datasheets.draft(image.uuid)) == (True, (), None)
    file = sign_image(station, SignOrder(image.uuid, brought(image, sequence=5)), None)
    assert station.datasheets.draft(image.uuid) is None, "an image that was not built here stays the caller's"
    assert len(file.changes) == 1
    built = renamed(image, "built")
    station.datasheets.keep_draft(Draft(image.uuid, built, "built", "gripper"))
    plan = sign_image(station, SignOrder(image.uuid, dry_run=True), None)
    assert not plan.signed.reused
    draft = station.datasheets.draft(image.uuid)
    assert draft is not None
    assert draft.stage == "built"
    done = sign_image(station, SignOrder(image.uuid), None)
    draft = station.datasheets.draft(image.uuid)
    assert draft is not None
    assert (draft.stage, draft.profile, draft.image) == ("signed", "gripper", done.signed.image)
    assert sign_image(station, SignOrder(image.uuid), None).signed == replace(done.signed, reused=True)


def test_nothing_is_signed_of_a_node_without_a_datasheet(station: Station, image: Image, tmp_path) -> None:  # type: ignore[no-untyped-def]
    from teds_provision.station.store.records import WhitelistEntry

    uuid = bytes(9) + b"\1"
    station.pins.put(WhitelistEntry(uuid))
    with pytest.raises(NotFoundError, match=rf"^Nothing has been built for node {uuid.hex()}\.$"):
        sign_image(station, SignOrder(uuid), None)
    with pytest.raises(NotFoundError):
        sign_image(station, SignOrder(uuid, Image(uuid, {SECURITY: security_of(image)})), None)
    other = make_station(tmp_path / "other")
    with pytest.raises(PolicyError):
        sign_image(other, SignOrder(image.uuid, image), None)


def test_an_image_file_needs_a_place_for_what_is_signed_and_a_plan_does_not(
    station: Station, image: Image, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "image.json"
    file.write_text(image.to_json())
    orders: list[SignOrder] = []
    monkeypatch.setattr(signing, "sign_image", lambda _station, order, node: orders.append(order))

    def at(what: str, **how: object) -> None:
        signing.sign_at(station, LinkSettings(), what, SilentReporter(), **how)  # type: ignore[arg-type]

    with pytest.raises(UsageError, match=r"^Signing an image file requires an output file\.$"):
        at(str(file))
    at(str(file), output=tmp_path / "out.json")
    at(str(file), dry_run=True)
    at(image.uuid.hex())
    assert [(order.image is not None, order.dry_run) for order in orders] == [
        (True, False), (True, True), (False, False),
    ]  # fmt: skip


def test_a_node_that_is_not_whitelisted_costs_no_passphrase(
    station: Station, image: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[object] = []
    monkeypatch.setattr(type(station), "unlock", lambda *_: opened.append(1))
    station.pins.remove(image.uuid)
    with pytest.raises(PolicyError, match="is not on the whitelist"):
        signing.sign_at(station, LinkSettings(), image.uuid.hex(), SilentReporter())
    assert opened == []


@pytest.mark.parametrize(
    ("read", "same", "usable"), [(False, True, True), (False, False, True), (True, True, True), (True, False, False)]
)
def test_the_signature_of_a_node_that_was_altered_is_not_used_again(
    image: Image, read: bool, same: bool, usable: bool
) -> None:
    """It takes what it was signed for only under a newer sequence."""
    found: Any = SimpleNamespace() if read else None
    present = signing._PresentTeds(image if same else renamed(image), 1, 1, found)
    assert present.security_for(image) == (security_of(image) if usable else None)
    assert signing._PresentTeds(None, 1, 1, found).security_for(image) is None


@pytest.mark.parametrize(
    ("known", "brought", "refused"),
    [(0, 70_000, False), (5, 65_541, False), (5, 65_542, True), (70_000, 5, False)],
)
def test_a_file_uses_up_at_most_one_step_of_the_numbers_of_a_known_node(
    station: Station, monkeypatch: pytest.MonkeyPatch, known: int, brought: int, refused: bool
) -> None:
    uuid = bytes(9) + b"\x07"
    if known:
        station.nodes.remember(uuid, sequence=known)
    shown = SimpleNamespace(key_epoch=3, signed=True, station_key=b"another", sequence=brought)
    monkeypatch.setattr(signing.security, "decode", lambda _octets: shown)
    file = Image(uuid, {SECURITY: b"x"})
    if refused:
        with pytest.raises(PolicyError, match=rf"^The image has sequence {brought}; the last one known here is"):
            signing._last_known(station, uuid, None, file)
        return
    present = signing._last_known(station, uuid, None, file)
    assert (present.epoch, present.sequence) == (3, brought)
    shown.station_key = station.point
    assert signing._last_known(station, uuid, None, file).sequence == 0, "the number was given here"


@pytest.mark.parametrize(("seconds", "good"), [(0, True), (2**32 - 1, True), (2**32, False), (-1, False)])
def test_a_clock_that_no_signature_can_hold_is_wrong(monkeypatch: pytest.MonkeyPatch, seconds: int, good: bool) -> None:
    monkeypatch.setattr(signing, "time", SimpleNamespace(time_ns=lambda: seconds * 10**9 + 7))
    if good:
        assert signing._now() == seconds.to_bytes(4, "big") + bytes([0, 0, 0, 7])
        return
    with pytest.raises(TedsProvisionError, match=r"^This machine's clock is wrong\.$"):
        signing._now()


def test_a_signature_against_the_node_itself_is_made_in_its_session_under_its_lock(
    station: Station, image: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    course: list[Any] = []

    @contextmanager
    def met(_station: Station, links: LinkSettings, uuid: bytes, _reporter: Any) -> Iterator[str]:
        course.append(("met", uuid, links))
        yield "node"

    @contextmanager
    def locked(_own: Station, uuid: bytes) -> Iterator[None]:
        course.append(("locked", uuid))
        yield
        course.append("free")

    def sign_it(_station: Station, order: SignOrder, node: Any) -> str:
        course.append((node, order.uuid, order.dry_run))
        return "signed"

    monkeypatch.setattr(signing, "meet", met)
    monkeypatch.setattr(type(station), "node_lock", locked)
    monkeypatch.setattr(signing, "sign_image", sign_it)
    links, uuid = LinkSettings("nfc"), image.uuid
    at = partial(signing.sign_at, station, links, uuid.hex(), SilentReporter())
    assert at(read_node=True) == "signed"
    assert course == [("met", uuid, links.after_agreeing()), ("locked", uuid), ("node", uuid, False), "free"]
    course.clear()
    assert at() == "signed"
    assert course == [(None, uuid, False)], "the node is not met"


@pytest.mark.parametrize("dry_run", [False, True])
def test_a_plan_of_a_signature_opens_no_session_that_would_settle_a_key(
    station: Station, image: Image, monkeypatch: pytest.MonkeyPatch, dry_run: bool
) -> None:
    opened: list[Any] = []
    found = SimpleNamespace(image=image, identity=SimpleNamespace(epoch=3, sequence=9))
    monkeypatch.setattr(signing, "require_session", lambda *given: opened.append(given))
    monkeypatch.setattr(signing, "take_snapshot", lambda _node: found)
    node: Any = object()
    present = signing._read_now(station, node, SignOrder(image.uuid, None, None, dry_run))
    assert opened == ([] if dry_run else [(station, node)])
    assert (present.epoch, present.sequence) == (3, 9)


def test_of_two_equal_signatures_that_of_the_node_is_given_back_and_of_others_one_above_its_number(
    station: Station, image: Image, keys: SignedNodeKey, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers = {b"on node": 5, b"earlier": 9, b"too old": 5, b"other": None}
    monkeypatch.setattr(signing, "_sequence_if_the_same", lambda *given: numbers[given[3]])

    def signed(on_node: bytes | None, *earlier: bytes) -> int | None:
        found = signing.sign(station, keys, image, epoch=1, node_sequence=5, on_node=on_node, earlier=earlier)
        return found.sequence if found.reused else None

    assert signed(b"on node", b"earlier") == 5
    assert signed(None, b"too old", b"earlier") == 9
    assert signed(b"other", b"too old") is None


def test_the_vault_opens_before_a_node_is_waited_for_and_not_for_a_plan(
    station: Station, image: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    course: list[str] = []
    monkeypatch.setattr(station, "unlock", lambda: course.append("unlocked"))
    monkeypatch.setattr(signing, "sign_image", lambda *_: course.append("signed"))
    for dry_run in (False, True):
        signing.sign_at(station, LinkSettings(), image.uuid.hex(), SilentReporter(), dry_run=dry_run)
    assert course == ["unlocked", "signed", "signed"]


@pytest.mark.parametrize("dry_run", [True, False])
def test_a_calibration_that_was_accepted_is_in_the_log_unless_nothing_is_signed(
    station: Station, image: Image, monkeypatch: pytest.MonkeyPatch, dry_run: bool
) -> None:
    given: list[Any] = []
    monkeypatch.setattr(signing, "guard", lambda *words, **how: given.append((words[3], how)))
    signing.sign_image(station, SignOrder(image.uuid, None, "a reason", dry_run), None)
    assert given == [("a reason", {"record": not dry_run})]


@pytest.mark.parametrize(("sheet", "record"), [(70_000, 5), (5, 70_000)])
def test_the_numbers_of_a_node_are_the_highest_of_its_datasheet_its_record_and_the_file(
    station: Station, monkeypatch: pytest.MonkeyPatch, sheet: int, record: int
) -> None:
    uuid = bytes(9) + b"\x08"
    station.nodes.remember(uuid, epoch=7, sequence=record)
    shown = SimpleNamespace(key_epoch=3, signed=True, station_key=b"another", sequence=70_001)
    monkeypatch.setattr(signing.security, "decode", lambda _octets: shown)
    monkeypatch.setattr(signing, "_sequence_of", lambda _image: sheet)
    file = Image(uuid, {SECURITY: b"x"})
    present = signing._last_known(station, uuid, None, file)
    assert (present.epoch, present.sequence) == (7, 70_001)
    shown.sequence = 4
    assert signing._last_known(station, uuid, None, file).sequence == sheet


def test_a_plan_of_a_signature_needs_no_entry_of_the_whitelist_and_has_the_reason_that_was_given(
    station: Station, image: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    orders: list[SignOrder] = []
    monkeypatch.setattr(signing, "sign_image", lambda _station, order, _node: orders.append(order))
    station.pins.remove(image.uuid)
    how: dict[str, Any] = {"accept_calibration": "a new cell", "dry_run": True}
    signing.sign_at(station, LinkSettings(), image.uuid.hex(), SilentReporter(), **how)
    assert orders == [SignOrder(image.uuid, None, "a new cell", True)]
