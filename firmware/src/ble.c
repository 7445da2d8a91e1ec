/* SPDX-License-Identifier: Apache-2.0 */
/* BLE (wire.md): commands and replies as frames `transaction 2, total 2, offset 2, piece` over two characteristics. The
 * chip's stack provides the GATT server, connections and advertising; this file decides when to advertise and which
 * connection to drop. */
#include "ble.h"
#include "clock.h"
#include "drive.h"
#include "links.h"
#include "replies.h"
#include "session.h"
#include "stream.h"
#include "inside.h"

#if TEDS_BLE

#define HEAD 6u
#define LEAST_MTU 23u
#define MOST_VALUE 512u
#define STRANGER_NS (10u * TEDS_SECOND)
#define TAPPED_NS (60u * TEDS_SECOND)

static teds_ble_line *find_connection(teds_node *node, uint8_t connection)
{
    return connection < TEDS_BLE_CONNECTIONS && node->ble.lines[connection].used ? &node->ble.lines[connection] : NULL;
}

static teds_link link_of(uint8_t connection)
{
    return (teds_link)(TEDS_LINK_BLE + connection);
}

void teds_ble_connected(teds_node *node, uint8_t connection, uint16_t mtu)
{
    teds_ble_line *line;
    if (connection >= TEDS_BLE_CONNECTIONS) {
        return;
    }
    line = &node->ble.lines[connection];
    memset(line, 0, sizeof *line);
    line->used = true;
    line->mtu = mtu > LEAST_MTU ? mtu : LEAST_MTU;
    line->silent_since = teds_now(node);
}

void teds_ble_mtu(teds_node *node, uint8_t connection, uint16_t mtu)
{
    teds_ble_line *line = find_connection(node, connection);
    if (line != NULL) {
        line->mtu = mtu > LEAST_MTU ? mtu : LEAST_MTU;
    }
}

void teds_ble_disconnected(teds_node *node, uint8_t connection)
{
    teds_ble_line *line = find_connection(node, connection);
    if (line != NULL) {
        teds_wipe(line, sizeof *line);
        teds_node_link_lost(node, link_of(connection));
    }
}

static void run_request(teds_node *node, uint8_t connection, teds_ble_line *line)
{
    const teds_arrival arrival = {TEDS_AT_BLE, false, false, teds_now(node)};
    uint8_t transaction[2];
    teds_stored_reply *reply;
    teds_put16(transaction, line->transaction);
    reply = teds_answer(node, link_of(connection), &arrival, transaction, 2, line->request, line->total);
    line->reply = reply;
    line->sends = true;
    line->at = 0;
    line->sent_transaction = line->transaction;
}

/* Offset 0 starts a new message; a frame that does not continue the held one drops it. Neither gets an answer. */
void teds_ble_written(teds_node *node, uint8_t connection, const uint8_t *value, size_t length)
{
    teds_ble_line *line = find_connection(node, connection);
    size_t octets = length - HEAD;
    uint16_t transaction, total, offset;
    if (line == NULL) {
        return;
    }
    if (length < HEAD) {
        line->holds = false;
        return;
    }
    transaction = teds_get16(value);
    total = teds_get16(value + 2);
    offset = teds_get16(value + 4);
    if (offset == 0) {
        line->holds = true;
        line->transaction = transaction;
        line->total = total;
        line->held = 0;
    }
    if (!line->holds || transaction != line->transaction || total != line->total || offset != line->held ||
        offset + octets > total || (octets == 0 && total != 0)) {
        line->holds = false;
        return;
    }
    for (size_t i = 0; i < octets && offset + i < sizeof line->request; i++) {
        /* a message longer than maxMessage must get refusal 10, not silence */
        line->request[offset + i] = value[HEAD + i];
    }
    line->held = (uint16_t)(offset + octets);
    if (line->held == total) {
        line->holds = false;
        run_request(node, connection, line);
    }
}

size_t teds_ble_notify(teds_node *node, uint8_t connection, uint8_t out[MOST_VALUE])
{
    teds_ble_line *line = find_connection(node, connection);
    const teds_stored_reply *reply;
    size_t room, left;
    if (line == NULL || !line->sends) {
        return 0;
    }
    reply = line->reply;
    room = (line->mtu - 3u < MOST_VALUE ? line->mtu - 3u : MOST_VALUE) - HEAD;
    left = (size_t)(reply->length - 1 - line->at);
    room = left < room ? left : room;
    teds_put16(out, line->sent_transaction);
    teds_put16(out + 2, (uint16_t)(reply->length - 1));
    teds_put16(out + 4, line->at);
    memcpy(out + HEAD, reply->octets + 1 + line->at, room);
    line->at = (uint16_t)(line->at + room);
    if (room == left) {
        line->sends = false;
        line->reply->at = teds_now(node);
        teds_node_reply_left(node, link_of(connection));
    }
    return HEAD + room;
}

#if TEDS_OPERATION
void teds_ble_hears(teds_node *node, uint8_t connection, bool hears)
{
    teds_ble_line *line = find_connection(node, connection);
    teds_session *session = teds_session_on(node, link_of(connection));
    if (line == NULL) {
        return;
    }
    line->hears = hears;
    if (session != NULL && !hears) {
        teds_streams_end(node, session, UINT32_MAX);
    }
}

size_t teds_ble_data(teds_node *node, uint8_t *connection, uint8_t out[TEDS_BLE_DATA])
{
    teds_link link = TEDS_LINK_BLE;
    size_t length = teds_data_notify(node, &link, out, teds_now(node));
    *connection = (uint8_t)(link - TEDS_LINK_BLE);
    return length;
}

void teds_ble_driven(teds_node *node, uint8_t connection, const uint8_t *value, size_t length)
{
    if (find_connection(node, connection) != NULL && length > 0 && value[0] == 0) {
        teds_drive_message(node, link_of(connection), value + 1, length - 1);
    }
}
#endif

void teds_ble_tapped(teds_node *node)
{
    node->ble.was_tapped = true;
    node->ble.tapped_at = teds_now(node);
}

bool teds_ble_advertises(const teds_node *node)
{
    bool room = false;
    for (size_t i = 0; i < TEDS_BLE_CONNECTIONS; i++) {
        room = room || !node->ble.lines[i].used;
    }
    return room && (!teds_in_factory(node) ||
                    (node->ble.was_tapped && teds_now(node) < node->ble.tapped_at + TAPPED_NS));
}

bool teds_ble_drops(teds_node *node, uint8_t connection)
{
    teds_ble_line *line = find_connection(node, connection);
    if (line == NULL) {
        return false;
    }
    if (teds_session_on(node, link_of(connection)) != NULL) {
        line->silent_since = teds_now(node);
    }
    return teds_now(node) >= line->silent_since + STRANGER_NS;
}

#else
typedef int teds_ble_is_left_out;
#endif
