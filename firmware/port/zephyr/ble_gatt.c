/* SPDX-License-Identifier: Apache-2.0 */
/* The profile's GATT service on Zephyr's Bluetooth host: connectable advertising while the node says so, a write and a
 * notify characteristic for commands, one for data messages and set points. The host's callbacks fill a queue; the
 * node's thread empties it.
 */
#include "teds_zephyr.h"

#include <string.h>
#include <zephyr/bluetooth/bluetooth.h>
#include <zephyr/bluetooth/conn.h>
#include <zephyr/bluetooth/gatt.h>
#include <zephyr/bluetooth/uuid.h>
#include <zephyr/kernel.h>

#define OF_PROFILE(number) BT_UUID_128_ENCODE(number, 0x29b5, 0x44d3, 0x91d4, 0x401ec8a7a4d4)

static const struct bt_uuid_128 service_uuid = BT_UUID_INIT_128(OF_PROFILE(0xd8570001));
static const struct bt_uuid_128 write_uuid = BT_UUID_INIT_128(OF_PROFILE(0xd8570002));
static const struct bt_uuid_128 notify_uuid = BT_UUID_INIT_128(OF_PROFILE(0xd8570003));
static const struct bt_uuid_128 data_uuid = BT_UUID_INIT_128(OF_PROFILE(0xd8570004));

/* What the host's thread says of a connection, in flags: a queue that is full would hold up that thread while the node's
 * waits for a buffer of it. Only what was written is queued; where there is no room its writer is told. */
typedef struct line {
    struct bt_conn *connection; /* set by the host's thread while it is NULL, given back by the node's thread */
    atomic_t begun, ended, mtu, subscribed, hears;
    bool known, heard; /* the node knows of it, and that it hears data messages */
} line;

typedef struct said {
    uint8_t place;
    bool drives; /* a set point, not a command */
    uint16_t length;
    uint8_t octets[512];
} said;

K_MSGQ_DEFINE(teds_ble_said, sizeof(said), 3, 4);
static line lines[TEDS_BLE_CONNECTIONS];
static atomic_t stopped = ATOMIC_INIT(0);
static bool advertises;

static line *line_of(const struct bt_conn *connection)
{
    for (size_t i = 0; i < ARRAY_SIZE(lines); i++) {
        if (lines[i].connection == connection && (connection == NULL || atomic_get(&lines[i].ended) == 0)) {
            return &lines[i];
        }
    }
    return NULL;
}

static ssize_t take(const struct bt_conn *connection, const void *octets, uint16_t length, uint16_t offset,
                    uint8_t flags, bool drives)
{
    static said one; /* the host calls back from one thread */
    const line *own = line_of(connection);
    if ((flags & BT_GATT_WRITE_FLAG_PREPARE) != 0) {
        return 0;
    }
    if (offset != 0 || length > sizeof one.octets) {
        return BT_GATT_ERR(BT_ATT_ERR_INVALID_ATTRIBUTE_LEN);
    }
    one.place = own != NULL ? (uint8_t)(own - lines) : 0;
    one.drives = drives;
    one.length = length;
    memcpy(one.octets, octets, length);
    if (own == NULL || k_msgq_put(&teds_ble_said, &one, K_NO_WAIT) != 0) {
        return BT_GATT_ERR(BT_ATT_ERR_INSUFFICIENT_RESOURCES);
    }
    teds_zephyr_wake();
    return (ssize_t)length;
}

static ssize_t on_write(struct bt_conn *connection, const struct bt_gatt_attr *attribute, const void *octets,
                        uint16_t length, uint16_t offset, uint8_t flags)
{
    (void)attribute;
    return take(connection, octets, length, offset, flags, false);
}

static ssize_t on_drive(struct bt_conn *connection, const struct bt_gatt_attr *attribute, const void *octets,
                        uint16_t length, uint16_t offset, uint8_t flags)
{
    (void)attribute;
    return take(connection, octets, length, offset, flags, true);
}

static ssize_t on_subscribe(struct bt_conn *connection, const struct bt_gatt_attr *attribute, uint16_t value)
{
    line *own = line_of(connection);
    (void)attribute;
    if (own != NULL) {
        atomic_set(&own->subscribed, value == BT_GATT_CCC_NOTIFY);
    }
    teds_zephyr_wake();
    return sizeof value;
}

static ssize_t on_hear(struct bt_conn *connection, const struct bt_gatt_attr *attribute, uint16_t value)
{
    line *own = line_of(connection);
    (void)attribute;
    if (own != NULL) {
        atomic_set(&own->hears, value == BT_GATT_CCC_NOTIFY);
    }
    teds_zephyr_wake();
    return sizeof value;
}

static struct bt_gatt_ccc_managed_user_data subscriptions = BT_GATT_CCC_MANAGED_USER_DATA_INIT(NULL, on_subscribe, NULL);
static struct bt_gatt_ccc_managed_user_data hearers = BT_GATT_CCC_MANAGED_USER_DATA_INIT(NULL, on_hear, NULL);

BT_GATT_SERVICE_DEFINE(teds_service, BT_GATT_PRIMARY_SERVICE(&service_uuid),
                       BT_GATT_CHARACTERISTIC(&write_uuid.uuid, BT_GATT_CHRC_WRITE, BT_GATT_PERM_WRITE, NULL, on_write,
                                              NULL),
                       BT_GATT_CHARACTERISTIC(&notify_uuid.uuid, BT_GATT_CHRC_NOTIFY, BT_GATT_PERM_NONE, NULL, NULL,
                                              NULL),
                       BT_GATT_CCC_MANAGED(&subscriptions, BT_GATT_PERM_READ | BT_GATT_PERM_WRITE),
                       BT_GATT_CHARACTERISTIC(&data_uuid.uuid, BT_GATT_CHRC_WRITE_WITHOUT_RESP | BT_GATT_CHRC_NOTIFY,
                                              BT_GATT_PERM_WRITE, NULL, on_drive, NULL),
                       BT_GATT_CCC_MANAGED(&hearers, BT_GATT_PERM_READ | BT_GATT_PERM_WRITE));
#define REPLIES 4 /* places of the values that are notified, as BT_GATT_SERVICE_DEFINE lays attributes out */
#define DATA 7

static void on_connected(struct bt_conn *connection, uint8_t error)
{
    line *own = line_of(NULL);
    atomic_set(&stopped, 1); /* the host stops advertising with a connection */
    if (error == 0 && own != NULL) {
        atomic_set(&own->mtu, bt_gatt_get_mtu(connection));
        atomic_set(&own->subscribed, 0);
        atomic_set(&own->hears, 0);
        own->connection = bt_conn_ref(connection);
        atomic_set(&own->begun, 1);
    }
    teds_zephyr_wake();
}

static void on_disconnected(struct bt_conn *connection, uint8_t reason)
{
    line *own = line_of(connection);
    (void)reason;
    if (own != NULL) {
        atomic_set(&own->ended, 1);
    }
    teds_zephyr_wake();
}

static void on_mtu(struct bt_conn *connection, uint16_t tx, uint16_t rx)
{
    line *own = line_of(connection);
    if (own != NULL) {
        atomic_set(&own->mtu, tx < rx ? tx : rx);
    }
    teds_zephyr_wake();
}

BT_CONN_CB_DEFINE(teds_connections) = {.connected = on_connected, .disconnected = on_disconnected};
static struct bt_gatt_cb teds_gatt = {.att_mtu_updated = on_mtu};

int teds_zephyr_ble_start(teds_config *config)
{
    static uint8_t address[6];
    bt_addr_le_t own;
    size_t count = 1;
    const int failed = bt_enable(NULL);
    if (failed != 0) {
        return failed;
    }
    bt_id_get(&own, &count);
    if (count == 1) {
        for (size_t i = 0; i < sizeof address; i++) {
            address[i] = own.a.val[5 - i]; /* as people write it */
        }
        config->ble_address = address;
    }
    bt_gatt_cb_register(&teds_gatt);
    return 0;
}

static void advertise(const teds_node *node)
{
    static const uint8_t flags[] = {BT_LE_AD_GENERAL | BT_LE_AD_NO_BREDR}, uuid[] = {OF_PROFILE(0xd8570001)};
    static const struct bt_data data[] = {BT_DATA(BT_DATA_FLAGS, flags, sizeof flags),
                                          BT_DATA(BT_DATA_UUID128_ALL, uuid, sizeof uuid)};
    const bool wanted = teds_ble_advertises(node);
    if (atomic_cas(&stopped, 1, 0)) {
        advertises = false;
    }
    if (wanted && !advertises) {
        advertises = bt_le_adv_start(BT_LE_ADV_CONN_FAST_2, data, ARRAY_SIZE(data), NULL, 0) == 0;
    } else if (!wanted && advertises) {
        (void)bt_le_adv_stop();
        advertises = false;
    }
}

/* Give back a connection that has ended: nobody but this thread uses it, so nobody holds it any more. */
static void end(teds_node *node, uint8_t place)
{
    line *own = &lines[place];
    if (own->known) {
        teds_ble_disconnected(node, place);
        own->known = own->heard = false;
    }
    bt_conn_unref(own->connection);
    atomic_set(&own->begun, 0);
    own->connection = NULL;
    atomic_set(&own->ended, 0); /* last: from now on the place is free */
}

#if TEDS_OPERATION
static void tell_who_hears(teds_node *node, uint8_t place)
{
    line *own = &lines[place];
    const bool hears = atomic_get(&own->hears) != 0;
    if (hears != own->heard) {
        own->heard = hears;
        teds_ble_hears(node, place, hears);
    }
}

static bool send_data(teds_node *node)
{
    static uint8_t out[TEDS_BLE_DATA];
    bool moved = false;
    uint8_t place;
    size_t length;
    while ((length = teds_ble_data(node, &place, out)) > 0) {
        if (lines[place].known && atomic_get(&lines[place].ended) == 0) {
            (void)bt_gatt_notify(lines[place].connection, &teds_service.attrs[DATA], out, (uint16_t)length);
        }
        moved = true;
    }
    return moved;
}
#endif

static bool serve(teds_node *node, uint8_t place)
{
    static uint8_t out[512];
    line *own = &lines[place];
    bool moved = false;
    size_t length;
    if (own->connection == NULL) {
        return false;
    }
    if (atomic_get(&own->ended) != 0) {
        end(node, place);
        return true;
    }
    if (atomic_get(&own->begun) == 0) {
        return false;
    }
    if (!own->known) {
        teds_ble_connected(node, place, (uint16_t)atomic_get(&own->mtu));
        own->known = true;
    }
    teds_ble_mtu(node, place, (uint16_t)atomic_get(&own->mtu));
#if TEDS_OPERATION
    tell_who_hears(node, place);
#endif
    if (teds_ble_drops(node, place)) {
        (void)bt_conn_disconnect(own->connection, BT_HCI_ERR_REMOTE_USER_TERM_CONN);
        return false;
    }
    /* bt_gatt_notify waits for a buffer on this thread: no notification is lost, and no other is reordered. */
    while (atomic_get(&own->subscribed) != 0 && (length = teds_ble_notify(node, place, out)) > 0) {
        (void)bt_gatt_notify(own->connection, &teds_service.attrs[REPLIES], out, (uint16_t)length);
        moved = true;
    }
    return moved;
}

bool teds_zephyr_ble_work(teds_node *node)
{
    static said one;
    bool moved = false;
    for (uint8_t i = 0; i < ARRAY_SIZE(lines); i++) {
        moved = serve(node, i) || moved;
    }
    while (k_msgq_get(&teds_ble_said, &one, K_NO_WAIT) == 0) {
        if (lines[one.place].known && !one.drives) {
            teds_ble_written(node, one.place, one.octets, one.length);
        }
#if TEDS_OPERATION
        if (lines[one.place].known && one.drives) {
            teds_ble_driven(node, one.place, one.octets, one.length);
        }
#endif
        (void)serve(node, one.place);
        moved = true;
    }
#if TEDS_OPERATION
    moved = send_data(node) || moved;
#endif
    advertise(node);
    return moved;
}
