"""A line and its office cut at every durable step: the same command carries on, and no unit is given twice or lost.

What lies on the disk at a commit, or before a file gets its name, is set aside as kill -9 would leave it; the board
stays what it is by then, and the work is carried on from that disk. A small share runs in the gate; ``make faults``
runs all.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from teds_provision import files
from teds_provision.errors import PolicyError, StoreError
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.jobs import find_job, take_job
from teds_provision.plant.line import LineRun
from teds_provision.plant.office import MOST_ANSWERS, answer
from teds_provision.plant.sync import sync
from teds_provision.protocol.keys import node_key_message
from teds_provision.protocol.plant import evidence as codec
from teds_provision.protocol.plant.signing import Answer, SignRequest, open_answer, seal_request
from teds_provision.station.station import Station
from teds_provision.station.store.connection import Connection
from teds_provision.teds.image import Image
from tests.bench import Board

from .owner import alone, job_of
from .stations import Plant, ask
from .test_jobs import build, make_board, units
from .test_office import LocalOffice, proven

Homes = dict[str, Station]


class KilledError(BaseException):
    """The machine stopped."""


@contextmanager
def killed_at(step: int, folder: Path, disk: Path, patch: pytest.MonkeyPatch) -> Iterator[None]:
    """Stop before the durable step of this number, and keep as ``disk`` what ``folder`` held then."""
    left = step
    execute, publish = Connection.execute, files._publish

    def one_step() -> None:
        nonlocal left
        left -= 1
        if left < 0:
            if not disk.exists():
                shutil.copytree(folder, disk)
            raise KilledError

    def counted(self: Connection, statement: str, values: object = ()) -> object:
        if statement == "COMMIT":
            one_step()
        return execute(self, statement, values)  # type: ignore[arg-type]

    def published(draft: Path, path: Path, *, replace: bool) -> None:
        one_step()
        publish(draft, path, replace=replace)

    with patch.context() as patched:
        patched.setattr(Connection, "execute", counted)
        patched.setattr(files, "_publish", published)
        yield


@contextmanager
def opened(folder: Path, *names: str) -> Iterator[Homes]:
    homes = {name: Station.open(folder / name, ask=ask) for name in names}
    try:
        for station in homes.values():
            station.unlock()
        yield homes
    finally:
        for station in homes.values():
            station.close()


def cut(
    folder: Path, names: tuple[str, ...], steps: range, patch: pytest.MonkeyPatch, line_of: Callable[[Homes], LineRun]
) -> Iterator[Homes]:
    """Build a board and be cut at each step, carry on, build another; gives the homes as they are then."""
    for step in steps:
        work, disk, board = folder / "work", folder / "disk", make_board(1)
        shutil.copytree(folder / "kept", work)
        with opened(work, *names) as homes:
            line = line_of(homes)
            with killed_at(step, work, disk, patch), suppress(KilledError):
                build(line, board)
        if not disk.exists():
            return
        with opened(disk, *names) as homes:
            line = line_of(homes)
            assert build(line, board).verified.verdict == "authentic", step
            assert build(line, make_board(2)).verified.verdict == "authentic", step
            given = units(line)
            assert [unit for unit, _, _ in given] == [1, 2], step
            assert all(passed for _, _, passed in given), step
            rows = list(line.station.plant.line.evidence())
            assert {row.unit for row in rows if row.verdict == codec.PASSED} == {1, 2}, step
            assert len({(row.uuid, row.attempt) for row in rows}) == len(rows), step
            assert all(codec.faults(codec.read(row.document), line.station.identity.ca) == [] for row in rows), step
            yield homes
        shutil.rmtree(work)
        shutil.rmtree(disk)


def cut_line(folder: Path, steps: range, patch: pytest.MonkeyPatch) -> int:
    station = alone(folder / "kept" / "home")
    job = take_job(station, job_of(station))
    station.close()
    return sum(
        1
        for _ in cut(
            folder, ("home",), steps, patch, lambda homes: LineRun(homes["home"], find_job(homes["home"], job.id))
        )
    )


def cut_office(folder: Path, steps: range, patch: pytest.MonkeyPatch) -> int:
    (folder / "kept").mkdir()
    plant = Plant(folder / "kept")
    west, north = plant.member("west", "line"), plant.north
    north.unlock()
    own = {"stations": {west.identity.fingerprint: 3}, "sign": north.identity.fingerprint}
    document = job_of(north, registry=plant.roster.registry, **own)
    take_job(north, document)
    job = take_job(west, document)
    plant.close()

    def line_of(homes: Homes) -> LineRun:
        return LineRun(homes["west"], find_job(homes["west"], job.id), office=LocalOffice(homes["north"]))

    done = 0
    for homes in cut(folder, ("north", "west"), steps, patch, line_of):
        line = homes["north"].plant.line
        assert [row.unit for row in line.units(job.id)] == [1, 2]
        for row in line.units(job.id):
            answered = [request.sequence for request in line.sign_requests(job.id, row.uuid, "in")]
            assert len(set(answered)) == len(answered), "each request has a sequence of its own"
            for request in line.sign_requests(job.id, row.uuid, "in"):
                assert answer(homes["north"], request.request) == request.answer, (
                    "the same request gets the same answer"
                )
        done += 1
    return done


def test_a_line_that_is_killed_carries_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cut_line(tmp_path, range(1, 12, 4), monkeypatch) >= 2


def test_an_office_that_is_killed_carries_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cut_office(tmp_path, range(3, 12, 4), monkeypatch) >= 2


@pytest.mark.soak
def test_a_line_that_is_killed_at_any_step_carries_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cut_line(tmp_path, range(100), monkeypatch) >= 6


@pytest.mark.soak
def test_an_office_that_is_killed_at_any_step_carries_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cut_office(tmp_path, range(100), monkeypatch) >= 8


def pages_of(station: Station, most: int | None = None) -> int:
    """Return how many pages the store has; it may have ``most`` from now on."""
    database = station._store
    if most is not None:
        database.execute(f"PRAGMA max_page_count = {most}")
    return int(database.execute("PRAGMA page_count")[0][0])


@pytest.mark.parametrize("home", ["line", "office"])
def test_a_disk_that_is_full_loses_no_unit_and_gives_none_twice(tmp_path: Path, home: str) -> None:
    """The store has room for so many pages more, up to where all fits; then somebody makes room."""
    plant = Plant(tmp_path)
    west, north = plant.member("west", "line"), plant.north
    north.unlock()
    west.unlock()
    own = {"stations": {west.identity.fingerprint: 50}, "sign": north.identity.fingerprint, "count": 50}
    document = job_of(north, registry=plant.roster.registry, **own)
    take_job(north, document)
    line = LineRun(west, take_job(west, document), office=LocalOffice(north))
    full = west if home == "line" else north
    failed = 0
    for number, room in enumerate((0, 1, 2, 3, 5, 8), 1):
        board = make_board(number)
        pages_of(full, pages_of(full) + room)
        try:
            build(line, board)
        except StoreError:
            failed += 1
        pages_of(full, 1 << 20)
        assert build(line, board).verified.verdict == "authentic", room
        rows = list(west.plant.line.evidence(uuid=board.uuid))
        assert rows[-1].verdict == codec.PASSED, room
        assert all(codec.faults(codec.read(row.document), west.identity.ca) == [] for row in rows), room
        assert [unit for unit, _, _ in units(line)] == list(range(1, number + 1)), room
    assert failed, "at first nothing fits"
    assert len(north.plant.line.units(line.job.id if line.job else "")) == 6
    plant.close()


def test_a_home_out_of_an_old_backup_gives_no_unit_before_it_knows_those_given_since(tmp_path: Path) -> None:
    plant = Plant(tmp_path)
    west = plant.member("west", "line", "sign")
    plant.north.unlock()
    own = {"stations": {west.identity.fingerprint: 3}}
    job = take_job(west, job_of(plant.north, registry=plant.roster.registry, **own))
    west.unlock()
    build(LineRun(west, job), make_board(1))
    sync(west, FolderTransport(plant.stick))
    west.close()
    shutil.copytree(tmp_path / "west", tmp_path / "backup")
    with opened(tmp_path, "west") as homes:
        build(LineRun(homes["west"], job), make_board(2))
        sync(homes["west"], FolderTransport(plant.stick))
    with opened(tmp_path, "backup") as homes:
        back = homes["backup"]
        back.plant.begin_restored()
        line, third = LineRun(back, job), make_board(3)
        with pytest.raises(PolicyError, match="was restored from a backup"):
            build(line, third)
        assert units(line) == [(1, 1, 1)]
        sync(back, FolderTransport(plant.stick))
        assert units(line) == [(1, 1, 1), (2, 1, 1)]
        build(line, third)
        assert [unit for unit, _, _ in units(line)] == [1, 2, 3]
        with pytest.raises(PolicyError, match="one too many"):
            build(line, make_board(4))
    plant.north.close()


def test_an_office_out_of_an_old_backup_answers_no_request_before_it_knows_its_pages(tmp_path: Path) -> None:
    plant = Plant(tmp_path)
    plant.north.unlock()
    plant.north.plant.begin_restored()
    with pytest.raises(PolicyError, match="was restored from a backup"):
        answer(plant.north, b"")
    plant.sync(plant.north)
    assert answer(plant.north, b"") is None
    plant.north.close()


def test_an_office_out_of_an_old_backup_counts_the_units_and_answers_that_it_gave_since(tmp_path: Path) -> None:
    """Its own pages name job and unit of what it signed: the job allows no board more, a unit no further answers."""
    plant = Plant(tmp_path)
    west, office = plant.member("west", "line"), plant.member("office", "sign")
    west.unlock()
    own = {"stations": {west.fingerprint: 2}, "count": 2, "sign": office.fingerprint}
    document = job_of(plant.north, registry=plant.roster.registry, **own)
    plant.round()
    take_job(office, document)
    job = take_job(west, document)
    office.close()
    shutil.copytree(tmp_path / "office", tmp_path / "backup")
    with opened(tmp_path, "office") as homes:
        hand = LocalOffice(homes["office"])
        run = LineRun(west, job, office=hand)
        first_board, two = make_board(1), make_board(2)
        build(run, first_board)
        build(run, two)
        first = hand.asked[0]
        for number in range(MOST_ANSWERS - 2):
            again = proven(first, west, first_board, nonce=number.to_bytes(16, "big"))
            assert answered(homes["office"], west, again).security
        sync(homes["office"], FolderTransport(plant.stick))
    with opened(tmp_path, "backup") as homes:
        back = homes["backup"]
        back.plant.begin_restored()
        sync(back, FolderTransport(plant.stick))
        rows = back.plant.line.units(job.id)
        assert [(row.uuid, row.unit, row.attempts) for row in rows] == [
            (first_board.uuid, 1, MOST_ANSWERS - 1),
            (two.uuid, 2, 1),
        ]
        assert answered(back, west, a_request_for(make_board(3), first, west)).refused == "full"
        twin = Board(uuid=first_board.uuid)
        assert answered(back, west, a_request_for(twin, first, west)).refused == "other-key"
        last = proven(first, west, first_board, nonce=b"\xfe" * 16)
        assert answered(back, west, last).sequence == MOST_ANSWERS, "no sequence says two things"
        assert answered(back, west, proven(first, west, first_board, nonce=b"\xff" * 16)).refused == "full"
    plant.close()


def answered(office: Station, line: Station, request: SignRequest) -> Answer:
    """Return what an office says to a request that a line station signs as it stands."""
    octets = answer(office, seal_request(request, line.credentials().key))
    assert octets is not None
    return open_answer(octets, lambda kid: office.point)


def a_request_for(other: Board, request: SignRequest, line: Station) -> SignRequest:
    """Return the same for another board that lies there too."""
    signed = other.key.sign(node_key_message(other.uuid, other.key.point))
    image = Image(other.uuid, request.image.blocks)
    return proven(request, line, other, image=image, point=other.key.point, key_signature=signed)
