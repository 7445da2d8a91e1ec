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
        """Return the changed text; raises AssertionError where a place is not there once."""
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
HKDF: Final = """
static int hkdf_of(const teds_node *node, const uint8_t *salt, size_t salt_length, const uint8_t *ikm,
                   size_t ikm_length, const teds_part *info, size_t count, uint8_t *out, size_t length)
{
    const teds_part part = {ikm, ikm_length};
    uint8_t prk[32];
    return node->port->hmac(node->port->user, salt, salt_length, &part, 1, prk) != 0 ||
           teds_hkdf_expand(node, prk, info, count, out, length) != 0;
}
"""
"""HKDF whose salt may have any length."""


CHANGES: Final[dict[str, Change]] = {
    "FAULT_ABOUT_FORM": Change("about.c", "#define FORM 1u\n", "#define FORM 2u\n"),
    "FAULT_ABOUT_ANY_PAYLOAD": Change("about.c", "if (command->length != 0) {", "if (command->length > 9) {"),
    "FAULT_ABOUT_BY_RADIO": Change(
        "commands.c",
        "if (!teds_in_factory(node) && origin->arrival->kind != TEDS_CAN) {",
        "if (false) {",
    ),
    "FAULT_LOCATE_FOR_ANYONE": Change(
        "commands.c",
        "    case TEDS_RESET:\n    case TEDS_LOCATE: return",
        "    case TEDS_LOCATE: return 0;\n    case TEDS_RESET: return",
    ),
    "FAULT_LOCATE_FOR_LONG": Change("about.c", "#define LONGEST_SECONDS 60u", "#define LONGEST_SECONDS 61u"),
    "FAULT_MANAGE_UNKNOWN": Change(
        "commands.c",
        "    default: return -TEDS_NOT_PERMITTED; /* Close, and the commands of operation.md */",
        "    case TEDS_MANAGE: return -TEDS_UNKNOWN_COMMAND;\n    default: return -TEDS_NOT_PERMITTED; /* Close, and the commands of operation.md */",
    ),
    "FAULT_PRESSED_CLAIMS": Change(
        "can.c", " ||\n        frame->data[6] == 1) { /* a pressed button claims no address */", ") {"
    ),
    # -- the agreement
    "FAULT_TRANSCRIPT_LABEL_WITHOUT_00": Change(
        "agree.c", 'LABEL("TEDS1 transcript")', 'MAC_LABEL("TEDS1 transcript")'
    ),
    "FAULT_TRANSCRIPT_EPOCH_NOT_PLUS_1": Change(
        "agree.c",
        "    /* reply_head: nonceN, epoch and En, as in the reply. */\n",
        "    uint8_t head[85];\n    memcpy(head, reply_head, 85);\n    teds_put32(head + 16, node->state.epoch);\n"
        "    reply_head = head;\n",
    ),
    "FAULT_TRANSCRIPT_WITHOUT_ONE_TIME": Change("agree.c", "{reply_head, 85}", "{reply_head, 20}"),
    "FAULT_Z_HALVES_SWAPPED": Change(
        "agree.c",
        "&own->key, payload + 194, z) != 0 ||\n                       port->p256_ecdh(port->user, &own->key, payload, z + 32)",
        "&own->key, payload + 194, z + 32) != 0 ||\n                       port->p256_ecdh(port->user, &own->key, payload, z)",
    ),
    "FAULT_Z_ONE_TIME_ALONE": Change("agree.c", "{{z, 64}, LABEL", "{{z, 32}, LABEL"),
    "FAULT_SALT_AND_IKM_SWAPPED": Change(
        "agree.c",
        "teds_hkdf(node, nonce, parts, 3, okm, 48)",
        "hkdf_of(node, z, 64, nonce, 16, parts + 1, 2, okm, 48)",
        HKDF,
    ),
    "FAULT_INFO_LABEL_WITHOUT_00": Change("agree.c", 'LABEL("TEDS1 link key")', 'MAC_LABEL("TEDS1 link key")'),
    "FAULT_M_OF_16_OCTETS": Change(
        "agree.c", "okm + 16, 32, for_node, 2, node_tag)", "okm + 16, 16, for_node, 2, node_tag)"
    ),
    "FAULT_MAC_LABEL_WITH_00": Change("agree.c", '{MAC_LABEL("node"), {script, 32}}', '{LABEL("node"), {script, 32}}'),
    "FAULT_TAGS_SWAPPED": Change(
        "agree.c", '{MAC_LABEL("node"), {script, 32}}', '{MAC_LABEL("station"), {script, 32}}'
    ),
    "FAULT_SIGN_LABEL_WITHOUT_00": Change("agree.c", 'LABEL("TEDS1 agree")', 'MAC_LABEL("TEDS1 agree")'),
    "FAULT_SIGN_NOT_HASHED": Change(
        "agree.c",
        "failed = teds_sign(node, agreed, 2, out + 101) != 0;",
        "(void)agreed;\n        node->port->p256_sign(node->port->user, &node->identity.key, script, out + 101);\n"
        "        if (out[133] & 0x80) {\n            high(out + 133);\n        }",
        HIGH,
    ),
    "FAULT_CONFIRM_LABEL_WITH_00": Change(
        "agree.c", '{MAC_LABEL("station"), {script, 32}}', '{LABEL("station"), {script, 32}}'
    ),
    "FAULT_STATION_LABEL_WITHOUT_00": Change(
        "crypto.c", 'LABEL("TEDS1 station key")', 'MAC_LABEL("TEDS1 station key")'
    ),
    "FAULT_SAME_NONCE": Change(
        "agree.c", "int failed = port->random(port->user, out, 16) != 0 ||", "memset(out, 7, 16);\n    int failed ="
    ),
    "FAULT_STATIC_FOR_ONE_TIME": Change("agree.c", "memcmp(one_time, station, 65) == 0", "false"),
    "FAULT_ANY_CA": Change("agree.c", "if (!teds_in_factory(node) && memcmp(ca", "if (false && memcmp(ca"),
    "FAULT_CONFIRM_FROM_ANYWHERE": Change(
        "agree.c", "pending->link != origin->link ||\n        pending->session != origin->session", "false"
    ),
    "FAULT_CONFIRM_FROM_ANY_SESSION": Change(
        "session_life.c", "node->pending.used && node->pending.session == session", "false"
    ),
    "FAULT_WRONG_TAG_LEAVES_REQUEST": Change(
        "agree.c", "        teds_pending_forget(node);\n        return -TEDS_BAD_TAG;", "        return -TEDS_BAD_TAG;"
    ),
    "FAULT_SESSIONS_SURVIVE_CONFIRM": Change("agree.c", "    origin->after = TEDS_AFTER_END_ALL;\n", ""),
    "FAULT_REQUEST_HIGH_S": Change("crypto.c", "memcmp(signature + 32, HALF_ORDER, 32) > 0", "false"),
    "FAULT_PROVE_LABEL_WITHOUT_00": Change("commands.c", '"TEDS1 prove", 12', '"TEDS1 prove", 11'),
    "FAULT_PROVE_ANY_CHALLENGE": Change(
        "commands.c",
        "TEDS_PROVE, 32, run_prove}",
        "TEDS_PROVE, ANY, run_prove}",
    ),
    "FAULT_RESET_WITHOUT_EPOCH": Change(
        "commands.c", "{epoch, 4}, {command->payload, 32}};", "{epoch, 0}, {command->payload, 32}};"
    ),
    # -- sessions
    "FAULT_OPEN_INFO_LABEL_WITHOUT_00": Change("session.c", 'LABEL("TEDS1 session")', 'MAC_LABEL("TEDS1 session")'),
    "FAULT_OPEN_POINTS_SWAPPED": Change(
        "session.c",
        "{node->identity.uuid, 10}, {es, 65}, {own->point, 65}};",
        "{node->identity.uuid, 10}, {own->point, 65}, {es, 65}};",
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
        "    node->opens++;\n    return teds_point_good(node, es) && memcmp(es, node->state.agreed.station, 65) != 0 ? 0 : -TEDS_BAD_POINT;",
        "    if (!teds_point_good(node, es) || memcmp(es, node->state.agreed.station, 65) == 0) return -TEDS_BAD_POINT;\n"
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
    "FAULT_LOWER_COUNTER": Change("session.c", "if (taken->counter <= last) {", "if (taken->counter == last) {"),
    "FAULT_FIRST_COUNTER_0": Change(
        "session.c", "if (taken->counter <= last) {", "if (half == NULL && taken->counter <= last) {"
    ),
    "FAULT_LAST_COUNTER": Change("commands.c", "if (taken.counter == UINT32_MAX && ", "if (false && "),
    "FAULT_CLOSE_IGNORED": Change(
        "commands.c", "    origin->after = TEDS_AFTER_END_SESSION;\n    return 0;", "    (void)origin;\n    return 0;"
    ),
    # -- frames and states
    "FAULT_HEADER_LENGTH_IGNORED": Change(
        "commands.c", "if (teds_get16(frame + 4) != command->length) {", "if (false) {"
    ),
    "FAULT_IDENTIFY_ANY_PAYLOAD": Change(
        "commands.c",
        "TEDS_IDENTIFY, 0, run_identify}",
        "TEDS_IDENTIFY, ANY, run_identify}",
    ),
    "FAULT_ADDRESS_240": Change("commands.c", "command->payload[0] > TEDS_LAST_ADDRESS", "command->payload[0] > 240"),
    "FAULT_ADDRESS_AGAIN": Change("commands.c", "if (now < node->address_again) {", "if (false) {"),
    # -- writing
    "FAULT_WRITE_KEEPS_REST": Change(
        "staging.c",
        "    size_t before = 0;\n",
        "    size_t before = 0;\n    if (teds_staged(node, id, &before) != NULL && offset + length < before) {\n"
        "        memcpy((uint8_t *)(uintptr_t)teds_staged(node, id, &before) + offset, octets, length);\n        return 0;\n    }\n"
        "    before = 0;\n",
    ),
    "FAULT_STAGING_FOR_EVER": Change(
        "session_life.c", "    if (node->staging_of == session) {\n        teds_staging_drop(node);\n    }\n", ""
    ),
    "FAULT_OWN_CHECK": Change("commit.c", "if (!teds_own_check((uint8_t)id, image, length)) {", "if (false) {"),
    "FAULT_DIGEST_NOT_LOOKED_AT": Change("commit.c", "|| memcmp(hash, block + 3, 32) != 0) {", ") {"),
    "FAULT_DATASHEET_LABEL_WITHOUT_00": Change("commit.c", '"TEDS1 datasheet", 16', '"TEDS1 datasheet", 15'),
    "FAULT_META_OF_ANOTHER": Change("commit.c", "if (!metas_good(node, teds)) {", "if (false) {"),
    "FAULT_OLD_SEQUENCE": Change(
        "commit.c", "sequence <= node->state.sequence || sequence - node->state.sequence > SEQUENCE_WINDOW", "false"
    ),
    "FAULT_ANY_VALUES": Change("security_teds.c", "case 1: return value[0] == wanted[2];", "case 1: return true;"),
    "FAULT_UTF8_NOT_CHECKED": Change(
        "security_teds.c", "length <= wanted[1] && teds_is_utf8(value, length)", "length <= wanted[1]"
    ),
    "FAULT_REFUSES_111": Change("security_teds.c", "} else if (type <= 110) { /*", "} else { /*"),
    "FAULT_RESET_FORGETS_EPOCH": Change("commit.c", "    state.epoch = node->state.epoch;\n", ""),
    "FAULT_RESET_TAKES_TEDS": Change(
        "slots.c",
        ": id == (int32_t)TEDS_SECURITY_ID && (state->flags & TEDS_PROVISIONED) == 0) {",
        ": (state->flags & TEDS_KEYED) == 0) {",
    ),
    "FAULT_NODE_KEY_WITHOUT_UUID": Change(
        "identity.c", '"TEDS1 node key", 15}, {own->uuid, 10}', '"TEDS1 node key", 15}, {own->uuid, 0}'
    ),
    "FAULT_STALE_INITIAL": Change(
        "security_teds.c", "teds_put32(at + 11, node->state.epoch);", "teds_put32(at + 11, 0);"
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
    "FAULT_KEY_ID_LABEL_WITHOUT_00": Change("session.c", 'LABEL("TEDS1 key id")', 'MAC_LABEL("TEDS1 key id")'),
    "FAULT_OPEN_MAC_LABEL_WITH_00": Change("session.c", 'MAC_LABEL("station open")', 'LABEL("station open")'),
    "FAULT_OPEN_TAG_LABEL_WITH_00": Change("session.c", 'MAC_LABEL("node open")', 'LABEL("node open")'),
    "FAULT_OPEN_MAC_COUNTER_LITTLE_ENDIAN": Change(
        "session.c", "teds_put64(counter, node->opens);", "memcpy(counter, &node->opens, 8);"
    ),
    "FAULT_OPEN_SALT_AND_IKM_SWAPPED": Change(
        "session.c",
        "teds_hkdf(node, node->state.agreed.key, parts, 5, okm, 96)",
        "hkdf_of(node, z, 32, node->state.agreed.key, 16, parts + 1, 4, okm, 96)",
        HKDF,
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
        "commands.c",
        "    case TEDS_REQUEST:\n    case TEDS_CONFIRM:\n    case TEDS_SET_CAN_ADDRESS: return",
        "    case TEDS_REQUEST: return 0;\n    case TEDS_CONFIRM:\n    case TEDS_SET_CAN_ADDRESS: return",
    ),
    "FAULT_RESET_LEAVES_REQUEST": Change(
        "commands.c", "    teds_pending_forget(node);\n    return 64;", "    return 64;"
    ),
    # -- the agreement, once more
    "FAULT_TRANSCRIPT_EPOCH_LITTLE_ENDIAN": Change(
        "agree.c",
        "    /* reply_head: nonceN, epoch and En, as in the reply. */\n",
        "    uint8_t head[85];\n    const uint32_t next = node->state.epoch + 1;\n    memcpy(head, reply_head, 85);\n"
        "    memcpy(head + 16, &next, 4);\n    reply_head = head;\n",
    ),
    "FAULT_EPOCH_STANDS_STILL": Change(
        "agree.c", "teds_put32(out + 16, node->state.epoch + 1);", "teds_put32(out + 16, node->state.epoch);"
    ),
    "FAULT_TRANSCRIPT_DIGEST_OF_DATA_BLOCK": Change(
        "agree.c",
        "    /* reply_head: nonceN, epoch and En, as in the reply. */\n",
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
        "teds_hkdf(node, nonce, parts, 3, okm, 48) != 0",
        "(turned(z), turned(z + 32), teds_hkdf(node, nonce, parts, 3, okm, 48)) != 0",
        "static void turned(uint8_t *at)\n{\n    for (size_t i = 0; i < 16; i++) {\n        uint8_t low = at[i];\n"
        "        at[i] = at[31 - i];\n        at[31 - i] = low;\n    }\n}\n",
    ),
    "FAULT_M_OF_48_OCTETS": Change(
        "agree.c",
        "    uint8_t okm[48];\n",
        "    uint8_t okm[64];\n",
        more=(
            ("teds_hkdf(node, nonce, parts, 3, okm, 48)", "teds_hkdf(node, nonce, parts, 3, okm, 64)"),
            ("okm + 16, 32, for_node", "okm + 16, 48, for_node"),
        ),
    ),
    "FAULT_SIGN_WITHOUT_LABEL": Change(
        "agree.c", '{LABEL("TEDS1 agree"), {script, 32}}', "{{script, 0}, {script, 32}}"
    ),
    "FAULT_SIGN_WITH_ONE_TIME_KEY": Change(
        "agree.c",
        "failed = teds_sign(node, agreed, 2, out + 101) != 0;",
        "teds_node other = *node;\n        other.identity.key = node->one_time.key;\n"
        "        failed = teds_sign(&other, agreed, 2, out + 101) != 0;",
    ),
    "FAULT_SIGN_LITTLE_ENDIAN": Change(
        "agree.c",
        "failed = teds_sign(node, agreed, 2, out + 101) != 0;",
        "failed = teds_sign(node, agreed, 2, out + 101) != 0;\n        turned(out + 101);\n        turned(out + 133);",
        "static void turned(uint8_t *at)\n{\n    for (size_t i = 0; i < 16; i++) {\n        uint8_t low = at[i];\n"
        "        at[i] = at[31 - i];\n        at[31 - i] = low;\n    }\n}\n",
    ),
    "FAULT_SIGN_HIGH_S": Change(
        "agree.c",
        "failed = teds_sign(node, agreed, 2, out + 101) != 0;",
        "failed = teds_sign(node, agreed, 2, out + 101) != 0;\n        high(out + 133);",
        HIGH,
    ),
    "FAULT_PROVE_HIGH_S": Change(
        "commands.c",
        "    return teds_sign(node, parts, 3, out) == 0 ? 64 : -TEDS_FAILURE;",
        "    teds_sign(node, parts, 3, out);\n    high(out + 32);\n    return 64;",
        HIGH,
    ),
    "FAULT_RESET_HIGH_S": Change(
        "commands.c",
        "    if (teds_sign(node, parts, 4, out) != 0) {\n        return -TEDS_FAILURE;\n    }\n",
        "    teds_sign(node, parts, 4, out);\n    high(out + 32);\n",
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
        "agree.c", "memcpy(node->pending.agreed.key, okm, 16);", "memcpy(node->pending.agreed.key, okm + 16, 16);"
    ),
    "FAULT_SAME_ONE_TIME_KEY": Change(
        "agree.c",
        "teds_one_time_make(node) != 0;",
        "(kept.ready ? (node->one_time = kept, 0) : teds_one_time_make(node)) != 0;\n    kept = node->one_time;",
        "static teds_one_time kept;\n",
    ),
    "FAULT_SIGNATURE_BEFORE_POINTS": Change(
        "agree.c",
        "    if (!teds_point_good(node, station) || !teds_point_good(node, ca)",
        "    if (!teds_station_certified(node, station, ca, signature)) {\n"
        "        return -TEDS_BAD_SIGNATURE;\n    }\n    if (!teds_point_good(node, station) || !teds_point_good(node, ca)",
    ),
    "FAULT_CONFIRM_FROM_ANY_LINK": Change(
        "agree.c", "pending->link != origin->link ||\n        pending->session", "pending->session"
    ),
    "FAULT_CONFIRM_BESIDE": Change(
        "agree.c", "pending->link != origin->link ||\n        pending->session != origin->session", "false"
    ),
    "FAULT_HALF_OPEN_SURVIVES_CONFIRM": Change(
        "session_life.c",
        "    teds_wipe(node->half_open, sizeof node->half_open);\n    teds_pending",
        "    teds_pending",
    ),
    # -- frames and states, once more
    "FAULT_UNKNOWN_IS_SILENT": Change(
        "commands.c",
        "    octets = close_reply(reply, outcome);\n",
        "    octets = outcome == -TEDS_UNKNOWN_COMMAND && frame[3] == 99 ? 0 : close_reply(reply, outcome);\n",
    ),
    "FAULT_LONG_REFUSAL": Change(
        "commands.c", "        outcome = 1;\n", "        reply[4] = 0;\n        outcome = 2;\n"
    ),
    "FAULT_LENGTH_BEFORE_STATE": Change(
        "commands.c",
        "    refused = permit_command(node, command, origin);\n",
        "    if (command->command_class == TEDS_CLASS_COMMON && command->function == TEDS_WRITE && length == 6) {\n"
        "        return -TEDS_BAD_FORM;\n    }\n    refused = permit_command(node, command, origin);\n",
    ),
    "FAULT_LONGER_THAN_MAX_MESSAGE": Change(
        "commands.c", "length > TEDS_MAX_MESSAGE ? -TEDS_TOO_LARGE", "length >= TEDS_MAX_MESSAGE ? -TEDS_TOO_LARGE"
    ),
    "FAULT_PROVE_OTHER_KEY": Change(
        "commands.c",
        "    return teds_sign(node, parts, 3, out) == 0 ? 64 : -TEDS_FAILURE;",
        "    teds_node other = *node;\n    other.identity.key.octets[20] ^= 1;\n    return teds_sign(&other, parts, 3, out) == 0 ? 64 : -1;",
    ),
    "FAULT_PROVE_NOT_HASHED": Change(
        "commands.c",
        "    return teds_sign(node, parts, 3, out) == 0 ? 64 : -TEDS_FAILURE;",
        "    (void)parts;\n    node->port->p256_sign(node->port->user, &node->identity.key, command->payload, out);\n"
        "    if (out[32] & 0x80) {\n        high(out + 32);\n    }\n    return 64;",
        HIGH,
    ),
    "FAULT_LIST_TWICE": Change(
        "commands.c",
        "        length += 3;\n",
        "        length += 3;\n        if (length == 3) {\n            memcpy(out + 3, out, 3);\n            length = 6;\n        }\n",
    ),
    "FAULT_ABSENT_AVAILABLE": Change(
        "teds_commands.c", "(source.read_only ? 1u : 0u) | (there ? 0u : 2u)", "(source.read_only ? 1u : 0u)"
    ),
    "FAULT_TEXT_ATTRIBUTE": Change("teds_commands.c", "code >= 128 ? 0x40 :", "code >= 128 ? 0x50 :"),
    "FAULT_TEDS_CHECKSUM": Change(
        "security_teds.c",
        "teds_checksum(out, TEDS_INITIAL_OCTETS - 2));",
        "teds_checksum(out, TEDS_INITIAL_OCTETS - 2) ^ 1);",
    ),
    "FAULT_NOT_CANONICAL": Change("security_teds.c", "109, 1, 2, 110, 1, 2};", "110, 1, 2, 110, 1, 2};"),
    "FAULT_OTHER_SUITE": Change("security_teds.c", "109, 1, 2, 110, 1, 2};", "109, 1, 1, 110, 1, 2};"),
    "FAULT_READ_END_REFUSED": Change(
        "teds_commands.c",
        "    offset = offset < source.length ? offset : source.length;\n",
        "    if (offset >= source.length) {\n        return -TEDS_NO_SUCH_TEDS;\n    }\n",
    ),
    # -- sessions and writing, once more
    "FAULT_OPEN_SAME_ONE_TIME_KEY": Change(
        "session.c",
        "    failed = teds_one_time_make(node) != 0;",
        "    failed = (kept.ready ? (node->one_time = kept, 0) : teds_one_time_make(node)) != 0;\n"
        "    kept = node->one_time;",
        "static teds_one_time kept;\n",
    ),
    "FAULT_OPEN_ENDS_SESSION": Change(
        "session.c",
        "        keep_half_open(node, origin->link, &keys);\n",
        "        keep_half_open(node, origin->link, &keys);\n        teds_session_end(node, teds_session_on(node, origin->link));\n",
    ),
    "FAULT_FIRST_OPEN_STAYS": Change(
        "session.c",
        "    teds_half_open *place = teds_half_open_on(node, link);\n",
        "    teds_half_open *place = teds_half_open_on(node, link);\n    if (place != NULL) {\n        return;\n    }\n",
    ),
    "FAULT_C_LITTLE_ENDIAN": Change(
        "session.c",
        "    node->opens++;\n",
        "    node->opens = __builtin_bswap64(__builtin_bswap64(node->opens) + 1);\n",
    ),
    "FAULT_ONE_SESSION": Change(
        "session_life.c",
        "each < node->sessions + TEDS_SESSIONS; each++) {\n        if (!each->used) {",
        "each < node->sessions + 1; each++) {\n        if (!each->used) {",
    ),
    "FAULT_STRANGER_ENDS_SESSION": Change(
        "commands.c",
        ": parse_command(node, frame, length, &origin, &command);\n    if (",
        ": parse_command(node, frame, length, &origin, &command);\n"
        "    for (int8_t i = 0; !outcome && command.function == TEDS_IDENTIFY && i < TEDS_SESSIONS; i++) {\n"
        "        if (command.command_class == TEDS_CLASS_SECURITY && teds_session_on(node, link) == NULL) {\n"
        "            teds_session_end(node, &node->sessions[i]);\n        }\n    }\n    if (",
    ),
    "FAULT_ANY_SIZE": Change(
        "staging.c",
        "    if (end - before + offset + length > TEDS_STAGING) {\n        return -TEDS_TOO_LARGE;\n    }\n",
        "    if (end - before + offset + length > TEDS_STAGING) {\n        return 0;\n    }\n",
    ),
    "FAULT_REFUSED_WRITE_DROPS": Change(
        "teds_commands.c",
        "    if (offset > staged) {\n        return -TEDS_BAD_FORM;",
        "    if (offset > staged) {\n        teds_staging_drop(node);\n        return -TEDS_BAD_FORM;",
    ),
    "FAULT_EMPTY_WRITE": Change(
        "teds_commands.c",
        "    failed = teds_stage(node, (uint16_t)id, offset, command->payload + 5, octets);\n",
        "    failed = command->length == 5\n"
        "                 ? 0 : teds_stage(node, (uint16_t)id, offset, command->payload + 5, octets);\n",
    ),
    "FAULT_REFUSED_COMMIT_COUNTS": Change(
        "commit.c",
        "    failed = check_datasheet(node, &teds, image, length);\n    if (failed) {\n",
        "    failed = check_datasheet(node, &teds, image, length);\n    if (failed) {\n        node->state.sequence = teds.numbers[0];\n",
    ),
    "FAULT_DATASHEET_HIGH_S": Change("crypto.c", "memcmp(signature + 32, HALF_ORDER, 32) > 0", "false"),
    "FAULT_BASE64_NOT_STRICT": Change(
        "security_teds.c", "return out[65] == 0 && (length == 65 || out[64] == 0);", "return true;"
    ),
    # -- the agreement, to its end
    "FAULT_IDENTITY_KEY_AGREES": Change(
        "agree.c",
        "port->p256_ecdh(port->user, &own->key, payload + 194, z) != 0 ||\n"
        "                       port->p256_ecdh(port->user, &own->key, payload, z + 32)",
        "port->p256_ecdh(port->user, &node->identity.key, payload + 194, z) != 0 ||\n"
        "                 port->p256_ecdh(port->user, &node->identity.key, payload, z + 32)",
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
        "    teds_pending_forget(node);\n    length = answer_request(node, payload, out);\n",
        "    const teds_pending before = node->pending;\n    length = answer_request(node, payload, out);\n"
        "    if (before.used) {\n        node->pending = before;\n        return length;\n    }\n",
    ),
    "FAULT_RESET_KEEPS_CA": Change(
        "agree.c",
        "if (!teds_in_factory(node) && memcmp(ca, node->state.agreed.ca, 65) != 0) {",
        "if (kept[0] == 4 && memcmp(ca, kept, 65) != 0) {",
        "static uint8_t kept[65];\n",
        more=(
            (
                "    state.agreed = pending->agreed; /*",
                "    state.agreed = pending->agreed;\n    memcpy(kept, state.agreed.ca, 65); /*",
            ),
        ),
    ),
    "FAULT_RESET_ANY_CHALLENGE": Change(
        "commands.c",
        "TEDS_PROVE, 32, run_prove}",
        "TEDS_PROVE, ANY, run_prove}",
        more=(("TEDS_RESET, 32, run_reset}", "TEDS_RESET, ANY, run_reset}"),),
    ),
    # -- frames, sessions and writing, to their end
    "FAULT_LIST_LONG": Change(
        "commands.c",
        "    octets = close_reply(reply, outcome);\n",
        "    if (length == 6 && frame[2] == 128 && frame[3] == TEDS_LIST) {\n"
        "        outcome = 2046;\n        memset(reply + 3, 0, 2046);\n    }\n"
        "    octets = close_reply(reply, outcome);\n",
    ),
    "FAULT_WRITE_ANYWHERE": Change(
        "commands.c",
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
        "teds_commands.c",
        "    if (elsewhere && now < node->staged_until) {\n        return -TEDS_BUSY;\n    }\n",
        "",
    ),
    "FAULT_DIGEST_OF_DATA_BLOCKS": Change(
        "commit.c",
        "teds_source_hash(node, &source, hash)",
        "hash_of_block(node, &source, hash)",
        "static int hash_of_block(const teds_node *node, const teds_source *source, uint8_t out[32])\n{\n"
        "    uint8_t whole[16384];\n    const teds_part part = {whole + 4, source->length - 6};\n"
        "    if (teds_source_read(node, source, 0, whole, source->length) != 0) {\n        return -1;\n    }\n"
        "    teds_sha256_parts(node, &part, 1, out);\n    return 0;\n}\n",
    ),
    "FAULT_111_NOT_COVERED": Change(
        "commit.c",
        "    return !teds->others",
        "    for (size_t at = 6; at < length; at += 2u + block[at + 1]) {\n        if (block[at] > 110) {\n"
        "            return true;\n        }\n    }\n    return !teds->others",
    ),
}

SEEN_BY_A_STATION: Final[dict[str, Change]] = {
    # -- comparisons, the commit, what is stored
    "FAULT_OPEN_MAC_OF_8_OCTETS": Change(
        "session.c", "teds_equal(payload + 73, mac, 16)", "teds_equal(payload + 73, mac, 8)"
    ),
    "FAULT_KEY_ID_OF_4_OCTETS": Change("session.c", "teds_equal(payload, key_id, 8)", "teds_equal(payload, key_id, 4)"),
    "FAULT_STATION_TAG_OF_8_OCTETS": Change(
        "agree.c", "teds_equal(command->payload, pending->tag, 16)", "teds_equal(command->payload, pending->tag, 8)"
    ),
    "FAULT_SESSION_OF_ANY_ADDRESS": Change(
        "session.c",
        "    return teds_session_on(node, link) != NULL || teds_half_open_on(node, link) != NULL;",
        "    return teds_session_on(node, link) != NULL || teds_half_open_on(node, link) != NULL || any_session(node) != NULL ||\n"
        "           node->half_open[0].used;",
        "static teds_session *any_session(teds_node *node)\n{\n    for (size_t i = 0; i < TEDS_SESSIONS; i++) {\n"
        "        if (node->sessions[i].used) {\n            return &node->sessions[i];\n        }\n    }\n    return NULL;\n}\n",
        more=(
            (
                "    const teds_keys *keys = NULL;\n    uint32_t last = 0;\n",
                "    const teds_keys *keys = NULL;\n    uint32_t last = 0;\n"
                "    session = session != NULL ? session : any_session(node);\n"
                "    half = half != NULL || !node->half_open[0].used ? half : &node->half_open[0];\n",
            ),
        ),
    ),
    "FAULT_OLDER_EPOCH": Change(
        "commit.c", "teds->numbers[1] == node->state.epoch", "teds->numbers[1] <= node->state.epoch"
    ),
    "FAULT_CALIBRATION_CHECKSUM": Change(
        "security_teds.c",
        "    if (length < 12 || teds_get32(teds)",
        "    if (code == 5) {\n        return true;\n    }\n    if (length < 12 || teds_get32(teds)",
    ),
    "FAULT_NEVER_PROVISIONED": Change("identity.c", "(node->state.flags & TEDS_PROVISIONED) != 0 ? 2 : 1;", "1;"),
    "FAULT_STAGING_SURVIVES_COMMIT": Change(
        "commit.c", "    if (!failed) {\n        teds_staging_drop(node);\n    }\n", ""
    ),
    "FAULT_ROTATION_UNPROVISIONS": Change("agree.c", "state.flags |= TEDS_KEYED;", "state.flags = TEDS_KEYED;"),
    "FAULT_READ_STAGED": Change(
        "teds_commands.c",
        "    if (!teds_find(node, (uint16_t)id, &source)) {\n        return -TEDS_NO_SUCH_TEDS;\n    }\n    offset",
        "    if (!teds_find_new(node, (uint16_t)id, &source)) {\n        return -TEDS_NO_SUCH_TEDS;\n    }\n    offset",
    ),
    "FAULT_UPDATE_STORES": Change(
        "teds_commands.c",
        "        failed = teds_own_check((uint8_t)id, image, octets) ? 0 : -TEDS_BAD_FORM;\n",
        "        failed = teds_own_check((uint8_t)id, image, octets) ? 0 : -TEDS_BAD_FORM;\n"
        "        if (!failed && octets <= sizeof stored) {\n            stored_id = id;\n            stored_octets = octets;\n"
        "            memcpy(stored, image, octets);\n        }\n",
        "static uint8_t stored[64];\nstatic size_t stored_octets;\nstatic int stored_id = -1;\n",
        more=(
            (
                "    if (!teds_find(node, (uint16_t)id, &source)) {\n        return -TEDS_NO_SUCH_TEDS;\n    }\n    offset",
                "    if (id == stored_id && node->staging_end == 0) {\n        teds_put32(out, 0);\n        memcpy(out + 4, stored, stored_octets);\n"
                "        return (int)(4 + stored_octets);\n    }\n"
                "    if (!teds_find(node, (uint16_t)id, &source)) {\n        return -TEDS_NO_SUCH_TEDS;\n    }\n    offset",
            ),
        ),
    ),
    "FAULT_WRITE_READ_ONLY": Change(
        "teds_commands.c",
        "    if (teds_find_fixed(node, (uint16_t)id, &source)) {\n        return -TEDS_NOT_PERMITTED;\n    }\n    offset",
        "    (void)source;\n    offset",
    ),
    # -- frames of CAN
    "FAULT_ANY_TARGET": Change(
        "can.c",
        "    if (own != node->can.address || frame->length < 2) {\n",
        "    (void)own;\n    if (frame->length < 2) {\n",
    ),
    "FAULT_ANYTHING_FUNCTIONAL": Change(
        "can.c",
        "octets != 7 ||\n        memcmp(body + 1, identify, 6) != 0) {",
        "octets != 7) {\n        (void)identify;",
    ),
    "FAULT_ANY_SEQUENCE_NUMBER": Change(
        "can.c", "if (number != can->rx_number || now >= can->rx_until", "if (now >= can->rx_until"
    ),
    "FAULT_BLOCK_SIZE_IGNORED": Change("isotp.c", "line->out_block = data[1];", "line->out_block = 0;"),
    "FAULT_STMIN_IGNORED": Change("isotp.c", "line->out_gap = teds_isotp_gap(data[2]);", "line->out_gap = 0;"),
    "FAULT_WAIT_IGNORED": Change("isotp.c", "    switch (data[0] & 15) {\n", "    switch (data[0] & 14) {\n"),
    "FAULT_SHORT_FIRST_FRAME": Change(
        "can.c", "} else if (length < (frame->length > 8 ? frame->length - 1u : 8u)) {", "} else if (false) {"
    ),
    "FAULT_ESCAPED_CLASSIC_FRAME": Change(
        "isotp.c",
        "const size_t start = length > 8 ? 2 : 1;",
        "const size_t start = length > 8 || (length == 8 && data[0] == 0) ? 2 : 1;",
        more=(("*octets >= (start == 2 ? 8u : 1u)", "*octets >= 1u"),),
    ),
    "FAULT_ANNOUNCE_CRC": Change(
        "can.c",
        "teds_put32(frame->data + 2, teds_uuid_crc(node));",
        "teds_put32(frame->data + 2, teds_uuid_crc(node) ^ 1u);",
    ),
    "FAULT_CLAIM_REVERSED": Change(
        "can.c", "if (crc > own || keeps_address(node)) {", "if (crc < own || keeps_address(node)) {"
    ),
    # -- measurement
    "FAULT_LEASE_255": Change("operation.c", "lease > 60 ||", "(lease > 60 && lease != 255) ||"),
    "FAULT_OPERATE_ANY_DIGEST": Change(
        "operation.c", "if (memcmp(digest, command->payload, 16) != 0) {", "if (false) {"
    ),
    "FAULT_WRITE_UNDER_CLAIM": Change(
        "operation.c",
        "    if (origin->session != NULL && origin->session->claims != 0) {\n        return -TEDS_WRONG_STATE;",
        "    if (origin->session != NULL && origin->session->claims != 0) {\n        return 0;",
    ),
    "FAULT_VALUES_UNCLAIMED": Change(
        "operation.c",
        "return place >= 0 && (origin->session->claims >> place & 1) != 0;",
        "(void)origin;\n    return place >= 0;",
    ),
    "FAULT_LEASE_FOR_EVER": Change(
        "operation.c",
        "            at = each->good_at + each->lease;\n            if (now >= at) {",
        "            at = each->good_at + each->lease;\n            if (false) {",
    ),
    "FAULT_STREAM_NONCE": Change(
        "stream.c", "teds_put32(nonce + 9, stream->full_counter);", "teds_put32(nonce, stream->full_counter);"
    ),
    "FAULT_STREAM_NONCE_STANDS_STILL": Change("stream.c", "    teds_put32(nonce + 9, stream->full_counter);\n", ""),
    "FAULT_RUN_STANDS_STILL": Change("stream.c", "    session->run++;\n", "    session->run = 1;\n"),
    "FAULT_DRIVE_REPLAY": Change(
        "drive.c", "if (session->drive.seen && counter <= session->drive.last) {", "if (false) {"
    ),
    "FAULT_DRIVE_TWICE": Change(
        "drive.c",
        "session->drive.seen && counter <= session->drive.last",
        "session->drive.seen && counter < session->drive.last",
    ),
    "FAULT_ANY_TOKEN": Change("trigger.c", "teds_equal(seen, session->arms[i].commitment, 16)", "seen[0] <= 255"),
}
"""Faults that a station sees only if it looks for them: frame by frame, over all octets, on a board with channels."""

ON_THE_BUS: Final[dict[str, Change]] = {
    "FAULT_REQUEST_RUNS_AGAIN": Change(
        "replies.c", "(frame[3] == TEDS_IDENTIFY ||", "(frame[3] == TEDS_REQUEST || frame[3] == TEDS_IDENTIFY ||"
    ),
    "FAULT_OPEN_RUNS_AGAIN": Change(
        "replies.c", "(frame[3] == TEDS_IDENTIFY ||", "(frame[3] == TEDS_OPEN || frame[3] == TEDS_IDENTIFY ||"
    ),
    "FAULT_RUNS_AGAIN": Change("replies.c", "    if (!place->stored || memcmp(digest", "    if (true || memcmp(digest"),
    "FAULT_EVERYONE_DROPS_REPLY": Change(
        "can.c",
        "    line->asked = false;\n",
        "    line->asked = false;\n    for (size_t i = 0; i < TEDS_REPLIES; i++) {\n"
        "        node->replies[i].stored = node->replies[i].stored && node->replies[i].link != line->source;\n    }\n",
    ),
    "FAULT_BUSY_SILENT": Change(
        "can.c",
        "    if (reason != 0) {\n        refuse_request(line, frame->data[head]",
        "    if (reason == TEDS_BUSY) {\n        return;\n    }\n    if (reason != 0) {\n        refuse_request(line, frame->data[head]",
    ),
    "FAULT_ADDRESS_TOO_SOON": Change(
        "commands.c",
        "    node->can.moves_to = command->payload[0]; /* once the reply has been sent */\n"
        "    node->can.moves_link = origin->link;\n",
        "    teds_address_move(node, command->payload[0]);\n",
    ),
    "FAULT_ADDRESS_STAYS": Change(
        "can.c",
        "    if (own != node->can.address || frame->length < 2) {\n",
        "    if ((own != node->can.address && own != teds_default_address(node)) || frame->length < 2) {\n",
        more=(("    switch (frame->data[0] >> 4) {\n", "    line->own = own;\n    switch (frame->data[0] >> 4) {\n"),),
    ),
}
"""Faults of the node's lines, which a frame that is handed over whole does not meet: found over a bus."""
