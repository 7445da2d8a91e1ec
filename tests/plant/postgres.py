"""A PostgreSQL server for tests, and stations that log in at it with psycopg alone, as a thief would."""

from __future__ import annotations

import os
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psycopg
import pytest

from teds_provision.plant.demo.cluster import Cluster, programs, running
from teds_provision.plant.schema import member_sql, registry_sql, role_of
from teds_provision.plant.scram import password, verifier
from tests.places import free_tcp_port


@contextmanager
def own_cluster() -> Iterator[Cluster]:
    """Yield a running server for this test; skip the test if Debian's `postgresql` is missing."""
    found = programs()
    if found is None:
        pytest.skip("no PostgreSQL 15 here (scripts/install-test-packages)")
    with tempfile.TemporaryDirectory(prefix="pg-") as folder:
        Path(folder).chmod(0o755)  # the server runs as another user
        with running(Path(folder, "c"), free_tcp_port(), found) as cluster:
            yield cluster


@dataclass
class Login:
    """A station's way into a database: its fingerprint and secret, known to the server by its verifier."""

    database: Database
    fingerprint: str = field(default_factory=lambda: os.urandom(32).hex())
    secret: bytes = field(default_factory=lambda: os.urandom(32))

    @property
    def role(self) -> str:
        return role_of(self.fingerprint)

    def connect(self, **more: Any) -> psycopg.Connection[tuple[Any, ...]]:
        """Log in as the station would: TLS with the server verified, SCRAM bound to the channel."""
        usual = {
            "host": "localhost",
            "port": self.database.cluster.port,
            "dbname": self.database.name,
            "user": self.role,
            "password": password(self.secret),
            "sslmode": "verify-full",
            "channel_binding": "require",
            "sslrootcert": str(self.database.cluster.root_certificate),
            "gssencmode": "disable",
        }
        return psycopg.connect(autocommit=True, **(usual | more))


@dataclass
class Database:
    """A database with the schema of a registry."""

    cluster: Cluster
    name: str
    registry: str

    @classmethod
    def new(cls, cluster: Cluster) -> Database:
        made = cls(cluster, f"plant_{os.urandom(4).hex()}", str(uuid.uuid4()))
        cluster.psql(f"create database {made.name}")
        made.sql(registry_sql(made.registry))
        return made

    @property
    def url(self) -> str:
        return self.cluster.url(self.name)

    def sql(self, text: str) -> list[list[str]]:
        """Return what the keeper's `psql` gives for some SQL, as rows of columns."""
        return [line.split("|") for line in self.cluster.psql(text, self.name).splitlines()]

    def member(self) -> Login:
        """Return a new station that is a member."""
        made = Login(self)
        self.sql(member_sql(made.fingerprint, verifier(made.secret)))
        return made
