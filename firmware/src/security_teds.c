/* SPDX-License-Identifier: Apache-2.0 */
/* The Security TEDS (security-teds.md, 1) as octets: the initial one, and the canonical form of a signed one. */
#include "security_teds.h"
#include "inside.h"

/* Checksum of a TEDS whose `length` octets precede it. */
uint16_t teds_checksum(const uint8_t *octets, size_t length)
{
    uint32_t sum = 0;
    for (size_t i = 0; i < length; i++) {
        sum += octets[i];
    }
    return (uint16_t)(0xFFFFu - (sum & 0xFFFFu));
}

bool teds_own_check(uint8_t code, const uint8_t *teds, size_t length)
{
    if (length < 12 || teds_get32(teds) != length - 4 ||
        teds_get16(teds + length - 2) != teds_checksum(teds, length - 2) || teds[4] != 3) {
        return false;
    }
    if (teds[5] == 4) {
        return teds[7] == code;
    }
    return teds[5] == 5 && length >= 13 && teds[8] == code;
}

static const char SIXTY_FOUR[64] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

static void put_base64(const uint8_t *octets, size_t length, uint8_t *out)
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

static int decode_six_bits(uint8_t letter)
{
    const char *at = memchr(SIXTY_FOUR, letter, sizeof SIXTY_FOUR);
    return at != NULL ? (int)(at - SIXTY_FOUR) : -1;
}

/* 88 letters of canonical base64 to `length` octets, 64 or 65: padded, spare bits zero. `out` has room for 66. */
static bool decode_base64(const uint8_t *text, size_t length, uint8_t *out)
{
    const size_t letters = length == 64 ? 86 : 87;
    uint32_t bits = 0;
    size_t at = 0;
    for (size_t i = 0; i < 88; i++) {
        int value = i < letters ? decode_six_bits(text[i]) : (text[i] == '=' ? 0 : -1);
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

/* The initial one consists of a head, fields 101 and 102 in base64 with a head of two octets each, and a tail. */
#define TEXT_OCTETS 88u
#define TAIL_AT (TEDS_INITIAL_OCTETS - 2 - sizeof TAIL)
static const uint8_t HEAD[] = {0, 0, 0, TEDS_INITIAL_OCTETS - 4, 3, 4, 0, 128, 1, 1, 1, 1, 4, 2, 1, 2, 3, 1, 0,
                               4, 1, 1, 5, 0, 6, 8, 0, 0, 0, 0, 0, 0, 0, 0, 101, TEXT_OCTETS};
static const uint8_t TAIL[] = {105, 1, 1, 106, 4, 0, 0, 0, 0, 107, 4, 0, 0, 0, 0, 109, 1, 2, 110, 1, 2};

void teds_put_initial(const teds_node *node, uint8_t out[TEDS_INITIAL_OCTETS])
{
    uint8_t *at = out + sizeof HEAD;
    memcpy(out, HEAD, sizeof HEAD);
    put_base64(node->identity.point, 65, at);
    at[TEXT_OCTETS] = 102;
    at[TEXT_OCTETS + 1] = TEXT_OCTETS;
    put_base64(node->identity.signature, 64, at + TEXT_OCTETS + 2);
    at = out + TAIL_AT;
    memcpy(at, TAIL, sizeof TAIL);
    teds_put32(at + 5, node->state.sequence);
    teds_put32(at + 11, node->state.epoch);
    teds_put16(at + sizeof TAIL, teds_checksum(out, TEDS_INITIAL_OCTETS - 2));
}

bool teds_is_utf8(const uint8_t *text, size_t length)
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

/* Fields of a signed one, each once and ascending: type, length, and the value that the profile requires for fields of
 * one octet. 108 comes between 107 and 109, once for each block. */
static const uint8_t FIELDS[][3] = {
    {1, 1, 4},          {2, 1, 2},          {3, 1, 0},          {4, 1, 1},          {5, 64, 0},         {6, 8, 0},
    {100, TEXT_OCTETS}, {101, TEXT_OCTETS}, {102, TEXT_OCTETS}, {103, TEXT_OCTETS}, {104, TEXT_OCTETS}, {105, 1, 1},
    {106, 4, 0},        {107, 4, 0},        {109, 1, 2},        {110, 1, 2},
};
#define FIELD_COUNT (sizeof FIELDS / sizeof FIELDS[0])

/* 88 letters: a signature (100, 102, 104) or a point (101, 103). Values that are only compared are decoded into the
 * place of 103, which comes later, to save stack. */
static bool take_text(const teds_node *node, teds_signed *out, uint8_t type, const uint8_t *text)
{
    const uint8_t *own = type == 101 ? node->identity.point : node->identity.signature;
    const size_t length = 64u + (type & 1u);
    uint8_t *octets = out->decoded[type == 100 ? TEDS_SIGNATURE : type == 104 ? TEDS_STATION_SIGNATURE : TEDS_STATION];
    if (!decode_base64(text, length, octets)) {
        return false;
    }
    if ((type == 101 || type == 102) && memcmp(octets, own, length) != 0) {
        out->others = true;
    }
    return true;
}

static bool take_field(const teds_node *node, teds_signed *out, const uint8_t wanted[3], const uint8_t *value,
                       size_t length)
{
    const uint8_t type = wanted[0];
    if (type == 5) {
        return length <= wanted[1] && teds_is_utf8(value, length);
    }
    if (length != wanted[1]) {
        return false;
    }
    switch (length) {
    case 1: return value[0] == wanted[2];
    case 4: out->numbers[type - 106] = teds_get32(value); return true;
    case TEXT_OCTETS: return take_text(node, out, type, value);
    default: return true;
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

bool teds_security_parse(const teds_node *node, const uint8_t *block, size_t length, teds_signed *out)
{
    size_t at = 6, next = 0;
    uint8_t last = 0;
    memset(out, 0, sizeof *out);
    if (length < 6 || memcmp(block, HEAD + 4, 6) != 0) {
        return false;
    }
    while (at < length) {
        uint8_t type = block[at];
        size_t octets = at + 1 < length ? block[at + 1] : 256;
        if (at + 2 + octets > length || type < last || (type == last && type != 108)) {
            return false;
        }
        if (type == 108) {
            if (!take_block(out, block + at, octets)) {
                return false;
            }
        } else if (type <= 110) { /* 111 to 255 are skipped */
            if (next == FIELD_COUNT || type != FIELDS[next][0] ||
                !take_field(node, out, FIELDS[next], block + at + 2, octets)) {
                return false;
            }
            out->signature_at = type == 100 ? at : out->signature_at;
            next++;
        }
        last = type;
        at += 2 + octets;
    }
    return next == FIELD_COUNT;
}

/* A listed block: channel 2, access code 1, digest 32, after the head of its tuple. */
const uint8_t *teds_listed_block(const teds_signed *teds, size_t place)
{
    return teds->blocks + 37 * place + 2;
}

bool teds_is_listed(const teds_signed *teds, uint16_t id)
{
    for (size_t i = 0; i < teds->block_count; i++) {
        const uint8_t *block = teds_listed_block(teds, i);
        if (block[0] == 0 && block[1] == id >> 8 && block[2] == (id & 0xFF)) {
            return true;
        }
    }
    return false;
}
