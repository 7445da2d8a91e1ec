"""Whose keys count: added by a person, public only, P-256 only, never one's own."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

from teds_provision.errors import BadDataError, NotAuthenticError, NotFoundError, PolicyError, UsageError
from teds_provision.handover.pending import BundleNotes
from teds_provision.handover.trust import (
    Certificate,
    CertificateRequest,
    add,
    candidate,
    candidates_of,
    find_removed,
    find_trusted,
    make_request,
    plan_removal,
    private_keys,
    read_request,
    remove,
    require_ca,
    sign_request,
    spoken,
    write_certificate,
)
from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message, to_pem
from teds_provision.station.station import Station
from teds_provision.station.store.records import Handover, TrustRecord
from tests.bench import make_station

ROOT = Path(__file__).resolve().parents[2]
OTHER = SoftwareKey(21)


@pytest.fixture
def north(tmp_path: Path) -> Iterator[Station]:
    made = make_station(tmp_path / "north", "north")
    yield made
    made.close()


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    folder = tmp_path / "keys"
    folder.mkdir()
    return folder


def public(key: object) -> str:
    made = key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)  # type: ignore[attr-defined]
    return str(made.decode())


def private(key: object, encoding: Encoding = Encoding.PEM) -> bytes:
    return bytes(key.private_bytes(encoding, PrivateFormat.PKCS8, NoEncryption()))  # type: ignore[attr-defined]


def test_a_key_counts_once_it_was_added_and_until_it_is_removed(north: Station, keys: Path) -> None:
    (keys / "lab.pem").write_text(to_pem(OTHER.point))
    assert north.policy.trusted_stations() == [north.point]
    assert add(north, [candidate(north, "lab", keys / "lab.pem", "station")]) == 1
    assert north.policy.trusted_stations() == [north.point, OTHER.point]
    again = candidate(north, "lab", keys / "lab.pem", "station")
    assert again.known
    assert add(north, [again]) == 0
    remove(north, find_trusted(north, "lab"))
    assert north.policy.trusted_stations() == [north.point]


@pytest.mark.parametrize(("ends", "left"), [("lab", "owner"), ("owner", "lab")])
def test_only_the_named_row_of_a_key_with_two_roles_is_removed(
    north: Station, keys: Path, ends: str, left: str
) -> None:
    (keys / "lab.pem").write_text(to_pem(OTHER.point))
    add(
        north, [candidate(north, "lab", keys / "lab.pem", "station"), candidate(north, "owner", keys / "lab.pem", "ca")]
    )
    assert remove(north, find_trusted(north, ends)).record.name == ends
    assert [record.name for record in north.policy.listed()] == [left]


def test_a_key_is_found_by_name_fingerprint_or_file(north: Station, keys: Path) -> None:
    path = keys / "lab.pem"
    path.write_text(to_pem(OTHER.point))
    digits = fingerprint(OTHER.point)
    with pytest.raises(PolicyError, match="is not trusted here"):
        find_trusted(north, str(path))
    add(north, [candidate(north, "lab", path, "station")])
    for text in ("lab", digits, digits[:16].upper(), spoken(digits), str(path)):
        assert find_trusted(north, text, "station").name == "lab"
    assert find_trusted(north, digits[:8]).name == "lab"
    for short in (digits[:6], digits[:7]):
        with pytest.raises(NotFoundError):
            find_trusted(north, short)
    with pytest.raises(NotFoundError, match="No trusted key is known as 'lab'"):
        find_trusted(north, "lab", "ca")
    remove(north, find_trusted(north, "lab"))
    add(north, [candidate(north, "owner", path, "ca")])
    assert (north.policy.station_points(), north.policy.trusted_stations()) == ({}, [north.point])
    for text in ("owner", digits[:16]):
        with pytest.raises(NotFoundError, match=f"No trusted station is known as '{text}'"):
            find_trusted(north, text, "station")
    with pytest.raises(PolicyError, match="is not trusted here"):
        find_trusted(north, str(path), "station")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda: private(ec.generate_private_key(ec.SECP256R1())).decode(), "private key where a public one"),
        (lambda: public(rsa.generate_private_key(65537, 2048)), "not a P-256 key"),
        (lambda: public(ec.generate_private_key(ec.SECP384R1())), "not a P-256 key"),
        (lambda: public(ed25519.Ed25519PrivateKey.generate()), "not a P-256 key"),
        (lambda: "a letter", "no public key"),
        (lambda: "", "no public key"),
    ],
)
def test_what_is_no_public_p256_key(north: Station, keys: Path, content, message: str) -> None:  # type: ignore[no-untyped-def]
    (keys / "bad.pem").write_text(content())
    with pytest.raises(BadDataError, match=message):
        candidate(north, "bad", keys / "bad.pem", "station")


def test_its_own_key_needs_no_trust(north: Station, keys: Path) -> None:
    (keys / "self.pem").write_text(to_pem(north.point))
    with pytest.raises(PolicyError, match="own key"):
        candidate(north, "self", keys / "self.pem", "station")
    (keys / "ca.pem").write_text(to_pem(north.ca))
    with pytest.raises(PolicyError, match="own key"):
        candidate(north, "self", keys / "ca.pem", "ca")


def test_a_name_belongs_to_one_key(north: Station, keys: Path) -> None:
    for number in (21, 22):
        (keys / f"{number}.pem").write_text(to_pem(SoftwareKey(number).point))
    add(north, [candidate(north, "lab", keys / "21.pem", "station")])
    with pytest.raises(PolicyError, match="is already taken by"):
        candidate(north, "lab", keys / "22.pem", "station")
    with pytest.raises(PolicyError, match="is already taken by the station"):
        candidate(north, "lab", keys / "21.pem", "ca")
    for name in ("", " lab", "lab ", "a" * 101):
        with pytest.raises(UsageError, match="is not a valid name"):
            candidate(north, name, keys / "22.pem", "station")
    assert candidate(north, "a" * 100, keys / "22.pem", "station").record.name == "a" * 100
    with pytest.raises(UsageError):
        candidate(north, "a\x1b[31m", keys / "22.pem", "station")


def test_a_folder_of_keys_with_roles_by_name(north: Station, keys: Path) -> None:
    (keys / "lab.pem").write_text(to_pem(OTHER.point))
    (keys / "owner.ca.pem").write_text(to_pem(SoftwareKey(22).point))
    (keys / "own.pem").write_text(to_pem(north.point))
    (keys / "own.ca.pem").write_text(to_pem(north.ca))
    (keys / "README.md").write_text("Public keys.")
    found = candidates_of(north, keys, "station")
    assert [(found_key.record.name, found_key.record.role) for found_key in found] == [
        ("lab", "station"),
        ("owner", "ca"),
    ]
    add(north, found)
    assert SoftwareKey(22).point in north.policy.trusted_cas()


@pytest.mark.parametrize("kind", ["rsa", "p384"])
@pytest.mark.parametrize("name", ["a.pem", "zz.pem", "nested/key.pub", "zz.ca.pem"])
def test_a_folder_with_a_key_of_another_kind_is_refused_whole(north: Station, keys: Path, name: str, kind: str) -> None:
    (keys / "lab.pem").write_text(to_pem(OTHER.point))
    (keys / name).parent.mkdir(exist_ok=True)
    made = rsa.generate_private_key(65537, 1024) if kind == "rsa" else ec.generate_private_key(ec.SECP384R1())
    (keys / name).write_text(public(made))
    with pytest.raises(BadDataError, match="not a P-256 key"):
        candidates_of(north, keys, "station")


def test_which_files_of_a_folder_are_keys_and_of_whom(north: Station, keys: Path) -> None:
    owner, east = SoftwareKey(23), SoftwareKey(24)
    certificate = Certificate("the east", east.point, owner.point, owner.sign(station_key_message(east.point)))
    (keys / "east.cert").write_bytes(write_certificate(certificate))
    for name, number in (
        ("lab.pub", 25), ("own.ca.pub", 26), ("more.ca.pem", 27), (".hidden.pem", 28), ("notes.txt", 29)
    ):  # fmt: skip
        (keys / name).write_text(to_pem(SoftwareKey(number).point))
    (keys / "folder.pem").mkdir()
    found = candidates_of(north, keys, "station")
    assert [(one.record.name, one.record.role, one.record.point, one.certificate) for one in found] == [
        ("east", "station", east.point, certificate),
        ("lab", "station", SoftwareKey(25).point, None),
        ("more", "ca", SoftwareKey(27).point, None),
        ("own", "ca", SoftwareKey(26).point, None),
    ]
    add(north, found[:1])
    assert north.identity.certificate(owner.point, east.point) == certificate.signature


def bad_files() -> dict[str, bytes]:
    key = ec.generate_private_key(ec.SECP256R1())
    return {
        "key.pem": private(key),
        "nested/deep.txt": b"some text before\n" + private(key),
        **{f"old{suffix}": private(key, Encoding.DER) for suffix in (".key", ".der", ".p8", ".pk8", ".p12", ".pfx")},
        "jwk.json": json.dumps({"kty": "EC", "crv": "P-256", "d": "AA"}).encode(),
        "link.json": json.dumps({"kty": "oct", "k": "AA"}).encode(),
        "vault.json": b'{"format": "teds-provision-vault/1"}',
        "export.json": b'{"format": "teds-vault/1"}',
    }


@pytest.mark.parametrize("name", list(bad_files()))
def test_a_folder_that_holds_a_private_key_is_refused_whole(north: Station, keys: Path, name: str) -> None:
    (keys / "lab.pem").write_text(to_pem(OTHER.point))
    (keys / name).parent.mkdir(exist_ok=True)
    (keys / name).write_bytes(bad_files()[name])
    with pytest.raises(PolicyError, match="is for public keys"):
        candidates_of(north, keys, "station")
    assert north.policy.trusted() == []


def test_public_keys_in_der_and_what_git_keeps_are_no_private_keys(north: Station, keys: Path) -> None:
    (keys / "lab.pem").write_text(to_pem(OTHER.point))
    shared = ec.generate_private_key(ec.SECP256R1()).public_key()
    (keys / "lab.der").write_bytes(shared.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo))
    (keys / "lab.jwk").write_text(json.dumps({"kty": "EC", "crv": "P-256", "x": "AA", "y": "AA"}))
    (keys / ".git").mkdir()
    (keys / ".git" / "object").write_bytes(bad_files()["key.pem"])
    assert [found.record.name for found in candidates_of(north, keys, "station")] == ["lab"]


def test_the_keys_folder_of_this_workspace_holds_no_private_key() -> None:
    assert list(private_keys(ROOT / "keys")) == []


def test_no_private_key_is_under_version_control() -> None:
    """But for those of the test vectors, which are published on purpose."""
    try:
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git work tree")
    marker = b"-----BEGIN " + b"PRIVATE KEY-----"
    for name in listed.decode().split("\0"):
        path = ROOT / name
        if name and path.is_file() and not name.startswith("tests/"):
            assert marker not in path.read_bytes(), name


def test_an_empty_or_missing_folder(north: Station, keys: Path) -> None:
    for folder in (keys, keys / "none"):
        with pytest.raises(NotFoundError):
            candidates_of(north, folder, "station")


def test_a_certificate_that_does_not_verify(north: Station, keys: Path) -> None:
    forged = Certificate("lab", OTHER.point, north.ca, OTHER.sign(b"something else"))
    (keys / "lab.cert").write_bytes(write_certificate(forged))
    with pytest.raises(NotAuthenticError):
        candidate(north, "lab", keys / "lab.cert", "station")


@pytest.mark.parametrize(
    ("name", "good"), [("a", True), ("a" * 100, True), ("a" * 101, False), ("", False), ("a\tb", False)]
)
def test_the_name_in_a_request(name: str, good: bool) -> None:
    octets = make_request(name, OTHER)
    if good:
        assert read_request(octets) == CertificateRequest(name, OTHER.point)
    else:
        with pytest.raises(BadDataError, match="name"):
            read_request(octets)


def test_what_is_no_request_and_whose_is_not_signed(north: Station) -> None:
    with pytest.raises(BadDataError, match="contains a private key, not a request"):
        read_request(make_request("PRIVATE KEY", OTHER))
    with pytest.raises(PolicyError, match="names the CA's own key as a station"):
        sign_request(north, CertificateRequest("lab", north.ca))
    sign_request(north, CertificateRequest("lab", OTHER.point))
    sign_request(north, CertificateRequest("lab", OTHER.point))
    assert [entry.detail["name"] for entry in north.audit_log.entries() if entry.act == "certify"] == ["lab"]


def test_a_certificate_is_no_ca(north: Station, keys: Path) -> None:
    (keys / "lab.cert").write_bytes(write_certificate(sign_request(north, CertificateRequest("lab", OTHER.point))))
    with pytest.raises(UsageError) as caught:
        candidate(north, "lab", keys / "lab.cert", "ca")
    assert (caught.value.message.endswith("is a station's certificate, not a CA's key."), caught.value.hint) == (
        True, "Omit --role."
    )  # fmt: skip


def test_which_files_of_a_folder_are_keys(north: Station, keys: Path) -> None:
    pem = to_pem(OTHER.point)
    for name in ("a.pem", "b.pub", "c.ca.pub", ".hidden.pem", "d.txt"):
        (keys / name).write_text(pem)
    (keys / "deep").mkdir()
    (keys / "deep" / "e.pem").write_text(pem)
    found = [(key.record.name, key.record.role) for key in candidates_of(north, keys, "station")]
    assert found == [("a", "station"), ("b", "station"), ("c", "ca"), ("e", "station")]


def test_a_name_counts_before_the_digits_of_another_key(north: Station, keys: Path) -> None:
    digits = fingerprint(OTHER.point)
    for name, number in (("lab", 21), (digits[:8], 22)):
        (keys / "key.pem").write_text(to_pem(SoftwareKey(number).point))
        add(north, [candidate(north, name, keys / "key.pem", "station")])
    assert find_trusted(north, digits[:8]).point == SoftwareKey(22).point
    assert find_trusted(north, digits[:9]).point == OTHER.point


def test_a_key_that_was_removed_is_found_as_the_last_one_under_its_name_or_digits(north: Station, keys: Path) -> None:
    for number in (21, 22):
        (keys / "key.pem").write_text(to_pem(SoftwareKey(number).point))
        add(north, [candidate(north, "lab", keys / "key.pem", "station")])
        assert (find_removed(north, "lab") is None) is (number == 21), "only added"
        remove(north, find_trusted(north, "lab"))
    first, last = (fingerprint(SoftwareKey(number).point) for number in (21, 22))
    found = [find_removed(north, text) for text in ("lab", first[:8].upper(), spoken(last), first[:7], "la")]
    assert [key.fingerprint if key is not None else None for key in found] == [last, first, last, None, None]


def brought(
    north: Station, ca: bytes, peer: str, *, direction: str = "in", state: str = "imported", id: str = "h1"
) -> None:
    notes = BundleNotes((), "content", ca.hex(), "2026-03-08T08:00:00Z")
    north.handovers.put(Handover(id, direction, "copy", (peer,), state, notes.to_json()))  # type: ignore[arg-type]


def test_what_ends_with_the_trust_in_a_station(north: Station, keys: Path) -> None:
    west, ca, own_ca = SoftwareKey(22), SoftwareKey(23).point, SoftwareKey(24).point
    for name, point, role in (
        ("lab", OTHER.point, "station"),
        ("west", west.point, "station"),
        ("owner", own_ca, "ca"),
    ):
        (keys / "key.pem").write_text(to_pem(point))
        add(north, [candidate(north, name, keys / "key.pem", role)])  # type: ignore[arg-type]
    lab, other = fingerprint(OTHER.point), fingerprint(west.point)
    record = find_trusted(north, "lab")
    for number, (point, to, direction, state) in enumerate((
        (ca, lab, "in", "imported"), (own_ca, lab, "in", "imported"), (north.ca, lab, "in", "imported"),
        (SoftwareKey(25).point, lab, "out", "open"), (north.ca, lab, "out", "closed"), (north.ca, other, "out", "open"),
    )):  # fmt: skip
        brought(north, point, to, direction=direction, state=state, id=f"h{number}")
    plan = plan_removal(north, record)
    assert (plan.cas, plan.open, plan.bans, plan.shared, plan.under) == ((ca,), ("h3",), (), (), 0)
    brought(north, ca, other, id="h9")
    assert plan_removal(north, record).cas == (), "west brought it too"
    ends = plan_removal(north, find_trusted(north, "owner"))
    assert (ends.cas, ends.open) == ((own_ca,), ())


def test_the_ca_key_is_this_owners_and_trust_in_it_never_ends(north: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    assert require_ca(north).point == north.ca
    own = TrustRecord("own", "ca", north.ca, fingerprint(north.ca))
    assert plan_removal(north, own).cas == ()
    for key in (None, SoftwareKey(31)):
        monkeypatch.setattr(north.vault, "ca", lambda key=key: key)
        with pytest.raises(PolicyError, match=f"{fingerprint(north.ca)[:16]} is not in this vault"):
            require_ca(north)


def test_a_fingerprint_as_it_is_spoken() -> None:
    assert spoken("0123456789abcdef") == "0123 4567 89ab cdef"
