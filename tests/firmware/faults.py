# ruff: noqa: E501 - lines of C as they stand
"""The faulty nodes of ``tests/check`` in C, by their names there: one place of the source is changed, nothing else.

The library itself holds no fault: a build of one is made from a changed copy of one file. A place that is not found any
more, or found twice, fails the test.
"""

from __future__ import annotations

from typing import Final, NamedTuple


class Change(NamedTuple):
    """In this file of firmware/src: ``old`` becomes ``new``."""

    file: str
    old: str
    new: str


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
}
