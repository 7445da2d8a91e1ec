/* SPDX-License-Identifier: Apache-2.0 */
/* Hashes, keys and signatures of the profile, from the port's primitives. A part is octets and their number; functions
 * that take parts process them in order. int: 0, or the port failed. */
#ifndef TEDS_SRC_CRYPTO_H
#define TEDS_SRC_CRYPTO_H

#include "inside.h"

/* A part from a text: HKDF infos and signatures end their label in 00, MACs do not (profile.md). */
#define LABEL(text) {(const uint8_t *)(text), sizeof(text)}
#define MAC_LABEL(text) {(const uint8_t *)(text), sizeof(text) - 1u}

void teds_sha256_parts(const teds_node *node, const teds_part *parts, size_t count, uint8_t out[32]);

/* HKDF-Expand (RFC 5869) with at most 6 parts of info. */
int teds_hkdf_expand(const teds_node *node, const uint8_t prk[32], const teds_part *info, size_t count, uint8_t *out,
                     size_t length);

/* HKDF. The first of the parts is the key material, the others are the info. */
int teds_hkdf(const teds_node *node, const uint8_t salt[16], const teds_part *parts, size_t count, uint8_t *out,
              size_t length);

/* The first 16 octets of an HMAC. */
int teds_mac(const teds_node *node, const uint8_t *key, size_t key_length, const teds_part *parts, size_t count,
             uint8_t out[16]);

/* True for a point of P-256 other than the node's own: no station may use the node's own key. */
bool teds_point_good(const teds_node *node, const uint8_t point[65]);

/* Signatures are over the SHA-256 of the parts, with s in the lower half of the order, so that each has only one form.
 * */
bool teds_verify(const teds_node *node, const uint8_t point[65], const teds_part *parts, size_t count,
                 const uint8_t signature[64]);

/* True if this CA vouches for that station. */
bool teds_station_certified(const teds_node *node, const uint8_t station[65], const uint8_t ca[65],
                            const uint8_t signature[64]);

/* Sign with the identity key. */
int teds_sign(const teds_node *node, const teds_part *parts, size_t count, uint8_t out[64]);

/* Make the one-time key of the next Request or Open, unless teds_idle_work made it ahead. */
int teds_one_time_make(teds_node *node);

/* Wipe the one-time key: after its one use, whatever the result. */
void teds_one_time_drop(teds_node *node);

#endif
