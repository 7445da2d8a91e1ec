"""``config.toml``, ``config``, ``completion``: names and values are checked, sources told, words completed."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, cast

import click
import pytest

from teds_provision.cli.config_file import Defaults, anchored, brokers_of, home_of, problems, read_config
from teds_provision.cli.main import _read_config, cli, run
from teds_provision.cli.station.config import _edited
from teds_provision.errors import BadDataError

from .shell import call, clean_environment

ROOT = Path(__file__).resolve().parents[2]
UUID = "8d4d9da65281f7000000"


@pytest.mark.needs_room("plant")
def test_what_follows_from_the_command_line_is_up_to_date() -> None:
    script = ROOT / "scripts" / "options.py"
    if not script.exists():
        pytest.skip("the scripts are not part of this installation")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, str(script), "--check"], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{done.stdout}{done.stderr}Write them: make man"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('cann = "x"', "line 1: no command has an option --cann. Did you mean 'can'?"),
        ("[provisoin]\nyes = true", "line 1: there is no command 'provisoin'. Did you mean 'provision'?"),
        ("[verify]\n\nprofile = 'x'", "line 3: verify has no option --profile."),
        ("[whitelist.ad]\nname = 'x'", "there is no command 'whitelist ad'."),
        ("passphrase-fd = 3", "line 1: no command has an option --passphrase-fd."),
        ("can = ", "is not valid TOML"),
    ],
)
def test_a_name_that_nothing_knows_is_an_error_with_its_line(home: Path, text: str, message: str) -> None:
    (home / "config.toml").write_text(text)
    done = call(home, "--json", "nodes")
    assert done.code == 8
    assert message in done.json["error"]["message"]


def test_config_show_names_values_and_where_they_come_from(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "config.toml").write_text('can = "socketcan:can9"\n[provision]\ntimeout = 5\n')
    monkeypatch.setenv("TEDS_PROVISION_VIA", "can")
    settings = call(home, "--json", "config", "show").json["settings"]
    assert {(row["name"], str(row["value"])) for row in settings[1:]} == {
        ("via", "can"),
        ("can", "socketcan:can9"),
        ("provision.timeout", "5"),
    }
    assert [row["source"] for row in settings if row["name"] == "via"] == ["environment (TEDS_PROVISION_VIA)"]
    assert call(home, "--json", "config", "path").json == {"path": str(home / "config.toml"), "exists": True}


def test_a_commands_own_table_goes_before_its_groups_and_that_before_what_stands_outside_of_tables() -> None:
    zero = {"timeout": 7}
    defaults = Defaults({"timeout": 40, "provision": {"timeout": 5}, "calibrate": {"timeout": 6, "zero": zero}})
    assert [defaults.get(command)["timeout"] for command in ("verify", "provision")] == [40, 5]
    calibrate = defaults.get("calibrate")
    assert [calibrate.get(command)["timeout"] for command in ("capture", "zero")] == [6, 7]


def test_a_bad_value_is_named_before_it_hurts(home: Path) -> None:
    (home / "config.toml").write_text('[provision]\ntimeout = "soon"\n')
    done = call(home, "--json", "config", "show")
    assert (done.code, "provision.timeout = 'soon'" in done.json["error"]["message"]) == (8, True)


def options(command: click.Command = cli, *path: str) -> Iterator[tuple[tuple[str, ...], click.Option, str]]:
    """Yield every option of every command but flags, with its name on the command line."""
    for option in command.params:
        long = next((name[2:] for name in option.opts if name.startswith("--")), "")
        if isinstance(option, click.Option) and path and long and not option.is_flag:
            yield path, option, long
    context = click.Context(command)
    for name in command.list_commands(context) if isinstance(command, click.Group) else ():
        inner = command.get_command(context, name)
        assert inner is not None
        yield from options(inner, *path, name)


def test_each_option_is_read_from_file_and_variable_by_its_own_name(monkeypatch: pytest.MonkeyPatch) -> None:
    for path, option, name in options():
        nested: dict[str, Any] = {name: "x"}
        for word in reversed(path):
            nested = {word: nested}
        found: Any = Defaults(nested)
        for word in path:
            found = found.get(word)
        assert found == {option.name: ["x"] if option.multiple else "x"}, f"{path} --{name}"
        variable = f"TEDS_PROVISION_{name.replace('-', '_').upper()}"
        with monkeypatch.context() as patched:
            patched.setenv(variable, "x")
            context = click.Context(cli, auto_envvar_prefix="TEDS_PROVISION")
            assert option.resolve_envvar_value(context) == "x", f"{variable} of {path}"


def test_a_setting_for_all_commands_reaches_those_that_have_the_option_and_no_other_parameter() -> None:
    root = Defaults({"can": "socketcan:can0", "files": "carried", "timeout": 5})
    assert root.get("measure") == {"can": ["socketcan:can0"], "timeout": 5}  # --to is what the code calls files
    assert root.get("ncap").get("run") == {"can": ["socketcan:can0"]}
    assert root.get("doctor") == {"can": "socketcan:can0"}
    two = Defaults({"can": ["socketcan:can0", "socketcan:can1"]})
    assert two.get("ncap").get("run") == {"can": ["socketcan:can0", "socketcan:can1"]}
    assert two.get("doctor") == {}  # which opens one


def test_what_takes_one_value_is_not_given_several(home: Path) -> None:
    (home / "config.toml").write_text('[doctor]\ncan = ["socketcan:can8", "socketcan:can9"]\n')
    done = call(home, "--json", "doctor")
    assert (done.code, done.json["error"]["message"]) == (8, "config.toml: doctor takes one --can, and 2 are named.")


def test_one_bus_in_the_file_is_the_bus_of_the_service(home: Path) -> None:
    assert call(home, "config", "set", "can", "socketcan:can0?bitrat=1").code == 0
    done = call(home, "--json", "ncap", "run")
    assert (done.code, "bitrat" in done.json["error"]["message"]) == (2, True), done.json


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_shell_gets_its_lines(home: Path, shell: str) -> None:
    assert "_TEDS_PROVISION_COMPLETE" in call(home, "completion", shell).out


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("verify 8d", UUID),
        ("verify fin", "finger"),
        ("provision --profile accel", "accelerometer"),
        ("white", "whitelist"),
        ("agree --rot", "--rotate"),
    ],
)
def test_a_shell_is_offered_what_fits(home: Path, words: str, offered: str) -> None:
    assert call(home, "whitelist", "add", UUID, "--name", "finger").code == 0
    line = f"teds-provision {words}"
    asked = {
        "_TEDS_PROVISION_COMPLETE": "bash_complete",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(line.split()) - 1),
        "TEDS_PROVISION_HOME": str(home),
    }
    done = subprocess.run(
        [sys.executable, "-m", "teds_provision"],
        env=clean_environment() | asked,
        capture_output=True,
        text=True,
        check=False,
    )
    assert offered in [row.partition(",")[2] for row in done.stdout.splitlines()], done.stdout + done.stderr


def test_a_setting_is_written_beside_the_others_and_removed_again(home: Path) -> None:
    file = home / "config.toml"
    before = '# the bench\n\ncan = "socketcan:can9"  # left\n\n[provision]  # one\n# patience\ntimeout = 5\n'
    file.write_text(before)
    assert call(home, "config", "set", "can", "socketcan:can0#1").code == 0
    assert call(home, "config", "set", "provision.via", "can").code == 0
    assert call(home, "config", "set", "whitelist.add.dry-run", "true").code == 0
    assert call(home, "config", "set", "timeout", "2.5").code == 0
    assert call(home, "config", "set", "ncap.brokers.lab", "mqtts://lab").code == 0
    assert file.read_text() == (
        '# the bench\n\ncan = "socketcan:can0#1"  # left\ntimeout = 2.5\n\n'
        '[provision]  # one\n# patience\ntimeout = 5\nvia = "can"\n\n'
        '[whitelist.add]\ndry-run = true\n\n[ncap.brokers]\nlab = "mqtts://lab"\n'
    )
    settings = call(home, "--json", "config", "set", "provision.via", "can").json["settings"]
    assert settings == [{"name": "provision.via", "value": "can", "source": str(file)}]
    for name in ("provision.via", "whitelist.add.dry_run", "timeout", "ncap.brokers.lab"):
        assert call(home, "config", "unset", name).code == 0
    file.write_text(file.read_text().replace("\n[whitelist.add]\n", "").replace("\n[ncap.brokers]\n", ""))
    assert file.read_text() == before.replace("can9", "can0#1")
    assert call(home, "--json", "config", "unset", "provision.via").json["removed"] is None


WRITTEN = """\
# at the bench
can = "socketcan:can1" # the left one

[provision]
# over the bus
via = "nfc"
yes = true

[whitelist.add]
dry-run = true
"""


def test_what_each_change_says_and_the_whole_file_after_it(home: Path) -> None:
    file = home / "config.toml"
    assert call(home, "config", "set", "can", "socketcan:can0").out == 'Set can = "socketcan:can0"\n'
    assert file.read_text() == 'can = "socketcan:can0"\n'
    file.write_text('# at the bench\ncan = "socketcan:can0" # the left one\n')
    for words, text in (
        ("set can socketcan:can1", 'Set can = "socketcan:can1"'),
        ("set can socketcan:can1", 'Nothing to do: can = "socketcan:can1"'),
        ("set provision.via nfc", 'Set provision.via = "nfc"'),
        ("set whitelist.add.dry-run true", "Set whitelist.add.dry-run = true"),
        ("set provision.yes true", "Set provision.yes = true"),
        ("unset nfc", "Nothing to do: nfc is not set in config.toml."),
    ):
        done = call(home, "config", *words.split())
        assert (done.code, done.out) == (0, f"{text}\n"), words
    assert file.read_text() == WRITTEN.replace("# over the bus\n", "")
    file.write_text(WRITTEN)
    assert call(home, "config", "unset", "provision.yes").out == "Removed provision.yes.\n"
    assert call(home, "--json", "config", "unset", "provision.yes").json == {"settings": [], "removed": None}
    assert file.read_text() == WRITTEN.replace("yes = true\n", "")
    assert call(home, "--json", "config", "set", "provision.yes", "true").json == {
        "settings": [{"name": "provision.yes", "value": True, "source": str(file)}]
    }
    assert file.read_text() == WRITTEN, "behind the last setting of its table"


def test_a_line_is_put_where_a_person_would_put_it() -> None:
    for text, table, key, value, after in (
        ("", "", "can", "x", 'can = "x"\n'),
        ("", "provision", "via", "can", '[provision]\nvia = "can"\n'),
        ("can = 1\n", "provision", "via", "can", 'can = 1\n\n[provision]\nvia = "can"\n'),
        ("# head\n# more\n\n[log]\nlast = 5\n", "", "can", "x", '# head\n# more\ncan = "x"\n\n[log]\nlast = 5\n'),
        ("[x]\nrate = 5\n# to\n\n[verify]\n", "x", "kind", 1, "[x]\nrate = 5\nkind = 1\n# to\n\n[verify]\n"),
        ("[x]\n# none\n[verify]\nyes = true\n", "x", "kind", 1, "[x]\nkind = 1\n# none\n[verify]\nyes = true\n"),
        ('can = "a#b" # c#d\n', "", "can", "y", 'can = "y" # c#d\n'),
        ("can = 1\n[x]\ncan = 2\n", "x", "can", None, "can = 1\n[x]\n"),
        ("can = 1\n[x]\ncan = 2\n", "", "can", None, "[x]\ncan = 2\n"),
        ("[x]\ncan = 2\n", "", "can", None, "[x]\ncan = 2\n"),
        ("[x]\nno_scalars = true\n", "x", "no-scalars", False, "[x]\nno_scalars = false\n"),
        ('["x"]\ncan = 2\n', "x", "can", "y", '["x"]\ncan = "y"\n'),
        ("[ 'x' . import_keys ]\ncan = 2\n", "x import-keys", "can", "y", "[ 'x' . import_keys ]\ncan = \"y\"\n"),
        ("[x]\na = 1\n[y]\n[x.y]\na = 2\n", "x y", "a", 3, "[x]\na = 1\n[y]\n[x.y]\na = 3\n"),
        ("can = 1\n", "log", "last", None, "can = 1\n"),
    ):  # fmt: skip
        assert _edited(text, table.split(), key, value) == after, (text, table, key)


def test_where_the_home_was_named(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in (None, str(home)):
        with monkeypatch.context() as patch:
            if variable is not None:
                patch.setenv("TEDS_PROVISION_HOME", variable)
            (found,) = call(home, "--json", "config", "show").json["settings"]
            assert found == {"name": "home", "value": str(home), "source": "--home"}, "the command line goes first"
    monkeypatch.setenv("TEDS_PROVISION_HOME", str(home))
    out = io.StringIO()
    with redirect_stdout(out):
        assert run(["--json", "config", "show"]) == 0
    (found,) = json.loads(out.getvalue())["settings"]
    assert found == {"name": "home", "value": str(home), "source": "environment (TEDS_PROVISION_HOME)"}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("cann", "x"),
        ("verify.profile", "x"),
        ("timeout", "soon"),
        ("provision.watch", "perhaps"),
        ("home", "/tmp"),
        ("can", "can0"),
        ("can", '["socketcan:can0", "can1"]'),
        ("timeout", "[5]"),
        ("measure.rate", "[1, 2]"),
    ],
)
def test_a_setting_that_no_command_takes_is_not_written(home: Path, name: str, value: str) -> None:
    assert call(home, "config", "set", name, value).code == 2
    assert not (home / "config.toml").exists()


def test_several_values_are_one_setting_of_the_commands_that_take_several(home: Path) -> None:
    buses = '["socketcan:can0", "socketcan:can1"]'
    assert call(home, "config", "set", "can", buses).code == 0
    assert (home / "config.toml").read_text() == f"can = {buses}\n"
    assert call(home, "config", "show").code == 0
    (home / "config.toml").write_text("[measure]\nrate = [1, 2]\n")
    done = call(home, "config", "show")
    assert done.code == 8
    assert "measure.rate takes one value, not 2" in done.err


def test_a_broker_keeps_the_name_that_it_was_given(home: Path) -> None:
    """An option may be written with ``_`` or ``-``; a request names a broker, letter by letter."""
    brokers = {"plant_1": "mqtts://one", "plant-1": "mqtts://two", "a+b": "mqtts://three"}
    for name, url in brokers.items():
        assert call(home, "config", "set", f"ncap.brokers.{name}", url).code == 0
    assert brokers_of(home / "config.toml") == brokers
    assert call(home, "config", "unset", "ncap.brokers.plant_1").code == 0
    del brokers["plant_1"]
    assert brokers_of(home / "config.toml") == brokers


def test_settings_may_come_before_the_station(tmp_path: Path) -> None:
    home = tmp_path / "below" / "new"
    assert call(home, "--json", "config", "unset", "nfc").json["removed"] is None
    assert not home.exists()
    assert call(home, "config", "set", "nfc", "usb").code == 0
    assert home.stat().st_mode & 0o777 == 0o700
    made = call(home, "init", "--keystore", "file")
    assert made.code == 0, made.err
    assert [setting["value"] for setting in call(home, "--json", "config", "show").json["settings"]][1:] == ["usb"]


def test_a_file_that_says_it_otherwise_is_left_to_its_owner(home: Path) -> None:
    (home / "config.toml").write_text('provision = { via = "can" }\n')
    assert call(home, "config", "set", "provision.via", "nfc").code == 8
    assert (home / "config.toml").read_text() == 'provision = { via = "can" }\n'


def test_a_path_in_the_file_means_the_same_file_wherever_the_command_is_typed(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere, here = tmp_path / "elsewhere", tmp_path / "here"
    elsewhere.mkdir()
    here.mkdir()
    (elsewhere / "gripper.toml").write_text("this is another profile")
    (here / "gripper.toml").write_text((ROOT / "profiles" / "gripper.toml").read_text())
    image = tmp_path / "image.json"
    monkeypatch.chdir(here)
    assert call(home, "config", "set", "profile", "./gripper.toml").code == 0
    assert call(home, "config", "set", "build.output", "../image.json").code == 0
    monkeypatch.chdir(elsewhere)
    assert call(home, "whitelist", "add", UUID, "--fingerprint", "ab" * 32).code == 0
    done = call(home, "build", UUID)
    assert done.code == 0, done.err
    assert image.is_file()


def test_a_relative_path_in_the_file_starts_at_the_folder_of_the_file() -> None:
    settings = {
        "trace": "frames.pcapng",
        "provision": {"profile": "own/arm.toml", "name": "a/b"},
        "build": {"profile": "arm.toml", "calibration": "~/arm.csv"},
        "profile": "gripper",
        "node": {"create": {"profile": "types/arm", "teds": ["a.json", "/b.json"]}},
        "backup": {"to": "office.pem"},
        "measure": {"to": ["run.csv", "mqtt:lab"]},
        "export-keys": {"to": "north"},
        "ncap": {
            "brokers": {
                "lab": "mqtts://a@lab?password-file=secret/arm&ca=/etc/ca.pem",
                "office": "mqtts://office?ca=own/ca.pem&cert=arm.pem&key=../arm.key&qos=1",
            }
        },
    }
    folder = Path("/etc/teds")
    assert anchored(settings, folder) == {
        "trace": "/etc/teds/frames.pcapng",
        "profile": "gripper",
        "provision": {"profile": "/etc/teds/own/arm.toml", "name": "a/b"},
        "build": {"profile": "/etc/teds/arm.toml", "calibration": str(Path.home() / "arm.csv")},
        "node": {"create": {"profile": "/etc/teds/types/arm", "teds": ["/etc/teds/a.json", "/b.json"]}},
        "backup": {"to": "/etc/teds/office.pem"},
        "measure": {"to": ["/etc/teds/run.csv", "mqtt:lab"]},
        "export-keys": {"to": "north"},
        "ncap": {
            "brokers": {
                "lab": "mqtts://a@lab?password-file=/etc/teds/secret/arm&ca=/etc/ca.pem",
                "office": "mqtts://office?ca=/etc/teds/own/ca.pem&cert=/etc/teds/arm.pem&key=/etc/arm.key&qos=1",
            }
        },
    }
    assert anchored(anchored(settings, folder), Path("/elsewhere")) == anchored(settings, folder)


@pytest.mark.parametrize(
    ("values", "text", "found"),
    [
        ({"dry_run": True, "export_keys": {"all": True}, "whitelist": {"dry-run": True}}, "", []),
        ({"whitelist": {"add": {"name": "x"}}, "ncap": {"brokers": {"any_name": "mqtt://h"}}}, "", []),
        ({"home": "/x"}, "home = '/x'", ["line 1: no command has an option --home."]),
        ({"passphrase-fd": 3}, "\n\npassphrase-fd = 3", ["line 3: no command has an option --passphrase-fd."]),
        (
            {"sign": {"jump": True}},  # signer once has one
            "[sign]\njump = true",
            ["line 2: sign has no option --jump."],
        ),
        ({"provision": {"help": True}}, "[provision]\nhelp = true", ["line 2: provision has no option --help."]),
        ({"whitelist": {"watch": True}}, "[whitelist]\nwatch = true", ["line 2: whitelist has no option --watch."]),
        ({"whitelist": {"add": {"watch": 1}}}, "[whitelist.add]\nwatch = 1", [
            "line 2: whitelist add has no option --watch."]),
        ({"whitelist": {"ad": {}}}, "[whitelist.ad]", ["line 1: there is no command 'whitelist ad'."]),
        ({"provison": {}}, "# provison\nname = 'provison'\n[ provison ]", [
            "line 3: there is no command 'provison'. Did you mean 'provision'?"]),
        ({"ncap": {"brokers": {"lab": 7}}}, "[ncap.brokers]\nlab = 7", [
            'line 2: a broker is named with its URL: lab = "mqtts://HOST".']),
        ({"profil": "x", "watsh": 1}, "profil = 'x'\n'watsh' = 1", [
            "line 1: no command has an option --profil. Did you mean 'profile'?",
            "line 2: no command has an option --watsh. Did you mean 'watch'?",
        ]),
        ({"a" * 50: 1}, "", [f"line 1: no command has an option --{'a' * 40}."]),
    ],
)  # fmt: skip
def test_each_name_that_no_command_knows_is_a_problem_with_its_line(
    values: dict[str, Any], text: str, found: list[str]
) -> None:
    said = list(problems(values, text))
    assert len(said) == len(found)
    assert all(problem.startswith(start) for problem, start in zip(said, found, strict=True)), said


def test_a_home_may_be_named_from_that_of_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/users/ada")
    assert home_of(Path("~/bench")) == Path("/users/ada/bench")
    assert home_of(Path("bench")) == Path("bench")


def test_a_value_is_checked_as_its_own_command_takes_it(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert call(home, "--json", "config", "path").json["exists"] is False
    (home / "config.toml").write_text('[ncap.run]\nble = ["hci0", "hci1"]\nrate = 5\n[update]\nparallel = 24\n')
    done = call(home, "--json", "config", "show")
    assert done.code == 0, done
    assert [(row["name"], row["value"]) for row in done.json["settings"][1:]] == [
        ("ncap.run.ble", ["hci0", "hci1"]), ("ncap.run.rate", 5), ("update.parallel", 24),
    ]  # fmt: skip
    assert done.err == ""
    for text, message in (
        ('[provision]\nble = ["hci0", "hci1"]\n', "provision.ble takes one value, not 2."),
        ("[update]\nparallel = 25\n", "update.parallel = 25: 25 is not in the range 1<=x<=24."),
        ("[update]\nwait = 0\n", "update.wait = 0: 0.0 is not in the range 1<=x<=3600."),
    ):
        (home / "config.toml").write_text(text)
        refused = call(home, "--json", "config", "show")
        assert refused.code == 8
        assert refused.json["error"]["message"].endswith(f"config.toml: {message}"), refused
    (home / "config.toml").unlink()
    monkeypatch.setenv("TEDS_PROVISION_BITRATE", "5")
    warned = call(home, "--json", "config", "show")
    assert (warned.code, warned.err) == (
        0, "Warning: TEDS_PROVISION_BITRATE is set, but no command has an option --bitrate.\n",
    )  # fmt: skip
    assert warned.json["settings"][1:] == [
        {"name": "bitrate", "value": "5", "source": "environment (TEDS_PROVISION_BITRATE)"}
    ]


def test_a_command_reads_the_relative_paths_of_the_file_from_its_folder(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text('trace = "frames.pcapng"\n[backup]\nto = "copy.tpbk"\n')
    context = click.Context(click.Command("teds-provision"))
    assert _read_config(context, cast(Any, None), tmp_path) == tmp_path
    assert context.default_map is not None
    assert context.default_map["trace"] == str(tmp_path / "frames.pcapng")
    assert context.default_map["backup"]["to"] == str(tmp_path / "copy.tpbk")


def test_a_link_to_a_file_that_is_gone_is_no_missing_file(home: Path) -> None:
    """Settings that were meant to apply are not passed over without a word."""
    (home / "config.toml").symlink_to(home / "gone.toml")
    refused = call(home, "--json", "nodes")
    assert (refused.code, refused.json["error"]["message"]) == (8, f"There is no file {home / 'config.toml'}.")


@pytest.mark.parametrize(("value", "count"), [('["5"]', 1), ("[5, 6]", 2), ("[]", 0)])
def test_a_list_is_no_value_of_an_option_that_takes_one(home: Path, value: str, count: int) -> None:
    (home / "config.toml").write_text(f"[log]\nlast = {value}\n")
    error = call(home, "--json", "config", "show").json["error"]
    assert (error["code"], error["message"], error["hint"]) == (
        "bad-data",
        f"{home / 'config.toml'}: log.last takes one value, not {count}.",
        "Fix that line.",
    )


def test_of_the_faults_of_a_config_the_first_is_named_and_how_all_settings_are_listed(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    assert read_config(path) is None
    path.write_text("")
    assert read_config(path) == {}
    path.write_text("via = 'nfc'\nqqqq = 1\nzzzz = 2\n")
    with pytest.raises(BadDataError) as refused:
        read_config(path)
    assert (refused.value.message, refused.value.hint) == (
        f"{path}, line 2: no command has an option --qqqq.",
        "To list all settings: teds-provision config show",
    )
