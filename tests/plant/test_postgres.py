"""A station's connection to the registry: what it says, how it logs in, and what becomes of it when the way is bad."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from teds_provision.errors import ForkError, NotMemberError, PolicyError, RegistryError, StoreError, UsageError
from teds_provision.plant.demo.cluster import Cluster
from teds_provision.plant.postgres import Registry, parameters
from teds_provision.plant.schema import close_sql
from tests.pace import PATIENCE
from tests.plant.postgres import Database, Login, own_cluster
from tests.plant.relay import Relay, relay
from tests.plant.test_thief import digest, page

pytestmark = pytest.mark.system


def registry(login: Login, port: int = 0, **more: Any) -> Registry:
    settings = parameters(login.database.url, login.fingerprint, login.secret) | more
    return Registry(settings | ({"port": port} if port else {}), patience=2.0)


@pytest.fixture
def login(database: Database) -> Login:
    return database.member()


@pytest.fixture
def transport(login: Login) -> Iterator[Registry]:
    made = registry(login)
    yield made
    made.close()


@pytest.fixture
def way(database: Database) -> Iterator[Relay]:
    with relay(database.cluster.port) as made:
        yield made


@pytest.fixture
def far(login: Login, way: Relay) -> Iterator[Registry]:
    made = registry(login, way.port)
    yield made
    made.close()


def chain(count: int) -> list[tuple[int, str, bytes]]:
    pages: list[tuple[int, str, bytes]] = []
    before = ""
    for n in range(1, count + 1):
        text = page()
        pages.append((n, before, text.encode()))
        before = digest(text).hex()
    return pages


def later(days: int = 7) -> datetime:
    return datetime.now(UTC) + timedelta(days=days)


def test_pages_that_one_appends_another_reads(transport: Registry, login: Login) -> None:
    pages = chain(70)  # more than are asked for at once
    transport.append(pages)
    transport.append(pages[-3:])  # there already
    other = registry(login.database.member())
    look = other.look()
    assert look.registry == login.database.registry
    assert look.heads[login.fingerprint] == (70, digest(pages[-1][2].decode()).hex())
    assert list(other.pages({login.fingerprint: 3})) == [(login.fingerprint, n, octets) for n, _, octets in pages[3:]]
    other.close()


def test_a_page_that_does_not_follow_leaves_none_of_its_push(transport: Registry, login: Login) -> None:
    first, second, _ = chain(3)
    with pytest.raises(ForkError):
        transport.append([first, (2, "00" * 32, second[2])])
    assert transport.look().heads[login.fingerprint][0] == 0
    with pytest.raises(StoreError):
        transport.append([second])
    transport.append([first, second])


def test_a_parcel_goes_to_its_receiver_and_is_taken_away(transport: Registry, login: Login) -> None:
    to = login.database.member()
    receiver, name = registry(to), str(uuid.uuid4())
    transport.send(name, to.fingerprint, b"sealed", later())
    transport.send(name, to.fingerprint, b"sealed", later())
    [waiting] = receiver.look().parcels
    assert (waiting.id, waiting.sender, waiting.to, waiting.octets) == (name, login.fingerprint, to.fingerprint, 6)
    assert [waiting_parcel.id for waiting_parcel in transport.look().parcels] == [name]
    assert receiver.parcel(name) == b"sealed"
    second = str(uuid.uuid4())
    transport.send(second, to.fingerprint, b"sealed", later())
    receiver.remove([name, second])
    assert transport.look().parcels == ()
    assert receiver.parcel(name) is None
    with pytest.raises(PolicyError):
        transport.send(str(uuid.uuid4()), to.fingerprint, b"", later(40))
    receiver.close()


def test_two_stations_that_send_to_each_other_at_once_do_not_lock_each_other_out(login: Login) -> None:
    """Each locked its own row against the reference to it by the other's parcel: "deadlock detected"."""
    other = login.database.member()
    with login.connect() as here, other.connect() as there, here.transaction():
        send = "select registry.send(%s, %s, %s, %s)"
        here.execute(send, (uuid.uuid4(), bytes.fromhex(other.fingerprint), b"to the other", later()))
        there.execute("set lock_timeout = '20s'")
        there.execute(send, (uuid.uuid4(), bytes.fromhex(login.fingerprint), b"and back", later()))


def test_a_roster_that_many_post_comes_once(transport: Registry, login: Login) -> None:
    other = registry(login.database.member())
    transport.post_roster(4, b"the fourth")
    other.post_roster(4, b"the fourth")
    assert transport.look().rosters.count(b"the fourth") == 1
    assert transport.look().posted == b"the fourth"
    assert registry(login.database.member()).look().posted is None
    other.close()


def test_nothing_new_is_one_round_trip(far: Registry, way: Relay) -> None:
    far.look()
    before = way.sent
    far.look()
    assert way.sent - before == 1


def test_a_push_of_many_pages_is_one_round_trip(far: Registry, way: Relay) -> None:
    far.look()
    before = way.sent
    far.append(chain(10))
    assert way.sent - before == 1


def test_who_listens_is_woken_and_is_not_without_a_reason(transport: Registry, login: Login) -> None:
    listener = registry(login)
    listener.listen()
    assert not listener.wait(0.05)
    transport.append(chain(1))
    assert listener.wait(PATIENCE)
    woken: list[bool] = []
    waits = threading.Thread(target=lambda: woken.append(listener.wait(PATIENCE)))
    waits.start()
    transport.post_roster(1, b"one")
    waits.join(PATIENCE)
    assert woken == [True]
    listener.close()


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://user:secret@localhost/plant",
        "postgresql://user@localhost/plant",
        "postgresql://localhost/plant?password=secret",
        "postgresql://localhost/plant?sslmode=disable",
        "postgresql://localhost/plant?passfile=/tmp/x",
        "postgresql://localhost/",
        "postgresql:///plant",
        "https://localhost/plant",
        "postgresql://localhost/plant?%zz",
    ],
)
def test_a_url_says_only_where_the_registry_is(url: str) -> None:
    with pytest.raises(UsageError) as refused:
        parameters(url, "ab" * 32, bytes(32))
    assert "secret" not in refused.value.message


def test_the_environment_takes_nothing_back(login: Login, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"PGSSLMODE": "disable", "PGCHANNELBINDING": "disable", "PGUSER": "postgres"}.items():
        monkeypatch.setenv(name, value)
    made = registry(login)
    made.look()
    assert made._connection is not None
    assert made._connection.pgconn.ssl_in_use
    made.close()


def test_another_servers_certificate_is_refused(login: Login, tmp_path: Any) -> None:
    from teds_provision.plant.demo.cluster import _tls

    stranger = tmp_path / "root.crt"
    stranger.write_bytes(_tls()[1])
    with pytest.raises(RegistryError, match="certificate verify failed"):
        registry(login, sslrootcert=str(stranger)).look()


def test_a_refused_login_names_its_cure(login: Login) -> None:
    for more in ({"password": "0" * 64}, {}):
        with pytest.raises(RegistryError, match="refuses this station's login") as refused:
            registry(login, **more).look()
        assert refused.value.exit_code == 5
        assert "registry sql --member FILE" in refused.value.hint
        login.database.sql(close_sql(login.fingerprint))  # the second time its own password is of no use either


def test_a_server_of_another_name_is_refused(login: Login) -> None:
    with pytest.raises(RegistryError, match="does not match host name"):
        registry(login, host="elsewhere.example", hostaddr="127.0.0.1").look()


def test_a_closed_station_is_told_that_it_is_no_member(transport: Registry, login: Login) -> None:
    transport.look()
    login.database.sql(f"update registry.member set open = false where role = '{login.role}'")
    with pytest.raises(NotMemberError):
        transport.append(chain(1))


def test_a_database_without_schema_and_one_of_a_newer_version_are_reported(cluster: Cluster, login: Login) -> None:
    database = Database.new(cluster)
    newer = registry(database.member())
    database.sql("update registry.meta set version = 3")
    with pytest.raises(StoreError, match="schema 3"):
        newer.look()
    database.sql("drop schema registry cascade")
    with pytest.raises(StoreError, match="does not contain a registry"):
        newer.look()
    newer.close()


def test_what_a_restore_opened_is_named(cluster: Cluster) -> None:
    database = Database.new(cluster)
    member = registry(database.member())
    assert member.open_doors() == []
    database.sql(f"grant temporary on database {database.name} to public; grant insert on registry.page to teds_member")
    assert member.open_doors() == ["TEMP for PUBLIC", "writing pages past the functions"]
    member.close()


def test_a_connection_that_is_cut_is_made_again(far: Registry, way: Relay) -> None:
    far.look()
    way.cut()
    with pytest.raises(RegistryError):
        far.look()
    assert far.look().registry


def test_a_connection_that_is_half_open_is_given_up_in_time(far: Registry, way: Relay) -> None:
    far.look()
    way.silent = True
    began = time.monotonic()
    with pytest.raises(RegistryError, match="in time"):
        far.look()
    assert time.monotonic() - began < PATIENCE / 2
    way.silent = False
    assert far.look().registry


def test_a_server_that_never_greets_is_given_up_in_time(login: Login, way: Relay) -> None:
    way.silent = True
    with pytest.raises(RegistryError):
        registry(login, way.port, connect_timeout=2).look()


def test_a_slow_way_is_only_slow(far: Registry, way: Relay) -> None:
    way.delay = 0.05
    far.append(chain(5))
    assert far.look().registry


def test_a_server_that_dies_during_a_push_has_all_of_it_or_nothing(login: Login, far: Registry, way: Relay) -> None:
    pages = chain(20)
    far.look()
    for cut in range(5):
        way.delay = 0.002 * cut
        stop = threading.Timer(0.004 * cut, way.cut)
        stop.start()
        try:
            far.append(pages)
        except RegistryError:
            n, _ = registry(login).look().heads[login.fingerprint]
            assert n in (0, 20)
        stop.join()
    way.delay = 0
    far.append(pages)


def test_no_server_and_one_that_comes_back() -> None:
    with own_cluster() as cluster:
        database = Database.new(cluster)
        transport = registry(database.member())
        transport.append(chain(1))
        cluster.stop()
        with pytest.raises(RegistryError):
            transport.look()
        with pytest.raises(RegistryError, match="refused"):
            transport.look()
        cluster.start()
        assert transport.look().heads
        transport.close()
