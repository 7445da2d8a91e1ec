/* SPDX-License-Identifier: Apache-2.0 */
/* Drive: set points in messages without a reply. */
#ifndef TEDS_SRC_DRIVE_H
#define TEDS_SRC_DRIVE_H

#include "inside.h"

#if TEDS_OPERATION
teds_handler teds_drive;

/* A frame of a Drive message on CAN. */
void teds_drive_frame(teds_node *node, teds_link link, const uint8_t *octets, size_t length);

/* A whole Drive message, over BLE. */
void teds_drive_message(teds_node *node, teds_link link, const uint8_t *octets, size_t length);
#endif

#endif
