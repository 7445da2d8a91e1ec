/* SPDX-License-Identifier: Apache-2.0 */
/* The TEDS that the node has, and those that it would have after a commit. */
#ifndef TEDS_SRC_DATASHEET_H
#define TEDS_SRC_DATASHEET_H

#include "teds_source.h"
#include "inside.h"

/* True if a TEDS of this channel and access code may exist here. */
bool teds_storable(uint16_t channel, uint8_t code);

/* Find a TEDS that is part of the firmware, and that no station can change. */
bool teds_find_fixed(const teds_node *node, uint16_t id, teds_source *out);

/* Find a TEDS: fixed, stored, or the initial Security TEDS. */
bool teds_find(const teds_node *node, uint16_t id, teds_source *out);

/* Find a TEDS as after a commit: the staged image, otherwise the result of teds_find. */
bool teds_find_new(const teds_node *node, uint16_t id, teds_source *out);

/* The lowest id above `after` (-1: the first) in these sets; TEDS_NO_ID at the end, TEDS_UNREADABLE if flash failed. */
enum { TEDS_STORED = 1, TEDS_NOT_STORED = 2, TEDS_STAGED = 4 }; /* NOT_STORED: fixed ones, and the Security TEDS */
int32_t teds_next_id(const teds_node *node, int32_t after, unsigned among);

#endif
