/* The Security TEDS (security-teds.md, 1): the initial one, and the canonical form of a signed one. Octets alone. */
#include "inside.h"

static const uint8_t TEDSID[6] = {3, 4, 0, 128, 1, 1};

uint16_t teds_checksum(uint32_t sum)
{
    return (uint16_t)(0xFFFFu - (sum & 0xFFFFu));
}

bool teds_own_check(uint8_t code, const uint8_t *teds, size_t length)
{
    uint32_t sum = 0;
    if (length < 12 || teds_get32(teds) != length - 4) {
        return false;
    }
    for (size_t i = 0; i < length - 2; i++) {
        sum += teds[i];
    }
    if (teds_get16(teds + length - 2) != teds_checksum(sum) || teds[4] != 3) {
        return false;
    }
    if (teds[5] == 4) {
        return teds[7] == code;
    }
    return teds[5] == 5 && length >= 13 && teds[8] == code;
}

static const char SIXTY_FOUR[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

void teds_base64(const uint8_t *octets, size_t length, uint8_t *out)
{
    for (size_t at = 0; at < length; at += 3) {
        uint32_t three = (uint32_t)octets[at] << 16;
        three |= at + 1 < length ? (uint32_t)octets[at + 1] << 8 : 0;
        three |= at + 2 < length ? octets[at + 2] : 0;
        *out++ = (uint8_t)SIXTY_FOUR[three >> 18];
        *out++ = (uint8_t)SIXTY_FOUR[three >> 12 & 63];
        *out++ = (uint8_t)(at + 1 < length ? SIXTY_FOUR[three >> 6 & 63] : '=');
        *out++ = (uint8_t)(at + 2 < length ? SIXTY_FOUR[three & 63] : '=');
    }
}

static int six_bits(uint8_t letter)
{
    if (letter >= 'A' && letter <= 'Z') {
        return letter - 'A';
    }
    if (letter >= 'a' && letter <= 'z') {
        return letter - 'a' + 26;
    }
    if (letter >= '0' && letter <= '9') {
        return letter - '0' + 52;
    }
    return letter == '+' ? 62 : letter == '/' ? 63 : -1;
}

/* 88 letters of canonical base64 to `length` octets, 64 or 65: padded, spare bits zero. `out` has room for 66. */
static bool from_base64(const uint8_t *text, size_t length, uint8_t *out)
{
    const size_t letters = length == 64 ? 86 : 87;
    uint32_t bits = 0;
    size_t at = 0;
    for (size_t i = 0; i < 88; i++) {
        int value = i < letters ? six_bits(text[i]) : (text[i] == '=' ? 0 : -1);
        if (value < 0) {
            return false;
        }
        bits = bits << 6 | (uint32_t)value;
        if (i % 4 == 3) {
            out[at++] = (uint8_t)(bits >> 16);
            out[at++] = (uint8_t)(bits >> 8);
            out[at++] = (uint8_t)bits;
            bits = 0;
        }
    }
    return out[65] == 0 && (length == 65 || out[64] == 0);
}

static uint8_t *tuple(uint8_t *at, uint8_t type, const uint8_t *octets, uint8_t length)
{
    at[0] = type;
    at[1] = length;
    memcpy(at + 2, octets, length);
    return at + 2 + length;
}

void teds_initial(const teds_node *node, uint8_t out[TEDS_INITIAL_OCTETS])
{
    static const uint8_t values[] = {1, 1, 4, 2, 1, 2, 3, 1, 0, 4, 1, 1, 5, 0, 6, 8, 0, 0, 0, 0, 0, 0, 0, 0};
    static const uint8_t version = 1, suite = 2, agreement = 2;
    uint8_t number[4], text[88];
    uint8_t *at = out + 4;
    uint32_t sum = 0;
    memcpy(at, TEDSID, 6);
    memcpy(at + 6, values, sizeof values);
    at += 6 + sizeof values;
    teds_base64(node->point, 65, text);
    at = tuple(at, 101, text, 88);
    teds_base64(node->signature, 64, text);
    at = tuple(at, 102, text, 88);
    at = tuple(at, 105, &version, 1);
    teds_put32(number, node->state.sequence);
    at = tuple(at, 106, number, 4);
    teds_put32(number, node->state.epoch);
    at = tuple(at, 107, number, 4);
    at = tuple(at, 109, &suite, 1);
    at = tuple(at, 110, &agreement, 1);
    teds_put32(out, (uint32_t)(at - out) - 4 + 2);
    for (const uint8_t *each = out; each < at; each++) {
        sum += *each;
    }
    teds_put16(at, teds_checksum(sum));
}

/* RFC 3629: no overlong forms, no surrogates, nothing above U+10FFFF. */
static bool is_utf8(const uint8_t *text, size_t length)
{
    size_t at = 0;
    while (at < length) {
        uint8_t first = text[at++];
        uint8_t low = 0x80, high = 0xBF;
        size_t more;
        if (first < 0x80) {
            continue;
        }
        if (first < 0xC2 || first > 0xF4) {
            return false;
        }
        more = first < 0xE0 ? 1 : first < 0xF0 ? 2 : 3;
        low = first == 0xE0 ? 0xA0 : first == 0xF0 ? 0x90 : low;
        high = first == 0xED ? 0x9F : first == 0xF4 ? 0x8F : high;
        for (; more > 0; more--, at++) {
            if (at >= length || text[at] < low || text[at] > high) {
                return false;
            }
            low = 0x80;
            high = 0xBF;
        }
    }
    return true;
}

/* The value that the profile wants in a field of one octet; -1 for another field. */
static int own_value(uint8_t type)
{
    switch (type) {
    case 1: return 4;
    case 2: return 2;
    case 3: return 0;
    case 4: return 1;
    case 105: return 1;
    case 109: return 2;
    case 110: return 2;
    default: return -1;
    }
}

/* Fields that a signed one must hold, as bits: 1 to 6, and 100 to 110 without 108 from bit 8 on. */
#define MUST_HOLD (0x7Eu | ((0x7FFu << 8) & ~(1u << 16)))

static bool take_field(teds_signed *out, uint8_t type, const uint8_t *value, size_t length, size_t at)
{
    uint8_t scratch[66];
    if (own_value(type) >= 0) {
        return length == 1 && value[0] == own_value(type);
    }
    switch (type) {
    case 5: return length <= 64 && is_utf8(value, length);
    case 6: return length == 8;
    case 100:
        out->signature_at = at;
        if (length != 88 || !from_base64(value, 64, scratch)) {
            return false;
        }
        memcpy(out->signature, scratch, 64);
        return true;
    case 101:
        out->node_key = value;
        return length == 88 && from_base64(value, 65, scratch);
    case 102:
        out->node_signature = value;
        return length == 88 && from_base64(value, 64, scratch);
    case 103:
        if (length != 88 || !from_base64(value, 65, scratch)) {
            return false;
        }
        memcpy(out->station, scratch, 65);
        return true;
    case 104:
        if (length != 88 || !from_base64(value, 64, scratch)) {
            return false;
        }
        memcpy(out->station_signature, scratch, 64);
        return true;
    case 106:
        out->sequence = length == 4 ? teds_get32(value) : 0;
        return length == 4;
    case 107:
        out->epoch = length == 4 ? teds_get32(value) : 0;
        return length == 4;
    default: return type > 110; /* 111 to 255 are skipped */
    }
}

static bool take_block(teds_signed *out, const uint8_t *tuple_at, size_t length)
{
    const uint8_t *value = tuple_at + 2;
    static const uint8_t itself[3] = {0, 0, 128};
    if (length != 35 || memcmp(value, itself, 3) == 0) {
        return false;
    }
    if (out->block_count == 0) {
        out->blocks = tuple_at;
    } else if (memcmp(value, out->blocks + 37 * (out->block_count - 1) + 2, 3) <= 0) {
        return false;
    }
    out->block_count++;
    return true;
}

bool teds_security_parse(const uint8_t *block, size_t length, teds_signed *out)
{
    uint32_t there = 0;
    uint8_t last = 0;
    size_t at = 6;
    memset(out, 0, sizeof *out);
    if (length < 6 || memcmp(block, TEDSID, 6) != 0) {
        return false;
    }
    while (at < length) {
        uint8_t type = block[at];
        size_t octets = at + 1 < length ? block[at + 1] : 256;
        if (at + 2 + octets > length) {
            return false;
        }
        if (type == 108) {
            if (last > 108 || !take_block(out, block + at, octets)) {
                return false;
            }
        } else {
            if (type <= last || !take_field(out, type, block + at + 2, octets, at)) {
                return false;
            }
            there |= type <= 6 ? 1u << type : type <= 110 ? 1u << (type - 92) : 0;
        }
        last = type;
        at += 2 + octets;
    }
    return (there & MUST_HOLD) == MUST_HOLD;
}
