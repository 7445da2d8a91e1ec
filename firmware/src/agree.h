/* SPDX-License-Identifier: Apache-2.0 */
/* Key agreement: 128.1 Request and 128.2 Confirm. Between the two, node->pending holds what was agreed. */
#ifndef TEDS_SRC_AGREE_H
#define TEDS_SRC_AGREE_H

#include "inside.h"

teds_handler teds_request, teds_confirm;

/* Forget a Request that waits for its Confirm, and wipe its key. */
void teds_pending_forget(teds_node *node);

/* The transcript T; and Z, from it link key, node's tag and station's tag. Functions of their own, so that what they need is
 * gone from the stack when the reply is signed, which takes most of it. */
int teds_hash_transcript(teds_node *node, const uint8_t *request, const uint8_t *reply_head, uint8_t out[32]);
int teds_agree_keys(teds_node *node, const uint8_t *payload, const uint8_t nonce[16], const uint8_t script[32],
                    uint8_t node_tag[16]);

#endif
