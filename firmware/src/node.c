/* SPDX-License-Identifier: Apache-2.0 */
/* One node: which command may be run when (security-teds.md, 4), routing, and the commands that need little. */
#include "node.h"
#include "about.h"
#include "agree.h"
#include "ble.h"
#include "can.h"
#include "clock.h"
#include "commit.h"
#include "drive.h"
#include "isotp.h"
#include "manage.h"
#include "operation.h"
#include "session.h"
#include "stream.h"
#include "teds_store.h"
#include "tnep.h"
#include "inside.h"

#define ADDRESS_NS (10u * TEDS_SECOND)
#define STRANGER_NS TEDS_SECOND
#define KEEP_NS (20u * TEDS_SECOND)

/* -- permission: the first question asked of a command --------------------------------------------------------------- */

/* Commands, in the order of their names in the profile; any length where the handler asks for it in its own order. */
#define ANY 255u
typedef struct known {
    uint8_t command_class, function, length;
    teds_handler *run;
} known;

static teds_handler identify, prove, reset, set_can_address, list, close_session;

static const known KNOWN[] = {
    {TEDS_CLASS_SECURITY, TEDS_IDENTIFY, 0, identify}, /* asked most */
    {TEDS_CLASS_COMMON, TEDS_QUERY, 1, teds_query},
    {TEDS_CLASS_COMMON, TEDS_READ, 5, teds_read},
    {TEDS_CLASS_COMMON, TEDS_WRITE, ANY, teds_write},
    {TEDS_CLASS_COMMON, TEDS_UPDATE, 1, teds_update},
    {TEDS_CLASS_SECURITY, TEDS_REQUEST, ANY, teds_request},
    {TEDS_CLASS_SECURITY, TEDS_CONFIRM, ANY, teds_confirm},
    {TEDS_CLASS_SECURITY, TEDS_OPEN, ANY, teds_open},
    {TEDS_CLASS_SECURITY, TEDS_CLOSE, 0, close_session},
    {TEDS_CLASS_SECURITY, TEDS_PROVE, 32, prove},
    {TEDS_CLASS_SECURITY, TEDS_RESET, 32, reset},
    {TEDS_CLASS_SECURITY, TEDS_SET_CAN_ADDRESS, 1, set_can_address},
    {TEDS_CLASS_SECURITY, TEDS_LIST, 0, list},
    {TEDS_CLASS_SECURITY, TEDS_ABOUT, ANY, teds_about},
    {TEDS_CLASS_SECURITY, TEDS_LOCATE, ANY, teds_locate},
#if TEDS_MANAGED
    {TEDS_CLASS_SECURITY, TEDS_MANAGE, ANY, teds_manage},
#endif
#if TEDS_OPERATION /* from here on those of operation.md */
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
#define MEASURES (TEDS_MANAGED ? 16u : 15u) /* place of the first of operation.md */

/* NULL: no such command here. A board without channels offers none of operation.md. */
static const known *look_up(const teds_node *node, const teds_command *command)
{
    const size_t count = node->port->channel_count > 0 ? sizeof KNOWN / sizeof KNOWN[0] : MEASURES;
    for (size_t i = 0; i < count; i++) {
        if (KNOWN[i].command_class == command->command_class && KNOWN[i].function == command->function) {
            return &KNOWN[i];
        }
    }
    return NULL;
}

/* No stranger's point arithmetic may hold up the values of a claimed actuator. */
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

/* While a stream runs, plain Read and List beyond one a second get 17, together and over all links. */
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

static int plain_security(teds_node *node, const teds_command *command, const teds_origin *origin)
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
    case TEDS_ABOUT: /* by radio a board with a key would be told apart by it */
        return teds_in_factory(node) || origin->arrival->kind == TEDS_CAN ? 0 : -TEDS_NOT_PERMITTED;
    case TEDS_PROVE: return spare_actuators(node);
    case TEDS_RESET:
    case TEDS_LOCATE: return teds_in_factory(node) ? 0 : -TEDS_NOT_PERMITTED;
    case TEDS_LIST: return hold_strangers_back(node);
    default: return -TEDS_NOT_PERMITTED; /* Close, and what measures */
    }
}

static int plain(teds_node *node, const teds_command *command, const teds_origin *origin)
{
    if (command->command_class == TEDS_CLASS_SECURITY) {
        return plain_security(node, command, origin);
    }
    if (command->command_class != TEDS_CLASS_COMMON || command->function < TEDS_QUERY || command->function > TEDS_READ) {
        return -TEDS_NOT_PERMITTED;
    }
    return command->function == TEDS_READ ? hold_strangers_back(node) : 0;
}

static int inner(const teds_command *command)
{
    if (command->command_class == TEDS_CLASS_SECURITY &&
        (command->function == TEDS_OPEN || command->function == TEDS_SEALED)) {
        return -TEDS_NOT_PERMITTED;
    }
    return command->known == NULL ? -TEDS_UNKNOWN_COMMAND : 0;
}

static int permitted(teds_node *node, const teds_command *command, const teds_origin *origin)
{
    const uint8_t function = command->function;
    int refused;
    if (command->command_class == TEDS_CLASS_SECURITY &&
        (command->channel != 0 || function == 0 || function == TEDS_NO_FUNCTION || function > TEDS_MANAGE ||
         (function == TEDS_SET_CAN_ADDRESS && node->config->no_can) ||
         ((function == TEDS_ABOUT || function == TEDS_LOCATE) && node->port->about == NULL))) {
        return -TEDS_UNKNOWN_COMMAND;
    }
    refused = origin->session != NULL ? inner(command) : plain(node, command, origin);
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

/* -- class 128, the small ones ---------------------------------------------------------------------------------------- */

uint8_t teds_state_octet(const teds_node *node)
{
    return teds_in_factory(node) ? 0 : (node->state.flags & TEDS_PROVISIONED) != 0 ? 2 : 1;
}

void teds_node_identify(const teds_node *node, uint8_t out[23])
{
    const teds_state *state = &node->state;
    out[0] = 1;
    memcpy(out + 1, node->identity.uuid, 10);
    out[11] = teds_state_octet(node);
    teds_put32(out + 12, state->epoch);
    teds_put32(out + 16, state->sequence);
    teds_put16(out + 20, TEDS_MAX_MESSAGE);
    out[22] = node->config->no_can ? 0 : node->can.address;
}

static int identify(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    (void)command;
    (void)origin;
    teds_node_identify(node, out);
    return 23;
}

static int close_session(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    (void)node;
    (void)command;
    (void)out;
    origin->after = TEDS_AFTER_END_SESSION;
    return 0;
}

static int prove(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const teds_part parts[] = {{(const uint8_t *)"TEDS1 prove", 12}, {node->identity.uuid, 10}, {command->payload, 32}};
    (void)origin;
    return teds_sign(node, parts, 3, out) == 0 ? 64 : -TEDS_FAILURE;
}

static int reset(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
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
        teds_everything_safe(node);
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

static int set_can_address(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    teds_state state = node->state;
    uint64_t now = teds_now(node);
    int failed;
    (void)out;
    if (command->payload[0] == 0 || command->payload[0] > TEDS_LAST_ADDRESS) {
        return -TEDS_BAD_FORM;
    }
    if (command->payload[0] != state.address) {
        if (now < node->address_again) {
            return -TEDS_BUSY;
        }
        state.address = command->payload[0];
        failed = teds_store_write(node, &state, NULL);
        if (failed) {
            return failed;
        }
        node->address_again = now + ADDRESS_NS;
    }
    node->can.moves_to = command->payload[0]; /* when the reply has left */
    node->can.moves_link = origin->link;
    return 0;
}

static int list(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
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

/* -- routing ---------------------------------------------------------------------------------------------------------- */

static int cut(teds_node *node, const uint8_t *frame, size_t length, const teds_origin *origin, teds_command *command)
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
    command->known = look_up(node, command);
    refused = permitted(node, command, origin);
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

/* A command that is permitted and whose length is right, other than Sealed. */
static int run(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
#if TEDS_OPERATION
    if (command->known >= KNOWN + MEASURES) {
        /* what is due by now goes first: a lease or dead-man that ran out, samples taken before a Stop */
        (void)teds_operation_poll(node, teds_now(node));
    }
#endif
    return command->known->run(node, command, origin, out);
}

/* The reply frame around a handler's outcome, whose payload stands at reply + 3. */
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

static void run_after(teds_node *node, const teds_origin *origin)
{
    if (origin->after == TEDS_AFTER_END_ALL) {
        teds_end_everything(node);
    } else if (origin->after == TEDS_AFTER_END_SESSION) {
        teds_session_end(node, origin->session);
    }
}

/* The payload of Sealed's reply at `out`. The inner command is deciphered to the end of the reply's own room, which
 * nobody reads any more; its reply grows from the front. */
static int sealed(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    teds_taken taken = {0};
    uint8_t *reply = out + 4;
    uint8_t *inner = out + (TEDS_MAX_MESSAGE - 3) - (command->length >= 36 ? command->length - 20 : 0);
    size_t length;
    int outcome;
#if TEDS_OPERATION
    (void)teds_operation_poll(node, teds_now(node)); /* a lease that ran out before is over: this does not revive it */
#endif
    outcome = teds_take_sealed(node, origin->link, origin->arrival, command->payload, command->length, inner, &taken);
    if (outcome) {
        return outcome;
    }
    if (taken.session == NULL) {
        outcome = -TEDS_NO_ROOM;
    } else {
        teds_command within;
        origin->session = taken.session;
        outcome = cut(node, inner, taken.length, origin, &within);
        if (!outcome) {
            outcome = run(node, &within, origin, reply + 3);
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
    outcome = length > TEDS_MAX_MESSAGE ? -TEDS_TOO_LARGE : cut(node, frame, length, &origin, &command);
    if (!outcome) {
        outcome = command.known != NULL ? run(node, &command, &origin, reply + 3)
                                        : sealed(node, &command, &origin, reply + 3);
    }
    octets = close_reply(reply, outcome);
    run_after(node, &origin);
    return octets;
}

/* -- stored replies ----------------------------------------------------------------------------------------------------- */

static bool is_being_sent(const teds_node *node, const teds_stored_reply *reply)
{
    for (const teds_line *line = node->lines; line < node->lines + TEDS_CAN_LINES; line++) {
        if (line->out_state != TEDS_OUT_IDLE && line->out_reply == reply) {
            return true;
        }
    }
#if TEDS_NFC
    if (node->nfc.answered && node->nfc.reply == reply) {
        return true;
    }
#endif
#if TEDS_BLE
    return teds_ble_sends(node, reply);
#else
    return false;
#endif
}

/* A link's place: its own, a free one, the oldest of those whose link has no session; of these rather one that is not
 * being sent. NULL: every place is that of a session, in a build that has no place more than sessions. */
teds_stored_reply *teds_reply_place(teds_node *node, teds_link link)
{
    enum { FREE, TAKEN, SENT, NONE } best = NONE;
    teds_stored_reply *found = node->replies;
    for (teds_stored_reply *each = node->replies; each < node->replies + TEDS_REPLIES; each++) {
        if (each->used && each->link == link) {
            return each;
        }
    }
    for (teds_stored_reply *each = node->replies; each < node->replies + TEDS_REPLIES; each++) {
        const unsigned rank = !each->used ? FREE : is_being_sent(node, each) ? SENT : TAKEN;
        if (each->used && teds_session_on(node, each->link) != NULL) {
            continue;
        }
        if (rank < best || (rank == best && each->at < found->at)) {
            found = each;
            best = rank;
        }
    }
    if (TEDS_PLACES_MAY_LACK && best == NONE) {
        return NULL;
    }
    for (teds_line *line = node->lines; line < node->lines + TEDS_CAN_LINES; line++) {
        if (line->out_reply == found) {
            line->out_state = TEDS_OUT_IDLE;
            line->out_reply = NULL; /* it is another link's from now on */
        }
    }
#if TEDS_NFC
    node->nfc.answered = node->nfc.answered && node->nfc.reply != found;
#endif
#if TEDS_BLE
    teds_ble_forget(node, found);
#endif
    found->used = true;
    found->stored = false;
    found->link = link;
    return found;
}

/* Identify, Prove, About, List, Query and Read outside Sealed are always run anew. */
static bool always_anew(const uint8_t *frame, size_t length)
{
    if (length < 4) {
        return false;
    }
    if (frame[2] == TEDS_CLASS_COMMON) {
        return frame[3] == TEDS_QUERY || frame[3] == TEDS_READ;
    }
    return frame[2] == TEDS_CLASS_SECURITY &&
           (frame[3] == TEDS_IDENTIFY || frame[3] == TEDS_PROVE || frame[3] == TEDS_LIST || frame[3] == TEDS_ABOUT);
}

teds_stored_reply *teds_answer(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *transaction,
                               size_t transaction_length, const uint8_t *frame, size_t length)
{
    const teds_part parts[] = {{transaction, transaction_length}, {frame, length < TEDS_MAX_MESSAGE ? length : TEDS_MAX_MESSAGE}};
    teds_stored_reply *place = teds_reply_place(node, link);
    uint8_t digest[32];
    if (TEDS_PLACES_MAY_LACK && place == NULL) {
        return NULL;
    }
    teds_sha256_parts(node, parts, 2, digest);
    if (!place->stored || memcmp(digest, place->digest, 32) != 0 || teds_now(node) >= place->at + KEEP_NS ||
        always_anew(frame, length)) {
        place->stored = false;
        place->length = (uint16_t)(1 + teds_node_handle(node, link, arrival, frame, length, place->octets + 1));
        memcpy(place->digest, digest, 32);
        place->used = true; /* its link may have ended by its own command */
        place->stored = length <= TEDS_MAX_MESSAGE;
        place->link = link;
        place->at = teds_now(node);
    }
    return place;
}

/* -- the life of a node -------------------------------------------------------------------------------------------------- */

int teds_node_init_as_built(teds_node *node, uint32_t built, const teds_config *config, const teds_port *port)
{
    uint8_t counter[8];
    teds_firmware firmware;
    int failed;
    if (built != teds_built()) {
        return TEDS_E_BUILD; /* this node may be larger than the board's */
    }
    memset(node, 0, sizeof *node);
    node->config = config;
    node->port = port;
    if (port->p256_make == NULL || port->unit == 0 || port->unit > 32 || (port->unit & (port->unit - 1)) != 0 ||
        port->slot_octets < TEDS_STAGING + 256u || port->identity_octets < 192 ||
        (TEDS_NFC && config->nfc.present && config->nfc.max_ndef != 0 && config->nfc.max_ndef < 160)) {
        return TEDS_E_USAGE;
    }
#if TEDS_NFC
    if (config->nfc.present && !teds_nfc_services_good(config)) {
        return TEDS_E_USAGE;
    }
#endif
#if TEDS_OPERATION
    if (!teds_channels_good(port)) {
        return TEDS_E_USAGE;
    }
#endif
    (void)teds_firmware_read(node, &firmware); /* first: while an image is on trial no flash is changed */
    failed = teds_store_load(node);
    if (failed) {
        return failed;
    }
    /* c of Open is random at each start, so that no mac from before it is good again */
    if (port->random(port->user, counter, sizeof counter) != 0) {
        return TEDS_E_RANDOM;
    }
    node->opens = teds_get64(counter);
    node->can.address = node->state.address;
#if TEDS_OPERATION
    teds_operation_start(node);
#endif
#if TEDS_NFC
    teds_nfc_start(node);
#endif
    return 0;
}

void teds_node_reply_left(teds_node *node, teds_link link)
{
#if TEDS_OPERATION
    teds_streams_ready(node, teds_session_on(node, link));
#endif
    if (node->can.moves_to != 0 && node->can.moves_link == link) {
        teds_can_move(node, node->can.moves_to);
    }
#if TEDS_MANAGED
    teds_restart_after(node, link);
#endif
}

void teds_node_link_lost(teds_node *node, teds_link link)
{
    teds_link_forget(node, link);
    if (node->can.moves_to != 0 && node->can.moves_link == link) {
        teds_can_move(node, node->can.moves_to); /* nobody waits for the reply any more */
    }
#if TEDS_MANAGED
    teds_restart_after(node, link);
#endif
}

int teds_node_reset_by_hand(teds_node *node)
{
    int failed;
#if TEDS_OPERATION
    teds_everything_safe(node);
#endif
    if (teds_on_trial(node) && node->port->restart != NULL) {
        node->port->restart(node->port->user);
        return 0;
    }
    failed = teds_in_factory(node) ? 0 : teds_to_factory(node); /* no write where nothing changes */
    if (failed) {
        return TEDS_E_FLASH;
    }
    teds_end_everything(node);
    return 0;
}

uint64_t teds_node_poll(teds_node *node, uint64_t now)
{
    uint64_t next = TEDS_NEVER;
#if TEDS_OPERATION
    next = teds_operation_poll(node, now);
#endif
#if TEDS_NFC
    teds_nfc_poll(node);
#endif
    teds_sooner(&next, teds_can_poll(node, now));
    teds_sooner(&next, teds_locate_poll(node, now));
#if TEDS_MANAGED
    teds_sooner(&next, teds_trial_poll(node, now));
#endif
    teds_store_poll(node, now);
#if TEDS_NFC
    if (node->old_slot_due && now < node->nfc.busy_until) {
        teds_sooner(&next, node->nfc.busy_until);
    }
#endif
    if (node->old_slot_due) {
        teds_sooner(&next, node->old_slot_by);
    }
    teds_sooner(&next, teds_sessions_poll(node, now)); /* last: what ran above may have opened one */
    return next;
}

bool teds_idle_work(teds_node *node)
{
    return !node->one_time.ready && teds_one_time_make(node) == 0;
}

uint64_t teds_node_missed(const teds_node *node)
{
#if TEDS_OPERATION
    uint64_t missed = node->missed;
    for (const teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        missed += each->used ? each->missed : 0;
    }
    return missed;
#else
    (void)node;
    return 0;
#endif
}
