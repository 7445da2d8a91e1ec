/* SPDX-License-Identifier: Apache-2.0 */
/* Stored replies: a command that is repeated gets the reply that it got. */
#ifndef TEDS_SRC_REPLIES_H
#define TEDS_SRC_REPLIES_H

#include "inside.h"

/* As many places of stored replies as sessions: the compiler leaves the question out of every other build. */
#define TEDS_PLACES_MAY_LACK (TEDS_REPLIES == TEDS_SESSIONS)

/* Run a request, or take up the stored reply of an octet-equal one: the reply's place, octets from 1 on; NULL: there is
 * none, nothing was run (never if there are more places than sessions). */
teds_stored_reply *teds_answer(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *transaction,
                               size_t transaction_length, const uint8_t *frame, size_t length);

/* True while a reply is being sent, or a reader may still come for one: then flash is not erased, which takes long. */
bool teds_replies_wait(const teds_node *node, uint64_t now);

#endif
