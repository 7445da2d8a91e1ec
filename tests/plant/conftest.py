from __future__ import annotations

from collections.abc import Iterator

import pytest

from teds_provision.plant.demo.cluster import Cluster
from tests.plant.postgres import Database, own_cluster


@pytest.fixture(scope="session")
def cluster() -> Iterator[Cluster]:
    """Yield one PostgreSQL server for all tests of this worker; each module makes databases of its own in it."""
    with own_cluster() as made:
        yield made


@pytest.fixture(scope="module")
def database(cluster: Cluster) -> Database:
    """Return a registry for the tests of a module."""
    return Database.new(cluster)
