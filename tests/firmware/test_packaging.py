"""What a project that builds the C library into its board relies on: headers, reference, licence lines, version."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

import teds_provision
from tests.firmware import builds

pytestmark = pytest.mark.system

PUBLIC = ("teds/version.h", "teds/config.h", "teds/port.h", "teds/node_state.h", "teds/node.h", "teds_bearssl.h")
PUBLIC += ("teds_psa.h", "teds_zephyr.h")
FOLDERS = ("include", "port/bearssl", "port/psa", "port/zephyr")
NUMBERS = re.compile(r"#define TEDS_VERSION_(?:MAJOR|MINOR|PATCH) (\d+)")


def run(*words: str, given: str = "", folder: Path | None = None, code: int = 0) -> str:
    """Run a command: what it printed."""
    done = subprocess.run(words, input=given, capture_output=True, text=True, check=False, cwd=folder)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def version() -> str:
    """The version of the C library, from its header."""
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
    where = [f"-I{builds.FIRMWARE / folder}" for folder in (*FOLDERS, "src")]
    sources = [*sorted((builds.FIRMWARE / "src").glob("*.c")), builds.FIRMWARE / "port/bearssl/teds_bearssl.c"]
    run("gcc", "-std=c99", "-O0", *where, "-c", *map(str, sources), folder=tmp_path)
    main = tmp_path / "main.cpp"
    main.write_text(
        '#include "teds/node.h"\n#include "teds_bearssl.h"\n'
        "static teds_node node; static teds_config config; static teds_port port; static teds_bearssl crypto;\n"
        "int main() {\n"
        "    if (teds_bearssl_fill(&port, &crypto) != -1 || teds_node_init(&node, &config, &port) != TEDS_E_USAGE)\n"
        "        return 1;\n"
        "    return teds_node_init_as_built(&node, teds_built() + 1, &config, &port) == TEDS_E_BUILD ? 0 : 2;\n}\n"
    )
    objects = sorted(map(str, tmp_path.glob("*.o")))
    run("g++", "-std=c++11", *where, str(main), *objects, "-lbearssl", "-o", "program", folder=tmp_path)
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
    files = [path for path in files if path.suffix not in (".md", ".json")]
    assert len(files) > 80
    for path in files:
        assert "SPDX-License-Identifier: Apache-2.0" in path.read_text(encoding="utf-8")[:200], path


def test_the_library_has_the_version_of_the_project() -> None:
    text = (builds.FIRMWARE / "include/teds/version.h").read_text(encoding="utf-8")
    whole = teds_provision.__version__
    assert re.match(r"\d+\.\d+\.\d+", whole)[0] == version()  # type: ignore[index]
    assert f'"{version()}{"-dev" if "dev" in whole else ""}"' in text
    assert version() in (builds.FIRMWARE / "CHANGELOG.md").read_text(encoding="utf-8")
