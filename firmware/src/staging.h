/* SPDX-License-Identifier: Apache-2.0 */
/* Staging: images that a session has written and not committed yet. It belongs to one session, node->staging_of. */
#ifndef TEDS_SRC_STAGING_H
#define TEDS_SRC_STAGING_H

#include "teds_source.h"
#include "inside.h"

/* The image of this id, and its length; NULL: none is staged. */
const uint8_t *teds_staged(const teds_node *node, uint16_t id, size_t *length);

bool teds_find_staged(const teds_node *node, uint16_t id, teds_source *out);

/* Lower `found` to the lowest staged id above `after`, if there is one below it. */
void teds_next_staged(const teds_node *node, int32_t after, int32_t *found);

/* Put `length` octets at `offset` of an image; octets after them are dropped. 0, or a reason negated. */
int teds_stage(teds_node *node, uint16_t id, uint32_t offset, const uint8_t *octets, size_t length);

/* Drop all images; afterwards staging belongs to no session. */
void teds_staging_drop(teds_node *node);

#endif
