"""Nodes that nobody vouches for are published in a namespace of their own, whatever they call themselves."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from teds_provision.measure.blocks import ChannelFacts, StationFacts
from teds_provision.measure.sinks.names import Topics

OURS, FIRST, SECOND = "aa" * 10, "bb" * 10, "cc" * 10


def facts(uuid: str, node: str, channel: str = "angle", *, unverified: bool = True) -> ChannelFacts:
    return ChannelFacts(uuid, node, 1, channel, unverified=unverified)


def station(**names: str) -> StationFacts:
    chosen = {(FIRST, 0): "chosen", (FIRST, 1): "elsewhere/chosen"}
    return StationFacts("bench", names=chosen if names else {}, nodes={OURS: "arm", FIRST: "arm"})


def test_it_takes_no_name_from_who_is_trusted() -> None:
    topics = Topics(station())
    topics.learn([facts(OURS, "arm", unverified=False)])
    before = topics.channel(OURS, 1)
    topics.learn([facts(SECOND, "arm")])
    assert topics.channel(SECOND, 1) == "/bench/unverified/arm/angle"
    assert topics.channel(OURS, 1) == before


def test_of_two_with_one_name_the_first_keeps_it() -> None:
    topics = Topics(station())
    topics.learn([facts(FIRST, "arm")])
    topics.learn([facts(SECOND, "Arm")])
    assert topics.channel(FIRST, 1) == "/bench/unverified/arm/angle"
    assert topics.channel(SECOND, 1) == "/bench/unverified/arm_cccccccc/angle"
    topics.learn([facts(FIRST, "arm")])
    assert topics.channel(FIRST, 1) == "/bench/unverified/arm/angle"


def test_names_that_were_chosen_are_for_what_is_signed() -> None:
    topics = Topics(station(chosen="x"))
    topics.learn([facts(FIRST, "arm")])
    assert topics.channel(FIRST, 1) == "/bench/unverified/arm/angle"
    topics.learn([facts(FIRST, "arm", unverified=False)])
    assert topics.channel(FIRST, 1) == "/elsewhere/chosen"
    assert topics.node(FIRST) == "chosen"


@given(st.text(max_size=40), st.text(max_size=40))
def test_no_name_leads_out_of_the_namespace(node: str, channel: str) -> None:
    topics = Topics(station())
    topics.learn([facts(FIRST, node, channel)])
    topics.learn([facts(SECOND, node, channel)])
    made = [topics.channel(uuid, 1) for uuid in (FIRST, SECOND)]
    assert len(set(made)) == 2
    assert all(topic.startswith("/bench/unverified/") and topic.count("/") == 4 for topic in made)
