/* SPDX-License-Identifier: Apache-2.0 */
/* Stored replies (wire.md, "Repetition"), one per link: a command that is repeated because its reply was lost gets that
 * reply, and is not run twice. */
#include "replies.h"
#include "clock.h"
#include "commands.h"
#include "crypto.h"
#include "isotp.h"
#include "session.h"
#include "inside.h"

#define KEEP_NS (20u * TEDS_SECOND)

/* -- replies being sent -------------------------------------------------------------------------------------------- */

#if TEDS_BLE
/* A stored reply is sent in pieces, so its place must not be given to another link meanwhile. */
static bool is_sent_by_ble(const teds_node *node, const teds_stored_reply *reply)
{
    for (size_t i = 0; i < TEDS_BLE_CONNECTIONS; i++) {
        if (node->ble.lines[i].used && node->ble.lines[i].sends && node->ble.lines[i].reply == reply) {
            return true;
        }
    }
    return false;
}
#endif

static bool is_being_sent(const teds_node *node, const teds_stored_reply *reply)
{
    for (const teds_line *line = node->lines; line < node->lines + TEDS_CAN_LINES; line++) {
        if (line->out_state != TEDS_OUT_IDLE && line->out_reply == reply) {
            return true;
        }
    }
#if TEDS_NFC
    if (node->nfc.answered && node->nfc.reply == reply) {
        return true;
    }
#endif
#if TEDS_BLE
    return is_sent_by_ble(node, reply);
#else
    return false;
#endif
}

/* Broadcast answers do not count: any stranger could keep one waiting. */
bool teds_replies_wait(const teds_node *node, uint64_t now)
{
    bool waits = false;
    for (const teds_line *line = node->lines; line < node->lines + TEDS_CAN_LINES; line++) {
        waits = waits || (line->out_state != TEDS_OUT_IDLE && line->out_reply != NULL);
    }
#if TEDS_NFC
    waits = waits || now < node->nfc.busy_until;
#else
    (void)now;
#endif
#if TEDS_BLE
    for (const teds_stored_reply *each = node->replies; each < node->replies + TEDS_REPLIES; each++) {
        waits = waits || is_sent_by_ble(node, each);
    }
#endif
    return waits;
}

/* -- places -------------------------------------------------------------------------------------------------------- */

/* Find the place for a link's reply: its own, a free one, or the oldest of a link without a session, preferably one
 * that is not being sent. NULL: all places belong to sessions, in a build with no more places than sessions. */
static teds_stored_reply *find_place(teds_node *node, teds_link link)
{
    enum { FREE, TAKEN, SENT, NONE } best = NONE;
    teds_stored_reply *found = node->replies;
    for (teds_stored_reply *each = node->replies; each < node->replies + TEDS_REPLIES; each++) {
        if (each->used && each->link == link) {
            return each;
        }
    }
    for (teds_stored_reply *each = node->replies; each < node->replies + TEDS_REPLIES; each++) {
        const unsigned rank = !each->used ? FREE : is_being_sent(node, each) ? SENT : TAKEN;
        if (each->used && teds_session_on(node, each->link) != NULL) {
            continue;
        }
        if (rank < best || (rank == best && each->at < found->at)) {
            found = each;
            best = rank;
        }
    }
    if (TEDS_PLACES_MAY_LACK && best == NONE) {
        return NULL;
    }
    for (teds_line *line = node->lines; line < node->lines + TEDS_CAN_LINES; line++) {
        if (line->out_reply == found) {
            line->out_state = TEDS_OUT_IDLE;
            line->out_reply = NULL; /* the place belongs to another link from now on */
        }
    }
#if TEDS_NFC
    node->nfc.answered = node->nfc.answered && node->nfc.reply != found;
#endif
#if TEDS_BLE
    for (size_t i = 0; i < TEDS_BLE_CONNECTIONS; i++) {
        node->ble.lines[i].sends = node->ble.lines[i].sends && node->ble.lines[i].reply != found;
    }
#endif
    found->used = true;
    found->stored = false;
    found->link = link;
    return found;
}

/* Identify, Prove, About, List, Query and Read outside Sealed are run each time. */
static bool always_runs(const uint8_t *frame, size_t length)
{
    if (length < 4) {
        return false;
    }
    if (frame[2] == TEDS_CLASS_COMMON) {
        return frame[3] == TEDS_QUERY || frame[3] == TEDS_READ;
    }
    return frame[2] == TEDS_CLASS_SECURITY &&
           (frame[3] == TEDS_IDENTIFY || frame[3] == TEDS_PROVE || frame[3] == TEDS_LIST || frame[3] == TEDS_ABOUT);
}

teds_stored_reply *teds_answer(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *transaction,
                               size_t transaction_length, const uint8_t *frame, size_t length)
{
    const teds_part parts[] = {{transaction, transaction_length}, {frame, length < TEDS_MAX_MESSAGE ? length : TEDS_MAX_MESSAGE}};
    teds_stored_reply *place = find_place(node, link);
    uint8_t digest[32];
    if (TEDS_PLACES_MAY_LACK && place == NULL) {
        return NULL;
    }
    teds_sha256_parts(node, parts, 2, digest);
    if (!place->stored || memcmp(digest, place->digest, 32) != 0 || teds_now(node) >= place->at + KEEP_NS ||
        always_runs(frame, length)) {
        place->stored = false;
        place->length = (uint16_t)(1 + teds_node_handle(node, link, arrival, frame, length, place->octets + 1));
        memcpy(place->digest, digest, 32);
        place->used = true; /* the command may have ended its own link */
        place->stored = length <= TEDS_MAX_MESSAGE;
        place->link = link;
        place->at = teds_now(node);
    }
    return place;
}
