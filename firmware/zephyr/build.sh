#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Build the module against a Zephyr tree: `make firmware-zephyr ZEPHYR=DIR`, DIR being the folder `zephyr` of a west workspace.
# First the load cell on native_sim, with its CAN; then both boards for the NUCLEO-G474RE, if an ARM toolchain is found.
# Without DIR, or without a tree there, it says so and ends with 0. In build/zephyr-*.
#   ZEPHYR_MODULES   the modules' folders, separated by ;, for a tree that is in no west workspace
#   ZEPHYR_TOOLCHAIN_VARIANT, ZEPHYR_SDK_INSTALL_DIR   as Zephyr has them; without them, arm-none-eabi-gcc
#   NATIVE           the board of the first build: native_sim (default), or native_sim/native/64 without 32-bit libraries
set -eu

zephyr=${1:-}
here=$(cd "$(dirname "$0")/.." && pwd)

if [ -z "$zephyr" ]; then
    echo "Skipped: no Zephyr tree. Give one: make firmware-zephyr ZEPHYR=DIR"
    exit 0
fi
if [ ! -f "$zephyr/VERSION" ]; then
    echo "Skipped: $zephyr is no Zephyr tree, it has no file VERSION."
    exit 0
fi
ZEPHYR_BASE=$(cd "$zephyr" && pwd)
export ZEPHYR_BASE

build() { # FOLDER APPLICATION BOARD WORD…
    folder=$here/build/zephyr-$1 application=$here/boards/$2 board=$3
    shift 3
    echo "== $(basename "$application") for $board"
    cmake -G Ninja -B "$folder" -S "$application" -DBOARD="$board" "$@" \
        ${ZEPHYR_MODULES:+-DZEPHYR_MODULES="$ZEPHYR_MODULES"} >"$folder.log" 2>&1 ||
        { tail -n 30 "$folder.log" >&2; exit 1; }
    ninja -C "$folder" >>"$folder.log" 2>&1 || { tail -n 30 "$folder.log" >&2; exit 1; }
    sed -n '/Memory region/,/IDT_LIST/p' "$folder.log"
}

mkdir -p "$here/build"
build native loadcell_hx711 "${NATIVE:-native_sim}" -DZEPHYR_TOOLCHAIN_VARIANT=host
echo "$here/build/zephyr-native/zephyr/zephyr.exe"

if [ -n "${ZEPHYR_TOOLCHAIN_VARIANT:-}${ZEPHYR_SDK_INSTALL_DIR:-}" ]; then
    set --
elif compiler=$(command -v arm-none-eabi-gcc); then
    set -- -DZEPHYR_TOOLCHAIN_VARIANT=cross-compile -DCROSS_COMPILE="${compiler%gcc}"
else
    echo "Skipped: the boards. No ARM toolchain: ZEPHYR_SDK_INSTALL_DIR, or arm-none-eabi-gcc in PATH."
    exit 0
fi
build loadcell loadcell_hx711 nucleo_g474re "$@"
build gripper gripper_servo nucleo_g474re "$@"
