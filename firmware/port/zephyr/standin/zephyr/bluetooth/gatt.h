/* SPDX-License-Identifier: Apache-2.0 */
#ifndef STANDIN_BT_GATT_H
#define STANDIN_BT_GATT_H

#include <zephyr/bluetooth/conn.h>
#include <zephyr/bluetooth/uuid.h>

struct bt_gatt_attr;
typedef ssize_t (*bt_gatt_attr_read_func_t)(struct bt_conn *conn, const struct bt_gatt_attr *attr, void *buf,
                                            uint16_t len, uint16_t offset);
typedef ssize_t (*bt_gatt_attr_write_func_t)(struct bt_conn *conn, const struct bt_gatt_attr *attr, const void *buf,
                                             uint16_t len, uint16_t offset, uint8_t flags);
struct bt_gatt_attr {
    const struct bt_uuid *uuid;
    bt_gatt_attr_write_func_t write;
    void *user_data;
};
struct bt_gatt_ccc_managed_user_data {
    void (*cfg_changed)(const struct bt_gatt_attr *attr, uint16_t value);
    ssize_t (*cfg_write)(struct bt_conn *conn, const struct bt_gatt_attr *attr, uint16_t value);
    bool (*cfg_match)(struct bt_conn *conn, const struct bt_gatt_attr *attr);
};
#define BT_GATT_CCC_MANAGED_USER_DATA_INIT(_changed, _write, _match) {_changed, _write, _match}
struct bt_gatt_service_static {
    const struct bt_gatt_attr *attrs;
    size_t attr_count;
};
struct bt_gatt_cb {
    void (*att_mtu_updated)(struct bt_conn *conn, uint16_t tx, uint16_t rx);
};
/* Attribute by attribute as Zephyr lays them out: the service; declaration and value of each characteristic; CCC. */
#define BT_GATT_PRIMARY_SERVICE(_service) {&(_service)->uuid, NULL, NULL}
#define BT_GATT_CHARACTERISTIC(_uuid, _props, _perm, _read, _write, _user) {_uuid, NULL, NULL}, {_uuid, _write, NULL}
#define BT_GATT_CCC_MANAGED(_ccc, _perm) {NULL, NULL, _ccc}
#define BT_GATT_SERVICE_DEFINE(_name, ...)                        \
    static const struct bt_gatt_attr attr_##_name[] = {__VA_ARGS__}; \
    static const struct bt_gatt_service_static _name = {attr_##_name, ARRAY_SIZE(attr_##_name)}
#define BT_GATT_CHRC_WRITE_WITHOUT_RESP 0x04
#define BT_GATT_CHRC_WRITE 0x08
#define BT_GATT_CHRC_NOTIFY 0x10
#define BT_GATT_PERM_NONE 0
#define BT_GATT_PERM_READ 1
#define BT_GATT_PERM_WRITE 2
#define BT_GATT_WRITE_FLAG_PREPARE 1
#define BT_GATT_CCC_NOTIFY 1
#define BT_GATT_ERR(_att_err) (-(_att_err))
#define BT_ATT_ERR_INVALID_ATTRIBUTE_LEN 0x0d
#define BT_ATT_ERR_INSUFFICIENT_RESOURCES 0x11
uint16_t bt_gatt_get_mtu(struct bt_conn *conn);
void bt_gatt_cb_register(struct bt_gatt_cb *cb);
int bt_gatt_notify(struct bt_conn *conn, const struct bt_gatt_attr *attr, const void *data, uint16_t len);

#endif
