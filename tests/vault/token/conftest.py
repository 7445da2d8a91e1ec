from __future__ import annotations

import pytest

from teds_provision.protocol.keys import fingerprint
from teds_provision.vault.pkcs11 import Pkcs11Vault
from tests.vault.softhsm import loaded, unload
from tests.vault.token.person import Person


@pytest.fixture(scope="module")
def uris(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        yield loaded(tmp_path_factory.mktemp("hsm"), patch, ("bench", "spare"))
        unload()


@pytest.fixture
def uri(uris):
    return uris["bench"]


@pytest.fixture
def home(tmp_path):
    return tmp_path


@pytest.fixture
def store_id(request):
    """Return one store per test, so that each test has keys of its own in the token."""
    return fingerprint(request.node.name.encode())[:32]


@pytest.fixture
def vault(home, store_id, uri):
    made = Pkcs11Vault.create(home, store_id, uri, Person())
    yield made
    made.close()
