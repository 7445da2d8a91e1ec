/* SPDX-License-Identifier: Apache-2.0 */
/* The node on CAN: teds_can_start, teds_can_rx, teds_can_tx, teds_can_pressed and teds_node_bus_off of teds/node.h. */
#ifndef TEDS_SRC_CAN_H
#define TEDS_SRC_CAN_H

#include "inside.h"

/* Abandon what has waited too long; return the time of the next action. */
uint64_t teds_can_poll(teds_node *node, uint64_t now);

#endif
