# ruff: noqa: E501 - lines of C as they stand
"""The faulty nodes of ``tests/check`` in C, by their names there, each of them: one file of the source is changed, nothing else.

The library itself holds no fault: a build of one is made from a changed copy of one file. A place that is not found any
more, or found twice, fails the test.
"""

from __future__ import annotations

from typing import Final, NamedTuple


class Change(NamedTuple):
    """In this file of firmware/src: ``old`` becomes ``new``, and so each of ``more``; ``helper`` stands behind the first
    include."""

    file: str
    old: str
    new: str
    helper: str = ""
    more: tuple[tuple[str, str], ...] = ()

    def made(self, text: str) -> str:
        """The changed text; raises AssertionError where a place is not there once."""
        for old, new in ((self.old, self.new), *self.more):
            assert text.count(old) == 1, f"{self.file} holds {old!r} {text.count(old)} times"
            text = text.replace(old, new)
        first = '#include "inside.h"\n'
        return text.replace(first, first + self.helper, 1)


HIGH: Final = """
static void high(uint8_t *s)
{
    static const uint8_t n[32] = {0xFF, 0xFF, 0xFF, 0xFF, 0, 0, 0, 0, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF,
                                  0xBC, 0xE6, 0xFA, 0xAD, 0xA7, 0x17, 0x9E, 0x84, 0xF3, 0xB9, 0xCA, 0xC2, 0xFC, 0x63,
                                  0x25, 0x51};
    int borrow = 0;
    for (int i = 31; i >= 0; i--) {
        int value = n[i] - s[i] - borrow;
        borrow = value < 0;
        s[i] = (uint8_t)value;
    }
}
"""
"""n - s for a low s."""


CHANGES: Final[dict[str, Change]] = {
    # -- the agreement
    "FAULT_TRANSCRIPT_LABEL_WITHOUT_00": Change(
        "agree.c", 'LABEL("TEDS1 transcript")', 'MAC_LABEL("TEDS1 transcript")'
    ),
    "FAULT_TRANSCRIPT_EPOCH_NOT_PLUS_1": Change(
        "agree.c",
        "    /* reply_head: nonceN, epoch, En as they stand in the reply */\n",
        "    uint8_t head[85];\n    memcpy(head, reply_head, 85);\n    teds_put32(head + 16, node->state.epoch);\n"
        "    reply_head = head;\n",
    ),
    "FAULT_TRANSCRIPT_WITHOUT_ONE_TIME": Change("agree.c", "{reply_head, 85}", "{reply_head, 20}"),
    "FAULT_Z_HALVES_SWAPPED": Change(
        "agree.c",
        "&own->key, payload + 194, z) != 0 ||\n                 port->p256_ecdh(port->user, &own->key, payload, z + 32)",
        "&own->key, payload + 194, z + 32) != 0 ||\n                 port->p256_ecdh(port->user, &own->key, payload, z)",
    ),
    "FAULT_Z_ONE_TIME_ALONE": Change(
        "agree.c", "teds_hkdf(node, nonce, 16, z, 64, info", "teds_hkdf(node, nonce, 16, z, 32, info"
    ),
    "FAULT_SALT_AND_IKM_SWAPPED": Change(
        "agree.c", "teds_hkdf(node, nonce, 16, z, 64, info", "teds_hkdf(node, z, 64, nonce, 16, info"
    ),
    "FAULT_INFO_LABEL_WITHOUT_00": Change("agree.c", 'LABEL("TEDS1 link key")', 'MAC_LABEL("TEDS1 link key")'),
    "FAULT_M_OF_16_OCTETS": Change("agree.c", "okm + 16, 32, for_node, 2, mac)", "okm + 16, 16, for_node, 2, mac)"),
    "FAULT_MAC_LABEL_WITH_00": Change("agree.c", '{MAC_LABEL("node"), {script, 32}}', '{LABEL("node"), {script, 32}}'),
    "FAULT_TAGS_SWAPPED": Change(
        "agree.c", '{MAC_LABEL("node"), {script, 32}}', '{MAC_LABEL("station"), {script, 32}}'
    ),
    "FAULT_SIGN_LABEL_WITHOUT_00": Change("agree.c", 'LABEL("TEDS1 agree")', 'MAC_LABEL("TEDS1 agree")'),
    "FAULT_SIGN_NOT_HASHED": Change(
        "agree.c",
        "failed = teds_sign(node, hash, out + 101) != 0;",
        "failed = teds_sign(node, script, out + 101) != 0;",
    ),
    "FAULT_CONFIRM_LABEL_WITH_00": Change(
        "agree.c", '{MAC_LABEL("station"), {script, 32}}', '{LABEL("station"), {script, 32}}'
    ),
    "FAULT_STATION_LABEL_WITHOUT_00": Change("agree.c", 'LABEL("TEDS1 station key")', 'MAC_LABEL("TEDS1 station key")'),
    "FAULT_SAME_NONCE": Change(
        "agree.c", "int failed = port->random(port->user, out, 16) != 0 ||", "memset(out, 7, 16);\n    int failed ="
    ),
    "FAULT_STATIC_FOR_ONE_TIME": Change("agree.c", "memcmp(one_time, station, 65) == 0", "false"),
    "FAULT_ANY_CA": Change("agree.c", "if (!teds_in_factory(node) && memcmp(ca", "if (false && memcmp(ca"),
    "FAULT_CONFIRM_FROM_ANYWHERE": Change(
        "agree.c", "pending->link != origin->link ||\n        pending->session != origin->session", "false"
    ),
    "FAULT_CONFIRM_FROM_ANY_SESSION": Change(
        "session.c", "node->pending.used && node->pending.session == session", "false"
    ),
    "FAULT_WRONG_TAG_LEAVES_REQUEST": Change(
        "agree.c", "        teds_pending_forget(node);\n        return -TEDS_BAD_TAG;", "        return -TEDS_BAD_TAG;"
    ),
    "FAULT_SESSIONS_SURVIVE_CONFIRM": Change("agree.c", "    origin->after = TEDS_AFTER_END_ALL;\n", ""),
    "FAULT_REQUEST_HIGH_S": Change("agree.c", "memcmp(signature + 32, HALF_ORDER, 32) > 0", "false"),
    "FAULT_PROVE_LABEL_WITHOUT_00": Change("node.c", '"TEDS1 prove", 12', '"TEDS1 prove", 11'),
    "FAULT_PROVE_ANY_CHALLENGE": Change(
        "node.c",
        "{command->payload, 32}};\n    uint8_t hash[32];\n    if (command->length != 32) {",
        "{command->payload, 32}};\n    uint8_t hash[32];\n    if (command->length < 32) {",
    ),
    "FAULT_RESET_WITHOUT_EPOCH": Change(
        "node.c", "{epoch, 4}, {command->payload, 32}};", "{epoch, 0}, {command->payload, 32}};"
    ),
    # -- sessions
    "FAULT_OPEN_INFO_LABEL_WITHOUT_00": Change("session.c", 'LABEL("TEDS1 session")', 'MAC_LABEL("TEDS1 session")'),
    "FAULT_OPEN_POINTS_SWAPPED": Change(
        "session.c", "{node->uuid, 10}, {es, 65}, {own->point, 65}};", "{node->uuid, 10}, {own->point, 65}, {es, 65}};"
    ),
    "FAULT_SESSION_KEYS_SWAPPED": Change(
        "session.c",
        "memcpy(keys->to_node, okm, 16);\n        memcpy(keys->to_station, okm + 16, 16);",
        "memcpy(keys->to_node, okm + 16, 16);\n        memcpy(keys->to_station, okm, 16);",
    ),
    "FAULT_OPEN_KC_OF_16_OCTETS": Change("session.c", "okm + 32, 32, tagged", "okm + 32, 16, tagged"),
    "FAULT_OPEN_ANY_MAC": Change("session.c", "if (!teds_equal(payload + 73, mac, 16)) {", "if (false) {"),
    "FAULT_C_GROWS_BY_2": Change("session.c", "node->opens++;", "node->opens += 2;"),
    "FAULT_BAD_POINT_COSTS_NO_C": Change(
        "session.c",
        "    node->opens++;\n    return teds_point_good(node, es) && memcmp(es, node->state.station, 65) != 0 ? 0 : -TEDS_BAD_POINT;",
        "    if (!teds_point_good(node, es) || memcmp(es, node->state.station, 65) == 0) return -TEDS_BAD_POINT;\n"
        "    node->opens++;\n    return 0;",
    ),
    "FAULT_PKCS7_NO_FULL_BLOCK": Change(
        "session.c", "size_t count = 16 - inner % 16;", "size_t count = (16 - inner % 16) % 16;"
    ),
    "FAULT_PADDING_NOT_LOOKED_AT": Change(
        "session.c",
        "return wrong ? -1 : (int)(length - count);",
        "(void)wrong; return count <= 16 ? (int)(length - count) : -1;",
    ),
    "FAULT_ANY_COUNTER": Change("session.c", "if (taken->counter <= last) {", "if (false) {"),
    "FAULT_LAST_COUNTER": Change("node.c", "if (taken.counter == UINT32_MAX && ", "if (false && "),
    "FAULT_CLOSE_IGNORED": Change(
        "node.c", "            origin->after = TEDS_AFTER_END_SESSION;\n            return 0;", "            return 0;"
    ),
    # -- frames and states
    "FAULT_HEADER_LENGTH_IGNORED": Change(
        "node.c", "return teds_get16(frame + 4) == command->length ? 0 : -TEDS_BAD_FORM;", "return 0;"
    ),
    "FAULT_IDENTIFY_ANY_PAYLOAD": Change(
        "node.c",
        "    if (command->length != 0) {\n        return -TEDS_BAD_FORM;\n    }\n    teds_node_identify",
        "    teds_node_identify",
    ),
    "FAULT_ADDRESS_240": Change("node.c", "command->payload[0] > TEDS_LAST_ADDRESS", "command->payload[0] > 240"),
    "FAULT_ADDRESS_AGAIN": Change("node.c", "node->address_written && now", "false && now"),
    # -- writing
    "FAULT_WRITE_KEEPS_REST": Change(
        "teds_store.c",
        "    size_t before = 0;\n",
        "    size_t before = 0;\n    if (teds_staged(node, id, &before) != NULL && offset + length < before) {\n"
        "        memcpy((uint8_t *)(uintptr_t)teds_staged(node, id, &before) + offset, octets, length);\n        return 0;\n    }\n"
        "    before = 0;\n",
    ),
    "FAULT_STAGING_FOR_EVER": Change(
        "session.c", "    if (own->staged) {\n        teds_staging_drop(node);\n    }\n", ""
    ),
    "FAULT_OWN_CHECK": Change("commit.c", "if (!teds_own_check((uint8_t)id, image, length)) {", "if (false) {"),
    "FAULT_DIGEST_NOT_LOOKED_AT": Change(
        "commit.c", "            memcmp(hash, block + 3, 32) != 0) {", "            false) {"
    ),
    "FAULT_DATASHEET_LABEL_WITHOUT_00": Change("commit.c", '"TEDS1 datasheet", 16', '"TEDS1 datasheet", 15'),
    "FAULT_META_OF_ANOTHER": Change("commit.c", "if (!metas_good(node, teds)) {", "if (false) {"),
    "FAULT_OLD_SEQUENCE": Change(
        "commit.c", "teds->sequence <= node->state.sequence || ahead > SEQUENCE_WINDOW", "false"
    ),
    "FAULT_ANY_VALUES": Change(
        "security_teds.c", "return length == 1 && value[0] == own_value(type);", "return length == 1;"
    ),
    "FAULT_UTF8_NOT_CHECKED": Change("security_teds.c", "length <= 64 && is_utf8(value, length)", "length <= 64"),
    "FAULT_REFUSES_111": Change("security_teds.c", "default: return type > 110; /*", "default: return false; /*"),
    "FAULT_RESET_FORGETS_EPOCH": Change("commit.c", "    state.epoch = node->state.epoch;\n", ""),
    "FAULT_RESET_TAKES_TEDS": Change(
        "commit.c", "    return id != TEDS_SECURITY_ID;", "    (void)id;\n    return false;"
    ),
    "FAULT_NODE_KEY_WITHOUT_UUID": Change(
        "teds_store.c", '"TEDS1 node key", 15}, {node->uuid, 10}', '"TEDS1 node key", 15}, {node->uuid, 0}'
    ),
    "FAULT_STALE_INITIAL": Change(
        "security_teds.c", "teds_put32(number, node->state.epoch);", "teds_put32(number, 0);"
    ),
    "FAULT_LEASE_0": Change("operation.c", "if (lease < 1 || ", "if ("),
    # -- sessions, once more
    "FAULT_NONCE_COUNTER_FIRST": Change("session.c", "memcpy(nonce + 9, payload, 4);", "memcpy(nonce, payload, 4);"),
    "FAULT_REPLY_NONCE_COUNTER_FIRST": Change(
        "session.c", "teds_put32(nonce + 9, counter);", "teds_put32(nonce, counter);"
    ),
    "FAULT_REPLY_COUNTER_LITTLE_ENDIAN": Change(
        "session.c", "teds_put32(payload, counter);", "memcpy(payload, &counter, 4);"
    ),
    "FAULT_KEY_ID_LABEL_WITHOUT_00": Change("agree.c", 'LABEL("TEDS1 key id")', 'MAC_LABEL("TEDS1 key id")'),
    "FAULT_OPEN_MAC_LABEL_WITH_00": Change("session.c", 'MAC_LABEL("station open")', 'LABEL("station open")'),
    "FAULT_OPEN_TAG_LABEL_WITH_00": Change("session.c", 'MAC_LABEL("node open")', 'LABEL("node open")'),
    "FAULT_OPEN_MAC_COUNTER_LITTLE_ENDIAN": Change(
        "session.c", "teds_put64(counter, node->opens);", "memcpy(counter, &node->opens, 8);"
    ),
    "FAULT_OPEN_SALT_AND_IKM_SWAPPED": Change(
        "session.c",
        "teds_hkdf(node, node->state.key, 16, z, 32, info, 4, okm, 96)",
        "teds_hkdf(node, z, 32, node->state.key, 16, info, 4, okm, 96)",
    ),
    "FAULT_PADDING_ZEROS": Change(
        "session.c", "memset(payload + 4 + inner, (int)count, count);", "memset(payload + 4 + inner, 0, count);"
    ),
    "FAULT_EPOCH_LITTLE_ENDIAN": Change(
        "agree.c",
        "teds_put32(out + 16, node->state.epoch + 1);",
        "const uint32_t next = node->state.epoch + 1;\n        memcpy(out + 16, &next, 4);",
    ),
    # -- permissions, once more
    "FAULT_REQUEST_UNTAPPED": Change(
        "node.c",
        "    case TEDS_REQUEST:\n    case TEDS_CONFIRM:\n    case TEDS_SET_CAN_ADDRESS: return",
        "    case TEDS_REQUEST: return 0;\n    case TEDS_CONFIRM:\n    case TEDS_SET_CAN_ADDRESS: return",
    ),
    "FAULT_RESET_LEAVES_REQUEST": Change("node.c", "    teds_pending_forget(node);\n    return 64;", "    return 64;"),
    # -- the agreement, once more
    "FAULT_TRANSCRIPT_EPOCH_LITTLE_ENDIAN": Change(
        "agree.c",
        "    /* reply_head: nonceN, epoch, En as they stand in the reply */\n",
        "    uint8_t head[85];\n    const uint32_t next = node->state.epoch + 1;\n    memcpy(head, reply_head, 85);\n"
        "    memcpy(head + 16, &next, 4);\n    reply_head = head;\n",
    ),
    "FAULT_EPOCH_STANDS_STILL": Change(
        "agree.c", "teds_put32(out + 16, node->state.epoch + 1);", "teds_put32(out + 16, node->state.epoch);"
    ),
    "FAULT_TRANSCRIPT_DIGEST_OF_DATA_BLOCK": Change(
        "agree.c",
        "    /* reply_head: nonceN, epoch, En as they stand in the reply */\n",
        "    uint8_t image[2048];\n    teds_source_read(node, &source, 0, image, source.length);\n"
        "    const teds_part block = {image + 4, source.length - 6};\n    teds_sha256_parts(node, &block, 1, teds);\n",
    ),
    "FAULT_TRANSCRIPT_DIGEST_OF_NEW_EPOCH": Change(
        "agree.c",
        "    if (!teds_find(node, TEDS_SECURITY_ID, &source) || teds_source_hash(node, &source, teds) != 0) {",
        "    node->state.epoch++;\n    int failed = !teds_find(node, TEDS_SECURITY_ID, &source) ||\n"
        "                 teds_source_hash(node, &source, teds) != 0;\n    node->state.epoch--;\n    if (failed) {",
    ),
    "FAULT_Z_LITTLE_ENDIAN": Change(
        "agree.c",
        "                 derive(node, z, out, script, out + 85) != 0;",
        "                 (turned(z), turned(z + 32), derive(node, z, out, script, out + 85)) != 0;",
        "static void turned(uint8_t *at)\n{\n    for (size_t i = 0; i < 16; i++) {\n        uint8_t low = at[i];\n"
        "        at[i] = at[31 - i];\n        at[31 - i] = low;\n    }\n}\n",
    ),
    "FAULT_M_OF_48_OCTETS": Change(
        "agree.c",
        "    uint8_t okm[48], mac[32];\n    int failed = teds_hkdf(node, nonce, 16, z, 64, info, 2, okm, 48);\n"
        "    if (!failed) {\n        failed = port->hmac(port->user, okm + 16, 32,",
        "    uint8_t okm[64], mac[32];\n    int failed = teds_hkdf(node, nonce, 16, z, 64, info, 2, okm, 64);\n"
        "    if (!failed) {\n        failed = port->hmac(port->user, okm + 16, 48,",
    ),
    "FAULT_SIGN_WITHOUT_LABEL": Change(
        "agree.c", '{LABEL("TEDS1 agree"), {script, 32}}', "{{script, 0}, {script, 32}}"
    ),
    "FAULT_SIGN_WITH_ONE_TIME_KEY": Change(
        "agree.c",
        "failed = teds_sign(node, hash, out + 101) != 0;",
        "teds_node other = *node;\n        other.key = own->key;\n"
        "        failed = teds_sign(&other, hash, out + 101) != 0;",
    ),
    "FAULT_SIGN_LITTLE_ENDIAN": Change(
        "agree.c",
        "failed = teds_sign(node, hash, out + 101) != 0;",
        "failed = teds_sign(node, hash, out + 101) != 0;\n        turned(out + 101);\n        turned(out + 133);",
        "static void turned(uint8_t *at)\n{\n    for (size_t i = 0; i < 16; i++) {\n        uint8_t low = at[i];\n"
        "        at[i] = at[31 - i];\n        at[31 - i] = low;\n    }\n}\n",
    ),
    "FAULT_SIGN_HIGH_S": Change(
        "agree.c",
        "failed = teds_sign(node, hash, out + 101) != 0;",
        "failed = teds_sign(node, hash, out + 101) != 0;\n        high(out + 133);",
        HIGH,
    ),
    "FAULT_PROVE_HIGH_S": Change(
        "node.c",
        "    return teds_sign(node, hash, out) == 0 ? 64 : -TEDS_FAILURE;",
        "    teds_sign(node, hash, out);\n    high(out + 32);\n    return 64;",
        HIGH,
    ),
    "FAULT_RESET_HIGH_S": Change(
        "node.c",
        "    if (teds_sign(node, hash, out) != 0) {\n        return -TEDS_FAILURE;\n    }\n",
        "    teds_sign(node, hash, out);\n    high(out + 32);\n",
        HIGH,
    ),
    "FAULT_REPLY_WITH_TEDS": Change(
        "agree.c",
        "    return failed ? -TEDS_FAILURE : 165;",
        "    teds_source source;\n    teds_find(node, TEDS_SECURITY_ID, &source);\n"
        "    teds_source_read(node, &source, 0, out + 165, source.length);\n"
        "    return failed ? -TEDS_FAILURE : 465;",
    ),
    "FAULT_K_ELSEWHERE": Change(
        "agree.c", "memcpy(node->pending.key, okm, 16);", "memcpy(node->pending.key, okm + 16, 16);"
    ),
    "FAULT_SAME_ONE_TIME_KEY": Change(
        "agree.c",
        "teds_one_time_take(node, own) != 0;",
        "(kept.ready ? 0 : teds_one_time_take(node, &kept)) != 0;\n    *own = kept;",
        "static teds_one_time kept;\n",
    ),
    "FAULT_SIGNATURE_BEFORE_POINTS": Change(
        "agree.c",
        "    if (!teds_point_good(node, station) || !teds_point_good(node, ca)",
        "    teds_sha256_parts(node, certified, 2, hash);\n    if (!teds_verify(node, ca, hash, signature)) {\n"
        "        return -TEDS_BAD_SIGNATURE;\n    }\n    if (!teds_point_good(node, station) || !teds_point_good(node, ca)",
    ),
    "FAULT_CONFIRM_FROM_ANY_LINK": Change(
        "agree.c", "pending->link != origin->link ||\n        pending->session", "pending->session"
    ),
    "FAULT_CONFIRM_BESIDE": Change(
        "agree.c", "pending->link != origin->link ||\n        pending->session != origin->session", "false"
    ),
    "FAULT_HALF_OPEN_SURVIVES_CONFIRM": Change(
        "session.c", "    teds_wipe(node->half_open, sizeof node->half_open);\n    teds_pending", "    teds_pending"
    ),
    # -- frames and states, once more
    "FAULT_UNKNOWN_IS_SILENT": Change(
        "node.c",
        "    octets = close_reply(reply, outcome);\n",
        "    octets = outcome == -TEDS_UNKNOWN_COMMAND && frame[3] == 99 ? 0 : close_reply(reply, outcome);\n",
    ),
    "FAULT_LONG_REFUSAL": Change("node.c", "        outcome = 1;\n", "        reply[4] = 0;\n        outcome = 2;\n"),
    "FAULT_LENGTH_BEFORE_STATE": Change(
        "node.c",
        "    refused = permitted(node, command, origin);\n",
        "    if (command->command_class == TEDS_CLASS_COMMON && command->function == TEDS_WRITE && length == 6) {\n"
        "        return -TEDS_BAD_FORM;\n    }\n    refused = permitted(node, command, origin);\n",
    ),
    "FAULT_LONGER_THAN_MAX_MESSAGE": Change(
        "node.c", "    if (length > TEDS_MAX_MESSAGE) {", "    if (length >= TEDS_MAX_MESSAGE) {"
    ),
    "FAULT_PROVE_OTHER_KEY": Change(
        "node.c",
        "    return teds_sign(node, hash, out) == 0 ? 64 : -TEDS_FAILURE;",
        "    teds_node other = *node;\n    other.key.octets[20] ^= 1;\n    return teds_sign(&other, hash, out) == 0 ? 64 : -1;",
    ),
    "FAULT_PROVE_NOT_HASHED": Change(
        "node.c",
        "    return teds_sign(node, hash, out) == 0 ? 64 : -TEDS_FAILURE;",
        "    return teds_sign(node, command->payload, out) == 0 ? 64 : -TEDS_FAILURE;",
    ),
    "FAULT_LIST_TWICE": Change(
        "node.c",
        "        length += 3;\n",
        "        length += 3;\n        if (length == 3) {\n            memcpy(out + 3, out, 3);\n            length = 6;\n        }\n",
    ),
    "FAULT_ABSENT_AVAILABLE": Change(
        "teds_store.c", "(read_only ? 1u : 0u) | (there ? 0u : 2u)", "(read_only ? 1u : 0u)"
    ),
    "FAULT_TEXT_ATTRIBUTE": Change("teds_store.c", "code >= 128 ? 0x40u :", "code >= 128 ? 0x50u :"),
    "FAULT_TEDS_CHECKSUM": Change(
        "security_teds.c", "teds_put16(at, teds_checksum(sum));", "teds_put16(at, teds_checksum(sum) ^ 1);"
    ),
    "FAULT_NOT_CANONICAL": Change("security_teds.c", "tuple(at, 109, &suite, 1)", "tuple(at, 110, &suite, 1)"),
    "FAULT_OTHER_SUITE": Change("security_teds.c", "version = 1, suite = 2,", "version = 1, suite = 1,"),
    "FAULT_READ_END_REFUSED": Change(
        "teds_store.c",
        "    offset = offset < source.length ? offset : source.length;\n",
        "    if (offset >= source.length) {\n        return -TEDS_NO_SUCH_TEDS;\n    }\n",
    ),
    # -- sessions and writing, once more
    "FAULT_OPEN_SAME_ONE_TIME_KEY": Change(
        "session.c",
        "    failed = teds_one_time_take(node, &own) != 0;",
        "    failed = (kept.ready ? 0 : teds_one_time_take(node, &kept)) != 0;\n    own = kept;",
        "static teds_one_time kept;\n",
    ),
    "FAULT_OPEN_ENDS_SESSION": Change(
        "session.c",
        "        keep_half_open(node, origin->link, &keys);\n",
        "        keep_half_open(node, origin->link, &keys);\n        teds_session_end(node, teds_session_on(node, origin->link));\n",
    ),
    "FAULT_FIRST_OPEN_STAYS": Change(
        "session.c",
        "    teds_half_open *place = half_open_on(node, link);\n",
        "    teds_half_open *place = half_open_on(node, link);\n    if (place != NULL) {\n        return;\n    }\n",
    ),
    "FAULT_C_LITTLE_ENDIAN": Change(
        "session.c",
        "    node->opens++;\n",
        "    node->opens = __builtin_bswap64(__builtin_bswap64(node->opens) + 1);\n",
    ),
    "FAULT_ONE_SESSION": Change(
        "session.c",
        "    for (int8_t i = 0; i < TEDS_SESSIONS; i++) {\n        if (!node->sessions[i].used) {",
        "    for (int8_t i = 0; i < 1; i++) {\n        if (!node->sessions[i].used) {",
    ),
    "FAULT_STRANGER_ENDS_SESSION": Change(
        "node.c",
        "    outcome = cut(node, frame, length, &origin, &command);\n    if (",
        "    outcome = cut(node, frame, length, &origin, &command);\n"
        "    for (int8_t i = 0; !outcome && command.function == TEDS_IDENTIFY && i < TEDS_SESSIONS; i++) {\n"
        "        if (command.command_class == TEDS_CLASS_SECURITY && teds_session_on(node, link) < 0) {\n"
        "            teds_session_end(node, i);\n        }\n    }\n    if (",
    ),
    "FAULT_ANY_SIZE": Change(
        "teds_store.c",
        "    if (end - before + offset + length > TEDS_STAGING) {\n        return -TEDS_TOO_LARGE;\n    }\n",
        "    if (end - before + offset + length > TEDS_STAGING) {\n        return 0;\n    }\n",
    ),
    "FAULT_REFUSED_WRITE_DROPS": Change(
        "teds_store.c",
        "    if (offset > staged) {\n        return -TEDS_BAD_FORM;",
        "    if (offset > staged) {\n        teds_staging_drop(node);\n        return -TEDS_BAD_FORM;",
    ),
    "FAULT_EMPTY_WRITE": Change(
        "teds_store.c",
        "    failed = stage(node, (uint16_t)id, offset, command->payload + 5, command->length - 5);\n",
        "    failed = command->length == 5\n"
        "                 ? 0 : stage(node, (uint16_t)id, offset, command->payload + 5, command->length - 5);\n",
    ),
    "FAULT_REFUSED_COMMIT_COUNTS": Change(
        "commit.c",
        "    failed = check(node, &teds, image, length);\n    if (failed) {\n",
        "    failed = check(node, &teds, image, length);\n    if (failed) {\n        node->state.sequence = teds.sequence;\n",
    ),
    "FAULT_DATASHEET_HIGH_S": Change("agree.c", "memcmp(signature + 32, HALF_ORDER, 32) > 0", "false"),
    "FAULT_BASE64_NOT_STRICT": Change(
        "security_teds.c", "return out[65] == 0 && (length == 65 || out[64] == 0);", "return true;"
    ),
    # -- the agreement, to its end
    "FAULT_IDENTITY_KEY_AGREES": Change(
        "agree.c",
        "port->p256_ecdh(port->user, &own->key, payload + 194, z) != 0 ||\n"
        "                 port->p256_ecdh(port->user, &own->key, payload, z + 32)",
        "port->p256_ecdh(port->user, &node->key, payload + 194, z) != 0 ||\n"
        "                 port->p256_ecdh(port->user, &node->key, payload, z + 32)",
    ),
    "FAULT_TWO_SLIPS": Change(
        "agree.c",
        'LABEL("TEDS1 transcript")',
        'MAC_LABEL("TEDS1 transcript")',
        more=(
            ("&own->key, payload + 194, z)", "&own->key, payload, z)"),
            ("payload, z + 32)", "payload + 194, z + 32)"),
        ),
    ),
    "FAULT_SIGN_OF_REQUEST": Change(
        "agree.c",
        '{LABEL("TEDS1 agree"), {script, 32}}',
        '{LABEL("TEDS1 agree"), {payload, REQUEST_OCTETS}}',
    ),
    "FAULT_FIRST_REQUEST_STAYS": Change(
        "agree.c",
        "    teds_pending_forget(node);\n    length = answer(node, payload, &own, out);\n",
        "    const teds_pending before = node->pending;\n    length = answer(node, payload, &own, out);\n"
        "    if (before.used) {\n        node->pending = before;\n        return length;\n    }\n",
    ),
    "FAULT_RESET_KEEPS_CA": Change(
        "agree.c",
        "if (!teds_in_factory(node) && memcmp(ca, node->state.ca, 65) != 0) {",
        "if (kept[0] == 4 && memcmp(ca, kept, 65) != 0) {",
        "static uint8_t kept[65];\n",
        more=(
            (
                "    state.flags |= TEDS_KEYED;\n    state.epoch = ",
                "    memcpy(kept, state.ca, 65);\n    state.flags |= TEDS_KEYED;\n    state.epoch = ",
            ),
        ),
    ),
    "FAULT_RESET_ANY_CHALLENGE": Change(
        "node.c",
        "{command->payload, 32}};\n    uint8_t hash[32];\n    if (command->length != 32) {",
        "{command->payload, 32}};\n    uint8_t hash[32];\n    if (false) {",
        more=(
            (
                "{epoch, 4}, {command->payload, 32}};\n    if (command->length != 32) {",
                "{epoch, 4}, {command->payload, 32}};\n    if (false) {",
            ),
        ),
    ),
    # -- frames, sessions and writing, to their end
    "FAULT_LIST_LONG": Change(
        "node.c",
        "    octets = close_reply(reply, outcome);\n",
        "    if (length == 6 && frame[2] == 128 && frame[3] == TEDS_LIST) {\n"
        "        outcome = 2046;\n        memset(reply + 3, 0, 2046);\n    }\n"
        "    octets = close_reply(reply, outcome);\n",
    ),
    "FAULT_WRITE_ANYWHERE": Change(
        "node.c",
        "    octets = close_reply(reply, outcome);\n",
        "    if (length >= 6 && frame[2] == 1 && frame[3] == TEDS_WRITE) {\n        outcome = 0;\n    }\n"
        "    octets = close_reply(reply, outcome);\n",
    ),
    "FAULT_AAD_COUNTER": Change(
        "session.c",
        "    if (!node->port->ccm_open(node->port->user, keys->to_node, nonce, payload + 4, length - 20, plain, 16)) {",
        "    if (!opened(keys->to_node, nonce, payload, length, plain)) {",
        """#include <bearssl.h>
static bool opened(const uint8_t key[16], const uint8_t nonce[13], const uint8_t *payload, size_t length, uint8_t *plain)
{
    br_aes_ct_ctrcbc_keys aes;
    br_ccm_context ccm;
    br_aes_ct_ctrcbc_init(&aes, key, 16);
    br_ccm_init(&ccm, &aes.vtable);
    br_ccm_reset(&ccm, nonce, 13, 4, length - 20, 16);
    br_ccm_aad_inject(&ccm, payload, 4);
    br_ccm_flip(&ccm);
    memcpy(plain, payload + 4, length - 20);
    br_ccm_run(&ccm, 0, plain, length - 20);
    return br_ccm_check_tag(&ccm, payload + length - 16) != 0;
}
""",
    ),
    "FAULT_STAGING_PER_SESSION": Change(
        "teds_store.c",
        "    if (other >= 0 && now < node->sessions[other].staged_at + STAGED_NS) {\n        return -TEDS_BUSY;\n    }\n",
        "",
    ),
    "FAULT_DIGEST_OF_DATA_BLOCKS": Change(
        "commit.c",
        "        const teds_part part = {image, length};\n",
        "        const teds_part part = {image + 4, length - 6};\n",
        more=(
            (
                "    return teds_find(node, id, &source) && teds_source_hash(node, &source, out) == 0 ? 0 : -1;",
                "    uint8_t stored[4096];\n"
                "    if (!teds_find(node, id, &source) || teds_source_read(node, &source, 0, stored, source.length) != 0) {\n"
                "        return -1;\n    }\n"
                "    const teds_part of_stored = {stored + 4, source.length - 6};\n"
                "    teds_sha256_parts(node, &of_stored, 1, out);\n    return 0;",
            ),
        ),
    ),
    "FAULT_111_NOT_COVERED": Change(
        "commit.c",
        "    teds_base64(node->point, 65, own);\n",
        "    for (size_t at = 6; at < length; at += 2u + block[at + 1]) {\n        if (block[at] > 110) {\n"
        "            return true;\n        }\n    }\n    teds_base64(node->point, 65, own);\n",
    ),
}

ON_THE_BUS: Final[dict[str, Change]] = {
    "FAULT_RUNS_AGAIN": Change("node.c", "    if (!place->stored || memcmp(digest", "    if (true || memcmp(digest"),
    "FAULT_EVERYONE_DROPS_REPLY": Change(
        "can.c",
        "    line->asked = false;\n",
        "    line->asked = false;\n    for (size_t i = 0; i < TEDS_REPLIES; i++) {\n"
        "        node->replies[i].stored = node->replies[i].stored && node->replies[i].link != line->source;\n    }\n",
    ),
    "FAULT_BUSY_SILENT": Change(
        "can.c",
        "        refuse(line, frame->data[head], TEDS_BUSY, frame->fd);\n        return;\n",
        "        return;\n",
    ),
    "FAULT_ADDRESS_TOO_SOON": Change(
        "node.c",
        "    node->can.moves_to = command->payload[0]; /* when the reply has left */\n"
        "    node->can.moves_link = origin->link;\n",
        "    teds_can_move(node, command->payload[0]);\n",
    ),
    "FAULT_ADDRESS_STAYS": Change(
        "can.c",
        "    if (own != node->can.address) {\n",
        "    if (own != node->can.address && own != teds_default_address(node->uuid)) {\n",
        more=(("    switch (frame->data[0] >> 4) {\n", "    line->own = own;\n    switch (frame->data[0] >> 4) {\n"),),
    ),
}
"""Faults of the node's lines, which a frame that is handed over whole does not meet: found over a bus."""
