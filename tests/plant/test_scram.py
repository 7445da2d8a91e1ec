from __future__ import annotations

import pytest

from teds_provision.errors import BadDataError
from teds_provision.plant.schema import close_sql, member_sql, mend_sql
from teds_provision.plant.scram import is_verifier, verifier

SECRET, FINGERPRINT = bytes(range(32)), "0d9ce5609c2920bb" * 4


def test_the_same_secret_gives_the_same_verifier_and_another_one_another() -> None:
    assert verifier(SECRET) == verifier(SECRET)
    assert is_verifier(verifier(SECRET))
    assert verifier(bytes(32)) != verifier(SECRET)


@pytest.mark.parametrize("text", ["secret", "md5" + "0" * 32, verifier(SECRET) + "'; drop table x; --", ""])
def test_only_a_verifier_gets_into_the_sql(text: str) -> None:
    with pytest.raises(BadDataError):
        member_sql(FINGERPRINT, text)


@pytest.mark.parametrize("digits", [FINGERPRINT[:16], FINGERPRINT.upper(), FINGERPRINT[:-1] + "'"])
def test_only_a_whole_fingerprint_gets_into_the_sql(digits: str) -> None:
    for make in (close_sql, lambda digits: member_sql(digits, verifier(SECRET)), lambda digits: mend_sql(digits, 1)):
        with pytest.raises(BadDataError):
            make(digits)
