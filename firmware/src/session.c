/* SPDX-License-Identifier: Apache-2.0 */
/* Sessions (security-teds.md, 4): Open, Sealed, their lives and ends. Sessions and half-open Opens are tables apart, so
 * that nobody's plain question, and nobody's Open, ends a session. */
#include "session.h"
#include "agree.h"
#include "clock.h"
#include "manage.h"
#include "operation.h"
#include "teds_store.h"
#include "inside.h"

#define HALF_OPEN_NS (60u * TEDS_SECOND)
#define IDLE_NS (600u * TEDS_SECOND)
#define LABEL(text) {(const uint8_t *)(text), sizeof(text)}
#define MAC_LABEL(text) {(const uint8_t *)(text), sizeof(text) - 1u}

teds_session *teds_session_on(teds_node *node, teds_link link)
{
    for (teds_session *each = node->sessions; each < node->sessions + TEDS_SESSIONS; each++) {
        if (each->used && each->link == link) {
            return each;
        }
    }
    return NULL;
}

static teds_half_open *half_open_on(teds_node *node, teds_link link)
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
    return teds_session_on(node, link) != NULL || half_open_on(node, link) != NULL;
}

void teds_session_end(teds_node *node, teds_session *session)
{
    if (session == NULL || !session->used) {
        return;
    }
#if TEDS_OPERATION
    teds_claims_end(node, session, UINT32_MAX, false);
#endif
    if (node->staging_of == session) {
        teds_staging_drop(node);
    }
#if TEDS_MANAGED
    teds_upload_end(node, session);
#endif
    if (node->pending.used && node->pending.session == session) {
        teds_pending_forget(node);
    }
    teds_wipe(session, sizeof *session);
}

void teds_link_forget(teds_node *node, teds_link link)
{
    teds_half_open *half = half_open_on(node, link);
    teds_session_end(node, teds_session_on(node, link));
    if (half != NULL) {
        teds_wipe(half, sizeof *half);
    }
    for (teds_stored_reply *each = node->replies; each < node->replies + TEDS_REPLIES; each++) {
        if (each->link == link) {
            each->used = false;
        }
    }
    if (node->pending.link == link) {
        teds_pending_forget(node);
    }
}

void teds_end_everything(teds_node *node)
{
    for (teds_session *each = node->sessions; each < node->sessions + TEDS_SESSIONS; each++) {
        teds_session_end(node, each);
    }
    teds_wipe(node->half_open, sizeof node->half_open);
    teds_pending_forget(node);
}

/* Whether that time has come; if not, something is due then. */
static bool is_over(uint64_t at, uint64_t now, uint64_t *due)
{
    if (now >= at) {
        return true;
    }
    teds_sooner(due, at);
    return false;
}

uint64_t teds_sessions_poll(teds_node *node, uint64_t now)
{
    uint64_t due = TEDS_NEVER;
    for (size_t i = 0; i < TEDS_SESSIONS; i++) {
        teds_session *session = &node->sessions[i];
        teds_half_open *half = &node->half_open[i];
        if (session->used && is_over(session->good_at + IDLE_NS, now, &due)) {
#if TEDS_OPERATION
            (void)teds_operation_poll(node, now); /* a dead-man that stopped an actuator before is told, this end is not */
#endif
            teds_session_end(node, session);
        }
        if (half->used && is_over(half->until, now, &due)) {
            teds_wipe(half, sizeof *half);
        }
    }
    if (node->pending.used && is_over(node->pending.until, now, &due)) {
        teds_pending_forget(node);
    }
    return due;
}

static void keep_half_open(teds_node *node, teds_link link, const teds_keys *keys)
{
    teds_half_open *place = half_open_on(node, link);
    if (place == NULL) { /* a free one, whose time is 0; beyond its room the oldest goes */
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
static int derive(const teds_node *node, const uint8_t es[65], const uint8_t key_id[8], teds_keys *keys,
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

/* keyId and mac before the point: a stranger costs no point arithmetic, and each Open is good once. */
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
        failed = derive(node, payload + 8, payload, &keys, out + 65);
    }
    if (!failed) {
        keep_half_open(node, origin->link, &keys);
    }
    teds_wipe(&keys, sizeof keys);
    teds_one_time_drop(node);
    return failed ? -TEDS_FAILURE : 81;
}

/* A place for the session that a half-open Open becomes: its link's own, a free one, that of the session without a
 * claim which was silent longest; NULL where all have claims. */
static teds_session *make_room(teds_node *node, teds_link link)
{
    teds_session *place = teds_session_on(node, link);
    if (place != NULL) {
        return place;
    }
    for (teds_session *each = node->sessions; each < node->sessions + TEDS_SESSIONS; each++) {
        if (!each->used) {
            return each;
        }
#if TEDS_OPERATION
        if (each->claims != 0) {
            continue;
        }
#endif
        if (place == NULL || each->good_at < place->good_at) {
            place = each;
        }
    }
    return place;
}

/* Octets of the inner frame behind the padding of RFC 5652 6.3; -1 where the padding is wrong. */
static int unpadded(const uint8_t *plain, size_t length)
{
    uint8_t count = length > 0 ? plain[length - 1] : 0;
    uint8_t wrong = (uint8_t)(count == 0 || count > 16 || length % 16 != 0);
    for (size_t i = 0; i < 16 && i < length; i++) {
        wrong |= (uint8_t)((i < count) & (plain[length - 1 - i] != count));
    }
    return wrong ? -1 : (int)(length - count);
}

static int unseal(const teds_node *node, const teds_keys *keys, const uint8_t *payload, size_t length, uint8_t *plain)
{
    uint8_t nonce[13] = {0};
    memcpy(nonce + 9, payload, 4);
    if (!node->port->ccm_open(node->port->user, keys->to_node, nonce, payload + 4, length - 20, plain, 16)) {
        return -1;
    }
    return unpadded(plain, length - 20);
}

int teds_take_sealed(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *payload,
                     size_t length, uint8_t *plain, teds_taken *taken)
{
    teds_session *session = teds_session_on(node, link);
    teds_half_open *half = half_open_on(node, link);
    const teds_keys *keys = NULL;
    uint32_t last = 0;
    int inner = -1;
    if (length < 36) {
        return -TEDS_BAD_FORM;
    }
    if (session != NULL) {
        keys = &session->keys;
        last = session->counter;
        inner = unseal(node, keys, payload, length, plain);
    }
    if (inner >= 0) {
        half = NULL;
    } else if (half != NULL) {
        keys = &half->keys;
        last = 0;
        inner = unseal(node, keys, payload, length, plain);
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
    if (half != NULL) {
        session = make_room(node, link);
        if (session != NULL) {
            teds_session_end(node, session);
            session->used = true;
            session->link = link;
            session->kind = arrival->kind;
            session->keys = half->keys;
        }
        teds_wipe(half, sizeof *half);
    }
    taken->session = session;
    if (session != NULL) {
        session->counter = taken->counter;
        session->good_at = teds_now(node);
    }
    return 0;
}

/* `payload` has room for counter, padding and tag around `inner` octets that stand at payload + 4. */
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
