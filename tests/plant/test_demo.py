from __future__ import annotations

import pytest

from teds_provision.demo import cluster
from teds_provision.demo.plant import run_plant_demo
from teds_provision.talk.progress import Silent


@pytest.mark.link
@pytest.mark.parametrize("files", [pytest.param(False, marks=pytest.mark.system), True], ids=["postgresql", "files"])
def test_three_stations_share_a_key_and_refuse_what_the_stolen_one_signs(files: bool) -> None:
    if not files and cluster.programs() is None:
        pytest.skip("no PostgreSQL 15 here (scripts/install-test-packages)")
    said: list[str] = []
    done = run_plant_demo(Silent(), said.append, files=files)
    assert (done.by, done.before, done.after) == ("files" if files else "postgresql", "authentic", "not authentic")
    assert ("No PostgreSQL" in said[0]) == files
    assert all(step.result != "failed" for step in done.steps)
