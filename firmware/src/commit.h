/* SPDX-License-Identifier: Apache-2.0 */
/* The commit of a datasheet, and the return to factory state. int: 0, or a reason negated. */
#ifndef TEDS_SRC_COMMIT_H
#define TEDS_SRC_COMMIT_H

#include "security_teds.h"
#include "inside.h"

/* Check what is staged, and store it in one transaction. A refused commit changes nothing. */
int teds_commit(teds_node *node);

/* The last step of a commit. A separate function, so that the new state is not on the stack during a verification. */
int teds_commit_state(teds_node *node, const teds_signed *teds);

/* Forget the key, station and CA, and the signed datasheet. Epoch, sequence, address and other TEDS are kept. */
int teds_to_factory(teds_node *node);

#endif
