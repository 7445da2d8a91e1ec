/* SPDX-License-Identifier: Apache-2.0 */
/* Request, Confirm; hashes, keys and signatures. */
#ifndef TEDS_SRC_AGREE_H
#define TEDS_SRC_AGREE_H

#include "inside.h"

void teds_sha256_parts(const teds_node *node, const teds_part *parts, size_t count, uint8_t out[32]);
int teds_hkdf_expand(const teds_node *node, const uint8_t prk[32], const teds_part *info, size_t count, uint8_t *out,
                     size_t length);
/* The first of the parts is the key material, the others are the info. */
int teds_hkdf(const teds_node *node, const uint8_t salt[16], const teds_part *parts, size_t count, uint8_t *out,
              size_t length);
/* The first 16 octets of an HMAC. */
int teds_mac(const teds_node *node, const uint8_t *key, size_t key_length, const teds_part *parts, size_t count,
             uint8_t out[16]);
bool teds_point_good(const teds_node *node, const uint8_t point[65]);
/* Signatures are over the SHA-256 of the parts one after another. */
bool teds_verify(const teds_node *node, const uint8_t point[65], const teds_part *parts, size_t count,
                 const uint8_t signature[64]);
/* Whether this CA vouches for that station. */
bool teds_certified(const teds_node *node, const uint8_t station[65], const uint8_t ca[65],
                    const uint8_t signature[64]);
int teds_sign(const teds_node *node, const teds_part *parts, size_t count, uint8_t out[64]);
/* The one-time key of the next Request or Open, where it was not made ahead; dropped after its one use. */
int teds_one_time_make(teds_node *node);
void teds_one_time_drop(teds_node *node);
teds_handler teds_request, teds_confirm;
/* T; and Z, from it link key, node's tag and station's tag. Functions of their own, so that what they need is gone from
 * the stack when the reply is signed, which takes most of it. */
int teds_transcript(teds_node *node, const uint8_t *request, const uint8_t *reply_head, uint8_t out[32]);
int teds_agree(teds_node *node, const uint8_t *payload, const uint8_t nonce[16], const uint8_t script[32],
               uint8_t node_tag[16]);
void teds_pending_forget(teds_node *node);

#endif
