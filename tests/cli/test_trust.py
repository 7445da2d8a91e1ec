"""``trust`` and ``init --request`` as typed."""

from __future__ import annotations

from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from teds_provision.handover.trust import spoken
from teds_provision.protocol.keys import SoftwareKey, fingerprint, to_pem
from tests.bench import PASSPHRASE
from tests.terminal import on_terminal

from .shell import Outcome, call, python, spawn

KEY = SoftwareKey(51)
DIGITS = fingerprint(KEY.point)


@pytest.fixture
def pem(tmp_path: Path) -> Path:
    path = tmp_path / "keys" / "lab.pem"
    path.parent.mkdir()
    path.write_text(to_pem(KEY.point))
    return path


def unlocked(home: Path, *words: object) -> Outcome:
    return spawn("--home", home, "--json", *words, passphrase=PASSPHRASE)


def pem_of_another(folder: Path) -> Path:
    """Return a file that holds something else."""
    path = folder / "other.pem"
    path.write_text("another file")
    return path


def test_add_list_remove(home: Path, pem: Path) -> None:
    assert call(home, "--json", "trust", "add", "lab", pem).code == 6
    plan = call(home, "--json", "trust", "add", "lab", pem, "--dry-run")
    assert (plan.json["plan"], plan.json["added"]) == (True, 1)
    assert call(home, "--json", "trust", "list").json["trusted"] == []
    assert (
        spawn("--home", home, "--json", "trust", "add", "lab", pem, "--yes").code == 7
    )  # it changes what is sealed by the vault
    added = unlocked(home, "trust", "add", "lab", pem, "--yes")
    assert added.json == {"trusted": [{"name": "lab", "role": "station", "fingerprint": DIGITS}], "added": 1}
    assert call(home, "--json", "trust", "add", "lab", pem, "--yes").json["added"] == 0
    (listed,) = call(home, "--json", "trust", "list").json["trusted"]
    assert (listed["name"], listed["role"], listed["fingerprint"]) == ("lab", "station", DIGITS)
    assert call(home, "--json", "trust", "remove", "lab").code == 6
    assert spawn("--home", home, "--json", "trust", "remove", "lab", "--yes").code == 7
    removed = unlocked(home, "trust", "remove", DIGITS[:32], "--yes").json
    assert removed["removed"]["name"] == "lab"
    assert removed["ends"] == {"rotations": [], "cas": [], "nodes_under_them": 0, "bans": [], "open_handovers": []}
    for words in (["lab", "--yes"], ["lab"], [DIGITS[:32], "--no-input"], ["lab", "--dry-run"]):
        again = call(home, "--json", "trust", "remove", *words)
        assert (again.code, again.json) == (0, removed | {"fresh": False})
    assert call(home, "trust", "remove", "lab").out.startswith(
        f"Nothing to do: the station lab, {DIGITS[:32]}, is not trusted any more since 20"
    )
    assert call(home, "--json", "trust", "remove", "lap", "--yes").code == 3, "a key that was never trusted"
    assert unlocked(home, "trust", "add", "lab", pem, "--yes").json["added"] == 1
    assert call(home, "--json", "trust", "remove", "lab").code == 6, "it is trusted again"


def test_the_whole_fingerprint_is_shown_to_compare(home: Path, pem: Path) -> None:
    assert spoken(DIGITS) in call(home, "trust", "add", "lab", pem, "--yes").err


def test_a_folder(home: Path, pem: Path) -> None:
    (pem.parent / "owner.ca.pem").write_text(to_pem(SoftwareKey(52).point))
    added = unlocked(home, "trust", "add", "--from", pem.parent, "--yes")
    assert [(item["name"], item["role"]) for item in added.json["trusted"]] == [("lab", "station"), ("owner", "ca")]
    key = ec.generate_private_key(ec.SECP256R1())
    (pem.parent / "oops.txt").write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    refused = call(home, "--json", "trust", "add", "--from", pem.parent, "--yes")
    assert (refused.code, refused.json["error"]["code"]) == (6, "refused")


@pytest.mark.parametrize("digits", [DIGITS, DIGITS[:32], spoken(DIGITS).upper()])
def test_a_key_is_trusted_by_the_digits_that_its_owner_read_out_and_by_no_others(
    home: Path, pem: Path, digits: str
) -> None:
    other = digits[:-1] + ("0" if digits[-1] != "0" else "1")
    refused = call(home, "--json", "trust", "add", "lab", pem, "--fingerprint", other, "--yes")
    assert (refused.code, refused.json["error"]["code"]) == (6, "other-key")
    assert call(home, "--json", "trust", "list").json["trusted"] == []
    added = call(home, "--json", "trust", "add", "lab", pem, "--fingerprint", digits)
    assert (added.code, added.json["added"]) == (0, 1), "nobody is asked"


def test_usage(home: Path, pem: Path) -> None:
    for words in ([], ["lab"], ["lab", pem, "--from", pem.parent], ["--from", pem.parent, "--fingerprint", DIGITS]):
        assert call(home, "--json", "trust", "add", *words).code == 2
    assert call(home, "--json", "trust", "add", "lab", pem.parent / "none.pem", "--yes").code == 3


def test_a_station_without_its_own_ca(home: Path, tmp_path: Path) -> None:
    east, asked, cert = tmp_path / "east", tmp_path / "east.request", tmp_path / "east.cert"
    for _ in range(2):
        made = unlocked(east, "init", "--name", "east", "--keystore", "file", "--request", asked)
        assert (made.code, made.json["ca"]) == (0, None), made
    assert "init --certificate" in unlocked(east, "nodes").json["error"]["hint"]
    assert unlocked(home, "trust", "ca", "sign", asked, "--output", cert).code == 6
    assert unlocked(home, "trust", "ca", "sign", asked, "--output", cert, "--dry-run").json["plan"] is True
    assert not cert.exists()
    for fresh in (True, False):
        signed = unlocked(home, "trust", "ca", "sign", asked, "--output", cert, "--yes").json
        assert (signed["name"], signed["fingerprint"], signed["fresh"]) == ("east", made.json["fingerprint"], fresh)
    assert unlocked(east, "init", "--certificate", cert).code == 6
    for _ in range(2):
        done = unlocked(east, "init", "--certificate", cert, "--yes")
        assert done.code == 0, done
        assert done.json["ca"]["fingerprint"] == signed["ca"]
    assert unlocked(east, "trust", "ca", "create").code == 6
    unlocked(tmp_path / "west", "init", "--keystore", "file", "--request", tmp_path / "west.request")
    refused = unlocked(east, "trust", "ca", "sign", tmp_path / "west.request", "--output", tmp_path / "x", "--yes")
    assert refused.code == 3


def test_the_ca_key_away_and_back(home: Path, tmp_path: Path) -> None:
    path = tmp_path / "ca.pem"
    shown = unlocked(home, "trust", "ca", "create").json["fingerprint"]
    assert unlocked(home, "trust", "ca", "export", path).json == {"file": str(path), "fresh": True}
    octets = path.read_bytes()
    assert unlocked(home, "trust", "ca", "export", path).json == {"file": str(path), "fresh": False}
    other = spawn("--home", home, "--json", "trust", "ca", "export", pem_of_another(tmp_path), passphrase=PASSPHRASE)
    assert (other.code, path.read_bytes()) == (7, octets)
    assert path.stat().st_mode & 0o777 == 0o600
    assert b"ENCRYPTED" in path.read_bytes()
    assert unlocked(home, "trust", "ca", "drop").code == 6
    assert unlocked(home, "trust", "ca", "drop", "--dry-run").json == {"dropped": True, "plan": True}
    assert unlocked(home, "trust", "ca", "create").code == 0, "a plan drops nothing"
    assert [unlocked(home, "trust", "ca", "drop", "--yes").json["dropped"] for _ in range(2)] == [True, False]
    assert unlocked(home, "trust", "ca", "drop", "--dry-run").json == {"dropped": False, "plan": True}
    plan = unlocked(home, "trust", "ca", "import", path, "--dry-run")
    assert plan.json == {"fingerprint": shown, "plan": True}
    assert unlocked(home, "trust", "ca", "create").code == 6, "a plan imports nothing"
    assert unlocked(home, "trust", "ca", "import", path).json["fingerprint"] == shown
    assert unlocked(home, "trust", "ca", "create").code == 0


@pytest.mark.nightly("tests/cli/test_help.py::test_the_help_of_no_command_loads_anything_heavy, of every command")
@pytest.mark.parametrize("words", [["trust"], ["export-keys"], ["import-keys"], ["handover"], ["revoke"], ["init"]])
def test_help_loads_no_cryptography(words: list[str]) -> None:
    script = (
        "import sys\nfrom teds_provision.cli.main import run\n"
        f"code = run({[*words, '--help']!r})\n"
        "heavy = {'cryptography', 'nfc', 'can', 'keyring', 'rich', 'numpy', 'pint'} & set(sys.modules)\n"
        "print('HEAVY', sorted(heavy), code)"
    )
    done = python(script)
    assert done.out.splitlines()[-1] == "HEAVY [] 0"
    assert "Examples:" in done.out


def test_each_key_of_a_folder_is_asked_for(home: Path, pem: Path) -> None:
    (pem.parent / "west.pem").write_text(to_pem(SoftwareKey(53).point))
    words = ("trust", "add", "--from", pem.parent)
    done = on_terminal(home, *words, streams=["stdin"], answers=["n", "y"], passphrase=PASSPHRASE)
    assert done.code == 0, done
    assert spoken(DIGITS) in done.err
    assert done.out == "Now trusted: west.\n"
    assert [item["name"] for item in call(home, "--json", "trust", "list").json["trusted"]] == ["west"]
