/* SPDX-License-Identifier: Apache-2.0 */
/* Hashes, keys and signatures over the port's primitives (profile.md, "Cryptography"); this file knows no commands.
 * NIST SP 800-56A ECC CDH with one-time keys, HKDF of RFC 5869; the node's identity key is only used to sign. */
#include "crypto.h"
#include "inside.h"

/* -- hashes and keys ----------------------------------------------------------------------------------------------- */

void teds_sha256_parts(const teds_node *node, const teds_part *parts, size_t count, uint8_t out[32])
{
    const teds_port *port = node->port;
    teds_sha256 state;
    port->sha256_start(port->user, &state);
    for (size_t i = 0; i < count; i++) {
        port->sha256_update(port->user, &state, parts[i].octets, parts[i].length);
    }
    port->sha256_finish(port->user, &state, out);
}

int teds_hkdf_expand(const teds_node *node, const uint8_t prk[32], const teds_part *info, size_t count, uint8_t *out,
                     size_t length)
{
    uint8_t block[32];
    teds_part parts[8];
    uint8_t number = 1;
    int failed = 0;
    for (size_t i = 0; i < count; i++) {
        parts[1 + i] = info[i];
    }
    parts[0] = (teds_part){block, 0}; /* from the second round on, the previous block */
    parts[1 + count] = (teds_part){&number, 1};
    for (size_t at = 0; at < length && !failed; at += 32) {
        failed = node->port->hmac(node->port->user, prk, 32, parts, count + 2, block);
        memcpy(out + at, block, length - at < 32 ? length - at : 32);
        parts[0].length = 32;
        number++;
    }
    teds_wipe(block, sizeof block);
    return failed;
}

int teds_hkdf(const teds_node *node, const uint8_t salt[16], const teds_part *parts, size_t count, uint8_t *out,
              size_t length)
{
    uint8_t prk[32];
    int failed = node->port->hmac(node->port->user, salt, 16, parts, 1, prk);
    if (!failed) {
        failed = teds_hkdf_expand(node, prk, parts + 1, count - 1, out, length);
    }
    teds_wipe(prk, sizeof prk);
    return failed;
}

int teds_mac(const teds_node *node, const uint8_t *key, size_t key_length, const teds_part *parts, size_t count,
             uint8_t out[16])
{
    uint8_t mac[32];
    int failed = node->port->hmac(node->port->user, key, key_length, parts, count, mac);
    if (!failed) {
        memcpy(out, mac, 16);
    }
    teds_wipe(mac, sizeof mac);
    return failed;
}

/* -- points and signatures ----------------------------------------------------------------------------------------- */

/* Group order of P-256 and its half, SP 800-186. */
static const uint8_t ORDER[32] = {0xFF, 0xFF, 0xFF, 0xFF, 0,    0,    0,    0,    0xFF, 0xFF, 0xFF,
                                  0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xBC, 0xE6, 0xFA, 0xAD, 0xA7, 0x17,
                                  0x9E, 0x84, 0xF3, 0xB9, 0xCA, 0xC2, 0xFC, 0x63, 0x25, 0x51};
static const uint8_t HALF_ORDER[32] = {0x7F, 0xFF, 0xFF, 0xFF, 0x80, 0,    0,    0,    0x7F, 0xFF, 0xFF,
                                       0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xDE, 0x73, 0x7D, 0x56, 0xD3, 0x8B,
                                       0xCF, 0x42, 0x79, 0xDC, 0xE5, 0x61, 0x7E, 0x31, 0x92, 0xA8};

bool teds_point_good(const teds_node *node, const uint8_t point[65])
{
    return point[0] == 4 && memcmp(point, node->identity.point, 65) != 0 && node->port->p256_good(node->port->user, point);
}

static bool is_zero(const uint8_t number[32])
{
    uint8_t any = 0;
    for (size_t i = 0; i < 32; i++) {
        any |= number[i];
    }
    return any == 0;
}

bool teds_verify(const teds_node *node, const uint8_t point[65], const teds_part *parts, size_t count,
                 const uint8_t signature[64])
{
    uint8_t hash[32];
    if (is_zero(signature) || is_zero(signature + 32) ||
        memcmp(signature, ORDER, 32) >= 0 || memcmp(signature + 32, HALF_ORDER, 32) > 0) {
        return false;
    }
    teds_sha256_parts(node, parts, count, hash);
    return node->port->p256_verify(node->port->user, point, hash, signature);
}

bool teds_station_certified(const teds_node *node, const uint8_t station[65], const uint8_t ca[65],
                            const uint8_t signature[64])
{
    const teds_part certified[] = {LABEL("TEDS1 station key"), {station, 65}};
    return teds_verify(node, ca, certified, 2, signature);
}

int teds_sign(const teds_node *node, const teds_part *parts, size_t count, uint8_t out[64])
{
    uint32_t borrow = 0;
    uint8_t hash[32];
    teds_sha256_parts(node, parts, count, hash);
    if (node->port->p256_sign(node->port->user, &node->identity.key, hash, out) != 0) {
        return -TEDS_FAILURE;
    }
    if (memcmp(out + 32, HALF_ORDER, 32) > 0) { /* s becomes n - s */
        for (size_t i = 32; i-- > 0;) {
            uint32_t value = (uint32_t)ORDER[i] - out[32 + i] - borrow;
            out[32 + i] = (uint8_t)value;
            borrow = value >> 31;
        }
    }
    return 0;
}

/* -- one-time keys ------------------------------------------------------------------------------------------------- */

int teds_one_time_make(teds_node *node)
{
    teds_one_time *own = &node->one_time;
    if (!own->ready) {
        own->ready = node->port->p256_make(node->port->user, TEDS_KEY_AGREES, &own->key, own->point) == 0;
    }
    return own->ready ? 0 : -TEDS_FAILURE;
}

void teds_one_time_drop(teds_node *node)
{
    teds_one_time *own = &node->one_time;
    if (own->ready && node->port->p256_drop != NULL) {
        node->port->p256_drop(node->port->user, &own->key);
    }
    teds_wipe(own, sizeof *own);
}
