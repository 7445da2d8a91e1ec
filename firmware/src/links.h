/* SPDX-License-Identifier: Apache-2.0 */
/* Links to stations, of every kind: their ends, and the move to another CAN address. Implements teds_node_reply_left
 * and teds_node_link_lost of teds/node.h. */
#ifndef TEDS_SRC_LINKS_H
#define TEDS_SRC_LINKS_H

#include "inside.h"

#define TEDS_FIRST_STATION 0xF1u
#define TEDS_LAST_STATION 0xF7u

/* End a link: session, half-open Open, stored reply, a Request that waits for its Confirm. */
void teds_link_forget(teds_node *node, teds_link link);

/* End every link of the bus, and what its lines were sending or receiving. */
void teds_can_links_forget(teds_node *node);

/* Use this CAN address now. Every link is a pair of addresses, so all of them end. */
void teds_address_move(teds_node *node, uint8_t address);

#endif
