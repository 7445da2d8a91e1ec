/* SPDX-License-Identifier: Apache-2.0 */
/* Framing of commands and replies over Bluetooth LE. */
#ifndef TEDS_SRC_BLE_H
#define TEDS_SRC_BLE_H

#include "inside.h"

#if TEDS_BLE
bool teds_ble_sends(const teds_node *node, const teds_stored_reply *reply);
void teds_ble_forget(teds_node *node, const teds_stored_reply *reply);
/* Octets of the longest data message of a connection; 0: its station does not hear them. */
uint16_t teds_ble_longest(const teds_node *node, teds_link link);
#endif

#endif
