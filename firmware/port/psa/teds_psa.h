/* Cryptography by the PSA Crypto API (Mbed TLS 2.28 and later, TF-M): one key, one use.
 *
 * The signing key is persistent under TEDS_PSA_KEY and never exported; one-time keys are volatile, their id is all that
 * the node holds. Randomness is PSA's. psa_crypto_init() is called here. The library allocates from its own heap.
 */
#ifndef TEDS_PSA_H
#define TEDS_PSA_H

#include "teds/port.h"

#ifndef TEDS_PSA_KEY
#define TEDS_PSA_KEY 0x14454453u /* within PSA_KEY_ID_USER_MIN to _MAX */
#endif

/* Fill in cryptography and randomness of a port; 0, or -1 where PSA does not start. `persistent`: the identity key lies
 * in PSA's storage; else it is volatile, for tests of a node whose flash is gone with the process. */
int teds_psa_fill(teds_port *port, bool persistent);

#endif
