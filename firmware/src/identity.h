/* SPDX-License-Identifier: Apache-2.0 */
/* The node's identity: UUID, identity key, and the state that it reports. */
#ifndef TEDS_SRC_IDENTITY_H
#define TEDS_SRC_IDENTITY_H

#include "inside.h"

/* Load the identity area, or make the identity at the very first start. 0, or the error of teds_node_init. */
int teds_identity_load(teds_node *node);

/* CRC-32 of the UUID, as in Announce. */
uint32_t teds_uuid_crc(const teds_node *node);

/* CAN address of a node without a stored one: derived from the UUID. */
uint8_t teds_default_address(const teds_node *node);

/* As Identify and Announce report it: 0 factory, 1 keyed, 2 provisioned. */
uint8_t teds_state_octet(const teds_node *node);

#endif
