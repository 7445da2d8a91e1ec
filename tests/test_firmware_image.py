"""Image files: what imgtool signed is read; anything else is refused by name, whatever was done to it."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import BestAvailableEncryption, Encoding, PrivateFormat
from hypothesis import given
from hypothesis import strategies as st
from imgtool import keys

from teds_provision import firmware_image
from teds_provision.errors import BadDataError, NotAuthenticError, NotFoundError
from teds_provision.firmware_image import (
    FirmwareImage,
    load_firmware_image,
    load_key,
    public_pem,
    read_firmware_image,
    read_key,
)

from .firmware_images import make_key, sign


@pytest.fixture(scope="module")
def owner(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_key(tmp_path_factory.mktemp("owner") / "owner.pem")


@pytest.fixture(scope="module")
def image(owner: Path) -> FirmwareImage:
    return load_firmware_image(sign(owner.parent, "1.2.3+45", owner, counter=7), owner)


def test_an_image_names_its_version_board_counter_and_digest(image: FirmwareImage, owner: Path) -> None:
    assert (image.version, image.version_text) == ((1, 2, 3, 45), "1.2.3+45")
    assert (image.board, image.security_counter, image.signed) == ("virtual/finger", 7, True)
    assert image.digest != hashlib.sha256(image.octets).digest(), "MCUboot's digest is not that of the file"
    bare = load_firmware_image(sign(owner.parent, "2.0.0", owner, board=None))
    assert (bare.version_text, bare.board, bare.security_counter, bare.signed) == ("2.0.0", None, None, False)


def test_the_public_half_of_the_owners_key_is_enough(image: FirmwareImage, owner: Path) -> None:
    public = public_pem(load_key(owner))
    assert b"PRIVATE" not in public
    assert read_firmware_image(image.octets, read_key(public)) == image


def test_only_the_owners_signature_counts(image: FirmwareImage, owner: Path) -> None:
    rival = make_key(owner.parent / "rival.pem")
    with pytest.raises(NotAuthenticError, match="not signed with this key"):
        read_firmware_image(image.octets, load_key(rival))
    unsigned = sign(owner.parent, "3.0.0", None)
    assert load_firmware_image(unsigned).version_text == "3.0.0", "the board decides, if no key is given"
    with pytest.raises(NotAuthenticError, match="not signed with this key"):
        load_firmware_image(unsigned, owner)


def test_a_padded_image_is_refused_because_its_trailer_steers_the_boot_loader(
    owner: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, more in enumerate((("--pad",), ("--pad", "--confirm"))):
        padded = sign(owner.parent, f"4.0.{number}", owner, more=more)
        with pytest.raises(BadDataError, match="is padded"):
            load_firmware_image(padded, owner)
    whole = sign(owner.parent, "4.1.0", owner).read_bytes()
    for tail in (b"x", bytes(100)):
        with pytest.raises(BadDataError, match="is padded"):
            read_firmware_image(whole + tail)
    assert capsys.readouterr() == ("", ""), "imgtool's warnings do not reach our stdout"


@given(st.data())
def test_an_image_that_was_cut_or_changed_is_none(image: FirmwareImage, data: st.DataObject) -> None:
    octets = bytearray(image.octets)
    if data.draw(st.booleans(), label="cut"):
        del octets[data.draw(st.integers(0, len(octets) - 1)) :]
    else:
        octets[data.draw(st.integers(0, len(octets) - 1))] ^= data.draw(st.integers(1, 255))
    try:
        found = read_firmware_image(bytes(octets))
    except BadDataError:
        return
    assert found.digest == image.digest, "outside what the digest covers: the signature, or the hash of the key"
    assert found.version == image.version


def test_what_is_no_key_and_no_file_is_named(tmp_path: Path, owner: Path) -> None:
    with pytest.raises(NotFoundError):
        load_firmware_image(tmp_path / "none.bin")
    for octets in (b"", b"-----BEGIN PUBLIC KEY-----\nAAAA\n-----END PUBLIC KEY-----\n", b"\xff" * 40):
        with pytest.raises(BadDataError, match="not a firmware key"):
            read_key(octets)
    wrong = tmp_path / "wrong.bin"
    wrong.write_bytes(b"no image")
    with pytest.raises(BadDataError, match=r"wrong\.bin: This is not a whole MCUboot image"):
        load_firmware_image(wrong, owner)


@pytest.mark.parametrize("package", ["imgtool", "cbor2"])
def test_the_package_that_is_missing_is_named(owner: Path, monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "imgtool"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(NotFoundError, match=f"needs the package {package}\\."):
        read_firmware_image(b"")


def test_an_image_names_one_board_and_one_counter_at_most() -> None:
    """Of imgtool's reading of its TLVs: 0x10 SHA-256, 0x50 the security counter, 0x54A0 our name of the board."""

    def tlv(kind: int, octets: bytes) -> dict[str, Any]:
        return {"type": kind, "len": len(octets), "data": octets.hex()}

    board, other, counter = tlv(0x54A0, b"a"), tlv(0x54A0, b"b"), tlv(0x50, b"\x07\0\0\0")

    def named(*protected: dict[str, Any]) -> tuple[str | None, int | None]:
        area = {"tlvs_prot": list(protected), "tlvs": [tlv(0x10, bytes(32))]}
        return firmware_image._named_in({"tlv_area": area, "trailer": None}, bytes(32))

    assert named(board, counter) == ("a", 7)
    for protected in ((board, other), (board, board), (counter, counter)):
        with pytest.raises(BadDataError):
            named(*protected)


_DIGEST = bytes(range(32))


def _tlv(kind: int, octets: bytes, length: int | None = None) -> dict[str, Any]:
    """Return a TLV as imgtool lists it: of a cut one there is less than its length."""
    return {"type": kind, "len": len(octets) if length is None else length, "data": octets.hex()}


def _named(protected: list[dict[str, Any]], beside: list[dict[str, Any]], digest: bytes = _DIGEST) -> tuple[Any, Any]:
    info = {"tlv_area": {"tlvs_prot": protected, "tlvs": [_tlv(0x10, _DIGEST), *beside]}, "trailer": None}
    return firmware_image._named_in(info, digest)


def test_what_is_not_protected_by_the_signature_names_no_board_and_counts_nothing() -> None:
    assert _named([], [_tlv(0x54A0, b"evil"), _tlv(0x50, b"\7\0\0\0")]) == (None, None)
    assert _named([_tlv(0x54A0, b"good"), _tlv(0x50, b"\1\2\0\0")], [_tlv(0x54A0, b"evil")]) == ("good", 513)


@pytest.mark.parametrize(
    ("protected", "beside"),
    [
        ([_tlv(0x54A0, b"boa", 5)], []),
        ([], [_tlv(0x22, b"\x30", 70)]),
        ([], [_tlv(0x10, _DIGEST)]),
        ([], [_tlv(0x12, bytes(64))]),
    ],
    ids=["a cut board", "a cut signature", "the digest twice", "another digest"],
)
def test_tlvs_that_are_cut_or_that_name_two_digests_are_none(
    protected: list[dict[str, Any]], beside: list[dict[str, Any]]
) -> None:
    assert _named([], []) == (None, None)
    with pytest.raises(BadDataError, match="not a whole MCUboot image"):
        _named(protected, beside)


def test_the_digest_that_was_computed_is_that_of_the_image() -> None:
    with pytest.raises(BadDataError, match="not a whole MCUboot image"):
        _named([], [], bytes(32))


def test_a_board_is_shown_as_text_that_steers_no_terminal() -> None:
    (board, _) = _named([_tlv(0x54A0, "nrf/\x1b[31m\u202eloadcell".encode())], [])
    assert "\x1b" not in board
    assert "\u202e" not in board
    with pytest.raises(BadDataError, match="not UTF-8"):
        _named([_tlv(0x54A0, b"\xff")], [])


def test_of_a_longer_digest_the_first_32_octets_count(tmp_path: Path) -> None:
    keys.ECDSA384P1.generate().export_private(str(tmp_path / "owner.pem"))
    signed = load_firmware_image(sign(tmp_path, "1.0.0", tmp_path / "owner.pem"))
    at = signed.octets.index(b"\x11\0\x30\0") + 4
    assert signed.digest == signed.octets[at : at + 32]


def test_a_key_with_a_passphrase_is_bad_data_with_the_way_out() -> None:
    pem = ec.generate_private_key(ec.SECP256R1()).private_bytes(
        Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"secret")
    )
    with pytest.raises(BadDataError, match="encrypted with a passphrase") as refused:
        read_key(pem)
    assert "getpub" in refused.value.hint
