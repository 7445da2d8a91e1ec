/* SPDX-License-Identifier: Apache-2.0 */
/** @file
 * Cryptography by BearSSL: no heap, constant time. Private keys are scalars in software.
 */
#ifndef TEDS_BEARSSL_H
#define TEDS_BEARSSL_H

#include "teds/port.h"

#ifdef __cplusplus
extern "C" {
#endif

/** What these functions find through the port's `user`: make it the first member of the structure that `user` points to.
 * teds_bearssl_fill checks that. */
typedef struct teds_bearssl {
    /** Source of new keys, usually the function that is `random` of the port. */
    int (*random)(void *user, uint8_t *out, size_t length);
} teds_bearssl;

/** Fill in the cryptography of a port. Set `port->user` and `context->random` first: `user` points to `context` or to a
 * structure that begins with it. Return 0, or -1 if that is not so: nothing is filled in then, and teds_node_init refuses
 * the port with #TEDS_E_USAGE. */
int teds_bearssl_fill(teds_port *port, const teds_bearssl *context);

#ifdef __cplusplus
}
#endif

#endif
