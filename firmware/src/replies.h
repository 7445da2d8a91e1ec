/* SPDX-License-Identifier: Apache-2.0 */
/* Stored replies: a repeated command gets its reply again. */
#ifndef TEDS_SRC_REPLIES_H
#define TEDS_SRC_REPLIES_H

#include "inside.h"

/* True if there are as many places for stored replies as sessions; in other builds the compiler removes this check. */
#define TEDS_PLACES_MAY_LACK (TEDS_REPLIES == TEDS_SESSIONS)

/* Run a request, or find the stored reply of an identical one. Returns the reply's place, whose octets begin at 1;
 * NULL: there is no place and nothing was run (never if there are more places than sessions). */
teds_stored_reply *teds_answer(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *transaction,
                               size_t transaction_length, const uint8_t *frame, size_t length);

/* True while a reply is being sent, or a reader may still fetch one: flash is not erased then, because that takes long.
 * */
bool teds_replies_wait(const teds_node *node, uint64_t now);

#endif
