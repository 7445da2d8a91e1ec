/* The profile's GATT service on Zephyr's Bluetooth host: connectable advertising while the node says so, one write and
 * one notify characteristic. The host's callbacks fill a queue; the node's thread empties it.
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

enum { CONNECTED, MTU, DISCONNECTED, WRITTEN };

typedef struct said {
    uint8_t event, connection;
    uint16_t length; /* of what was written, or the MTU */
    uint8_t octets[512];
} said;

K_MSGQ_DEFINE(teds_ble_said, sizeof(said), 3, 4);
static struct bt_conn *connections[TEDS_BLE_CONNECTIONS];
static atomic_t subscribed = ATOMIC_INIT(0);
static bool advertises;

static int place_of(const struct bt_conn *connection)
{
    for (int i = 0; i < TEDS_BLE_CONNECTIONS; i++) {
        if (connections[i] == connection) {
            return i;
        }
    }
    return -1;
}

static int tell(uint8_t event, int place, uint16_t length, const void *octets)
{
    static said one; /* the Bluetooth host calls back from one thread */
    int failed;
    one.event = event;
    one.connection = (uint8_t)place;
    one.length = length;
    if (octets != NULL) {
        memcpy(one.octets, octets, length);
    }
    failed = k_msgq_put(&teds_ble_said, &one, octets != NULL ? K_NO_WAIT : K_FOREVER);
    teds_zephyr_wake();
    return failed;
}

static ssize_t on_write(struct bt_conn *connection, const struct bt_gatt_attr *attribute, const void *octets,
                        uint16_t length, uint16_t offset, uint8_t flags)
{
    const int place = place_of(connection);
    (void)attribute;
    if ((flags & BT_GATT_WRITE_FLAG_PREPARE) != 0) {
        return 0;
    }
    if (offset != 0 || length > sizeof(((said *)NULL)->octets)) {
        return BT_GATT_ERR(BT_ATT_ERR_INVALID_ATTRIBUTE_LEN);
    }
    if (place < 0 || tell(WRITTEN, place, length, octets) != 0) {
        return BT_GATT_ERR(BT_ATT_ERR_INSUFFICIENT_RESOURCES);
    }
    return (ssize_t)length;
}

static void on_subscribe(const struct bt_gatt_attr *attribute, uint16_t value)
{
    (void)attribute;
    atomic_set(&subscribed, value == BT_GATT_CCC_NOTIFY);
    teds_zephyr_wake();
}

BT_GATT_SERVICE_DEFINE(teds_service, BT_GATT_PRIMARY_SERVICE(&service_uuid),
                       BT_GATT_CHARACTERISTIC(&write_uuid.uuid, BT_GATT_CHRC_WRITE, BT_GATT_PERM_WRITE, NULL, on_write,
                                              NULL),
                       BT_GATT_CHARACTERISTIC(&notify_uuid.uuid, BT_GATT_CHRC_NOTIFY, BT_GATT_PERM_NONE, NULL, NULL,
                                              NULL),
                       BT_GATT_CCC(on_subscribe, BT_GATT_PERM_READ | BT_GATT_PERM_WRITE));

static void on_connected(struct bt_conn *connection, uint8_t error)
{
    const int place = place_of(NULL);
    advertises = false; /* the host stops it with a connection */
    if (error != 0 || place < 0) {
        return;
    }
    connections[place] = bt_conn_ref(connection);
    (void)tell(CONNECTED, place, bt_gatt_get_mtu(connection), NULL);
}

static void on_disconnected(struct bt_conn *connection, uint8_t reason)
{
    const int place = place_of(connection);
    (void)reason;
    if (place >= 0) {
        (void)tell(DISCONNECTED, place, 0, NULL);
        connections[place] = NULL;
        bt_conn_unref(connection);
    }
}

static void on_mtu(struct bt_conn *connection, uint16_t tx, uint16_t rx)
{
    const int place = place_of(connection);
    if (place >= 0) {
        (void)tell(MTU, place, tx < rx ? tx : rx, NULL);
    }
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
    if (wanted && !advertises) {
        advertises = bt_le_adv_start(BT_LE_ADV_CONN_FAST_2, data, ARRAY_SIZE(data), NULL, 0) == 0;
    } else if (!wanted && advertises) {
        (void)bt_le_adv_stop();
        advertises = false;
    }
}

bool teds_zephyr_ble_work(teds_node *node)
{
    static said one;
    static uint8_t out[512];
    bool moved = false;
    while (k_msgq_get(&teds_ble_said, &one, K_NO_WAIT) == 0) {
        moved = true;
        if (one.event == CONNECTED) {
            teds_ble_connected(node, one.connection, one.length);
        } else if (one.event == MTU) {
            teds_ble_mtu(node, one.connection, one.length);
        } else if (one.event == DISCONNECTED) {
            teds_ble_disconnected(node, one.connection);
        } else {
            teds_ble_written(node, one.connection, one.octets, one.length);
        }
    }
    for (uint8_t i = 0; i < TEDS_BLE_CONNECTIONS; i++) {
        struct bt_conn *connection = connections[i];
        size_t length;
        if (connection == NULL) {
            continue;
        }
        if (teds_ble_drops(node, i)) {
            (void)bt_conn_disconnect(connection, BT_HCI_ERR_REMOTE_USER_TERM_CONN);
            continue;
        }
        /* bt_gatt_notify waits for a buffer on this thread: no notification is lost, and no other is reordered. */
        while (atomic_get(&subscribed) != 0 && (length = teds_ble_notify(node, i, out)) > 0) {
            (void)bt_gatt_notify(connection, &teds_service.attrs[4], out, (uint16_t)length);
            moved = true;
        }
    }
    advertise(node);
    return moved;
}
