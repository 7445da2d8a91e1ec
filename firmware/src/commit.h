/* SPDX-License-Identifier: Apache-2.0 */
/* The checks of a commit, and its last step. */
#ifndef TEDS_SRC_COMMIT_H
#define TEDS_SRC_COMMIT_H

#include "security_teds.h"
#include "inside.h"

int teds_commit(teds_node *node);
/* Its last step; apart, so that the new state is not on the stack beside a verification. */
int teds_commit_state(teds_node *node, const teds_signed *teds);
int teds_to_factory(teds_node *node);
bool teds_lists(const teds_signed *teds, uint16_t id);

#endif
