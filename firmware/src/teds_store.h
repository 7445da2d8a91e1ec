/* SPDX-License-Identifier: Apache-2.0 */
/* Slots of flash, staging, and the commands that read and write TEDS. */
#ifndef TEDS_SRC_TEDS_STORE_H
#define TEDS_SRC_TEDS_STORE_H

#include "security_teds.h"
#include "inside.h"

/* A TEDS is named channel << 8 | access code. */
typedef struct teds_source {
    uint32_t length, at;
    const uint8_t *octets; /* NULL: in flash, at `at`; the initial Security TEDS: length alone */
    bool initial, read_only, unreadable;
} teds_source;
int teds_store_load(teds_node *node);
bool teds_storable(uint16_t channel, uint8_t code);
bool teds_find(const teds_node *node, uint16_t id, teds_source *out);
/* What stands there after a commit: the staged image, or else what teds_find finds. */
bool teds_find_new(const teds_node *node, uint16_t id, teds_source *out);
int teds_source_read(const teds_node *node, const teds_source *source, uint32_t at, uint8_t *out, size_t length);
int teds_source_hash(const teds_node *node, const teds_source *source, uint8_t out[32]);
/* Of these, the lowest id above `after` (-1: the first); TEDS_NO_ID at the end, TEDS_UNREADABLE where flash failed. */
enum { TEDS_NO_ID = 0x10000, TEDS_UNREADABLE = 0x10001 };
enum { TEDS_STORED = 1, TEDS_NOT_STORED = 2, TEDS_STAGED = 4 }; /* NOT_STORED: fixed ones, and the Security TEDS */
int32_t teds_next_id(const teds_node *node, int32_t after, unsigned among);
/* Through the tuples of a TEDS: type 1, length `width`, value. */
typedef struct teds_walk {
    const teds_node *node;
    teds_source source;
    uint32_t at, end, width;
} teds_walk;
uint32_t teds_number_at(const teds_walk *in, uint32_t at, uint32_t octets);
bool teds_next_tuple(teds_walk *in, uint8_t *type, uint32_t *value, uint32_t *length);
teds_handler teds_query, teds_read, teds_write, teds_update;
const uint8_t *teds_staged(const teds_node *node, uint16_t id, size_t *length);
void teds_staging_drop(teds_node *node);
int teds_make_blank(teds_node *node);
/* Write a whole new state, with the TEDS that stay. A commit says which it lists, and what is staged comes to them;
 * without one (NULL) all stay, but for the Security TEDS where the new state is not provisioned. */
int teds_store_write(teds_node *node, const teds_state *state, const teds_signed *commit);
/* Erase the old slot where nobody waits for anything. */
void teds_store_poll(teds_node *node, uint64_t now);

#endif
