/* SPDX-License-Identifier: Apache-2.0 */
/* Begin and end of sessions. */
#ifndef TEDS_SRC_SESSION_LIFE_H
#define TEDS_SRC_SESSION_LIFE_H

#include "session.h"
#include "inside.h"

/* Decrypt a command. If it is the first message of a half-open Open, that becomes a session: in its link's place, a
 * free one, or that of the session without claims that was silent longest. taken->session is NULL if there is no room.
 * */
int teds_take_sealed(teds_node *node, teds_link link, const uint8_t *payload,
                     size_t length, uint8_t *plain, teds_taken *taken);

/* End a session and what it holds; does nothing for NULL or an unused one. */
void teds_session_end(teds_node *node, teds_session *session);

/* End all sessions, half-open Opens and a waiting Request: the node has another key, or none. */
void teds_sessions_end(teds_node *node);

/* End what has expired; return the time of the next action. */
uint64_t teds_sessions_poll(teds_node *node, uint64_t now);

#endif
