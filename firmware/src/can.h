/* SPDX-License-Identifier: Apache-2.0 */
/* Lines, answers to everyone, Announce and Claim. */
#ifndef TEDS_SRC_CAN_H
#define TEDS_SRC_CAN_H

#include "inside.h"

void teds_can_move(teds_node *node, uint8_t address);
bool teds_can_sending(const teds_node *node);
/* What Identify says is another thing from now on: answers to everyone that are under way end. */
void teds_can_identity_changed(teds_node *node);
uint64_t teds_can_poll(teds_node *node, uint64_t now);
uint8_t teds_default_address(const teds_node *node);

#endif
