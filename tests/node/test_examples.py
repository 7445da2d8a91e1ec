"""The examples of simulations; ``make test-all`` runs one, with the newest MuJoCo (no dependency of the project)."""

from __future__ import annotations

import ast
import json
import os
import subprocess
from pathlib import Path

import pytest

from teds_provision.node.hardware.board import Board
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.sheet import Sheet

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
MUJOCO_PYTHON = Path(os.environ.get("MUJOCO_PYTHON", ROOT / ".venv-mujoco" / "bin" / "python"))
UUID = bytes(10)


def board(profile: str) -> Board:
    return Board(Sheet.from_image(Image(UUID, load_profile(profile).build(UUID).blocks)))


def names_in(example: str) -> set[str]:
    """Return every text constant of an example."""
    tree = ast.parse((EXAMPLES / example).read_text())
    return {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}


@pytest.mark.parametrize(
    ("example", "profile"),
    [("mujoco_pendulum.py", "magnetic-angular-position-sensor"), ("fmu_gripper.py", "gripper")],
)
def test_examples_name_the_sensors_of_their_profile_and_are_short(example: str, profile: str) -> None:
    assert {place.name for place in board(profile).places} <= names_in(example)
    code = [line for line in (EXAMPLES / example).read_text().split('"""', 2)[2].splitlines() if line.strip()]
    assert len(code) <= 24


@pytest.mark.soak
def test_the_pendulum_swings_within_the_sensors_range() -> None:
    with subprocess.Popen(
        [MUJOCO_PYTHON, EXAMPLES / "mujoco_pendulum.py"], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        lines = [json.loads(process.stdout.readline()) for _ in range(50)]
        process.kill()
    assert [round(line["t"], 3) for line in lines[:3]] == [0.005, 0.01, 0.015]
    assert all(0 <= line["value"]["angle"] <= 360 for line in lines)
