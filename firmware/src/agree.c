/* SPDX-License-Identifier: Apache-2.0 */
/* Key agreement (security-teds.md, 3): Request, which a station signs and the node answers, and Confirm, which makes the
 * new key count. Z, OKM and both one-time keys are wiped after use. */
#include "agree.h"
#include "clock.h"
#include "crypto.h"
#include "datasheet.h"
#include "operation.h"
#include "slots.h"
#include "inside.h"

#define PENDING_NS (60u * TEDS_SECOND)
#define REQUEST_OCTETS 259u

void teds_pending_forget(teds_node *node)
{
    teds_wipe(&node->pending, sizeof node->pending);
}

int teds_agree_keys(teds_node *node, const uint8_t *payload, const uint8_t nonce[16], const uint8_t script[32],
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

int teds_hash_transcript(teds_node *node, const uint8_t *request, const uint8_t *reply_head, uint8_t out[32])
{
    teds_source source;
    uint8_t teds[32];
    if (!teds_find(node, TEDS_SECURITY_ID, &source) || teds_source_hash(node, &source, teds) != 0) {
        return -TEDS_FAILURE;
    }
    /* reply_head: nonceN, epoch and En, as in the reply. */
    const teds_part parts[] = {LABEL("TEDS1 transcript"), {request, REQUEST_OCTETS}, {reply_head, 85},
                               {node->identity.uuid, 10},          {node->identity.point, 65},         {teds, 32}};
    teds_sha256_parts(node, parts, sizeof parts / sizeof parts[0], out);
    return 0;
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
    if (!teds_station_certified(node, station, ca, signature)) {
        return -TEDS_BAD_SIGNATURE;
    }
    return node->state.epoch == UINT32_MAX ? -TEDS_WRONG_EPOCH : 0;
}

/* Answer a checked Request: the reply's 165 octets, and the pending agreement. */
static int answer_request(teds_node *node, const uint8_t *payload, uint8_t *out)
{
    const teds_port *port = node->port;
    uint8_t script[32];
    int failed = port->random(port->user, out, 16) != 0 || teds_one_time_make(node) != 0;
    if (!failed) {
        teds_put32(out + 16, node->state.epoch + 1);
        memcpy(out + 20, node->one_time.point, 65);
        failed = teds_hash_transcript(node, payload, out, script) != 0 ||
                 teds_agree_keys(node, payload, out, script, out + 85) != 0;
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
    length = answer_request(node, payload, out);
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
    state.agreed = pending->agreed; /* outside factory state, Request has checked that the CA stays the same */
#if TEDS_OPERATION
    teds_make_all_safe(node);
#endif
    failed = teds_slots_write(node, &state, NULL);
    teds_wipe(&state, sizeof state);
    if (failed) {
        return failed;
    }
    teds_pending_forget(node);
    origin->after = TEDS_AFTER_END_ALL;
    return 0;
}
