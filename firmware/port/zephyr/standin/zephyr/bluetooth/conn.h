/* SPDX-License-Identifier: Apache-2.0 */
#ifndef STANDIN_BT_CONN_H
#define STANDIN_BT_CONN_H

#include <zephyr/kernel.h>

struct bt_conn;
struct bt_conn_cb {
    void (*connected)(struct bt_conn *conn, uint8_t err);
    void (*disconnected)(struct bt_conn *conn, uint8_t reason);
};
#define BT_CONN_CB_DEFINE(_name) const struct bt_conn_cb _name
#define BT_HCI_ERR_REMOTE_USER_TERM_CONN 0x13
extern const struct bt_conn_cb teds_connections;
struct bt_conn *bt_conn_ref(struct bt_conn *conn);
void bt_conn_unref(struct bt_conn *conn);
int bt_conn_disconnect(struct bt_conn *conn, uint8_t reason);

#endif
