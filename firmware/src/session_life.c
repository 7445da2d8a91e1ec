/* SPDX-License-Identifier: Apache-2.0 */
/* Begin and end of sessions, and what ends with them: claims and streams, staging, an upload, a Request that waits for
 * its Confirm. */
#include "session_life.h"
#include "agree.h"
#include "clock.h"
#include "manage.h"
#include "operation.h"
#include "session.h"
#include "staging.h"
#include "inside.h"

#define IDLE_NS (600u * TEDS_SECOND)

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

void teds_sessions_end(teds_node *node)
{
    for (teds_session *each = node->sessions; each < node->sessions + TEDS_SESSIONS; each++) {
        teds_session_end(node, each);
    }
    teds_wipe(node->half_open, sizeof node->half_open);
    teds_pending_forget(node);
}

/* True if the time has come; otherwise lower `due` to it. */
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
            /* first, so that a dead-man that already stopped an actuator is reported; the end of a session is not */
            (void)teds_operation_poll(node, now);
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

/* The place of a new session: its link's own, a free one, or that of the session without claims that was silent
 * longest; NULL if all have claims. */
static teds_session *make_session_room(teds_node *node, teds_link link)
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

/* Begin the session of a half-open Open at its first good message; NULL if there is no room. */
static teds_session *begin_session(teds_node *node, teds_link link, teds_half_open *half)
{
    teds_session *session = make_session_room(node, link);
    if (session != NULL) {
        teds_session_end(node, session);
        session->used = true;
        session->link = link;
        session->keys = half->keys;
    }
    teds_wipe(half, sizeof *half);
    return session;
}

int teds_take_sealed(teds_node *node, teds_link link, const uint8_t *payload,
                     size_t length, uint8_t *plain, teds_taken *taken)
{
    const int refused = teds_unseal(node, link, payload, length, plain, taken);
    if (refused) {
        return refused;
    }
    if (taken->half != NULL) {
        taken->session = begin_session(node, link, taken->half);
    }
    if (taken->session != NULL) {
        taken->session->counter = taken->counter;
        taken->session->good_at = teds_now(node);
    }
    return 0;
}
