/* SPDX-License-Identifier: Apache-2.0 */
/* Commands: permission (security-teds.md, 4), routing, and the short handlers. */
#include "commands.h"
#include "about.h"
#include "agree.h"
#include "clock.h"
#include "commit.h"
#include "crypto.h"
#include "datasheet.h"
#include "drive.h"
#include "identity.h"
#include "manage.h"
#include "operation.h"
#include "session.h"
#include "session_life.h"
#include "slots.h"
#include "stream.h"
#include "teds_commands.h"
#include "trigger.h"
#include "inside.h"

#define ADDRESS_NS (10u * TEDS_SECOND)
#define STRANGER_NS TEDS_SECOND

/* -- permission: checked first for each command -------------------------------------------------------------------- */

/* Commands, in the order of their names in the profile. ANY length: the handler checks it, in its own order of checks.
 * */
#define ANY 255u
typedef struct known {
    uint8_t command_class, function, length;
    teds_handler *run;
} known;

static teds_handler run_identify, run_prove, run_reset, run_set_can_address, run_list, run_close;

static const known KNOWN[] = {
    {TEDS_CLASS_SECURITY, TEDS_IDENTIFY, 0, run_identify}, /* first, as the most frequent one */
    {TEDS_CLASS_COMMON, TEDS_QUERY, 1, teds_query},
    {TEDS_CLASS_COMMON, TEDS_READ, 5, teds_read},
    {TEDS_CLASS_COMMON, TEDS_WRITE, ANY, teds_write},
    {TEDS_CLASS_COMMON, TEDS_UPDATE, 1, teds_update},
    {TEDS_CLASS_SECURITY, TEDS_REQUEST, ANY, teds_request},
    {TEDS_CLASS_SECURITY, TEDS_CONFIRM, ANY, teds_confirm},
    {TEDS_CLASS_SECURITY, TEDS_OPEN, ANY, teds_open},
    {TEDS_CLASS_SECURITY, TEDS_CLOSE, 0, run_close},
    {TEDS_CLASS_SECURITY, TEDS_PROVE, 32, run_prove},
    {TEDS_CLASS_SECURITY, TEDS_RESET, 32, run_reset},
    {TEDS_CLASS_SECURITY, TEDS_SET_CAN_ADDRESS, 1, run_set_can_address},
    {TEDS_CLASS_SECURITY, TEDS_LIST, 0, run_list},
    {TEDS_CLASS_SECURITY, TEDS_ABOUT, ANY, teds_about},
    {TEDS_CLASS_SECURITY, TEDS_LOCATE, ANY, teds_locate},
#if TEDS_MANAGED
    {TEDS_CLASS_SECURITY, TEDS_MANAGE, ANY, teds_manage},
#endif
#if TEDS_OPERATION /* commands of operation.md from here on */
    {TEDS_CLASS_SECURITY, TEDS_SAMPLE, ANY, teds_sample},
    {TEDS_CLASS_SECURITY, TEDS_SET, ANY, teds_set},
    {TEDS_CLASS_SECURITY, TEDS_SUBSCRIBE, ANY, teds_subscribe},
    {TEDS_CLASS_SECURITY, TEDS_STOP, 1, teds_stop},
    {TEDS_CLASS_SECURITY, TEDS_CLOCK, 0, teds_clock},
    {TEDS_CLASS_SECURITY, TEDS_ARM, 18, teds_arm},
    {TEDS_CLASS_SECURITY, TEDS_POWER, 0, teds_power_state},
    {TEDS_CLASS_SECURITY, TEDS_OPERATION_STATE, 0, teds_operation_state},
    {TEDS_CLASS_SECURITY, TEDS_DRIVE, ANY, teds_drive},
    {TEDS_CLASS_EITHER, 1, ANY, teds_operate},
    {TEDS_CLASS_EITHER, 2, ANY, teds_idle},
    {TEDS_CLASS_OPERATE, 1, ANY, teds_read_data_set},
    {TEDS_CLASS_OPERATE, 2, ANY, teds_write_data_set},
    {TEDS_CLASS_COMMON, TEDS_SELF_TEST, ANY, teds_self_test},
#endif
};
#define MEASURES (TEDS_MANAGED ? 16u : 15u) /* index of the first command of operation.md */

/* NULL: unknown command. A board without channels has none of operation.md. */
static const known *find_known(const teds_node *node, const teds_command *command)
{
    const size_t count = node->port->channel_count > 0 ? sizeof KNOWN / sizeof KNOWN[0] : MEASURES;
    for (size_t i = 0; i < count; i++) {
        if (KNOWN[i].command_class == command->command_class && KNOWN[i].function == command->function) {
            return &KNOWN[i];
        }
    }
    return NULL;
}

/* While an actuator is claimed, refuse strangers' commands that need slow point arithmetic: they would delay its
 * values. */
static int spare_actuators(const teds_node *node)
{
#if TEDS_OPERATION
    if (!node->config->quick_points && teds_actuator_claimed(node)) {
        return -TEDS_BUSY;
    }
#else
    (void)node;
#endif
    return 0;
}

/* While a stream runs, plain Read, List and About are limited to one a second, over all links together; others get 17.
 * */
static int hold_strangers_back(teds_node *node)
{
#if TEDS_OPERATION
    uint64_t now = teds_now(node);
    if (!teds_streams_running(node)) {
        return 0;
    }
    if (now < node->strangers_again) {
        return -TEDS_BUSY;
    }
    node->strangers_again = now + STRANGER_NS;
#else
    (void)node;
#endif
    return 0;
}

static int permit_plain_security(teds_node *node, const teds_command *command, const teds_origin *origin)
{
    switch (command->function) {
    case TEDS_REQUEST:
    case TEDS_CONFIRM:
    case TEDS_SET_CAN_ADDRESS: return origin->arrival->tapped ? 0 : -TEDS_NOT_PERMITTED;
    case TEDS_OPEN:
        if (teds_in_factory(node)) {
            return -TEDS_WRONG_STATE;
        }
        return command->length == TEDS_OPEN_OCTETS ? spare_actuators(node) : 0;
    case TEDS_SEALED:
        return !teds_in_factory(node) && teds_any_on(node, origin->link) ? 0 : -TEDS_WRONG_STATE;
    case TEDS_IDENTIFY: return 0;
    case TEDS_ABOUT: /* over radio, it would identify a board that has a key */
        if (!teds_in_factory(node) && origin->arrival->kind != TEDS_CAN) {
            return -TEDS_NOT_PERMITTED;
        }
        return hold_strangers_back(node);
    case TEDS_PROVE: return spare_actuators(node);
    case TEDS_RESET:
    case TEDS_LOCATE: return teds_in_factory(node) ? 0 : -TEDS_NOT_PERMITTED;
    case TEDS_LIST: return hold_strangers_back(node);
    default: return -TEDS_NOT_PERMITTED; /* Close, and the commands of operation.md */
    }
}

static int permit_plain(teds_node *node, const teds_command *command, const teds_origin *origin)
{
    if (command->command_class == TEDS_CLASS_SECURITY) {
        return permit_plain_security(node, command, origin);
    }
    if (command->command_class != TEDS_CLASS_COMMON || command->function < TEDS_QUERY || command->function > TEDS_READ) {
        return -TEDS_NOT_PERMITTED;
    }
    return command->function == TEDS_READ ? hold_strangers_back(node) : 0;
}

static int permit_inner(const teds_command *command)
{
    if (command->command_class == TEDS_CLASS_SECURITY &&
        (command->function == TEDS_OPEN || command->function == TEDS_SEALED)) {
        return -TEDS_NOT_PERMITTED;
    }
    return command->known == NULL ? -TEDS_UNKNOWN_COMMAND : 0;
}

static int permit_command(teds_node *node, const teds_command *command, const teds_origin *origin)
{
    const uint8_t function = command->function;
    int refused;
    if (command->command_class == TEDS_CLASS_SECURITY &&
        (command->channel != 0 || function == 0 || function == TEDS_NO_FUNCTION || function > TEDS_MANAGE ||
         (function == TEDS_SET_CAN_ADDRESS && node->config->no_can) ||
         ((function == TEDS_ABOUT || function == TEDS_LOCATE) && node->port->about == NULL))) {
        return -TEDS_UNKNOWN_COMMAND;
    }
    refused = origin->session != NULL ? permit_inner(command) : permit_plain(node, command, origin);
#if TEDS_MANAGED
    if (!refused) {
        refused = teds_demand_no_image(node, command);
    }
#endif
#if TEDS_OPERATION
    if (!refused && command->command_class == TEDS_CLASS_COMMON &&
        (function == TEDS_WRITE || function == TEDS_UPDATE)) {
        refused = teds_demand_configuration(node, origin, function == TEDS_WRITE);
    } else if (!refused && command->command_class == TEDS_CLASS_SECURITY && function == TEDS_SET_CAN_ADDRESS) {
        refused = teds_demand_configuration(node, origin, false);
    }
#endif
    return refused;
}

/* -- class 128: short handlers ------------------------------------------------------------------------------------- */

static int run_identify(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    (void)command;
    (void)origin;
    teds_node_identify(node, out);
    return 23;
}

static int run_close(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    (void)node;
    (void)command;
    (void)out;
    origin->after = TEDS_AFTER_END_SESSION;
    return 0;
}

static int run_prove(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const teds_part parts[] = {{(const uint8_t *)"TEDS1 prove", 12}, {node->identity.uuid, 10}, {command->payload, 32}};
    (void)origin;
    return teds_sign(node, parts, 3, out) == 0 ? 64 : -TEDS_FAILURE;
}

static int run_reset(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    uint8_t epoch[4];
    const teds_part parts[] = {
        {(const uint8_t *)"TEDS1 reset", 12}, {node->identity.uuid, 10}, {epoch, 4}, {command->payload, 32}};
    teds_put32(epoch, node->state.epoch);
    if (teds_sign(node, parts, 4, out) != 0) {
        return -TEDS_FAILURE;
    }
    if (!teds_in_factory(node)) {
        int failed;
#if TEDS_OPERATION
        teds_make_all_safe(node);
#endif
        failed = teds_to_factory(node);
        if (failed) {
            return failed;
        }
        origin->after = TEDS_AFTER_END_ALL;
    }
    teds_pending_forget(node);
    return 64;
}

static int run_set_can_address(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    uint64_t now = teds_now(node);
    (void)out;
    if (command->payload[0] == 0 || command->payload[0] > TEDS_LAST_ADDRESS) {
        return -TEDS_BAD_FORM;
    }
    if (command->payload[0] != node->state.address) {
        teds_state state;
        int failed;
        if (now < node->address_again) {
            return -TEDS_BUSY;
        }
        state = node->state;
        state.address = command->payload[0];
        failed = teds_slots_write(node, &state, NULL);
        teds_wipe(&state, sizeof state);
        if (failed) {
            return failed;
        }
        node->address_again = now + ADDRESS_NS;
    }
    node->can.moves_to = command->payload[0]; /* once the reply has been sent */
    node->can.moves_link = origin->link;
    return 0;
}

static int run_list(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    int32_t id = -1;
    int length = 0;
    (void)command;
    (void)origin;
    while ((id = teds_next_id(node, id, TEDS_STORED | TEDS_NOT_STORED)) < TEDS_NO_ID) {
        if ((size_t)length + 3 > TEDS_ROOM) {
            return -TEDS_TOO_LARGE;
        }
        teds_put16(out + length, (uint16_t)(id >> 8));
        out[length + 2] = (uint8_t)id;
        length += 3;
    }
    return id == TEDS_NO_ID ? length : -TEDS_FAILURE;
}

/* -- routing ------------------------------------------------------------------------------------------------------- */

static int parse_command(teds_node *node, const uint8_t *frame, size_t length, const teds_origin *origin, teds_command *command)
{
    int refused;
    if (length < 6) {
        return -TEDS_BAD_FORM;
    }
    command->channel = teds_get16(frame);
    command->command_class = frame[2];
    command->function = frame[3];
    command->payload = frame + 6;
    command->length = length - 6;
    command->known = find_known(node, command);
    refused = permit_command(node, command, origin);
    if (refused) {
        return refused;
    }
    if (teds_get16(frame + 4) != command->length) {
        return -TEDS_BAD_FORM;
    }
    return command->known == NULL || command->known->length == ANY || command->known->length == command->length
               ? 0
               : -TEDS_BAD_FORM;
}

/* Run a permitted command of the right length, other than Sealed. */
static int run_command(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
#if TEDS_OPERATION
    if (command->known >= KNOWN + MEASURES) {
        /* First end expired leases and dead-men, and take samples that are due, for example before a Stop. */
        (void)teds_operation_poll(node, teds_now(node));
    }
#endif
    return command->known->run(node, command, origin, out);
}

/* Complete the reply frame of a handler, whose payload is at reply + 3. */
static size_t close_reply(uint8_t *reply, int outcome)
{
    reply[0] = outcome >= 0;
    if (outcome < 0) {
        reply[3] = (uint8_t)-outcome;
        outcome = 1;
    }
    teds_put16(reply + 1, (uint16_t)outcome);
    return 3 + (size_t)outcome;
}

static void end_after_reply(teds_node *node, const teds_origin *origin)
{
    if (origin->after == TEDS_AFTER_END_ALL) {
        teds_sessions_end(node);
    } else if (origin->after == TEDS_AFTER_END_SESSION) {
        teds_session_end(node, origin->session);
    }
}

/* Write the payload of Sealed's reply to `out`. The inner command is decrypted into the end of the reply buffer, which
 * is free by then; the inner reply grows from its front. */
static int run_sealed(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    teds_taken taken = {0};
    uint8_t *reply = out + 4;
    uint8_t *inner = out + (TEDS_MAX_MESSAGE - 3) - (command->length >= 36 ? command->length - 20 : 0);
    size_t length;
    int outcome;
#if TEDS_OPERATION
    /* expired leases end first, so that this command cannot renew them */
    (void)teds_operation_poll(node, teds_now(node));
#endif
    outcome = teds_take_sealed(node, origin->link, command->payload, command->length, inner, &taken);
    if (outcome) {
        return outcome;
    }
    if (taken.session == NULL) {
        outcome = -TEDS_NO_ROOM;
    } else {
        teds_command within;
        origin->session = taken.session;
        outcome = parse_command(node, inner, taken.length, origin, &within);
        if (!outcome) {
            outcome = run_command(node, &within, origin, reply + 3);
        }
        if (taken.counter == UINT32_MAX && origin->after == TEDS_AFTER_NOTHING) {
            origin->after = TEDS_AFTER_END_SESSION;
        }
    }
    outcome = teds_seal_reply(node, taken.to_station, taken.counter, out, close_reply(reply, outcome), &length);
    teds_wipe(&taken, sizeof taken);
    return outcome ? -TEDS_FAILURE : (int)length;
}

size_t teds_node_handle(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *frame,
                        size_t length, uint8_t *reply)
{
    teds_origin origin = {link, arrival, NULL, TEDS_AFTER_NOTHING};
    teds_command command;
    int outcome;
    size_t octets;
    (void)teds_sessions_poll(node, teds_now(node));
    outcome = length > TEDS_MAX_MESSAGE ? -TEDS_TOO_LARGE : parse_command(node, frame, length, &origin, &command);
    if (!outcome) {
        outcome = command.known != NULL ? run_command(node, &command, &origin, reply + 3)
                                        : run_sealed(node, &command, &origin, reply + 3);
    }
    octets = close_reply(reply, outcome);
    end_after_reply(node, &origin);
    return octets;
}
