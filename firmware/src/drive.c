/* SPDX-License-Identifier: Apache-2.0 */
/* Drive (operation.md, 4 and 6): values for actuators by message, without a reply. A message with any error is dropped
 * silently; with a good tag it uses up its counter anyway. */
#include "drive.h"
#include "clock.h"
#include "isotp.h"
#include "operation.h"
#include "session.h"
#include "transducers.h"
#include "inside.h"

#if TEDS_OPERATION

#define HEAD 16u /* counter, until, tag */
#define MICRO 1000u

static uint32_t drive_octets(const teds_session *session)
{
    return HEAD + session->drive.octets;
}

int teds_drive(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    teds_session *session = origin->session;
    uint8_t places[16], key[16];
    uint32_t octets = 0;
    const size_t count = command->length;
    int refused = teds_channel_list(command->payload, count, 16);
    if (refused) {
        return refused;
    }
    if (origin->arrival->kind == TEDS_AT_NFC) {
        return -TEDS_DOES_NOT_FIT;
    }
    for (size_t i = 0; i < count; i++) {
        int place = teds_place_of(node, command->payload[i]);
        if (!teds_is_claimed(origin, place)) {
            return -TEDS_WRONG_STATE;
        }
        places[i] = (uint8_t)place;
        octets += node->port->channels[place].octets;
    }
    for (size_t i = 0; i < count; i++) {
        if (node->port->channels[places[i]].kind != TEDS_ACTUATOR) {
            return -TEDS_NOT_PERMITTED;
        }
    }
    if (session->run == UINT16_MAX || octets > TEDS_DRIVE_OCTETS) {
        return -TEDS_NO_ROOM;
    }
    session->run++;
    if (teds_run_key(node, session, "TEDS1 drive", 12, key) != 0) {
        return -TEDS_FAILURE;
    }
    teds_wipe(&session->drive, sizeof session->drive);
    session->drive.used = true;
    session->drive.fd = origin->arrival->fd && TEDS_CAN_FD;
    session->drive.count = (uint8_t)count;
    session->drive.octets = (uint8_t)octets;
    memcpy(session->drive.places, places, count);
    memcpy(session->drive.key, key, sizeof key);
    teds_wipe(key, sizeof key);
    teds_put16(out, session->run);
    teds_put16(out + 2, (uint16_t)drive_octets(session));
    return 4;
}

/* `until` must not be in the past (which looks far ahead, mod 2^32) nor further ahead than the shortest dead-man. */
static bool is_in_time(const teds_node *node, const teds_session *session, uint32_t until)
{
    uint32_t ahead = until - (uint32_t)(teds_now(node) / MICRO);
    for (size_t i = 0; i < session->drive.count; i++) {
        if (ahead > node->dead_man[session->drive.places[i]] * MICRO) {
            return false;
        }
    }
    return true;
}

static void take_drive_message(teds_node *node, teds_session *session)
{
    uint8_t plain[4 + TEDS_DRIVE_OCTETS], pairs[16 + TEDS_DRIVE_OCTETS], nonce[13] = {0};
    uint32_t counter = teds_get32(session->drive.message);
    size_t at = 4, length = 0;
    if (session->drive.seen && counter <= session->drive.last) {
        return;
    }
    teds_put32(nonce + 9, counter);
    if (!node->port->ccm_open(node->port->user, session->drive.key, nonce, session->drive.message + 4,
                              4u + session->drive.octets, plain, 8)) {
        return;
    }
    session->drive.seen = true;
    session->drive.last = counter;
    for (size_t i = 0; i < session->drive.count; i++) {
        const teds_channel *own = &node->port->channels[session->drive.places[i]];
        pairs[length] = own->number;
        memcpy(pairs + length + 1, plain + at, own->octets);
        length += 1u + own->octets;
        at += own->octets;
    }
    if (is_in_time(node, session, teds_get32(plain))) {
        (void)teds_set_actuators(node, pairs, length);
    }
}

/* The length of a CAN FD frame that can hold so many octets. */
static size_t round_to_fd(size_t octets)
{
    teds_can_frame frame = {0};
    if (octets <= 8) {
        return octets;
    }
    teds_can_pad(&frame, octets);
    return frame.length;
}

void teds_drive_message(teds_node *node, teds_link link, const uint8_t *octets, size_t length)
{
    teds_session *session = teds_session_on(node, link);
    if (session == NULL) {
        return;
    }
    (void)teds_operation_poll(node, teds_now(node)); /* end dead-men that expired before this message */
    if (session->drive.used && length == drive_octets(session)) {
        memcpy(session->drive.message, octets, length);
        take_drive_message(node, session);
    }
}

void teds_drive_frame(teds_node *node, teds_link link, const uint8_t *octets, size_t length)
{
    teds_session *session = teds_session_on(node, link);
    size_t room, due;
    if (session == NULL || length < 1 || octets[0] > 7) {
        return;
    }
    (void)teds_operation_poll(node, teds_now(node)); /* end dead-men that expired before this frame */
    if (!session->drive.used) {
        return;
    }
    if (octets[0] == 0) {
        session->drive.begun = true;
        session->drive.at = 0;
    } else if (!session->drive.begun || octets[0] != session->drive.segment) {
        session->drive.begun = false;
        return;
    }
    room = session->drive.fd ? 63 : 7;
    due = drive_octets(session) - session->drive.at < room ? drive_octets(session) - session->drive.at : room;
    if (length - 1 != (session->drive.fd ? round_to_fd(due + 1) - 1 : due)) {
        session->drive.begun = false;
        return;
    }
    memcpy(session->drive.message + session->drive.at, octets + 1, due);
    session->drive.at = (uint8_t)(session->drive.at + due);
    session->drive.segment = (uint8_t)(octets[0] % 7 + 1);
    if (session->drive.at == drive_octets(session)) {
        session->drive.begun = false;
        take_drive_message(node, session);
    }
}

#else
typedef int teds_drive_is_left_out;
#endif
