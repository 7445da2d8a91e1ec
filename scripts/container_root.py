"""Run the steps of service/Containerfile on a Debian root, where there is no container engine: `make container-root`.

As root, with debootstrap: every COPY and RUN line is done in a copy of a fresh Debian with Python, which replaces the
base image. At the end the installed program runs `demo` as the image's user on a read-only root, with /tmp and the
user's home as the only places that can be written, as `podman run --read-only` has it.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parent.parent
SUITE: Final = "bookworm"
USER: Final = "teds"
HOST_FILES: Final = ("etc/resolv.conf", "etc/hosts", "etc/pip.conf", "etc/ssl/certs/ca-certificates.crt")


def run(*command: str) -> None:
    """Run a command; ends the program if it fails."""
    print("+", shlex.join(command), flush=True)
    subprocess.run(command, check=True)


def base(folder: Path) -> Path:
    """Return a Debian with Python, made once, which replaces the base image."""
    made = folder / "base"
    if not made.is_dir():
        partial = folder / "base.partial"
        shutil.rmtree(partial, ignore_errors=True)
        run("debootstrap", "--variant=minbase", "--include=python3,python3-venv,ca-certificates", SUITE, str(partial))
        (partial / "usr/local/bin/python").symlink_to("/usr/bin/python3")
        for name in HOST_FILES:
            if (Path("/") / name).exists():
                shutil.copy(Path("/") / name, partial / name)
        partial.rename(made)
    return made


def instructions(path: Path) -> list[tuple[str, str]]:
    """Return the instructions of a Containerfile with their words, continued lines joined."""
    text = re.sub(r"^\s*#.*\n", "", path.read_text(), flags=re.MULTILINE).replace("\\\n", " ")
    return [(line.split(None, 1)[0], line.split(None, 1)[1]) for line in text.splitlines() if line.strip()]


def context(folder: Path) -> None:
    """Copy what .containerignore lets into the build."""
    for line in (ROOT / ".containerignore").read_text().split():
        if line.startswith("!"):
            kept = ROOT / line[1:]
            if kept.is_dir():
                shutil.copytree(kept, folder / kept.name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(kept, folder / kept.name)


def build(folder: Path) -> Path:
    """Do the steps and return the root of the last stage."""
    stages: dict[str, Path] = {}
    stage = folder
    for word, rest in instructions(ROOT / "service" / "Containerfile"):
        if word == "FROM":
            name = rest.split()[-1] if " AS " in rest else "image"
            stage = stages[name] = folder / name
            shutil.rmtree(stage, ignore_errors=True)
            run("cp", "-a", "--reflink=auto", str(base(folder)), str(stage))
        elif word == "COPY" and rest.startswith("--from="):
            source, path, target = re.fullmatch(r"--from=(\S+) (\S+) (\S+)", rest).groups()  # type: ignore[union-attr]
            run("cp", "-a", f"{stages[source]}{path}", f"{stage}{target}")
        elif word == "COPY":
            target = stage / rest.split()[1].lstrip("/")
            target.mkdir()
            context(target)
        elif word == "RUN":
            run(
                "unshare",
                "--mount",
                "sh",
                "-ec",
                f"mount -t proc proc {stage}/proc; exec chroot {stage} sh -ec '{rest}'",
            )
    return stage


def demo(image: Path) -> None:
    """Run the demo as the image's user on a read-only root, and show that the root is read-only."""
    writable = ("/tmp", "/var/lib/teds-provision")
    user, chroot = f"{USER}:{USER}", shutil.which("chroot")
    script = [f"mount --bind {image} {image}", f"mount -o remount,bind,ro {image}", f"mount -t proc proc {image}/proc"]
    script += [f"mount -t tmpfs -o mode=1777 tmpfs {image}{path}" for path in writable]
    inside = "! touch /root-is-writable 2>/dev/null && id && teds-provision --version && teds-provision demo"
    environment = f"env -i HOME={writable[1]} PATH=/opt/teds-provision/bin:/usr/bin:/bin"
    script.append(f"exec {environment} {chroot} --userspec={user} {image} sh -ec '{inside}'")
    run("unshare", "--mount", "sh", "-ec", "; ".join(script))


def main(folder: Path) -> int:
    """Build the image's root below a folder and run the demo in it."""
    if os.geteuid() != 0 or shutil.which("debootstrap") is None:
        sys.exit("This needs root and debootstrap: sudo apt install debootstrap")
    folder.mkdir(parents=True, exist_ok=True)
    demo(build(folder))
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).resolve()))
