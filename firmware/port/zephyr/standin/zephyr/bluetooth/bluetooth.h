/* SPDX-License-Identifier: Apache-2.0 */
#ifndef STANDIN_BT_H
#define STANDIN_BT_H

#include <zephyr/kernel.h>

typedef struct {
    uint8_t val[6];
} bt_addr_t;
typedef struct {
    uint8_t type;
    bt_addr_t a;
} bt_addr_le_t;
struct bt_data {
    uint8_t type, data_len;
    const uint8_t *data;
};
struct bt_le_adv_param {
    uint32_t options;
};
#define BT_DATA(_type, _data, _data_len) {.type = (_type), .data_len = (_data_len), .data = (const uint8_t *)(_data)}
#define BT_DATA_FLAGS 0x01
#define BT_DATA_UUID128_ALL 0x07
#define BT_LE_AD_GENERAL 0x02
#define BT_LE_AD_NO_BREDR 0x04
extern const struct bt_le_adv_param standin_fast_2;
#define BT_LE_ADV_CONN_FAST_2 (&standin_fast_2)
typedef void (*bt_ready_cb_t)(int err);
int bt_enable(bt_ready_cb_t cb);
void bt_id_get(bt_addr_le_t *addrs, size_t *count);
int bt_le_adv_start(const struct bt_le_adv_param *param, const struct bt_data *ad, size_t ad_len,
                    const struct bt_data *sd, size_t sd_len);
int bt_le_adv_stop(void);

#endif
