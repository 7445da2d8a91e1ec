"""The --can option."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import UsageError
from teds_provision.links.can.spec import CanSpec, parse_spec


def test_reads_all_keys_and_passes_the_rest_on_as_numbers() -> None:
    text = "socketcan:can0?bitrate=250000&fd=1&node=0x21&source=0xF2&pace=1&data_bitrate=4000000&gain=0.5&serial=a1"
    assert parse_spec(text) == CanSpec(
        "socketcan",
        "can0",
        fd=True,
        node=0x21,
        source=0xF2,
        bitrate=250_000,
        data_bitrate=4_000_000,
        pace=True,
        options=(("bitrate", 250_000), ("data_bitrate", 4_000_000), ("gain", 0.5), ("serial", "a1")),
    )


def test_multicast_stays_on_the_machine_unless_told_otherwise() -> None:
    assert dict(parse_spec("udp_multicast:239.74.163.2").options) == {"hop_limit": 0}
    assert dict(parse_spec("udp_multicast:239.74.163.2?hop_limit=2").options) == {"hop_limit": 2}


def test_an_ipv6_group_keeps_its_colons() -> None:
    assert parse_spec("udp_multicast:ff15:7079:7468::1?port=4000").channel == "ff15:7079:7468::1"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "interface"),
        ("can0", "interface"),
        ("socketcan:", "channel"),
        ("socketcan:can0?node=0", "node"),
        ("socketcan:can0?node=240", "node"),
        ("socketcan:can0?node=x", "node"),
        ("socketcan:can0?source=0xF0", "source"),
        ("socketcan:can0?source=0xF8", "source"),
        ("socketcan:can0?bitrate=0", "bitrate"),
        ("socketcan:can0?bitrate=1e6", "bitrate"),
        ("socketcan:can0?fd=perhaps", "fd"),
        ("socketcan:can0?node=1&node=2", "twice"),
        ("socketcan:can0?channel=can1", "channel"),
        ("socketcan:can0?nonsense", "key=value"),
    ],
)
def test_names_what_is_wrong(text: str, named: str) -> None:
    with pytest.raises(UsageError, match=named):
        parse_spec(text)


@given(st.text(max_size=60) | st.from_regex(r"[a-z]{1,5}:[^?]{1,9}\?([a-z_]{1,8}=[0-9a-fx._+-]{0,6}&?){0,4}"))
def test_any_text_is_read_or_refused_as_usage(text: str) -> None:
    try:
        spec = parse_spec(text)
    except UsageError:
        return
    assert 0xF1 <= spec.source <= 0xF7
    assert spec.node is None or 1 <= spec.node <= 239


def test_a_bus_has_the_defaults_of_the_profile() -> None:
    spec = parse_spec("socketcan:can0")
    assert (spec.bitrate, spec.data_bitrate, spec.node, spec.source, spec.source_named) == (
        500_000,
        2_000_000,
        None,
        0xF1,
        False,
    )
    assert (spec.fd, spec.pace, spec.options, spec.text, spec.wire) == (
        False,
        False,
        (),
        "socketcan:can0",
        "socketcan:can0",
    )


def test_a_named_source_is_the_only_one_and_else_it_is_the_first_choice() -> None:
    assert parse_spec("socketcan:can0").sources == (0xF1, 0xF2, 0xF3, 0xF4, 0xF5, 0xF6, 0xF7)
    assert parse_spec("socketcan:can0?source=0xF7").sources == (0xF7,)
    assert parse_spec("socketcan:can0?source=0xF1").sources == (0xF1,)
    named, default = parse_spec("socketcan:can0?source=0xF1"), parse_spec("socketcan:can0")
    assert named == default, "which bus it is does not depend on who named the address"


def test_a_bus_is_the_same_however_it_is_used() -> None:
    one = parse_spec("udp_multicast:239.74.163.2?port=4000&fd=1&bitrate=125000&hop_limit=1&pace=1")
    assert one.wire == "udp_multicast:239.74.163.2?port=4000"
    assert parse_spec("udp_multicast:239.74.163.2?b=1&a=x%26y").wire == "udp_multicast:239.74.163.2?a=x&y&b=1"


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("node=240", "--can node='240' is not a whole number from 0x01 to 0xEF."),
        ("node=1.5", "--can node='1.5' is not a whole number from 0x01 to 0xEF."),
        ("source=0xF8", "--can source='0xF8' is not a whole number from 0xF1 to 0xF7."),
        ("bitrate=1000001", "--can bitrate='1000001' is not a whole number from 1 to 1000000."),
        ("data_bitrate=20000001", "--can data_bitrate='20000001' is not a whole number from 1 to 20000000."),
        ("fd=2", "--can fd='2' is neither 1 nor 0."),
        ("interface=x", "--can has an option 'interface=x' that is not of the form key=value."),
        ("can_filters=x", "--can has an option 'can_filters=x' that is not of the form key=value."),
        ("a=1&a=1", "--can names a twice."),
    ],
)
def test_a_wrong_option_is_named_in_whole_words(query: str, message: str) -> None:
    with pytest.raises(UsageError) as refused:
        parse_spec(f"socketcan:can0?{query}")
    assert refused.value.message == message


@pytest.mark.parametrize(
    ("query", "value"),
    [
        ("a=010", 10),
        ("a=0x10", 16),
        ("a=-1", -1),
        ("a=1e3", 1000.0),
        ("a=٣", "٣"),
        ("a=x", "x"),
        ("a=%2B", "+"),
        ("a=", ""),
    ],
)
def test_a_value_that_looks_like_a_number_is_one(query: str, value: object) -> None:
    ((_, found),) = parse_spec(f"socketcan:can0?{query}").options
    assert (type(found), found) == (type(value), value)
    assert parse_spec("socketcan:can0?fd=ON&pace=No").fd
    assert parse_spec("socketcan:can0?bitrate=1000000&data_bitrate=20000000").bitrate == 1_000_000


def test_a_key_that_the_interface_does_not_have_is_refused_with_those_that_it_has() -> None:
    parse_spec("udp_multicast:239.74.163.2?port=4000&node=1&fd=1").require_known()
    with pytest.raises(UsageError, match=r"^--can udp_multicast has no key 'prot'\.$") as refused:
        parse_spec("udp_multicast:239.74.163.2?prot=4000").require_known()
    assert {"port", "hop_limit", "node", "source", "pace", "fd"} <= set(refused.value.hint[8:-1].split(", "))


def test_an_interface_whose_keys_are_not_known_takes_any() -> None:
    parse_spec("made_by_us:0?speed=3").require_known()
    parse_spec("socketcan:can0").require_known()


@pytest.mark.parametrize(
    ("query", "example"), [("node=240", "node=0x1"), ("source=0xF8", "source=0xf1"), ("bitrate=0", "bitrate=0x1")]
)
def test_a_number_that_cannot_be_meant_is_answered_by_one_that_can(query: str, example: str) -> None:
    with pytest.raises(UsageError) as refused:
        parse_spec(f"socketcan:can0?{query}")
    assert refused.value.hint == f"Write, for example, {example}."
