/* SPDX-License-Identifier: Apache-2.0 */
/* Sessions: their table and their keys. A link has at most one session and one half-open Open. */
#ifndef TEDS_SRC_SESSION_H
#define TEDS_SRC_SESSION_H

#include "inside.h"

/* 128.3: a good Open becomes half-open. */
teds_handler teds_open;

/* The session of a link; NULL: none. */
teds_session *teds_session_on(teds_node *node, teds_link link);

/* The half-open Open of a link; NULL: none. */
teds_half_open *teds_half_open_on(teds_node *node, teds_link link);

/* True if a sealed command of this link could be valid. */
bool teds_any_on(teds_node *node, teds_link link);

/* A command that was decrypted. */
typedef struct teds_taken {
    teds_session *session; /* whose key was good; NULL: that of `half`, or there is no room for a session */
    teds_half_open *half;  /* NULL: a session's key was good */
    uint32_t counter;
    uint8_t to_station[16];
    size_t length; /* of the inner frame */
} teds_taken;

/* Decrypt the payload of Sealed into `plain`, with the session's key or else the half-open one's; the tag is checked
 * before the counter. No session changes. 0, or a reason negated. */
int teds_unseal(teds_node *node, teds_link link, const uint8_t *payload, size_t length, uint8_t *plain,
                teds_taken *taken);

/* Seal the inner reply of `inner` octets at payload + 4 in place: `payload` has room for counter, padding and tag
 * around it. */
int teds_seal_reply(const teds_node *node, const uint8_t key[16], uint32_t counter, uint8_t *payload, size_t inner,
                    size_t *length);

#if TEDS_OPERATION
/* Key of a run of a stream or of Drive: HKDF-Expand(k_m, label, run, 16); the label ends in 00. */
int teds_run_key(const teds_node *node, const teds_session *session, const char *label, size_t length, uint8_t out[16]);
#endif

#endif
