"""Words of commands about time, order and units that no larger test reads whole."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.cli.node import show
from teds_provision.cli.station import log, profile, trust
from teds_provision.errors import UsageError


@pytest.mark.parametrize(
    ("after", "narrowed", "acts", "said"),
    [
        (0, False, {}, ["7 entries, chain intact, head 0123456789abcdef."]),
        (5, False, {}, ["7 entries, chain intact from entry 6 on, head 0123456789abcdef."]),
        (0, True, {}, ["1 entry, 0 failed.", "7 entries, chain intact, head 0123456789abcdef."]),
        (5, True, {"write": 2, "agree": 5}, ["1 entry, 0 failed: 5 agree, 2 write",
         "7 entries, chain intact from entry 6 on, head 0123456789abcdef."]),
    ],
)  # fmt: skip
def test_the_log_says_from_where_it_was_checked_and_how_many_were_chosen(
    after: int, narrowed: bool, acts: dict[str, int], said: list[str]
) -> None:
    notes: list[str] = []
    app: Any = SimpleNamespace(note=notes.append)
    entries: Any = type("Entries", (list,), {})()
    entries.entries, entries.failed, entries.acts = 1, 0, Counter(acts)
    verdict: Any = SimpleNamespace(intact=True, count=7, head="0123456789abcdef0123")
    log._print_lines(app, entries, verdict, after, narrowed=narrowed)
    assert notes == said


@pytest.mark.parametrize(
    ("indicated", "unit", "heads"),
    [
        (None, "N", ("coefficient", "value [N]")),
        (None, "", ("coefficient", "value")),
        ("V", "N", ("indication [V]", "value [N]")),
        ("", "N", ("raw", "value [N]")),
    ],
)
def test_the_columns_of_a_certificate_have_their_units(
    indicated: str | None, unit: str, heads: tuple[str, str]
) -> None:
    of = None if indicated is None else SimpleNamespace(unit=SimpleNamespace(text=indicated))
    item: Any = SimpleNamespace(indicated=of, reference=SimpleNamespace(unit=SimpleNamespace(text=unit)))
    assert show._heads(item) == heads


@pytest.mark.parametrize(
    ("source", "message", "mapping", "why", "hint"),
    [
        (None, "Torque", None, "--message needs --from dbc:FILE.", ""),
        ("a.xml", "Torque", None, "--message needs --from dbc:FILE.", ""),
        ("dbc:a.dbc", None, Path("m.toml"), "--map reads XML.", "Omit --map."),
        ("iio:device0", None, Path("m.toml"), "--map reads XML.", "Omit --map."),
    ],
)
def test_options_of_other_sources_are_refused(
    source: str | None, message: str | None, mapping: Path | None, why: str, hint: str
) -> None:
    with pytest.raises(UsageError) as refused:
        profile._sensor(source, message, mapping)
    assert (refused.value.message, refused.value.hint) == (why, hint)
    assert profile._sensor("a.xml", None, Path("m.toml")) is None
    assert profile._sensor(None, None, None) is None


@pytest.mark.parametrize("fresh", [True, False])
def test_the_passphrase_of_an_exported_ca_key_is_asked_for_twice_and_the_vault_for_its_own(
    fresh: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    course: list[Any] = []

    class Lock:
        def __init__(self, *words: Any) -> None:
            course.append(words)

        def __enter__(self) -> None: ...

        def __exit__(self, *_: object) -> None: ...

    station: Any = SimpleNamespace(use_agent=True, vault="vault", lock=Lock)
    app: Any = SimpleNamespace(
        station=lambda: station,
        ask_secret=lambda prompt, confirm: course.append((prompt, confirm, station.use_agent)) or "secret",
        note="note",
        emit=lambda result, text: course.append((result, text)),
    )
    monkeypatch.setattr(trust, "export_ca", lambda *words: course.append(words[1:]) or fresh)
    assert trust.export.callback is not None
    trust.export.callback.__wrapped__(app, Path("ca.pem"))
    already = "" if fresh else " already"
    text = f"The CA key is in ca.pem{already}. Store it offline, then: teds-provision trust ca drop"
    assert course == [
        ("New passphrase for the CA key's file", True, False),
        ("trust ca export", "note"),
        ("vault", Path("ca.pem"), "secret"),
        ({"file": "ca.pem", "fresh": fresh}, text),
    ]
