/* SPDX-License-Identifier: Apache-2.0 */
/* When sessions begin and end. */
#ifndef TEDS_SRC_SESSION_LIFE_H
#define TEDS_SRC_SESSION_LIFE_H

#include "session.h"
#include "inside.h"

/* Unseal a command. A half-open Open whose first message it is becomes a session: in its link's place, a free one, or that
 * of the session without claims that was silent longest. taken->session is NULL if there is no room. */
int teds_take_sealed(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *payload,
                     size_t length, uint8_t *plain, teds_taken *taken);

/* End a session and what it holds; NULL and one that is not used: nothing happens. */
void teds_session_end(teds_node *node, teds_session *session);

/* End all sessions, half-open Opens and a Request that waits: the node has another key, or none. */
void teds_sessions_end(teds_node *node);

/* End what is over; return when the next of them is. */
uint64_t teds_sessions_poll(teds_node *node, uint64_t now);

#endif
