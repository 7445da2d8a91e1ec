/* SPDX-License-Identifier: Apache-2.0 */
/* NDEF records: reading a message in place, writing heads. */
#ifndef TEDS_SRC_NDEF_H
#define TEDS_SRC_NDEF_H

#include "inside.h"

#if TEDS_NFC
#define TEDS_TIM_TYPE "teds-provision:tim"
enum { TEDS_NDEF_WELL_KNOWN = 1, TEDS_NDEF_MIME = 2, TEDS_NDEF_EXTERNAL = 4, TEDS_NDEF_BEGINS = 0x80, TEDS_NDEF_ENDS = 0x40 };

/* The parts of a message that the profile uses; NULL: no such record. */
typedef struct teds_ndef {
    bool any, charges; /* charges: the first record is about how the reader charges */
    /* a record came in chunks, which are joined in place, so the octets after it are no valid message any more */
    bool chunked;
    const uint8_t *selection, *payload;
    size_t selection_length, payload_length;
} teds_ndef;

/* Read a message; false if it is not well formed. Records in chunks are joined in place. */
bool teds_ndef_read(uint8_t *message, size_t length, teds_ndef *out);

/* Write a record up to its payload; return the number of octets written. */
size_t teds_ndef_head(uint8_t *at, uint8_t marks, uint8_t tnf, const char *type, size_t type_length, size_t payload);
#endif

#endif
