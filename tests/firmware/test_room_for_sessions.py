"""Which session of the node in C ends when another one needs its place; it has two."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from teds_provision.protocol.messages.frames import IDENTIFY, Reason, refusal
from teds_provision.protocol.session import StationSession
from tests.firmware.desk import CDesk

pytestmark = pytest.mark.system


@pytest.fixture
def desk() -> Iterator[CDesk]:
    yield CDesk()
    CDesk.close_all()


def opened(desk: CDesk, link: str) -> StationSession:
    """Open a session on a link; it has its place with its first good message."""
    session = desk.open(link=link).session
    assert session is not None
    assert is_served(desk, session, link)
    return session


def is_served(desk: CDesk, session: StationSession, link: str) -> bool:
    """Return True if a sealed command of this session is answered; the only other answer is that there is none."""
    reply = desk.plain(session.seal(IDENTIFY), link=link, tapped=False)
    assert reply.ok or reply == refusal(Reason.WRONG_STATE)
    return reply.ok


def test_the_session_that_was_silent_longest_gives_way_to_a_third(desk: CDesk) -> None:
    desk.agree()
    first = opened(desk, "can:f1")
    desk.now += 10
    second = opened(desk, "can:f2")
    desk.now += 10
    assert is_served(desk, first, "can:f1")
    desk.now += 10
    third = opened(desk, "can:f3")
    assert not is_served(desk, second, "can:f2")
    assert is_served(desk, first, "can:f1")
    assert is_served(desk, third, "can:f3")


def test_an_open_alone_ends_no_session(desk: CDesk) -> None:
    desk.agree()
    first, second = opened(desk, "can:f1"), opened(desk, "can:f2")
    desk.open(link="can:f3").open(link="can:f4").open(link="can:f5")
    assert is_served(desk, first, "can:f1")
    assert is_served(desk, second, "can:f2")


def test_the_oldest_of_three_half_open_opens_gives_way(desk: CDesk) -> None:
    desk.agree()
    opens = []
    for link in ("can:f1", "can:f2", "can:f3"):
        opens.append(desk.open(link=link).session)
        desk.now += 1
    served = [is_served(desk, session, f"can:f{number}") for number, session in enumerate(opens, 1) if session]
    assert served == [False, True, True]
