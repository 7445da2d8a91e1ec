/* SPDX-License-Identifier: Apache-2.0 */
/* The node over Bluetooth LE: the functions teds_ble_... of teds/node.h. */
#ifndef TEDS_SRC_BLE_H
#define TEDS_SRC_BLE_H

#include "inside.h"

#endif
