/* SPDX-License-Identifier: Apache-2.0 */
/* Of Zephyr's Bluetooth host what ble_gatt.c names: to compile against, nothing is behind it. */
#ifndef STANDIN_BT_UUID_H
#define STANDIN_BT_UUID_H

#include <zephyr/kernel.h>

struct bt_uuid {
    uint8_t type;
};
struct bt_uuid_128 {
    struct bt_uuid uuid;
    uint8_t val[16];
};
#define BT_UUID_128_ENCODE(w32, w1, w2, w3, w48)                                                                     \
    ((w48) & 0xFF), (((w48) >> 8) & 0xFF), (((w48) >> 16) & 0xFF), (((w48) >> 24) & 0xFF), (((w48) >> 32) & 0xFF),  \
        (((w48) >> 40) & 0xFF), ((w3) & 0xFF), (((w3) >> 8) & 0xFF), ((w2) & 0xFF), (((w2) >> 8) & 0xFF),           \
        ((w1) & 0xFF), (((w1) >> 8) & 0xFF), ((w32) & 0xFF), (((w32) >> 8) & 0xFF), (((w32) >> 16) & 0xFF),         \
        (((w32) >> 24) & 0xFF)
#define BT_UUID_INIT_128(...) {.uuid = {2}, .val = {__VA_ARGS__}}

#endif
