/* Cryptography by BearSSL: no heap, constant time. Private keys are scalars in software. */
#ifndef TEDS_BEARSSL_H
#define TEDS_BEARSSL_H

#include "teds/port.h"

/* What the port's `user` points to must begin with this: where new keys take their randomness from. */
typedef struct teds_bearssl {
    int (*random)(void *user, uint8_t *out, size_t length);
} teds_bearssl;

/* Fill in the cryptography of a port. */
void teds_bearssl_fill(teds_port *port);

#endif
