"""The Python that a ROS came with: another one than ours, with other versions of everything."""

from __future__ import annotations

import os
import subprocess

PROBING = 60.0  # seconds: an import of rospy takes one on a machine that is not busy


def imports(python: str, packages: str, environment: dict[str, str]) -> bool:
    """Whether this Python can import these packages (``a, b.c``) in this environment."""
    try:
        probe = [python, "-s", "-c", f"import {packages}"]
        done = subprocess.run(probe, env=environment, capture_output=True, timeout=PROBING, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def environment(*, sourced: bool) -> dict[str, str]:
    """Our environment without the paths of our own Python; those of a ROS that the user sourced stay."""
    kept = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
    if sourced and "PYTHONPATH" in os.environ:
        kept["PYTHONPATH"] = os.environ["PYTHONPATH"]
    return kept
