/* SPDX-License-Identifier: Apache-2.0 */
/* Routing, permission and stored replies; the interface of boards is teds/node.h. */
#ifndef TEDS_SRC_NODE_H
#define TEDS_SRC_NODE_H

#include "inside.h"

teds_stored_reply *teds_reply_place(teds_node *node, teds_link link);
/* As many places of stored replies as sessions: the compiler leaves the question out of every other build. */
#define TEDS_PLACES_MAY_LACK (TEDS_REPLIES == TEDS_SESSIONS)
/* Run a request, or take up the stored reply of an octet-equal one: the reply's place, octets from 1 on; NULL: there is
 * none, nothing was run (never where there are more places than sessions). */
teds_stored_reply *teds_answer(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *transaction,
                               size_t transaction_length, const uint8_t *frame, size_t length);
/* As Identify and Announce tell it: 0 factory, 1 keyed, 2 provisioned. */
uint8_t teds_state_octet(const teds_node *node);

#endif
