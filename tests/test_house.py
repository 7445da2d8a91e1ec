"""What holds of the house: no circle between files, imports on top.

How long, deep or full anything is, `make house` prints; no limit stands here. A limit divides functions and files where
their parts have no name worth knowing.
"""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from benchmarks import short
from tests.parsed import parsed, walked

ROOT = Path(__file__).parent.parent

LATE_IMPORTS = {
    "__main__.py": 2,  # Ctrl-C while Python imports the command line ends with 130 as later
}
"""Imports of our own inside functions, by file."""

_LISTS = "commands that only list need no cryptography and no codec of the TEDS"
LATE_MODULES = {
    "cli/config_file.py": "--help reads no file",
    "cli/context.py": "--help opens no station; a base station may not run; plain output has no rich",
    "cli/main.py": "for one command, for completion, for errors about a file",
    "cli/measure/measure.py": "numpy and the sinks: not for --help and not for JSON",
    "cli/measure/record.py": "numpy and the sinks: not for --help and not for JSON",
    "cli/node/build.py": "only in front of an operator",
    "cli/node/provision.py": "only in front of an operator",
    "cli/node/show.py": "cryptography: only for a handover bundle",
    "cli/node/virtual_nodes.py": "HTTP, links and hardware: only for nodes that run",
    "cli/options.py": "HTTP, Foxglove, traces, links, the codec: most runs use none of them",
    "cli/service/ncap.py": "the service: only for ncap run",
    "cli/shell_completion.py": "commands, options and files are completed without the store",
    "cli/station/init.py": "bundles and receipts: only for the CA of another station",
    "cli/station/log.py": "traces: only where one is merged in",
    "doctor/links.py": "nfcpy and pyserial: only if such a link was given",
    "measure/sinks/ros/ros2.py": "cyclonedds: an extra",
    "plant/commands/line.py": "jobs and requests: not for `evidence verify`",
    "plant/doctor.py": "cryptography: only for a station that joined a registry",
    "plant/verify_evidence.py": "the store and the roster, which nothing else there needs",
    "provisioning/inventory.py": "cryptography: not for a list of unverified nodes",
    "station/plant/plant.py": _LISTS,
    "station/policy.py": _LISTS,
    "station/station.py": "sockets and processes: `nodes` opens no vault",
    "teds/calibration/files.py": "lxml: not for a calibration that is no certificate",
    "vault/selection.py": "argon2, keyring and python-pkcs11: a station has one of them",
}
"""Files that load a module of ours at its first use, by `late`, and what that spares a command that people wait for."""

LATE_ROOMS = {
    "check", "demo", "describe", "measure", "measure/recordings", "node",
    "plant", "provisioning", "teds", "teds/calibration",
}  # fmt: skip
"""Rooms that give their modules at the first use (PEP 562): users name a room where a module would slow --help."""

_WIRED = "a part of the daemon, wired up once in daemon.py: each argument is another part or a setting"
MANY_PARAMETERS = {
    "client.py provision": "the members of the request body, as keywords of the public client",
    "ncap/nodes/provisioning.py begin": "the members of that request body",
    "node/nfc/server.py __init__": "the tag's pace and sizes, each set by itself in tests of a link",
    "ncap/measurement_supervisor.py __init__": _WIRED,
    "ncap/nodes/link_watch.py __init__": _WIRED,
    "provisioning/sign.py sign": "what a signature depends on, which each caller has from another place",
    "provisioning/write.py _conclude": "what one durable write of the store holds",
    "measure/topic_actuators.py __init__": "the session, the streams' clock and lock, and the two ways of an answer",
    "measure/capture.py capture_at": "a command's arguments, as each function of that name has them",
}
"""Functions of more than eight parameters, and why; those of a command are its options."""


@pytest.fixture(scope="module")
def house() -> ModuleType:
    spec = importlib.util.spec_from_file_location("house", ROOT / "scripts" / "house.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["house"] = module  # where its dataclasses look for their annotations
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def modules(house: ModuleType) -> dict[str, object]:
    return dict(house.modules(walked))


def test_no_files_import_each_other(house: ModuleType, modules: dict[str, Any]) -> None:
    """Imports inside functions and for type checkers count too."""
    assert not house.circles({name: module.imports for name, module in modules.items()})


def test_imports_of_our_own_stand_on_top(house: ModuleType, modules: dict[str, object]) -> None:
    found = Counter(place.rpartition(":")[0] for place in house.late_imports(modules))
    more = [f"{file}: {count}" for file, count in found.items() if count > LATE_IMPORTS.get(file, 0)]
    assert not more, "import on top, through the room if it must load late (CONTRIBUTING.md, The house)"


def test_modules_of_ours_are_loaded_late_only_for_a_named_reason() -> None:
    package = ROOT / "teds_provision"
    texts = {path.relative_to(package): path.read_text("utf-8") for path in package.rglob("*.py")}
    late = {str(path) for path, text in texts.items() if 'late("teds_provision' in text}
    rooms = {str(path.parent) for path, text in texts.items() if path.name == "__init__.py" and "= lazy(" in text}
    assert (late, rooms) == (set(LATE_MODULES), LATE_ROOMS), "import on top; else give the reason here"


def many_parameters(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Yield the functions of more than eight parameters that are no commands."""
    for node in nodes:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            names = [parameter.arg for parameter in every if parameter.arg not in ("self", "cls")]
            if len(names) > 8 and not any("command(" in ast.unparse(part) for part in node.decorator_list):
                yield node.name


def test_more_than_eight_parameters_have_a_reason(modules: dict[str, Any]) -> None:
    folder = ROOT / "teds_provision"
    found = {
        f"{module.path.relative_to(folder)} {name}"
        for module in modules.values()
        for name in many_parameters(module.nodes)
    }
    assert found - MANY_PARAMETERS.keys() == set(), "hand over one object that has a name, or state the reason above"
    assert MANY_PARAMETERS.keys() - found == set(), "they have fewer now"


def test_scripts_of_the_page_import_each_other_one_way(house: ModuleType) -> None:
    found = house.scripts()
    assert found["views/node.js"], "the scripts' imports are not read"
    assert house.circles(found) == []


def test_no_sources_of_the_c_library_include_or_call_each_other_in_a_circle(house: ModuleType) -> None:
    found = house.c_sources()
    assert {"slots", "session", "stream", "commands", "can"} <= found.keys(), "the sources are not read"
    assert {"replies", "links", "isotp"} <= found["can"], "includes are not read"
    assert "ble" in found["tnep"], "a call of teds/node.h is not read"
    assert house.circles(found) == []
    lowest = {"octets", "clock", "ndef", "isotp", "security_teds", "crypto", "area"}
    assert {name: found[name] for name in lowest if found[name] - lowest} == {}, "the lowest ones know no upper one"


def test_the_readme_lists_the_sources_of_the_c_library_from_the_bottom_up(house: ModuleType) -> None:
    text = (ROOT / "firmware" / "README.md").read_text(encoding="utf-8").partition("uses only what stands above")[2]
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    order = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    found = house.c_sources()
    assert sorted(order) == sorted(found)
    too_low = [f"{name}: {used}" for name in order for used in found[name] - set(order[: order.index(name)])]
    assert too_low == []


def test_each_source_of_the_c_library_has_its_own_header_and_unique_names(house: ModuleType) -> None:
    headers = {path.stem for path in (ROOT / "firmware" / "src").glob("*.h")}
    assert house.c_sources().keys() - headers == {"node", "t4t"}, "their interface is the boards' alone, in teds/node.h"
    assert headers - house.c_sources().keys() == {"inside"}, "a header without a source"
    assert house.c_shared_names() == [], "a backtrace tells which file it was"


def test_json_of_strangers_is_decoded_in_one_place(modules: dict[str, Any]) -> None:
    """A second decoder would take equal names, or refuse them in a way of its own."""
    own = {
        name
        for name, module in modules.items()
        for node in module.nodes
        if "object_pairs_hook" in (getattr(node, "arg", ""), getattr(node, "value", ""))
    }
    assert own == {"teds_provision.json_decoder"}


def rooms_named(nodes: Iterable[ast.AST], rooms: set[str]) -> dict[str, str]:
    """Return the names that stand for a room in this file, with its dotted name."""
    found: dict[str, str] = {}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module:
            dotted = {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name: room for name, room in dotted.items() if room in rooms}
    return found


def loaded_at_run_time(tree: ast.AST) -> Iterator[str]:
    """Yield what a file imports when it runs: nothing of ``if TYPE_CHECKING``. No expression imports anything."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.expr):
            continue
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            yield from loaded_at_run_time(ast.Module(node.orelse, []))
            continue
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from (node.module, *(f"{node.module}.{alias.name}" for alias in node.names))
        yield from loaded_at_run_time(node)


def test_a_module_that_is_reached_through_its_room_is_imported() -> None:
    """``can.server`` works without an import if something else loaded it first, or if the room loads late."""
    package = ROOT / "teds_provision"
    files = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in package.rglob("*.py")}
    rooms = {name.removesuffix(".__init__") for name in files if name.endswith(".__init__")}
    late = {room for room in rooms if room.partition(".")[2].replace(".", "/") in LATE_ROOMS}
    missing = []
    for path in files.values():
        named = rooms_named(walked(path), rooms)
        loaded = {*loaded_at_run_time(parsed(path))} if named else set()
        for node in walked(path) if named else ():
            first, *rest = dotted_names(node)
            room = named.get(first, "")
            for part in rest if room else ():
                module = f"{room}.{part}"
                if module not in files and module not in rooms:
                    break
                if room not in late and module not in loaded and module not in loaded_by_a_room(files, room):
                    missing.append(f"{path.relative_to(ROOT)}:{node.lineno} needs {module}")
                room = module
    assert not missing


def dotted_names(node: ast.AST) -> list[str]:
    """Return the parts of ``a.b.c``; one empty part for anything else."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return [node.id, *reversed(parts)] if parts and isinstance(node, ast.Name) else [""]


def loaded_by_a_room(files: dict[str, Path], room: str) -> set[str]:
    """Return what the ``__init__`` of a room imports when it runs; nothing for a module."""
    path = files.get(f"{room}.__init__")
    return {*loaded_at_run_time(parsed(path))} if path is not None else set()


def test_every_benchmark_has_a_short_run() -> None:
    assert short.unlisted() == []
