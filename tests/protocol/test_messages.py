"""Messages: the collected and worked strings, both payload schools, the profile's class 128, and any octets at all."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import BadDataError
from teds_provision.protocol.messages import arguments
from teds_provision.protocol.messages.arguments import size_of, words
from teds_provision.protocol.messages.identity import Identity
from teds_provision.protocol.messages.message import (
    compose_command,
    compose_service,
    decode_message,
    looks_like_message,
)
from teds_provision.protocol.messages.tables import COMMANDS, MESSAGE_TYPES, NETWORK
from teds_provision.teds.codec.model import TimeInstance

VECTORS = Path(__file__).parent.parent / "vectors" / "ieee1451"
INDEX = json.loads((VECTORS / "index.json").read_text())["vectors"]
UBI_TIM = bytes.fromhex("86258A0B72F612D68707E8054911DCF0")


def octets_of(name):
    lines = (VECTORS / f"{name}.hex").read_text().splitlines()
    return bytes.fromhex("".join(line.strip() for line in lines if not line.lstrip().startswith("#")))


@pytest.mark.parametrize("entry", INDEX, ids=lambda entry: entry["name"])
def test_messages_are_distinguished_from_teds_in_every_given_string(entry):
    assert looks_like_message(octets_of(entry["name"])) == (entry["verdict"] == "message")


@pytest.mark.parametrize("entry", [e for e in INDEX if e["verdict"] == "message"], ids=lambda entry: entry["name"])
def test_every_given_message_is_read_without_an_error(entry):
    message = decode_message(octets_of(entry["name"]))
    assert message.edition == int(entry["era"])
    assert [finding for finding in message.findings if finding.severity == "error"] == []
    assert b"".join(argument.raw for argument in message.arguments) == message.octets[_header(message) :]


def _header(message):
    return {"command": 6, "reply": 3, "network-service": 5}[message.kind]


def test_read_teds_command_of_the_2024_edition_by_name():
    message = decode_message(octets_of("m24_readteds_cmd_chan"))
    assert (message.group_name, message.name) == ("TEDS access", "Read TEDS, command")
    assert message.get("tim") == UBI_TIM
    assert (message.channel, message.get("access_code"), message.get("timeout")) == (1, 3, 5.0)
    assert next(a.meaning for a in message.arguments if a.name == "access_code") == "ChanTEDS"


def test_read_teds_reply_carries_a_whole_teds_with_its_place():
    message = decode_message(octets_of("m24_readteds_reply_name"))
    ((offset, teds),) = message.teds
    assert message.ok
    assert message.octets[offset:] == teds
    assert teds.endswith(b"TPM 36 UBI\xfc\x43")


def test_discovery_replies_give_names_and_addresses():
    ncap = decode_message(octets_of("m24_ncap_discovery_reply"))
    assert (ncap.get("name"), ncap.get("address")) == ("UBI-NCAP1", bytes([114, 138, 134, 210]))
    channels = decode_message(octets_of("m24_chan_discovery_reply"))
    assert (channels.get("channels"), channels.get("names")) == ((1,), ("UBI-TRANSDUCERCHANNEL1",))


def test_a_length_that_counts_one_too_few_is_tolerated_and_named():
    octets = bytearray(octets_of("m24_readteds_cmd_chan"))
    octets[4] -= 1
    message = decode_message(bytes(octets))
    assert message.get("access_code") == 3
    assert [(f.severity, f.code) for f in message.findings] == [("warning", "message-length")]
    octets[4] -= 1
    assert not looks_like_message(bytes(octets))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("m07_query_teds_cmd", ("CommonCmd", "Query TEDS", 1)),
        ("m07_operate_cmd", ("XdcrEither", "TransducerChannel Operate", 1)),
        ("m07_reset_cmd", ("AnyState", "Reset", 0)),
        ("m07_trigger_cmd", ("XdcrOperate", "Trigger", 1)),
    ],
)
def test_commands_of_2007_by_name(name, expected):
    message = decode_message(octets_of(name))
    assert (message.group_name, message.name, message.channel) == expected


def test_a_reply_is_read_for_what_it_is_with_its_request_and_guessed_without():
    request = decode_message(octets_of("m07_read_data_cmd"))
    reply = octets_of("m07_read_data_reply")
    assert decode_message(reply, request=request).name == "Reply to Read data-set segment"
    assert "reply-guessed" in {finding.code for finding in decode_message(reply).findings}
    query = decode_message(octets_of("m07_query_teds_reply"))
    assert (query.get("size"), query.get("checksum"), query.get("max_size")) == (29, 0xFAF5, 256)


def test_tagged_arguments_are_recognised_and_never_written():
    plain = compose_command(1, 1, 2, {"access_code": 3, "offset": 7})
    assert plain.hex() == "00010102" + "0005" + "0300000007"
    tagged = bytes.fromhex("00010102" + "000b" + "01000103" + "03000400000007")
    message = decode_message(tagged)
    assert message.school == "tagged"
    assert (message.get("access_code"), message.get("offset")) == (3, 7)
    assert [finding.code for finding in message.findings] == ["tagged-arguments"]
    write = decode_message(bytes.fromhex("00010103" + "0010" + "0100010c" + "03000400000000" + "0700020304"))
    assert (write.school, write.get("octets")) == ("tagged", b"\x03\x04")


@pytest.mark.parametrize(
    ("sections", "school"),
    [
        ("01000103" + "03000400000007", "tagged"),
        ("01000103" + "03000400000007" + "010001ff", "concatenated"),  # one more than a Read has
        ("01000103", "concatenated"),
        ("01000103" + "0300040000000700", "concatenated"),
        ("01000103" + "030004000000", "concatenated"),
        ("02000103" + "03000400000007", "concatenated"),  # a u16 of one octet
    ],
)
def test_a_payload_is_tagged_if_its_sections_are_those_of_the_layout(sections, school):
    octets = bytes.fromhex(sections)
    assert decode_message(bytes.fromhex("00010102") + len(octets).to_bytes(2, "big") + octets).school == school


def test_a_segment_that_only_begins_like_tagged_arguments_is_plain():
    octets = compose_command(1, 1, 3, {"access_code": 1, "offset": 0x00010C03, "octets": bytes(9)})
    assert decode_message(octets).get("offset") == 0x00010C03


@pytest.mark.parametrize(
    ("function", "name", "octets"),
    [
        (1, "Request", 65 + 64 + 65 + 65),
        (2, "Confirm", 16),
        (3, "Open", 0),
        (3, "Open", 89),
        (4, "Sealed", 30),
        (5, "Close", 0),
        (7, "Identify", 0),
        (8, "Prove", 32),
        (9, "Reset", 32),
        (10, "Set CAN address", 1),
        (11, "List", 0),
        (12, "Sample", 3),
        (13, "Set", 6),
        (14, "Subscribe", 22),
        (15, "Stop", 1),
        (16, "Clock", 0),
        (17, "Arm", 18),
        (18, "Power", 0),
        (19, "Operation", 0),
        (20, "Drive", 2),
    ],
)
def test_functions_of_the_profile_by_name(function, name, octets):
    message = decode_message(bytes([0, 0, 128, function]) + octets.to_bytes(2, "big") + bytes(octets))
    assert (message.name, message.findings) == (name, ())


def test_identify_and_list_replies_of_the_profile():
    request = decode_message(compose_command(0, 128, 7))
    payload = bytes([1]) + bytes(range(10)) + bytes([2]) + bytes.fromhex("000000030000000908002a")
    reply = decode_message(b"\x01\x00\x17" + payload, request=request)
    assert (reply.get("node_uuid"), reply.get("key_epoch"), reply.get("can_address")) == (bytes(range(10)), 3, 42)
    assert next(a.meaning for a in reply.arguments if a.name == "node_state") == "provisioned"
    listed = decode_message(
        b"\x01\x00\x06\x00\x00\x01\x00\x01\x03", request=decode_message(compose_command(0, 128, 11))
    )
    assert listed.get("blocks") == ((0, 1), (1, 3))


@pytest.mark.parametrize(
    ("at", "octets", "good"),
    [
        (0, "01", True), (0, "00", False), (0, "02", False),  # the version of the profile
        (11, "02", True), (11, "03", False),  # state
        (20, "01ff", False), (20, "0200", True), (20, "0ffe", True), (20, "0fff", False),  # 512 to 4094
        (22, "00", True), (22, "ef", True), (22, "f0", False),  # address: none, or up to 239
    ],
)  # fmt: skip
def test_an_identity_lies_in_the_ranges_of_the_profile(at, octets, good):
    payload = bytearray.fromhex("01" + "8d4d9da65281f7000000" + "01" + "00000002" + "00000003" + "0400" + "21")
    payload[at : at + len(octets) // 2] = bytes.fromhex(octets)
    assert len(payload) == 23
    if good:
        assert Identity.decode(bytes(payload)).encode() == payload
    else:
        with pytest.raises(BadDataError):
            Identity.decode(bytes(payload))
    for other in (payload[:-1], payload + b"\0"):
        with pytest.raises(BadDataError):
            Identity.decode(bytes(other))


@pytest.mark.parametrize(
    ("reason", "meaning"), [(1, "unknown command"), (14, "untrusted station"), (200, "unknown reason")]
)
def test_refusals_name_their_reason(reason, meaning):
    message = decode_message(bytes([0, 0, 1, reason]))
    assert message.ok is False
    assert message.arguments[0].meaning == meaning


def test_reserved_functions_are_an_error_and_makers_own_a_note():
    assert decode_message(bytes.fromhex("000101200000")).findings[0].severity == "error"
    assert decode_message(bytes.fromhex("0001c8010000")).findings[0].severity == "note"


def test_error_codes_of_replies_say_where_and_what():
    octets = bytearray(octets_of("m24_readteds_reply_meta"))
    octets[5:7] = (0x4000 | 3).to_bytes(2, "big")
    message = decode_message(bytes(octets))
    assert message.ok is False
    assert message.arguments[0].meaning == "time-out (remote .X)"


@pytest.mark.parametrize(
    ("message_type", "ok", "names"),
    [
        (1, None, ["octets"]),
        (2, False, ["error", "octets"]),
        (3, None, ["octets"]),
        (4, None, ["octets"]),
        (5, None, ["octets"]),
    ],
)
def test_of_the_messages_of_a_service_a_reply_alone_begins_with_an_error_code(message_type, ok, names):
    message = decode_message(bytes.fromhex(f"020e{message_type:02x}0003000101"))
    assert (message.ok, [argument.name for argument in message.arguments]) == (ok, names)


@pytest.mark.parametrize(
    ("channel", "meaning"),
    [(0, "the TIM itself"), (1, ""), (0x7FFF, ""), (0x8000, ""), (0xFFFE, ""), (0xFFFF, "every TransducerChannel")],
)
def test_channels_0_and_ffff_are_named(channel, meaning):
    octets = bytearray(octets_of("m24_readteds_cmd_chan"))
    octets[5 + 48 : 5 + 50] = channel.to_bytes(2, "big")
    message = decode_message(bytes(octets))
    [found] = [argument for argument in message.arguments if argument.name == "channel"]
    assert (message.channel, found.value, found.meaning) == (channel, channel, meaning)
    assert compose_command(channel, 4, 1).hex() == f"{channel:04x}" + "0401" + "0000"


def test_a_failure_has_the_form_of_the_reply_or_octets_or_a_reason():
    """EPOS answers a failed Read with offset 0; we answer with one octet, the reason."""
    read, query = (
        compose_command(1, 1, 2, {"access_code": 3, "offset": 0}),
        compose_command(1, 1, 1, {"access_code": 3}),
    )

    def names(request, reply):
        message = decode_message(bytes.fromhex(reply), request=decode_message(request))
        assert message.ok is False
        return message.name, [argument.name for argument in message.arguments]

    assert names(read, "00" + "0004" + "00000000") == ("Failure of Read TEDS segment", ["offset", "octets"])
    assert names(query, "00" + "000c" + "00" * 12)[1] == ["attributes", "status", "size", "checksum", "max_size"]
    assert names(query, "00" + "0002" + "0101") == ("Failure of Query TEDS", ["octets"])
    assert names(query, "00" + "0001" + "12") == ("Refusal", ["reason"])


def test_composing_names_the_argument_at_fault():
    with pytest.raises(BadDataError, match="'offset'"):
        compose_command(1, 1, 2, {"access_code": 3})
    with pytest.raises(BadDataError, match="'access_code'"):
        compose_command(1, 1, 1, {"access_code": 300})
    with pytest.raises(BadDataError, match="'colour'"):
        compose_command(1, 1, 1, {"access_code": 3, "colour": 1})
    with pytest.raises(BadDataError, match=r"no command 1\.99"):
        compose_command(1, 1, 99)
    for group, function, bad, cause in (
        (
            1,
            3,
            {"access_code": 3, "offset": 0, "octets": 5},
            "The argument 'octets' of Write TEDS segment does not fit octets: 5.",
        ),
        (
            1,
            3,
            {"access_code": 3, "offset": 0, "octets": "a"},
            "The argument 'octets' of Write TEDS segment does not fit octets: 'a'.",
        ),
        (128, 2, {"tag": bytes(15)}, f"The argument 'tag' of Confirm does not fit o16: {bytes(15)!r}."),
        (128, 2, {"tag": bytes(17)}, f"The argument 'tag' of Confirm does not fit o16: {bytes(17)!r}."),
    ):
        with pytest.raises(BadDataError) as no:
            compose_command(1, group, function, bad)
        assert no.value.message == cause


@given(st.binary(max_size=300))
def test_any_octets_decode_to_a_message_or_say_that_they_are_none(octets):
    message = decode_message(octets)
    assert message.octets == octets
    assert looks_like_message(octets) <= (message.kind != "unknown")


@given(st.sampled_from([e["name"] for e in INDEX if e["verdict"] == "message"]), st.data())
def test_damaged_messages_never_raise(name, data):
    octets = bytearray(octets_of(name))
    position = data.draw(st.integers(0, len(octets) - 1))
    octets[position] = data.draw(st.integers(0, 255))
    request = decode_message(octets_of("m07_query_teds_cmd"))
    for damaged in (bytes(octets), bytes(octets[:position])):
        decode_message(damaged)
        decode_message(damaged, request=request)


def _value(kind, count):
    text = st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=12)
    fixed = size_of(kind)
    if kind == "bool":
        return st.integers(0, 1)
    if kind in {"u8", "u16", "u32"}:
        return st.integers(0, 256**fixed - 1)
    simple = {
        "f32": st.floats(width=32, allow_nan=False),
        "duration": st.integers(-140_000, 140_000).map(float),
        "time": st.builds(TimeInstance, st.integers(0, 2**48 - 1), st.integers(0, 10**9 - 1)),
        "text": text,
        "texts": st.lists(text, min_size=count, max_size=count).map(tuple),
        "u16s": st.lists(st.integers(0, 65535), min_size=count, max_size=count).map(tuple),
        "uuids": st.lists(st.binary(min_size=16, max_size=16), min_size=count, max_size=count).map(tuple),
        "blocks": st.lists(st.tuples(st.integers(0, 65535), st.integers(0, 255)), max_size=3).map(tuple),
    }
    if kind in simple:
        return simple[kind]
    return st.binary(min_size=fixed or 0, max_size=fixed if fixed is not None else 20)


def _arguments(data, layout):
    count = data.draw(st.integers(0, 3))
    values = {}
    for name, kind in words(layout):
        values[name] = count if name == "count" else data.draw(_value(kind, count), label=name)
    return values


@given(st.sampled_from(sorted(COMMANDS)), st.integers(0, 65535), st.data())
def test_every_command_comes_back_as_it_was_composed(number, channel, data):
    values = _arguments(data, COMMANDS[number].arguments)
    octets = compose_command(channel, *number, values)
    message = decode_message(octets)
    assert (message.channel, message.group, message.function) == (channel, *number)
    if message.school == "concatenated":  # raw octets at the end may close as tagged arguments by chance
        assert {a.name: a.value for a in message.arguments} == values


def test_a_duration_that_does_not_fit_is_refused():
    for timeout in (1e6, float("inf"), float("nan")):
        with pytest.raises(BadDataError, match="'timeout'"):
            compose_service(2, 1, 1, {**SAMPLE_READ, "timeout": timeout})


SAMPLE_READ = {"app": bytes(16), "ncap": bytes(16), "tim": bytes(16), "channel": 1, "sampling_mode": 5}


@given(st.sampled_from(sorted(NETWORK)), st.sampled_from(sorted(MESSAGE_TYPES)), st.data())
def test_every_network_service_comes_back_as_it_was_composed(number, message_type, data):
    spec = NETWORK[number]
    layout = spec.reply if message_type == 2 and spec.reply is not None else spec.arguments
    values = _arguments(data, layout)
    message = decode_message(compose_service(*number, message_type, values))
    assert {a.name: a.value for a in message.arguments} == values


def test_a_reply_to_drive_names_the_run_before_the_octets_of_a_message():
    request = decode_message(bytes([0, 0, 128, 20, 0, 2, 1, 2]))
    reply = decode_message(bytes([1, 0, 4, 0, 7, 0, 24]), request=request)
    assert [(argument.name, argument.value) for argument in reply.arguments] == [("run", 7), ("message_octets", 24)]


@pytest.mark.parametrize(("tag", "fits"), [(0, False), (1, True), (21, True), (22, False)])
def test_type_codes_of_tagged_arguments_are_1_to_21(tag, fits):
    assert arguments._tag_fits(tag, arguments.TAGS.get(tag, 3), "no kind that is listed") is fits


@pytest.mark.parametrize(
    ("octets", "kind", "name", "findings"),
    [
        ("020000", "unknown", "", ["not-a-message"]),
        ("010000", "reply", "Success", []),
        ("000000", "reply", "Failure", []),
        ("01000107", "reply", "Success", ["reply-guessed"]),
        ("00000107", "reply", "Refusal", ["reply-guessed"]),
        ("01000c" + 12 * "00", "reply", "Reply to Query or Update TEDS", ["reply-guessed"]),
        ("000101010000", "command", "Query TEDS", ["argument-cut"]),
        ("00010101000103", "command", "Query TEDS", []),
        ("000001070000", "command", "Read service-request mask", []),
        ("000080c80000", "command", "Function 200", ["unknown-function"]),
        ("00007f010000", "unknown", "", ["not-a-message"]),
        ("0000017f0000", "command", "Function 127", ["unknown-function"]),
        ("05c8010000", "network-service", "Service 200, command", []),
        ("09c8010000", "network-service", "Service 200, command", []),
        ("08c8010000", "unknown", "", ["not-a-message"]),
        ("0500010000", "unknown", "", ["not-a-message"]),
        ("05c8010001", "unknown", "", ["not-a-message"]),
        ("05c801000100", "network-service", "Service 200, command", []),
        ("05c8090000", "unknown", "", ["not-a-message"]),
    ],
)
def test_a_message_is_what_its_header_and_length_fit(octets, kind, name, findings):
    """docs/formats.md: a reply has flag 0 or 1; class and function are known or a maker's."""
    message = decode_message(bytes.fromhex(octets))
    assert (message.kind, message.name, [finding.code for finding in message.findings]) == (kind, name, findings)
    assert message.edition == (2024 if kind == "network-service" else 2007)


def test_a_function_of_a_maker_is_no_error_and_a_reserved_one_is():
    def severity(octets):
        (finding,) = decode_message(bytes.fromhex(octets)).findings
        return finding.severity, finding.message

    assert severity("000001800000") == ("note", "Function 1.128 is a maker’s own.")
    assert severity("0000017f0000") == ("error", "Function 1.127 is reserved.")
    assert severity("0000810c0000") == ("note", "Function 129.12 is a maker’s own.")
    known = [looks_like_message(bytes.fromhex(octets)) for octets in ("0000810c0000", "0000800c0000", "0000017f0000")]
    assert known == [True, True, False], "a TEDS is never taken for a reserved function"


def test_a_reply_is_read_by_the_command_that_it_answers_and_not_by_another_message():
    query = decode_message(bytes.fromhex("00010101000103"))
    reply = bytes.fromhex("01000c" + 12 * "00")
    read = decode_message(reply, request=query)
    assert (read.name, read.findings, read.channel, read.function) == ("Reply to Query TEDS", (), 1, 1)
    command = bytes.fromhex("00010101000103")
    assert decode_message(command, request=decode_message(reply)).kind == "command"


@pytest.mark.parametrize("channel", [-1, 0x10000])
def test_a_command_goes_to_a_channel_of_a_u16(channel):
    with pytest.raises(BadDataError, match=f"A channel is a number from 0 to 65535, not {channel}."):
        compose_command(channel, 1, 7)
    assert compose_command(0xFFFF, 1, 7) == bytes.fromhex("ffff01070000")
