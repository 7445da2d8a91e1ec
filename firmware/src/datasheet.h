/* SPDX-License-Identifier: Apache-2.0 */
/* Which TEDS the node has, and which it would have after a commit. */
#ifndef TEDS_SRC_DATASHEET_H
#define TEDS_SRC_DATASHEET_H

#include "teds_source.h"
#include "inside.h"

/* True if a TEDS of this channel and access code may exist here. */
bool teds_storable(uint16_t channel, uint8_t code);

/* Find a TEDS that the firmware holds and no station changes. */
bool teds_find_fixed(const teds_node *node, uint16_t id, teds_source *out);

/* Find a TEDS: fixed, stored, or the initial Security TEDS. */
bool teds_find(const teds_node *node, uint16_t id, teds_source *out);

/* Find the TEDS as it is after a commit: the staged image, or else what teds_find finds. */
bool teds_find_new(const teds_node *node, uint16_t id, teds_source *out);

/* Of these, the lowest id above `after` (-1: the first); TEDS_NO_ID at the end, TEDS_UNREADABLE if flash failed. */
enum { TEDS_STORED = 1, TEDS_NOT_STORED = 2, TEDS_STAGED = 4 }; /* NOT_STORED: fixed ones, and the Security TEDS */
int32_t teds_next_id(const teds_node *node, int32_t after, unsigned among);

#endif
