"""What a station and its store refuse, each with its message and with what to do about it, in the words of the user."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import (
    BadDataError,
    FrozenError,
    KeyMismatchError,
    KeyringUnavailableError,
    NewerStoreError,
    NotFoundError,
    PolicyError,
    StoreError,
    TedsProvisionError,
    UsageError,
    VaultError,
    VaultLockedError,
    WrongPassphraseError,
)
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.station import (
    firmware,
    groups,
    identity,
    label,
    measurements,
    node_keys,
    nodes,
    policy,
    shown_units,
)
from teds_provision.station.policy import PlantConflictError
from teds_provision.station.station import not_certified
from teds_provision.station.store import connection, database, dump
from teds_provision.station.store.records import NodeRecord, TrustRecord
from teds_provision.station.store.store import Store

NODE, OTHER = bytes.fromhex("8d4d9da65281f7000001"), bytes.fromhex("8d4d9da65281f7000002")
ONE, TWO = SoftwareKey(61).point, SoftwareKey(62).point


def stub(**members: Any) -> Any:
    return SimpleNamespace(**members)


def refused(run: Callable[[], object], kind: type[TedsProvisionError], message: str, hint: str) -> None:
    with pytest.raises(kind) as error:
        run()
    assert (error.value.message, error.value.hint) == (message, hint)


def bare(kind: type[Any], **members: Any) -> Any:
    """Return an object without what its class would open."""
    made = cast("Any", kind.__new__(kind))
    for name, value in members.items():
        setattr(made, name, value)
    return made


def test_a_name_of_a_group_and_its_nodes_are_the_users_choice(store: Store, tmp_path: Path) -> None:
    rule = "Use up to 64 characters, not only hex digits or dots, and not 'all', which means every node."
    kept = groups.Groups(store, tmp_path, stub(record_event=lambda *_, **__: None))
    for name in ("all", "abcdef", "..", "x" * 65, ""):
        refused(lambda: kept.create(name, []), UsageError, f"{name!r} is not a valid group name.", rule)  # noqa: B023
    kept.create("left hand", [NODE])
    kept.create("left hand", [NODE])
    pair = kept.create("pair", [OTHER, NODE, OTHER])
    assert kept.create("pair", [NODE, OTHER]) == kept.create("pair", [OTHER, NODE]) == pair
    assert pair.uuids == (NODE, OTHER)
    refused(
        lambda: kept.create("left hand", [OTHER]), UsageError, "Group 'left hand' already exists.",
        "Add nodes to it: group add 'left hand' UUID …",
    )  # fmt: skip


def test_a_measurement_that_is_not_there_is_chosen_from_those_that_are(tmp_path: Path) -> None:
    listed = list[Any]()
    kept = bare(measurements.Measurements, _store=stub(read_one=lambda *_: None), all=lambda: listed)
    refused(lambda: kept.get("m9"), NotFoundError, "There is no measurement 'm9'.", "Measurements: none.")
    listed[:] = [stub(id="m1"), stub(id="m2")]
    refused(lambda: kept.get("m9"), NotFoundError, "There is no measurement 'm9'.", "Measurements: m1, m2.")


def test_a_group_with_measurements_is_deleted_only_with_them(store: Store, tmp_path: Path) -> None:
    of = groups.Groups(store, tmp_path, stub(record_event=lambda *_, **__: None))
    of.create("left hand", [NODE])
    there = ["m1", "m2"]
    kept = bare(
        measurements.Measurements, _store=store, _groups=of, of_group=lambda _: [stub(id=name) for name in there]
    )
    refused(
        lambda: kept.delete_group("left hand", also=("m1",)), FrozenError,
        "Group 'left hand' has 2 kept measurements (m1, m2), which would be deleted with it.",
        "Delete them first, or: group delete 'left hand' --yes",
    )  # fmt: skip
    del there[1]
    refused(
        lambda: kept.delete_group("left hand"), FrozenError,
        "Group 'left hand' has 1 kept measurement (m1), which would be deleted with it.",
        "Delete it first, or: group delete 'left hand' --yes",
    )  # fmt: skip
    assert of.find("left hand") is not None


def test_a_name_or_frame_of_a_measured_node_stays_and_no_two_channels_have_one_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    running, put = [True], list[object]()
    monkeypatch.setattr(measurements.Measurements, "names", {(OTHER, 2): "left", (NODE, 1): "right"})
    kept = bare(
        measurements.Measurements, is_running=lambda _: running[0],
        _put_name=lambda *given: put.append(given), _put_frame=lambda *given: put.append(given),
    )  # fmt: skip
    end = "End that measurement first."
    refused(
        lambda: kept.rename(NODE, 1, "x"), FrozenError,
        f"Node {NODE.hex()} is being measured, so its names cannot be changed now.", end,
    )  # fmt: skip
    running[0] = False
    for uuid, channel in ((NODE, 1), (OTHER, 1)):
        refused(
            lambda: kept.rename(uuid, channel, "left"), UsageError,  # noqa: B023
            f"'left' is the name of channel 2 of node {OTHER.hex()} already.", "Choose another name.",
        )  # fmt: skip
    kept.rename(NODE, 1, "right")
    kept.rename(OTHER, 2, "left")
    assert put == [(NODE, 1, "right"), (OTHER, 2, "left")]
    put.clear()
    running[0], kept._remove_frame, kept._remove_name = True, kept._put_frame, kept._put_name
    refused(
        lambda: kept.set_frame(NODE, 1, "wrist"), FrozenError,
        f"Node {NODE.hex()} is being measured, so its frames cannot be changed now.", end,
    )  # fmt: skip
    running[0] = False
    for frame in ("wrist", "", None):
        kept.set_frame(NODE, 1, frame)
    kept.rename(NODE, 1, None)
    assert put == [(NODE, 1, "wrist"), (NODE, 1, ""), (NODE, 1), (NODE, 1)], "only None is the profile's"


def test_a_measurement_names_its_nodes_in_one_way(store: Store) -> None:
    kept = bare(measurements.Measurements, _store=store)
    for ways in ({}, {"group": "g", "uuids": (NODE,)}, {"group": "g", "match": "m"}, {"uuids": (NODE,), "match": "m"}):
        one = stub(**{"group": None, "uuids": (), "match": None} | cast("Any", ways))
        refused(
            lambda: kept._put(one), BadDataError,  # noqa: B023
            "A measurement names a group, or nodes by UUID, or says which nodes match.", "",
        )  # fmt: skip


def test_only_a_key_that_is_here_becomes_the_active_one(store: Store) -> None:
    keys = bare(node_keys.NodeKeys, _store=store)
    refused(lambda: keys.activate(NODE, "a1"), NotFoundError, f"The store has no key a1 of node {NODE.hex()}.", "")


def test_labels_need_their_packages_by_format(monkeypatch: pytest.MonkeyPatch) -> None:
    there = set[str]()
    monkeypatch.setattr(label, "is_installed", lambda name: name in there)
    monkeypatch.setattr(label, "how_to_install", lambda extra: f"install {extra}")
    for form in ("svg", "png"):
        refused(
            lambda: label.require_label_packages(form), TedsProvisionError, "Labels need segno, which is not installed.",  # noqa: B023, E501
            "install label",
        )  # fmt: skip
    there.add("segno")
    label.require_label_packages("svg")
    refused(
        lambda: label.require_label_packages("png"), TedsProvisionError, "A PNG needs Pillow, which is not installed.",
        "install label",
    )  # fmt: skip
    there.add("PIL")
    label.require_label_packages("png")


def test_a_node_that_shows_another_key_is_not_to_be_trusted() -> None:
    kept = bare(nodes.Nodes)
    known, shown = (cast("NodeRecord", stub(uuid=NODE, point=point)) for point in (ONE, TWO))
    refused(
        lambda: kept._replace(shown, known), KeyMismatchError,
        f"Node {NODE.hex()} is known with another identity key than the one it shows now.",
        "Do not trust this node. If its chip was really replaced, it needs a new UUID.",
    )  # fmt: skip


def test_a_name_that_no_node_has_is_answered_with_what_can_be_given() -> None:
    near = list[str]()
    kept = bare(nodes.Nodes, _store=stub(execute=lambda *_: []), _near_names=lambda _: near)
    rule = "Give a UUID (20 hex digits, or its first four or more) or a name; see nodes."
    refused(lambda: kept.resolve("elbw"), NotFoundError, "No node is known as 'elbw'.", rule)
    near[:] = ["elbow", "elbow 2"]
    refused(
        lambda: kept.resolve("elbw"), NotFoundError, "No node is known as 'elbw'.",
        f"Did you mean 'elbow' or 'elbow 2'? {rule}",
    )  # fmt: skip


def test_what_policy_refuses_of_a_node_can_be_confirmed_or_decided() -> None:
    keys = stub(restored=lambda _: True, rotation_due=lambda _: "restored from a backup", held=lambda _: held[0])
    claims = stub(conflicts=lambda _: [(NODE, "name", "x"), (NODE, "two keys", "a and b")])
    entry: Any = None
    held = [False]
    judge = bare(policy.Policy, _keys=keys, _plant=stub(joined=True, claims=claims), _pins=stub(row=lambda _: entry))
    refused(
        lambda: judge.require_not_restored(NODE), PolicyError,
        f"The key of node {NODE.hex()} was restored from a backup.",
        f"Tap it (with any command), or confirm that it is still yours: agree {NODE.hex()} --rotate --yes",
    )  # fmt: skip
    keys.restored = lambda _: False
    judge.require_not_restored(NODE)
    for entry in (None, stub(fingerprint=None, assurance="tap"), stub(fingerprint="f", assurance="registry")):  # noqa: B007
        refused(
            lambda: judge.require_undisputed(NODE), PlantConflictError,
            f"The plant's stations know two keys for node {NODE.hex()}: a and b.",
            f"A keeper must pin one of them, or you do: whitelist add {NODE.hex()} --fingerprint F",
        )  # fmt: skip
    entry = stub(fingerprint="f", assurance="tap")
    judge.require_undisputed(NODE)
    entry, held[0] = None, True
    judge.require_undisputed(NODE)
    held[0], judge._plant.joined = False, None
    judge.require_undisputed(NODE)


def test_a_name_of_a_trusted_key_means_one_key(store: Store) -> None:
    judge = bare(policy.Policy, _store=store, _row_macs=stub(require=lambda: None))
    digits = ["ab" * 8 + "0" * 48, "ab" * 8 + "1" * 48]
    for number, one in enumerate(digits):
        store.execute("INSERT INTO trust VALUES(?, 'station', zeroblob(65), ?, '', NULL)", (f"its {number}", one))
    refused(
        lambda: judge.restore_trust(TrustRecord("its 0", "ca", ONE, fingerprint(ONE))), PolicyError,
        f"The name 'its 0' is already taken by the station {'ab' * 8}.",
        "Choose another name, or run teds-provision trust remove 'its 0' first.",
    )  # fmt: skip
    refused(
        lambda: judge.distrust("AB" * 8), UsageError, f"{'ab' * 8} matches 2 trusted keys.",
        "Give the whole fingerprint.",
    )  # fmt: skip
    assert judge.distrust("ab" * 7 + "a") is False, "fewer than 16 digits name no key"
    assert judge.distrust(digits[0].upper()) is True
    assert judge.distrust("its 1") is True
    assert store.execute("SELECT * FROM trust") == []


def test_a_label_is_of_a_known_key_and_an_image() -> None:
    unknown = stub(pins=stub(pinned=lambda _: pinned))
    for pinned in (None, "ab" * 31):  # noqa: B007
        refused(
            lambda: label.label_of(unknown, NODE), NotFoundError, f"The key of node {NODE.hex()} is not known here.",
            "Tap it once: teds-provision identify --add",
        )  # fmt: skip
    for name in ("label.pdf", "label"):
        refused(
            lambda: label.write_label(stub(), Path(name)), UsageError,  # noqa: B023
            f"Labels are written as .svg or .png, not {name}.", "Name it LABEL.svg.",
        )  # fmt: skip


def test_beside_the_code_of_a_label_stand_its_name_and_all_digits_16_in_a_line() -> None:
    digits = "".join(f"{number:x}" * 16 for number in range(4))
    lines = [NODE.hex(), "0" * 16, "1" * 16, "2" * 16, "3" * 16]
    assert label.Label(NODE, digits, None).lines == label.Label(NODE, digits, "").lines == lines
    assert label.Label(NODE, digits, "elbow").lines == ["elbow", *lines]


@pytest.mark.parametrize("text", ["", "x" * 91, "TEDS1:" + "8" * 20 + ":" + "a" * 63 + "g", "TEDS1:" + "8" * 20])
def test_what_is_no_label_is_read_as_none(text: str) -> None:
    assert label.read_label(text) is None
    assert label.read_label("TEDS1:" + "8d" * 10 + ":" + "AB" * 32) == (bytes.fromhex("8d" * 10), "ab" * 32)


def test_a_certificate_comes_from_the_station_with_the_ca_key() -> None:
    for key in (None, stub(point=b"another CA")):
        own = bare(identity.StationIdentity, _vault=lambda key=key: stub(ca=lambda: key))
        own.record = lambda: stub(ca=ONE)
        refused(
            lambda: own.certify(TWO), NotFoundError, "The CA key is not in this vault.",  # noqa: B023
            "Run this on the station that has the CA key.",
        )  # fmt: skip
    waiting = not_certified()
    assert (waiting.message, waiting.hint) == (
        "This station is waiting for its CA's certificate.", "To install it: teds-provision init --certificate CERT"
    )  # fmt: skip


# -- the store ---------------------------------------------------------------------------------------------------------

NEWER = "Use the newer version of teds-provision that made it."


def test_a_store_of_another_version_is_for_that_version(tmp_path: Path) -> None:
    newer = connection.newer_schema(tmp_path, 99)
    assert isinstance(newer, NewerStoreError)
    assert newer.message.startswith(f"The store {tmp_path} has schema 99; this version of the tool knows up to ")
    assert newer.hint == NEWER
    old = connection.too_old("The store x", 3)
    assert (old.message, old.hint) == (
        "The store x is of schema 3, from before KeyAgreement 2, which nodes no longer support.",
        "That version was never released. Choose another --home, run init there, and provision the nodes again.",
    )
    head = b'{"schema": 99, "tables": {}}\n'
    with pytest.raises(StoreError) as error:
        dump._head(stub(read_line=lambda *_: head))
    assert error.value.message.startswith("The store in the backup has schema 99; this version of the tool knows up to")
    assert error.value.hint == NEWER


def test_a_change_that_failed_in_part_or_is_no_text_is_run_again(store: Store) -> None:
    def fail() -> None:
        with store.together():
            store.execute("UPDATE meta SET value = value")
            raise KeyError

    def caught() -> None:
        with store.transaction():
            with pytest.raises(KeyError):
                fail()
            store.execute("INSERT INTO meta VALUES('kept', 'no')")

    refused(caught, StoreError, "Part of this change failed, so all of it was undone.", "Run it again.")
    assert store.execute("SELECT * FROM meta WHERE name = 'kept'") == []
    refused(
        lambda: store.execute("SELECT ?", ("\udcff",)), BadDataError, "A name or text is not valid UTF-8.",
        "Give it in UTF-8.",
    )  # fmt: skip


def test_a_failure_in_part_is_not_forgotten_for_another_one_that_was_taken_back(store: Store) -> None:
    def fail(block: Any) -> None:
        with suppress(KeyError), block:
            store.execute("INSERT OR REPLACE INTO meta VALUES('part', 'x')")
            raise KeyError

    def both() -> None:
        with store.transaction():
            store.execute("INSERT INTO meta VALUES('before', 'x')")
            fail(store.together())
            fail(store.transaction())

    def apart() -> None:
        with store.transaction():
            store.execute("INSERT INTO meta VALUES('before', 'x')")
            fail(store.transaction())

    refused(both, StoreError, "Part of this change failed, so all of it was undone.", "Run it again.")
    assert store.execute("SELECT name FROM meta WHERE name IN ('before', 'part')") == []
    apart()
    assert store.execute("SELECT name FROM meta WHERE name IN ('before', 'part')") == [("before",)]


def test_a_home_that_others_can_reach_or_that_is_none_is_refused_with_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home, file, link = tmp_path / "home", tmp_path / "file", tmp_path / "link"
    file.touch()
    link.symlink_to(file)
    init = "Run teds-provision init."
    refused(lambda: database.prepare_home(home, create=False), StoreError, f"There is no store in {home}.", init)
    refused(
        lambda: database.prepare_home(file, create=False), StoreError, f"{file} is not a directory.",
        "Choose another --home.",
    )  # fmt: skip
    home.mkdir(mode=0o700)
    refused(
        lambda: database.prepare_file(home / "store.sqlite3", create=False), StoreError,
        f"There is no store in {home}.", init,
    )  # fmt: skip
    (home / "content").touch()
    home.chmod(0o722)
    for create in (True, False):
        refused(
            lambda: database.prepare_home(home, create=create), StoreError, f"Other users can write to {home}.",  # noqa: B023
            f"Run: chmod 700 {home}, or choose another --home.",
        )  # fmt: skip
    move = "Another program put it there: check it and move it away."
    refused(lambda: database._require_own(link), StoreError, f"{link} is a link.", move)
    database._require_own(file)
    database._require_own(tmp_path / "nothing")
    monkeypatch.setattr(database, "is_mine", lambda _: False)
    refused(lambda: database._require_own(file), StoreError, f"{file} is not owned by this user.", move)
    refused(
        lambda: database.prepare_home(home, create=False), StoreError, f"{home} belongs to another user.",
        "Run this as its owner, or choose another --home.",
    )  # fmt: skip


# -- what is left out because it cannot be read ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error", [NotFoundError("x"), BadDataError("x"), StoreError("x"), FileNotFoundError("x"), PermissionError("x")]
)
@pytest.mark.parametrize("at", ["find", "read"])
def test_a_profile_that_cannot_be_read_demands_nothing_and_shows_no_units(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, at: str
) -> None:
    def fails(*_: object) -> Any:
        raise error

    def found(*_: object) -> Path:
        return tmp_path

    monkeypatch.setattr(firmware.teds.profile, "find_profile", fails if at == "find" else found)
    monkeypatch.setattr(firmware, "_demand", fails)
    monkeypatch.setattr(shown_units, "find_profile", fails if at == "find" else found)
    monkeypatch.setattr(shown_units, "_read", fails)
    assert firmware.FirmwareDemands(tmp_path).demand_of("cell") is None
    assert shown_units._channels_of("cell", tmp_path) == {}


def test_a_key_that_is_damaged_hides_no_other_and_a_closed_vault_ends_the_search() -> None:
    fates: dict[str, Any] = {}

    def unwrap(record: str) -> Any:
        if isinstance(fates[record], Exception):
            raise fates[record]
        return fates[record]

    keys = bare(node_keys.NodeKeys, keys_of=lambda _: list(fates), unwrap=unwrap)
    fates.update(one=VaultError("one is damaged"), two=b"2", three=VaultError("three is damaged"), four=b"4")
    found = keys.unwrapped(NODE)
    assert [next(found).key for _ in "12"] == [b"2", b"4"]
    with pytest.raises(VaultError, match="three is damaged"):
        next(found)
    for error in (WrongPassphraseError("x"), KeyringUnavailableError("x"), VaultLockedError("x")):
        fates.update(one=error)
        with pytest.raises(type(error)):
            next(keys.unwrapped(NODE))
