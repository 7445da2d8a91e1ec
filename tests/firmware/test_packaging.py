"""What a project that builds the C library into its board relies on: headers, reference, licence lines, version."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from shutil import copy

import pytest

import teds_provision
from tests.firmware import builds

pytestmark = pytest.mark.system

PUBLIC = ("teds/version.h", "teds/config.h", "teds/port.h", "teds/node_state.h", "teds/node.h", "teds_bearssl.h")
PUBLIC += ("teds_psa.h", "teds_zephyr.h", "teds_esp32.h")
FOLDERS = ("include", "port/bearssl", "port/psa", "port/zephyr", "port/esp32")
NUMBERS = re.compile(r"#define TEDS_VERSION_(?:MAJOR|MINOR|PATCH) (\d+)")


def run(*words: str, given: str = "", folder: Path | None = None, code: int = 0) -> str:
    """Run a command: what it printed."""
    done = subprocess.run(words, input=given, capture_output=True, text=True, check=False, cwd=folder)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def version() -> str:
    """Return the version of the C library, from its header."""
    return ".".join(NUMBERS.findall((builds.FIRMWARE / "include/teds/version.h").read_text(encoding="utf-8")))


@pytest.mark.parametrize("standard", ["c++11", "c++20"])
@pytest.mark.parametrize("everything", [False, True])
def test_each_public_header_compiles_by_itself_and_together_as_cpp(standard: str, everything: bool) -> None:
    builds.need("g++")
    where = [f"-I{builds.FIRMWARE / folder}" for folder in FOLDERS]
    options = ["-DTEDS_NFC=1", "-DTEDS_BLE=1"] if everything else []
    words = ["g++", f"-std={standard}", "-Wall", "-Wextra", "-pedantic", "-Werror", *where, *options, "-xc++", "-"]
    for header in PUBLIC:
        run(*words, "-fsyntax-only", given=f'#include "{header}"\n')
    together = "".join(f'#include "{header}"\n' for header in PUBLIC)
    run(*words, "-fsyntax-only", given=together + together)


def test_a_cpp_program_links_with_the_library(tmp_path: Path) -> None:
    builds.need("g++", "gcc")
    objects, words = builds.objects(1024, 4096)  # of another test
    main = tmp_path / "main.cpp"
    main.write_text(
        '#include "teds/node.h"\n#include "teds_bearssl.h"\n'
        "static teds_node node; static teds_config config; static teds_port port; static teds_bearssl crypto;\n"
        "int main() {\n"
        "    if (teds_bearssl_fill(&port, &crypto) != -1 || teds_node_init(&node, &config, &port) != TEDS_E_USAGE)\n"
        "        return 1;\n"
        "    return teds_node_init_as_built(&node, teds_built() + 1, &config, &port) == TEDS_E_BUILD ? 0 : 2;\n}\n"
    )
    asked = [word for word in words if word != "-std=c99"]
    program = str(tmp_path / "program")
    command = ["g++", "-std=c++11", *asked, str(main), *map(str, objects), "-lbearssl", "-o", program]
    run(*command, folder=builds.FIRMWARE)
    run(str(tmp_path / "program"))


def test_the_crypto_context_has_to_be_what_user_points_to(tmp_path: Path) -> None:
    """`user` is handed to BearSSL's port as its context: one of another form must never be called through."""
    builds.need("gcc")
    main = tmp_path / "main.c"
    main.write_text(
        '#include "teds_bearssl.h"\n#include <stddef.h>\n'
        "static int dice(void *user, uint8_t *out, size_t length) { (void)user; (void)out; (void)length; return 0; }\n"
        "struct board { int first; teds_bearssl crypto; } board; struct { teds_bearssl crypto; int more; } good;\n"
        "int main(void) {\n"
        "    teds_port port = {0};\n"
        "    board.crypto.random = dice; port.user = &board;\n"
        "    if (teds_bearssl_fill(&port, &board.crypto) != -1 || port.p256_make != NULL) return 1;\n"
        "    port.user = &good;\n"
        "    if (teds_bearssl_fill(&port, &good.crypto) != -1 || teds_bearssl_fill(&port, NULL) != -1) return 2;\n"
        "    good.crypto.random = dice;\n"
        "    return teds_bearssl_fill(&port, &good.crypto) == 0 && port.p256_make != NULL ? 0 : 3;\n}\n"
    )
    where = [f"-I{builds.FIRMWARE / folder}" for folder in FOLDERS]
    source = str(builds.FIRMWARE / "port/bearssl/teds_bearssl.c")
    run("gcc", "-std=c99", *where, str(main), source, "-lbearssl", "-o", "program", folder=tmp_path)
    run(str(tmp_path / "program"))


def test_every_public_symbol_is_documented() -> None:
    """The reference is built from the headers; an undocumented symbol or a dead reference is an error."""
    builds.need("doxygen", headers=())
    builds.make("reference")
    page = (builds.BUILD / "reference/html/node_8h.html").read_text(encoding="utf-8")
    for function in ("teds_node_init", "teds_can_rx", "teds_nfc_written", "teds_ble_data", "teds_sensor_event"):
        assert function in page


def test_every_file_names_its_licence() -> None:
    files = [path for path in builds.FIRMWARE.rglob("*") if path.is_file() and "build" not in path.parts]
    files += (builds.ROOT / "tests/firmware/c").glob("*.[ch]")
    files = [path for path in files if path.suffix not in (".md", ".json", ".properties")]
    assert len(files) > 80
    for path in files:
        assert "SPDX-License-Identifier: Apache-2.0" in path.read_text(encoding="utf-8")[:200], path


def test_the_library_has_the_version_of_the_project() -> None:
    text = (builds.FIRMWARE / "include/teds/version.h").read_text(encoding="utf-8")
    whole = teds_provision.__version__
    assert re.match(r"\d+\.\d+\.\d+", whole)[0] == version()  # type: ignore[index]
    assert f'"{version()}{"-dev" if "dev" in whole else ""}"' in text
    assert version() in (builds.FIRMWARE / "CHANGELOG.md").read_text(encoding="utf-8")


CONSUMER = """cmake_minimum_required(VERSION 3.20)
project(board C)
{library}
set(folder {template})
add_executable(board ${{folder}}/main.c ${{folder}}/board.c)
target_link_libraries(board PRIVATE teds::node)
add_executable(sizes sizes.c)
target_link_libraries(sizes PRIVATE teds::node)
"""
SIZES = """#include "teds/node.h"
typedef char staging_is_that_of_the_cache[TEDS_STAGING == 8192 && TEDS_NFC == 1 ? 1 : -1];
static teds_node node; static teds_config config; static teds_port port;
int main(void) { return teds_node_init(&node, &config, &port) == TEDS_E_USAGE ? 0 : 1; }
"""
"""TEDS_E_USAGE and not TEDS_E_BUILD: board and library were compiled with the same sizes."""


def consumer(folder: Path, library: str) -> None:
    """Write a project that builds the blank port over the library as this CMake code names it."""
    folder.mkdir()
    template = builds.FIRMWARE / "port/template"
    (folder / "CMakeLists.txt").write_text(CONSUMER.format(library=library, template=template))
    (folder / "sizes.c").write_text(SIZES)


COMPILER = """#!/bin/sh
for word do
    case $word in *.c) name=${word##*/}; touch "${name%.c}.o";; esac
    [ "$before" != -o ] || touch "$word"
    before=$word
done
"""
"""What make sees of a compiler: an object of each source where it runs, and what is linked."""


def test_objects_of_sources_that_have_another_name_now_are_in_no_library(tmp_path: Path) -> None:
    """A renamed source was linked under both names: every symbol of it twice. A stand-in for the compiler is enough."""
    builds.need("make")
    compiler = tmp_path / "compiler"
    compiler.write_text(COMPILER)
    compiler.chmod(0o755)
    library, objects = tmp_path / "host" / "memory-1024-4096.so", tmp_path / "host" / "memory-1024-4096"

    def make() -> int:
        run("make", "-s", "-C", str(builds.FIRMWARE), f"BUILD={tmp_path}", f"CC={compiler}", str(library))
        return library.stat().st_mtime_ns

    first = make()
    assert make() == first, "nothing has changed"
    names = sorted(path.name for path in objects.iterdir())
    copy(objects / names[0], objects / "former.o")
    (tmp_path / "sources").write_text("src/former.c\n", encoding="utf-8")
    assert make() > first
    assert sorted(path.name for path in objects.iterdir()) == names


def test_a_project_finds_the_installed_library_by_cmake(tmp_path: Path) -> None:
    builds.need("cmake", "gcc")
    options = ["-DTEDS_STAGING=8192", "-DTEDS_NFC=1", "-DCMAKE_BUILD_TYPE=Debug"]
    run("cmake", "-S", str(builds.FIRMWARE), "-B", "library", *options, folder=tmp_path)
    run("cmake", "--build", "library", "-j2", folder=tmp_path)
    run("cmake", "--install", "library", "--prefix", str(tmp_path / "installed"), folder=tmp_path)
    consumer(tmp_path / "board", f"find_package(teds-node {version()} REQUIRED)")
    run("cmake", "-S", "board", "-B", "built", f"-DCMAKE_PREFIX_PATH={tmp_path / 'installed'}", folder=tmp_path)
    run("cmake", "--build", "built", folder=tmp_path)
    run(str(tmp_path / "built/sizes"))
    run(str(tmp_path / "built/board"), code=1)  # its flash fails: the blank port starts nothing

    wrong = run("cmake", "-S", str(builds.FIRMWARE), "-B", "wrong", "-DTEDS_CRYPTO=ROT13", folder=tmp_path, code=1)
    assert "TEDS_CRYPTO is BEARSSL, PSA or NONE, not ROT13." in wrong


def test_a_project_takes_the_library_into_its_tree_with_psa(tmp_path: Path) -> None:
    builds.need("cmake", "gcc", headers=("psa/crypto.h",))
    words = "set(TEDS_CRYPTO PSA)\nset(TEDS_STAGING 8192)\nset(TEDS_NFC 1)\n"
    consumer(tmp_path / "board", f"{words}add_subdirectory({builds.FIRMWARE} teds)")
    text = (tmp_path / "board/CMakeLists.txt").read_text().split("set(folder")[0]
    (tmp_path / "board/CMakeLists.txt").write_text(
        text + "add_executable(sizes sizes.c)\ntarget_link_libraries(sizes PRIVATE teds::node)\n"
    )
    run("cmake", "-S", "board", "-B", "built", folder=tmp_path)
    run("cmake", "--build", "built", "-j2", folder=tmp_path)
    run(str(tmp_path / "built/sizes"))


def test_bearssls_files_are_listed_once_and_are_there() -> None:
    """Makefile, CMakeLists.txt and ESP-IDF read one list, and one list of flags."""
    lists = builds.FIRMWARE / "port/bearssl"
    names = [line for line in (lists / "sources.txt").read_text().splitlines() if not line.startswith("#")]
    flags = [line for line in (lists / "flags.txt").read_text().splitlines() if not line.startswith("#")]
    assert "src/aead/ccm.c" in names
    assert "-DBR_USE_UNIX_TIME=0" in flags
    for path in [*builds.FIRMWARE.glob("*.mk"), *builds.FIRMWARE.rglob("CMakeLists.txt"), builds.FIRMWARE / "Makefile"]:
        text = path.read_text(encoding="utf-8")
        assert "ccm.c" not in text, path
        assert "BR_USE_" not in text, path
    source = builds.FIRMWARE / "build/bearssl"
    if source.exists():
        assert [name for name in names if not (source / name).exists()] == []


def test_the_blank_port_compiles_and_each_of_its_functions_has_a_comment() -> None:
    builds.need("gcc")
    folder = builds.FIRMWARE / "port/template"
    where = [f"-I{builds.FIRMWARE / name}" for name in ("include", "port/bearssl", "port/template")]
    warnings = ["-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic", "-Werror", "-fsyntax-only"]
    run("gcc", "-std=c99", *warnings, *where, str(folder / "main.c"), str(folder / "board.c"))
    lines = (folder / "board.c").read_text(encoding="utf-8").splitlines()
    heads = [at for at, line in enumerate(lines) if line == "{"]
    assert len(heads) > 18
    bare = [lines[at - 1] for at in heads if not lines[at - 2].endswith("*/")]
    assert bare == ["static uint64_t now(void *user)"], "a function without a comment on what it must do"
    port = (builds.FIRMWARE / "include/teds/port.h").read_text(encoding="utf-8")
    for name in (
        "erase",
        "write",
        "read",
        "random",
        "now",
        "sample",
        "bears",
        "set",
        "set_point",
        "safe",
        "arm",
        "kick",
    ):
        assert f"(*{name})(" in port
        assert f"port->{name} = " in "\n".join(lines), name
