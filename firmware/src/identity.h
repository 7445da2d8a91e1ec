/* SPDX-License-Identifier: Apache-2.0 */
/* Who the node is: UUID, identity key, the state that it shows. */
#ifndef TEDS_SRC_IDENTITY_H
#define TEDS_SRC_IDENTITY_H

#include "inside.h"

/* Load the identity area, or make the identity at the very first start. 0, or the error of teds_node_init. */
int teds_identity_load(teds_node *node);

/* CRC-32 of the UUID, which Announce shows. */
uint32_t teds_uuid_crc(const teds_node *node);

/* CAN address of a node that was given none: it follows from the UUID. */
uint8_t teds_default_address(const teds_node *node);

/* As Identify and Announce report it: 0 factory, 1 keyed, 2 provisioned. */
uint8_t teds_state_octet(const teds_node *node);

#endif
