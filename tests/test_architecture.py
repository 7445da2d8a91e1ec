"""The rules of docs/architecture.md: which room imports which, and what is loaded late."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path

import pytest

from teds_provision.optional_rooms import OPTIONAL, Hook, load, rooms
from tests.parsed import parsed, walked

PACKAGE = Path(__file__).parent.parent / "teds_provision"
MODULES = sorted(PACKAGE.rglob("*.py"))

# Room: the rooms that it may import. All may import those of _FOR_ALL and itself; all but protocol also files,
# portable and one_core.
_FOR_ALL = {"errors", "sanitize", "lazy", "arrays", "limits", "json_decoder", "optional_rooms"}
WITHOUT_FILES = {
    "errors",
    "sanitize",
    "lazy",
    "arrays",
    "limits",
    "portable",
    "one_core",
    "protocol",
    "json_decoder",
    "optional_rooms",
}
_BELOW_PROVISIONING = {"station", "links", "vault", "protocol", "teds", "shapes"}
ARROWS = {
    "shapes": set(),
    "api": {"shapes"},
    "errors": set(),
    "files": set(),
    "portable": set(),
    "one_core": set(),
    "sanitize": set(),
    "lazy": set(),
    "arrays": set(),
    "limits": set(),
    "optional_rooms": set(),
    "json_decoder": set(),
    "firmware_image": set(),
    "teds": set(),
    "protocol": {"teds"},
    "links": {"protocol", "teds"},
    "vault": {"protocol", "teds"},
    "station": {"vault", "protocol", "teds", "shapes"},
    "node": {"links", "protocol", "teds", "firmware_image"},
    "trace": {"links", "protocol", "teds"},
    "provisioning": _BELOW_PROVISIONING | {"firmware_image"},
    "handover": _BELOW_PROVISIONING | {"provisioning"},
    "measure": _BELOW_PROVISIONING | {"provisioning", "handover"},
    "client": {"api", "shapes"},
    "describe": _BELOW_PROVISIONING | {"provisioning", "handover", "measure", "api"},
    "ncap": _BELOW_PROVISIONING
    | {"provisioning", "handover", "measure", "node", "client", "api", "describe"}
    | {"firmware_image"},
    "backup": {"station", "vault", "protocol", "teds"},
    "doctor": {"station", "links", "vault", "protocol", "teds"},
    "demo": _BELOW_PROVISIONING | {"provisioning", "handover", "measure", "client"},
    "cli": _BELOW_PROVISIONING
    | {"provisioning", "handover", "backup", "doctor", "demo", "node", "measure", "ncap", "client", "api"}
    | {"trace", "describe", "firmware_image"},
    "__main__": {"cli"},
}
ARROWS |= {room: set(ARROWS) - {"__main__"} for room in OPTIONAL}  # above all others, and not one above another
# Too slow to load before they are needed: --help, --version and a pure decode must not wait for them.
HEAVY = {"nfc", "ndef", "can", "isotp", "keyring", "rich", "cryptography", "pint", "numpy", "matplotlib", "pkcs11"}
HEAVY |= {"mcap", "cyclonedds", "paho", "starlette", "uvicorn", "websockets"}
HEAVY |= {"bleak", "bumble", "dbus_fast", "psycopg", "pyarrow", "pandas", "cantools", "canopen", "lxml", "signxml"}
HEAVY |= {"imgtool", "smp", "cbor2", "pydantic"}
PURE = ("protocol", "teds")
IO = {"socket", "sqlite3", "subprocess", "threading", "time", "click", "serial"}


def name_of(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


def room_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else path.stem


def imports(nodes: Iterable[ast.AST]) -> Iterator[tuple[str, int]]:
    """Yield every module that is imported by one of the nodes, with its line; `from x import y` counts as x.y too."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield from ((f"{node.module}.{alias.name}", node.lineno) for alias in node.names)


@cache
def imports_of(path: Path) -> list[tuple[str, int]]:
    """Return what a module of the package imports; five rules ask."""
    return list(imports(walked(path)))


def may_import(room: str) -> set[str]:
    files = set() if room in WITHOUT_FILES else {"files", "portable", "one_core"}
    return ARROWS[room] | files | {room, *_FOR_ALL, "__version__"}


def test_arrows_between_rooms_point_one_way() -> None:
    wrong = [
        f"{name_of(path)}:{line} imports {name}, which {room_of(path)} may not"
        for path in MODULES
        if room_of(path) != "__init__"
        for name, line in imports_of(path)
        if name.startswith("teds_provision.") and name.split(".")[1] not in may_import(room_of(path))
    ]
    assert not wrong


def test_importing_the_package_imports_none_of_its_rooms() -> None:
    assert not [name for name, _ in imports(walked(PACKAGE / "__init__.py")) if name.startswith("teds_provision")]


def file_of(name: str) -> Path | None:
    """File of ours that a dotted name stands for or stands in: a module, a package, or a name in either."""
    for dotted in (name, name.rpartition(".")[0]):
        path = PACKAGE.parent / dotted.replace(".", "/")
        for file in (path.with_suffix(".py"), path / "__init__.py"):
            if file.is_file():
                return file
    return None


def test_the_rooms_are_those_of_the_page() -> None:
    there = {room_of(path) for path in MODULES} - {"__init__"}
    assert there | set(OPTIONAL) == set(ARROWS)
    assert {room for room in OPTIONAL if room in there} == set(rooms())


def test_what_a_room_names_it_gives() -> None:
    """A name stands in `__all__` and in the table of `lazy()`: whoever forgets one of them is told here."""
    rooms = [path.parent.relative_to(PACKAGE.parent) for path in MODULES if path.name == "__init__.py"]
    loaded = [importlib.import_module(".".join(room.parts)) for room in rooms]
    named = {room: getattr(room, "__all__", ()) for room in loaded}
    assert not [f"{room.__name__}.{name}" for room, names in named.items() for name in names if not hasattr(room, name)]
    assert sum(map(bool, named.values())) >= 5


def test_no_arrow_of_the_table_makes_a_circle() -> None:
    def reachable(room: str, seen: frozenset[str]) -> set[str]:
        assert room not in seen, f"circle through {room}"
        return {room}.union(*(reachable(next_room, seen | {room}) for next_room in ARROWS[room]))

    for room in ARROWS:
        assert reachable(room, frozenset()) <= set(ARROWS)


def test_protocol_and_teds_do_no_io() -> None:
    wrong = [
        f"{name_of(path)}:{line} imports {name}"
        for path in MODULES
        if room_of(path) in PURE
        for name, line in imports_of(path)
        if name.split(".")[0] in IO
    ]
    assert not wrong


@pytest.mark.parametrize(
    "statement",
    [
        "import teds_provision.teds",
        "from teds_provision.__main__ import main; import sys; sys.argv[1:] = ['--version']; main()",
        "from teds_provision.cli.main import run; run(['--help'])",
    ],
)
def test_what_must_be_quick_loads_nothing_heavy(statement: str) -> None:
    ask = f"import sys\ntry:\n    exec({statement!r})\nfinally:\n    print('LOADED', *sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, timeout=60, check=False)
    loaded = done.stdout.split("LOADED")[1].split()
    assert not HEAVY.intersection(loaded), statement


@pytest.mark.parametrize("module", ["provisioning.provision", "teds.sheet", "teds.formats", "teds.diff", "teds.fits"])
def test_numbers_without_a_calibration_need_no_numpy(module: str) -> None:
    ask = f"import sys, teds_provision.{module}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, timeout=60, check=True)
    assert not {"numpy", "pint", "matplotlib"}.intersection(done.stdout.split())


_AT_A_NODE = ("at_node", "build", "provision", "verify", "whitelist")
# Acts of a module beyond one for each of its commands: write --from brings back, --dry-run plans, verify takes files,
# lists are planned, provision --firmware keys the board first.
_MORE_ACTS = {"build": 2, "provision": 1, "verify": 2, "whitelist": 9}
_ROOMS_THAT_ACT = ("provisioning", "links", "handover", "backup")


def room_of_name(dotted: str) -> str:
    return dotted.split(".")[1] if dotted.count(".") else ""


def named(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield what is named of our modules, as (module, name): imported by name, or reached through its room."""
    rooms: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("teds_provision"):
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                file = file_of(full)
                if file and file.stem == "__init__" and file.parent.name == alias.name:
                    rooms[alias.asname or alias.name] = full
                else:
                    yield node.module, alias.name
    for node in ast.walk(tree):
        words = ast.unparse(node).split(".") if isinstance(node, ast.Attribute) else []
        if words and words[0] in rooms and file_of(".".join([rooms[words[0]], *words[1:-1]])):
            module, file = ".".join([rooms[words[0]], *words[1:-1]]), file_of(".".join([rooms[words[0]], *words[1:]]))
            if file and file.stem == module.split(".")[-1]:
                yield module, words[-1]


def test_a_command_at_a_node_is_one_call_of_one_step() -> None:
    """A command that provisions takes one function of the rooms below; meetings, sessions and locks are not its own."""
    for path in (PACKAGE / "cli" / "node" / f"{name}.py" for name in _AT_A_NODE):
        tree = parsed(path)
        commands = sum(
            isinstance(node, ast.FunctionDef) and any("command(" in ast.unparse(part) for part in node.decorator_list)
            for node in ast.walk(tree)
        )
        acts = {
            (module.removeprefix("teds_provision."), name)
            for module, name in named(tree)
            if room_of_name(module) in _ROOMS_THAT_ACT and name[0].islower()
        }
        assert len(acts) <= commands + _MORE_ACTS.get(path.stem, 0), f"{path.name}: {sorted(acts)}"
        conversing = ("links", "provisioning.meeting", "provisioning.conversation")
        assert not {module for module, _ in acts if module.startswith(conversing)}, path.name


# Who has one of them can read and write any row; the rest of the folder is records, locks and the audit log.
_FILE = {"Store", "Database", "Connection", "dump", "load", "statements"}
_OF_THE_FILE = {"_store", "_database", "tables", *_FILE}


def _is_the_file(node: ast.Attribute) -> bool:
    if node.attr == "_store":
        return getattr(node.value, "id", "") != "self"
    return node.attr in _OF_THE_FILE and ast.unparse(node.value).rpartition(".")[2] in ("station", "store", "plant")


def test_nothing_above_the_station_gets_its_tables() -> None:
    """Its topics (identity, keys, pins, policy …) are the doors: each has its rows, and none hands out the file."""
    above = [path for path in MODULES if room_of(path) != "station"]
    imported = [
        f"{name_of(path)}:{line} imports {name}"
        for path in above
        for name, line in imports_of(path)
        if name.startswith("teds_provision.station.store.") and name.rpartition(".")[2] in _FILE
    ]
    reached = [
        f"{name_of(path)}:{node.lineno} {ast.unparse(node)}"
        for path in above
        for node in walked(path)
        if isinstance(node, ast.Attribute) and _is_the_file(node)
    ]
    assert not imported + reached


def test_each_table_is_written_by_one_topic() -> None:
    """A rule about rows is in the class that writes them; the folder ``store`` makes and copies tables."""
    written: dict[str, set[str]] = {}
    for path in MODULES:
        if room_of(path) != "station" or "/store/" in f"/{name_of(path)}" or path.stem == "snapshot":
            continue
        for node in walked(path):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                unnamed = re.search(r"\b(?:INTO|UPDATE|DELETE FROM) $", node.value)  # of an f-string: any table
                assert unnamed is None, f"{name_of(path)}:{node.lineno} names no table"
                for table in re.findall(r"\b(?:INSERT(?: OR \w+)? INTO|UPDATE(?! SET)|DELETE FROM) (\w+)", node.value):
                    written.setdefault(table, set()).add(name_of(path))
    assert len(written) > 40
    shared = {table: files for table, files in written.items() if len(files) > 1 and table != "meta"}
    assert not shared


_KNOWS_NO_LINK = ("measure", "ncap")
_LINK_FOLDERS = tuple(sorted(path.name for path in (PACKAGE / "links").iterdir() if (path / "__init__.py").is_file()))


@cache
def classes_of_links() -> frozenset[str]:
    """Return names of the classes in the folder of each link: CanPort, BleLink …."""
    files = [path for name in _LINK_FOLDERS for path in (PACKAGE / "links" / name).rglob("*.py")]
    named = (node.name for path in files for node in walked(path) if isinstance(node, ast.ClassDef))
    return frozenset(name for name in named if name.lower().startswith(_LINK_FOLDERS))


def places_that_know_a_link(nodes: Sequence[ast.AST]) -> Iterator[tuple[int, str]]:
    """Yield each place that distinguishes links: an import from its folder, its class, or its name."""
    names = {f"{name}{end}" for name in _LINK_FOLDERS for end in ("", ":")}

    def is_named(part: ast.AST) -> bool:
        return any(isinstance(node, ast.Constant) and node.value in names for node in ast.walk(part))

    for name, line in imports(nodes):
        parts = name.split(".")
        if parts[:2] == ["teds_provision", "links"] and len(parts) > 2 and parts[2] in _LINK_FOLDERS:
            yield line, f"imports {name}"
    for node in nodes:
        match node:
            case ast.Compare() if is_named(node):
                yield node.lineno, f"compares {ast.unparse(node)}"
            case ast.Call(func=ast.Attribute(attr="startswith" | "removeprefix"), args=[part]) if is_named(part):
                yield node.lineno, f"compares {ast.unparse(node)}"
            case ast.MatchValue() if is_named(node):
                yield node.lineno, f"matches {ast.unparse(node)}"
            case ast.Name(id=name) | ast.Attribute(attr=name) if name in classes_of_links():
                yield node.lineno, f"names {name}"


def test_measure_and_ncap_know_a_link_by_its_capabilities_alone() -> None:
    """A link that streams is a MeasuringLink, and no file above `links` has to change for it (docs/extending.md)."""
    assert len(_LINK_FOLDERS) >= 3
    wrong = [
        f"{name_of(path)}:{line} {what}"
        for path in MODULES
        if room_of(path) in _KNOWS_NO_LINK
        for line, what in places_that_know_a_link(walked(path))
    ]
    assert not wrong


@pytest.mark.parametrize(
    "code",
    [
        "from teds_provision.links.can.port import CanPort",
        "from teds_provision.links import ble",
        "isinstance(port, ports.BlePort)",
        "links.via == 'can'",
        "port.via in ('nfc', 'ble')",
        "place.startswith('can:')",
        "place.startswith(('nfc:', 'ble:'))",
        "match place.partition(':')[0]:\n    case 'can':\n        pass",
    ],
)
def test_each_way_to_know_a_link_is_seen(code: str) -> None:
    assert list(places_that_know_a_link([*ast.walk(ast.parse(code))]))


def test_no_room_of_the_core_imports_an_optional_room() -> None:
    """Nor does it name a module of one: what a room adds, it registers (docs/extending.md)."""
    dotted = re.compile(rf"teds_provision\.({'|'.join(OPTIONAL)})\b")
    core = [path for path in MODULES if room_of(path) not in OPTIONAL]
    imported = [
        f"{name_of(path)}:{line} imports {name}"
        for path in core
        for name, line in imports_of(path)
        if name.startswith("teds_provision.") and name.split(".")[1] in OPTIONAL
    ]
    late = [
        f"{name_of(path)}:{node.lineno} names {node.value}"
        for path in core
        for node in walked(path)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and dotted.match(node.value)
    ]
    assert not imported + late


def test_what_a_room_registers_is_there_and_asked_for() -> None:
    from teds_provision.cli.table import COMMANDS

    for name, room in rooms().items():
        for row in (row for rows in room.sections.values() for row in rows.values()):
            assert load(name, f"{row.module}:{row.attribute}")
        for place in (*room.extends.values(), *room.hooks.values()):
            assert load(name, place), place
        assert set(room.extends) | set(room.helps) <= set(COMMANDS)
        assert room.groups <= set(COMMANDS)
    asked = {
        node.args[0].value
        for path in MODULES
        if room_of(path) not in OPTIONAL
        for node in walked(path)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == Hook.__name__
        if isinstance(node.args[0], ast.Constant)
    }
    assert {hook for room in rooms().values() for hook in room.hooks} <= asked
