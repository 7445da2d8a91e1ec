/* SPDX-License-Identifier: Apache-2.0 */
/* Measurement operation inside a session (operation.md, 1, 2, 5): claims, leases, dead-men, single values. Checks run in
 * the order in which operation.md writes them. */
#include "operation.h"
#include "clock.h"
#include "datasheet.h"
#include "stream.h"
#include "teds_source.h"
#include "transducers.h"
#include "inside.h"

#if TEDS_OPERATION

#define MOST_SAMPLE 64u
#define MILLI UINT64_C(1000000)

/* -- claims -------------------------------------------------------------------------------------------------------- */

void teds_operation_start(teds_node *node)
{
    for (size_t i = 0; i < node->port->channel_count; i++) {
        node->actuator_of[i] = NULL;
        if (teds_is_actuator(node, (int)i)) {
            teds_go_safe(node, (int)i);
        }
    }
}

static uint32_t list_claims(const teds_node *node)
{
    uint32_t claims = 0;
    for (const teds_session *each = node->sessions; each < node->sessions + TEDS_SESSIONS; each++) {
        claims |= each->claims;
    }
    return claims;
}

bool teds_actuator_claimed(const teds_node *node)
{
    for (size_t i = 0; i < node->port->channel_count; i++) {
        if (teds_is_actuator(node, (int)i) && node->actuator_of[i] != NULL) {
            return true;
        }
    }
    return false;
}

static void end_drive(teds_session *own, uint32_t places)
{
    for (size_t i = 0; own->drive.used && i < own->drive.count; i++) {
        if ((places >> own->drive.places[i] & 1) != 0) {
            teds_wipe(&own->drive, sizeof own->drive);
        }
    }
}

void teds_claims_end(teds_node *node, teds_session *session, uint32_t places, bool stopped)
{
    uint32_t going = session->claims & places;
    if (going == 0) {
        return;
    }
    for (int i = 0; i < (int)node->port->channel_count; i++) {
        if ((going >> i & 1) != 0 && teds_is_actuator(node, i)) {
            node->actuator_of[i] = NULL;
            teds_go_safe(node, i);
            node->stopped |= stopped ? UINT32_C(1) << i : 0;
        }
    }
    session->claims &= ~going;
    teds_streams_end(node, session, going);
    end_drive(session, going);
    if (session->claims == 0) {
        memset(session->arms, 0, sizeof session->arms);
    }
}

static void release_claims(teds_node *node)
{
    for (teds_session *each = node->sessions; each < node->sessions + TEDS_SESSIONS; each++) {
        teds_claims_end(node, each, UINT32_MAX, false);
    }
}

void teds_make_all_safe(teds_node *node)
{
    release_claims(node);
    for (int i = 0; i < (int)node->port->channel_count; i++) {
        if (teds_is_actuator(node, i) && (node->safe >> i & 1) == 0) {
            teds_go_safe(node, i);
        }
    }
}

void teds_yield_sensors(teds_node *node, teds_session *session)
{
    for (teds_session *each = node->sessions; each < node->sessions + TEDS_SESSIONS; each++) {
        if (each != session) {
            teds_claims_end(node, each, UINT32_MAX, false); /* no actuator is claimed: the caller has checked that */
        }
    }
}

/* Rule for 1.3, 1.4 and 128.10: refuse with 2 if this session has a claim, with 17 if another one has. */
int teds_demand_configuration(teds_node *node, const teds_origin *origin, bool writes)
{
    (void)teds_operation_poll(node, teds_now(node));
    if (origin->session != NULL && origin->session->claims != 0) {
        return -TEDS_WRONG_STATE;
    }
    if (list_claims(node) == 0 || (writes && origin->arrival->kind == TEDS_AT_NFC && !teds_actuator_claimed(node))) {
        return 0;
    }
    return -TEDS_BUSY;
}

uint64_t teds_operation_poll(teds_node *node, uint64_t now)
{
    uint64_t due = TEDS_NEVER, at;
    if (list_claims(node) != 0 && (teds_power_now(node).flags & TEDS_POWER_TOO_LOW) != 0) {
        release_claims(node);
    }
    for (int i = 0; i < (int)node->port->channel_count; i++) {
        if (teds_is_actuator(node, i) && node->actuator_of[i] != NULL) {
            if (now >= node->deadline[i]) {
                teds_claims_end(node, node->actuator_of[i], UINT32_C(1) << i, true);
            } else if (node->deadline[i] < due) {
                due = node->deadline[i];
            }
        }
    }
    for (teds_session *each = node->sessions; each < node->sessions + TEDS_SESSIONS; each++) {
        if (each->claims != 0) {
            at = each->good_at + each->lease;
            if (now >= at) {
                teds_claims_end(node, each, UINT32_MAX, false);
            } else if (at < due) {
                due = at;
            }
        }
    }
    teds_streams_sample(node, now);
    at = teds_streams_due(node);
    return at < due ? at : due;
}

static uint32_t choose_sensors(const teds_node *node)
{
    uint32_t wanted = 0;
    uint64_t period;
    for (int i = 0; i < (int)node->port->channel_count; i++) {
        if (!teds_is_actuator(node, i) && !teds_has_fault(node, i) && teds_channel_fits(node, i, &period)) {
            wanted |= UINT32_C(1) << i;
        }
    }
    return wanted;
}

static bool has_sensors(const teds_node *node)
{
    for (int i = 0; i < (int)node->port->channel_count; i++) {
        if (!teds_is_actuator(node, i)) {
            return true;
        }
    }
    return false;
}

int teds_operate(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    int place = command->channel >= 1 && command->channel <= 255 ? teds_place_of(node, (uint8_t)command->channel) : -1;
    bool acting = place >= 0 && teds_is_actuator(node, place);
    teds_session *session = origin->session;
    teds_source security;
    uint8_t digest[32], lease;
    uint16_t dead_man = 0;
    uint32_t wanted;
    uint64_t period;
    (void)out;
    if (place < 0 && (command->channel != 0 || !has_sensors(node))) {
        return -TEDS_UNKNOWN_COMMAND;
    }
    if (command->length != (acting ? 19u : 17u)) {
        return -TEDS_BAD_FORM;
    }
    if (!teds_find(node, TEDS_SECURITY_ID, &security) || teds_source_hash(node, &security, digest) != 0) {
        return -TEDS_FAILURE;
    }
    if (memcmp(digest, command->payload, 16) != 0) {
        return -TEDS_DIGEST_MISMATCH;
    }
    wanted = place < 0 ? choose_sensors(node)
                       : teds_channel_fits(node, place, &period) ? UINT32_C(1) << place : 0;
    if (wanted == 0) {
        return -TEDS_DIGEST_MISMATCH;
    }
    lease = command->payload[16];
    dead_man = acting ? teds_get16(command->payload + 17) : 20;
    if (lease < 1 || lease > 60 || dead_man < 20 || dead_man > 10000) {
        return -TEDS_OUT_OF_RANGE;
    }
    if (acting && node->actuator_of[place] != NULL) {
        return node->actuator_of[place] == origin->session ? -TEDS_WRONG_STATE : -TEDS_BUSY;
    }
    if ((teds_power_now(node).flags & TEDS_POWER_TOO_LOW) != 0 || (place >= 0 && teds_has_fault(node, place))) {
        return -TEDS_FAULT_REASON;
    }
    session->claims |= wanted;
    session->lease = lease * TEDS_SECOND;
    if (acting) {
        teds_go_safe(node, place);
        node->stopped &= ~(UINT32_C(1) << place);
        node->actuator_of[place] = origin->session;
        node->dead_man[place] = dead_man;
        node->deadline[place] = teds_now(node) + dead_man * MILLI;
        if (node->port->arm != NULL) {
            node->port->arm(node->port->user, teds_channel_at(node, place)->number, dead_man);
        }
    }
    return 0;
}

int teds_idle(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    int place = command->channel >= 1 && command->channel <= 255 ? teds_place_of(node, (uint8_t)command->channel) : -1;
    (void)out;
    if (command->channel != 0 && place < 0) {
        return -TEDS_UNKNOWN_COMMAND;
    }
    if (command->length != 0) {
        return -TEDS_BAD_FORM;
    }
    teds_claims_end(node, origin->session, place < 0 ? UINT32_MAX : UINT32_C(1) << place, false);
    return 0;
}

int teds_operation_state(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    int length = 1;
    (void)command;
    out[0] = list_claims(node) != 0;
    for (int i = 0; i < (int)node->port->channel_count; i++) {
        uint32_t state = teds_is_actuator(node, i) ? 1 : teds_channel_at(node, i)->kind == TEDS_EVENT_SENSOR ? 8 : 0;
        uint8_t claimant = 0;
        for (size_t s = 0; s < TEDS_SESSIONS; s++) {
            if ((node->sessions[s].claims >> i & 1) != 0) {
                state |= &node->sessions[s] == origin->session ? 2 : 4;
                claimant = node->sessions[s].link > claimant ? node->sessions[s].link : claimant;
            }
        }
        state |= teds_is_actuator(node, i) ? (node->safe >> i & 1) << 4 | (node->stopped >> i & 1) << 5 : 0;
        state |= (teds_is_testing(node, i) ? 64u : 0) | (teds_has_fault(node, i) ? 128u : 0);
        out[length] = teds_channel_at(node, i)->number;
        out[length + 1] = (uint8_t)state;
        out[length + 2] = claimant;
        length += 3;
    }
    return length;
}

/* -- single values ------------------------------------------------------------------------------------------------- */

bool teds_is_claimed(const teds_origin *origin, int place)
{
    return place >= 0 && (origin->session->claims >> place & 1) != 0;
}

int teds_read_data_set(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    int place = command->channel >= 1 && command->channel <= 255 ? teds_place_of(node, (uint8_t)command->channel) : -1;
    if (place < 0) {
        return -TEDS_UNKNOWN_COMMAND;
    }
    if (command->length != 4) {
        return -TEDS_BAD_FORM;
    }
    if (!teds_is_claimed(origin, place)) {
        return -TEDS_WRONG_STATE;
    }
    if (teds_get32(command->payload) != 0) {
        return -TEDS_OUT_OF_RANGE;
    }
    if (teds_has_fault(node, place)) {
        return -TEDS_FAULT_REASON;
    }
    teds_put32(out, 0);
    (void)teds_read_channel(node, place, teds_now(node), out + 4);
    return 4 + teds_channel_at(node, place)->octets;
}

int teds_sample(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    uint8_t channels[MOST_SAMPLE]; /* a copy, because the reply overwrites the command */
    const size_t count = command->length;
    size_t length = 9;
    uint64_t tick;
    int refused = teds_channel_list(command->payload, count, MOST_SAMPLE);
    if (refused) {
        return refused;
    }
    memcpy(channels, command->payload, count);
    for (size_t i = 0; i < count; i++) {
        int place = teds_place_of(node, channels[i]);
        if (!teds_is_claimed(origin, place)) {
            return -TEDS_WRONG_STATE;
        }
        length += teds_channel_at(node, place)->octets;
    }
    if (length > TEDS_ROOM - 4) {
        return -TEDS_TOO_LARGE;
    }
    for (size_t i = 0; i < count; i++) {
        if (teds_has_fault(node, teds_place_of(node, channels[i]))) {
            return -TEDS_FAULT_REASON;
        }
    }
    tick = teds_now(node);
    teds_put64(out, tick);
    out[8] = 0;
    length = 9;
    for (size_t i = 0; i < count; i++) {
        int place = teds_place_of(node, channels[i]);
        out[8] |= teds_read_channel(node, place, tick, out + length) ? 0 : 1;
        length += teds_channel_at(node, place)->octets;
    }
    return (int)length;
}

/* Set actuators: `pairs` of channel and data set, checked to be claimed by this session. */
int teds_set_actuators(teds_node *node, const uint8_t *pairs, size_t length)
{
    const teds_port *port = node->port;
    uint64_t now = teds_now(node);
    for (size_t at = 0; at < length; at += 1u + teds_channel_at(node, teds_place_of(node, pairs[at]))->octets) {
        if (port->bears == NULL || port->set == NULL || !port->bears(port->user, pairs[at], pairs + at + 1)) {
            return -TEDS_OUT_OF_RANGE;
        }
    }
    for (size_t at = 0; at < length; at += 1u + teds_channel_at(node, teds_place_of(node, pairs[at]))->octets) {
        if (teds_has_fault(node, teds_place_of(node, pairs[at]))) {
            return -TEDS_FAULT_REASON;
        }
    }
    for (size_t at = 0; at < length; at += 1u + teds_channel_at(node, teds_place_of(node, pairs[at]))->octets) {
        int place = teds_place_of(node, pairs[at]);
        port->set(port->user, pairs[at], pairs + at + 1);
        if (port->kick != NULL) {
            port->kick(port->user, pairs[at]);
        }
        node->deadline[place] = now + node->dead_man[place] * MILLI;
        node->safe &= ~(UINT32_C(1) << place); /* NOLINT: the caller has checked each channel, so none is -1 */
    }
    return 0;
}

int teds_write_data_set(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    uint8_t pair[256];
    int place = command->channel >= 1 && command->channel <= 255 ? teds_place_of(node, (uint8_t)command->channel) : -1;
    (void)out;
    if (place < 0) {
        return -TEDS_UNKNOWN_COMMAND;
    }
    if (command->length != 4u + teds_channel_at(node, place)->octets) {
        return -TEDS_BAD_FORM;
    }
    if (!teds_is_claimed(origin, place)) {
        return -TEDS_WRONG_STATE;
    }
    if (!teds_is_actuator(node, place)) {
        return -TEDS_NOT_PERMITTED;
    }
    if (teds_get32(command->payload) != 0) {
        return -TEDS_OUT_OF_RANGE;
    }
    pair[0] = (uint8_t)command->channel;
    memcpy(pair + 1, command->payload + 4, command->length - 4);
    return teds_set_actuators(node, pair, command->length - 3);
}

int teds_set(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const uint8_t *pairs = command->payload;
    uint32_t seen = 0;
    size_t at = 0;
    int place;
    (void)out;
    if (command->length == 0) {
        return -TEDS_BAD_FORM;
    }
    while (at < command->length) {
        place = teds_place_of(node, pairs[at]);
        if (pairs[at] == 0) {
            return -TEDS_BAD_FORM;
        }
        if (place < 0) { /* its width is unknown, so nothing after it can be read */
            return -TEDS_WRONG_STATE;
        }
        if ((seen >> place & 1) != 0 || at + 1 + teds_channel_at(node, place)->octets > command->length) {
            return -TEDS_BAD_FORM;
        }
        seen |= UINT32_C(1) << place;
        at += 1u + teds_channel_at(node, place)->octets;
    }
    if ((seen & ~origin->session->claims) != 0) {
        return -TEDS_WRONG_STATE;
    }
    for (place = 0; place < (int)node->port->channel_count; place++) {
        if ((seen >> place & 1) != 0 && !teds_is_actuator(node, place)) {
            return -TEDS_NOT_PERMITTED;
        }
    }
    return teds_set_actuators(node, pairs, command->length);
}

int teds_self_test(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    int place = command->channel >= 1 && command->channel <= 255 ? teds_place_of(node, (uint8_t)command->channel) : -1;
    uint32_t wanted = place < 0 ? UINT32_MAX : UINT32_C(1) << place;
    (void)out;
    if (command->channel != 0 && place < 0) {
        return -TEDS_UNKNOWN_COMMAND;
    }
    if (command->length != 1) {
        return -TEDS_BAD_FORM;
    }
    if (command->payload[0] != 0) {
        return -TEDS_OUT_OF_RANGE;
    }
    for (teds_session *each = node->sessions; each < node->sessions + TEDS_SESSIONS; each++) {
        if (each != origin->session && (each->claims & wanted) != 0) {
            return -TEDS_BUSY;
        }
    }
    for (int i = 0; i < (int)node->port->channel_count; i++) {
        if ((wanted >> i & 1) != 0 && node->port->self_test != NULL) {
            node->port->self_test(node->port->user, teds_channel_at(node, i)->number);
        }
    }
    return 0;
}

int teds_power_state(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const teds_power now = teds_power_now(node);
    (void)command;
    (void)origin;
    out[0] = now.flags;
    out[1] = now.level;
    teds_put16(out + 2, now.voltage);
    teds_put16(out + 4, (uint16_t)now.current);
    out[6] = (uint8_t)now.temperature;
    return 7;
}

int teds_clock(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const teds_session *session = origin->session;
    (void)command;
    teds_put64(out, origin->arrival->tick);
    teds_put64(out + 16, session->mark);
    teds_put32(out + 24, node->port->step);
    teds_put16(out + 28, node->port->drift);
    teds_put32(out + 30, session->drive.used && session->drive.seen ? session->drive.last : UINT32_MAX);
    teds_put64(out + 8, teds_now(node));
    return 34;
}

#else
typedef int teds_operation_is_left_out;
#endif
