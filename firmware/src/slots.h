/* SPDX-License-Identifier: Apache-2.0 */
/* The two slots of flash: the node's state and the stored TEDS. Each change writes a whole new slot. */
#ifndef TEDS_SRC_SLOTS_H
#define TEDS_SRC_SLOTS_H

#include "security_teds.h"
#include "teds_source.h"
#include "inside.h"

/* Load identity and state at a start; write the first slot of a new node. 0, or the error of teds_node_init. */
int teds_slots_load(teds_node *node);

/* Find a stored TEDS. If flash cannot be read, `out` is unreadable too, so that the answer is a failure and not "no
 * such TEDS". */
bool teds_find_stored(const teds_node *node, uint16_t id, teds_source *out);

/* Lower `found` to the lowest stored id above `after`, if there is one below it; false: flash cannot be read. */
bool teds_next_stored(const teds_node *node, int32_t after, int32_t *found);

/* Write a whole new state, with the TEDS that are kept: those that a commit lists, plus the staged ones; without a
 * commit (NULL) all, except the Security TEDS if the new state is not provisioned. 0, or a reason negated: then the
 * state is unchanged. */
int teds_slots_write(teds_node *node, const teds_state *state, const teds_signed *commit);

/* Erase the free slot unless it is blank. 0, or a reason negated. */
int teds_slots_blank(teds_node *node);

/* Erase the old slot when due: at once if no reply `waits`, otherwise after 15 s. */
void teds_slots_poll(teds_node *node, uint64_t now, bool waits);

#endif
