/* SPDX-License-Identifier: Apache-2.0 */
/* Key agreement: 128.1 Request and 128.2 Confirm. Between them, node->pending holds the agreement. */
#ifndef TEDS_SRC_AGREE_H
#define TEDS_SRC_AGREE_H

#include "inside.h"

teds_handler teds_request, teds_confirm;

/* Forget a Request that waits for its Confirm, and wipe its key. */
void teds_pending_forget(teds_node *node);

/* The transcript T; and Z, from which the link key, the node's tag and the station's tag are derived. Separate
 * functions, so that their data are off the stack when the reply is signed, which needs most of it. */
int teds_hash_transcript(teds_node *node, const uint8_t *request, const uint8_t *reply_head, uint8_t out[32]);
int teds_agree_keys(teds_node *node, const uint8_t *payload, const uint8_t nonce[16], const uint8_t script[32],
                    uint8_t node_tag[16]);

#endif
