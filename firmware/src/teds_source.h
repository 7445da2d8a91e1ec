/* SPDX-License-Identifier: Apache-2.0 */
/* One TEDS in flash or RAM, and its tuples. The id of a TEDS is channel << 8 | access code. */
#ifndef TEDS_SRC_TEDS_SOURCE_H
#define TEDS_SRC_TEDS_SOURCE_H

#include "inside.h"

typedef struct teds_source {
    uint32_t length, at;
    const uint8_t *octets; /* NULL: in the current slot, at `at`; the initial Security TEDS: only a length */
    bool initial, read_only, unreadable;
} teds_source;

/* Read `length` octets from `at` on, which must be within the TEDS. 0, or flash failed. */
int teds_source_read(const teds_node *node, const teds_source *source, uint32_t at, uint8_t *out, size_t length);

int teds_source_hash(const teds_node *node, const teds_source *source, uint8_t out[32]);

/* Results of a search among ids: the end, and unreadable flash. */
enum { TEDS_NO_ID = 0x10000, TEDS_UNREADABLE = 0x10001 };

/* Set `found` to `id` if that is above `after` and lower than the best so far: a step of a walk in ascending order. */
static inline void teds_keep_nearer(uint32_t id, int32_t after, int32_t *found)
{
    if ((int32_t)id > after && (int32_t)id < *found) {
        *found = (int32_t)id;
    }
}

/* A walk through the tuples of a TEDS: type 1, length `width`, value. `at` moves on, up to `end`. */
typedef struct teds_walk {
    const teds_node *node;
    teds_source source;
    uint32_t at, end, width;
} teds_walk;

/* The next tuple: its type, and offset and length of its value; false at the end, or if it does not fit. */
bool teds_next_tuple(teds_walk *in, uint8_t *type, uint32_t *value, uint32_t *length);

/* A number of 1 to 4 octets; UINT32_MAX: it does not fit, or flash cannot be read. */
uint32_t teds_number_at(const teds_walk *in, uint32_t at, uint32_t octets);

#endif
