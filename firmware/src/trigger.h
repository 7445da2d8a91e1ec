/* SPDX-License-Identifier: Apache-2.0 */
/* Arm, and the trigger frame. */
#ifndef TEDS_SRC_TRIGGER_H
#define TEDS_SRC_TRIGGER_H

#include "inside.h"

#if TEDS_OPERATION
teds_handler teds_arm;

/* Handle a trigger frame: do what its token was armed for, as of this tick. */
void teds_trigger(teds_node *node, teds_link link, const uint8_t *token, uint64_t tick);
#endif

#endif
