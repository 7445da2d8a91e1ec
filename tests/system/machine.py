"""A machine with a kernel that has CAN and Bluetooth: Debian's, in qemu without KVM, over this machine's files.

The host's ``/`` is read-only below a file system in memory, so the checkout and its environment run inside as they are.
A scene is a module of ``tests.system`` that prints one line of JSON for each thing it looked at, between other output.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[2]
FOLDER: Final = ROOT / "build" / "machine"
MARK: Final = "SCENE "
_BOOT_MODULES: Final = ("virtio_pci", "9pnet_virtio", "9p", "overlay")
_PROGRAMS: Final = ("qemu-system-x86_64", "busybox", "cpio")
_LIMIT_SECONDS: Final = 1200

_INIT: Final = """#!/bin/busybox sh
/bin/busybox mkdir -p /proc /sys /dev /host /root /memory
/bin/busybox --install -s /bin
mount -t proc proc /proc; mount -t sysfs sys /sys; mount -t devtmpfs dev /dev
for module in $(cat /boot.modules); do insmod /lib/$(basename $module) || echo "insmod $module failed"; done
mount -t tmpfs memory /memory; mkdir /memory/upper /memory/work
mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000,ro,cache=loose root /host || echo "no 9p"
mount -t overlay -o lowerdir=/host,upperdir=/memory/upper,workdir=/memory/work whole /root || echo "no overlay"
mount -t proc proc /root/proc; mount -t sysfs sys /root/sys; mount -t devtmpfs dev /root/dev
mkdir -p /root/dev/pts; mount -t devpts pts /root/dev/pts
MEMORY
mkdir -p /root/run/dbus
ip link set lo up
for module in $(cat /scene.modules); do insmod /root$module || echo "insmod $module failed"; done
echo "booted in $(cut -d' ' -f1 /proc/uptime) s"
cd /root; chroot /root /bin/sh -c "cd ROOT && PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/tmp PYTHONDONTWRITEBYTECODE=1 \\
  PYTHON -m tests.system.SCENE"
poweroff -f
"""


def why_not() -> str:
    """Why no machine can be booted here, "" where one can."""
    missing = [program for program in _PROGRAMS if shutil.which(program) is None]
    if missing:
        return f"{missing[0]} is missing: scripts/install-test-machine"
    if not (FOLDER / "vmlinuz").exists():
        return "no kernel in build/machine: scripts/install-test-machine"
    return ""


class Machine:
    """Boots and plays one scene. ``results`` are its lines by name, ``output`` all that it said."""

    def __init__(self, scene: str, modules: tuple[str, ...], folder: Path) -> None:
        self.results: dict[str, dict[str, Any]] = {}
        image = _boot_image(scene, modules, folder)
        words = [
            *("nice", "qemu-system-x86_64", "-machine", "q35,accel=tcg", "-cpu", "max", "-smp", "2", "-m", "2048"),
            *("-nographic", "-no-reboot", "-nodefaults", "-serial", "stdio"),
            *("-kernel", str(FOLDER / "vmlinuz"), "-initrd", str(image)),
            # The kernel tries its timer at the start and panics where this machine is too busy to tick in that moment.
            *("-append", "console=ttyS0 quiet no_timer_check rdinit=/init panic=-1"),
            "-virtfs",
            "local,path=/,mount_tag=root,security_model=none,readonly=on,multidevs=remap",
        ]
        console = folder / "console"
        with console.open("wb") as file:
            subprocess.run(
                words,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                timeout=_LIMIT_SECONDS,
                check=False,
            )
        self.output = console.read_text(errors="replace").replace("\r", "")
        for line in self.output.splitlines():
            if line.startswith(MARK):
                record = json.loads(line.removeprefix(MARK))
                self.results[record.pop("name")] = record


def report(name: str, **what: Any) -> None:
    """Inside: say how one thing came out."""
    sys.__stdout__.write(f"\n{MARK}{json.dumps({'name': name, **what})}\n")  # type: ignore[union-attr]
    sys.__stdout__.flush()  # type: ignore[union-attr]


def in_memory(*used: Path) -> list[str]:
    """What of these folders gets a file system of its own in memory: those in which nothing lies that is ``used``.

    A checkout in the temporary folder of the system would be hidden by it. The files of the host are never written to
    in either case: what is written goes into the memory above them.
    """
    return [place for place in ("/dev/shm", "/tmp", "/run") if not any(path.is_relative_to(place) for path in used)]


def _in_order(names: tuple[str, ...]) -> list[str]:
    """Modules and what they need, in the order in which they are loaded; paths below the kernel's folder."""
    needs: dict[str, tuple[str, list[str]]] = {}
    for line in (FOLDER / "modules" / "modules.dep").read_text().splitlines():
        path, _, rest = line.partition(":")
        needs[Path(path).stem.replace("-", "_")] = (path, rest.split())
    order: list[str] = []
    for name in names:
        path, before = needs[name.replace("-", "_")]
        order += [name for name in (*reversed(before), path) if name not in order]
    return order


def _boot_image(scene: str, modules: tuple[str, ...], folder: Path) -> Path:
    """Return the first file system of the kernel: busybox, the modules to reach the host's files, and the scene."""
    tree = folder / "initrd"
    (tree / "bin").mkdir(parents=True)
    (tree / "lib").mkdir()
    shutil.copy(os.path.realpath(str(shutil.which("busybox"))), tree / "bin" / "busybox")
    boot = _in_order(_BOOT_MODULES)
    for module in boot:
        shutil.copy(FOLDER / "modules" / module, tree / "lib")
    (tree / "boot.modules").write_text("\n".join(boot) + "\n")
    inside = [str(FOLDER / "modules" / module) for module in _in_order(modules)]
    (tree / "scene.modules").write_text("\n".join(inside) + "\n")
    init = tree / "init"
    used = (ROOT, FOLDER.resolve(), Path(sys.executable), Path(sys.executable).resolve(), Path(sys.prefix).resolve())
    mounts = [f"mkdir -p /root{place}; mount -t tmpfs memory /root{place}" for place in in_memory(*used)]
    words = _INIT.replace("MEMORY", "\n".join(mounts)).replace("ROOT", str(ROOT))
    init.write_text(words.replace("PYTHON -m", f"{sys.executable} -m").replace("SCENE", scene))
    init.chmod(0o755)
    names = "\n".join(str(path.relative_to(tree)) for path in sorted(tree.rglob("*")))
    packed = subprocess.run(
        ["cpio", "--create", "--format=newc", "--quiet"],
        input=names.encode(),
        capture_output=True,
        cwd=tree,
        check=True,
    )
    image = folder / "initrd.img"
    image.write_bytes(packed.stdout)
    return image
