"""``node create`` of a UUID that is known, and ``node run`` of wrapped nodes among others."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.cli.node import virtual_nodes
from teds_provision.errors import KnownUuidError, LinkError, NotFoundError, StoreError, UsageError
from teds_provision.node import node_template
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.wrapped.running import SensorPlace
from teds_provision.teds.image import Image
from teds_provision.teds.origin import Origin
from teds_provision.teds.profile import load_profile

UUID = bytes.fromhex("8d4d9da65281f7000000")
NODE = UUID.hex()


def image_file(folder: Path, uuid: bytes = UUID) -> Path:
    file = folder / f"{uuid.hex()}.json"
    file.write_text(Image(uuid, load_profile("gripper").build(uuid).blocks).to_json())
    return file


class Terminal:
    """Stands for the app of a command: a person who answers, and what is shown."""

    def __init__(self, home: Path, *, answer: bool | None) -> None:
        self.home, self.interactive, self._answer = home, answer is not None, answer
        self.questions, self.notes, self.warnings = list[str](), list[str](), list[str]()

    def ask_yes_no(self, question: str) -> bool:
        self.questions.append(question)
        return bool(self._answer)

    def note(self, text: str) -> None:
        self.notes.append(text)

    def warn(self, text: str) -> None:
        self.warnings.append(text)


def free_uuid(tmp_path: Path, answer: bool | None, *, uuid: bytes | None = None, new: bool = False) -> Any:
    """Return the terminal, and the UUID with which a node is made of a file."""
    terminal: Any = Terminal(tmp_path, answer=answer)
    return terminal, virtual_nodes._free_uuid(terminal, tmp_path / "n", uuid, image_file(tmp_path), new)


def test_a_uuid_that_is_known_is_asked_for_and_never_taken_over_without_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(virtual_nodes, "_known_as", lambda _app, uuid: "Node 'hand'" if uuid == UUID else None)
    terminal, uuid = free_uuid(tmp_path, answer=True)
    assert uuid not in (None, UUID)
    assert len(uuid) == 10
    assert terminal.questions == ["Create the node with a new UUID?"]
    assert terminal.notes == [
        f"Node 'hand' has the UUID {NODE} of {tmp_path / NODE}.json; two nodes with one UUID cannot be distinguished."
    ]
    with pytest.raises(KnownUuidError, match=r"Cancelled\. Nothing was created\.") as refused:
        free_uuid(tmp_path, answer=False)
    assert refused.value.hint == f"To make the copy anyway: --uuid {NODE}"
    with pytest.raises(KnownUuidError, match="has the UUID") as refused:
        free_uuid(tmp_path, answer=None)
    assert (refused.value.exit_code, refused.value.code) == (6, "uuid-known")
    for answer in (None, False):
        terminal, uuid = free_uuid(tmp_path, answer=answer, uuid=UUID)
        assert (uuid, terminal.questions) == (UUID, []), "who names it means it"
        assert terminal.warnings == [
            "Node 'hand' has this UUID: two nodes with one UUID cannot be distinguished. Run only one of them."
        ]
        terminal, uuid = free_uuid(tmp_path, answer=answer, new=True)
        assert (uuid != UUID, len(uuid), terminal.questions) == (True, 10, [])
    other = bytes(range(10))
    terminal, uuid = free_uuid(tmp_path, answer=None, uuid=other)
    assert (uuid, terminal.warnings) == (other, [])


def test_a_uuid_that_nobody_knows_is_the_files_and_one_that_was_made_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(virtual_nodes, "_known_as", lambda _app, _uuid: None)
    assert free_uuid(tmp_path, answer=None)[1] is None
    node_template.create(tmp_path / "n", teds=image_file(tmp_path))
    monkeypatch.setattr(virtual_nodes, "_known_as", lambda _app, _uuid: "Node 'hand'")
    assert free_uuid(tmp_path, answer=None)[1] is None, "the same command again"
    assert free_uuid(tmp_path, answer=None, new=True)[1] == UUID, "also one that asked for a new UUID before"


def test_a_node_is_known_to_the_station_or_on_a_link_of_its_running_ncap(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = SimpleNamespace(name="hand")
    station: Any = SimpleNamespace(
        overview=SimpleNamespace(is_known=lambda uuid: uuid != UUID),
        nodes=SimpleNamespace(get=lambda uuid: known if uuid == b"a" else None),
    )
    app: Any = SimpleNamespace(home=home, station=lambda: station)
    assert virtual_nodes._known_as(app, b"a") == "Node 'hand'"
    known.name = ""
    assert virtual_nodes._known_as(app, b"a") == "A node of this station"
    assert virtual_nodes._known_as(app, b"b") == "A node of this station"
    assert virtual_nodes._known_as(app, UUID) is None
    asked: list[str] = []
    connected = SimpleNamespace(connect=lambda home: SimpleNamespace(node=asked.append))
    monkeypatch.setattr(virtual_nodes, "client", connected)
    assert virtual_nodes._known_as(app, UUID) is None
    (home / "ncap.sock").touch()
    assert virtual_nodes._known_as(app, UUID) == "A node on a link of the running ncap"
    assert asked == [NODE]
    assert virtual_nodes._known_as(SimpleNamespace(home=home / "none", station=None), UUID) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(("kind", "source"), [("dbc", "dbc:FILE"), ("eds", "canopen:FILE"), ("iio", "iio:DEVICE")])
def test_a_wrapped_node_among_others_gives_no_made_up_values(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: Any, source: str
) -> None:
    origins = iter([None, Origin(kind, "Torque", "ab" * 32 if kind != "iio" else "")])
    monkeypatch.setattr(virtual_nodes.teds_room.origin, "origin_of", lambda _blocks: next(origins))
    none: Any = None
    for name in ("plain", "torque"):
        FlashFile.create(tmp_path / name)
    with pytest.raises(UsageError, match="so --source noise cannot give its values") as refused:
        virtual_nodes._wrapped(none, none, [tmp_path / "plain", tmp_path / "torque"], SensorPlace("noise"))
    assert refused.value.hint == f"Use --source {source}."
    assert str(tmp_path / "torque") in refused.value.message


def test_neither_a_broken_store_nor_an_ncap_that_does_not_know_it_hinders_a_node(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken() -> Any:
        raise StoreError("The disk is away.")

    app: Any = SimpleNamespace(home=home, station=broken)
    assert virtual_nodes._known_as(app, UUID) is None
    (home / "ncap.sock").touch()
    for error in (NotFoundError("No such node."), LinkError("It has just ended."), None):

        def node(_uuid: str, error: Exception | None = error) -> None:
            if error is not None:
                raise error

        monkeypatch.setattr(
            virtual_nodes, "client", SimpleNamespace(connect=lambda home, node=node: SimpleNamespace(node=node))
        )
        known = None if error is not None else "A node on a link of the running ncap"
        assert virtual_nodes._known_as(app, UUID) == known
