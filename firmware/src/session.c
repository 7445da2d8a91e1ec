/* SPDX-License-Identifier: Apache-2.0 */
/* Sessions (security-teds.md, 4): their table, Open and its keys, and sealing. Sessions and half-open Opens have
 * separate tables, so that neither a plain command nor a stranger's Open ends a session. session_life.c decides when
 * sessions begin and end. */
#include "session.h"
#include "clock.h"
#include "crypto.h"
#include "inside.h"

#define HALF_OPEN_NS (60u * TEDS_SECOND)

/* -- the tables ---------------------------------------------------------------------------------------------------- */

teds_session *teds_session_on(teds_node *node, teds_link link)
{
    for (teds_session *each = node->sessions; each < node->sessions + TEDS_SESSIONS; each++) {
        if (each->used && each->link == link) {
            return each;
        }
    }
    return NULL;
}

teds_half_open *teds_half_open_on(teds_node *node, teds_link link)
{
    for (size_t i = 0; i < TEDS_SESSIONS; i++) {
        if (node->half_open[i].used && node->half_open[i].link == link) {
            return &node->half_open[i];
        }
    }
    return NULL;
}

bool teds_any_on(teds_node *node, teds_link link)
{
    return teds_session_on(node, link) != NULL || teds_half_open_on(node, link) != NULL;
}

#if TEDS_OPERATION
/* Key of a run: HKDF-Expand(k_m, label, run, 16); the label ends in 00. */
int teds_run_key(const teds_node *node, const teds_session *session, const char *label, size_t length, uint8_t out[16])
{
    uint8_t run[2];
    const teds_part info[] = {{(const uint8_t *)label, length}, {run, 2}};
    teds_put16(run, session->run);
    return teds_hkdf_expand(node, session->keys.messages, info, 2, out, 16);
}
#endif

/* -- Open ---------------------------------------------------------------------------------------------------------- */

static void keep_half_open(teds_node *node, teds_link link, const teds_keys *keys)
{
    teds_half_open *place = teds_half_open_on(node, link);
    if (place == NULL) { /* a free place has time 0; if there is none, the oldest is dropped */
        place = &node->half_open[0];
        for (size_t i = 1; i < TEDS_SESSIONS; i++) {
            if (node->half_open[i].until < place->until) {
                place = &node->half_open[i];
            }
        }
    }
    place->used = true;
    place->link = link;
    place->until = teds_now(node) + HALF_OPEN_NS;
    place->keys = *keys;
}

/* Keys of the session and the node's tag, from Es, the node's one-time key and K. */
static int derive_keys(const teds_node *node, const uint8_t es[65], const uint8_t key_id[8], teds_keys *keys,
                       uint8_t tag[16])
{
    const teds_port *port = node->port;
    const teds_one_time *own = &node->one_time;
    uint8_t z[32], okm[96];
    const teds_part parts[] = {
        {z, 32}, LABEL("TEDS1 session"), {node->identity.uuid, 10}, {es, 65}, {own->point, 65}};
    const teds_part tagged[] = {MAC_LABEL("node open"), {key_id, 8}, {es, 65}, {own->point, 65}};
    const int failed = port->p256_ecdh(port->user, &own->key, es, z) != 0 ||
                       teds_hkdf(node, node->state.agreed.key, parts, 5, okm, 96) != 0 ||
                       teds_mac(node, okm + 32, 32, tagged, 4, tag) != 0;
    if (!failed) {
        memcpy(keys->to_node, okm, 16);
        memcpy(keys->to_station, okm + 16, 16);
        memcpy(keys->messages, okm + 64, 32);
    }
    teds_wipe(z, sizeof z);
    teds_wipe(okm, sizeof okm);
    return failed;
}

/* Check keyId and mac before the point: strangers cause no point arithmetic, and each Open works only once. */
static int check_open(teds_node *node, const uint8_t *payload)
{
    const uint8_t *es = payload + 8;
    uint8_t counter[8], key_id[32], mac[16];
    const teds_part named[] = {LABEL("TEDS1 key id"), {node->state.agreed.key, 16}};
    const teds_part parts[] = {MAC_LABEL("station open"), {node->identity.uuid, 10}, {counter, 8}, {es, 65}};
    teds_sha256_parts(node, named, 2, key_id); /* its first 8 octets */
    if (!teds_equal(payload, key_id, 8)) {
        return -TEDS_UNKNOWN_KEY;
    }
    teds_put64(counter, node->opens);
    if (teds_mac(node, node->state.agreed.key, 16, parts, 4, mac) != 0) {
        return -TEDS_FAILURE;
    }
    if (!teds_equal(payload + 73, mac, 16)) {
        return -TEDS_BAD_TAG;
    }
    node->opens++;
    return teds_point_good(node, es) && memcmp(es, node->state.agreed.station, 65) != 0 ? 0 : -TEDS_BAD_POINT;
}

int teds_open(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const uint8_t *payload = command->payload;
    teds_keys keys;
    int failed;
    if (command->length == 0) {
        teds_put64(out, node->opens);
        return 8;
    }
    if (command->length != TEDS_OPEN_OCTETS) {
        return -TEDS_BAD_FORM;
    }
    failed = check_open(node, payload);
    if (failed) {
        return failed;
    }
    failed = teds_one_time_make(node) != 0;
    if (!failed) {
        memcpy(out, node->one_time.point, 65);
        failed = derive_keys(node, payload + 8, payload, &keys, out + 65);
    }
    if (!failed) {
        keep_half_open(node, origin->link, &keys);
    }
    teds_wipe(&keys, sizeof keys);
    teds_one_time_drop(node);
    return failed ? -TEDS_FAILURE : 81;
}

/* -- Sealed -------------------------------------------------------------------------------------------------------- */

/* Octets of the inner frame, without the padding of RFC 5652 6.3; -1 if the padding is wrong. */
static int strip_padding(const uint8_t *plain, size_t length)
{
    uint8_t count = length > 0 ? plain[length - 1] : 0;
    uint8_t wrong = (uint8_t)(count == 0 || count > 16 || length % 16 != 0);
    for (size_t i = 0; i < 16 && i < length; i++) {
        wrong |= (uint8_t)((i < count) & (plain[length - 1 - i] != count));
    }
    return wrong ? -1 : (int)(length - count);
}

static int open_with(const teds_node *node, const teds_keys *keys, const uint8_t *payload, size_t length, uint8_t *plain)
{
    uint8_t nonce[13] = {0};
    memcpy(nonce + 9, payload, 4);
    if (!node->port->ccm_open(node->port->user, keys->to_node, nonce, payload + 4, length - 20, plain, 16)) {
        return -1;
    }
    return strip_padding(plain, length - 20);
}

int teds_unseal(teds_node *node, teds_link link, const uint8_t *payload, size_t length, uint8_t *plain,
                teds_taken *taken)
{
    teds_session *session = teds_session_on(node, link);
    teds_half_open *half = teds_half_open_on(node, link);
    const teds_keys *keys = NULL;
    uint32_t last = 0;
    int inner = -1;
    if (length < 36) {
        return -TEDS_BAD_FORM;
    }
    if (session != NULL) {
        keys = &session->keys;
        last = session->counter;
        inner = open_with(node, keys, payload, length, plain);
    }
    if (inner >= 0) {
        half = NULL;
    } else if (half != NULL) {
        keys = &half->keys;
        last = 0;
        inner = open_with(node, keys, payload, length, plain);
    }
    if (inner < 0 || keys == NULL) {
        return -TEDS_BAD_TAG;
    }
    taken->counter = teds_get32(payload);
    if (taken->counter <= last) {
        return -TEDS_REPLAY;
    }
    taken->length = (size_t)inner;
    memcpy(taken->to_station, keys->to_station, 16);
    taken->session = session;
    taken->half = half;
    return 0;
}

int teds_seal_reply(const teds_node *node, const uint8_t key[16], uint32_t counter, uint8_t *payload, size_t inner,
                    size_t *length)
{
    uint8_t nonce[13] = {0};
    size_t count = 16 - inner % 16;
    memset(payload + 4 + inner, (int)count, count);
    teds_put32(payload, counter);
    teds_put32(nonce + 9, counter);
    *length = 4 + inner + count + 16;
    return node->port->ccm_seal(node->port->user, key, nonce, payload + 4, inner + count, payload + 4, 16);
}
