"""The array message is written at once, not field by field: the octets are those that Cyclone DDS makes of it."""

from __future__ import annotations

from typing import Any

from cyclonedds.idl import IdlStruct
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.measure.sinks.ros.ros2_types import Header, JointState, Time

TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=9)
NUMBERS = st.lists(st.floats(), max_size=5)
STAMPS = st.builds(Time, st.integers(-(2**31), 2**31 - 1), st.integers(0, 10**9 - 1))


@given(STAMPS, TEXTS, st.lists(TEXTS, max_size=6), NUMBERS, NUMBERS, NUMBERS)
def test_an_array_has_the_octets_of_cyclone_dds(
    stamp: Time, frame: str, names: Any, position: Any, velocity: Any, effort: Any
) -> None:
    message = JointState(Header(stamp, frame), names, position, velocity, effort)
    assert message.serialize(use_version_2=False) == IdlStruct.serialize(message, use_version_2=False)
    assert message.serialize(use_version_2=True) == IdlStruct.serialize(message, use_version_2=True)
