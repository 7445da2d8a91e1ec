"""MQTT over TLS by Debian's mosquitto with a CA of its own, every failure in words, and what a URL may say."""

from __future__ import annotations

import datetime
import ipaddress
import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
)
from cryptography.x509.oid import NameOID

from teds_provision.errors import BadDataError, NotFoundError, TedsProvisionError, UsageError
from teds_provision.measure.blocks import SinkStats
from teds_provision.measure.sinks import Sink, open_sink
from tests.measure.sinks.parts import ANGLE, HAND, STATION, block
from tests.pace import until
from tests.places import free_tcp_port

MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/bin:/usr/local/sbin")
PASSWD = shutil.which("mosquitto_passwd")
SECRET = "a secret of the broker"


class Authority:
    """A private CA, and what it signs."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        self.key = ec.generate_private_key(ec.SECP256R1())
        self.file = folder / f"{name}.pem"
        made = self._signed(self.name, self.key.public_key(), x509.BasicConstraints(ca=True, path_length=0))
        self.file.write_bytes(made.public_bytes(Encoding.PEM))

    def _signed(self, name: x509.Name, key: ec.EllipticCurvePublicKey, *more: x509.ExtensionType) -> x509.Certificate:
        now = datetime.datetime.now(datetime.UTC)
        made = x509.CertificateBuilder(self.name, name, key, x509.random_serial_number())
        made = made.not_valid_before(now - datetime.timedelta(days=1)).not_valid_after(now + datetime.timedelta(days=2))
        for extension in more:
            made = made.add_extension(extension, critical=isinstance(extension, x509.BasicConstraints))
        return made.sign(self.key, hashes.SHA256())

    def issue(self, name: str, *addresses: str, passphrase: bytes | None = None) -> tuple[Path, Path]:
        """Return files of a certificate and its key."""
        key = ec.generate_private_key(ec.SECP256R1())
        names = [x509.IPAddress(ipaddress.ip_address(address)) for address in addresses]
        more = [x509.SubjectAlternativeName(names)] if names else []
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        certificate, secret = self.folder / f"{name}.crt", self.folder / f"{name}.key"
        certificate.write_bytes(self._signed(subject, key.public_key(), *more).public_bytes(Encoding.PEM))
        how = NoEncryption() if passphrase is None else BestAvailableEncryption(passphrase)
        secret.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, how))
        return certificate, secret


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("ca"), "private")


@pytest.fixture(scope="module")
def ports(authority: Authority) -> Iterator[dict[str, int]]:
    """One mosquitto: TLS, TLS with a client's certificate, a certificate of another name, users with passwords."""
    if MOSQUITTO is None or PASSWD is None:
        pytest.skip("mosquitto is not installed")
    good, other = authority.issue("server", "127.0.0.1"), authority.issue("elsewhere", "127.0.0.9")
    users = authority.folder / "users"
    subprocess.run([PASSWD, "-b", "-c", users, "arm", SECRET], check=True, capture_output=True, timeout=60)
    users.chmod(0o644)
    for file in (*good, *other):
        file.chmod(0o644)
    authority.folder.chmod(0o755)
    named = {name: free_tcp_port() for name in ("tls", "client", "elsewhere", "users")}
    lines = ["per_listener_settings true", "user root"]
    for name, port in named.items():
        certificate, key = other if name == "elsewhere" else good
        lines.append(f"listener {port} 127.0.0.1")
        if name == "users":
            lines += ["allow_anonymous false", f"password_file {users}"]
            continue
        lines += ["allow_anonymous true", f"certfile {certificate}", f"keyfile {key}"]
        if name == "client":
            lines += [f"cafile {authority.file}", "require_certificate true"]
    config = authority.folder / "mosquitto.conf"
    config.write_text("\n".join(lines) + "\n")
    process = subprocess.Popen([MOSQUITTO, "-c", str(config)], stderr=subprocess.DEVNULL)
    try:
        yield named
    finally:
        process.kill()
        process.wait()


def taken(url: str) -> SinkStats:
    """Return how a sink ends that was given values until the broker took one."""
    sink = opened(url)
    until(lambda: (sink.write(block([[7]], [[0.5]], uuid=HAND)), sink.stats.written)[1], sink.stats)
    sink.close()
    return sink.stats


def refused(url: str, *words: str) -> SinkStats:
    """How a sink ends that was given values and whose broker never took one; its reason stands there meanwhile."""
    sink = opened(url)
    try:
        until(lambda: all(word in sink.stats.detail for word in words), lambda: sink.stats)
        assert sink.stats.state == "waiting"
        until(lambda: (sink.write(block([[7]], [[0.5]], uuid=HAND)), sink.stats.dropped)[1])
    finally:
        sink.close()
    stats = sink.stats
    assert (stats.state, stats.written) == ("failed", 0)
    assert all(word in stats.error for word in words), stats.error
    return stats


def opened(url: str) -> Sink:
    sink = open_sink(url)
    sink.open([ANGLE], STATION)
    return sink


@pytest.mark.system
def test_a_broker_under_a_private_ca_takes_values(ports: dict[str, int], authority: Authority) -> None:
    stats = taken(f"mqtts://127.0.0.1:{ports['tls']}?ca={authority.file}")
    assert (stats.state, stats.error) == ("ended", "")


@pytest.mark.system
def test_a_client_shows_its_own_certificate(ports: dict[str, int], authority: Authority) -> None:
    certificate, key = authority.issue("robot")
    url = f"mqtts://127.0.0.1:{ports['client']}?ca={authority.file}"
    assert taken(f"{url}&cert={certificate}&key={key}").error == ""
    both = authority.folder / "both.pem"
    both.write_bytes(certificate.read_bytes() + key.read_bytes())
    assert taken(f"{url}&cert={both}").error == ""
    refused(url, "closed the connection", "client certificate")
    stranger = Authority(authority.folder, "stranger").issue("intruder")
    refused(f"{url}&cert={stranger[0]}&key={stranger[1]}", "closed the connection", "client certificate")


@pytest.mark.system
def test_each_failure_is_reported_in_words(ports: dict[str, int], authority: Authority, tmp_path: Path) -> None:
    refused(f"mqtts://127.0.0.1:{ports['tls']}", "certificate of 127.0.0.1 does not verify", "ca=")
    elsewhere = f"mqtts://127.0.0.1:{ports['elsewhere']}?ca={authority.file}"
    refused(elsewhere, "certificate of 127.0.0.1 does not verify", "mismatch")
    refused(f"mqtts://127.0.0.1:{ports['users']}", "127.0.0.1", "TLS")
    refused(f"mqtt://127.0.0.1:{ports['tls']}", "closed the connection", "mqtts://")
    refused(f"mqtt://127.0.0.1:{free_tcp_port()}", "nothing is listening at 127.0.0.1")
    refused("mqtt://nowhere.invalid", "unknown host nowhere.invalid")
    refused(f"mqtt://127.0.0.1:{ports['users']}", "refused", "not authorized")
    password = tmp_path / "password"
    password.write_text("another one\n")
    url = f"mqtt://arm@127.0.0.1:{ports['users']}?password-file={password}"
    stats = refused(url, "refused")
    assert "another one" not in f"{stats}"
    password.write_text(f"{SECRET}\n")
    assert taken(url).error == ""


@pytest.mark.parametrize(
    ("url", "word"),
    [
        ("mqtt://host?pasword-file=/x", "pasword-file"),
        ("mqtt://host?ca=/x", "mqtts"),
        ("mqtts://host?cafile=/x", "cafile"),
        ("mqtts://host?ca=", "empty"),
        ("mqtts://host?ca=/x&ca=/y", "twice"),
        ("mqtts://host?key=/x", "needs 'cert'"),
        ("mqtt://host?password-file=/x", "user"),
        ("mqtt://host/topic", "not an MQTT URL"),
        ("mqtt://host:port", "not an MQTT URL"),
        ("mqtt://host#x", "not an MQTT URL"),
    ],
)
def test_what_a_url_does_not_know_is_refused_with_what_it_does(url: str, word: str) -> None:
    with pytest.raises(UsageError) as refusal:
        open_sink(url)
    assert word in f"{refusal.value.message} {refusal.value.hint}"


def test_files_are_regular_small_and_what_they_should_be(tmp_path: Path, authority: Authority) -> None:
    """A pipe in place of a file must not hold the sink, nor an endless file its memory."""
    pipe, huge, text = tmp_path / "pipe", tmp_path / "huge", tmp_path / "text"
    os.mkfifo(pipe)
    huge.write_bytes(b"x" * (1 << 21))
    text.write_text("not a certificate")
    locked, good = authority.issue("locked", passphrase=b"secret words"), authority.issue("good")
    for query, error in (
        (f"password-file={pipe}", BadDataError),
        (f"password-file={huge}", BadDataError),
        (f"password-file={tmp_path / 'none'}", NotFoundError),
        ("password-file=/dev/zero", BadDataError),
        (f"ca={pipe}", BadDataError),
        (f"ca={text}", BadDataError),
        (f"ca={huge}", BadDataError),
        (f"ca={authority.file}&cert={pipe}", BadDataError),
        (f"ca={authority.file}&cert={huge}", BadDataError),
        (f"ca={authority.file}&cert={good[0]}&key={pipe}", BadDataError),
        (f"ca={authority.file}&cert={good[0]}&key={huge}", BadDataError),
        (f"ca={authority.file}&cert={good[0]}&key={tmp_path / 'none'}", NotFoundError),
        (f"ca={authority.file}&cert={text}&key={text}", BadDataError),
        (f"ca={authority.file}&cert={locked[0]}&key={locked[1]}", BadDataError),
    ):
        found: list[TedsProvisionError] = []
        thread = threading.Thread(target=_open_into, args=(f"mqtts://arm@127.0.0.1?{query}", found), daemon=True)
        thread.start()
        thread.join(30)
        assert [type(error) for error in found] == [error], query


def _open_into(url: str, found: list[TedsProvisionError]) -> None:
    try:
        opened(url)
    except TedsProvisionError as error:
        found.append(error)
