/* SPDX-License-Identifier: Apache-2.0 */
/** @file
 * Cryptography by the PSA Crypto API (Mbed TLS 2.28 and later, TF-M): one key, one use.
 *
 * The signing key is persistent under #TEDS_PSA_KEY and never exported; one-time keys are volatile, and the node holds
 * their ids only. Randomness is PSA's. psa_crypto_init() is called here. The library allocates from its own heap. One
 * node in a process: PSA has one key of that id, and the port one note of its persistence.
 */
#ifndef TEDS_PSA_H
#define TEDS_PSA_H

#include "teds/port.h"

#ifdef __cplusplus
extern "C" {
#endif

#ifndef TEDS_PSA_KEY
/** PSA key id of the identity key, within PSA_KEY_ID_USER_MIN to _MAX. */
#define TEDS_PSA_KEY 0x14454453u
#endif

/** Fill in cryptography and randomness of a port; its `user` is free for the board. `persistent`: the identity key is
 * kept in PSA's storage; false: it is volatile, for tests of a node whose flash ends with its process. Return 0, or -1 if
 * PSA does not start. */
int teds_psa_fill(teds_port *port, bool persistent);

#ifdef __cplusplus
}
#endif

#endif
