/* SPDX-License-Identifier: Apache-2.0 */
/* Open, Sealed, and the lives of sessions. */
#ifndef TEDS_SRC_SESSION_H
#define TEDS_SRC_SESSION_H

#include "inside.h"

teds_handler teds_open;
teds_session *teds_session_on(teds_node *node, teds_link link);
bool teds_any_on(teds_node *node, teds_link link);
/* Ends what is over; when the next of them is. */
uint64_t teds_sessions_poll(teds_node *node, uint64_t now);
typedef struct teds_taken {
    teds_session *session; /* NULL: there was no room for it */
    uint32_t counter;
    uint8_t to_station[16];
    size_t length; /* of the inner frame */
} teds_taken;
int teds_take_sealed(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *payload,
                     size_t length, uint8_t *plain, teds_taken *taken);
int teds_seal_reply(const teds_node *node, const uint8_t key[16], uint32_t counter, uint8_t *payload, size_t inner,
                    size_t *length);
void teds_session_end(teds_node *node, teds_session *session);
void teds_end_everything(teds_node *node);
/* Loss of a link, but for the move that 128.10 may have left. */
void teds_link_forget(teds_node *node, teds_link link);

#endif
