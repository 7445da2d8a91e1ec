/* SPDX-License-Identifier: Apache-2.0 */
/* Key agreement (security-teds.md, 3): Request, Confirm, and the hashes, keys and signatures under them.
 *
 * NIST SP 800-56A ECC CDH over two one-time keys and the station's static one, HKDF of RFC 5869. The node's identity
 * key only signs. Z, OKM and both one-time keys are wiped after use.
 */
#include "agree.h"
#include "clock.h"
#include "operation.h"
#include "teds_store.h"
#include "inside.h"

#define PENDING_NS (60u * TEDS_SECOND)
#define REQUEST_OCTETS 259u
#define LABEL(text) {(const uint8_t *)(text), sizeof(text)}          /* ends in 00 */
#define MAC_LABEL(text) {(const uint8_t *)(text), sizeof(text) - 1u} /* does not */

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
    parts[0] = (teds_part){block, 0}; /* the block before, from the second on */
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

void teds_pending_forget(teds_node *node)
{
    teds_wipe(&node->pending, sizeof node->pending);
}

int teds_agree(teds_node *node, const uint8_t *payload, const uint8_t nonce[16], const uint8_t script[32],
               uint8_t node_tag[16])
{
    const teds_port *port = node->port;
    const teds_one_time *own = &node->one_time;
    uint8_t z[64];
    const teds_part parts[] = {{z, 64}, LABEL("TEDS1 link key"), {script, 32}};
    const teds_part for_node[] = {MAC_LABEL("node"), {script, 32}};
    const teds_part for_station[] = {MAC_LABEL("station"), {script, 32}};
    uint8_t okm[48];
    const int failed = port->p256_ecdh(port->user, &own->key, payload + 194, z) != 0 ||
                       port->p256_ecdh(port->user, &own->key, payload, z + 32) != 0 ||
                       teds_hkdf(node, nonce, parts, 3, okm, 48) != 0 ||
                       teds_mac(node, okm + 16, 32, for_node, 2, node_tag) != 0 ||
                       teds_mac(node, okm + 16, 32, for_station, 2, node->pending.tag) != 0;
    if (!failed) {
        memcpy(node->pending.agreed.key, okm, 16);
    }
    teds_wipe(okm, sizeof okm);
    teds_wipe(z, sizeof z);
    return failed;
}

int teds_transcript(teds_node *node, const uint8_t *request, const uint8_t *reply_head, uint8_t out[32])
{
    teds_source source;
    uint8_t teds[32];
    if (!teds_find(node, TEDS_SECURITY_ID, &source) || teds_source_hash(node, &source, teds) != 0) {
        return -TEDS_FAILURE;
    }
    /* reply_head: nonceN, epoch, En as they stand in the reply */
    const teds_part parts[] = {LABEL("TEDS1 transcript"), {request, REQUEST_OCTETS}, {reply_head, 85},
                               {node->identity.uuid, 10},          {node->identity.point, 65},         {teds, 32}};
    teds_sha256_parts(node, parts, sizeof parts / sizeof parts[0], out);
    return 0;
}

bool teds_certified(const teds_node *node, const uint8_t station[65], const uint8_t ca[65],
                    const uint8_t signature[64])
{
    const teds_part certified[] = {LABEL("TEDS1 station key"), {station, 65}};
    return teds_verify(node, ca, certified, 2, signature);
}

static int check_request(const teds_node *node, const uint8_t *payload)
{
    const uint8_t *station = payload, *signature = payload + 65, *ca = payload + 129, *one_time = payload + 194;
    if (!teds_point_good(node, station) || !teds_point_good(node, ca) || !teds_point_good(node, one_time) ||
        memcmp(one_time, station, 65) == 0) {
        return -TEDS_BAD_POINT;
    }
    if (!teds_in_factory(node) && memcmp(ca, node->state.agreed.ca, 65) != 0) {
        return -TEDS_UNTRUSTED;
    }
    if (!teds_certified(node, station, ca, signature)) {
        return -TEDS_BAD_SIGNATURE;
    }
    return node->state.epoch == UINT32_MAX ? -TEDS_WRONG_EPOCH : 0;
}

/* What a checked Request makes: the reply's 165 octets, and what pends. */
static int answer(teds_node *node, const uint8_t *payload, uint8_t *out)
{
    const teds_port *port = node->port;
    uint8_t script[32];
    int failed = port->random(port->user, out, 16) != 0 || teds_one_time_make(node) != 0;
    if (!failed) {
        teds_put32(out + 16, node->state.epoch + 1);
        memcpy(out + 20, node->one_time.point, 65);
        failed = teds_transcript(node, payload, out, script) != 0 ||
                 teds_agree(node, payload, out, script, out + 85) != 0;
    }
    if (!failed) {
        const teds_part agreed[] = {LABEL("TEDS1 agree"), {script, 32}};
        failed = teds_sign(node, agreed, 2, out + 101) != 0;
    }
    return failed ? -TEDS_FAILURE : 165;
}

int teds_request(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const uint8_t *payload = command->payload;
    int length;
    if (command->length != REQUEST_OCTETS) {
        return -TEDS_BAD_FORM;
    }
    length = check_request(node, payload);
    if (length < 0) {
        return length;
    }
    teds_pending_forget(node);
    length = answer(node, payload, out);
    teds_one_time_drop(node);
    if (length < 0) {
        teds_pending_forget(node);
        return length;
    }
    node->pending.used = true;
    node->pending.link = origin->link;
    node->pending.session = origin->session;
    node->pending.until = teds_now(node) + PENDING_NS;
    node->pending.epoch = node->state.epoch + 1;
    memcpy(node->pending.agreed.station, payload, 65);
    memcpy(node->pending.agreed.ca, payload + 129, 65);
    return length;
}

int teds_confirm(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const teds_pending *pending = &node->pending;
    teds_state state;
    int failed;
    (void)out;
    if (!pending->used || teds_now(node) >= pending->until || pending->link != origin->link ||
        pending->session != origin->session) {
        return -TEDS_WRONG_STATE;
    }
    if (command->length != 16) {
        return -TEDS_BAD_FORM;
    }
    if (!teds_equal(command->payload, pending->tag, 16)) {
        teds_pending_forget(node);
        return -TEDS_BAD_TAG;
    }
    state = node->state;
    state.flags |= TEDS_KEYED;
    state.epoch = pending->epoch;
    state.agreed = pending->agreed; /* its CA is the kept one, outside factory state: Request has seen to that */
#if TEDS_OPERATION
    teds_everything_safe(node);
#endif
    failed = teds_store_write(node, &state, NULL);
    teds_wipe(&state, sizeof state);
    if (failed) {
        return failed;
    }
    teds_pending_forget(node);
    origin->after = TEDS_AFTER_END_ALL;
    return 0;
}
