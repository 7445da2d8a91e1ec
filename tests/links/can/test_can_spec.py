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
