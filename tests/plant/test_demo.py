from __future__ import annotations

import pytest

from teds_provision.plant.demo import cluster, plant
from teds_provision.provisioning.progress import SilentReporter

BY_DATABASE = pytest.mark.nightly(
    "tests/plant/test_demo.py::test_three_stations_share_a_key_and_refuse_what_the_stolen_one_signs[files]; every test "
    "with a database runs the demo's server, and syncs as tests/plant/test_synced_by_database.py does"
)


@pytest.mark.link
@pytest.mark.parametrize(
    "driver", [pytest.param(True, marks=[pytest.mark.system, BY_DATABASE]), False], ids=["postgresql", "files"]
)
def test_three_stations_share_a_key_and_refuse_what_the_stolen_one_signs(
    driver: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By files, with a word, also where a server is installed and its driver is not."""
    if driver and cluster.programs() is None:
        pytest.skip("no PostgreSQL 15 here (scripts/install-test-packages)")
    if not driver:
        monkeypatch.setattr(plant, "find_spec", lambda _name: None)
    messages: list[str] = []
    done = plant.run_plant_demo(SilentReporter(), messages.append)
    assert (done.by, done.before, done.after) == ("postgresql" if driver else "files", "authentic", "not authentic")
    assert ("No psycopg (the extra registry) is installed here" in messages[0]) == (not driver)
    assert all(step.result != "failed" for step in done.steps)
