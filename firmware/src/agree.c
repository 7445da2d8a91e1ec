/* Key agreement (security-teds.md, 3): Request, Confirm, and the hashes, keys and signatures under them.
 *
 * NIST SP 800-56A ECC CDH over two one-time keys and the station's static one, HKDF of RFC 5869. The node's identity
 * key only signs. Z, OKM and both one-time keys are wiped after use.
 */
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
    for (size_t at = 0; at < length && !failed; number++) {
        size_t piece = length - at < 32 ? length - at : 32;
        parts[0] = (teds_part){block, number == 1 ? 0u : 32u};
        parts[1 + count] = (teds_part){&number, 1};
        failed = node->port->hmac(node->port->user, prk, 32, parts, count + 2, block);
        memcpy(out + at, block, piece);
        at += piece;
    }
    teds_wipe(block, sizeof block);
    return failed;
}

int teds_hkdf(const teds_node *node, const uint8_t *salt, size_t salt_length, const uint8_t *ikm, size_t ikm_length,
              const teds_part *info, size_t count, uint8_t *out, size_t length)
{
    uint8_t prk[32];
    const teds_part part = {ikm, ikm_length};
    int failed = node->port->hmac(node->port->user, salt, salt_length, &part, 1, prk);
    if (!failed) {
        failed = teds_hkdf_expand(node, prk, info, count, out, length);
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
    return point[0] == 4 && memcmp(point, node->point, 65) != 0 && node->port->p256_good(node->port->user, point);
}

bool teds_verify(const teds_node *node, const uint8_t point[65], const uint8_t hash[32], const uint8_t signature[64])
{
    static const uint8_t zero[32] = {0};
    if (memcmp(signature, zero, 32) == 0 || memcmp(signature + 32, zero, 32) == 0) {
        return false;
    }
    if (memcmp(signature, ORDER, 32) >= 0 || memcmp(signature + 32, HALF_ORDER, 32) > 0) {
        return false;
    }
    return node->port->p256_verify(node->port->user, point, hash, signature);
}

int teds_sign(const teds_node *node, const uint8_t hash[32], uint8_t out[64])
{
    uint32_t borrow = 0;
    if (node->port->p256_sign(node->port->user, &node->key, hash, out) != 0) {
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

int teds_one_time_take(teds_node *node, teds_one_time *out)
{
    if (node->one_time.ready) {
        *out = node->one_time;
        teds_wipe(&node->one_time, sizeof node->one_time);
        return 0;
    }
    if (node->port->p256_make(node->port->user, TEDS_KEY_AGREES, &out->key, out->point) != 0) {
        return -TEDS_FAILURE;
    }
    out->ready = true;
    return 0;
}

void teds_one_time_wipe(const teds_node *node, teds_one_time *key)
{
    if (key->ready && node->port->p256_drop != NULL) {
        node->port->p256_drop(node->port->user, &key->key);
    }
    teds_wipe(key, sizeof *key);
}

void teds_key_id(const teds_node *node, const uint8_t key[16], uint8_t out[8])
{
    const teds_part parts[] = {LABEL("TEDS1 key id"), {key, 16}};
    uint8_t hash[32];
    teds_sha256_parts(node, parts, 2, hash);
    memcpy(out, hash, 8);
}

void teds_pending_forget(teds_node *node)
{
    teds_wipe(&node->pending, sizeof node->pending);
}

/* Link key, node's tag and station's tag from Z and T. */
static int derive(teds_node *node, const uint8_t z[64], const uint8_t nonce[16], const uint8_t script[32],
                  uint8_t node_tag[16])
{
    const teds_part info[] = {LABEL("TEDS1 link key"), {script, 32}};
    const teds_part for_node[] = {MAC_LABEL("node"), {script, 32}};
    const teds_part for_station[] = {MAC_LABEL("station"), {script, 32}};
    const teds_port *port = node->port;
    uint8_t okm[48], mac[32];
    int failed = teds_hkdf(node, nonce, 16, z, 64, info, 2, okm, 48);
    if (!failed) {
        failed = port->hmac(port->user, okm + 16, 32, for_node, 2, mac);
        memcpy(node_tag, mac, 16);
    }
    if (!failed) {
        failed = port->hmac(port->user, okm + 16, 32, for_station, 2, mac);
        memcpy(node->pending.tag, mac, 16);
        memcpy(node->pending.key, okm, 16);
    }
    teds_wipe(okm, sizeof okm);
    teds_wipe(mac, sizeof mac);
    return failed;
}

static int transcript(teds_node *node, const uint8_t *request, const uint8_t *reply_head, uint8_t out[32])
{
    teds_source source = {0};
    uint8_t teds[32];
    if (!teds_find(node, TEDS_SECURITY_ID, &source) || teds_source_hash(node, &source, teds) != 0) {
        return -TEDS_FAILURE;
    }
    /* reply_head: nonceN, epoch, En as they stand in the reply */
    const teds_part parts[] = {LABEL("TEDS1 transcript"), {request, REQUEST_OCTETS}, {reply_head, 85},
                               {node->uuid, 10},          {node->point, 65},         {teds, 32}};
    teds_sha256_parts(node, parts, sizeof parts / sizeof parts[0], out);
    return 0;
}

static int check_request(const teds_node *node, const uint8_t *payload)
{
    const uint8_t *station = payload, *signature = payload + 65, *ca = payload + 129, *one_time = payload + 194;
    const teds_part certified[] = {LABEL("TEDS1 station key"), {station, 65}};
    uint8_t hash[32];
    if (!teds_point_good(node, station) || !teds_point_good(node, ca) || !teds_point_good(node, one_time) ||
        memcmp(one_time, station, 65) == 0) {
        return -TEDS_BAD_POINT;
    }
    if (!teds_in_factory(node) && memcmp(ca, node->state.ca, 65) != 0) {
        return -TEDS_UNTRUSTED;
    }
    teds_sha256_parts(node, certified, 2, hash);
    if (!teds_verify(node, ca, hash, signature)) {
        return -TEDS_BAD_SIGNATURE;
    }
    return node->state.epoch == UINT32_MAX ? -TEDS_WRONG_EPOCH : 0;
}

/* What a checked Request makes: the reply's 165 octets, and what pends. */
static int answer(teds_node *node, const uint8_t *payload, teds_one_time *own, uint8_t *out)
{
    const teds_port *port = node->port;
    uint8_t z[64], script[32], hash[32];
    int failed = port->random(port->user, out, 16) != 0 || teds_one_time_take(node, own) != 0;
    if (!failed) {
        teds_put32(out + 16, node->state.epoch + 1);
        memcpy(out + 20, own->point, 65);
        failed = transcript(node, payload, out, script) != 0 ||
                 port->p256_ecdh(port->user, &own->key, payload + 194, z) != 0 ||
                 port->p256_ecdh(port->user, &own->key, payload, z + 32) != 0 ||
                 derive(node, z, out, script, out + 85) != 0;
    }
    if (!failed) {
        const teds_part agreed[] = {LABEL("TEDS1 agree"), {script, 32}};
        teds_sha256_parts(node, agreed, 2, hash);
        failed = teds_sign(node, hash, out + 101) != 0;
    }
    teds_wipe(z, sizeof z);
    return failed ? -TEDS_FAILURE : 165;
}

int teds_request(teds_node *node, const teds_command *command, const teds_origin *origin, uint8_t *out)
{
    const uint8_t *payload = command->payload;
    teds_one_time own = {0};
    int length;
    if (command->length != REQUEST_OCTETS) {
        return -TEDS_BAD_FORM;
    }
    length = check_request(node, payload);
    if (length < 0) {
        return length;
    }
    teds_pending_forget(node);
    length = answer(node, payload, &own, out);
    teds_one_time_wipe(node, &own);
    if (length < 0) {
        teds_pending_forget(node);
        return length;
    }
    node->pending.used = true;
    node->pending.link = origin->link;
    node->pending.session = origin->session;
    node->pending.at = teds_now(node);
    node->pending.epoch = node->state.epoch + 1;
    memcpy(node->pending.station, payload, 65);
    memcpy(node->pending.ca, payload + 129, 65);
    return length;
}

int teds_confirm(teds_node *node, const teds_command *command, teds_origin *origin)
{
    const teds_pending *pending = &node->pending;
    teds_state state;
    int failed;
    if (!pending->used || teds_now(node) >= pending->at + PENDING_NS || pending->link != origin->link ||
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
    if (teds_in_factory(node)) {
        memcpy(state.ca, pending->ca, 65);
    }
    state.flags |= TEDS_KEYED;
    state.epoch = pending->epoch;
    memcpy(state.key, pending->key, 16);
    memcpy(state.station, pending->station, 65);
#if TEDS_OPERATION
    teds_everything_safe(node);
#endif
    failed = teds_store_state(node, &state);
    teds_wipe(&state, sizeof state);
    if (failed) {
        return failed;
    }
    teds_pending_forget(node);
    origin->after = TEDS_AFTER_END_ALL;
    return 0;
}
