/* SPDX-License-Identifier: Apache-2.0 */
/* CAN (wire.md): lines to stations, one long request at a time, replies, broadcasts, Announce and Claim, and the order
 * of sending. */
#include "can.h"
#include "clock.h"
#include "drive.h"
#include "identity.h"
#include "isotp.h"
#include "links.h"
#include "manage.h"
#include "operation.h"
#include "replies.h"
#include "session.h"
#include "stream.h"
#include "trigger.h"
#include "inside.h"

#define PHYSICAL 0x18DA0000u
#define FUNCTIONAL 0x18DBFF00u
#define ANNOUNCE 0x1CFF0000u
#define TRIGGER 0x18FF0000u
#define DRIVE 0x18EF0000u
#define CR_NS TEDS_SECOND
#define REQUEST_NS (5u * TEDS_SECOND)
#define MILLISECOND UINT64_C(1000000)
/* A reply that has waited so long for flow control gives way to another station's request; stations answer in 1 to 5
 * ms. */
#define PATIENT_NS (100 * MILLISECOND)
#define MOST_OF_12_BITS 4095u
#define LONGEST_SILENCE UINT64_C(30) /* s */
#define SPREAD_NS 50000000u
#define START_NS 500000000u
#define UNIT_BITS 26 /* of the Announce times kept: 67 ms */
#define A_MINUTE (60u * TEDS_SECOND >> UNIT_BITS)
/* A pressed button: ten Announces at once and one more each 6 s, so 20 in any minute. */
#define PRESSES_APART ((TEDS_SECOND >> UNIT_BITS) + 2)
#define PRESS_UNITS (A_MINUTE / 10)
#define PRESSES_PAID (A_MINUTE - PRESS_UNITS)
#define MOVES_AT_ONCE 3u
#define QUIET_NS (600u * TEDS_SECOND) /* without a conflict for so long, moves are immediate again */
#define LONGEST_STAY UINT64_C(60)     /* s */

static bool is_sending(const teds_line *line)
{
    return line->out_state != TEDS_OUT_IDLE;
}

/* A random wait of up to `most` ns. While the chip has no randomness it is derived from the UUID: nodes that start
 * together must not send at the same time. */
static uint32_t draw_wait(const teds_node *node, uint32_t most)
{
    uint8_t octets[2];
    if (node->port->random(node->port->user, octets, sizeof octets) != 0) {
        const uint32_t crc = teds_uuid_crc(node);
        teds_put16(octets, (uint16_t)(crc ^ crc >> 16));
    }
    return (most >> 16) * teds_get16(octets);
}

/* -- lines --------------------------------------------------------------------------------------------------------- */

/* Handle a message that was sent or abandoned. */
static void finish_message(teds_node *node, teds_line *line)
{
    line->out_state = TEDS_OUT_IDLE;
    if (line->out_reply == NULL) {
        return;
    }
    line->out_reply->at = teds_now(node);
    line->out_reply = NULL;
    teds_node_reply_left(node, line->source);
}

/* A broadcast answer that waits for flow control gives way to any other command. */
static bool gives_way(const teds_line *line)
{
    return line->out_reply == NULL && line->out_state == TEDS_OUT_WAITS;
}

/* How easily another station may take a line. Never that of a session, so that strangers cannot take a place that a
 * pair with a session needs; nor that of the long request being received. */
enum { AT_REST, OF_A_BROADCAST, OF_A_REPLY, NOT_AVAILABLE };

static unsigned rank_line(teds_node *node, const teds_line *line, uint64_t now)
{
    if (line->source == 0) {
        return AT_REST;
    }
    if (node->can.rx_line == line || teds_session_on(node, line->source) != NULL) {
        return NOT_AVAILABLE;
    }
    if (!is_sending(line)) {
        return line->asked ? OF_A_BROADCAST : AT_REST;
    }
    if (gives_way(line)) {
        return OF_A_BROADCAST;
    }
    return line->out_state == TEDS_OUT_WAITS && line->out_due + PATIENT_NS <= now + TEDS_N_BS ? OF_A_REPLY
                                                                                              : NOT_AVAILABLE;
}

/* Find a station's line; otherwise the one that is easiest to take, and of equal ones the least recently used. `most`:
 * the limit of what may be taken. NULL: none may be taken, or the node moved to another address when it abandoned a
 * reply. */
static teds_line *find_line(teds_node *node, uint8_t source, unsigned most, uint64_t now)
{
    const uint8_t own = node->can.address;
    unsigned best = NOT_AVAILABLE;
    teds_line *found = NULL;
    node->can.touches++;
    for (teds_line *each = node->lines; each < node->lines + TEDS_CAN_LINES; each++) {
        unsigned held;
        if (each->source == source) {
            each->touched = node->can.touches;
            return each;
        }
        held = rank_line(node, each, now);
        if (held <= most && (held < best || (held == best && each->touched < found->touched))) { /* source 0: unused */
            found = each;
            best = held;
        }
    }
    if (found != NULL && best == OF_A_REPLY) {
        finish_message(node, found);
        found = own == node->can.address ? found : NULL;
    }
    if (found != NULL) {
        memset(found, 0, sizeof *found);
        found->source = source;
        found->own = own;
        found->touched = node->can.touches;
    }
    return found;
}

/* Two nodes at one address drive each other off the bus: stay silent for a second, doubling to half a minute. */
static void keep_silent(teds_can *can, uint64_t now)
{
    if (now < can->back_at) {
        return; /* reported twice */
    }
    if (now >= can->back_at + 2 * LONGEST_SILENCE * TEDS_SECOND) {
        can->bus_offs = 0;
    }
    can->back_at = now + (can->bus_offs < 5 ? UINT64_C(1) << can->bus_offs : LONGEST_SILENCE) * TEDS_SECOND;
    can->bus_offs = (uint8_t)(can->bus_offs < 5 ? can->bus_offs + 1 : 5);
}

void teds_node_bus_off(teds_node *node)
{
    teds_can_links_forget(node);
    keep_silent(&node->can, teds_now(node));
    node->can.announces = node->can.pressed = false;
    if (node->can.moves_to != 0) { /* the reply will not be sent any more */
        teds_address_move(node, node->can.moves_to);
    }
#if TEDS_MANAGED
    if (node->managed.restart_link >= TEDS_FIRST_STATION) {
        teds_restart_after(node, node->managed.restart_link);
    }
#endif
}

/* -- requests ------------------------------------------------------------------------------------------------------ */

/* Send a refusal in place of flow control or a reply, as one frame; the stored reply is kept. */
static void refuse_request(teds_line *line, uint8_t transaction, uint8_t reason, bool fd)
{
    line->refuses = reason;
    line->refused = transaction;
    if (TEDS_CAN_FD && !is_sending(line)) {
        line->fd = fd;
    }
}

/* The time by which a request that begins now must be complete: 5 s, plus our own STmin for each frame. */
static uint64_t find_end(size_t length, size_t octets_of_frame, uint64_t now)
{
    return now + REQUEST_NS + (uint64_t)(length / (octets_of_frame - 1)) * teds_isotp_gap(TEDS_CAN_STMIN);
}

/* Return the reason to refuse a long request of this line because another one is being received; 0: accept it. A pair
 * with a session takes precedence over a stranger. The pair that holds the buffer may not begin another request in it
 * while another pair waits. */
static uint8_t check_reception(teds_node *node, const teds_line *line, uint64_t now)
{
    teds_can *can = &node->can;
    teds_line *holder = can->rx_line;
    if (holder == NULL || now >= can->rx_until) {
        return 0;
    }
    if (holder == line) {
        if (can->rx_wanted) {
            can->rx_line = NULL;
            return TEDS_BUSY;
        }
        return 0;
    }
    if (teds_session_on(node, line->source) != NULL && teds_session_on(node, holder->source) == NULL) {
        holder->flow = 0;
        refuse_request(holder, node->rx[0], TEDS_BUSY, can->rx_frame > 8);
        return 0;
    }
    can->rx_wanted = true;
    return TEDS_BUSY;
}

static void run_can_request(teds_node *node, teds_line *line, const uint8_t *body, size_t length, bool fd, uint64_t tick)
{
    const teds_arrival arrival = {TEDS_CAN, !teds_has_nfc(node) && teds_in_factory(node), fd, tick};
    const uint8_t own = line->own;
    teds_stored_reply *reply;
    if (is_sending(line)) { /* a new request shows that the station no longer wants the reply */
        finish_message(node, line);
        if (line->own != own) {
            return; /* the node has moved, and the old address does not answer */
        }
    }
    reply = teds_answer(node, line->source, &arrival, body, 1, body + 1, length - 1);
    if (TEDS_PLACES_MAY_LACK && reply == NULL) {
        refuse_request(line, body[0], TEDS_BUSY, fd);
        return;
    }
    reply->octets[0] = body[0];
    line->out_reply = reply;
    teds_isotp_begin(line, reply->octets, reply->length, fd);
}

static void take_first_frame(teds_node *node, teds_line *line, const teds_can_frame *frame, uint64_t now)
{
    teds_can *can = &node->can;
    size_t length = (size_t)(frame->data[0] & 15u) << 8 | frame->data[1], head = 2;
    uint8_t reason = 0;
    if (frame->length < 8) {
        return;
    }
    if (length == 0) { /* the length is in 32 bits: more than 4095 octets, otherwise ignored (ISO 15765-2) */
        length = teds_get32(frame->data + 2);
        head = 6;
        if (length <= MOST_OF_12_BITS) {
            return;
        }
    } else if (length < (frame->length > 8 ? frame->length - 1u : 8u)) {
        return; /* it would fit one frame, so it is ignored (FF_DLmin of ISO 15765-2) */
    }
    if (gives_way(line)) {
        line->out_state = TEDS_OUT_IDLE; /* so that the line may answer in the form (classic, FD) of this frame */
    }
    /* always true for a 32-bit length; an accepted request is longer than its first frame */
    if (length > sizeof node->rx) {
        reason = TEDS_TOO_LARGE;
    } else {
        reason = check_reception(node, line, now);
    }
    if (reason != 0) {
        refuse_request(line, frame->data[head], reason, frame->fd);
        return;
    }
    can->rx_line = line;
    can->rx_length = (uint16_t)length;
    can->rx_at = (uint16_t)(frame->length - 2u);
    can->rx_number = 1;
    can->rx_frame = frame->length;
    can->rx_block = TEDS_CAN_BLOCK;
    can->rx_wanted = false;
    can->rx_until = now + CR_NS;
    can->rx_ends = find_end(length, frame->length, now);
    memcpy(node->rx, frame->data + 2, can->rx_at);
    line->flow = 0x30;
    if (TEDS_CAN_FD && !is_sending(line)) {
        line->fd = frame->fd;
    }
}

static void take_consecutive_frame(teds_node *node, teds_line *line, const teds_can_frame *frame, uint64_t now)
{
    teds_can *can = &node->can;
    uint8_t number = frame->data[0] & 15;
    const uint8_t first = TEDS_CAN_FD ? can->rx_frame : 8;
    size_t octets = (size_t)(can->rx_length - can->rx_at);
    if (can->rx_line != line) {
        return;
    }
    if (number == ((can->rx_number + 15u) & 15u) && can->rx_at > 8) {
        return; /* the same frame twice: CAN repeats a frame after an error in its last bit */
    }
    if (frame->length > first || (frame->length < first && frame->length - 1u < octets)) {
        return; /* only the last frame may be shorter than the first, none longer; others are ignored (ISO 15765-2) */
    }
    octets = octets < frame->length - 1u ? octets : frame->length - 1u;
    if (number != can->rx_number || now >= can->rx_until || octets == 0) {
        can->rx_line = NULL;
        return;
    }
    memcpy(node->rx + can->rx_at, frame->data + 1, octets);
    can->rx_at = (uint16_t)(can->rx_at + octets);
    can->rx_number = (uint8_t)((number + 1) & 15);
    can->rx_until = now + CR_NS < can->rx_ends ? now + CR_NS : can->rx_ends;
    if (can->rx_at == can->rx_length) {
        line->flow = 0;
        run_can_request(node, line, node->rx, can->rx_length, frame->fd, now);
        can->rx_line = NULL;
    } else if (TEDS_CAN_BLOCK != 0 && --can->rx_block == 0) {
        can->rx_block = TEDS_CAN_BLOCK;
        line->flow = 0x30;
    }
}

/* Refuse a station for which there is no line, with 17: a refusal needs no line. */
static void turn_station_away(teds_node *node, const teds_can_frame *frame, uint8_t source)
{
    const uint8_t *body = frame->data + 2;
    size_t octets;
    if (frame->data[0] >> 4 == 1 ? frame->length >= 8 : teds_isotp_single(frame->data, frame->length, &body, &octets)) {
        node->can.turned_away = source;
        node->can.turned_away_transaction = body[0];
        node->can.turned_away_fd = TEDS_CAN_FD && frame->fd;
    }
}

static void take_physical(teds_node *node, const teds_can_frame *frame, uint64_t tick)
{
    const uint8_t own = (uint8_t)(frame->identifier >> 8), source = (uint8_t)frame->identifier;
    const uint8_t *body;
    size_t octets;
    teds_line *line;
    if (own != node->can.address || frame->length < 2) {
        return;
    }
    line = find_line(node, source, OF_A_REPLY, tick);
    if (line == NULL) {
        if (own == node->can.address) { /* otherwise the node has moved, and the old address does not answer */
            turn_station_away(node, frame, source);
        }
        return;
    }
    switch (frame->data[0] >> 4) {
    case 0:
        if (teds_isotp_single(frame->data, frame->length, &body, &octets)) {
            if (node->can.rx_line == line) {
                node->can.rx_line = NULL; /* a new message of a station replaces its previous one */
            }
            run_can_request(node, line, body, octets, frame->fd, tick);
        }
        break;
    case 1: take_first_frame(node, line, frame, tick); break;
    case 2: take_consecutive_frame(node, line, frame, tick); break;
    case 3: teds_isotp_flow(line, frame->data, frame->length, tick); break;
    default: break;
    }
}

/* -- broadcasts ---------------------------------------------------------------------------------------------------- */

static void take_functional(teds_node *node, const teds_can_frame *frame, uint64_t now)
{
    static const uint8_t identify[6] = {0, 0, TEDS_CLASS_SECURITY, TEDS_IDENTIFY, 0, 0};
    const uint8_t *body;
    size_t octets;
    teds_line *line;
    if (!teds_isotp_single(frame->data, frame->length, &body, &octets) || octets != 7 ||
        memcmp(body + 1, identify, 6) != 0) {
        return; /* no other command is answered to a broadcast */
    }
    line = find_line(node, (uint8_t)frame->identifier, OF_A_BROADCAST, now);
    if (line != NULL) { /* a newer broadcast of the same station replaces the waiting one */
        line->asked = true;
        line->asked_transaction = body[0];
        line->asked_fd = TEDS_CAN_FD && frame->fd;
        line->asked_due = now + draw_wait(node, SPREAD_NS);
    }
}

/* The answer gives way to the next message. */
static bool may_answer_broadcast(const teds_line *line)
{
    return !is_sending(line) || gives_way(line);
}

/* Answer a broadcast without touching the stored reply. All lines share the octets: the transaction is sent with the
 * first frame, now, and answers in progress are ended when the rest changes (end_old_answers). */
static void answer_broadcast(teds_node *node, teds_line *line)
{
    uint8_t *octets = node->can.broadcast_answer;
    line->asked = false;
    octets[0] = line->asked_transaction;
    octets[1] = 1;
    teds_put16(octets + 2, 23);
    teds_node_identify(node, octets + 4);
    line->out_reply = NULL;
    teds_isotp_begin(line, octets, sizeof node->can.broadcast_answer, TEDS_CAN_FD && line->asked_fd);
}

/* The reply to Identify has changed: end the broadcast answers in progress. */
static void end_old_answers(teds_node *node)
{
    if (!node->identity_changed) {
        return;
    }
    node->identity_changed = false;
    for (teds_line *line = node->lines; line < node->lines + TEDS_CAN_LINES; line++) {
        if (line->out_reply == NULL) {
            line->out_state = TEDS_OUT_IDLE;
        }
    }
}

/* -- Announce and Claim -------------------------------------------------------------------------------------------- */

static void plan_announce(teds_node *node, uint64_t now, uint32_t most)
{
    node->can.announces = true;
    node->can.announce_due = now + draw_wait(node, most);
}

void teds_can_start(teds_node *node, uint64_t now)
{
    plan_announce(node, now > node->can.back_at ? now : node->can.back_at, START_NS);
}

/* The next address at which no node was heard; this node's own if all others are in use. */
static uint8_t find_free_address(const teds_node *node)
{
    const uint8_t own = node->can.address;
    uint8_t address = own;
    do {
        address = (uint8_t)(address < TEDS_LAST_ADDRESS ? address + 1 : 1);
    } while (address != own && (node->can.heard[address >> 3] >> (address & 7) & 1) != 0);
    return address;
}

/* While an actuator is claimed, the node keeps its address and continues to announce it. */
static bool keeps_address(const teds_node *node)
{
#if TEDS_OPERATION
    return teds_actuator_claimed(node);
#else
    (void)node;
    return false;
#endif
}

/* Leave this address to the node that claims it. */
static void give_up_address(teds_node *node, uint64_t now)
{
    node->can.gives_up = false;
    if (!keeps_address(node)) {
        node->can.moves = (uint8_t)(node->can.moves < UINT8_MAX ? node->can.moves + 1 : UINT8_MAX);
        teds_address_move(node, find_free_address(node));
    }
    plan_announce(node, now, SPREAD_NS);
}

static void take_announce(teds_node *node, const teds_can_frame *frame, uint64_t now)
{
    teds_can *can = &node->can;
    uint8_t address = (uint8_t)frame->identifier;
    uint32_t crc, own;
    if (address != node->can.address || frame->length != 8 || frame->data[0] != 1 || frame->data[1] > 2 ||
        frame->data[6] == 1) { /* a pressed button claims no address */
        return;
    }
    crc = teds_get32(frame->data + 2);
    own = teds_uuid_crc(node);
    if (crc == own) {
        return; /* the same UUID twice, which the operator must resolve, or an echo of our own frame */
    }
    if (can->conflict_at != 0 && now - can->conflict_at >= QUIET_NS) {
        can->moves = 0;
    }
    can->conflict_at = now;
    if (crc > own || keeps_address(node)) {
        plan_announce(node, now, SPREAD_NS);
    } else if (can->moves < MOVES_AT_ONCE) {
        give_up_address(node, now);
    } else if (!can->gives_up) {
        /* An Announce is not authenticated, and each move ends the sessions here: delay it. */
        const unsigned doublings = can->moves - MOVES_AT_ONCE;
        can->gives_up = true;
        can->move_at = now + (doublings < 6 ? UINT64_C(1) << doublings : LONGEST_STAY) * TEDS_SECOND;
    }
}

/* At most 20 a minute; more are left out. */
static bool may_announce(teds_node *node, uint64_t now)
{
    teds_can *can = &node->can;
    uint32_t at = (uint32_t)(now >> UNIT_BITS) + 1;
    uint32_t oldest = can->announced[can->announced_at];
    if (oldest != 0 && at - oldest < A_MINUTE + 1) {
        return false;
    }
    can->announced[can->announced_at] = at;
    can->announced_at = (uint8_t)((can->announced_at + 1) % 20);
    return true;
}

void teds_can_pressed(teds_node *node, uint64_t now)
{
    teds_can *can = &node->can;
    const uint32_t at = (uint32_t)(now >> UNIT_BITS) + 1;
    const uint32_t paid = can->pressed_paid > at ? can->pressed_paid : at;
    if (now < can->back_at || (can->pressed_at != 0 && at - can->pressed_at < PRESSES_APART) || paid - at > PRESSES_PAID) {
        return;
    }
    can->pressed = true;
    can->pressed_at = at;
    can->pressed_paid = paid + PRESS_UNITS + 1;
}

static void put_announce(const teds_node *node, teds_can_frame *frame)
{
    frame->identifier = ANNOUNCE | node->can.address;
    frame->fd = false;
    frame->length = 8;
    memset(frame->data, 0, 8);
    frame->data[0] = 1;
    frame->data[1] = teds_state_octet(node);
    teds_put32(frame->data + 2, teds_uuid_crc(node));
}

/* -- in and out ---------------------------------------------------------------------------------------------------- */

void teds_can_rx(teds_node *node, const teds_can_frame *frame, uint64_t tick)
{
    uint8_t source = (uint8_t)frame->identifier;
    end_old_answers(node);
    if (tick < node->can.back_at) {
        return;
    }
    if (frame->length > (frame->fd ? 64 : 8) || (frame->fd && !TEDS_CAN_FD)) {
        return;
    }
    if (source >= 1 && source <= TEDS_LAST_ADDRESS) {
        node->can.heard[source >> 3] |= (uint8_t)(1u << (source & 7));
    }
    if ((frame->identifier & 0x1FFFFF00u) == ANNOUNCE) {
        take_announce(node, frame, tick);
        return;
    }
    if (source < TEDS_FIRST_STATION || source > TEDS_LAST_STATION) {
        return;
    }
    if ((frame->identifier & 0x1FFFFF00u) == FUNCTIONAL) {
        take_functional(node, frame, tick);
    } else if ((frame->identifier & 0x1FFF0000u) == PHYSICAL) {
        take_physical(node, frame, tick);
    }
#if TEDS_OPERATION
    else if ((frame->identifier & 0x1FFFFF00u) == (TRIGGER) && frame->length == 8) {
        teds_trigger(node, source, frame->data, tick);
    } else if ((frame->identifier & 0x1FFF0000u) == DRIVE && (uint8_t)(frame->identifier >> 8) == node->can.address) {
        teds_drive_frame(node, source, frame->data, frame->length);
    }
#endif
}

static void put_flow_control(teds_line *line, teds_can_frame *frame)
{
    frame->fd = TEDS_CAN_FD && line->fd;
    frame->data[0] = line->flow;
    frame->data[1] = TEDS_CAN_BLOCK;
    frame->data[2] = TEDS_CAN_STMIN;
    teds_can_pad(frame, 3);
    line->flow = 0;
}

static void put_refusal(teds_can_frame *frame, uint8_t transaction, uint8_t reason, bool fd)
{
    frame->fd = TEDS_CAN_FD && fd;
    frame->data[0] = 5;
    frame->data[1] = transaction;
    frame->data[2] = 0;
    frame->data[3] = 0;
    frame->data[4] = 1;
    frame->data[5] = reason;
    teds_can_pad(frame, 6);
}

/* The next frame of a line. Flow control first, because a station waits for it. */
static bool next_line_frame(teds_node *node, teds_line *line, teds_can_frame *frame, uint64_t now)
{
    frame->identifier = PHYSICAL | (uint32_t)line->source << 8 | line->own;
    if (line->flow != 0) {
        put_flow_control(line, frame);
        return true;
    }
    if (line->refuses != 0) {
        put_refusal(frame, line->refused, line->refuses, line->fd);
        line->refuses = 0;
        return true;
    }
    if (line->asked && now >= line->asked_due && may_answer_broadcast(line)) {
        answer_broadcast(node, line);
    }
    if (!is_sending(line) || !teds_isotp_next(line, frame, now)) {
        return false;
    }
    if (line->out_state == TEDS_OUT_IDLE) {
        finish_message(node, line);
    }
    return true;
}

bool teds_can_tx(teds_node *node, teds_can_frame *frame, uint64_t now)
{
    end_old_answers(node);
    if (now < node->can.back_at) {
        return false;
    }
    for (teds_line *line = node->lines; line < node->lines + TEDS_CAN_LINES; line++) {
        if (line->source != 0 && next_line_frame(node, line, frame, now)) {
            return true;
        }
    }
    if (node->can.turned_away != 0) {
        frame->identifier = PHYSICAL | (uint32_t)node->can.turned_away << 8 | node->can.address;
        put_refusal(frame, node->can.turned_away_transaction, TEDS_BUSY, node->can.turned_away_fd);
        node->can.turned_away = 0;
        return true;
    }
    if (node->can.pressed) {
        node->can.pressed = false;
        put_announce(node, frame);
        frame->data[6] = 1;
        return true;
    }
    if (node->can.announces && now >= node->can.announce_due) {
        node->can.announces = false;
        if (may_announce(node, now)) {
            put_announce(node, frame);
            return true;
        }
    }
#if TEDS_OPERATION
    return teds_data_next(node, frame, now);
#else
    return false;
#endif
}

uint64_t teds_can_poll(teds_node *node, uint64_t now)
{
    teds_can *can = &node->can;
    uint64_t due;
    end_old_answers(node);
    if (can->gives_up && now >= can->move_at) {
        give_up_address(node, now);
    }
    due = can->turned_away != 0 || can->pressed ? now : TEDS_NEVER;
    if (can->announces) {
        teds_sooner(&due, can->announce_due);
    }
    if (can->gives_up) {
        teds_sooner(&due, can->move_at);
    }
    if (can->rx_line != NULL) {
        if (now >= can->rx_until) {
            can->rx_line = NULL;
        } else {
            teds_sooner(&due, can->rx_until);
        }
    }
    for (teds_line *line = node->lines; line < node->lines + TEDS_CAN_LINES; line++) {
        if (line->out_state == TEDS_OUT_WAITS && now >= line->out_due) {
            finish_message(node, line); /* no flow control came */
        }
        if (is_sending(line)) {
            teds_sooner(&due, line->out_due);
        }
        if (line->asked && may_answer_broadcast(line)) {
            teds_sooner(&due, line->asked_due);
        }
        if (line->flow != 0 || line->refuses != 0) {
            due = now;
        }
    }
    return due;
}
