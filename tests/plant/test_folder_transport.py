"""A folder as a transport: which files are read and written, under which names, and what is left alone."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import pytest

from teds_provision.errors import LinkError
from teds_provision.plant import folder_transport
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.transport import CarriedPage, Parcel
from teds_provision.protocol.plant.document import hash_of

WEST, EAST = "bb" * 32, "ee" * 32
IDS = [f"{number:08x}-0000-4000-8000-000000000000" for number in range(20)]


@pytest.fixture
def stick(tmp_path: Path) -> Path:
    (tmp_path / "stick").mkdir()
    return tmp_path / "stick"


@pytest.fixture
def transport(stick: Path) -> FolderTransport:
    return FolderTransport(stick)


def put(path: Path, octets: bytes = b"x") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(octets)
    return path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


def test_a_folder_carries_everything_and_names_no_registry(transport: FolderTransport, stick: Path) -> None:
    assert (transport.carries_all, transport.where, transport.registry(), transport.returned) == (
        True, str(stick), None, None
    )  # fmt: skip
    with pytest.raises(LinkError, match="There is no folder"):
        FolderTransport(stick / "none")


def test_pages_are_read_by_number_and_other_files_are_not(transport: FolderTransport, stick: Path) -> None:
    for name in ("10.jws", "2.jws", "2.00112233445566aa.jws"):
        put(stick / WEST / name, f" page {name}\n".encode())
    for name in ("0.jws", "02.jws", "3.jws.part", "3.JWS", "3.0011.jws", "x.jws", "12345678901.jws", "\u0663.jws"):
        put(stick / WEST / name)
    (stick / WEST / "4.jws").symlink_to(put(stick / "elsewhere"))
    put(stick / "notes" / "5.jws")
    put(stick / EAST[:-1] / "7.jws")
    (stick / EAST).mkdir()
    assert list(transport.pages(WEST, 9)) == [
        CarriedPage(WEST, 2, b"page 2.00112233445566aa.jws"), CarriedPage(WEST, 2, b"page 2.jws"),
        CarriedPage(WEST, 10, b"page 10.jws"),
    ]  # fmt: skip
    assert transport.heads() == {WEST: 10}
    assert list(transport.pages(EAST, 0)) == []
    put(stick / ("cc" * 32))
    assert transport.heads() == {WEST: 10}, "a file where a station's folder would be"


def test_rosters_are_read_in_the_order_of_their_versions(transport: FolderTransport, stick: Path) -> None:
    put(stick / "roster" / "11.jws", b"eleven\n")
    put(stick / "roster" / "9.jws", b"nine")
    put(stick / "roster" / "readme.txt")
    assert list(transport.rosters()) == [b"nine", b"eleven"]


def test_a_file_larger_than_any_of_its_kind_is_left_alone(
    transport: FolderTransport, stick: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from types import SimpleNamespace

    monkeypatch.setattr(folder_transport, "PAGE", SimpleNamespace(most=10))
    put(stick / WEST / "1.jws", b"x" * 74)
    put(stick / WEST / "2.jws", b"y" * 75)
    assert [page.number for page in transport.pages(WEST, 0)] == [1]


def test_a_page_that_is_there_with_another_content_is_never_replaced(transport: FolderTransport, stick: Path) -> None:
    first, second, third = b"h.Zmlyc3Q.s", b"h.c2Vjb25k.s", b"h.dGhpcmQ.s"
    for _ in range(2):
        for octets in (first, second):
            transport.append(WEST, 3, "", hash_of(octets), octets)
    beside = f"3.{hash_of(second)[:16]}.jws"
    assert names(stick / WEST) == sorted(["3.jws", beside])
    assert ((stick / WEST / "3.jws").read_bytes(), (stick / WEST / beside).read_bytes()) == (first, second)
    assert (stick / WEST / "3.jws").stat().st_mode & 0o777 == 0o644
    (stick / WEST / "4.jws").symlink_to(stick / "nowhere")
    transport.append(WEST, 4, "", hash_of(third), third)
    assert (stick / WEST / f"4.{hash_of(third)[:16]}.jws").read_bytes() == third
    assert not (stick / "nowhere").exists()
    transport.post_roster(2, hash_of(b"roster"), b"roster")
    assert (stick / "roster" / "2.jws").read_bytes() == b"roster"


def test_a_page_that_another_program_wrote_with_blanks_around_it_is_the_same_page(
    transport: FolderTransport, stick: Path
) -> None:
    octets = b"h.Zmlyc3Q.s"
    put(stick / WEST / "3.jws", b"\r\n" + octets + b"\r\n")
    transport.append(WEST, 3, "", hash_of(octets), octets)
    assert names(stick / WEST) == ["3.jws"]


def test_parcels_lie_below_their_receiver(transport: FolderTransport, stick: Path) -> None:
    for number in range(18):
        transport.send(Parcel(IDS[number], WEST, b"sealed %d" % number, ""))
    transport.send(Parcel(IDS[0], WEST, b"another", ""))
    assert (stick / "to" / WEST / IDS[0]).read_bytes() == b"sealed 0"
    put(stick / "to" / WEST / "readme")
    put(stick / "to" / WEST / IDS[18].upper().replace("4000", "4ABC"))
    (stick / "to" / WEST / IDS[19]).symlink_to(put(stick / "elsewhere"))
    found = list(transport.parcels(WEST))
    assert [parcel.id for parcel in found] == IDS[:18]
    assert found[1] == Parcel(IDS[1], WEST, b"sealed 1", "")
    assert [parcel.id for parcel in transport.new_parcels(WEST, IDS[:1])] == IDS[1:17], "sixteen at once"
    assert list(transport.parcels(EAST)) == []
    transport.drop(IDS[0], WEST)
    transport.drop(IDS[0], WEST)
    assert [parcel.id for parcel in transport.new_parcels(WEST, ())] == IDS[1:17]


def test_a_stick_that_was_unplugged_is_not_made_again(transport: FolderTransport, stick: Path) -> None:
    shutil.rmtree(stick)
    with pytest.raises(LinkError, match="There is no folder"):
        transport.send(Parcel(IDS[0], WEST, b"x", ""))
    with pytest.raises(LinkError):
        transport.append(WEST, 1, "", hashlib.sha256(b"x").hexdigest(), b"x")
    assert not stick.exists()
    assert (transport.heads(), list(transport.rosters()), list(transport.parcels(WEST))) == ({}, [], [])
    transport.close()


def test_a_file_that_another_station_takes_away_meanwhile_is_none(
    transport: FolderTransport, stick: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(stick / "large").write_bytes(bytes(164))
    put(stick / "larger").write_bytes(bytes(165))
    assert transport._read(stick / "large", 100) == bytes(164)
    assert transport._read(stick / "larger", 100) is None
    assert transport._read(stick / "gone", 100) is None
    (stick / "link").symlink_to(stick / "large")
    assert transport._read(stick / "link", 100) is None
