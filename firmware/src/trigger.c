/* SPDX-License-Identifier: Apache-2.0 */
/* Arm and the trigger (operation.md, 5): a session stores the digest of a token; a frame with the token on the bus then
 * marks the time, starts waiting streams or stops actuators. */
#include "trigger.h"
#include "clock.h"
#include "crypto.h"
#include "operation.h"
#include "session.h"
#include "stream.h"
#include "inside.h"

#if TEDS_OPERATION

int teds_arm(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const uint8_t *payload = command->payload;
    teds_session *session = origin->session;
    (void)out;
    if (payload[16] > 60 || payload[17] > 2) {
        return -TEDS_OUT_OF_RANGE;
    }
    if (origin->arrival->kind != TEDS_CAN) {
        return -TEDS_DOES_NOT_FIT;
    }
    session->arms[payload[17]].armed = payload[16] != 0;
    session->arms[payload[17]].until = teds_now(node) + payload[16] * TEDS_SECOND;
    memcpy(session->arms[payload[17]].commitment, payload, 16);
    return 0;
}

static void act_on_trigger(teds_node *node, teds_session *session, size_t action, uint64_t tick)
{
    uint32_t acting = 0;
    session->mark = tick;
    if (action == 1) {
        teds_streams_start(node, session, tick);
    } else if (action == 2) {
        for (size_t i = 0; i < node->port->channel_count; i++) {
            acting |= node->port->channels[i].kind == TEDS_ACTUATOR ? UINT32_C(1) << i : 0;
        }
        teds_claims_end(node, session, acting, true);
    }
}

void teds_trigger(teds_node *node, teds_link link, const uint8_t *token, uint64_t tick)
{
    const teds_part parts[] = {{(const uint8_t *)"TEDS1 trigger", 14}, {token, 8}};
    teds_session *session = teds_session_on(node, link);
    uint64_t now = teds_now(node);
    uint8_t seen[32];
    if (session == NULL) {
        return;
    }
    teds_sha256_parts(node, parts, 2, seen);
    for (size_t i = 0; i < 3; i++) {
        if (session->arms[i].armed && now >= session->arms[i].until) {
            session->arms[i].armed = false;
        }
        if (session->arms[i].armed &&
            teds_equal(seen, session->arms[i].commitment, 16)) {
            session->arms[i].armed = false;
            act_on_trigger(node, session, i, tick);
        }
    }
}

#else
typedef int teds_trigger_is_left_out;
#endif
